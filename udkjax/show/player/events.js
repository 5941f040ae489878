// Runs with events: machine code runs from one to the next, and what happens there is noted; an impact changes the velocities.

/** The conditions at a state, with their rates, what impulses along them do, and their scales: what a displacement of a length or
 *  a turn of a radian changes in each, which never becomes smaller than `before`. */
function look(engine, numbers, settings, state, before) {
  const {tolerances: {zero}} = engine.data.events, found = engine.conditions(numbers, settings, state), rate = settings.omega;
  const largest = (slopes, size) => slopes.reduce((most, slope, i) => Math.max(most, Math.abs(slope * size(i)) || 0), 0);
  found.scales = Array.from(found.g, (_, k) => Math.max(Math.abs(found.byT[k]) * Math.max(1 / rate, Math.abs(state.t)),
    largest(found.byQ[k], i => Math.max(engine.unit(i), Math.abs(state.q[i]))),
    largest(found.byV[k], i => Math.max(engine.unit(i) * rate, Math.abs(state.v[i]))), before?.scales[k] ?? 0));
  found.sides = Array.from(found.g, (g, k) => (Number.isFinite(g) ? (Math.abs(g) > zero * found.scales[k] ? Math.sign(g) : 0) : NaN));
  return found;
}

/** The velocities behind an impact of contact k by Newton's law, g_dot+ = -e g_dot-, and whether it is over with its rebounds; or
 *  `words` where more happens than that: several contacts at once, and contacts that are held at rest, are no programs of a page. */
function hit(engine, numbers, settings, at, watch, k) {
  const {events} = engine.data, {tolerances: tol} = events, {omega} = settings, {g, rate, rate2, scales, byQ, directions} = watch;
  const along = (i, j) => byQ[i].reduce((sum, x, r) => sum + x * directions[j][r], 0), W = along(k, k), unit = j => scales[j] * omega;
  const isHit = j => j !== k && events.restitution[j] !== null && Math.abs(g[j]) <= tol.closed * scales[j] && rate[j] <= tol.zero_rate * unit(j)
    && Math.abs(along(j, k)) > tol.coupled * Math.sqrt(along(j, j) * W);
  const other = events.names.findIndex((_, j) => isHit(j)), name = events.names[k];
  if (other >= 0) return {words: `${name} and ${events.names[other]} are hit at once, which is no program of a page yet`};
  const inverse = engine.inverseMasses(numbers);
  if (!(W > tol.blocked * byQ[k].reduce((sum, x, i) => sum + x * x * inverse[i], 0))) return {words: `the joints leave ${name} no motion`};
  const floor = tol.zero_rate * unit(k), isPressed = acceleration => acceleration < -tol.zero_rate_2 * unit(k) * omega;
  const isSlow = Math.abs(rate[k]) < tol.rest * unit(k) && isPressed(rate2[k]);
  const impulse = Math.max(0, -(1 + (isSlow ? 0 : events.restitution[k])) * rate[k] / W), after = rate[k] + W * impulse;
  const v = at.v.map((x, i) => x + impulse * directions[k][i]), hits = !isSlow && rate[k] < -floor;
  const stays = after <= Math.max(floor, tol.still * Math.abs(rate[k])) || (isSlow && rate[k] > 0);
  return {v, hits, rests: stays && isPressed(engine.conditions(numbers, settings, {...at, v}).rate2[k])};
}

