// Runs with events: machine code integrates from one event to the next; events are recorded, and an impact changes the velocities.

/** The conditions at a state, with their rates, the effect of impulses along them, and their scales: the change of each by a
 *  displacement of one length or a turn of one radian, which never becomes smaller than in `before`. */
function evaluate(engine, numbers, settings, state, before) {
  const {tolerances: {zero}} = engine.data.events, found = engine.conditions(numbers, settings, state), rate = settings.omega;
  const largest = (slopes, size) => slopes.reduce((most, slope, i) => Math.max(most, Math.abs(slope * size(i)) || 0), 0);
  found.scales = Array.from(found.g, (_, k) => Math.max(Math.abs(found.byT[k]) * Math.max(1 / rate, Math.abs(state.t)),
    largest(found.byQ[k], i => Math.max(engine.unit(i), Math.abs(state.q[i]))),
    largest(found.byV[k], i => Math.max(engine.unit(i) * rate, Math.abs(state.v[i]))), before?.scales[k] ?? 0));
  found.sides = Array.from(found.g, (g, k) => (Number.isFinite(g) ? (Math.abs(g) > zero * found.scales[k] ? Math.sign(g) : 0) : NaN));
  return found;
}

/** The velocities after an impact of contact k by Newton's law, g_dot+ = -e g_dot-, whether it `hits`, and whether it then `rests`;
 *  or, in `words`, why a page cannot compute it, as for several contacts hit at once. The contact `held` is at rest. */
function hit(engine, numbers, settings, at, watch, k, held) {
  const {events} = engine.data, {tolerances: tol} = events, {omega} = settings, {g, rate, rate2, scales, byQ, directions} = watch;
  const W = along(watch, k, k), unit = j => scales[j] * omega;
  const isHit = j => j !== k && j !== held && events.restitution[j] !== null && Math.abs(g[j]) <= tol.closed * scales[j]
    && rate[j] <= tol.zero_rate * unit(j) && Math.abs(along(watch, j, k)) > tol.coupled * Math.sqrt(along(watch, j, j) * W);
  const other = events.names.findIndex((_, j) => isHit(j)), name = events.names[k];
  if (other >= 0) return {words: `${name} and ${events.names[other]} are hit at once, which a live page cannot compute yet`};
  const inverse = engine.inverseMasses(numbers);
  if (!(W > tol.blocked * byQ[k].reduce((sum, x, i) => sum + x * x * inverse[i], 0))) return {words: `the joints allow no motion at the contact ${name}`};
  const floor = tol.zero_rate * unit(k), isPressed = acceleration => acceleration < -tol.zero_rate_2 * unit(k) * omega;
  const isSlow = Math.abs(rate[k]) < tol.rest * unit(k) && isPressed(rate2[k]);
  const impulse = Math.max(0, -(1 + (isSlow ? 0 : events.restitution[k])) * rate[k] / W), after = rate[k] + W * impulse;
  const moved = size => at.v.map((x, i) => x + size * directions[k][i]), v = moved(impulse), hits = !isSlow && rate[k] < -floor;
  const stays = after <= Math.max(floor, tol.still * Math.abs(rate[k]), tol.rest * unit(k));
  const rests = stays && isPressed(engine.conditions(numbers, settings, {...at, v}).rate2[k]);
  return {v: rests ? moved(-rate[k] / W) : v, hits, rests};
}

/** The change of the rate of contact i by a unit impulse along contact j. */
const along = ({byQ, directions}, i, j) => byQ[i].reduce((sum, x, r) => sum + x * directions[j][r], 0);

/** `Engine.run` for an engine with events; these stop the motion only if `stops`. While a contact is at rest, the engine that holds
 *  it runs; `numbersOf` returns the numbers of an engine. */
