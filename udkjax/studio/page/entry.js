// Places typed instead of clicked: a pin's name, "x, y", or "length @ angle" from the place before. With it, tools need no mouse.

import {pinsOf, placeOf} from "./document.js";
import {toolOf} from "./tools.js";
import {placeFrom} from "./units.js";
import {toPixels} from "./view.js";
import {make} from "./player/elements.js";

const SAME = 1e-9;  // m: a typed place so close to a pin is this pin
const KINDS = ["points", "click", "corners"];  // of tools that take places

export class PlaceEntry {
  constructor(studio, element) {
    Object.assign(this, {studio, element, last: [0, 0]});
    this.input = make("input", {type: "text", "aria-label": "place", spellcheck: "false", placeholder: "A, or 12, 30, or 50 @ 60"});
    this.words = make("span", {});
    const form = make("form", {}, this.words, this.input);
    form.addEventListener("submit", event => { event.preventDefault(); this.take(this.input.value.trim()); });
    this.input.addEventListener("keydown", event => { if (event.key === "Escape") { event.stopPropagation(); this.close(); studio.gestures.cancel(); } });
    element.append(form);
    element.hidden = true;
  }

  /** Ask for a place for the tool in hand, beginning with a text; returns false if the tool takes none. */
  open(text = "") {
    const tool = toolOf(this.studio.tool);
    if (!KINDS.includes(tool.kind)) return false;
    if (this.studio.isMoved) this.studio.rewind();
    this.element.hidden = false;
    this.input.value = text;
    this.ask();
    this.input.focus();
    return true;
  }

  close() {
    this.element.hidden = true;
    this.studio.parts.canvas.focus({preventScroll: true});
  }

  ask() {
    const {gestures, tool} = this.studio, {kind} = toolOf(tool);
    this.words.textContent = kind === "click" ? "at" : kind === "corners" ? `corner ${gestures.corners.length + 1}` : gestures.start ? "to" : "from";
  }

  take(text) {
    const {studio, studio: {document, gestures}} = this;
    if (!text) return gestures.corners.length > 2 ? gestures.finish() : this.close();
    const place = Object.hasOwn(pinsOf(document), text) ? placeOf(document, text) : placeFrom(text, this.last, document);
    if (!place) return studio.say(`"${text}" is not a place: write a pin's name, 12, 30, or 50 @ 60`, true);
    const pin = Object.keys(pinsOf(document)).find(name => name === text || Math.hypot(...[0, 1].map(k => (placeOf(document, name)?.[k] ?? Infinity) - place[k])) < SAME) ?? null;
    this.last = place;
    this.input.value = "";
    gestures.give({pin, link: null, place, free: place, pixel: toPixels(studio.view, place)});
    studio.redraw();
    return this.ask();
  }
}
