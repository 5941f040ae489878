"""A window of a run with events: integrate it, look for the first crossing in it, and locate that.

A window has the output times within it and a uniform grid besides. On it the conditions g and, where they depend on positions
alone, their rates are known: between two times g is a cubic, which tells crossings in pairs from touching, too. What it predicts
is located by Newton's method on the event time, safeguarded by the bracket, with the state integrated anew from the bracket's
beginning; the last change of the time, too small to matter for anything but g, is a step of Taylor's. So g is zero to rounding.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.events.crossings import (
    NO_EVENT,
    ZERO,
    Cubic,
    bisect,
    carry_signs,
    crosses,
    cubic_extremum,
    cubic_value,
)
from udkjax.integrate.events.hybrid import ConditionValues, Hybrid, RunState
from udkjax.integrate.problem import IntegratorOutput
from udkjax.integrate.solution import Result
from udkjax.native.steps import DONE, NOT_FINITE, STEP_LIMIT

GRID = 32  # times of a window besides those of output
PER_TIME = 16  # times of the grid in the shortest time in which anything changes
MOST_OUTPUTS = 32  # output times of a window
MOST_TRIES = 60  # of Newton's method, safeguarded by bisection
LAST_CHANGE = 1e-7  # of the event time, in T: Taylor's step makes an error of its square

T = TypeVar("T")


class Search(NamedTuple):
    """The event that is being located between `low` and `high`, with `time` to try next."""

    event: Int[Array, ""]  # `NO_EVENT`: nothing is searched for
    time: Float[Array, ""]
    low: Float[Array, ""]
    high: Float[Array, ""]
    tries: Int[Array, ""]
    sure: Bool[Array, ""]  # whether the condition has changed its sign, not only a cubic
    side: Int[Array, ""]  # of zero, before the event
    until: Float[Array, ""]  # the end of the interval in which it was found


class Window(NamedTuple):
    """The times of a run of the integrator, and the outputs that it may have."""

    grid: Float[Array, "G"]
    output: Int[Array, "N"]  # their numbers; of any value beyond the last
    due: Float[Array, "N"]


class WindowResult(NamedTuple):
    """What a run of the integrator over a window has found."""

    reached: RunState  # as far as nothing happens
    sides: Int[Array, "E"]  # of zero, there
    search: Search
    is_new: Bool[Array, ""]  # whether another event than before is searched for
    fails: Bool[Array, ""]
    end: RunState  # of the window
    window: Window
    q: Float[Array, "N n"]  # outputs
    v: Float[Array, "N n"]
    totals: Int[Array, "4"]
    code: Int[Array, ""]


class Step(NamedTuple):
    """The next step of a search: the event is found, lost, or looked for again."""

    search: Search
    is_found: Bool[Array, ""]
    is_lost: Bool[Array, ""]
    continues: Bool[Array, ""]  # it was looked for, and the state is that before it
    change: Float[Array, ""]  # of the time, from the end of the window to the event


def no_search(t: Float[Array, ""]) -> Search:
    """Return the search for nothing."""
    return Search(jnp.array(NO_EVENT), t, t, t, jnp.array(0), jnp.array(True), jnp.array(0), t)


def choose(condition: Bool[Array, ""], a: T, b: T) -> T:
    """Return tree a where the condition holds, else b."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def plan_window(
    hybrid: Hybrid, ts: Float[Array, "T"], state: RunState, search: Search, reach: Float[Array, ""], written: Int[Array, ""]
) -> Window:
    """Plan the next run of the integrator: to the time that is searched for, or as far as `reach` and the outputs go."""
    t, output = state.t, written + np.arange(min(MOST_OUTPUTS, len(ts)))
    due = ts[jnp.minimum(output, len(ts) - 1)]
    speed = jnp.maximum(hybrid.scales.rate, hybrid.scales.size(state.v))
    full = jnp.where(speed > 0, GRID / PER_TIME / jnp.where(speed > 0, speed, 1.0), ts[-1] - ts[0])
    end = jnp.minimum(jnp.minimum(t + jnp.minimum(full, reach), ts[-1]), due[-1])
    end = jnp.where(search.event >= 0, search.time, end)
    grid = (t + (end - t) * np.linspace(0.0, 1.0, GRID)).at[-1].set(end)
    return Window(jnp.sort(jnp.concatenate([grid, jnp.clip(due, t, end)])), output, due)


