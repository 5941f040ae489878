// Panels of curves below the drawing, which scrub it. Kinematics: positions, speeds, angles between links, how far motors turn;
// dynamics: energies and efforts by the engine in the page, forces at pins by the server; statics: where it rests, and what holds it.

import {ask} from "./api.js";
import {list, members, nameOf, pinsOf, placeOf} from "./document.js";
import {carry} from "./mover.js";
import {lengthName, lengthUnit} from "./units.js";
import {button, make} from "./player/elements.js";
import {interval} from "./player/motion.js";
import {Painter, THEMES, contextOf} from "./player/painter.js";
import {drawStrip, stripPart} from "./player/strip.js";

const ROUNDING = 1e-10;  // of the scale of a quantity

// Of each panel what the server is asked for: the words on its button, and what it does.
const PANELS = {
  kinematics: {title: "Kinematics", words: "positions, speeds, angles, travel", actions: []},
  dynamics: {title: "Dynamics", words: "energies, efforts, forces", actions: [["dynamics", "Forces at pins", "compute forces at pins, and powers of motors"]]},
  statics: {title: "Statics", words: "rest, and what holds it", actions: [["rest", "At rest", "find the position of rest next to the drawn one, and its frequencies"],
    ["holding", "Held by motors", "compute efforts and forces where motors hold the mechanism still, in each position of the motion"]]},
};

export class CurvesPanel {
  constructor(studio, element) {
    Object.assign(this, {studio, panel: "kinematics", chosen: {}, served: {}, facts: {}, busy: ""});
    this.tabs = Object.entries(PANELS).map(([name, {title, words}]) => [name, make("button", {type: "button", role: "tab", title: words, onclick: () => this.open(name)}, title)]);
    this.actions = Object.entries(PANELS).flatMap(([panel, {actions}]) => actions.map(([name, words, title]) => ({panel, name, button: button(words, title, () => this.ask(name))})));
    this.select = make("select", {"aria-label": "curve", onchange: () => { this.chosen[this.panel] = this.select.value; studio.redraw(); }});
    this.canvas = make("canvas", {"aria-hidden": "true"});
    this.fact = make("span", {class: "fact", role: "status"});
    element.append(make("div", {class: "strip-bar"}, make("div", {class: "tabs", role: "tablist", "aria-label": "curves of"}, ...this.tabs.map(([, tab]) => tab)),
      this.select, ...this.actions.map(one => one.button), this.fact), this.canvas);
    this.canvas.addEventListener("pointerdown", event => { this.canvas.setPointerCapture(event.pointerId); this.seek(event); });
    this.canvas.addEventListener("pointermove", event => { if (event.buttons) this.seek(event); });
    this.open(this.panel);
  }

  open(panel) {
    this.panel = panel;
    for (const [name, tab] of this.tabs) tab.setAttribute("aria-selected", name === panel);
    this.listed = null;
    this.studio.redraw();
  }

  get name() { return this.chosen[this.panel] ?? ""; }

  seek(event) {
    const box = this.canvas.getBoundingClientRect(), {motion} = this.studio;
    motion.pause();
    motion.seek(motion.end * stripPart(event.clientX - box.left, box.width));
  }

  /** The names of the curves of the panel that is open. */
  names() {
    const {motion} = this.studio;
    if (!motion.run || motion.run.count < 2) return [];
    const own = {kinematics: () => this.kinematic(), dynamics: () => this.dynamic(), statics: () => []}[this.panel]();
    return [...own, ...this.servedCurves().map(shownName).filter(name => !own.includes(name))];
  }

  kinematic() {
    const {document, motion} = this.studio, found = [], driven = list(document, "motor").flatMap(({pin}) => (pin ? members(document, pin) : []));
    for (const pin of Object.keys(pinsOf(document))) {
      if (this.studio.canvas.carrier(document, pin) >= 0) found.push(`${pin}: x`, `${pin}: y`, `${pin}: speed`);
      const met = members(document, pin).filter(name => name !== "ground"), transmits = driven.length && !met.some(name => driven.includes(name));
      if (met.length === 2) found.push(`${pin}: angle between ${met[0]} and ${met[1]}${transmits ? " (transmission angle)" : ""}`);
    }
    for (const link of list(document, "link")) found.push(`${link.name}: angle`, `${link.name}: angular velocity`);
    return motion.run.violation.length ? [...found, "violation of the loops"] : found;
  }

