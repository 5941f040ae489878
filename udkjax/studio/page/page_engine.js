// The engine of the page: the motion of the drawing, its closed positions, and pulling it. WebAssembly computes; this module
// matches its bodies to the links of the document, whose frames coincide with the ground's in the drawn position.

import {list, placeOf} from "./document.js";
import {stateAt} from "./player/motion.js";

const INSTANTS = 401;
const PULLS = 12;  // closures per frame, each nearer to the pointer
const LONGEST_PULL = 0.08;  // characteristic lengths per closure, so that the pull cannot jump to another branch
const STILL = 1e-9;  // characteristic lengths, or rad: a smaller motion is rounding
const NEAR = 1e-4;  // characteristic lengths: at this distance the pointer counts as reached

/** Motions p -> t + R p of the ground frame that bring bodies from the frames `drawn` (x, y, angle) to the frames `q`. */
export function motionsOf(q, drawn, order) {
  const found = new Float64Array(3 * order.length);
  order.forEach((body, k) => {
    if (body < 0) return;
    const angle = q[3 * body + 2] - drawn[3 * body + 2], c = Math.cos(angle), s = Math.sin(angle);
    const x = drawn[3 * body], y = drawn[3 * body + 1];
    found.set([q[3 * body] - c * x + s * y, q[3 * body + 1] - s * x - c * y, angle], 3 * k);
  });
  return found;
}

/** The place to which a motion brings a place of the drawing. */
export function carry(motions, k, [x, y]) {
  if (k < 0) return [x, y];
  const c = Math.cos(motions[3 * k + 2]), s = Math.sin(motions[3 * k + 2]);
  return [motions[3 * k] + c * x - s * y, motions[3 * k + 1] + s * x + c * y];
}

export class PageEngine {
  /** Load the engine of `document` from `compiled`, the answer of the compile route. */
  static async load(document, compiled, loadEngine) {
    const found = new PageEngine();
    found.scene = compiled.scene;
    found.recorded = compiled.motion;
    found.size = 3 * found.scene.bodies.length;
    found.order = list(document, "link").map(link => found.scene.bodies.indexOf(link.name));
    if (compiled.engine) {
      found.engine = await loadEngine(compiled.engine);
      found.hand = compiled.hand ? await loadEngine(compiled.hand) : found.engine;
      found.pins = compiled.pins;
    }
    found.follow(document);
    return found;
  }

  /** Take the places of pins from a document of the same structure; returns false if one is not a number. */
  follow(document) {
    this.drawn = Float64Array.from(this.scene.frames.flat());
    if (!this.engine) return true;
    const places = this.pins.map(name => placeOf(document, name));
    if (!places.every(Boolean)) return false;
    this.parameters = Float64Array.from(places.flat());
    this.drawn = this.engine.guess(this.engine.numbers(this.parameters)).q;
    return true;
  }

  get duration() { return this.scene.duration; }

  /** The state as drawn; `closed` is false if its loops do not close. */
  start() {
    if (!this.engine) return {t: 0, q: this.recorded.q.slice(0, this.size), v: this.recorded.v.slice(0, this.size), closed: true, violation: 0};
    return this.engine.close(this.parameters);
  }

  /** The motion from the drawn position, or from a state. */
  run(from = null) {
    if (!this.engine) {
      const {times, q, v, cause} = this.recorded;
      return {ts: times, q, v, count: times.length, done: !cause, words: cause, violation: []};
    }
    const state = from ?? this.start(), still = {ts: [0], q: state.q, v: state.v, count: 1, done: false, violation: [state.violation]};
    if (state.closed && this.engine.data.why) return {...still, words: this.engine.data.why};
    if (!state.closed) return {...still, words: "the loops do not close as drawn"};
    const times = Float64Array.from({length: INSTANTS}, (_, k) => this.duration * k / (INSTANTS - 1));
    const found = this.engine.run(this.parameters, state, times);
    if (!found.count) return {...still, words: found.words};
    return this.moves(found) ? found : {...still, words: "nothing moves"};
  }

  /** True if any body moves during a run. */
  moves({q, count}) {
    const {size} = this, least = STILL * this.scene.length;
    for (let k = size; k < count * size; k++) if (Math.abs(q[k] - q[k % size]) > (k % 3 === 2 ? STILL : least)) return true;
    return false;
  }

  /** The state of a run at a time. It is closed again: interpolation between instants leaves loops slightly open. */
  at(run, t) {
    const state = stateAt(run, t, this.size);
    if (!this.engine) return {...state, violation: 0};
    const found = this.engine.close(this.parameters, state);
    return found.closed ? found : {...state, violation: found.violation};
  }

  /** The closed state, with motors released, that brings a drawn place of a link (m) closest to the pointer at `hand`. */
  pull(state, link, place, hand) {
    const body = this.order[link], {length} = this.scene;
    let best = state;
    for (let i = 0; i < PULLS; i++) {
      const motions = motionsOf(best.q, this.drawn, this.order), at = carry(motions, link, place);
      const way = [hand[0] - at[0], hand[1] - at[1]], away = Math.hypot(...way);
      if (away <= NEAR * length) break;
      const share = Math.min(1, LONGEST_PULL * length / away), q = Float64Array.from(best.q);
      q[3 * body] += share * way[0];
      q[3 * body + 1] += share * way[1];
      const found = this.hand.close(this.parameters, {t: state.t, q, v: new Float64Array(this.size)});
      if (!found.closed) return {...best, words: "it cannot move any farther: its loops would open"};
      const reached = carry(motionsOf(found.q, this.drawn, this.order), link, place);
      if (Math.hypot(hand[0] - reached[0], hand[1] - reached[1]) >= away - 1e-9 * length) return {...best, words: "it cannot get closer to the pointer"};
      best = found;
    }
    return {...best, words: ""};
  }

  /** Names, frames, masses (kg) and inertias (kg m2) of the bodies in the current drawing. */
  bodies() {
    const {scene, engine, drawn} = this, frames = scene.bodies.map((_, k) => Array.from(drawn.slice(3 * k, 3 * k + 3)));
    if (!engine) return {...scene, frames};
    const numbers = engine.numbers(this.parameters), [masses, inertias] = [0, 1].map(i => engine.data.masses.map(places => numbers[places[i]]));
    return {bodies: scene.bodies, frames, masses, inertias};
  }

  motions(q) { return motionsOf(q, this.drawn, this.order); }

  /** Energies (J) over a run. */
  energies(run) {
    return this.engine && run.count > 1 ? this.engine.measure(this.parameters, run, true) : null;
  }
}