export function runWithEvents(free, numbersOf, {smallest, omega}, state, ts, stops, limit) {
  const {data: {events, scales, drift_tol: driftTol}, size: n} = free, T = ts.length, end = ts[T - 1], E = events.names.length;
  const {zero, zero_rate: zeroRate, zero_rate_2: zeroRate2} = events.tolerances, isImpact = k => events.restitution[k] !== null;
  const found = {ts, q: new Float64Array(T * n), v: new Float64Array(T * n), violation: new Float64Array(T), held: new Int16Array(T), count: 0,
    events: [], steps: 0, tried: 0, done: false, limited: false, words: "", stop: null};
  let at = {...state, t: ts[0]}, watch = state.watch, violation = 0, first = 0, pending = -1;
  let held, engine, numbers, settings;
  const use = k => {
    held = k;
    engine = k < 0 ? free : free.held[k];
    numbers = numbersOf(engine);
    settings = {...engine.data.settings, smallest, omega};
  };
  const put = (row, q, v, open) => { found.q.set(q, row * n); found.v.set(v, row * n); found.violation[row] = open; found.held[row] = held + 1; };
  const finish = (words, more = {}) => Object.assign(found, {words, t: at.t, last: {...at, watch, held}, marks: held < 0 ? at.marks : null, ...more});
  const note = index => found.events.push({t: at.t, index, q: at.q, v: at.v});
  const stop = words => {  // with the current state as the last output
    if (first < T && !(first && ts[first - 1] === at.t)) {
      ts[first] = at.t;
      put(first++, at.q, at.v, violation);
    }
    return finish(words, {stop: stops ? words : null, count: first});
  };
  /** Continue with a contact at rest, or with none. */
  const rest = (k, v = at.v) => {
    use(k);
    at = {t: at.t, q: at.q, v};
    const {sides} = watch;
    watch = Object.assign(evaluate(engine, numbers, settings, at, watch), {sides});
  };
  use(state.held ?? -1);
  if (!watch) {
    watch = evaluate(engine, numbers, settings, at, null);
    const beyond = watch.sides.findIndex((side, k) => isImpact(k) && side < 0);
    if (beyond >= 0) return finish(`it begins beyond the contact ${events.names[beyond]}`);
    const {rate, rate2, scales: unit, sides} = watch, small = k => zeroRate * unit[k] * omega;
    const falls = k => rate[k] < -small(k) || (Math.abs(rate[k]) <= small(k) && rate2[k] < -zeroRate2 * unit[k] * omega ** 2);
    pending = sides.findIndex((side, k) => isImpact(k) && side === 0 && falls(k));  // a closed contact that closes further
    watch.sides = sides.map((side, k) => (isImpact(k) && side === 0 ? 1 : side));
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
    let event = pending, before = watch.sides, part = null;
    pending = -1;
    if (event < 0) {
      const times = Float64Array.of(at.t, ...ts.subarray(first)), floors = watch.scales.map(x => zero * x), isHeld = held < 0 ? [] : [1];
      const counts = before.map((_, k) => (k === held ? 0 : 1)), force = zero * scales.mass * scales.length * omega ** 2;
      const given = [...engine.conditionNumbers(numbers), ...before, ...isHeld, ...counts, ...isHeld, ...floors, ...isHeld.map(() => force),
        ...events.directions, ...isHeld.map(() => -1), events.slowest];
      part = engine.piece(numbers, settings, at, times, limit - found.tried, given);
      const [crossed, sure, worst] = part.crossing;
      before = [...part.crossing.subarray(events.head, events.head + E)];
      found.steps += part.steps;
      found.tried += part.tried;
      for (let k = 1; k < part.count && times[k] <= sure; k++) {
        put(first, part.q.subarray(k * n, (k + 1) * n), part.v.subarray(k * n, (k + 1) * n), part.violation[k]);
        found.count = ++first;
      }
      at = {t: sure, q: part.crossing.slice(-2 * n, -n), v: part.crossing.slice(-n), marks: part.marks};
      violation = worst;
      if (!(worst <= driftTol)) return finish("the loops do not stay closed");
      event = crossed;
      watch = evaluate(engine, numbers, settings, at, watch);
    }
    if (event === E) {  // the contact would have to pull
      before[held] = 1;
      note(E + held);
      watch.sides = before;
      rest(-1);
      continue;
    }
    let lifted = -1;  // contact lifted by the impact of another
    if (event >= 0 && isImpact(event) && held >= 0) {
      const bare = evaluate(free, numbersOf(free), settings, {t: at.t, q: at.q, v: at.v}, watch);
      if (along(bare, held, event) > events.tolerances.coupled * Math.sqrt(along(bare, held, held) * along(bare, event, event))) {
        lifted = held;
        before[held] = 1;
        rest(-1);
      }
    }
    const jump = event >= 0 && isImpact(event) ? hit(engine, numbers, settings, at, watch, event, Math.max(held, lifted)) : null;
    if (jump?.words) return finish(jump.words);
    if (event >= 0 && (!jump || jump.hits || !jump.rests)) note(event);
    if (lifted >= 0) note(E + lifted);
    if (jump) {
      at = {...at, v: jump.v};
      if (jump.rests) {
        note(2 * E + event);
        const words = `${events.names[event]} has come to rest`;
        if (events.ends_at_rest[event]) return stop(words);
        if (!free.held[event]) return finish(`${words}, where a live page cannot hold it`);
        if (held >= 0) return finish(`${words} as well as ${events.names[held]}; a live page cannot hold two contacts at rest yet`);
        before[event] = 1;
        watch.sides = before;
        rest(event);
        continue;
      }
      watch = evaluate(engine, numbers, settings, at, watch);
    }
    // A condition at zero keeps its side and crosses after the event, as does one that depends on velocities if these jump. The
    // event's own condition has crossed; that of a contact is back on its side.
    watch.sides = watch.sides.map((side, k) => {
      if (k === event) return jump ? 1 : -before[k];
      if (k === held) return 1;
      return Number.isNaN(side) || (side !== 0 && !(jump && events.by_velocity[k])) ? side : before[k];
    });
    if (event < 0) {
      if (part.done) continue;
      return finish(part.words, {limited: part.limited});
    }
    if (events.stops[event] && stops) return stop(`stopped by ${events.names[event]}`);
    if (found.events.length >= events.most) return finish(`more than ${events.most} events`);
  }
}
