"""Steps near singular configurations: how far these are, when they are reached, and a step whose stages avoid them."""

from udkjax.native.base.ir import DOUBLE, Function, Value
from udkjax.native.base.layout import Lane
from udkjax.native.base.module import Module
from udkjax.native.base.steps import NEAREST_STAGE, ROUNDING_GROWTH, SAFETY, SHRINK


def is_clear(module: Module, f: Function, s: Lane, distance: Value) -> Value:
    """Return whether a step as long as the one that is tried may begin so far away from singular configurations."""
    return (distance > NEAREST_STAGE) & (distance * distance * distance * s.tolerance > s.h * s.omega * ROUNDING_GROWTH)


def time_to_singularity(module: Module, f: Function, s: Lane) -> Value:
    """Return the time that is left until a singular configuration: a root of the parabola through three distances."""
    t2, t1, t0, d2, d1, d0 = s.point1_t, s.point2_t, s.point3_t, s.distance0, s.distance1, s.distance2
    slope, before = (d0 - d1) / (t0 - t1), (d1 - d2) / (t1 - t2)
    curve = (slope - before) / (t0 - t2)
    slope = slope + curve * (t0 - t1)
    return -d0 / (slope - curve * (d0 / slope))


def step_around(module: Module, f: Function, s: Lane, left: Value, step: Value, otherwise: Value) -> Value:
    """In place of a step that failed, one that has the configuration ahead in the middle of a wide gap between its nodes."""
    low, high = (float(x) for x in module.method.clearings)
    share = left / step
    found = left / f.select(share < low, f.const(low, DOUBLE, f.width), high)
    return f.select((found > step * SHRINK) & (found < step * SAFETY), found, otherwise)
