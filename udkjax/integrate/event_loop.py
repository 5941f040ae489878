"""The loop over the windows of a run with events: integrate one, look for crossings, locate the first, jump, go on.

A window has the output times within it and a uniform grid besides. On it the conditions g and, where they depend on positions
alone, their rates are known: between two times g is a cubic, which tells crossings in pairs from touching, too. What it predicts
is located by Newton's method on the event time, safeguarded by the bracket, with the state integrated anew from the bracket's
beginning; the last change of the time, too small to matter for anything but g, is a step of Taylor's. So g is zero to rounding.

One pass of the loop is one run of the integrator, or one jump, so that the members of a batch each go their own way through one
program.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.integrate.hybrid import ZERO, ZERO_RATE, ZERO_RATE_2, Hybrid, Point, Values
from udkjax.integrate.problem import IntegratorOutput
from udkjax.integrate.solution import Result
from udkjax.native.steps import DONE, NOT_FINITE, STEP_LIMIT

NONE, BEGIN = -1, -2  # instead of an event: nothing happens now, or the values at the start are not known yet
GRID = 32  # times of a window besides those of output
PER_TIME = 16  # times of the grid in the shortest time in which anything changes
MOST_OUTPUTS = 32  # output times of a window
BISECTIONS = 40  # to a root of a cubic; what remains is for Newton's method
MOST_TRIES = 60  # of Newton's method, safeguarded by bisection
LAST_CHANGE = 1e-7  # of the event time, in T: Taylor's step makes an error of its square


class Noted(NamedTuple):
    """Events so far, with room for more."""

    t: Array  # (K,)
    index: Array  # (K,) of the event; plus their number E where a contact lets go, plus 2 E where it comes to rest
    phase: Array  # (K,) after it
    q: Array  # (K, 2, n) before and after
    v: Array


class Search(NamedTuple):
    """The event that is being located between `low` and `high`, with `time` to try next."""

    event: Array  # -1: none
    time: Array
    low: Array
    high: Array
    tries: Array
    sure: Array  # whether the condition has changed its sign, not only a cubic
    side: Array  # of zero, before the event
    until: Array  # the end of the interval in which it was found


def no_search(t: Any) -> Search:
    """That of nothing."""
    return Search(jnp.array(-1), t, t, t, jnp.array(0), jnp.array(True), jnp.array(0), t)


class Loop(NamedTuple):
    """Everything that changes."""

    point: Point
    values: Values
    sides: Array  # (2E,) of each condition, which side of zero it was on last: -1, 1, or 0: not known
    pending: Array  # the event that happens now; or NONE, or BEGIN
    search: Search
    reach: Array  # how far the next window goes (s)
    quiet: Array  # the time up to which crossings in pairs were looked for in vain
    q: Array  # (T, n) outputs
    v: Array
    written: Array  # how many of them
    noted: Noted
    count: Array
    last: Array  # the time of the last event
    code: Array
    running: Array
    tallies: Array  # steps tried, accepted, right-hand sides, projections


def run_loop(hybrid: Hybrid, ts: Array, point: Point, code: Any, drift_tol: Any, max_events: int) -> Loop:
    """Run from a state to the last of the output times, or an event that stops."""
    E, n, T = hybrid.count, len(point.q), len(ts)
    nothing = jnp.full((T, n), jnp.nan, float)
    none = jnp.full(max_events, -1, int)
    of_each, zeros = jnp.full((max_events, 2, n), jnp.nan, float), jnp.zeros(2 * E)
    state = Loop(
        point=point,
        values=Values(zeros, zeros, zeros, jnp.zeros((E, n)), jnp.zeros(n), zeros),
        sides=jnp.zeros(2 * E, int),
        pending=jnp.array(BEGIN),
        search=no_search(ts[0]),
        reach=ts[-1] - ts[0],
        quiet=ts[0],
        q=nothing,
        v=nothing,
        written=jnp.array(0),
        noted=Noted(jnp.full(max_events, jnp.nan, float), none, none, of_each, of_each),
        count=jnp.zeros((), int),
        last=ts[0],
        code=code,
        running=code == Result.successful,
        tallies=jnp.zeros(4, int),
    )

    def body(loop: Loop) -> Loop:
        window, happens = _window(hybrid, ts, loop), loop.pending != NONE
        still = jax.eval_shape(lambda: _integrated(hybrid, loop, window, drift_tol))
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), still)
        jumped = jax.lax.cond(loop.pending >= 0, lambda: _jumped(hybrid, loop, max_events), lambda: loop)
        went = jax.lax.cond(happens, lambda: nothing, lambda: _integrated(hybrid, loop, window, drift_tol))
        values = hybrid.values(_where(happens, jumped.point, went.probe))
        values = values._replace(scale=jnp.maximum(values.scale, loop.values.scale))
        loop = jax.lax.cond(
            happens, lambda: _settled(hybrid, loop, jumped, values), lambda: _advanced(hybrid, loop, went, values)
        )
        more = (loop.point.t < ts[-1]) | (loop.pending >= 0)
        too_long = (loop.tallies[0] >= hybrid.max_steps) & loop.running & more
        code = jnp.where(too_long, Result.step_limit, loop.code)
        return loop._replace(code=code, running=loop.running & more & ~too_long)

    loop = jax.lax.while_loop(lambda loop: loop.running, body, state)
    return _finished(loop, ts)


def _settled(hybrid: Hybrid, loop: Loop, jumped: Loop, values: Values) -> Loop:
    """After an event, or at the start: with what happens at once."""
    new = jax.lax.cond(loop.pending == BEGIN, lambda: _begun(hybrid, jumped, values), lambda: jumped)
    pending = _first(_crossed(hybrid, new.point.phase, new.sides, _sign(values, hybrid.rate)))
    return new._replace(values=values, pending=jnp.where(new.running, pending, NONE))


def _begun(hybrid: Hybrid, loop: Loop, values: Values) -> Loop:
    """With the sides of zero that the conditions are on at the start."""
    is_zero = jnp.abs(values.h) <= ZERO * values.scale
    # Contacts are approached from the side that is allowed: what is zero and falls at the start happens at once.
    impacts = np.append(hybrid.restituting, np.zeros(hybrid.count, bool))
    sides = jnp.where(impacts & is_zero, 1, _sign(values, hybrid.rate))
    beyond = jnp.any(impacts & (values.h < 0) & ~is_zero)
    code = jnp.where(beyond, Result.beyond_contact, loop.code)
    return loop._replace(sides=sides, code=code, running=loop.running & ~beyond)


# --- one window


def _window(hybrid: Hybrid, ts: Array, loop: Loop) -> tuple[Array, Array, Array]:
    """The grid of the next run, and the outputs that it may have: their numbers and times."""
    t, number = loop.point.t, loop.written + np.arange(min(MOST_OUTPUTS, len(ts)))
    due = ts[jnp.minimum(number, len(ts) - 1)]
    speed = jnp.maximum(hybrid.scales.rate, hybrid.scales.size(loop.point.v))
    full = jnp.where(speed > 0, GRID / PER_TIME / jnp.where(speed > 0, speed, 1.0), ts[-1] - ts[0])
    end = jnp.minimum(jnp.minimum(t + jnp.minimum(full, loop.reach), ts[-1]), due[-1])
    end = jnp.where(loop.search.event >= 0, loop.search.time, end)
    grid = (t + (end - t) * np.linspace(0.0, 1.0, GRID)).at[-1].set(end)
    return jnp.sort(jnp.concatenate([grid, jnp.clip(due, t, end)])), number, due


def _integrated(hybrid: Hybrid, loop: Loop, window: Any, drift_tol: Any) -> "Went":
    """Integrate a window, and look for the first crossing in it."""
    (grid, number, due), E, point = window, hybrid.count, loop.point
    start, length = grid[0], grid[-1] - grid[0]
    # Too short to integrate, or of no length, as of a member of a batch that something else happens to.
    short = length <= 2 * hybrid.smallest
    times = jnp.where(short, start + 100 * hybrid.smallest * np.arange(len(grid)), grid)
    raw = hybrid.flow(times, point, derivatives=False)
    own = (short | (np.arange(len(grid)) == 0))[:, None]
    q = jnp.where(own, point.q + (grid - start)[:, None] * point.v, raw.q)
    v = jnp.where(own, point.v, raw.v)
    good = jnp.cumsum(~(own[:, 0] | (raw.reached & (raw.violation <= drift_tol)))) == 0

    g, g_dot = jax.vmap(hybrid.on_grid)(grid, q, v)  # (G, E)
    scale = loop.values.scale[:E]
    signs = jnp.where((jnp.abs(g) <= ZERO * scale) | ~good[:, None], 0, jnp.sign(g)).astype(int)
    sides = _filled(loop.sides[:E], signs.at[0].set(0))  # (G, E)
    before, after = sides[:-1], sides[1:]
    step = jnp.diff(grid)[:, None]
    slopes = jnp.where(hybrid.by_velocity, jnp.diff(g, axis=0), 0.0)  # of those whose rates are not known: straight lines
    cubic = (
        g[:-1],
        jnp.where(hybrid.by_velocity, slopes, step * g_dot[:-1]),
        g[1:],
        jnp.where(hybrid.by_velocity, slopes, step * g_dot[1:]),
    )
    crosses = _matches(hybrid, before, after)
    # In pairs: on one side at both ends, approaching zero at the first, leaving it at the second, and beyond it in between.
    lowest = _extremum(cubic, before)
    dips = (before != 0) & (before == after) & (before * cubic[1] < 0) & (before * cubic[3] > 0)
    dips = dips & (before * _cubic(cubic, lowest) < -ZERO * scale) & good[1:, None] & (grid[:-1] >= loop.quiet)[:, None]
    enters = dips & _matches(hybrid, before, -before)
    leaves = dips & ~enters & _matches(hybrid, -before, before)
    search = loop.search
    is_other = (np.arange(E) != search.event) & ~hybrid.is_held(point.phase)
    found = (crosses | enters | leaves) & is_other  # (G - 1, E)

    place = jnp.argmax(jnp.any(found, axis=1))
    here = jax.tree.map(lambda x: x[place], (cubic, before, found, enters, leaves, lowest))
    cubic, side, found, enters, leaves, lowest = here
    low, high = jnp.where(leaves, lowest, 0.0), jnp.where(enters, lowest, 1.0)
    root = _bisected(lambda x: _cubic(cubic, x) * jnp.where(leaves, -side, side) > 0, low, high)
    event = jnp.argmin(jnp.where(found, root, jnp.inf))
    width, after_it = grid[place + 1] - grid[place], grid[place + 1]
    low, high, time = (grid[place] + x[event] * width for x in (low, high, root))
    time = jnp.maximum(time, jnp.nextafter(low, jnp.inf))
    sure = ~(enters | leaves)[event]
    # While one is searched for, another that comes later waits.
    is_found = jnp.any(found) & ~((search.event >= 0) & (time > search.time))
    new = Search(event, time, low, high, jnp.array(0), sure, jnp.where(leaves, -side, side)[event], after_it)
    search = _where(is_found, new, search)

    fails = ~jnp.all(good) & ~is_found
    held = jnp.any(hybrid.is_held(point.phase))
    last = jnp.where(search.event >= 0, 0, len(grid) - 1)
    commits = jnp.where(is_found & ~held, place, jnp.where(fails, jnp.maximum(jnp.sum(good) - 1, 0), last))
    rows = jnp.searchsorted(grid, jnp.clip(due, start, grid[-1]), side="left")
    tallies = loop.tallies + jnp.stack(
        [raw.tried, raw.accepted, raw.evaluations, hybrid.projects * (raw.tried + 2 * len(grid) - 2)]
    )
    code = jnp.where(fails, _failure(raw, good), loop.code)
    reached = Point(grid[commits], q[commits], v[commits], point.phase, point.added)
    probe = Point(grid[-1], q[-1], v[-1], point.phase, point.added)
    return Went(reached, sides[commits], search, is_found, fails, probe, (number, due, q[rows], v[rows]), tallies, code)


class Went(NamedTuple):
    """What a run of the integrator over a window has come to."""

    reached: Point  # as far as nothing happens
    sides: Array  # (E,) there
    search: Search
    is_new: Array  # whether what is searched for is another event than before
    fails: Array
    probe: Point  # the window's end
    outputs: Any  # their numbers, times, q and v
    tallies: Array
    code: Array


def _advanced(hybrid: Hybrid, loop: Loop, went: Went, values: Values) -> Loop:
    """After a run, with the values at its end: go on, search on, or let what was found happen."""
    E, probe, search = hybrid.count, went.probe, went.search
    told, scale = _sign(values, hybrid.rate), values.scale
    # Newton's method on the time of what is searched for.
    k = jnp.maximum(search.event, 0)
    looked = (search.event >= 0) & ~went.is_new & ~went.fails
    h, rate = values.h[k], values.rate[k]
    change = jnp.where(rate != 0, -h / jnp.where(rate != 0, rate, 1.0), jnp.inf)
    small = (jnp.abs(change) * hybrid.rate <= LAST_CHANGE) | (jnp.abs(h) <= ZERO / 10 * scale[k])
    ahead = h * search.side > 0
    low, high = jnp.where(ahead, probe.t, search.low), jnp.where(ahead, search.high, probe.t)
    ends = (search.tries >= MOST_TRIES) | (high <= jnp.nextafter(low, jnp.inf))
    is_found = looked & (small | (ends & search.sure))
    lost = looked & ends & ~is_found
    time = probe.t + change
    time = jnp.where((time > low) & (time < high), time, (low + high) / 2)
    on = Search(search.event, time, low, high, search.tries + 1, search.sure, search.side, search.until)
    shift = jnp.where(small & jnp.isfinite(change), jnp.clip(change, -LAST_CHANGE / hybrid.rate, LAST_CHANGE / hybrid.rate), 0.0)
    q, v = probe.q + shift * probe.v + shift**2 / 2 * values.a, probe.v + shift * values.a
    arrived = Point(probe.t + shift, q, v, probe.phase, probe.added)
    # A contact that would have to pull at the end of the window has let go within it.
    pulls = hybrid.is_held(probe.phase) & (loop.sides[E:] > 0) & (told[E:] < 0)
    is_free = (is_found & (k < E)) | (search.event < 0)
    lets_go = is_free & jnp.any(pulls) & ~went.fails & (probe.t > loop.point.t)
    which = E + jnp.argmax(pulls)
    middle = (loop.point.t + probe.t) / 2
    release = Search(which, middle, loop.point.t, probe.t, jnp.array(0), jnp.array(True), jnp.array(1), probe.t)
    is_found = is_found & ~lets_go

    none, side = no_search(loop.point.t), search.side
    search = _where(lets_go, release, _where(is_found | lost, none, _where(looked, on, search)))
    point = _where(is_found, arrived, _where(looked | lets_go, loop.point, went.reached))
    at_end = is_found | ((search.event < 0) & ~lost & ~went.fails)
    # At the end of the run every condition that is not zero tells its side; what is located tells it by happening.
    others = (np.arange(2 * E) != jnp.where(is_found, k, -1)) & (jnp.abs(values.h) > ZERO * scale)
    sides = jnp.append(_where(looked | lets_go, loop.sides[:E], went.sides), loop.sides[E:])
    pending = _first(_crossed(hybrid, probe.phase, sides, told))
    pending = jnp.where(is_found, k, jnp.where(at_end, pending, NONE))
    sides = jnp.where(is_found & others, told, sides)
    sides = sides.at[k].set(jnp.where(is_found, side, sides[k]))
    number, due, qs, vs = went.outputs
    where = jnp.where((number < len(loop.q)) & (due < point.t), number, len(loop.q))
    return loop._replace(
        point=point,
        values=values._replace(rate=values.rate + shift * values.rate_2),
        sides=sides,
        pending=jnp.where(went.fails, NONE, pending),
        search=search,
        reach=jnp.where(search.event >= 0, loop.reach, 2 * loop.reach),
        quiet=jnp.where(lost, went.search.until, loop.quiet),
        q=loop.q.at[where].set(qs, mode="drop"),
        v=loop.v.at[where].set(vs, mode="drop"),
        written=loop.written + jnp.sum(where < len(loop.q)),
        tallies=went.tallies,
        code=went.code,
        running=loop.running & ~went.fails,
    )


def _jumped(hybrid: Hybrid, loop: Loop, max_events: int) -> Loop:
    """Do what is pending."""
    E, k, point = hybrid.count, jnp.maximum(loop.pending, 0), loop.point
    rests = hybrid.rests(k, loop.values)
    found = hybrid.jump(k, rests, point, loop.values)
    full, place = loop.count >= max_events, jnp.where(loop.count < max_events, loop.count, max_events)
    put = lambda x, y: x.at[place].set(y, mode="drop")  # noqa: E731
    noted = Noted(
        put(loop.noted.t, point.t),
        put(loop.noted.index, jnp.where(rests, 2 * E + k, k)),
        put(loop.noted.phase, found.point.phase),
        put(loop.noted.q, jnp.stack([point.q, found.point.q])),
        put(loop.noted.v, jnp.stack([point.v, found.point.v])),
    )
    e = k % E
    stop = jnp.array(hybrid.stops)[e] & (k < E)
    rest = rests & jnp.array(hybrid.stops_at_rest)[e]
    code = jnp.where(stop, Result.event_stop, loop.code)
    code = jnp.where(rest, Result.at_rest, code)
    code = jnp.where(found.blocked, Result.event_impossible, code)
    code = jnp.where(full, Result.event_limit, code)
    contact = jnp.array(hybrid.restituting)[e] | (k >= E)
    sides = loop.sides.at[e].set(jnp.where(contact, 1, -loop.sides[e])).at[E + e].set(1)
    apart = point.t - loop.last
    return loop._replace(
        point=_where(full | found.blocked, point, found.point),
        sides=sides,
        pending=jnp.array(NONE),
        reach=jnp.where(apart > 0, jnp.minimum(loop.reach, 2 * apart), loop.reach),
        noted=noted,
        count=loop.count + jnp.where(full, 0, 1),
        last=point.t,
        code=code,
        running=loop.running & (code == Result.successful),
    )


def _finished(loop: Loop, ts: Array) -> Loop:
    """Outputs at the very end, an event's time or the last, are the state there."""
    number = np.arange(len(ts))
    end = (number >= loop.written) & (ts <= loop.point.t)
    q, v = (jnp.where(end[:, None], x, y) for x, y in ((loop.point.q, loop.q), (loop.point.v, loop.v)))
    return loop._replace(q=q, v=v, written=loop.written + jnp.sum(end))


