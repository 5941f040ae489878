// One run of a live page: its first motion, and the motion with changed numbers, which its engine simulates part by part.

import {Hand, bodyAt} from "./hand.js";
import {Run, boundsOf, place} from "./motion.js";
import {PartRun} from "./part_run.js";
import {placedValues} from "./pin_measures.js";
import {SymbolUpdater} from "./symbol_updates.js";

const SMALLEST_POSITIVE = 1e-17;  // m: drawn instead of a zero violation on a logarithmic axis
const GHOST = 0.28;  // opacity of the first motion
const REACH = {mouse: 6, touch: 16};  // px around a body within which it can be grasped
// Bytes of code times steps per frame: some 5 ms on a current processor, a third of a frame. It is the same on every machine, so
// that the same numbers give the same motion.
const STEP_BYTES = 4e7;
const USUAL = 0.95;  // fraction of the instants without a force above the usual force, which scales the arrows

export class LiveRun {
  /** `live` is the page; `run` is shown; `record` is its data, and `data` its further data for a live page. */
  constructor(live, run, record, data) {
    const {ts, q, v, measures, frame, reactions, forces, events, sticking} = run;
    Object.assign(this, {live, run, data, player: live.player, ghost: new Run(record), first: {ts, q, v, measures, frame, reactions, forces, events, sticking}});
    this.times = data.times ? Float64Array.from(data.times) : ts;  // all output times, even if the first motion failed or was stopped
    this.updater = new SymbolUpdater(run, data.symbol_updates);
    Object.assign(this, {changed: false, hand: null, job: null, marks: null});
  }

  use(engine) {
    this.engine = engine;
    this.steps = Math.round(STEP_BYTES / engine.data.modules.run.bytes);  // per frame
    this.firstFreedoms = this.freedoms(this.close(null), null);
  }

  /** The numbers of this run's sliders; sliders that were not moved have the run's own numbers. */
  get values() {
    const {values, data: {sliders}} = this.live;
    return Float64Array.from(this.data.sliders, ([k, own]) => (values[k] === sliders[k].value ? own : values[k]));
  }

  get end() { return this.run.ts[this.run.ts.length - 1]; }

  close(values) { return this.engine.close(values, {t: this.times[0], ...this.data.start}); }

  /** The degrees of freedom near a closed state, whose marks are set; null where branches of the motion meet. */
  freedoms(state, values) {
    this.marks = state.marks = this.engine.mark(values, state);
    const rank = this.marks?.reduce((sum, x) => sum + x, 0) ?? state.rank;
    return this.marks && state.rank < rank && this.marks.every((mark, row) => mark || !this.engine.holds(row)) ? null : this.engine.size - rank;
  }

  lengthOf(violation) { return `${(violation * this.engine.data.scales.length).toPrecision(2)} m`; }

  reset() {
    const {ts, q, v, measures, frame, reactions, forces, events} = this.first;
    this.drop();
    this.run.replace(ts, q, v, measures, frame, events);
    this.run.modes = null;
    this.run.sticking = this.first.sticking;
    this.showReactions(reactions, forces);
    this.updater.update(this.engine.numbers(null));
    this.changed = false;
  }

  // Simulating

  /** Begin to simulate the motion with the current numbers; returns a message if its loops do not close. */
  begin() {
    this.drop();
    const {engine, times, values} = this, start = performance.now(), state = this.close(values);
    if (!state.closed) return `The loops do not close with these numbers: a gap of ${this.lengthOf(state.violation)} remains. The last valid motion is shown.`;
    const freedoms = this.freedoms(state, values);  // which marks the rows of the state
    this.job = {parts: new PartRun(engine, values, state, times), freedoms, start};
    this.updater.update(engine.numbers(values));
    return "";
  }