/** What `Engine.run` returns, of an engine whose runs have events; one that stops the motion does so only where `stops`. */
export function runWithEvents(engine, numbers, settings, state, ts, stops, limit) {
  const {data: {events, drift_tol: driftTol}, size: n} = engine, T = ts.length, end = ts[T - 1], E = events.names.length;
  const {zero} = events.tolerances, own = engine.conditionNumbers(numbers), isImpact = k => events.restitution[k] !== null;
  const found = {ts, q: new Float64Array(T * n), v: new Float64Array(T * n), violation: new Float64Array(T), count: 0, events: [],
    steps: 0, tried: 0, done: false, limited: false, words: "", stop: null};
  let at = {...state, t: ts[0]}, watch = state.watch, violation = 0, first = 0;
  const put = (row, q, v, open) => { found.q.set(q, row * n); found.v.set(v, row * n); found.violation[row] = open; };
  const finish = (words, more = {}) => Object.assign(found, {words, t: at.t, last: {...at, watch}, marks: at.marks, ...more});
  const note = index => found.events.push({t: at.t, index, q: at.q, v: at.v});
  const stop = words => {  // with the state there as the last output
    if (first < T && !(first && ts[first - 1] === at.t)) {
      ts[first] = at.t;
      put(first++, at.q, at.v, violation);
    }
    return finish(words, {stop: stops ? words : null, count: first});
  };
  if (!watch) {
    watch = look(engine, numbers, settings, at, null);
    const beyond = watch.sides.findIndex((side, k) => isImpact(k) && side < 0);
    if (beyond >= 0) return finish(`it begins beyond ${events.names[beyond]}`);
    watch.sides = watch.sides.map((side, k) => (isImpact(k) && side === 0 ? 1 : side));
  }
  for (;;) {
    while (first < T && ts[first] <= at.t) put(first++, at.q, at.v, violation);
    found.count = first;
    const noNumber = watch.sides.findIndex(Number.isNaN);
    if (noNumber >= 0) return finish(`the condition of ${events.names[noNumber]} is not a number`);
    if (end - at.t <= 2 * settings.smallest) {
      while (first < T) put(first++, at.q, at.v, violation);
      return finish("", {done: true, count: T});
    }
    const times = Float64Array.of(at.t, ...ts.subarray(first)), floors = watch.scales.map(x => zero * x);
    const given = [...own, ...watch.sides, ...Array(E).fill(1), ...floors, ...events.directions, events.slowest];
    const part = engine.piece(numbers, settings, at, times, limit - found.tried, given), [event, sure, worst] = part.crossing;
    const before = [...part.crossing.subarray(events.head, events.head + E)];
    found.steps += part.steps;
    found.tried += part.tried;
    for (let k = 1; k < part.count && times[k] <= sure; k++) {
      put(first, part.q.subarray(k * n, (k + 1) * n), part.v.subarray(k * n, (k + 1) * n), part.violation[k]);
      found.count = ++first;
    }
    at = {t: sure, q: part.crossing.slice(-2 * n, -n), v: part.crossing.slice(-n), marks: part.marks};
    violation = worst;
    if (!(worst <= driftTol)) return finish("the loops do not stay closed");
    watch = look(engine, numbers, settings, at, watch);
    const jump = event >= 0 && isImpact(event) ? hit(engine, numbers, settings, at, watch, event) : null;
    if (jump?.words) return finish(jump.words);
    if (event >= 0 && (!jump || jump.hits || !jump.rests)) note(event);
    if (jump) {
      at = {...at, v: jump.v};
      if (jump.rests) {
        note(2 * E + event);
        const words = `${events.names[event]} has come to rest`;
        return events.ends_at_rest[event] ? stop(words) : finish(`${words}, and how it is held is no program of a page yet`);
      }
      watch = look(engine, numbers, settings, at, watch);
    }
    // What is zero keeps its side, and crosses behind the event; so does what velocities change that jump. The event's own
    // condition is beyond it, or that of a contact on the side where it was.
    watch.sides = watch.sides.map((side, k) => {
      if (k === event) return jump ? 1 : -before[k];
      return Number.isNaN(side) || (side !== 0 && !(jump && events.by_velocity[k])) ? side : before[k];
    });
    if (event < 0) {
      if (part.done) continue;
      return finish(part.words, {limited: part.limited});
    }
    if (events.stops[event] && stops) return stop(`${events.names[event]} stops it`);
    if (found.events.length >= events.most) return finish(`more than ${events.most} events`);
  }
}
