"""A window of a run with events: integrate it, look for the first crossing in it, and locate that.

A window has the output times within it, and nodes at which the conditions and the forces of contacts at rest are looked at
(`detection`); where these are too coarse for a condition, the window is done again, an eighth as long. Events are located by
Newton's method on the event time, safeguarded by the bracket, with the state integrated anew from the bracket's beginning; the
last change of the time, too small to matter for anything but g, is a step of Taylor's. So g is zero to rounding.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.events.crossings import NO_EVENT, ZERO, ZERO_RATE, ZERO_RATE_2, ConditionValues
from udkjax.integrate.events.detection import INTERVALS, NODES, ROOT, SECOND_OF_TWO, Nodes, detect
from udkjax.integrate.events.hybrid import Hybrid, RunState
from udkjax.integrate.problem import IntegratorOutput
from udkjax.integrate.solution import Result
from udkjax.native.conditions import FINEST, PER_TIME, SHORT
from udkjax.native.steps import DONE, LOST, NOT_FINITE, STEP_LIMIT

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
    seeks: Int[Array, ""]  # a ROOT, or the extremum between two
    side: Int[Array, ""]  # of zero, before the event
    until: Float[Array, ""]  # the end of the interval in which it was found


class Window(NamedTuple):
    """The times of a run of the integrator, and the outputs that it may have."""

    times: Float[Array, "A"]
    nodes: Float[Array, "G"]
    output: Int[Array, "N"]  # their numbers; of any value beyond the last
    due: Float[Array, "N"]
    full: Float[Array, ""]  # the length that it would have if nothing ended it before (s)


class WindowResult(NamedTuple):
    """The result of the integrator over a window."""

    reached: RunState  # as far as nothing happens
    sides: Int[Array, "2E"]  # of zero, there
    search: Search
    is_new: Bool[Array, ""]  # whether another event than before is searched for
    is_coarse: Bool[Array, ""]  # whether the window is to be done again, shorter
    unresolved: Bool[Array, "2E"]  # the conditions that are too fast for the shortest window
    undefined: Bool[Array, "E"]  # the conditions that are not a number, in the shortest window
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
    return Search(jnp.array(NO_EVENT), t, t, t, jnp.array(0), jnp.array(ROOT), jnp.array(0), t)


def choose(condition: Bool[Array, ""], a: T, b: T) -> T:
    """Return tree a where the condition holds, else b."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def plan_window(
    hybrid: Hybrid,
    ts: Float[Array, "T"],
    state: RunState,
    search: Search,
    reach: Float[Array, ""],
    quiet: Float[Array, "2E"],
    written: Int[Array, ""],
) -> Window:
    """Plan the next run of the integrator: to the time that is searched for, or as far as `reach` and the outputs go."""
    t, output = state.t, written + np.arange(min(MOST_OUTPUTS, len(ts)))
    due = ts[jnp.minimum(output, len(ts) - 1)]
    speed = jnp.maximum(hybrid.scales.rate, hybrid.scales.size(state.v))
    full = jnp.where(speed > 0, INTERVALS / PER_TIME / jnp.where(speed > 0, speed, 1.0), ts[-1] - ts[0])
    end = jnp.minimum(jnp.minimum(t + jnp.minimum(full, reach), ts[-1]), due[-1])
    end = jnp.minimum(end, jnp.min(jnp.where(quiet > t, quiet, jnp.inf)))
    end = jnp.where(search.event >= 0, search.time, end)
    nodes = (t + (end - t) * NODES).at[-1].set(end)
    return Window(jnp.sort(jnp.concatenate([nodes, jnp.clip(due, t, end)])), nodes, output, due, full)