  /** Simulate as many steps as fit into one frame; returns the message, with `bad` for a motion that ended too early. */
  goOn() {
    const {job: {parts, freedoms, start}} = this, goesOn = parts.goOn(this.steps);
    this.show(parts.run);
    if (goesOn) return {words: `Simulating: ${Math.round(100 * parts.share)} %`, bad: false};
    this.job = null;
    const {run: {ts, events}, t, steps, done, words: reason} = parts, span = this.times[this.times.length - 1] - ts[0];
    const happened = events.length ? `, ${events.length} event${events.length > 1 ? "s" : ""}` : "";
    const ended = done ? `${+span.toPrecision(3)} s simulated in ${(performance.now() - start).toFixed(1)} ms, ${steps} steps${happened}.`
      : `The motion ends at ${t.toPrecision(4)} s: ${reason}.`;
    const first = this.firstFreedoms === null ? "" : `, ${this.firstFreedoms} in the first motion`;
    const words = freedoms === this.firstFreedoms || freedoms === null ? ended : `${ended} Degrees of freedom: ${freedoms}${first}.`;
    return {words, bad: !done && !parts.stop};
  }

  drop() {
    this.job = null;
    const {hand} = this;
    this.hand = null;
    if (hand) cancelAnimationFrame(hand.request);
  }

  // Display

  show(run) {
    const {count} = run, n = this.engine.size, cut = (x, size) => x.subarray(0, count * size);
    const part = {...run, marks: this.marks, ts: cut(run.ts, 1), q: cut(run.q, n), v: cut(run.v, n), violation: cut(run.violation, 1)};
    const found = this.engine.measure(this.values, part, true, Boolean(this.first.reactions));
    this.run.replace(part.ts, part.q, part.v, this.measures(part, found), 1, this.named(run.events));
    this.run.modes = run.modes;
    this.run.sticking = this.stuck(part, this.run.events);
    this.showReactions(this.reactions(found.forces), found.forces);
    this.changed = true;
  }

  /** The joints that stick, with the spans of time in which they do: from their events, or else from output to output. */
  stuck({ts, modes}, events) {
    const {sticking = {}} = this.engine.data.events ?? {};
    return (this.first.sticking ?? []).map(joint => {
      const [lock, side] = sticking[joint.name], sticks = mode => Boolean(mode) && (mode.phase[lock] > 0.5 || mode.joints[side] > 0.5), changes = [];
      ts.forEach((t, k) => {
        const now = sticks(modes[k]), before = k > 0 && sticks(modes[k - 1]);
        if (now === before) return;
        const name = `${joint.name} ${now ? "sticks" : "slips"}`, event = events.findLast(e => e.name === name && e.t >= ts[k - 1] && e.t <= t);
        changes.push(event?.t ?? t);
      });
      if (changes.length % 2) changes.push(ts[ts.length - 1]);
      return {...joint, spans: Array.from({length: changes.length / 2}, (_, k) => changes.slice(2 * k, 2 * k + 2))};
    });
  }

  /** Events in the form in which they are shown, {t, name}. */
  named(events) {
    const names = this.engine.data.events?.names ?? [];
    return events.map(({t, index}) => ({t, name: names[index]}));
  }

