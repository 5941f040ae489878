// A live page: sliders change numbers of the scene, the pointer pulls bodies, and the motions are closed and simulated again.

import {Address} from "./address.js";
import {loadEngine} from "./engine.js";
import {LiveRun} from "./live_run.js";
import {SliderPanel} from "./sliders.js";

const SETTLED = 150;  // ms without a change before the numbers are written to the address

export class Live {
  constructor(player, data) {
    Object.assign(this, {player, data: data.live, firstEnd: data.end, dirty: false});
    this.values = Float64Array.from(this.data.sliders, s => s.value);
    this.runs = player.runs.map((run, k) => new LiveRun(this, run, data.runs[k], this.data.runs[k]));
    this.panel = new SliderPanel(this.data.sliders, (k, value) => this.set(k, value), {
      ghost: {words: "First motion", title: "show the first motion as well (G)", act: () => player.toggle("ghost")},
      reset: {words: "Reset", title: "back to the first motion (Backspace)", act: () => this.reset()},
      share: {words: "Copy link", title: "copy a link with these numbers", act: () => this.address.copy()},
    });
    player.show.ghost = true;
    player.buttons.ghost = this.panel.buttons.ghost;
    this.address = new Address(this);
    this.panel.enable(false);
    this.ready = this.load();
  }

  async load() {
    try {
      if (typeof WebAssembly === "undefined" || typeof DecompressionStream === "undefined") throw new Error("no WebAssembly");
      const engines = await Promise.all(this.data.engines.map(loadEngine));
      for (const run of this.runs) run.use(engines[run.data.engine]);
    } catch (error) {
      this.say(`This browser cannot simulate (${error.message}): the page plays the recorded motion.`, true);
      return false;
    }
    this.isReady = true;
    this.panel.enable(true);
    this.greet();
    this.address.read();
    return true;
  }

  get changed() { return this.runs.some(run => run.changed); }
  get isSolving() { return this.runs.some(run => run.job); }
  get end() { return Math.max(...this.runs.map(run => run.end)); }

  keys() {
    return {g: () => this.player.toggle("ghost"), Backspace: () => this.isReady && this.reset()};
  }

  greet() { this.say(`Move a slider or drag a body: the ${this.runs.length > 1 ? "motions are" : "motion is"} simulated again.`); }

  say(words, bad = false) { this.panel.say(words, bad); }

  // Numbers

  set(k, value) {
    this.values[k] = value;
    this.solveSoon();
    clearTimeout(this.settling);
    this.settling = setTimeout(() => this.address.write(), SETTLED);
  }

  /** Change numbers by the names of their parameters, and simulate at once. */
  change(numbers) {
    this.data.sliders.forEach(({name}, k) => { if (name in numbers) this.values[k] = numbers[name]; });
    this.panel.show(this.values);
    this.solve();
  }

  reset() {
    cancelAnimationFrame(this.request);
    this.dirty = false;
    this.values = Float64Array.from(this.data.sliders, s => s.value);
    this.panel.show(this.values);
    for (const run of this.runs) run.reset();
    this.player.setEnd(this.firstEnd);
    this.address.write();
    this.greet();
    this.player.draw();
  }

  // Motion

  /** Simulate before the next frame, once for all changes until then. */
  solveSoon() {
    if (this.dirty) return;
    this.dirty = true;
    cancelAnimationFrame(this.request);  // a simulation in progress has the old numbers
    this.request = requestAnimationFrame(() => this.solve());
  }

  solve() {
    cancelAnimationFrame(this.request);
    this.dirty = false;
    this.said = this.runs.map(run => ({words: run.begin(), bad: true}));
    if (this.isSolving) this.player.setEnd(Math.max(...this.runs.map(run => (run.job ? run.times[run.times.length - 1] : run.end))));
    this.goOn();
  }

  /** Continue the simulation for one frame, and so on until the end. */
  goOn() {
    this.runs.forEach((run, k) => { if (run.job) this.said[k] = run.goOn(); });
    const several = this.said.length > 1, words = this.said.map((said, k) => (several ? `${this.player.runs[k].label}: ` : "") + said.words);
    this.say(words.join("\n"), this.said.some(said => said.bad));
    if (this.isSolving) this.request = requestAnimationFrame(() => this.goOn());
    else this.player.setEnd(this.end);  // a motion may end early
    this.player.draw();
  }

  /** Complete all simulations at once. */
  finish() {
    if (this.dirty) this.solve();
    cancelAnimationFrame(this.request);
    while (this.isSolving) this.goOn();
    cancelAnimationFrame(this.request);
  }

  /** Set the bounds of the view to those of the current motions. */
  fit() {
    const {bounds} = this.player.data, all = this.runs.map(run => run.bounds());
    this.firstBounds ??= bounds.slice();
    bounds.splice(0, 4, ...(this.changed ? [0, 1, 2, 3].map(k => Math[k < 2 ? "min" : "max"](...all.map(one => one[k]))) : this.firstBounds));
  }
}