def integrate_window(
    hybrid: Hybrid,
    window: Window,
    state: RunState,
    sides: Int[Array, "2E"],
    scale: Float[Array, "2E"],
    watched: Bool[Array, "2E"],
    search: Search,
    quiet: Float[Array, "2E"],
    unresolved: Bool[Array, "2E"],
    drift_tol: Float[Array, ""],
) -> WindowResult:
    """Integrate a window, and look for the first crossing in it.

    Args:
        hybrid: the system.
        window: its times.
        state: state at its beginning.
        sides: the sides of zero of all conditions there.
        scale: scale of each condition.
        watched: mask of the conditions, and of the contact forces, that count.
        search: searches under way already.
        quiet: the time up to which each condition has no crossings in pairs.
        unresolved: the conditions that are known to be too fast.
        drift_tol: the violation of the constraints that ends a run.
    """
    times, nodes, due, E = window.times, window.nodes, window.due, hybrid.count
    first, length = times[0], times[-1] - times[0]
    # Too short to integrate, or of no length, as of a member of a batch that something else happens to.
    short = length <= 2 * hybrid.smallest
    clear = jnp.where(short, first + 100 * hybrid.smallest * np.arange(len(times)), times)
    raw = hybrid.flow(clear, state, derivatives=False)
    own = (short | (np.arange(len(times)) == 0))[:, None]
    q = jnp.where(own, state.q + (times - first)[:, None] * state.v, raw.q)
    v = jnp.where(own, state.v, raw.v)
    good = jnp.cumsum(~(own[:, 0] | (raw.reached & (raw.violation <= drift_tol)))) == 0

    at = jnp.searchsorted(times, nodes)
    g, g_dot = jax.vmap(hybrid.conditions_and_rates)(nodes, q[at], v[at])  # (G, E)
    pressures = hybrid.pressures(nodes, q[at], v[at], state)
    h, rates = jnp.concatenate([g, pressures], 1), jnp.concatenate([g_dot, 0 * g_dot], 1)
    has_rates = np.append(~hybrid.by_velocity, np.zeros(E, bool))
    is_other = watched & (np.arange(2 * E) != search.event)
    is_short = length * hybrid.rate <= SHORT
    found = detect(
        Nodes(nodes, h, rates, good[at]), has_rates, hybrid.directions, sides, scale, is_other, quiet, is_short, unresolved
    )
    # While an event is located, the window is part of an interval that was fine enough.
    is_coarse = found.is_coarse & (search.event < 0)
    place, width = found.place, nodes[found.place + 1] - nodes[found.place]
    time = jnp.maximum(nodes[place] + found.root * width, jnp.nextafter(nodes[place], jnp.inf))
    # While one event is searched for, another that comes later waits.
    is_found = found.is_found & ~((search.event >= 0) & (time > search.time))
    until = nodes[place + 1]
    new = Search(found.event, time, nodes[place], until, jnp.array(0), found.seeks, found.side, until)
    search = choose(is_found, new, search)

    is_shortest = length <= jnp.maximum(FINEST / hybrid.rate, 100 * len(times) * hybrid.smallest)
    undefined = is_coarse & is_shortest & found.undefined[:E]
    stays = is_found | is_coarse
    fails = (~jnp.all(good) & ~stays) | jnp.any(undefined)
    last = jnp.where(search.event >= 0, 0, len(times) - 1)
    last = jnp.where(~jnp.all(good), jnp.maximum(jnp.sum(good) - 1, 0), last)
    node = jnp.where(stays, jnp.where(is_coarse, found.last_sure, place), len(nodes) - 1)
    commits = jnp.where(stays, at[node], last)
    rows = jnp.searchsorted(times, jnp.clip(due, first, times[-1]), side="left")
    projections = hybrid.projects * (raw.tried + 2 * len(times) - 2)
    code = jnp.where(jnp.any(undefined), Result.undefined_condition.value, _failure(raw))
    return WindowResult(
        reached=RunState(times[commits], q[commits], v[commits], state.phase, state.added),
        sides=jnp.where(stays | (search.event < 0), found.sides[node], sides),
        search=search,
        is_new=is_found,
        is_coarse=is_coarse & ~jnp.any(undefined),
        unresolved=is_coarse & is_shortest & found.coarse & ~found.undefined,
        undefined=undefined,
        fails=fails,
        end=RunState(times[-1], q[-1], v[-1], state.phase, state.added),
        window=window,
        q=q[rows],
        v=v[rows],
        totals=jnp.stack([raw.tried, raw.accepted, raw.evaluations, projections]),
        code=jnp.where(fails, code, jnp.array(Result.successful.value)),
    )


