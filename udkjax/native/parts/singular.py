"""Steps near singular configurations, where pivots are too small for elimination: shortened, or left to the fallback."""

from udkjax.native.language.ir import DOUBLE, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.parts import Shortened
from udkjax.native.module.steps import (
    EXPECTED_RATIO,
    FACTORS,
    NEAREST_STAGE,
    PIVOT_RETRIES,
    PLANNING_DISTANCE,
    ROUNDING_ACROSS,
    ROUNDING_GROWTH,
    SHORTEST_LAST,
    SURE_FRACTION,
)
from udkjax.native.module.tableau import Method


def retry_or_fall_back(f: Function, s: Lane, failed: Value, tries: Value | None) -> Shortened:
    """Shorten a step that encountered a pivot too small for elimination, or leave it to the fallback.

    `failed`: the lanes whose attempt failed; `tries`: those whose attempt was a trial of an implicit step (None: no trials).

    Returns:
        The mask of the lanes whose attempt is complete, the mask of the lanes that repeat it with a shorter step, and the time
        (s) to the next singular configuration.
    """
    where, stepping, fallback, error = f.select, s.stepping > 0.5, s.fallback > 0.5, s.error
    fallback_due = failed & ~fallback
    was_clear = is_clear(f, s, s.distance2)
    is_near = stepping & ~fallback & (error < 1.0) & ~is_clear(f, s, s.distance) & (s.last < 0.5)
    time_left = time_to_singularity(s)
    has_passed = (
        (time_left > 0.0)
        & (time_left < s.h * SURE_FRACTION)
        & (s.distance * time_left > s.distance2 * EXPECTED_RATIO * (s.h - time_left))
    )
    is_near = is_near & ~(has_passed & (s.distance > NEAREST_STAGE))
    shortens = (fallback_due | is_near) & was_clear & (s.retries < float(PIVOT_RETRIES)) & (s.begin < 0.5)
    retries = where(shortens, s.retries + 1.0, where(error < 1.0, 0.0, s.retries))
    s.where(stepping if tries is None else stepping & ~tries, retries=retries)
    fallback_due = fallback_due & ~shortens
    s.fallback_due = where(fallback_due, f.const(1.0, DOUBLE, f.width), 0.0)
    return stepping & ~fallback_due, shortens, time_left


def limit_of_error(f: Function, s: Lane, method: Method, time_left: Value, drift: Value | None) -> Value:
    """Return the error, relative to the tolerance, up to which a step is accepted.

    It is one or, for a step across a singular configuration, the rounding error of the step if that is larger. `drift`, the
    violation of the constraints (None: it is rounding), turns the velocity as a rounding error of this size does.

    A shorter step across the singular configuration would have a larger rounding error, as its nodes are nearer to it. The run
    would creep there by ever shorter steps, whose errors add up to much more, and leave out rows that are independent. This only
    holds if the singular configuration is certain to be in a gap between nodes: a parabola and a straight line through the
    latest distances predict it there. If the mechanism turns back before it, they predict none, and shorter steps are needed.
    """
    straight = s.distance2 * (s.point3_t - s.point2_t) / (s.distance1 - s.distance2)
    is_certain = f.abs(straight - time_left) < s.step * method.clearance
    crosses = (s.fallback > 0.5) & (s.begin < 0.5) & (time_left > 0.0) & (time_left < s.step) & is_certain
    nearest = s.distance2 * (s.step * method.clearance / f.select(crosses, time_left, 1.0))
    size = f.const(ROUNDING_ACROSS, DOUBLE, f.width) if drift is None else f.max(drift, ROUNDING_ACROSS)
    rounding = size / (nearest * nearest * s.tolerance)
    return f.select(crosses, f.max(rounding, 1.0), 1.0)


def is_clear(f: Function, s: Lane, distance: Value, h: Value | None = None) -> Value:
    """Return the lanes in which a step of length `h` (None: `s.h`) may begin at this distance from singular configurations.

    There, the rounding errors of accelerations change the velocity in the step by less than the tolerance.
    """
    h = s.h if h is None else h
    return (distance > NEAREST_STAGE) & (distance * distance * distance * s.tolerance > h * s.omega * ROUNDING_GROWTH)


def time_to_singularity(s: Lane, accepted: bool = False) -> Value:
    """Return the time (s) until a singular configuration, a root of the parabola through three distances.

    The distances are those of the latest accepted states or, if the attempt is `accepted`, of its end and the two states before.
    """
    t2, t1, t0, d2, d1, d0 = s.point1_t, s.point2_t, s.point3_t, s.distance0, s.distance1, s.distance2
    if accepted:
        t2, t1, t0, d2, d1, d0 = t1, t0, s.t1, d1, d0, s.distance
    slope, before = (d0 - d1) / (t0 - t1), (d1 - d2) / (t1 - t2)
    curve = (slope - before) / (t0 - t2)
    slope = slope + curve * (t0 - t1)
    return -d0 / (slope - curve * (d0 / slope))


def step_across(f: Function, method: Method, time_left: Value, h: Value) -> Value:
    """Return the length of a step, about h, in which a singular configuration lies in the middle of a wide gap between nodes.

    `time_left`: the time from the start of the step to the singular configuration (s).
    """
    low, high = (float(x) for x in method.clearings)
    return time_left / f.select(time_left / h < low, f.const(low, DOUBLE, f.width), high)


def step_around(f: Function, s: Lane, method: Method, distance: Value, time_left: Value, h: Value) -> Value:
    """Return the length of the next step, at most about h, planned around a singular configuration ahead.

    `distance`: the distance from singular configurations at the start of the step; `time_left`: the time to the next one (s).

    Rounding errors are largest at the nodes of a step that are next to the singular configuration, and shorter steps have larger
    ones. Therefore the step that crosses it has it in the middle of a wide gap between its nodes, and the step before ends where
    the crossing step can begin. Steps whose nodes are clear anyway are not planned.
    """
    high = float(method.clearings[1])
    share, reach = time_left / h, high * FACTORS.safety  # the step after an approach may turn out shorter than h
    nearest = distance * (h * method.clearance / time_left)
    is_ahead = (time_left > 0.0) & (share < 1.0 + reach) & (distance < PLANNING_DISTANCE) & ~is_clear(f, s, nearest, h)
    across = step_across(f, method, time_left, h)
    approach = time_left - h * reach
    approach = f.select(approach < h * SHORTEST_LAST, time_left * (1.0 / (1.0 + 2.0 * reach)), approach)
    return f.select(is_ahead, f.select(share * FACTORS.safety <= high, across, approach), h)
