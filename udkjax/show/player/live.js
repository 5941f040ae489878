// A live page: sliders change numbers of the scene, a hand pulls at bodies, and the motion is closed and solved anew.

import {Address} from "./address.js";
import {loadEngine} from "./engine.js";
import {Follower} from "./follow.js";
import {Hand, bodyAt} from "./hand.js";
import {Run, boundsOf, place} from "./motion.js";
import {SliderPanel} from "./sliders.js";

const SMALLEST_POSITIVE = 1e-17;  // m: a violation that is zero, on a logarithmic scale
const GHOST = 0.28;  // how much one sees of the first motion
const REACH = {mouse: 6, touch: 16};  // px beside a body where it can be grasped
// Of code times steps that a processor of today runs in 8 ms, half of the time of a picture: the same on each machine, so that the
// same numbers give the same motion.
const STEP_BYTES = 6e7;
const USUAL = 0.95;  // of the instants have no force that is larger than the usual one, which sets the arrows' length
const SETTLED = 150;  // ms without a change until the address says the numbers

export class Live {
  constructor(player, data) {
    this.player = player;
    this.data = data.live;
    this.run = player.runs[0];
    this.ghost = new Run(data.runs[0]);
    this.first = {ts: this.run.ts, q: this.run.q, v: this.run.v, measures: this.run.measures, end: data.end, frame: this.run.frame,
      reactions: this.run.reactions, forces: this.run.forces};
    this.times = this.data.times ? Float64Array.from(this.data.times) : this.run.ts;  // all of them, where the first motion failed
    this.follower = new Follower(this.run, this.data.follow);
    this.values = Float64Array.from(this.data.sliders, s => s.value);
    this.changed = this.dirty = false;
    this.hand = this.job = null;
    this.steps = Math.round(STEP_BYTES / this.data.engine.modules.run.bytes);  // of one picture
    this.solving = 0;  // ms, of the last motion
    this.panel = new SliderPanel(this.data.sliders, (k, value) => this.set(k, value), {
      ghost: {words: "First motion", title: "show the first motion as well (G)", act: () => player.toggle("ghost")},
      reset: {words: "Reset", title: "back to the first motion (Backspace)", act: () => this.reset()},
      share: {words: "Copy link", title: "copy an address with these numbers", act: () => this.address.copy()},
    });
    player.show.ghost = true;
    player.buttons.ghost = this.panel.buttons.ghost;
    this.address = new Address(this);
    this.panel.enable(false);
    this.ready = this.load();
  }

  async load() {
    try {
      if (typeof WebAssembly === "undefined" || typeof DecompressionStream === "undefined") throw new Error("it has no WebAssembly");
      this.engine = await loadEngine(this.data.engine);
    } catch (error) {
      this.say(`This browser cannot simulate (${error.message}): the page plays what was recorded.`, true);
      return false;
    }
    this.panel.enable(true);
    this.greet();
    this.address.read();
    return true;
  }

  keys() {
    return {g: () => this.player.toggle("ghost"), Backspace: () => this.engine && this.reset()};
  }

  greet() { this.say("Move a slider, or pull at a body: the motion is solved anew."); }

  say(words, bad = false) { this.panel.say(words, bad); }

  // Numbers

  set(k, value) {
    this.values[k] = value;
    this.solveSoon();
    clearTimeout(this.settling);
    this.settling = setTimeout(() => this.address.write(), SETTLED);
  }

  /** Change numbers by the names of their parameters, and solve at once. */
  change(numbers) {
    this.data.sliders.forEach(({name}, k) => { if (name in numbers) this.values[k] = numbers[name]; });
    this.panel.show(this.values);
    this.solve();
  }

  /** Solve before the next picture, once for all changes until then. */
  solveSoon() {
    if (this.dirty) return;
    this.dirty = true;
    requestAnimationFrame(() => { if (this.dirty) this.solve(); });
  }

  reset() {
    this.drop();
    this.values = Float64Array.from(this.data.sliders, s => s.value);
    this.panel.show(this.values);
    const {ts, q, v, measures, end, frame} = this.first;
    this.run.replace(ts, q, v, measures, frame);
    this.showReactions(this.first.reactions, this.first.forces);
    this.follower.follow(this.engine.numbers(null));
    this.player.setEnd(end);
    this.changed = this.dirty = false;
    this.address.write();
    this.greet();
    this.player.draw();
  }

  // Motion

