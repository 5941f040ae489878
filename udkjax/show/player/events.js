// Runs with events: machine code integrates from one event to the next, and the module `instants` does all that happens at an event:
// impacts, contacts that come to rest, joints that stick. Both are compiled from the text of Python's own runs.

// A part of a run (part_run.js) counts an event as this many steps by code of the same size. It decides only when a page responds: parts
// of the woodpecker of the gallery, with 60 events, take 22 ms at most.
const EVENT_STEPS = 15;

/** The block of numbers of a run: its parts by name, each an array in the memory of the module. */
class Block {
  constructor(instance) {
    this.instance = instance;
    instance.begin();
    this.address = instance.reserve(8 * instance.module.size);
    instance.view(this.address, instance.module.size).fill(0);
  }

  part(name) {
    const [place, size] = this.instance.module.places[name];
    return this.instance.view(this.address + 8 * place, size);
  }

  put(name, numbers) { this.part(name).set(numbers); }

  number(name) { return this.part(name)[0]; }

  /** Copies of parts, by name. */
  copies(names) { return Object.fromEntries(names.map(name => [name, this.part(name).slice()])); }
}

/** The motion of one run: its block of numbers, and what the module `instants` asks for. */
class EventMotion {
  constructor(engine, numbers, settings) {
    Object.assign(this, {engine, numbers, settings, events: engine.data.events, marks: new Map()});
    this.instants = engine.instances.instants;
    this.instants.imports = {look: () => this.look(), project: () => this.project()};
    this.block = new Block(this.instants);
    const [conditions, actions, joints] = engine.numbersOfEvents(numbers);
    this.conditions = conditions;
    this.block.put("of_actions", actions);
    this.block.put("joint_numbers", joints);
    this.block.put("coordinates", Float64Array.from({length: engine.size}, (_, i) => engine.unit(i)));
    this.block.put("inverse_mass", engine.inverseMasses(numbers));
    this.block.put("rate", [settings.omega]);
  }

  /** The state at which a function of the host is asked. */
  get at() {
    const [t, q, v, phase, joints] = ["t", "q", "v", "phase", "joints"].map(name => this.block.part(`at_${name}`).slice());
    return {t: t[0], q, v, mode: {phase, joints}};
  }

  /** The state with its numbers and with the marks of its phase, which are found where the phase is entered first. */
  dressed({mode, ...state}) {
    const numbers = this.engine.inMode(this.numbers, mode), key = mode.phase.join();
    if (!this.marks.has(key)) this.marks.set(key, this.engine.markRows(numbers, state));
    return [numbers, {...state, marks: this.marks.get(key)}];
  }

  look() { this.block.put("look", this.engine.evaluate("states", this.settings, ...this.dressed(this.at))); }

  project() { this.block.put("project", this.engine.evaluate("project", this.settings, ...this.dressed(this.at))); }

  /** The present mode; the same object as long as it stays. */
  get mode() {
    const mode = this.block.copies(["phase", "joints"]), same = (x, y) => x.every((value, k) => Object.is(value, y[k]));
    if (!this.latest || !same(mode.phase, this.latest.phase) || !same(mode.joints, this.latest.joints)) this.latest = mode;
    return this.latest;
  }

  /** Integrate to the next crossing, at most to the last of `times`. */
  advance(times, limit) {
    const {block, events, engine} = this, {scales} = engine.data, pick = (x, of) => of.map(k => x[k]), E = events.zeros.length;
    const state = {t: times[0], q: block.part("q").slice(), v: block.part("v").slice(), mode: this.mode}, scale = block.part("scale");
    const floors = events.zeros.map((zero, k) => zero * scale[k]);
    const force = events.zero * scales.mass * scales.length * this.settings.omega ** 2, forces = events.watched.slice(E).map(() => force);
    const watch = [...this.conditions, ...pick(block.part("sides"), events.watched), ...pick(block.part("watched"), events.watched),
      ...floors, ...forces, ...events.directions, events.slowest];
    const [numbers, dressed] = this.dressed(state), part = engine.piece(numbers, this.settings, dressed, times, limit, watch), n = engine.size;
    const [crossed, t, worst] = part.crossing;
    block.put("t", [t]);
    block.put("q", part.crossing.subarray(-2 * n, -n));
    block.put("v", part.crossing.subarray(-n));
    block.put("event", [crossed < 0 ? events.no_event : events.watched[crossed]]);
    events.watched.forEach((k, place) => { block.part("sides")[k] = part.crossing[events.head + place]; });
    return {...part, crossed: crossed >= 0, sure: t, worst};
  }

