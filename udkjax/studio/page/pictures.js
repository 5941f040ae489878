// A picture behind the drawing, brought to scale by two of its points and their distance. It stays in the page: it is no part of the file.

import {length, lengthName, tidy, lengthUnit} from "./units.js";
import {button, make} from "./player/elements.js";

const SHARE = 0.7;  // of the view that a new picture takes
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
      button("scale", "bring the picture to scale: drag between two of its points", () => this.studio.setTool("scale")),
      button("no picture", "take the picture away", () => this.remove())] : [button("picture", "a picture behind the drawing", () => this.input.click())]));
  }

  async take(file) {
    if (!file) return;
    const image = new Image(), address = URL.createObjectURL(file);
    image.src = address;
    try {
      await image.decode();
    } catch {
      URL.revokeObjectURL(address);
      return this.studio.say(`${file.name} is no picture that this browser shows`, true);
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

  /** Ask how far two points (m) of the picture are apart, and scale it about the first one. */
  scale([ax, ay], [bx, by]) {
    const {studio} = this, {document} = studio, now = Math.hypot(bx - ax, by - ay);
    if (!(now > 0)) return studio.say("drag from one point of the picture to another");
    const input = make("input", {type: "text", value: tidy(+(now / lengthUnit(document)).toPrecision(3)), "aria-label": "distance"});
    const form = make("form", {method: "dialog"}, make("label", {class: "field"}, make("span", {}, "distance"), input, make("span", {class: "unit"}, lengthName(document))),
      make("div", {class: "group end"}, make("button", {class: "strong"}, "Scale")));
    form.addEventListener("submit", () => {
      const text = input.value.trim(), wanted = length(/^[\d.eE+-]+$/.test(text) ? +text : text, document);
      if (!(wanted > 0)) return studio.say(`${text} is no distance`, true);
      const {picture} = studio, ratio = wanted / now;
      studio.picture = {...picture, width: picture.width * ratio, x: ax + (picture.x - ax) * ratio, y: ay + (picture.y - ay) * ratio};
      return studio.setTool("select");
    });
    studio.files.dialog("How far apart are they?", form);
    input.select();
    return undefined;
  }
}
