"""Accelerations by elimination, in programs of the scene."""

from udkjax.native.language.ir import DOUBLE, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.parts import AccelerationPart
from udkjax.pinv.auto import NEAREST


class EliminatedAccelerations(AccelerationPart):
    """Accelerations by the scene's programs, which eliminate the rows of the constraints."""

    measured = "accelerations_and_drift"  # the program of the end of a step that is not projected

    def __init__(self, module: Module):
        self._in = module

    @property
    def programs(self) -> list[str]:
        return [*self._in.solving, *self._in.projection.checks]

    def accelerate(self, f: Function, to: str):
        self._in.invoke(f, "accelerations", to)

    def accelerate_and_measure(self, f: Function):
        self._in.invoke(f, "accelerations_and_drift", "result a")

    def check_pivots(self, f: Function, s: Lane, name: str):
        self._in.fallback.check_pivots(f, s, name)

    def nearest(self, f: Function, s: Lane) -> Value:
        return f.const(NEAREST, DOUBLE, f.width)

    def accelerate_state(self, f: Function, s: Lane):
        self.accelerate(f, "result a")
        self._in.fallback.accelerate_state(f, s)


class ByRows(EliminatedAccelerations):
    """Base of accelerations by a dense pseudoinverse or a formulation, which need Psi_q and M^(-1/2) in memory."""

    measured = "drift"
    arrays = ("psi_q", "root")

    def accelerate_exactly(self, f: Function, to: str):
        self.accelerate(f, to)

    def accelerate_and_measure(self, f: Function):
        self.accelerate(f, "result a")
        self._in.invoke(f, "drift")

    def nearest(self, f: Function, s: Lane) -> Value:
        """Return the distance below which rows are left out: the rank tolerance, or that of elimination if it is smaller."""
        return f.min(super().nearest(f, s), s.fallback_tol)
