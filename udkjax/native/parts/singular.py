"""Steps near singular configurations, where pivots are too small for elimination: shortened, or left to the fallback."""

from udkjax.native.language.ir import DOUBLE, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.parts import Shortened
from udkjax.native.module.steps import EXPECTED, FACTORS, NEAREST_STAGE, RETRIES, ROUNDING_GROWTH, SURE
from udkjax.native.module.tableau import Method


def retry_or_fall_back(f: Function, s: Lane, failed: Value, tries: Value | None) -> Shortened:
    """Shorten a step that encountered a pivot too small for elimination, or leave it to the fallback.

    Returns:
        Masks of the lanes whose attempt is complete, and of lanes that shorten it; and the time to the singular configuration.
    """
    where, stepping, fallback, error = f.select, s.stepping > 0.5, s.fallback > 0.5, s.error
    fallback_due = failed & ~fallback
    was_clear = is_clear(f, s, s.distance2)
    is_near = stepping & ~fallback & (error < 1.0) & ~is_clear(f, s, s.distance) & (s.last < 0.5)
    time_left = time_to_singularity(f, s)
    has_passed = (
        (time_left > 0.0) & (time_left < s.h * SURE) & (s.distance * time_left > s.distance2 * EXPECTED * (s.h - time_left))
    )
    is_near = is_near & ~(has_passed & (s.distance > NEAREST_STAGE))
    shortens = (fallback_due | is_near) & was_clear & (s.retries < float(RETRIES)) & (s.begin < 0.5)
    retries = where(shortens, s.retries + 1.0, where(error < 1.0, 0.0, s.retries))
    s.where(stepping if tries is None else stepping & ~tries, retries=retries)
    fallback_due = fallback_due & ~shortens
    s.fallback_due = where(fallback_due, f.const(1.0, DOUBLE, f.width), 0.0)
    return stepping & ~fallback_due, shortens, time_left


def is_clear(f: Function, s: Lane, distance: Value) -> Value:
    """Return whether a step of the current length may begin at a distance from singular configurations."""
    return (distance > NEAREST_STAGE) & (distance * distance * distance * s.tolerance > s.h * s.omega * ROUNDING_GROWTH)


def time_to_singularity(f: Function, s: Lane) -> Value:
    """Return the time until a singular configuration, a root of the parabola through three distances."""
    t2, t1, t0, d2, d1, d0 = s.point1_t, s.point2_t, s.point3_t, s.distance0, s.distance1, s.distance2
    slope, before = (d0 - d1) / (t0 - t1), (d1 - d2) / (t1 - t2)
    curve = (slope - before) / (t0 - t2)
    slope = slope + curve * (t0 - t1)
    return -d0 / (slope - curve * (d0 / slope))


def step_around(f: Function, method: Method, time_left: Value, step: Value, otherwise: Value) -> Value:
    """Return a step to replace a failed one: the singular configuration is then in the middle of a wide gap between its nodes."""
    low, high = (float(x) for x in method.clearings)
    share = time_left / step
    candidate = time_left / f.select(share < low, f.const(low, DOUBLE, f.width), high)
    return f.select((candidate > step * FACTORS.shrink) & (candidate < step * FACTORS.safety), candidate, otherwise)
