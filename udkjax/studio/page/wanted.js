// A wanted path, drawn by hand or read from a table, and the mechanisms whose point passes along it, which the server finds.

import {ask} from "./api.js";
import {lengthName, lengthUnit, shown} from "./units.js";
import {make} from "./player/elements.js";

const CLOSE = 0.5;  // px: a stroke has no points closer to each other
const FEWEST = 3;
const ROUNDS = 4;  // searches, each with more bars; the first one answers within seconds
const MOST = 8;  // mechanisms to look through
const ALIKE = 1e-3;  // pins whose places differ by less, relative to the extent of the path, are the same

const pinsText = ({pins}) => JSON.stringify(pins);
const placesOf = ({document}) => Object.values(document.pins).flat().map(x => x * lengthUnit(document));

/** The best different designs of two lists, the best first. */
export function merged(known, more, extent) {
  const all = [...known];
  for (const one of more) {
    const places = placesOf(one);
    if (!all.some(other => placesOf(other).length === places.length && placesOf(other).every((x, k) => Math.abs(x - places[k]) < ALIKE * extent))) all.push(one);
  }
  return all.sort((a, b) => a.deviation - b.deviation).slice(0, MOST);
}

export class WantedPath {
  constructor(studio, element) {
    Object.assign(this, {studio, element, points: null, designs: [], at: 0, seed: 0, round: 0, busy: null});
    this.input = make("input", {type: "file", accept: ".csv,.txt,text/*", "aria-label": "table of a wanted path", hidden: ""});
    this.input.addEventListener("change", () => this.read(this.input.files[0]));
    this.show();
  }

  /** Begin, continue and end a stroke. */
  begin(place) {
    this.stop();
    Object.assign(this, {points: [place], designs: [], seed: 0});
  }

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
    const {studio} = this;
    this.input.value = "";
    let points;
    try {
      ({path: points} = await ask("design", {table: await file.text(), name: file.name, unit: lengthName(studio.document)}));
    } catch (error) {
      return void studio.say(error.message, true);
    }
    this.stop();
    Object.assign(this, {points, designs: [], seed: 0});
    this.show();
    studio.fit();
  }

  stop() {
    this.busy?.abort();
    this.busy = null;
    this.show();
  }

  remove(words = "") {
    this.stop();
    Object.assign(this, {points: null, designs: []});
    this.studio.say(words);
    this.show();
  }

  /** Look for mechanisms in rounds, and show the best one so far, unless another one was chosen or the drawing was changed. */
  async find() {
    const {studio} = this, busy = this.busy = new AbortController();
    let reason = "", follows = true;
    this.shownPins = null;
    for (this.round = 0; this.round < ROUNDS && this.busy === busy; this.round++) {
      this.show();
      try {
        const found = await ask("design", {path: this.points, unit: lengthName(studio.document), seed: this.seed++}, busy.signal);
        if (this.busy !== busy) return;
        const chosen = this.designs[this.at];
        reason = found.reason;
        this.designs = merged(this.designs, found.designs, found.extent);
        follows &&= this.shownPins === null || this.shownPins === pinsText(studio.document);
        if (follows && this.designs.length && this.designs[0] !== chosen) this.look(0);
        else this.at = Math.max(0, this.designs.indexOf(chosen));
        if (follows) this.shownPins = pinsText(studio.document);
      } catch (error) {
        if (this.busy !== busy) return;
        if (error.name !== "AbortError") studio.say(error.message, true);
        break;
      }
    }
    this.busy = null;
    if (!this.designs.length && reason) studio.say(`no mechanism was found: ${reason}`, true);
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
    if (designs.length) {
      const {deviation, turns, transmission} = designs[at];
      parts.push(make("span", {}, `${at + 1} of ${designs.length}: at most ${shown(deviation / lengthUnit(studio.document), lengthName(studio.document))} off, `
        + `${turns ? "the crank turns" : "the crank swings"}, transmission angle at least ${Math.round(transmission * 180 / Math.PI)}°`),
      action("‹", "the mechanism before", () => this.look((at + designs.length - 1) % designs.length)), action("›", "the next mechanism", () => this.look((at + 1) % designs.length)));
    }
    if (busy) {
      parts.push(make("span", {role: "status"}, designs.length ? "looking for better ones …" : "looking for mechanisms …"),
        make("progress", {max: ROUNDS, value: this.round || 0.2, "aria-label": "progress of the search"}), action("Stop", "stop looking for mechanisms", () => this.stop()));
    } else if (designs.length) {
      parts.push(action("Others", "look for other mechanisms", () => this.find()), action("Keep", "keep this mechanism, and remove the wanted path", () => this.remove(), "small strong"));
    } else parts.push(make("span", {}, "wanted path"), action("Find a mechanism", "find a mechanism with a point that passes along this path", () => this.find(), "small strong"), action("Remove", "remove the wanted path", () => this.remove()));
    this.element.append(...parts);
  }
}