  solve() {
    const {engine, times, values} = this;
    this.dirty = false;
    this.drop();
    const start = performance.now(), state = engine.close(values, {t: times[0], ...this.data.start});
    if (state.closed) {
      const T = times.length, n = engine.size;
      const run = {ts: times, q: new Float64Array(T * n), v: new Float64Array(T * n), violation: new Float64Array(T), count: 0};
      this.job = {run, state, rank: state.rank, from: 0, steps: 0, tried: 0, start};
      this.follower.follow(engine.numbers(values));
      this.player.setEnd(times[T - 1]);
      this.goAhead();
    } else {
      const gap = this.lengthOf(state.violation);
      this.say(`The loops do not close with these numbers: they stay open by ${gap}. The last motion that does is shown.`, true);
    }
    this.player.draw();
  }

  /** Solve on for as many steps as fit into one picture, and so on until the end: the first motion that is whole stays. */
  goAhead() {
    const {engine, job} = this, {run, from} = job, n = engine.size;
    const times = from ? Float64Array.of(job.state.t, ...run.ts.subarray(from)) : run.ts;
    const part = engine.run(this.values, job.state, times, null, Math.min(this.steps, this.data.engine.settings.max_steps - job.tried));
    const skip = from ? 1 : 0, count = Math.max(part.count - skip, 0);
    run.q.set(part.q.subarray(skip * n, (skip + count) * n), from * n);
    run.v.set(part.v.subarray(skip * n, (skip + count) * n), from * n);
    run.violation.set(part.violation.subarray(skip, skip + count), from);
    run.count = job.from = from + count;
    job.steps += part.steps;
    job.tried += part.tried;
    job.state = part.last;
    this.show(run);
    const span = run.ts[run.ts.length - 1] - run.ts[0];
    if (part.limited && job.tried < this.data.engine.settings.max_steps) {
      this.say(`Solving: ${Math.round(100 * (part.t - run.ts[0]) / span)} %`);
      this.request = requestAnimationFrame(() => { this.goAhead(); this.player.draw(); });
      return;
    }
    this.solving = performance.now() - job.start;
    const freedoms = n - job.rank, usual = n - this.data.engine.rank;
    const ended = part.done ? `${+span.toPrecision(3)} s solved anew in ${this.solving.toFixed(1)} ms, ${job.steps} steps.`
      : `The motion ends at ${part.t.toPrecision(4)} s: ${part.words}.`;
    this.say(freedoms === usual ? ended : `${ended} ${freedoms} degrees of freedom here, ${usual} at first.`, !part.done);
    this.job = null;
  }

  lengthOf(violation) { return `${(violation * this.data.engine.scales.length).toPrecision(2)} m`; }

  show(run) {
    const {count} = run, n = this.engine.size, cut = (x, size) => x.subarray(0, count * size);
    const part = {...run, ts: cut(run.ts, 1), q: cut(run.q, n), v: cut(run.v, n), violation: cut(run.violation, 1)};
    const found = this.engine.measure(this.values, part, true, Boolean(this.first.reactions));
    this.run.replace(part.ts, part.q, part.v, this.measures(part, found), 1);
    this.showReactions(this.reactions(found.forces), found.forces);
    this.changed = true;
  }

  /** The arrows of forces that the page has found; none where joints are redundant: their shares would be a choice. */
  reactions(forces) {
    const {first: {reactions}} = this, each = 2 * (reactions?.anchors.length ?? 0);
    if (!forces.length || !reactions) return null;
    const largest = Float64Array.from({length: forces.length / each}, (_, i) => {
      const now = forces.subarray(i * each, (i + 1) * each);
      return now.reduce((most, x, k) => (k % 2 ? most : Math.max(most, Math.hypot(x, now[k + 1]))), 0);
    }).sort();
    const usual = largest[Math.floor(USUAL * (largest.length - 1))] || largest[largest.length - 1];
    return usual > 0 ? {...this.run.arrows, usual} : null;
  }

  showReactions(reactions, forces) {
    Object.assign(this.run, {reactions, forces});
    const button = this.player.buttons.reactions;
    if (button) button.disabled = !reactions;
  }

  /** The measures of a motion that the page finds itself, under the names of those that were recorded. */
  measures(run, found) {
    const {length} = this.data.engine.scales;
    const total = found.kinetic.map((x, k) => x + found.potential[k]), change = total.map(x => x - total[0]);
    const efforts = Object.entries(found.efforts).flatMap(([name, x]) => [[`torque of ${name}`, x], [`force of ${name}`, x]]);
    const known = {"violation": run.violation.map(x => Math.max(x * length, SMALLEST_POSITIVE)), "energy change": change,
      "work of drivers and loads": change, "kinetic energy": found.kinetic, "potential energy": found.potential, ...Object.fromEntries(efforts)};
    return this.first.measures.map(m => ({...m, values: known[m.name] ?? []}));
  }