  /** Apply what happens at an instant, by `begin` or `settle`; returns the events {t, index, q, v}, with their states before. */
  apply(name) {
    const {block, instants, engine: {size: n}} = this;
    instants.exports[name](block.address);
    const count = block.number("events"), of = part => block.part(`events_${part}`), times = of("time"), names = of("name"), q = of("q"), v = of("v");
    return Array.from({length: count}, (_, k) => ({t: times[k], index: names[k], q: q.slice(k * n, (k + 1) * n), v: v.slice(k * n, (k + 1) * n)}));
  }
}

/** `Engine.run` for an engine with events; these stop the motion only if `stops`. */
export function runWithEvents(engine, numbers, settings, state, ts, stops, limit) {
  const {data: {events, drift_tol: driftTol}, size: n} = engine, T = ts.length, end = ts[T - 1], {results} = events;
  const run = new EventMotion(engine, numbers, settings), {block} = run;
  const found = {ts, q: new Float64Array(T * n), v: new Float64Array(T * n), violation: new Float64Array(T), modes: Array(T).fill(null), count: 0,
    events: [], steps: 0, tried: 0, done: false, limited: false, words: "", stop: null};
  const {instances: {instants, run: {module: {bytes}}}} = engine, isPart = limit < settings.max_steps, stepsOfEvent = EVENT_STEPS * instants.module.bytes / bytes;
  let first = 0, violation = 0, mode = null;
  const put = (row, q, v, open) => { found.q.set(q, row * n); found.v.set(v, row * n); found.violation[row] = open; found.modes[row] = mode; };
  const now = () => block.number("t"), putNow = () => put(first++, block.part("q"), block.part("v"), violation);
  const finish = (words, more = {}) => {
    const last = {t: now(), q: block.part("q").slice(), v: block.part("v").slice(), mode, watch: block.copies(events.kept)};
    last.marks = run.dressed(last)[1].marks;
    return Object.assign(found, {words, t: last.t, last, marks: last.marks, count: first, ...more});
  };
  const stop = words => {  // with the current state as the last output
    if (first < T && !(first && ts[first - 1] === now())) {
      ts[first] = now();
      putNow();
    }
    return finish(words, {stop: stops ? words : null});
  };
  const nameOf = index => events.names[index];

  for (const [name, x] of Object.entries(state.watch ?? events.starts)) block.put(name, x);
  if (state.watch) {  // it goes on from the end of another run
    block.put("running", [1]);
    block.put("code", [results.successful]);
    block.put("event", [events.no_event]);
  } else block.put("joints", engine.jointsIn(numbers));
  block.put("t", [ts[0]]);
  block.put("q", state.q);
  block.put("v", state.v);
  block.put("end", [end]);
  if (!state.watch && run.instants.exports.begin) run.apply("begin");
  for (;;) {
    if (block.number("running")) found.events.push(...run.apply("settle"));
    mode = run.mode;
    if (block.number("code") === results.event_stop && !stops) {
      block.put("code", [results.successful]);
      block.put("running", [now() < end ? 1 : 0]);
    }
    const code = block.number("code");
    while (first < T && ts[first] <= now()) putNow();
    if (!block.number("running")) {
      const lastEvent = found.events.at(-1);
      if (code === results.successful) {
        while (first < T) putNow();
        return finish("", {done: true});
      }
      if (code === results.event_stop) return stop(`stopped by ${nameOf(lastEvent.index)}`);
      if (code === results.at_rest) return stop(`${nameOf(lastEvent.index).replace(/ rests$/, "")} has come to rest`);
      if (code === results.undefined_condition) return finish(`the condition of ${nameOf(block.part("undefined").findIndex(x => x > 0))} is not a number`);
      return finish(events.words[code] ?? "an event is impossible");
    }
    if (found.events.length >= events.most) return finish(`more than ${events.most} events`);
    if (block.number("event") !== events.no_event) continue;  // another event at the same instant
    if (isPart && found.tried + stepsOfEvent * found.events.length >= limit) return finish("", {limited: true});
    const times = Float64Array.of(now(), ...ts.subarray(first)), part = run.advance(times, limit - found.tried);
    found.steps += part.steps;
    found.tried += part.tried;
    for (let k = 1; k < part.count && times[k] <= part.sure; k++) {
      put(first++, part.q.subarray(k * n, (k + 1) * n), part.v.subarray(k * n, (k + 1) * n), part.violation[k]);
    }
    violation = part.worst;
    if (!(part.worst <= driftTol)) return finish("the loops do not stay closed");
    if (!part.done && !part.crossed) return finish(part.words, {limited: part.limited});
  }
}