  dynamic() {
    const {energies} = this.studio.motion;
    if (!energies) return [];
    const efforts = Object.entries(energies.efforts).filter(([, values]) => values.some(Number.isFinite)).map(([driver]) => `${driver}: effort`);
    return [...efforts, "kinetic energy", "potential energy", "energy"];
  }

  /** What the server found for the panel that is open, while it is of this drawing. */
  servedFor() {
    const found = this.served[this.panel];
    return found?.document === this.studio.document ? found : null;
  }

  servedCurves() { return this.servedFor()?.curves ?? []; }

  /** Show a curve of what is selected now, where there is one. */
  follow() {
    const first = this.names().find(name => name.startsWith(this.selectedName()));
    if (first && !this.name.startsWith(this.selectedName())) this.chosen[this.panel] = first;
    this.select.value = this.name;
  }

  /** Offer the curves that there are. */
  list() {
    const names = this.names(), groups = names.filter(name => name.startsWith(this.selectedName()));
    if (!names.includes(this.name)) this.chosen[this.panel] = groups[0] ?? names[0] ?? "";
    this.select.replaceChildren(...names.map(name => make("option", {value: name}, name)));
    this.select.value = this.name;
    this.select.hidden = !names.length;
    this.listed = names.join();
  }

  selectedName() {
    const [item] = this.studio.selection;
    return item ? `${item.kind === "pin" ? item.name : nameOf(this.studio.document, item.kind, item.index)}:` : "\0";
  }

  /** The values of a curve, and their unit. */
  values(name) {
    const {document, motion} = this.studio, {run, energies, mover} = motion, {size} = mover, unit = lengthUnit(document), long = lengthName(document);
    const served = this.servedCurves().find(curve => shownName(curve) === name);
    if (served && !(this.panel === "dynamics" && this.dynamic().includes(name))) return {unit: served.unit, ts: this.servedFor().times, values: served.values.map(x => x ?? NaN)};
    if (name === "violation of the loops") return {unit: "", log: true, values: Array.from(run.violation, x => Math.max(x, 1e-17))};
    if (name === "energy") return {unit: "J", values: Array.from(energies.kinetic, (x, k) => x + energies.potential[k])};
    if (name.endsWith(" energy")) return {unit: "J", values: energies[name.split(" ")[0]]};
    const at = name.lastIndexOf(": "), owner = name.slice(0, at), quantity = name.slice(at + 2), link = list(document, "link").findIndex(l => l.name === owner);
    if (quantity === "effort" && owner in energies.efforts) return {unit: "N m", values: energies.efforts[owner]};
    const each = action => Array.from({length: run.count}, (_, i) => action(i * size, mover.motions(run.q.slice(i * size, (i + 1) * size))));
    const still = (scale, values) => withoutRounding(values, scale);
    if (quantity === "angle" && link >= 0) return {unit: "°", values: still(180, each(i => run.q[i + 3 * mover.order[link] + 2] * 180 / Math.PI))};
    if (quantity === "angular velocity") return {unit: "rad/s", values: each(i => run.v[i + 3 * mover.order[link] + 2])};
    const place = placeOf(document, owner), carrier = this.studio.canvas.carrier(document, owner);
    if (quantity.startsWith("angle between ")) return {unit: "°", values: this.angles(owner, each)};
    if (quantity === "speed") return {unit: `${long}/s`, values: each((i, motions) => this.speed(i, motions, carrier, place) / unit)};
    return {unit: long, values: still(mover.scene.length / unit, each((_, motions) => carry(motions, carrier, place)[quantity === "x" ? 0 : 1] / unit))};
  }

  speed(i, motions, link, place) {
    const {run, mover} = this.studio.motion, k = i + 3 * mover.order[link], at = carry(motions, link, place), w = run.v[k + 2];
    return Math.hypot(run.v[k] - w * (at[1] - run.q[k + 1]), run.v[k + 1] + w * (at[0] - run.q[k]));
  }

