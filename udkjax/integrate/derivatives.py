"""Derivatives of a run, forward and reverse, of any order.

A run is a function x -> f(x) of its numbers. Its first derivatives, forward x' -> J x' and reverse w -> J^T w, are computed by
machine code if possible, else by diffrax. Together they are one primitive of JAX, a linear map with its transpose
(linear_map.py), so JAX never transposes a derivative operation by operation.
"""

import operator
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array

from udkjax.integrate import native_engine
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.integrate.time_derivatives import run_of_times
from udkjax.programs.undefined import defined_along
from udkjax.transforms.gradients import stop_gradients
from udkjax.transforms.linear_map import DifferentiableFunction, Linear, change_along
from udkjax.transforms.split_jvp import split_jvp
from udkjax.transforms.traced_numbers import Mask, TreeOfNumbers, replaced, select, split_numbers

CONTROLLER_NUMBERS = ("rtol", "atol", "smallest", "h")  # of `Problem`: the numbers of the step controller
SMOOTH_FIELDS = tuple(IntegratorOutput._fields.index(name) for name in ("q", "v", "y"))  # indices of fields with derivatives


def differentiable(problem: Problem, has_fixed_times: bool = False) -> IntegratorOutput:
    """Integrate a problem by machine code or with diffrax, with derivatives of any order of q, v and y.

    There are no derivatives with respect to the numbers of the step controller: the sizes of steps are held constant.

    Args:
        problem: the problem.
        has_fixed_times: whether `problem.ts`, although traced, needs no derivatives: it was concrete when `simulate` was called.
    """
    control = {name: stop_gradients(getattr(problem, name)) for name in CONTROLLER_NUMBERS}
    problem = replace(problem, **control)
    has_varying_times = isinstance(problem.ts, Tracer) and not has_fixed_times
    return run_of_times(_integrate, problem) if has_varying_times else _integrate(problem)


def _integrate(problem: Problem) -> IntegratorOutput:
    restore, inputs = split_numbers(problem)
    return _run(DifferentiableRun(restore, problem.compiled.plan.is_native), inputs)


@eqx.filter_custom_jvp
def _run(function: "DifferentiableRun", inputs: list[Array]) -> IntegratorOutput:
    return function.fast(inputs)


@_run.def_jvp
def _(primals, tangents):
    active = tuple(dx is not None for dx in tangents[1])
    if not any(active):
        return _run(*primals), IntegratorOutput._make([None] * len(IntegratorOutput._fields))
    shapes = eqx.filter_eval_shape(_run, *primals)

    def in_parts(at: Any, direction: list[Array]) -> tuple[list[Any], list[Any]]:
        """Return the run, and its change along the direction as a linear map, which JAX can transpose for reverse mode."""
        raw, recorded = at[0].recorded(stop_gradients(at[1]), active)
        linear = Linear(function=at[0], inputs=at[1], run=recorded, active=active)
        return list(_as_run(*at, raw)), defined_along(linear.applied, direction, [raw[k] for k in SMOOTH_FIELDS])

    def at_once(at: Any, direction: list[Array]) -> tuple[list[Any], list[Any]]:
        """Return the run, and its change along the direction, both computed in one run of forward mode."""
        function, inputs = at
        raw, change = function.run_and_jvp(inputs, active, direction)
        return list(raw), [jnp.where(jnp.isnan(raw[k]), jnp.nan, dx) for k, dx in zip(SMOOTH_FIELDS, change, strict=True)]

    known = list(shapes), [shapes[k] for k in SMOOTH_FIELDS]
    raw, change = split_jvp(in_parts, at_once, primals, select(tangents[1], active), known)
    return IntegratorOutput(*raw), IntegratorOutput._make(
        change[SMOOTH_FIELDS.index(k)] if k in SMOOTH_FIELDS else None for k in range(len(raw))
    )


@eqx.filter_custom_jvp
def _as_run(function: "DifferentiableRun", inputs: list[Array], raw: IntegratorOutput) -> IntegratorOutput:
    """Return `raw`, the results of a run, with the derivatives of that run attached."""
    del function, inputs
    return raw


@_as_run.def_jvp
def _(primals, tangents):
    *at, raw = primals
    if all(dx is None for dx in tangents[1]):
        return raw, IntegratorOutput._make([None] * len(raw))
    return raw, eqx.filter_jvp(_run, tuple(at), tuple(tangents[:2]))[1]


