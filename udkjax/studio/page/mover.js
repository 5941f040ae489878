// The engine in the page: the motion of the drawing, its closed positions, and a hand that pulls it. WebAssembly computes; here
// its bodies are matched to the links of the document, whose frames are that of the ground while they stand as drawn.

import {list, placeOf} from "./document.js";
import {stateAt} from "./player/motion.js";

const INSTANTS = 401;
const PULLS = 12;  // closings of one frame, each nearer to the hand
const LONGEST_PULL = 0.08;  // characteristic lengths in one closing, so that no branch is jumped to
const STILL = 1e-9;  // characteristic lengths, or rad: a motion that is less is rounding
const NEAR = 1e-4;  // characteristic lengths of the hand: near enough

/** Turn frames x, y, angle of bodies and those that they are drawn in into motions of the ground: place p goes to t + R p. */
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

/** Where a motion brings a place of the drawing. */
export function carry(motions, k, [x, y]) {
  if (k < 0) return [x, y];
  const c = Math.cos(motions[3 * k + 2]), s = Math.sin(motions[3 * k + 2]);
  return [motions[3 * k] + c * x - s * y, motions[3 * k + 1] + s * x + c * y];
}

export class Mover {
  /** `compiled` is the answer of the compile route for `document`; `loadEngine` makes its engines. */
  static async load(document, compiled, loadEngine) {
    const found = new Mover();
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

  /** Take the places of pins from a document of the same structure; tells whether they are numbers. */
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

  /** The closed state as drawn; `closed` says whether the loops close. */
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

  /** Tell whether a run goes anywhere. */
  moves({q, count}) {
    const {size} = this, least = STILL * this.scene.length;
    for (let k = size; k < count * size; k++) if (Math.abs(q[k] - q[k % size]) > (k % 3 === 2 ? STILL : least)) return true;
    return false;
  }

  /** The state of a run at a time, closed: between its instants it is interpolated, which leaves loops open by a little. */
  at(run, t) {
    const state = stateAt(run, t, this.size);
    if (!this.engine) return {...state, violation: 0};
    const found = this.engine.close(this.parameters, state);
    return found.closed ? found : {...state, violation: found.violation};
  }

  /** The state nearest to one in which a place of a link (m, as drawn) is at the hand: closed, without what drives it. */
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
      if (!found.closed) return {...best, words: "it cannot follow any farther: the loops would open"};
      const reached = carry(motionsOf(found.q, this.drawn, this.order), link, place);
      if (Math.hypot(hand[0] - reached[0], hand[1] - reached[1]) >= away - 1e-9 * length) return {...best, words: "it gets no nearer to the hand"};
      best = found;
    }
    return {...best, words: ""};
  }

  /** Names, frames, masses (kg) and inertias (kg m2) of the bodies as they are drawn now. */
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
