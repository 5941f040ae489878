"""The stages of a singly diagonally implicit Runge-Kutta method for q'' = a(t, q, v), by a simplified Newton method.

With g the diagonal of the tableau, the accelerations a_i of a stage are the solution of

    a_i = a(t_i, q_i, v_i),        q_i = Q_i + h^2 g^2 a_i,        v_i = V_i + h g a_i,

where Q_i and V_i follow from the stages before. A correction d of a_i solves D d = a(t_i, q_i, v_i) - a_i, with the matrix

    D = I - h g a_v - h^2 g^2 a_q,

whose slopes are those at the beginning of the step. If the iteration converges slowly, as it does where the direction of a stiff
force turns, they are those at the latest state, for this stage and for some steps. Columns of D are derivatives along n
directions, as many at a time as there are lanes for them. The correction changes q_i and v_i as well: their rounding errors are
thus those of the state, not those of the accelerations, which a stiff force multiplies. For the same reason the accelerations at
the end of a step are those of its last stage, and not those of the projected state.

The iteration ends when the next correction of the state, from the rate of convergence, is below `STAGE_TOL` of the tolerance. A
lane whose iteration does not converge repeats its step with a shorter one.
"""

import numpy as np

from udkjax.native.language.ir import DOUBLE, INT, Function, Operand, Value
from udkjax.native.module.layout import Lane, Layout
from udkjax.native.module.module import Module
from udkjax.native.module.program_derivative import SLOPES_SUFFIX, ProgramDerivative
from udkjax.native.module.steps import DIVERGING_RATE, EAGER_STEPS, RATE_FADING, RENEWALS, SLOW_RATE, STAGE_ITERATIONS, STAGE_TOL
from udkjax.native.module.tableau import Method
from udkjax.native.pseudoinverses.dense import DenseLayout, DenseMatrices
from udkjax.native.pseudoinverses.lu import OrderedLUCode
from udkjax.native.run.runge_kutta import error_of_velocities, stage_state


