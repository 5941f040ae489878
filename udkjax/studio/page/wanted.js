// A wanted path, drawn by hand or read from a table, and the mechanisms whose point passes along it, which the server finds.

import {ask} from "./api.js";
import {lengthName, lengthUnit, shown} from "./units.js";
import {make} from "./player/elements.js";

const CLOSE = 0.5;  // px: a stroke has no points closer to each other
const FEWEST = 3;

/** The places of a table of two columns, x and y in the document's unit; null if it has none. Further columns and headings are left out. */
export function placesOfTable(text, unit) {
  const rows = text.split(/\r?\n/).map(line => line.trim().split(/[\s,;]+/).slice(0, 2).map(Number)).filter(row => row.length === 2 && row.every(Number.isFinite));
  return rows.length >= FEWEST ? rows.map(row => row.map(x => x * unit)) : null;
}

export class WantedPath {
  constructor(studio, element) {
    Object.assign(this, {studio, element, points: null, designs: [], at: 0, seed: 0, busy: null});
    this.input = make("input", {type: "file", accept: ".csv,.txt,text/*", "aria-label": "table of a wanted path", hidden: ""});
    this.input.addEventListener("change", () => this.read(this.input.files[0]));
    this.show();
  }

  /** Begin, continue and end a stroke. */
  begin(place) { Object.assign(this, {points: [place], designs: [], seed: 0}); }

  go(place) {
    const last = this.points.at(-1), {scale} = this.studio.view;
    if (Math.hypot(place[0] - last[0], place[1] - last[1]) * scale >= CLOSE) this.points.push(place);
  }

  end() {
    if (this.points.length < FEWEST) return this.remove("a path is drawn by dragging: let go at its end, or near its beginning to close it");
    this.studio.setTool("select");
    return this.show();
  }

  async read(file) {
    if (!file) return;
    const {studio} = this, points = placesOfTable(await file.text(), lengthUnit(studio.document));
    this.input.value = "";
    if (!points) return void studio.say(`${file.name} has no two columns of numbers, x and y`, true);
    Object.assign(this, {points, designs: [], seed: 0});
    this.show();
    studio.fit();
  }

  remove(words = "") {
    this.busy?.abort();
    Object.assign(this, {points: null, designs: [], busy: null});
    this.studio.say(words);
    this.show();
  }

  async find() {
    const {studio} = this, {document} = studio;
    this.busy = new AbortController();
    this.show();
    try {
      const found = await ask("design", {path: this.points, unit: lengthName(document), seed: this.seed++}, this.busy.signal);
      Object.assign(this, {designs: found.designs, busy: null});
      if (found.designs.length) this.look(0); else studio.say(`no mechanism was found: ${found.reason}`, true);
    } catch (error) {
      this.busy = null;
      if (error.name !== "AbortError") studio.say(error.message, true);
    }
    this.show();
  }

  /** Show one of the mechanisms found as the drawing; undo returns to the one before. */
  look(k) {
    const {studio, designs} = this, {document, text} = designs[k];
    this.at = k;
    studio.isFresh = true;  // fits its paths into the view
    studio.commit(document, [], text);
    this.show();
  }

  show() {
    const {studio, designs, at, points, busy} = this, action = (words, title, act, kind = "small") => make("button", {type: "button", class: kind, title, "aria-label": title, onclick: act}, words);
    this.element.replaceChildren(this.input);
    this.element.hidden = !points;
    studio.redraw();
    if (!points) return;
    const parts = [];
    if (busy) parts.push(make("span", {}, "looking for mechanisms …"), action("Stop", "stop looking for mechanisms", () => { busy.abort(); this.busy = null; this.show(); }));
    else if (designs.length) {
      const {deviation, turns, transmission} = designs[at];
      parts.push(make("span", {}, `${at + 1} of ${designs.length}: at most ${shown(deviation / lengthUnit(studio.document), lengthName(studio.document))} off, `
        + `${turns ? "the crank turns" : "the crank swings"}, transmission angle at least ${Math.round(transmission * 180 / Math.PI)}°`),
      action("‹", "the mechanism before", () => this.look((at + designs.length - 1) % designs.length)), action("›", "the next mechanism", () => this.look((at + 1) % designs.length)),
      action("Others", "look for other mechanisms", () => this.find()), action("Keep", "keep this mechanism, and remove the wanted path", () => this.remove(), "small strong"));
    } else parts.push(make("span", {}, "wanted path"), action("Find a mechanism", "find a mechanism with a point that passes along this path", () => this.find(), "small strong"), action("Remove", "remove the wanted path", () => this.remove()));
    this.element.append(...parts);
  }
}
