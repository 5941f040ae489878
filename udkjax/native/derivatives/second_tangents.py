"""Second derivatives of a trajectory in forward mode, along pairs of directions, computed with each step."""

from udkjax.expressions.loops.loop_derivative import TWICE
from udkjax.native.derivatives.saltation import add_memory, write_saltation
from udkjax.native.derivatives.tangents import Forward
from udkjax.native.language.ir import BOOL, Function, Value
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.module.program_derivative import WAYS
from udkjax.native.module.steps import ACROSS_EDGE


class ForwardTwice(Forward):
    """A trajectory with its second derivatives along pairs of directions.

    Second derivatives are the same sums over stages, ends of steps and outputs; the programs of accelerations and projections
    compute them together with the tangents along either direction.

    They become NaN where a step by the fallback leaves unbounded loads of joints out of their friction. Near the singular
    configuration such a load is c / d, with the distance d, and a run omits it within a range of distances. But steps are not
    differentiated: if a change of the run moves the configuration by x, the ends of the range do not move with it, and the second
    derivatives of log d at the two ends, -(x / d)^2, are missing. This error does not decrease with the steps. They also become
    NaN where a load that depends on time changes its sign: the jump (saltation.py) is that of a surface at rest.
    """

    mode = TWICE
    ways = WAYS

    def __init__(self, plan: Plan, active: tuple[bool, ...], lanes: int):
        super().__init__(plan, active, lanes)
        if self.pieces:
            add_memory(self)

    def write_derivatives(self):
        super().write_derivatives()
        if self.pieces:
            write_saltation(self)

    def _finish_change(self, f: Function, s: Lane, accept: Value):
        lost = f.const(False, BOOL, f.width)
        lost = self.fallback.with_lost_loads(s, accept, lost)
        if self.edges and "t" in self.code.of(*self.programs["accelerations"].outputs).arrays:
            lost = lost | (accept & s.crosses.is_(ACROSS_EDGE))
        if self.friction.settles:
            with f.if_(f.any_of(lost)):
                self._lose(f, lost)
        if self.pieces:
            with f.if_(f.any_of(accept & (s.crosses > 0.5))):
                f.call("along_motion", f.given["work"])
                with self._each_group(f):
                    f.call("jump", f.given["work"], f.given["tangent"])

    def _lose(self, f: Function, lanes: Value):
        """Set the second derivatives of the state at the end of a step to NaN in some lanes."""
        for name in ("result q", "result v"):
            with self._each_group(f), self._in_way(f, self.ways[-1]), f.each(self.registers("tangent")) as r:
                self.put(f, name, r, f.select(lanes, float("nan"), self.vector(f, name, r, "tangent")), "tangent")

    def _project_end(self, f: Function, begin: Value):
        # From a state off the manifold, one Newton step is exact to first order, two steps to second order. Only the initial
        # state may be off the manifold.
        super()._project_end(f, begin)
        with f.if_(f.any_of(begin)):
            super()._project_end(f, begin)