class StageEquations:
    """The functions of a module that solve stages, in lanes that are `stepping`.

        take_stages_from_point3(work)    compute the accelerations of all stages of a step of length `step` from point 3
        factor_stage(work)               factorize D, from the slopes at the state
        solve_stage(work)                solve the equations of a stage for `guess a`, and its state

    With `exact`, there is a second matrix D, at the state of each solved stage, for derivatives: by the implicit function theorem
    the derivatives of a_i follow from D at the solution and from the slopes of a, whatever the iteration was. Its functions are

        factor_exact(work)               factorize this matrix
        solve_exact(work)                compute the row `x` = D^(-1) b
        solve_exact_transposed(work)     compute the row `b` = D^(-T) x
    """

    is_cold = False  # whether few runs need the stages, which spend their time in the functions that they call

    def __init__(self, module: Module, method: Method, exact: bool = False):
        self._in, self._method, plan, n = module, method, module.plan, module.n
        lanes = plan.vector if plan.width == 1 and plan.unrolled else plan.width
        self._group = lanes // plan.width  # directions of a tangent
        self._tangent = w = Layout(lanes, plan.vector)
        for name in ("state q", "state v", "slope a"):
            w.add(name, n)
        self._slopes = ProgramDerivative(module, "accelerations", slopes=w)
        p = module.places
        p.add("slopes linearization", self._slopes.stored_size)
        p.add("slope tangent", w.size * self._group)
        begin = p.size
        for name in ("residual a", "guess a", "weight q", "weight v"):
            p.add(name, n)
        self._lu = OrderedLUCode(relative=True)
        shapes = self._lu.matrices(n, n)
        self._layout = DenseLayout(module, shapes | {"kept": (n, n)}, (n, n), "stage")
        self._exact = DenseLayout(module, shapes, (n, n), "exact") if exact else None
        self._reserve()
        module.unused = begin, p.size  # the matrix of a large scene takes more memory than all else
        p.add("cleared")

    def _reserve(self):
        """Hook: a subclass reserves the memory that it needs in addition. Does nothing by default."""

    def write(self):
        """Write all functions of the stage equations."""
        self._slopes.evaluation()
        self._slopes.forward()
        self._write_factor("factor_stage", self._layout, "kept")
        self._write_solve()
        self.write_stages("point3")
        self._write_further()
        if self._exact is None:
            return
        self._write_factor("factor_exact", self._exact, "D")
        for name, solve in (("solve_exact", self._lu.solve), ("solve_exact_transposed", self._lu.solve_transposed)):
            f, _ = self._in.function(name)
            solve(DenseMatrices(self._exact, f))

    def _write_further(self):
        """Hook: a subclass writes the functions that it has in addition. Does nothing by default."""

    def exact(self, f: Function) -> DenseMatrices:
        """Return access, within the function f, to the second matrix, D at a solved stage."""
        assert self._exact is not None
        return DenseMatrices(self._exact, f)

    def _write_factor(self, name: str, layout: DenseLayout, to: str):
        """Write the function `name`: compute D from the slopes at the state, and its LU factors.

        Args:
            name: The name of the function.
            layout: The layout of the matrix and its factors.
            to: The matrix that receives D. If it is "kept", only lanes that are to `renew` D change it; the other lanes factorize
                the old matrix again, with the same result.
        """
        module = self._in
        f, s = module.function(name)
        work, d, lanes = f.given["work"], DenseMatrices(layout, f), self._tangent.width
        tangent = f.given["tangent"] = module.address(f, "slope tangent")
        module.friction.settle(f, "residual a")
        f.call(f"evaluation_{SLOPES_SUFFIX}", work, module.address(f, "residual a"), module.address(f, "slopes linearization"))
        hg = s.step * self._method.diagonal
        of_v = hg if module.plan.width > 1 else f.repeat(hg, lanes) if lanes > 1 else hg
        of_q = of_v * of_v
        with f.each(-(-module.n // self._group)) as group:
            first = group * self._group
            with f.each(self._tangent.size) as k:
                f.store(0.0, tangent, k * lanes, lanes)
            self._seed(f, first, of_q, of_v)
            f.call(f"forward_{SLOPES_SUFFIX}", work, module.address(f, "slopes linearization"), tangent, self._slope_address(f))
            self._enter_columns(f, d, first, to, None if to == "D" else s.renew > 0.5)
        if to != "D":
            with f.each(module.n) as i:
                d.copy(d.row(to, i), d.row("D", i))
        self._lu.factor(d)

    def _place(self, name: str, i: Operand) -> Operand:
        return i * self._tangent.width + self._tangent[name] * self._tangent.width

    def _slope_address(self, f: Function) -> Value:
        return f.at(f.given["tangent"], self._tangent["slope a"] * self._tangent.width)

    def _seed(self, f: Function, first: Value, of_q: Value, of_v: Value):
        """Set the tangents of the state for a group of directions, the columns of D from `first` on.

        Each direction is a unit change of one acceleration of the stage: the coordinate changes by h^2 g^2 (`of_q`) and its
        velocity by h g (`of_v`).
        """
        tangent, lanes, count = f.given["tangent"], self._tangent.width, self._in.n
        if self._group == 1:
            for name, x in (("state q", of_q), ("state v", of_v)):
                f.store(x, tangent, self._place(name, first), lanes)
            return
        with f.each(self._group) as j, f.if_(first + j < count):
            for name, x in (("state q", of_q), ("state v", of_v)):
                f.store(f.lane(x, j), tangent, self._place(name, first + j) + j)

    def _enter_columns(self, f: Function, d: DenseMatrices, first: Value, to: str, mask: Value | None):
        """Store the columns of D from `first` on, as many as a group has, in the matrix `to`.

        Padding after the last column becomes zero. `mask`: the lanes whose matrix changes; None: all lanes.
        """
        tangent, n, lanes = f.given["tangent"], self._in.n, self._tangent.width

        def chosen(new: Value, old: Value) -> Value:
            return new if mask is None else f.select(mask, new, old)

        with f.each(n) as i:
            address, place = d.row(to, i).address, first * f.width
            new = -f.load(tangent, self._place("slope a", i), lanes)
            f.store(chosen(new, f.load(address, place, lanes)), address, place, lanes)
        with f.each(self._group) as j, f.if_(first + j < n):
            row = d.row(to, first + j)
            row.put(first + j, chosen(row.entry(first + j) + 1.0, row.entry(first + j)))

    def _write_solve(self):
        """Write `solve_stage(work)`: correct `guess a` and the state of a stage until the iteration converges.

        It does so in lanes that are `stepping`; lanes that do not converge become `diverged`.
        """
        module = self._in
        f, s = module.function("solve_stage")
        diagonal, width = self._method.diagonal, f.width
        yes, d = f.const(1.0, DOUBLE, width), DenseMatrices(self._layout, f)
        s.iterating, s.size, s.renewals = s.stepping, f.const(np.inf, DOUBLE, width), f.const(0.0, DOUBLE, width)
        k = f.variable(0, INT, 1)
        with f.while_(lambda: f.any_of(s.iterating > 0.5) & (k.value < STAGE_ITERATIONS)):
            module.accelerations.accelerate(f, "residual a")
            module.accelerations.check_pivots(f, s, "residual a")
            self._correct(f, d)
            active, hg = s.iterating > 0.5, module.broadcast(f, s.step * diagonal)

            def change(r: Value, active: Value = active, hg: Value = hg) -> list[Value]:
                step = f.select(active, d.row("x")[r], 0.0)
                module.put(f, "guess a", r, module.vector(f, "guess a", r) + step)
                ratios = []
                for x, size in (("v", hg * step), ("q", hg * (hg * step))):
                    module.put(f, f"state {x}", r, module.vector(f, f"state {x}", r) + size)
                    ratio = f.abs(size) * module.vector(f, f"weight {x}", r)
                    ratios.append(f.select(ratio.is_(ratio), ratio, float("inf")))
                return ratios

            size = module.largest(f, change)
            is_first = s.size.is_(np.inf)
            rate = f.select(is_first, s.contraction, f.max(s.contraction * RATE_FADING, size / f.max(s.size, 1e-300)))
            converged = size * f.min(rate, 1.0) <= STAGE_TOL
            is_slow = active & ~converged & ~is_first & (rate > SLOW_RATE)
            renews = is_slow & (size < float("inf")) & (s.renewals < RENEWALS)
            diverges = ~(size < float("inf")) | (is_slow & (rate > DIVERGING_RATE) & ~renews)
            s.where(active, contraction=f.min(rate, 1.0), size=size, iterations=s.iterations + 1.0)
            s.where(active & diverges & ~converged, diverged=1.0)
            s.iterating = f.select(active & ~converged & ~diverges, yes, 0.0)
            s.renew = f.select(renews, yes, 0.0)
            with f.if_(f.any_of(renews)):
                f.call("factor_stage", f.given["work"])
                s.where(renews, renewals=s.renewals + 1.0, eager=EAGER_STEPS, size=np.inf, contraction=SLOW_RATE)
            k.value = k.value + 1
        s.where(s.iterating > 0.5, diverged=1.0)

    def _correct(self, f: Function, d: DenseMatrices):
        """Compute the row x, the correction of `guess a`, from `residual a`, the accelerations at the state of the stage."""
        module, b = self._in, d.row("b")

        def residual(r: Operand):
            b[r] = module.vector(f, "residual a", f.like(r, INT, 1)) - module.vector(f, "guess a", f.like(r, INT, 1))

        d.over_registers(module.rowcount, residual)
        self._lu.solve(d)

    def _measure_growth(self, f: Function, s: Lane):
        """Hook: update `s.growth`, an estimate of the largest eigenvalue of I - D. Does nothing by default.

        Called in the code of `take_stages_from_point3`, after D has been factorized for the step.
        """

    def write_stages(self, start: str):
        """Write `take_stages_from_<start>(work)`: compute the accelerations of all stages after the first.

        `start`: the name of the point from which the step starts, such as "point3".
        """
        module, method = self._in, self._method
        f, s = module.function(f"take_stages_from_{start}")
        f.cold = self.is_cold
        with f.if_(~f.any_of(s.cleared > 0.5)):
            start_place, end = (place * module.plan.width for place in module.unused)
            with f.each(end - start_place) as k:
                f.store(0.0, f.given["work"], k + start_place)
            s.cleared = f.const(1.0, DOUBLE, f.width)
        s.contraction, s.diverged, s.iterations = f.const(1.0, DOUBLE, f.width), *(f.const(0.0, DOUBLE, f.width),) * 2
        setattr(s, "state t", getattr(s, f"{start}_t"))
        rtol, names = module.broadcast(f, s.rtol), [f"{start} a", *module.stage_accelerations[1:]]
        with f.each(module.rowcount) as r:
            for x in "qv":
                old = module.vector(f, f"{start} {x}", r)
                module.put(f, f"state {x}", r, old)
                module.put(f, f"weight {x}", r, 1.0 / f.fma(rtol, f.abs(old), module.vector(f, f"atol {x}", r)))
        s.renew, s.eager = s.stepping, f.max(s.eager - 1.0, 0.0)
        f.call("factor_stage", f.given["work"])
        if start == "point3":
            self._measure_growth(f, s)
        for i in range(1, method.stages):
            with f.each(module.rowcount) as r:
                guess = module.weighted_sum(f, method.predictor[i], r, names)
                guess = f.const(0.0, DOUBLE, module.plan.vector) if guess is None else guess
                old = module.vector(f, f"stage{i} a", r)
                module.put(f, f"stage{i} a", r, f.select(s.stepping > 0.5, guess, old))
                module.put(f, "guess a", r, guess)
            stage_state(module, f, s, i, start, method=method)
            renews = (s.stepping > 0.5) & (s.eager > 0.0)
            with f.if_(f.any_of(renews)):
                s.renew = f.select(renews, f.const(1.0, DOUBLE, f.width), 0.0)
                f.call("factor_stage", f.given["work"])
            f.call("solve_stage", f.given["work"])
            module.copy(f, "guess a", f"stage{i} a", s.stepping > 0.5)
            if start == "point3":
                module.record_solved_stage(f, s, i)


class StagesOfChosenSteps(StageEquations):
    """The stages of a module that chooses between explicit and implicit steps, with the numbers that this choice needs.

        smooth_error(work)    multiply the error of velocities by D^(-1), where an implicit step is tried

    `growth` is the magnitude of the largest eigenvalue of I - D.
    """

    is_cold = True

    def _reserve(self):
        self._in.places.add("fastest", self._in.n)

    def _write_further(self):
        self._write_smooth_error()

    def _measure_growth(self, f: Function, s: Lane):
        """Update `s.growth` by one step of the power iteration, from the direction `fastest` found in the step before.

        All sums are in the order of the columns, so that results do not depend on the number of lanes.
        """
        module, d = self._in, DenseMatrices(self._layout, f)
        x = d.row("x")
        norms = [f.variable(0.0) for _ in range(2)]
        with f.each(module.n) as i:
            total = f.variable(module.entry(f, "fastest", i))
            with f.each(module.n) as k:
                total.value = f.fma(-d.row("kept", i).entry(k), module.entry(f, "fastest", k), total.value)
            x.put(i, total.value)
            for norm, entry in zip(norms, (total.value, module.entry(f, "fastest", i)), strict=True):
                norm.value = f.max(norm.value, f.abs(entry) * module.entry(f, "inverse unit", i))
        new, old = (norm.value for norm in norms)
        s.growth = new / old
        usable = (new > 0.0) & (new < float("inf"))
        with f.each(module.n) as i:
            unit = 1.0 / module.entry(f, "inverse unit", i)
            module.put_entry(f, "fastest", i, f.select(usable, x.entry(i) / f.select(usable, new, 1.0), unit))

    def _write_smooth_error(self):
        """Write `smooth_error(work)`: the error e of velocities becomes D^(-1) e in lanes that try an implicit step.

        An explicit method at its limit of stability leaves fast motions of the size of the tolerance. An implicit step damps
        them, and their part in its error does not show how long the following steps can be (Hairer and Wanner, IV.8).
        """
        module = self._in
        f, s = module.function("smooth_error")
        d, name = DenseMatrices(self._layout, f), error_of_velocities(module)
        tries = module.broadcast(f, f.select((s.stepping > 0.5) & (s.trial > 0.0), f.const(1.0, DOUBLE, f.width), 0.0)) > 0.5

        def enter(r: Operand):
            d.row("b")[r] = module.vector(f, name, f.like(r, INT, 1))

        d.over_registers(module.rowcount, enter)
        self._lu.solve(d)
        with f.each(module.rowcount) as r:
            module.put(f, name, r, f.select(tries, d.row("x")[r], module.vector(f, name, r)))