  /** The arrows of forces computed in the page; null with redundant constraints, since forces are not unique. */
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
    if (button) button.disabled = !this.player.runs.some(run => run.reactions);
  }

  /** The measures of a motion that the page computes, under the names of the recorded ones. */
  measures(run, found) {
    const {length} = this.engine.data.scales;
    const total = found.kinetic.map((x, k) => x + found.potential[k]), change = total.map(x => x - total[0]);
    const efforts = Object.entries(found.efforts).flatMap(([name, x]) => [[`torque of ${name}`, x], [`force of ${name}`, x]]);
    const known = {"violation": run.violation.map(x => Math.max(x * length, SMALLEST_POSITIVE)), "energy change": change,
      "work of drivers and loads": change, "kinetic energy": found.kinetic, "potential energy": found.potential,
      "power of friction": found.friction ?? [], ...Object.fromEntries(efforts)};
    return this.first.measures.map((m, k) => ({...m, values: known[m.name] ?? placedValues(run, this.engine.size, this.run.placed[k] ?? [])}));
  }

  // Pulling

  /** The state at the time shown. */
  stateNow() {
    const t = this.player.t, {q, v} = this.run.state(t);
    return {...this.engine.close(this.values, {t, q, v}), t};
  }

  /** The body at a pixel of a panel's canvas, if it can be grasped. */
  bodyAt(canvas, point, pointer = "mouse") {
    if (!this.engine) return null;
    const painter = this.player.painter(canvas);
    painter.pose = this.run.pose(this.player.t);
    return bodyAt(painter, this.run.symbols, point, REACH[pointer] ?? REACH.touch);
  }

  grasp(canvas, point, pointer) {
    const held = this.bodyAt(canvas, point, pointer);
    if (!held) return false;
    this.live.finish();
    this.player.pause();
    this.hand = new Hand(this, held, this.metres(canvas, point));
    return true;
  }

  move(canvas, point) { this.hand?.move(this.metres(canvas, point)); }

  release() {
    const {hand} = this;
    this.hand = null;
    hand?.release();
  }

  metres(canvas, [x, y]) {
    const view = this.player.view(canvas.clientWidth, canvas.clientHeight);
    return [(x - view.x) / view.scale, (view.y - y) / view.scale];
  }

  /** Begin the record of a pull with the motion up to now. */
  record(state) {
    const {ts, q, v} = this.run, n = this.engine.size, count = ts.findIndex(t => t >= state.t), before = count < 0 ? ts.length : count;
    const modes = this.modesBefore(before), old = this.run.measures.find(m => m.name === "violation")?.values, {length} = this.engine.data.scales;
    this.past = {ts: [...ts.slice(0, before)], q: [...q.slice(0, before * n)], v: [...v.slice(0, before * n)],
      violation: Array.from({length: before}, (_, k) => (old?.[k] ?? 0) / length), modes: Array.from({length: before}, (_, k) => modes?.[k] ?? null)};
    this.happened = this.run.events.filter(({t}) => t <= state.t);
    this.marks = state.marks ??= this.engine.mark(this.values, state);
    this.append(state, state.violation, []);
  }

  /** The modes of the first outputs of the motion; of a recorded motion they are computed. */
  modesBefore(count) {
    const {run: {modes, ts}, engine, values} = this;
    if (modes || !engine.data.events || count < 2) return modes;
    return engine.run(values, this.close(values), ts.subarray(0, count)).modes;
  }

  /** Add a state, and the events before it, to the record, and show it. */
  append({t, q, v, mode = null}, violation, events) {
    const {past} = this;
    this.happened.push(...this.named(events));
    past.ts.push(t);
    past.q.push(...q);
    past.v.push(...v);
    past.violation.push(violation);
    past.modes.push(mode);
    this.showPast();
    this.player.setEnd(Math.max(t, this.player.data.end));
    this.player.t = t;
    this.player.draw();
  }

  showPast() {
    const {modes, ...numbers} = this.past, run = Object.fromEntries(Object.entries(numbers).map(([name, x]) => [name, Float64Array.from(x)]));
    run.modes = this.engine.data.events ? modes : null;
    this.show({...run, count: run.ts.length, events: []});
    this.run.events = this.happened;
  }

  /** Continue the simulation after a pull, for the duration of the first motion. */
  letGo(state) {
    const {engine, past} = this, n = engine.size, times = this.times.map(t => t - this.times[0] + state.t);
    const run = engine.run(this.values, state, times);
    for (let k = 1; k < run.count; k++) {
      past.ts.push(run.ts[k]);
      past.q.push(...run.q.subarray(k * n, (k + 1) * n));
      past.v.push(...run.v.subarray(k * n, (k + 1) * n));
      past.violation.push(run.violation[k]);
      past.modes.push(run.modes?.[k] ?? null);
    }
    this.happened.push(...this.named(run.events));
    this.showPast();
    this.player.setEnd(this.live.end);
    const ended = `Released: the motion ends at ${run.t.toPrecision(4)} s: ${run.words}.`;
    this.live.say(run.done ? "Released: the motion continues by itself." : ended, !run.done && !run.stop);
    this.player.play();
  }

  // Pictures

  paintGhost(painter, context, t) {
    if (!this.changed || !this.player.show.ghost) return;
    painter.pose = this.ghost.pose(Math.min(t, this.first.ts[this.first.ts.length - 1]));
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

  /** Left, bottom, right, top (m) of everything drawn in the current motion. */
  bounds() { return boundsOf(this.run, 0.1 * this.engine.data.scales.length); }
}