# --- signs and cubics


def _sign(values: Values, rate: Any) -> Array:
    """Which side of zero each condition is on, or, at zero, will be next; 0 where that is not known."""
    h, dh, ddh, scale = values.h, values.rate, values.rate_2, values.scale
    next_but_one = jnp.where(jnp.abs(ddh) > ZERO_RATE_2 * scale * rate**2, jnp.sign(ddh), 0.0)
    following = jnp.where(jnp.abs(dh) > ZERO_RATE * scale * rate, jnp.sign(dh), next_but_one)
    return jnp.where(jnp.abs(h) > ZERO * scale, jnp.sign(h), following).astype(int)


def _crossed(hybrid: Hybrid, phase: Any, sides: Array, told: Array) -> Array:
    """Which events happen at a state, of the sides of zero that the conditions were on before and those that they tell now."""
    E = hybrid.count
    held = hybrid.is_held(phase)
    crossing = _matches(hybrid, sides[:E], told[:E]) & ~held
    return jnp.append(crossing, held & (sides[E:] > 0) & (told[E:] < 0))


def _matches(hybrid: Hybrid, before: Array, after: Array) -> Array:
    direction = np.array([e.direction for e in hybrid.events])
    return (before != 0) & (after == -before) & ((direction == 0) | (after == direction))


