// Runs with events: machine code runs from one to the next, and what happens there is noted.

/** The conditions at a state: each one's side of zero, 0 at zero, and its scale, what a displacement of a length or a turn of a
 *  radian changes in it, which never becomes smaller than `before`. */
function look(engine, numbers, rate, state, before) {
  const {data: {events}, size: n} = engine, scales = [], sides = [];
  engine.conditions(numbers, state).forEach(([g, ...slopes], k) => {
    const sizes = [Math.max(1 / rate, Math.abs(state.t)), ...[...state.q].map((x, i) => Math.max(engine.unit(i), Math.abs(x))),
      ...[...state.v].map((x, i) => Math.max(engine.unit(i) * rate, Math.abs(x)))];
    scales[k] = slopes.slice(0, 1 + 2 * n).reduce((most, slope, i) => Math.max(most, Math.abs(slope * sizes[i]) || 0), before?.scales[k] ?? 0);
    sides[k] = Number.isFinite(g) ? (Math.abs(g) > events.zero * scales[k] ? Math.sign(g) : 0) : NaN;
  });
  return {scales, sides};
}

/** What `Engine.run` returns, of an engine whose runs have events; one that stops the motion does so only where `stops`. */
export function runWithEvents(engine, numbers, settings, state, ts, stops, limit) {
  const {data: {events, count, knots, drift_tol: driftTol}, size: n} = engine, T = ts.length, end = ts[T - 1], E = events.names.length;
  const found = {ts, q: new Float64Array(T * n), v: new Float64Array(T * n), violation: new Float64Array(T), count: 0, events: [],
    steps: 0, tried: 0, done: false, limited: false, words: "", stop: null};
  let at = {...state, t: ts[0]}, watch = state.watch ?? look(engine, numbers, settings.omega, at, null);
  const put = (row, q, v, violation) => { found.q.set(q, row * n); found.v.set(v, row * n); found.violation[row] = violation; };
  const finish = (words, more = {}) => Object.assign(found, {words, t: at.t, last: {...at, watch}, marks: at.marks, ...more});
  let violation = 0, first = 0;
  for (;;) {
    while (first < T && ts[first] <= at.t) put(first++, at.q, at.v, violation);
    found.count = first;
    const undefined_ = watch.sides.findIndex(side => Number.isNaN(side));
    if (undefined_ >= 0) return finish(`the condition of ${events.names[undefined_]} is not a number`);
    if (end - at.t <= 2 * settings.smallest) {
      while (first < T) put(first++, at.q, at.v, violation);
      return finish("", {done: true, count: T});
    }
    const times = Float64Array.of(at.t, ...ts.subarray(first)), floors = watch.scales.map(x => events.zero * x);
    const given = [...numbers.subarray(count + knots), ...watch.sides, ...Array(E).fill(1), ...floors, ...events.directions, events.slowest];
    const part = engine.piece(numbers, settings, at, times, limit - found.tried, given), {crossing} = part, [event, sure, worst] = crossing;
    const sides = [...crossing.subarray(events.head, events.head + E)];
    found.steps += part.steps;
    found.tried += part.tried;
    for (let k = 1; k < part.count && times[k] <= sure; k++) {
      put(first, part.q.subarray(k * n, (k + 1) * n), part.v.subarray(k * n, (k + 1) * n), part.violation[k]);
      found.count = ++first;
    }
    at = {t: sure, q: crossing.slice(-2 * n, -n), v: crossing.slice(-n), marks: part.marks};
    violation = worst;
    if (!(worst <= driftTol)) return finish("the loops do not stay closed");
    watch = look(engine, numbers, settings.omega, at, watch);
    // What is zero keeps its side, and crosses behind the event; the event's own condition is beyond it.
    watch.sides = watch.sides.map((side, k) => (k === event ? -sides[k] : side || (Number.isNaN(side) ? NaN : sides[k])));
    if (event < 0) {
      if (part.done) continue;
      return finish(part.words, {limited: part.limited});
    }
    found.events.push({t: at.t, index: event, q: at.q, v: at.v});
    if (events.stops[event] && stops) {
      if (first < T && ts[first - 1] < at.t) {
        ts[first] = at.t;
        put(first++, at.q, at.v, violation);
      }
      return finish("", {stop: events.names[event], count: first});
    }
    if (found.events.length >= events.most) return finish(`more than ${events.most} events`);
  }
}
