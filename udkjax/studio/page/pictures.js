// A picture behind the drawing, scaled by the distance of two of its points. It stays in the page and is not saved in the file.

import {length, lengthName, tidy, lengthUnit} from "./units.js";
import {button, make} from "./player/elements.js";

const SHARE = 0.7;  // width of a new picture as a fraction of the view
const OPACITY = 0.5;

export class Pictures {
  constructor(studio, element) {
    Object.assign(this, {studio, element});
    this.input = make("input", {type: "file", accept: "image/*", "aria-label": "background picture", hidden: ""});
    this.input.addEventListener("change", () => this.take(this.input.files[0]));
    this.show();
  }

  show() {
    const has = Boolean(this.studio.picture);
    this.element.replaceChildren(this.input, ...(has ? [
      button("scale", "set the scale of the picture: drag between two of its points", () => this.studio.setTool("scale")),
      button("no picture", "remove the picture", () => this.remove())] : [button("picture", "put a picture behind the drawing", () => this.input.click())]));
  }

  async take(file) {
    if (!file) return;
    const image = new Image(), address = URL.createObjectURL(file);
    image.src = address;
    try {
      await image.decode();
    } catch {
      URL.revokeObjectURL(address);
      return this.studio.say(`this browser cannot show ${file.name} as a picture`, true);
    }
    const {view, canvas} = this.studio, width = SHARE * canvas.width / view.scale;
    const left = (canvas.width / 2 - view.x) / view.scale - width / 2, middle = (view.y - canvas.height / 2) / view.scale;
    this.studio.picture = {image, address, x: left, y: middle - width * image.height / image.width / 2, width, opacity: OPACITY};
    this.input.value = "";
    this.show();
    return this.studio.setTool("scale");
  }

  remove() {
    URL.revokeObjectURL(this.studio.picture.address);
    this.studio.picture = null;
    if (this.studio.tool === "scale") this.studio.setTool("select");
    this.show();
    this.studio.redraw();
  }

  /** Ask for the distance of two points (m) of the picture, and scale it about the first one. */
  scale([ax, ay], [bx, by]) {
    const {studio} = this, {document} = studio, now = Math.hypot(bx - ax, by - ay);
    if (!(now > 0)) return studio.say("drag from one point of the picture to another");
    const input = make("input", {type: "text", value: tidy(+(now / lengthUnit(document)).toPrecision(3)), "aria-label": "distance"});
    const form = make("form", {method: "dialog"}, make("label", {class: "field"}, make("span", {}, "distance"), input, make("span", {class: "unit"}, lengthName(document))),
      make("div", {class: "group end"}, make("button", {class: "strong"}, "Scale")));
    form.addEventListener("submit", () => {
      const text = input.value.trim(), wanted = length(/^[\d.eE+-]+$/.test(text) ? +text : text, document);
      if (!(wanted > 0)) return studio.say(`"${text}" is not a distance: write 12 or 12 mm, for example`, true);
      const {picture} = studio, ratio = wanted / now;
      studio.picture = {...picture, width: picture.width * ratio, x: ax + (picture.x - ax) * ratio, y: ay + (picture.y - ay) * ratio};
      return studio.setTool("select");
    });
    studio.files.dialog("Distance between the two points", form);
    input.select();
    return undefined;
  }
}