def _first(happens: Array) -> Array:
    return jnp.where(jnp.any(happens), jnp.argmax(happens), NONE)


def _filled(start: Array, signs: Array) -> Array:
    """Signs along a grid (G, E), where it is zero that of the time before."""

    def step(side: Array, sign: Array) -> tuple[Array, Array]:
        side = jnp.where(sign != 0, sign, side)
        return side, side

    return jax.lax.scan(step, start, signs)[1]


def _cubic(values: Any, x: Any) -> Any:
    """Hermite's cubic on [0, 1], of the values and slopes at both ends."""
    a, da, b, db = values
    return a + x * (da + x * (3 * (b - a) - 2 * da - db + x * (2 * (a - b) + da + db)))


def _slope(values: Any, x: Any) -> Any:
    a, da, b, db = values
    return da + x * (2 * (3 * (b - a) - 2 * da - db) + 3 * x * (2 * (a - b) + da + db))


def _extremum(values: Any, side: Any) -> Any:
    """Where a cubic on `side` of zero is nearest to it, or farthest beyond, if it approaches at 0 and leaves at 1."""
    zero = jnp.zeros_like(values[0])
    return _bisected(lambda x: _slope(values, x) * side < 0, zero, zero + 1)


def _bisected(is_before: Any, low: Any, high: Any) -> Any:
    def half(_: Any, bracket: Any) -> Any:
        low, high = bracket
        middle = (low + high) / 2
        before = is_before(middle)
        return jnp.where(before, middle, low), jnp.where(before, high, middle)

    low, high = jax.lax.fori_loop(0, BISECTIONS, half, (low, high))
    return (low + high) / 2


def _failure(raw: IntegratorOutput, good: Array) -> Array:
    code = jnp.where(raw.status == STEP_LIMIT, Result.step_limit, Result.step_too_small)
    code = jnp.where(raw.status == NOT_FINITE, Result.not_finite, code)
    return jnp.where(raw.status == DONE, Result.drift, code)


def _where(condition: Any, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
