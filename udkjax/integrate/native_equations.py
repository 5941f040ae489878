"""The equations of motion by machine code, for integrators that are not: accelerations and projections as functions of a state.

They are primitives of JAX with a batching rule. Their derivatives are those of the textbook equations, to any order.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.equations.abstract_system import AbstractSystem, TangentPart, Time, Vector
from udkjax.equations.formulations import WrappedSystem
from udkjax.equations.scales import Scales
from udkjax.equations.textbook import TextbookEquations
from udkjax.integrate.native_engine import formulation_settings, mark_rows, thresholds
from udkjax.integrate.packing import pack
from udkjax.integrate.problem import Problem
from udkjax.native.operations import Accelerate, FindTangentPart, ProjectStates, StateOperation
from udkjax.native.primitive import native_p


class NativeEquations(WrappedSystem):
    """Textbook equations whose accelerations and projections are machine code."""

    equations: TextbookEquations
    marks: Float[Array, "m"] | None  # of independent rows; None: machine code knows them
    formulated: AbstractSystem  # the same, or with the formulation around them
    operation: Accelerate = eqx.field(static=True)

    @property
    def scales(self) -> Scales:
        return self.equations.scales

    def accelerations(self, t: Time, q: Vector, v: Vector) -> Vector:
        return _accelerations(self, t, q, v)

    def project(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        return _project(self, t, q, v)

    def tangent_part(self, t: Time, q: Vector, v: Vector, dq: Vector, dv: Vector) -> TangentPart:
        return TangentPart(*jnp.split(self._find(FindTangentPart, t, q, v, [dq, dv]), 2))

    def is_finite(self, t: Time, q: Vector, v: Vector) -> Bool[Array, ""]:
        return self.equations.is_finite(t, q, v)

    def _find(self, kind: type[StateOperation], t: Time, q: Vector, v: Vector, further: list[Any] | None = None) -> Array:
        operation, equations = kind(self.operation.code, self.operation.pseudoinverse, self.operation.formulation), self.equations
        mechanism, scales = equations.mechanism.at(t), equations.scales
        drop_tol, safe_tol, fallback_tol = thresholds(equations, operation.code.policy)
        gains = [] if equations.baumgarte is None else [equations.baumgarte.alpha, equations.baumgarte.beta]
        marks = [] if self.marks is None else [self.marks]
        numbers = [*mechanism.numbers, *gains, *marks, drop_tol, safe_tol]
        settings = {"length": scales.length, "fallback_tol": fallback_tol, **formulation_settings(self.formulated)}
        ts = jnp.stack([t, t])
        given = pack(operation, numbers, ts, q, v, settings, scales.rows, jnp.zeros(0), jnp, further or [])
        return native_p.bind(*given, operation=operation, times=2)[0][0]


def equations_for_diffrax(problem: Problem) -> AbstractSystem:
    """Return the equations of a problem as an integrator of diffrax's takes them: by machine code, where there is some."""
    evaluation = problem.compiled.plan.evaluation
    if evaluation is None:
        return problem.equations
    textbook = problem.compiled.textbook
    marks = mark_rows(problem.compiled, problem.ts[0], problem.q, problem.v, problem.length, problem.rate)
    return NativeEquations(textbook, marks, problem.equations, evaluation)


@eqx.filter_custom_jvp
def _accelerations(native: NativeEquations, t: Time, q: Vector, v: Vector) -> Vector:
    return native._find(Accelerate, t, q, v)


@_accelerations.def_jvp
def _(primals, tangents):
    plain = lambda native, *state: native.equations.accelerations(*state)  # noqa: E731
    return _accelerations(*primals), eqx.filter_jvp(plain, primals, tangents)[1]


@eqx.filter_custom_jvp
def _project(native: NativeEquations, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    found = jnp.split(native._find(ProjectStates, t, q, v), 2)
    return found[0], found[1]


@_project.def_jvp
def _(primals, tangents):
    native, t, *_ = primals
    projected = _project(*primals)
    correct = lambda native, *state: native.equations.correct(*state)  # noqa: E731
    return projected, eqx.filter_jvp(correct, (native, t, *projected), tangents)[1]
