// A run that an engine computes part by part, so that a page responds in between.

const HOPELESS = 1e3;  // times the largest number of steps: a run that would need more at the pace of a part has come to a standstill
const STANDSTILL = "its steps become ever smaller, as where a motor asks for more than the linkage can reach";

export class PartRun {
  /** The run of `engine` from a closed state over `times`, with the numbers `values`. */
  constructor(engine, values, state, times) {
    const T = times.length, n = engine.size;
    const run = {ts: times.slice(), q: new Float64Array(T * n), v: new Float64Array(T * n), violation: new Float64Array(T), modes: engine.data.events ? Array(T).fill(null) : null, count: 0, events: []};
    Object.assign(this, {engine, values, state, run, steps: 0, tried: 0, t: times[0], goesOn: true, stands: false, done: false, stop: null, words: ""});
  }

  get most() { return this.engine.data.settings.max_steps; }

  /** The part of the span that has been computed, from 0 to 1. */
  get share() {
    const {ts} = this.run;
    return (this.t - ts[0]) / (ts[ts.length - 1] - ts[0]);
  }

  /** Integrate by at most `steps` steps; returns whether the run goes on. If not, `done` is false if it ended early, for the reason
   *  `words`; `stop` is the reason if an event ended it. */
  goOn(steps) {
    const {engine, run, most} = this, n = engine.size, from = run.count, before = this.t;
    const times = from ? Float64Array.of(this.state.t, ...run.ts.subarray(from)) : run.ts, skip = from ? 1 : 0;
    const part = engine.run(this.values, this.state, times, null, Math.min(steps, most - this.tried)), count = Math.max(part.count - skip, 0);
    run.ts.set(part.ts.subarray(skip, skip + count), from);
    run.q.set(part.q.subarray(skip * n, (skip + count) * n), from * n);
    run.v.set(part.v.subarray(skip * n, (skip + count) * n), from * n);
    run.violation.set(part.violation.subarray(skip, skip + count), from);
    if (run.modes) run.modes.splice(from, count, ...part.modes.slice(skip, skip + count));
    run.count = from + count;
    run.events.push(...part.events);
    this.steps += part.steps;
    this.tried += part.tried;
    Object.assign(this, {state: part.last, t: part.t, done: part.done, stop: part.stop ?? null, words: part.words});
    this.stands = part.limited && part.tried * (run.ts[run.ts.length - 1] - part.t) > HOPELESS * most * (part.t - before);
    if (this.stands) this.words = STANDSTILL;
    this.goesOn = part.limited && !this.stands && this.tried < most;
    return this.goesOn;
  }
}