def step_search(hybrid: Hybrid, result: WindowResult, values: ConditionValues) -> Step:
    """Take a step of Newton's method on the time of the event that is searched for, of its condition at the window's end.

    Where it is between two roots, the extremum is what is searched for, by the condition's rate, until the condition is beyond
    zero: then there are two roots, and the one that counts is searched for, from there.
    """
    search, t = result.search, result.end.t
    k = jnp.maximum(search.event, 0)
    tried = (search.event >= 0) & ~result.is_new & ~result.fails
    h, rate, rate_2, scale = values.h[k], values.rate[k], values.rate_2[k], values.scale[k]
    unit = scale * hybrid.rate
    in_pair = search.seeks != ROOT
    f, slope = jnp.where(in_pair, rate, h), jnp.where(in_pair, rate_2, rate)
    has_slope = jnp.abs(slope) > jnp.where(in_pair, ZERO_RATE_2 * unit * hybrid.rate, ZERO_RATE * unit)
    change = jnp.where(has_slope, -f / jnp.where(has_slope, slope, 1.0), jnp.inf)
    small = jnp.abs(change) * hybrid.rate <= LAST_CHANGE
    small = small | (~in_pair & (jnp.abs(h) <= ZERO / 10 * scale))
    comes_later = jnp.where(in_pair, rate * search.side < 0, h * search.side > 0)
    low, high = jnp.where(comes_later, t, search.low), jnp.where(comes_later, search.high, t)
    ends = (search.tries >= MOST_TRIES) | (high <= jnp.nextafter(low, jnp.inf))
    ends = ends | (in_pair & ((high - low) * hybrid.rate <= LAST_CHANGE))
    beyond = in_pair & (h * search.side < -ZERO * scale)
    # Where a condition jumps, the event is the first time behind the jump.
    behind = ~comes_later | (search.tries > MOST_TRIES)
    is_found = tried & ~in_pair & (small | (ends & behind))
    is_lost = tried & in_pair & (small | ends) & ~beyond
    time = t + change
    time = jnp.where((time > low) & (time < high), time, jnp.where(ends, high, (low + high) / 2))
    following = search._replace(time=time, low=low, high=high, tries=search.tries + 1)

    # Beyond zero, near the extremum: the roots of the parabola.
    is_second = search.seeks == SECOND_OF_TWO
    low, high = jnp.where(is_second, t, search.low), jnp.where(is_second, search.high, t)
    is_curved = jnp.abs(rate_2) > ZERO_RATE_2 * unit * hybrid.rate
    curvature = jnp.where(is_curved, rate_2, 1.0)
    root = jnp.sqrt(jnp.maximum(rate**2 - 2 * rate_2 * h, 0.0)) * jnp.where(is_second, 1, -1)
    time = t + (-rate / curvature + root / jnp.abs(curvature))
    time = jnp.where(is_curved & (time > low) & (time < high), time, (low + high) / 2)
    side = jnp.where(is_second, -search.side, search.side)
    of_root = Search(search.event, time, low, high, jnp.array(0), jnp.array(ROOT), side, search.until)
    following = choose(beyond, of_root, following)
    most = LAST_CHANGE / hybrid.rate
    change = jnp.where(small & jnp.isfinite(change), jnp.clip(change, -most, most), 0.0)
    return Step(choose(tried, following, search), is_found, is_lost, tried, change)


def _failure(raw: IntegratorOutput) -> Int[Array, ""]:
    code = jnp.where(raw.status == STEP_LIMIT, Result.step_limit, Result.step_too_small)
    code = jnp.where(raw.status == NOT_FINITE, Result.not_finite, code)
    return jnp.where((raw.status == DONE) | (raw.status == LOST), Result.drift, code)
