// Curves over time below the drawing, which scrub it: positions and speeds of what is selected, angles between links, energies and
// efforts by the engine in the page; forces at pins by the server, when they are asked for.

import {ask} from "./api.js";
import {list, members, nameOf, pinsOf, placeOf} from "./document.js";
import {carry} from "./mover.js";
import {lengthName, lengthUnit} from "./units.js";
import {make} from "./player/elements.js";
import {THEMES} from "./player/painter.js";
import {drawStrip} from "./player/strip.js";

const ROUNDING = 1e-10;  // of the scale of a quantity
const EDGE = 12;  // px of the strip on either side of its curve

export class CurvesPanel {
  constructor(studio, parts) {
    Object.assign(this, {studio, select: parts.curveSelect, canvas: parts.curveCanvas, forces: parts.forces, statics: parts.statics, chosen: "", served: null});
    this.select.addEventListener("change", () => { this.chosen = this.select.value; studio.redraw(); });
    this.canvas.addEventListener("pointerdown", event => { this.canvas.setPointerCapture(event.pointerId); this.seek(event); });
    this.canvas.addEventListener("pointermove", event => { if (event.buttons) this.seek(event); });
  }

  seek(event) {
    const box = this.canvas.getBoundingClientRect(), {motion} = this.studio;
    motion.pause();
    motion.seek(motion.end * Math.min(Math.max((event.clientX - box.left - EDGE) / (box.width - 2 * EDGE), 0), 1));
  }

  /** The names of the curves that there are. */
  names() {
    const {document, motion} = this.studio, {run, energies} = motion, found = [];
    if (!run || run.count < 2) return found;
    for (const pin of Object.keys(pinsOf(document))) {
      if (this.studio.canvas.carrier(document, pin) >= 0) found.push(`${pin}: x`, `${pin}: y`, `${pin}: speed`);
      const met = members(document, pin).filter(name => name !== "ground");
      if (met.length === 2) found.push(`${pin}: angle between ${met[0]} and ${met[1]}`);
    }
    for (const link of list(document, "link")) found.push(`${link.name}: angle`, `${link.name}: angular velocity`);
    if (energies) {
      found.push("kinetic energy", "potential energy", "energy");
      for (const [driver, values] of Object.entries(energies.efforts)) if (values.some(Number.isFinite)) found.push(`${driver}: effort`);
    }
    if (run.violation.length) found.push("violation of the loops");
    return [...found, ...(this.forcesOf()?.curves ?? []).map(curve => `${curve.name}${curve.unique ? "" : " (not unique)"}`)];
  }

  /** The curves of forces, while they are of this drawing. */
  forcesOf() { return this.served?.document === this.studio.document ? this.served : null; }

  /** Show a curve of what is selected now, where there is one. */
  follow() {
    const first = this.names().find(name => name.startsWith(this.selectedName()));
    if (first && !this.chosen.startsWith(this.selectedName())) this.chosen = first;
    this.select.value = this.chosen;
  }

  /** Offer the curves that there are. */
  list() {
    const names = this.names();
    const groups = names.filter(name => name.startsWith(this.selectedName()));
    if (!names.includes(this.chosen)) this.chosen = groups[0] ?? names[0] ?? "";
    this.select.replaceChildren(...names.map(name => make("option", {value: name}, name)));
    this.select.value = this.chosen;
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
    const served = this.forcesOf()?.curves.find(curve => curve.name === name || `${curve.name} (not unique)` === name);
    if (served) return {unit: served.unit, values: served.values.map(x => x ?? NaN)};
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

  /** Show the position of rest that the server finds. */
  async askStatics() {
    const {studio} = this, {document} = studio;
    this.statics.disabled = true;
    studio.say("looking for a position of rest …");
    try {
      const {problems, q, kind, frequencies} = await ask("diagnose", {text: await studio.files.text(), about: "statics"});
      if (problems.length) throw new Error(problems.join("; "));
      if (document === studio.document && q) studio.motion.pose(Float64Array.from(q));
      const rates = frequencies.map(x => `${+x.toPrecision(4)} Hz`).join(", ");
      studio.say(q ? `at rest: ${kind}${rates ? `, frequencies ${rates}` : ""}` : "no position of rest was found");
    } catch (error) { studio.say(error.message, true); }
    this.statics.disabled = false;
  }

  async askForces() {
    const {studio} = this, {document} = studio;
    this.forces.disabled = true;
    studio.say("computing forces …");
    try {
      const found = await ask("diagnose", {text: await studio.files.text(), about: "dynamics"});
      if (found.problems.length) throw new Error(found.problems.join("; "));
      this.served = {...found, document};
      const first = found.curves.find(curve => curve.name.includes("force"));
      if (first) this.chosen = `${first.name}${first.unique ? "" : " (not unique)"}`;
      this.list();
      studio.say("");
    } catch (error) { studio.say(error.message, true); }
    this.forces.disabled = false;
    studio.redraw();
  }

  draw() {
    const {studio, canvas} = this, {motion} = studio, width = canvas.clientWidth, height = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
    if (!width || !height) return;
    if (this.names().join() !== this.listed) this.list();
    [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    const context = canvas.getContext("2d"), theme = THEMES[studio.theme];
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.forces.hidden = this.statics.hidden = !motion.run || motion.run.count < 2;
    if (!this.chosen || !motion.run || motion.run.count < 2) return;
    const key = [this.chosen, motion.run, this.served];
    if (!this.cache || key.some((x, k) => x !== this.cache.key[k])) this.cache = {key, curve: this.values(this.chosen)};
    const {curve} = this.cache, isServed = this.forcesOf()?.curves.some(c => this.chosen.startsWith(c.name)), ts = isServed ? this.served.times : motion.run.ts;
    const run = {label: "", ts: Array.from(ts).slice(0, Math.min(motion.run.count, curve.values.length)), measures: [{name: this.chosen, ...curve}], find: t => find(ts, t)};
    drawStrip(context, width, height, [run], this.chosen, 0, motion.end, motion.t, theme, width);
  }
}

/** Values, or their first one throughout where they differ by rounding alone. */
function withoutRounding(values, scale) {
  const spread = values.reduce((most, x) => Math.max(most, Math.abs(x - values[0])), 0);
  return spread <= ROUNDING * scale ? values.map(() => values[0]) : values;
}

function find(ts, t) {
  let low = 0, high = ts.length - 1;
  while (high - low > 1) { const middle = (low + high) >> 1; if (ts[middle] <= t) low = middle; else high = middle; }
  const h = ts[high] - ts[low];
  return [low, high, h, h > 0 ? (t - ts[low]) / h : 0];
}
