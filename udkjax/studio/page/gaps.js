// Gaps between links: the server finds the least gap of each pair over the range of the motor. Links that touch in the position
// shown are red, and a click on a pair shows it where it is closest.

import {timeOfText} from "./along.js";
import {ask} from "./api.js";
import {list} from "./document.js";
import {button, make} from "./player/elements.js";
import {paintTouching} from "./player/gap_marks.js";

const BUTTON = "Gaps between links";

export class GapsPanel {
  constructor(studio, element) {
    Object.assign(this, {studio, element});
    this.clear();
  }

  /** Forget the gaps; offer to find those of the drawing that a text describes, if it has one motor. */
  clear(text = null) {
    Object.assign(this, {text, found: null});
    this.element.replaceChildren(...(text === null ? [] : [button(BUTTON, "find how close links come to each other over the range of the motor", () => this.find(), "small")]));
  }

  async find() {
    const {text} = this;
    this.element.replaceChildren(make("p", {role: "status"}, "computing gaps …"));
    const found = await ask("diagnose", {text, about: "gaps"}).catch(error => ({problems: [error.message]}));
    if (text !== this.text) return;
    this.clear(text);
    if (found.problems.length) this.element.append(...found.problems.map(words => make("p", {class: "warn"}, words)));
    else this.show(found);
  }

  show(found) {
    const {studio} = this, links = list(studio.document, "link").map(({name}) => name), {bodies} = studio.motion.pageEngine.scene;
    this.found = {pairs: found.pairs, parts: found.parts.map(part => ({...part, body: links.indexOf(bodies[part.body])}))};
    const row = gap => make("tr", {class: gap.touches ? "bad" : ""}, ...[gap.words, gap.gap, gap.at].map(words => make("td", {}, words)),
      make("td", {}, button("Show", `show ${gap.words} where they are closest`, () => this.jump(gap), "small")));
    this.element.replaceChildren(make("figure", {}, make("figcaption", {}, `least gaps, by ${found.counted}`), make("div", {class: "wide"}, make("table", {}, make("tbody", {}, ...found.gaps.map(row))))),
      ...found.remarks.map(words => make("p", {class: "bad"}, words)));
    studio.redraw();
  }

  /** Show a pair where it is closest: at the time at which the motion comes there, or as a pose. */
  jump({at, q, words, gap}) {
    const {studio: {motion}, studio} = this, t = motion.end ? timeOfText(at, motion.run, motion.pageEngine.scene) : null;
    if (t === null) motion.pose(Float64Array.from(q));
    else {
      motion.pause();
      motion.posed = null;
      motion.seek(t);
    }
    studio.say(`${words}: ${gap}`);
  }

  /** Paint the links that touch in the position shown; returns their parts. */
  draw(painter) { return this.found ? paintTouching(painter, this.found) : new Set(); }
}