  // The hand

  /** The state at the time that is shown. */
  stateNow() {
    const t = this.player.t, {q, v} = this.run.state(t);
    return {...this.engine.close(this.values, {t, q, v}), t};
  }

  /** What is on a panel's canvas at a place (px), if a hand can grasp it. */
  bodyAt(canvas, point, pointer = "mouse") {
    if (!this.engine) return null;
    const painter = this.player.painter(canvas);
    painter.pose = this.run.pose(this.player.t);
    return bodyAt(painter, this.run.symbols, point, REACH[pointer] ?? REACH.touch);
  }

  grasp(canvas, point, pointer) {
    const held = this.bodyAt(canvas, point, pointer);
    if (!held) return false;
    if (this.dirty) this.solve();
    while (this.job) this.goAhead();
    this.player.pause();
    this.hand = new Hand(this, held, this.metres(canvas, point));
    return true;
  }

  move(canvas, point) { this.hand?.move(this.metres(canvas, point)); }

  drop() {
    cancelAnimationFrame(this.request);
    this.job = null;
    const {hand} = this;
    this.hand = null;
    if (hand) cancelAnimationFrame(hand.request);
  }

  release() {
    const {hand} = this;
    this.hand = null;
    hand?.release();
  }

  metres(canvas, [x, y]) {
    const view = this.player.view(canvas.clientWidth, canvas.clientHeight);
    return [(x - view.x) / view.scale, (view.y - y) / view.scale];
  }

  /** Begin a record that a hand goes on with: of what was until now. */
  begin(state) {
    const {ts, q, v} = this.run, n = this.engine.size, count = ts.findIndex(t => t >= state.t), before = count < 0 ? ts.length : count;
    const old = this.run.measures.find(m => m.name === "violation")?.values, {length} = this.data.engine.scales;
    this.record = {ts: [...ts.slice(0, before)], q: [...q.slice(0, before * n)], v: [...v.slice(0, before * n)],
      violation: Array.from({length: before}, (_, k) => (old?.[k] ?? 0) / length)};
    this.append(state, state.violation);
  }

  /** Add one state to the record, and show it. */
  append({t, q, v}, violation) {
    const {record} = this;
    record.ts.push(t);
    record.q.push(...q);
    record.v.push(...v);
    record.violation.push(violation);
    this.showRecord();
    this.player.setEnd(Math.max(t, this.player.data.end));
    this.player.t = t;
    this.player.draw();
  }

  showRecord() {
    const run = Object.fromEntries(Object.entries(this.record).map(([name, x]) => [name, Float64Array.from(x)]));
    this.show({...run, count: run.ts.length});
  }

  /** Solve on from where the hand lets go, for as long as the first motion is. */
  goOn(state) {
    const {engine, record} = this, n = engine.size, times = this.times.map(t => t - this.times[0] + state.t);
    const run = engine.run(this.values, state, times);
    for (let k = 1; k < run.count; k++) {
      record.ts.push(run.ts[k]);
      record.q.push(...run.q.subarray(k * n, (k + 1) * n));
      record.v.push(...run.v.subarray(k * n, (k + 1) * n));
      record.violation.push(run.violation[k]);
    }
    this.showRecord();
    this.player.setEnd(record.ts[record.ts.length - 1]);
    this.say(run.done ? "Let go: the motion goes on by itself." : `Let go: the motion ends at ${run.t.toPrecision(4)} s, ${run.words}.`, !run.done);
    this.player.play();
  }

  // Pictures

  paintGhost(painter, context, t) {
    if (!this.changed || !this.player.show.ghost) return;
    painter.pose = this.ghost.pose(Math.min(t, this.first.end));
    context.globalAlpha = GHOST;
    painter.draw(this.ghost.symbols);
    context.globalAlpha = 1;
  }

  paintHand(painter) {
    const {hand} = this;
    if (!hand) return;
    const from = painter.px(place(painter.pose, [hand.held.body, ...hand.held.point])), to = painter.px(hand.target);
    painter.line([from, to], 1.6, painter.theme.accent, {dash: [5, 3]});
    painter.circle(from, 3.2 * painter.pt, {fill: painter.theme.accent});
    painter.circle(to, 6 * painter.pt, {stroke: painter.theme.accent, width: 1.6});
  }

  /** What the whole view shows: all that is drawn of the motion as it is now. */
  fit() {
    const {bounds} = this.player.data;
    this.first.bounds ??= bounds.slice();
    bounds.splice(0, 4, ...(this.changed ? boundsOf(this.run, 0.1 * this.data.engine.scales.length) : this.first.bounds));
  }
}