def integrate_window(
    hybrid: Hybrid,
    window: Window,
    state: RunState,
    sides: Int[Array, "E"],
    scale: Float[Array, "E"],
    search: Search,
    quiet: Float[Array, ""],
    drift_tol: Float[Array, ""],
) -> WindowResult:
    """Integrate a window, and look for the first crossing in it.

    Args:
        hybrid: the system.
        window: its times.
        state: where it begins.
        sides: the sides of zero of all conditions there.
        scale: that of each condition.
        search: what is searched for already.
        quiet: the time up to which there is no crossing in pairs.
        drift_tol: the violation of the constraints that ends a run.
    """
    grid, due, E = window.grid, window.due, hybrid.count
    first, length = grid[0], grid[-1] - grid[0]
    # Too short to integrate, or of no length, as of a member of a batch that something else happens to.
    short = length <= 2 * hybrid.smallest
    times = jnp.where(short, first + 100 * hybrid.smallest * np.arange(len(grid)), grid)
    raw = hybrid.flow(times, state, derivatives=False)
    own = (short | (np.arange(len(grid)) == 0))[:, None]
    q = jnp.where(own, state.q + (grid - first)[:, None] * state.v, raw.q)
    v = jnp.where(own, state.v, raw.v)
    good = jnp.cumsum(~(own[:, 0] | (raw.reached & (raw.violation <= drift_tol)))) == 0

    g, g_dot = jax.vmap(hybrid.conditions_and_rates)(grid, q, v)  # (G, E)
    signs = jnp.where((jnp.abs(g) <= ZERO * scale) | ~good[:, None], 0, jnp.sign(g)).astype(int)
    sides = carry_signs(sides, signs.at[0].set(0))  # (G, E)
    before, after = sides[:-1], sides[1:]
    step = jnp.diff(grid)[:, None]
    slopes = jnp.where(hybrid.by_velocity, jnp.diff(g, axis=0), 0.0)  # of those whose rates are not known: straight lines
    cubic: Cubic = (
        g[:-1],
        jnp.where(hybrid.by_velocity, slopes, step * g_dot[:-1]),
        g[1:],
        jnp.where(hybrid.by_velocity, slopes, step * g_dot[1:]),
    )
    hits = crosses(hybrid, before, after)
    # In pairs: on one side at both ends, approaching zero at the first, leaving it at the second, and beyond it in between.
    lowest = cubic_extremum(cubic, before)
    dips = (before != 0) & (before == after) & (before * cubic[1] < 0) & (before * cubic[3] > 0)
    dips = dips & (before * cubic_value(cubic, lowest) < -ZERO * scale) & good[1:, None] & (grid[:-1] >= quiet)[:, None]
    enters = dips & crosses(hybrid, before, -before)
    leaves = dips & ~enters & crosses(hybrid, -before, before)
    is_other = (np.arange(E) != search.event) & ~hybrid.is_held(state.phase)
    found = (hits | enters | leaves) & is_other  # (G - 1, E)

    place = jnp.argmax(jnp.any(found, axis=1))
    cubic, side, found, enters, leaves, lowest = jax.tree.map(lambda x: x[place], (cubic, before, found, enters, leaves, lowest))
    side = jnp.where(leaves, -side, side)
    low, high = jnp.where(leaves, lowest, 0.0), jnp.where(enters, lowest, 1.0)
    root = bisect(lambda x: cubic_value(cubic, x) * side > 0, low, high)
    event = jnp.argmin(jnp.where(found, root, jnp.inf))
    width, until = grid[place + 1] - grid[place], grid[place + 1]
    low, high, time = (grid[place] + x[event] * width for x in (low, high, root))
    time = jnp.maximum(time, jnp.nextafter(low, jnp.inf))
    # While one event is searched for, another that comes later waits.
    is_found = jnp.any(found) & ~((search.event >= 0) & (time > search.time))
    new = Search(event, time, low, high, jnp.array(0), ~(enters | leaves)[event], side[event], until)
    search = choose(is_found, new, search)

    fails = ~jnp.all(good) & ~is_found
    at_rest = jnp.any(hybrid.is_held(state.phase))
    last = jnp.where(search.event >= 0, 0, len(grid) - 1)
    commits = jnp.where(is_found & ~at_rest, place, jnp.where(fails, jnp.maximum(jnp.sum(good) - 1, 0), last))
    rows = jnp.searchsorted(grid, jnp.clip(due, first, grid[-1]), side="left")
    projections = hybrid.projects * (raw.tried + 2 * len(grid) - 2)
    return WindowResult(
        reached=RunState(grid[commits], q[commits], v[commits], state.phase, state.added),
        sides=sides[commits],
        search=search,
        is_new=is_found,
        fails=fails,
        end=RunState(grid[-1], q[-1], v[-1], state.phase, state.added),
        window=window,
        q=q[rows],
        v=v[rows],
        totals=jnp.stack([raw.tried, raw.accepted, raw.evaluations, projections]),
        code=jnp.where(fails, _failure(raw), jnp.array(Result.successful.value)),
    )


def step_search(hybrid: Hybrid, result: WindowResult, values: ConditionValues) -> Step:
    """Take a step of Newton's method on the time of the event that is searched for, of its condition at the window's end."""
    search, t = result.search, result.end.t
    k = jnp.maximum(search.event, 0)
    tried = (search.event >= 0) & ~result.is_new & ~result.fails
    h, rate = values.h[k], values.rate[k]
    change = jnp.where(rate != 0, -h / jnp.where(rate != 0, rate, 1.0), jnp.inf)
    small = (jnp.abs(change) * hybrid.rate <= LAST_CHANGE) | (jnp.abs(h) <= ZERO / 10 * values.scale[k])
    comes_later = h * search.side > 0
    low, high = jnp.where(comes_later, t, search.low), jnp.where(comes_later, search.high, t)
    ends = (search.tries >= MOST_TRIES) | (high <= jnp.nextafter(low, jnp.inf))
    is_found = tried & (small | (ends & search.sure))
    is_lost = tried & ends & ~is_found
    time = t + change
    time = jnp.where((time > low) & (time < high), time, (low + high) / 2)
    following = search._replace(time=time, low=low, high=high, tries=search.tries + 1)
    most = LAST_CHANGE / hybrid.rate
    change = jnp.where(small & jnp.isfinite(change), jnp.clip(change, -most, most), 0.0)
    return Step(choose(tried, following, search), is_found, is_lost, tried, change)


def _failure(raw: IntegratorOutput) -> Int[Array, ""]:
    code = jnp.where(raw.status == STEP_LIMIT, Result.step_limit, Result.step_too_small)
    code = jnp.where(raw.status == NOT_FINITE, Result.not_finite, code)
    return jnp.where(raw.status == DONE, Result.drift, code)
