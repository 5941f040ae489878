"""The steps of a run with a user-defined stabilization, which may change the rates that are integrated, and the end of a step.

With slip = q' - v, which is zero for most stabilizations, the stages of a step from a point are

    q_i = q + h c_i v + h^2 sum_j (A A)_ij v'_j + h sum_j A_ij slip_j,        v_i = v + h sum_j A_ij v'_j.

The difference of q from the integral of v, `slipped`, is interpolated on its own: the polynomial between points takes v for the
rate of the positions.
"""

from udkjax.native.language.ir import DOUBLE, Function, Value, Variable
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.steps import NODE_COUNT
from udkjax.native.parts.elimination import EliminatedAccelerations
from udkjax.native.parts.own_stabilization import OwnStabilization, StabilizationCode
from udkjax.native.parts.projection import Unprojected, estimate_errors

_LAST_POINT = f"point{NODE_COUNT - 1}"


class Stabilized(Unprojected):
    """No projection: the method integrates the rates of a stabilization, which may also change the state after each step."""

    def __init__(self, module: Module, accelerations: EliminatedAccelerations, code: StabilizationCode):
        super().__init__(module, accelerations)
        self._own, self._changes_rates = OwnStabilization(module, code, accelerations), code.rates is not None
        self.slips = code.slips
        self.programs = list(dict.fromkeys([*self.programs, *self._own.programs]))
        self.shared, self.arrays = (self._own.shared, self._own.arrays) if module.m else ((), ())

    def reserve(self):
        module = self._in
        self._own.reserve()
        if not self._changes_rates:
            return
        names = ["stage0 a", "end a", "present a"]
        module.stage_accelerations[0] = names[0]
        if self.slips:
            module.stage_slips = [f"stage{i} slip" for i in range(module.stages)]
            names += [*module.stage_slips, "end slip", "end slipped"]
            names += [f"point{k} {x}" for k in range(NODE_COUNT) for x in ("slip", "slipped")]
        for name in names:
            module.places.add(name, module.n)

    def write(self):
        self._own.write()

    def begin_step(self, f: Function, s: Lane):
        """Compute the rates at point 3, which may depend on the length of the step that begins there."""
        if not self._changes_rates:
            return
        module = self._in
        begins = self._lanes(f, s.begin > 0.5)
        setattr(s, "state t", getattr(s, f"{_LAST_POINT}_t"))
        with f.each(module.rowcount) as r:
            for x in "qv":
                module.put(f, f"state {x}", r, module.vector(f, f"{_LAST_POINT} {x}", r))
            module.put(f, "stage0 a", r, f.select(begins, 0.0, module.vector(f, "present a", r)))
        self._own.change_rates(f, "stage0 a", "stage0 slip")

    def end_stage(self, f: Function, i: int):
        self._own.change_rates(f, f"stage{i} a", f"stage{i} slip")

    def end_step(self, f: Function, s: Lane):
        module = self._in
        estimate_errors(module, f, s, None, "result dq", "result dv")
        h = module.broadcast(f, s.step)
        if self.slips:
            with f.each(module.rowcount) as r:
                slips = module.weighted_sum(f, module.method.v[-1], r, module.stage_slips)
                before = module.vector(f, f"{_LAST_POINT} slipped", r)
                module.put(f, "end slipped", r, before if slips is None else f.fma(h, slips, before))
        self._own.end_step(f)
        self.accelerate_end(f, s)
        if self._changes_rates:
            module.copy(f, "result a", "end a")
            self._own.change_rates(f, "result a", "end slip")

    def judge(self, f: Function, s: Lane, accept: Value, lost: Variable):
        module = self._in
        if self._changes_rates:
            self._shift(f, s, accept)
        if module.m:
            module.invoke(f, "psi")  # calls of the text may have left that of another state
        super().judge(f, s, accept, lost)

    def _shift(self, f: Function, s: Lane, accept: Value):
        """Move accelerations and slips to the points after an accepted step.

        The accelerations at the end of the step, without stabilization, become `present a`, and point 3 gets the slips there.
        Point 2 gets the rates with which the step began.
        """
        module, before = self._in, f"point{NODE_COUNT - 2}"
        accepted, stepped = (self._lanes(f, x) for x in (accept, accept & (s.begin < 0.5)))
        module.copy(f, "end a", "present a", accepted)
        module.copy(f, "stage0 a", f"{before} a", stepped)
        if not self.slips:
            return
        for x in ("slip", "slipped"):
            for k in range(NODE_COUNT - 1):
                module.copy(f, f"point{k + 1} {x}", f"point{k} {x}", accepted)
            with f.each(module.rowcount) as r:
                new, old = module.vector(f, f"end {x}", r), module.vector(f, f"{_LAST_POINT} {x}", r)
                module.put(f, f"{_LAST_POINT} {x}", r, f.select(stepped, new, f.select(accepted, 0.0, old)))
        module.copy(f, "stage0 slip", f"{before} slip", stepped)

    def _lanes(self, f: Function, mask: Value) -> Value:
        """Return a mask of lanes, repeated to match registers of coordinates."""
        if mask.width == self._in.plan.vector:
            return mask
        return self._in.broadcast(f, f.select(mask, f.const(1.0, DOUBLE, f.width), 0.0)) > 0.5

    def slipped_between(self, f: Function, s: Lane, r: Value) -> Value:
        """Return one register of the differences of q from the integral of v at the time `next`: a cubic in each step."""
        module, found = self._in, None
        for k in range(NODE_COUNT - 1):
            start, end = getattr(s, f"point{k}_t"), getattr(s, f"point{k + 1}_t")
            h = end - start
            x = module.broadcast(f, (s.next - start) / f.select(h > 0.0, h, 1.0))
            a, b, u, w = (module.vector(f, f"point{j} {y}", r) for y in ("slipped", "slip") for j in (k, k + 1))
            h, y = module.broadcast(f, h), 1.0 - x
            cubic = y * y * (a * (x * 2.0 + 1.0) + h * u * x) + x * x * (b * (y * 2.0 + 1.0) - h * w * y)
            found = cubic if found is None else f.select(module.broadcast(f, s.next - start) >= 0.0, cubic, found)
        assert found is not None
        return found
