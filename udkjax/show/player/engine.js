// The engine of one mechanism in a page: the data of udkjax/integrate/portable, run by WebAssembly.
//
//   const engine = await loadEngine(data)      throws without WebAssembly
//   engine.parameters                          a list of {name, unit, value}
//   engine.values                              their values in the scene, in the same order
//   engine.close(parameters, guess)            -> {t, q, v, violation, rate, rank, closed}
//   engine.mark(parameters, state)             -> for each row of Psi 1 if it is independent near a state, else 0; null if all are
//   engine.run(parameters, state, times, pull, limit) -> {ts, q, v, violation, count, done, words, t, steps, tried, limited, events,
//                                                 modes, last}
//   engine.measure(parameters, run, efforts, forces, accelerations) -> {kinetic, potential, efforts: {driver: values}, friction, forces, a}
//
// Parameters are an array of numbers, or null for those of the scene. Arrays are Float64Array; q has x, y (m), angle (rad) of each
// body in turn, and v their rates; in a run time is the first axis. Results are not overwritten by later calls.

import {runWithEvents} from "./events.js";
import {bytesOf} from "./motion.js";

const STACK = 1 << 20, PAGE = 1 << 16, LINE = 64;  // bytes: more than any stack needs, the unit in which memory grows, alignment
const STATUSES = ["running", "done", "step_limit", "step_too_small", "not_finite", "lost", "singular", "spurious_rank", "missing_rank", "crossed", "unresolved", "interrupted"];
const UNFINISHED = {step_limit: "too many steps", step_too_small: "the step became too small", not_finite: "a number is not finite",
  lost: "the loops do not stay closed", unresolved: "the condition of an event varies too quickly"};
const EPS = 2 ** -52;

const numbersOf = text => new Float64Array(bytesOf(text).buffer);
const largest = (x, unit) => x.reduce((most, value, k) => Math.max(most, Math.abs(value) / unit(k)), 0);