class DifferentiableRun(DifferentiableFunction):
    """A run as a function from the numbers of a problem to [q, v, y]: the states at the output times and at the end.

    Third and higher derivatives are computed by diffrax.
    """

    problem: TreeOfNumbers
    native: bool = eqx.field(static=True)

    @property
    def orders(self) -> int:
        plan = self.problem.rest.compiled.plan
        operation = plan.operation if self.native and plan.differentiates else None
        return 0 if operation is None else 1 if operation.sampled else 2

    def fast(self, inputs: list[Array]) -> IntegratorOutput:
        """Return the run without derivatives: by machine code if it can integrate the problem, else by diffrax."""
        problem = self.problem(inputs)
        return native_engine.integrate(problem) if self.native else integrate_by_diffrax(problem)

    def forward(self, inputs: list[Array], active: Mask, tangents: list[Array], run: Any) -> list[Array]:
        del run
        return self.run_and_jvp(inputs, active, tangents)[1]

    def backward(self, inputs: list[Array], active: Mask, cotangents: list[Array], run: Any) -> list[Array]:
        problem, mask = self.problem(inputs), self.problem.marks(active)
        if self._is_native(inputs, active):
            run = self.recorded(inputs, active)[1] if run is None else run
            q, v, y = cotangents
            gradient = native_engine.vjp(problem, mask, run, jnp.concatenate([q, v], axis=1), y)
            pairs = zip(*(jax.tree.leaves(tree, is_leaf=lambda x: x is None) for tree in (mask, gradient)), strict=True)
            return [bar for m, bar in pairs if m is True]
        if run is None:
            return self.pull(inputs, active, cotangents)

        def function(active_inputs: list[Array]) -> list[Array]:
            raw = integrate_by_diffrax(self.problem(replaced(inputs, active, active_inputs)), "RecursiveCheckpointAdjoint")
            return [raw[k] for k in SMOOTH_FIELDS]

        return jax.vjp(function, select(inputs, active))[1](cotangents)[0]

    def twice(
        self, inputs: list[Array], active: Mask, tangents: list[Array], others: Mask, other_tangents: list[Array]
    ) -> list[Array]:
        either, problem = tuple(map(operator.or_, active, others)), self.problem(inputs)
        mask = self.problem.marks(either)
        moves_samples = any(x is True for x in jax.tree.leaves(mask.textbook.mechanism.samples))
        if moves_samples or not self._is_native(inputs, either):  # splines are not linear in their knots
            return super().twice(inputs, active, tangents, others, other_tangents)
        self._require(not self.problem.rest.compiled.plan.has_timed_pieces, 2, "of pieces that depend on time")
        changes = (
            (self.problem.marks(mask), self.problem.changes(mask, dxs))
            for mask, dxs in ((active, tangents), (others, other_tangents))
        )
        return list(native_engine.second_derivative(problem, mask, *changes))

    def require_order(self, order: int) -> None:
        self._require(order <= self.problem.rest.compiled.plan.orders_by_diffrax, order, "by diffrax")

    def _require(self, is_right: bool, order: int, how: str) -> None:
        if not is_right:
            raise NotImplementedError(
                f"derivatives of order {order} {how} lack the jumps where a smooth piece of a constraint or a force ends, "
                "such as the knots of a cam: take differences of derivatives of the first order"
            )

    def run_and_jvp(self, inputs: list[Array], active: Mask, tangents: list[Array]) -> tuple[IntegratorOutput, list[Array]]:
        """Return the run and the change of its states along tangents of the active inputs, by machine code if possible."""
        if self._is_native(inputs, active):
            change = self.problem.changes(active, tangents)
            raw, changes = native_engine.jvp(self.problem(inputs), self.problem.marks(active), change)
            return self._own(inputs, raw), list(changes)
        raw, change = change_along(lambda inputs: integrate_by_diffrax(self.problem(inputs)), inputs, active, tangents)
        return raw, [change[k] for k in SMOOTH_FIELDS]

    def recorded(self, inputs: list[Array], active: Mask) -> tuple[IntegratorOutput, "native_engine.RecordedRun | tuple[()]"]:
        """Return the run, and its record for reverse mode by machine code; the record is () if diffrax integrates.

        The machine code of reverse mode computes both, so that no other code has to be compiled.
        """
        if self._is_native(inputs, active):
            raw, run = native_engine.integrate_for_vjp(self.problem(inputs), self.problem.marks(active))
            return self._own(inputs, raw), run
        return integrate_by_diffrax(self.problem(inputs)), ()

    def _own(self, inputs: list[Array], raw: IntegratorOutput) -> IntegratorOutput:
        """Return the output of a run by its own formulation; `raw` may be by that of its derivatives (`RunStates.closes`)."""
        operation = self.problem.rest.compiled.plan.operation
        return self.fast(inputs) if operation is not None and operation.closes else raw

    def _is_native(self, inputs: list[Array], active: Mask) -> bool:
        is_able = self.native and self.problem.rest.compiled.plan.differentiates
        return is_able and native_engine.serves_derivatives(self.problem.marks(active))

    def __call__(self, inputs: list[Array]) -> list[Array]:
        raw = integrate_by_diffrax(self.problem(inputs))
        return [raw[k] for k in SMOOTH_FIELDS]

    def shapes(self, inputs: list[Array]) -> list[tuple[int, ...]]:
        problem = self.problem(inputs)
        (times,), (n,) = problem.ts.shape, problem.q.shape
        return [(times, n), (times, n), (2 * n,)]


def integrate_by_diffrax(problem: Problem, adjoint: Any = "ForwardMode", meter: Any = None) -> IntegratorOutput:
    """Integrate by diffrax (diffrax_engine.py), which is imported only here: its import takes as long as that of JAX.

    Args:
        problem: the problem.
        adjoint: an adjoint of diffrax, the name of its class, or None for the engine's default.
        meter: a progress meter of diffrax, or None.
    """
    import diffrax

    from udkjax.integrate import diffrax_engine

    chosen = getattr(diffrax, adjoint)() if isinstance(adjoint, str) else adjoint
    return diffrax_engine.integrate_by_diffrax(problem, chosen, meter)
