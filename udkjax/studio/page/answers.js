// The answers that a course asks for: type, mobility, strokes, dead points, ratios; and tables of pins, links and instant centres at
// the position shown. The server computes them, by the functions of the command line.

import {alongOf, turningMotors} from "./along.js";
import {GapsPanel} from "./gaps.js";
import {make} from "./player/elements.js";

const DELAY = 200;  // ms without a change of position before the tables are asked for

export class AnswersPanel {
  constructor(studio, element) {
    Object.assign(this, {studio, element: make("div"), text: null, lines: [], tables: [], asked: null, last: null});
    const gaps = make("div");
    this.gaps = new GapsPanel(studio, gaps);
    element.append(this.element, gaps);
    this.clear();
  }

  clear() {
    Object.assign(this, {text: null, lines: [], tables: [], last: null});
    clearTimeout(this.timer);
    this.gaps.clear();
    this.element.replaceChildren(make("p", {}, "Strokes, dead points and ratios appear here once one motor moves the mechanism."));
  }

  markStale() {
    this.element.classList.add("stale");
    this.gaps.clear();
  }

  /** Ask for the answers of the drawing that a text describes. */
  async follow(text, isLate) {
    const at = this.position(), found = await this.studio.sync.examine({text, about: "answers", ...(at ? {end: {at}} : {})}, isLate);
    if (isLate()) return;
    if (text !== this.gaps.text) this.gaps.clear(found.answers?.length ? text : null);
    Object.assign(this, {text, last: at});
    this.show(found);
  }

  /** The value of the motor in the position shown; empty if it is the drawn one. */
  position() {
    const {motion} = this.studio, {run, pageEngine, t} = motion, motor = pageEngine && turningMotors(pageEngine.scene)[0];
    return run?.count > 1 && motor && t > 0 ? `${alongOf(run, pageEngine.scene, motor.name).at(t).toFixed(6)} deg` : "";
  }

  /** Ask for the tables at another position as soon as it stands still. */
  moved() {
    if (this.text === null || this.studio.motion.playing) return;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => {
      const {text} = this, at = this.position();
      if (text !== null && at !== this.last) this.follow(text, () => this.text !== text || this.position() !== at).catch(() => {});
    }, DELAY);
  }

  show(found) {
    this.element.classList.remove("stale");
    if (found.problems.length || !found.answers.length) return void this.element.replaceChildren(make("p", {}, found.problems[0] ?? "Answers need one motor."));
    const row = (cells, tag) => make("tr", {}, ...cells.map(cell => make(tag, {}, cell)));
    const table = ({title, heads, rows}) => make("figure", {}, make("figcaption", {}, title), make("div", {class: "wide"}, make("table", {}, make("thead", {}, row(heads, "th")), make("tbody", {}, ...rows.map(cells => row(cells, "td"))))));
    return void this.element.replaceChildren(make("dl", {}, ...found.answers.flatMap(([title, words]) => [make("dt", {}, title), make("dd", {}, words)])), ...found.tables.map(table));
  }
}
