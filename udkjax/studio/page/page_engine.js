// The engine of the page: closed positions of the drawing, pulling it, and its runs, which another thread computes (runner.js).
// WebAssembly computes; this module matches its bodies to the links of the document, whose frames coincide with the ground's in the
// drawn position.

import {list, placeOf} from "./document.js";
import {carry, motionsOf} from "./motions.js";
import {pathsOf} from "./page_run.js";
import {Runner} from "./runner.js";
import {stateAt} from "./player/motion.js";

const PULLS = 12;  // closures per frame, each nearer to the pointer
const FRAME = 30;  // ms that the closures of one frame may take together
const LONGEST_PULL = 0.08;  // characteristic lengths per closure, so that the pull cannot jump to another branch
const NEAR = 1e-4;  // characteristic lengths: at this distance the pointer counts as reached

export class PageEngine {
  /** Load the engine of `document` from `compiled`, the answer of the compile route. */
  static async load(document, compiled, loadEngine) {
    const found = new PageEngine();
    found.scene = compiled.scene;
    found.recorded = compiled.motion;
    found.size = 3 * found.scene.bodies.length;
    found.order = list(document, "link").map(link => found.scene.bodies.indexOf(link.name));
    if (compiled.engine) {
      found.engine = await loadEngine(positionsOf(compiled.engine));
      found.hand = compiled.hand ? await loadEngine(positionsOf(compiled.hand)) : found.engine;
      found.pins = compiled.pins;
      found.runner = new Runner(compiled.engine);
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

  /** The run from the drawn position, or from a state: see computeRun; null if a later one takes its place. `carried` are the pins
   *  whose paths are wanted, {name, link, place}. */
  async run(from, carried) {
    const {parameters, drawn, order} = this;
    if (this.engine) return this.runner.run({parameters, drawn, order, length: this.scene.length, duration: this.duration, from, carried});
    const {times, cause} = this.recorded, [q, v] = [this.recorded.q, this.recorded.v].map(x => Float64Array.from(x));
    const run = {ts: Float64Array.from(times), q, v, count: times.length, done: !cause, words: cause, violation: [], drawn, energies: null};
    return {...run, paths: pathsOf(run, drawn, order, carried)};
  }

  /** Stop the run in hand. */
  stop() { this.runner?.stop(); }

  /** End the thread of the engine. */
  close() { this.runner?.close(); }

  /** The state of a run at a time. It is closed again: interpolation between instants leaves loops slightly open. */
  at(run, t) {
    const state = stateAt(run, t, this.size);
    if (!this.engine) return {...state, violation: 0};
    const found = this.engine.close(this.parameters, state);
    return found.closed ? found : {...state, violation: found.violation};
  }

  /** The closed state, with motors released, that brings a drawn place of a link (m) closer to the pointer at `hand`; `goesOn` if
   *  it can come closer still, for which there was no time. */
  pull(state, link, place, hand) {
    const body = this.order[link], {length} = this.scene;
    let best = state;
    for (let i = 0, start = performance.now(); i < PULLS && performance.now() - start < FRAME; i++) {
      const motions = motionsOf(best.q, this.drawn, this.order), at = carry(motions, link, place);
      const way = [hand[0] - at[0], hand[1] - at[1]], away = Math.hypot(...way);
      if (away <= NEAR * length) return {...best, words: ""};
      const share = Math.min(1, LONGEST_PULL * length / away), q = Float64Array.from(best.q);
      q[3 * body] += share * way[0];
      q[3 * body + 1] += share * way[1];
      const found = this.hand.close(this.parameters, {t: state.t, q, v: new Float64Array(this.size)});
      if (!found.closed) return {...best, words: "it cannot move any farther: its loops would open"};
      const reached = carry(motionsOf(found.q, this.drawn, this.order), link, place);
      if (Math.hypot(hand[0] - reached[0], hand[1] - reached[1]) >= away - 1e-9 * length) return {...best, words: "it cannot get closer to the pointer"};
      best = found;
    }
    return {...best, words: "", goesOn: true};
  }

  /** The masses (kg) of the bodies by name, in the current drawing. */
  masses() {
    const {scene, engine} = this;
    if (!engine) return new Map(scene.bodies.map((name, k) => [name, scene.masses[k]]));
    const numbers = engine.numbers(this.parameters);
    return new Map(scene.bodies.map((name, k) => [name, numbers[engine.data.masses[k][0]]]));
  }

  motions(q) { return motionsOf(q, this.drawn, this.order); }
}

/** The part of an engine's data that closes positions. */
const positionsOf = data => ({...data, modules: {close: data.modules.close, evaluate: data.modules.evaluate}});