  /** The angle (degrees, 0 to 180) between two links at their pin: from it to the farthest other pin of each. */
  angles(pin, each) {
    const {document} = this.studio, here = placeOf(document, pin), met = members(document, pin).filter(name => name !== "ground");
    const links = met.map(name => list(document, "link").findIndex(link => link.name === name));
    const ends = links.map(k => list(document, "link")[k].pins.map(name => placeOf(document, name)).sort((a, b) => Math.hypot(b[0] - here[0], b[1] - here[1]) - Math.hypot(a[0] - here[0], a[1] - here[1]))[0]);
    return each((_, motions) => {
      const at = carry(motions, links[0], here), [a, b] = ends.map((end, k) => { const p = carry(motions, links[k], end); return Math.atan2(p[1] - at[1], p[0] - at[0]); });
      const between = Math.abs((a - b) * 180 / Math.PI) % 360;
      return between > 180 ? 360 - between : between;
    });
  }

  /** Ask the server for what a button says. */
  async ask(about) {
    const {studio} = this, {document} = studio, {panel} = this;
    this.busy = about;
    this.facts[panel] = null;
    this.showBar();
    try {
      const found = await ask("diagnose", {text: await studio.files.text(), about});
      if (found.problems.length) throw new Error(found.problems.join("; "));
      if (about === "rest") this.showRest(found, document);
      else {
        this.served[panel] = {...found, document};
        this.chosen[panel] = found.curves.map(shownName).find(name => name.includes("force")) ?? this.name;
        this.listed = null;
      }
    } catch (error) { this.facts[panel] = {document, words: error.message, isBad: true}; }
    this.busy = "";
    studio.redraw();
  }

  showRest({q, kind, frequencies}, document) {
    if (document === this.studio.document && q) this.studio.motion.pose(Float64Array.from(q));
    const rates = frequencies.map(x => `${+x.toPrecision(4)} Hz`).join(", ");
    this.facts.statics = {document, words: q ? `at rest: ${kind}${rates ? `, frequencies ${rates}` : ""}` : "no position of rest was found"};
  }

  /** The buttons of the panel that is open, and what it says. */
  showBar() {
    const {studio} = this, {motion} = studio, moves = motion.run?.count > 1, fact = this.facts[this.panel];
    for (const {panel, name, button} of this.actions) {
      button.hidden = panel !== this.panel || !motion.run || (!moves && name !== "rest");
      button.disabled = Boolean(this.busy);
    }
    const said = fact?.document === studio.document ? fact : null;
    const words = this.busy ? "computing …" : said?.words ?? (this.panel === "kinematics" && moves ? studio.findings.travelWords() : "");
    if (this.fact.textContent !== words) this.fact.textContent = this.fact.title = words;
    this.fact.classList.toggle("bad", Boolean(said?.isBad));
  }

  draw() {
    const {studio, canvas} = this, {motion} = studio;
    if (!canvas.clientWidth || !canvas.clientHeight) return undefined;
    if (this.names().join() !== this.listed) this.list();
    this.showBar();
    const {context, width, height} = contextOf(canvas), theme = THEMES[studio.theme];
    if (!this.name || !motion.run || motion.run.count < 2) return this.drawNothing(context, theme, width, height);
    const key = [this.name, this.panel, motion.run, this.served[this.panel]];
    if (!this.cache || key.some((x, k) => x !== this.cache.key[k])) this.cache = {key, curve: this.values(this.name)};
    const {curve} = this.cache, ts = curve.ts ?? motion.run.ts;
    const run = {label: "", ts: Array.from(ts).slice(0, Math.min(motion.run.count, curve.values.length)), measures: [{name: this.name, ...curve}], find: t => interval(ts, t)};
    return drawStrip(context, width, height, [run], this.name, 0, motion.end, motion.t, theme, width);
  }

  drawNothing(context, theme, width, height) {
    const moves = this.studio.motion.run?.count > 1;
    const words = moves ? "Press a button above: the server computes what there is to see." : "Curves of the motion stand here as soon as there is one.";
    new Painter(context, {x: 0, y: 0, scale: 1}, theme, 1, null).text(words, [width / 2, height / 2], theme.soft, {align: "center", halo: false});
  }
}

const shownName = curve => `${curve.name}${curve.unique ? "" : " (not unique)"}`;

/** Values, or their first one throughout where they differ by rounding alone. */
function withoutRounding(values, scale) {
  const spread = values.reduce((most, x) => Math.max(most, Math.abs(x - values[0])), 0);
  return spread <= ROUNDING * scale ? values.map(() => values[0]) : values;
}
