"""Projection of positions and velocities onto the constraint manifold by Newton's method."""

from collections.abc import Callable

from udkjax.native.language.ir import DOUBLE, INT, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.steps import NEWTON_STEPS, NEWTON_TOL


def newton(module: Module, f: Function, s: Lane):
    """Take Newton steps from `state q` towards Psi = 0, in lanes that are `stepping`, until one is shorter than `NEWTON_TOL`."""

    def correct(active: Value):
        module.invoke(f, "newton_q")
        s.where(active & (s.safe < 0.5), ok=0.0)

    iterate_newton(module, f, s, s.stepping > 0.5, correct)


def iterate_newton(
    module: Module,
    f: Function,
    s: Lane,
    mask: Value,
    correct: Callable[[Value], None],
    steps: int = NEWTON_STEPS,
    tol: float = NEWTON_TOL,
):
    """Take Newton steps in the lanes of `mask`, at most `steps`, until one changes `state q` by at most `tol`.

    `correct(lanes)` computes `corrected q` from `state q` in the given lanes. Lanes that have not converged stay `iterating`.
    """
    s.iterating = f.select(mask, f.const(1.0, DOUBLE, f.width), 0.0)
    k = f.variable(0, INT, 1)
    with f.while_(lambda: f.any_of(s.iterating > 0.5) & (k.value < steps)):
        active = s.iterating > 0.5
        correct(active)
        change = take_newton_step(module, f, active)
        s.iterating = f.select(active & ~(change <= tol), f.const(1.0, DOUBLE, f.width), 0.0)
        k.value = k.value + 1


def take_newton_step(module: Module, f: Function, active: Value, at: str = "state q", corrected: str = "corrected q") -> Value:
    """Set the array `at` to `corrected` in active lanes; return the largest change, in the scene's own units."""

    def change(r: Value) -> list[Value]:
        old, new = module.vector(f, at, r), module.vector(f, corrected, r)
        module.put(f, at, r, f.select(active, new, old))
        return [f.abs(new - old) * module.vector(f, "inverse unit", r)]

    return module.largest(f, change)


def with_threshold(f: Function, place: int | None, threshold: Value, do: Callable[[], None]):
    """Run `do` with another threshold of pivots, and restore the old one afterwards.

    `place`: the offset of the threshold in `work`; None: the module has no threshold, so that only `do` runs.
    """
    if place is None:
        do()
        return
    before = f.load(f.given["work"], place * f.width, f.width)
    f.store(threshold, f.given["work"], place * f.width, f.width)
    do()
    f.store(before, f.given["work"], place * f.width, f.width)


def is_moving(module: Module, f: Function, s: Lane) -> Value:
    """Return the lanes in which the state moves so fast that usual loads hardly turn its velocity in a singular configuration.

    Rows are left out within a distance from the configuration, their threshold. In the scene's own units, a mechanism with the
    velocity v stays within this distance for the time threshold / v. In this time loads of order one change the velocity by as
    much, which is less than v if v exceeds the root of the threshold.
    """
    fastest = module.largest(f, lambda r: [f.abs(module.vector(f, "state v", r)) * module.vector(f, "inverse unit", r)]) / s.omega
    return fastest * fastest > s.fallback_tol


def velocity_tolerance(module: Module, f: Function, s: Lane, name: str) -> Value:
    """Return the tolerance of the fastest velocity in the array `name`, in the scene's own units."""
    fastest = module.largest(f, lambda r: [f.abs(module.vector(f, name, r)) * module.vector(f, "inverse unit", r)])
    return f.fma(s.rtol, fastest / s.omega, s.atol)


def largest_violation(module: Module, f: Function) -> Value:
    """Return the largest magnitude in the array `psi`, each entry divided by the scale of its row; NaN if any entry is NaN."""
    worst = f.variable(0.0)
    with f.each(module.m) as i:
        x = f.abs(module.entry(f, "psi", i)) / module.entry(f, "rows", i)
        worst.value = f.select((x > worst.value) | x.is_not(x), x, worst.value)
    return worst.value