async function inflate(text) {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/** A module with its own memory: constants, stack, and then the data of a call, which the next call overwrites. */
class Instance {
  static async load(module) {
    const found = new Instance();
    found.module = module;
    found.start = Math.ceil((module.data_end + STACK) / LINE) * LINE;
    found.memory = new WebAssembly.Memory({initial: Math.ceil(found.start / PAGE) + 1});
    const env = {__linear_memory: found.memory, malloc: size => found.reserve(Number(size)), free: () => {}};
    for (const name of ["look", "project"]) env[name] = () => found.imports[name]();  // set by each run
    env.__stack_pointer = new WebAssembly.Global({value: "i32", mutable: true}, found.start);
    const {instance} = await WebAssembly.instantiate(await inflate(module.code), {env});
    found.exports = instance.exports;
    return found;
  }

  begin() { this.end = this.start; }

  /** Reserve bytes of memory and return their address. */
  reserve(size) {
    const place = this.end;
    this.end = Math.ceil((place + size) / LINE) * LINE;
    const missing = this.end - this.memory.buffer.byteLength;
    if (missing > 0) this.memory.grow(Math.ceil(missing / PAGE));
    return place;
  }

  put(numbers) {
    const place = this.reserve(8 * numbers.length);
    new Float64Array(this.memory.buffer, place, numbers.length).set(numbers);
    return place;
  }

  view(place, count) { return new Float64Array(this.memory.buffer, place, count); }

  /** Call `run` for one member: `inputs` are arrays by name, `results` the sizes of the arrays to return. */
  run(inputs, results, counts) {
    this.begin();
    const fields = {members: 1, directions: 0, next: this.put([0]), ...counts}, given = {};
    for (const name of this.module.inputs) fields[name] = this.put(inputs[name]);
    for (const name of this.module.results) fields[name] = given[name] = this.put(new Float64Array(results[name]));
    const record = this.reserve(8 * this.module.fields.length);
    const words = new BigInt64Array(this.memory.buffer, record, this.module.fields.length);
    this.module.fields.forEach((name, k) => { words[k] = BigInt(fields[name] ?? 0); });
    this.exports.run(record);
    return Object.fromEntries(this.module.results.map(name => [name, this.view(given[name], results[name]).slice()]));
  }
}

class Engine {
  constructor(data, instances) {
    this.data = data;
    this.instances = instances;
    this.parameters = data.parameters;
    this.values = Float64Array.from(data.parameters, p => p.value);
    this.base = numbersOf(data.numbers);
    this.samples = numbersOf(data.samples);
    this.size = 3 * data.bodies.length;
    this.row = data.sampled.length;
  }

  /** All numbers of the scene, followed by the times at which the motion is not smooth. */
  numbers(parameters) {
    if (!parameters || !this.parameters.length) return this.base.slice();
    const module = this.instances.evaluate;
    module.begin();
    const given = module.put(parameters), to = module.put(this.base);
    module.exports.numbers(given, to);
    return module.view(to, this.base.length).slice();
  }

  /** The numbers of conditions, of actions, and of joints that events add. */
  numbersOfEvents(numbers) {
    let place = this.data.count + this.data.knots;
    return this.data.of_events.map(size => numbers.subarray(place, place += size));
  }

  /** Numbers in another mode {phase, joints}: the constraints that hold, and the numbers of joints that events have added. */
  inMode(numbers, mode) {
    if (!mode) return numbers;
    const found = numbers.slice(), {switches, joints} = this.data.events;
    joints.forEach((place, k) => { if (place >= 0) found[place] = mode.joints[k]; });
    switches.forEach(([place, k]) => { found[place] = mode.phase[k]; });
    return found;
  }

  /** Return true if a row of Psi holds in a mode, by default that in which a run begins. */
  holds(row, mode) {
    const {events} = this.data, which = events?.switch_of_row[row] ?? -1;
    return which < 0 || (mode?.phase ?? events.starts.phase)[which] > 0.5;
  }

  /** The numbers of joints that events have added. */
  jointsIn(numbers) { return Float64Array.from(this.data.events.joints, place => (place < 0 ? 0 : numbers[place])); }

  /** All numbers of the scene, with the spring that pulls a body. */
  pulled(parameters, pull) {
    const numbers = this.numbers(parameters);
    if (pull) [...pull.point, ...pull.target, pull.stiffness, pull.damping].forEach((x, k) => { numbers[this.data.pulls[pull.body][k]] = x; });
    return numbers;
  }

  breaks(numbers) { return numbers.slice(this.data.count, this.data.count + this.data.knots).sort(); }

  /** The numbers of the equations in the form that a module takes: with marks of rows (optional), two thresholds, and the samples
   *  that are valid at a time. */
  dressed(numbers, thresholds, t, marks = null) {
    const {count} = this.data, found = new Float64Array(count + (marks?.length ?? 0) + 2);
    found.set(numbers.subarray(0, count));
    if (marks) found.set(this.data.shared ? this.data.rows.map(unit => this.data.scales.length / unit) : marks, count);
    found.set(thresholds, found.length - 2);
    const passed = this.breaks(numbers).filter(b => b <= t).length;
    this.data.sampled.forEach((place, k) => { found[place] = this.samples[passed * this.row + k]; });
    return found;
  }

  guess(numbers) {
    const {q, v} = this.data.guess;
    return {t: 0, q: Float64Array.from(q, k => numbers[k]), v: Float64Array.from(v, k => numbers[k])};
  }

  unit = k => (k % 3 === 2 ? 1 : this.data.scales.length);

  /** Find the closed state nearest to a guess {t, q, v}, by default that of the scene.
   *
   *  Returns t, q and v; `violation` of Psi and `rate` of Psi_dot, the largest of their rows in units of the scene; the `rank` of
   *  Psi_q; and `closed`, which is false if only an approximately closed state was found.
   */
  close(parameters = null, guess = null) {
    const {data} = this, numbers = this.numbers(parameters), start = {...this.guess(numbers), ...guess}, m = data.rows.length;
    const given = this.dressed(numbers, data.closing.thresholds, start.t);
    const inputs = {numbers: given, ts: [start.t, start.t], q: start.q, v: start.v, settings: data.closing.settings,
      rows: data.rows, breaks: []};
    const found = this.instances.close.run(inputs, {state: 2 * this.size, residuals: 2 * m, rank: 1}, {times: 2, knots: 0});
    const q = found.state.slice(0, this.size), v = found.state.slice(this.size), row = k => data.rows[k % m];
    const violation = largest(found.residuals.slice(0, m), row), rate = largest(found.residuals.slice(m), row);
    const tol = Math.max(data.closing.tol, data.closing.rounding * EPS * Math.max(1, largest(q, this.unit)));
    const closed = violation <= tol && rate <= tol * Math.max(data.scales.rate, largest(v, this.unit));
    return {t: start.t, q, v, violation, rate, rank: found.rank[0], closed};
  }

  /** The independent rows of Psi near a closed state {t, q, v}: 1 for each of them, 0 for others; null if all are. */
  mark(parameters, state) { return this.markRows(this.numbers(parameters), state); }

  markRows(numbers, {t, q, v}) {
    const {data} = this;
    if (!data.marks) return null;
    const given = this.dressed(numbers, data.closing.thresholds, t);
    const settings = [data.scales.length, Math.max(data.scales.rate, largest(v, this.unit))];
    const inputs = {numbers: given, ts: [t, t], q, v, settings, rows: data.rows, breaks: []};
    return this.instances.mark.run(inputs, {marks: data.marks}, {times: 2, knots: 0}).marks;
  }

  /** Why the friction of joints cannot be computed: redundant rows share their loads, and the engine has code for some of them. */
  otherShares(numbers, state) {
    const {shared} = this.data, marks = shared && this.markRows(numbers, state);
    return marks && marks.some((mark, k) => (mark === 0) !== shared.includes(k)) ? "with these numbers other constraints are redundant, and share loads that friction depends on" : "";
  }

  /** Integrate the motion from a closed state {q, v} at times[0]; missing `marks` of the state are computed.
   *
   *  `pull` is a spring {body, point, target, stiffness, damping} that pulls a body (its index): point in its frame and target in
   *  the ground frame (m), stiffness (N/m) and damping (N s/m). During a pull no event stops the motion.
   *  `limit` is the largest number of attempted steps, by default 20,000; a run that reaches it can continue from its `last` state.
   *  Returns the times ts, q and v, and the `violation` of Psi (in units of the scene), of which the first `count` are valid;
   *  `done`, and if it is false the reason in `words`; the number of `steps`; the `last` state; its `marks`; and `events`, a list of
   *  {t, index, q, v}, where `index` is that of a name in `data.events.names`. If an event stops the motion, `stop` is the reason, and
   *  the last time is that of the event. `modes` has, for each time, which constraints hold; parts of a motion in one mode share it.
   */
  run(parameters, state, times, pull = null, limit = this.data.settings.max_steps) {
    const {data} = this, T = times.length;
    if (data.why) throw new Error(data.why);
    const end = Math.max(Math.abs(times[0]), Math.abs(times[T - 1])), smallest = data.smallest * EPS * end;
    const omega = Math.max(data.scales.rate, largest(state.v, this.unit), 1 / (times[T - 1] - times[0]));
    const numbers = this.pulled(parameters, pull), settings = {...data.settings, smallest, omega};
    const others = this.otherShares(numbers, {t: times[0], ...state});
    if (others) return {ts: Float64Array.from(times), q: new Float64Array(T * this.size), v: new Float64Array(T * this.size), violation: new Float64Array(T),
      count: 0, done: false, words: others, t: times[0], steps: 0, tried: 0, limited: false, last: {t: times[0], ...state}, marks: null, events: []};
    if (data.events) return runWithEvents(this, numbers, settings, state, Float64Array.from(times), !pull, limit);
    return {...this.piece(numbers, settings, state, Float64Array.from(times), limit), events: []};
  }

  /** Integrate from a state over times, up to the first zero `crossing` of the conditions in `watch`. */
  piece(numbers, settings, state, ts, limit, watch = []) {
    const {data, size} = this, T = ts.length, breaks = this.breaks(numbers), marks = state.marks ?? this.markRows(numbers, {t: ts[0], ...state});
    const inputs = {numbers: this.dressed(numbers, data.thresholds, ts[0], marks), ts, q: state.q, v: state.v,
      settings: Object.values({...settings, max_steps: limit}), rows: data.rows, breaks, samples: this.samples, watch};
    const info = data.info.length, results = {qs: T * size, vs: T * size, violation: T, info: info + 2 * size};
    if (data.events) results.crossing = data.events.head + data.events.watched.length + 2 * size;
    const found = this.instances.run.run(inputs, results, {times: T, knots: breaks.length});
    const ended = Object.fromEntries(data.info.map((name, k) => [name, found.info[k]]));
    const status = STATUSES[ended.code], limited = status === "step_limit";
    let done = status === "done", count = done ? T : Math.min(ended.written + 1, T - 1), words = UNFINISHED[status] ?? "";
    if (ended.lost < count) { done = false; count = ended.lost; words = UNFINISHED.lost; }
    const last = {t: ended.t, marks, q: found.info.slice(info, info + size), v: found.info.slice(info + size)};
    return {ts, q: found.qs, v: found.vs, violation: found.violation, count, done, words, t: ended.t,
      steps: ended.accepted, tried: ended.tried, limited, last, marks, crossing: found.crossing};
  }

  /** Evaluate a module at a state: `states`, the conditions of events, or `project`. */
  evaluate(name, settings, numbers, {t, q, v, marks}) {
    const instance = this.instances[name], {module} = instance, [conditions] = this.numbersOfEvents(numbers);
    const inputs = {numbers: this.dressed(numbers, this.data.thresholds, t, marks), ts: [t, t], q, v, rows: this.data.rows, breaks: [],
      settings: module.settings.map(name => settings[name]), event_numbers: [...conditions, ...this.inverseMasses(numbers)]};
    return instance.run(inputs, {found: module.count}, {times: 2, knots: 0}).found;
  }

  /** One over the mass, or the inertia, of each coordinate. */
  inverseMasses(numbers) { return this.data.masses.flatMap(([mass, inertia]) => [1 / numbers[mass], 1 / numbers[mass], 1 / numbers[inertia]]); }

  /** Energies (J) at the states of a run and, if requested, the force or torque of each driver (N or N m) with the power of all
   *  friction (W), and the forces x, y (N) of the joints of `data.forces`, for all joints time by time, and accelerations `a`; these
   *  are empty if rows are redundant: forces are not unique. */
  measure(parameters, run, efforts = false, forces = false, accelerations = false) {
    if (run.modes) return this.measureParts(parameters, run, efforts, forces);
    const {ts, q, v, count, mode, marks = null} = run;
    const {data, size} = this, module = this.instances.evaluate, {places} = module.module;
    const rubs = efforts && data.friction, wanted = efforts ? data.efforts.filter(({row}) => !marks || marks[row]) : [], unique = !marks || marks.every((mark, row) => mark || !this.holds(row, mode));
    const numbers = this.inMode(this.numbers(parameters), mode), breaks = this.row ? this.breaks(numbers) : [];
    module.begin();
    const given = module.reserve(8 * (data.count + data.marks + 2)), work = module.reserve(8 * module.module.size);
    module.view(work, module.module.size).fill(0);
    const at = name => module.view(work + 8 * places[name], 1), copy = (name, from) => module.view(work + 8 * places[name], size).set(from);
    const found = {kinetic: new Float64Array(count), potential: new Float64Array(count),
      efforts: Object.fromEntries((efforts ? data.efforts : []).map(({driver}) => [driver, new Float64Array(count).fill(NaN)])),
      friction: rubs ? new Float64Array(count) : null, a: accelerations ? new Float64Array(count * size) : null, forces: new Float64Array(forces && unique ? 2 * data.forces.length * count : 0)};
    let next = -Infinity;  // time of the next sample, which changes the constants
    for (let i = 0; i < count; i++) {
      if (ts[i] >= next) {
        module.view(given, data.count + data.marks + 2).set(this.dressed(numbers, data.thresholds, ts[i], marks));
        module.exports.prologue(given, work);
        next = breaks.find(b => b > ts[i]) ?? Infinity;
      }
      at("t")[0] = ts[i];
      copy("q", q.subarray(i * size, (i + 1) * size));
      copy("v", v.subarray(i * size, (i + 1) * size));
      module.exports.energy(work, work);
      [found.kinetic[i], found.potential[i]] = module.view(work + 8 * places.energy, 2);
      if (!wanted.length && !found.forces.length && !accelerations && !rubs) continue;
      module.exports.accelerations(work, work);
      if (rubs) found.friction[i] = module.view(work + 8 * places.friction_power, 1)[0];
      found.a?.set(module.view(work + 8 * places.a, size), i * size);
      for (const {driver, place} of wanted) found.efforts[driver][i] = module.view(work + 8 * (places.x0 + place), 1)[0];
      if (found.forces.length) found.forces.set(this.forces(module.view(work, module.module.size), places), 2 * i * data.forces.length);
    }
    return found;
  }

  /** `measure` for a run with events: each part of the run, in one mode, by itself. */
  measureParts(parameters, {ts, q, v, count, modes}, efforts, forces) {
    const n = this.size, numbers = this.numbers(parameters), parts = [];
    for (let from = 0, to = 0; from < count; from = to) {
      while (to < count && modes[to] === modes[from]) to++;
      const part = {ts: ts.subarray(from, to), q: q.subarray(from * n, to * n), v: v.subarray(from * n, to * n), count: to - from, mode: modes[from]};
      part.marks = this.markRows(this.inMode(numbers, part.mode), {t: ts[from], q: part.q.subarray(0, n), v: part.v.subarray(0, n)});
      parts.push(this.measure(parameters, part, efforts, forces));
    }
    const joined = of => Float64Array.from(parts.flatMap(part => [...of(part)]));
    return {kinetic: joined(p => p.kinetic), potential: joined(p => p.potential),
      efforts: Object.fromEntries(Object.keys(parts[0].efforts).map(name => [name, joined(p => p.efforts[name])])),
      friction: parts[0].friction && joined(p => p.friction),
      forces: joined(p => (parts.every(({forces}) => forces.length) ? p.forces : []))};
  }

  /** Forces x, y of each joint at the last evaluated state. */
  forces(work, {x0, psi_q}) {
    const sum = terms => terms.reduce((total, [i, j, factor]) => total + work[x0 + i] * (j === null ? 1 : work[psi_q + j]) * factor, 0);
    return this.data.forces.flatMap(({x, y}) => [sum(x), sum(y)]);
  }
}

/** The engine of a mechanism, from its data. */
export async function loadEngine(data) {
  if (data.format !== 2) throw new Error(`this engine reads format 2, not ${data.format}`);
  const loaded = Object.entries(data.modules).map(async ([name, module]) => [name, await Instance.load(module)]);
  const engine = new Engine(data, Object.fromEntries(await Promise.all(loaded)));
  return engine;
}
