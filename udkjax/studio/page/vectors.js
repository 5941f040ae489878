// Arrows at pins: velocities, accelerations, and the forces that the server has computed, each with its value. The longest of a run
// has a fixed length, which a line below the drawing states.

import {placeOf} from "./document.js";
import {carry, ratesOf} from "./motions.js";
import {lengthName, lengthUnit} from "./units.js";
import {toPixels} from "./view.js";
import {interval, short, stateAt} from "./player/motion.js";

const LONGEST = 80, SHORTEST = 3, BEYOND = 10;  // px: arrows, and from an arrow's tip to its value
const UNITS = {velocities: "/s", accelerations: "/s²"};
const COLOURS = {velocities: theme => theme.accent, accelerations: theme => theme.force, forces: theme => theme.ink};

export const VECTORS = {velocities: "arrows of the velocities of pins", accelerations: "arrows of the accelerations of pins",
  forces: "arrows of the forces at pins, once they are computed (Dynamics, Forces at pins; Statics, Holding torques)"};

export class Vectors {
  constructor(studio) { Object.assign(this, {studio, sizes: new Map(), key: []}); }

  /** The arrows of a kind at a time: the place of each pin (m) and the vector there. */
  at(kind, t) {
    const {motion} = this.studio, {run, energies, pageEngine} = motion, {size, order} = pageEngine, {q, v} = stateAt(run, t, size), motions = pageEngine.motions(q);
    const [i, j, , s] = interval(run.ts, t, run.count), between = x => x.subarray(i * size, (i + 1) * size).map((y, k) => y + s * (x[j * size + k] - y));
    if (kind === "forces") return this.forces(motions, i, j, s);
    const state = {q, v, a: energies?.a ? between(energies.a) : null};
    return motion.carried().flatMap(({link, place}) => {
      const now = carry(motions, link, place), vector = ratesOf(state, order[link], now)[kind[0]];
      return vector ? [{place: now, vector}] : [];
    });
  }

  /** The server's forces for this drawing: those of the open panel, or of the other one that has some. */
  served() {
    const {curves, document} = this.studio;
    return [curves.panel, "dynamics", "statics"].map(panel => curves.served[panel]).find(found => found?.document === document && found.curves.some(({name}) => name.includes(": force x on "))) ?? null;
  }

  /** The forces at pins on the first of their links. */
  forces(motions, i, j, s) {
    const {studio: {document, canvas}} = this, served = this.served(), seen = new Set();
    return (served?.curves ?? []).flatMap(curve => {
      const [, pin, body] = /^(.*): force x on (.*)$/.exec(curve.name) ?? [], place = pin && placeOf(document, pin);
      const other = place && !seen.has(pin) && served.curves.find(({name}) => name === `${pin}: force y on ${body}`);
      if (!other) return [];
      seen.add(pin);
      return [{on: body, place: carry(motions, canvas.carrier(document, pin), place), vector: [curve, other].map(({values}) => values[i] + s * (values[j] - values[i]))}];
    });
  }

  /** The size of the longest arrow of a kind over the run. */
  largest(kind) {
    const {run} = this.studio.motion, key = [run, this.served()];
    if (key.some((x, k) => x !== this.key[k])) { this.sizes.clear(); this.key = key; }
    if (!this.sizes.has(kind)) {
      const sizes = Array.from(run.ts).slice(0, run.count).flatMap(t => this.at(kind, t).map(({vector}) => Math.hypot(...vector))).filter(Number.isFinite);
      this.sizes.set(kind, sizes.reduce((a, b) => Math.max(a, b), 0));
    }
    return this.sizes.get(kind);
  }

  draw(painter, theme) {
    const {show, motion, view, document, canvas} = this.studio, scales = [];
    if (!motion.run || motion.run.count < 2 || motion.posed) return;
    for (const kind of Object.keys(VECTORS).filter(name => show[name])) {
      const largest = this.largest(kind), scale = LONGEST / largest, colour = COLOURS[kind](theme), isForce = kind === "forces";
      if (!Number.isFinite(scale)) continue;
      const unit = isForce ? 1 : lengthUnit(document), name = isForce ? "N" : `${lengthName(document)}${UNITS[kind]}`;
      scales.push([`${kind}: longest ${short(largest / unit)} ${name}`, colour]);
      for (const {on, place, vector: [x, y]} of this.at(kind, motion.t)) {
        const [px, py] = toPixels(view, place), size = Math.hypot(x, y), far = scale + BEYOND / size;
        if (!(scale * size > SHORTEST)) continue;
        painter.arrow([px, py], [px + scale * x, py - scale * y], colour);
        painter.text(`${short(size / unit)}${on ? ` on ${on}` : ""}`, [px + far * x, py - far * y], colour, {size: 11, align: x < 0 ? "right" : "left"});
      }
    }
    scales.forEach(([words, colour], k) => painter.text(words, [canvas.width - 12, canvas.height - 14 - 16 * k], colour, {size: 11, align: "right"}));
  }
}
