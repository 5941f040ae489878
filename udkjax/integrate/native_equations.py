"""The equations of motion by machine code, for integrators that are not: accelerations and projections as functions of a state.

They are primitives of JAX with a batching rule. Their derivatives are those of the textbook equations, to any order.
"""

from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.equations.abstract_system import AbstractSystem, TangentPart, Time, Vector
from udkjax.equations.analysis import analyse
from udkjax.equations.formulations import WrappedSystem
from udkjax.equations.scales import Scales
from udkjax.equations.structure import numbers_as_vector
from udkjax.equations.textbook import TextbookEquations
from udkjax.equations.udwadia_kalaba import Baumgarte
from udkjax.integrate.compiled_mechanism import compile_known, evaluation_of
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.native_engine import formulation_settings, mark_rows, method_number, thresholds
from udkjax.integrate.packing import pack
from udkjax.integrate.problem import Problem
from udkjax.native.layout import INPUTS
from udkjax.native.operations import Accelerate, FindTangentPart, ProjectStates, StateOperation
from udkjax.native.primitive import machine_code, native_p
from udkjax.pinv import SVD, OneOf, Pseudoinverse
from udkjax.scene.mechanism import Mechanism


class NativeEquations(WrappedSystem):
    """Textbook equations whose accelerations and projections are machine code."""

    equations: TextbookEquations
    marks: Float[Array, "m"] | None  # of independent rows; None: machine code knows them
    formulated: AbstractSystem  # the same, or with the formulation around them
    numbers: Float[Array, "k"]  # all that machine code takes, at the first time: packed once, not in every step
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
        operation = kind(self.operation.code, self.operation.pseudoinverse, self.operation.formulation)
        numbers = self.numbers
        if self.equations.mechanism.samples:
            numbers = _numbers(self.equations, self.marks, operation, t)
        given = _inputs(operation, self.formulated, self.equations, numbers, t, q, v, jnp, further or [])
        return native_p.bind(*given, operation=operation, times=2)[0][0]

    @property
    def differentiated(self) -> TextbookEquations:
        """The equations whose derivatives are taken: of several methods those of singular values, the same at constant rank."""
        method = self.equations.method
        return (
            replace(self.equations, method=SVD(method.rank_tol, method.relative)) if isinstance(method, OneOf) else self.equations
        )


def native_equations(
    equations: TextbookEquations, marks: Float[Array, "m"] | None, formulated: AbstractSystem, operation: Accelerate
) -> NativeEquations:
    """Return equations evaluated by an operation, with marks of independent rows, or None where machine code knows them."""
    return NativeEquations(equations, marks, formulated, _numbers(equations, marks, operation), operation)


def _numbers(equations: TextbookEquations, marks: Any, operation: StateOperation, t: Any = 0.0) -> Any:
    """Return the numbers of a scene at a time, with gains, marks and thresholds, as one vector without derivatives."""
    drop_tol, safe_tol, _ = thresholds(equations, operation.code.policy)
    gains = [] if equations.baumgarte is None else [equations.baumgarte.alpha, equations.baumgarte.beta]
    numbers = [*equations.mechanism.at(t).numbers, *gains, *([] if marks is None else [marks]), drop_tol, safe_tol]
    return stop_gradients(numbers_as_vector(numbers))


def _inputs(
    operation: StateOperation,
    formulated: AbstractSystem,
    equations: TextbookEquations,
    numbers: Any,
    t: Any,
    q: Any,
    v: Any,
    xp: ModuleType,
    further: Sequence[Any] = (),
) -> list[Any]:
    """Return the arrays that machine code takes to evaluate equations at a state."""
    scales, fallback_tol = equations.scales, thresholds(equations, operation.code.policy).fallback_tol
    settings = {"length": scales.length, "fallback_tol": fallback_tol, "method": method_number(equations.method, xp)}
    settings |= formulation_settings(formulated)
    return pack(operation, [numbers], xp.stack([t, t]), q, v, settings, scales.rows, xp.zeros(0), xp, further)


class KnownRates:
    """The derivative (v, a) of a state (q, v) of a mechanism of known numbers, for integrators outside of JAX.

    Raises:
        ValueError: There is no machine code for the equations.
    """

    def __init__(self, mechanism: Mechanism, method: Pseudoinverse, baumgarte: Baumgarte | None = None):
        compiled = compile_known(mechanism, analyse(mechanism), method, baumgarte)
        equations, operation, n = compiled.textbook, evaluation_of(compiled.equations), mechanism.q0.size
        if operation is None or operation.code.marks_rows or mechanism.samples:
            raise ValueError(f"there is no machine code for {type(method).__name__} of this mechanism")
        numbers = np.asarray(_numbers(equations, None, operation))
        given = _inputs(operation, compiled.equations, equations, numbers, 0.0, np.zeros(n), np.zeros(n), np)
        self._call = machine_code(operation, 1, 1).prepare(given, operation.shapes(given, 2))
        self._t, self._q, self._v = (self._call.inputs[INPUTS.index(name)][0] for name in ("ts", "q", "v"))

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the derivative of y (2n,) at the time t (s)."""
        n = len(self._q)
        self._t[:], self._q[:], self._v[:] = t, y[:n], y[n:]
        return np.concatenate([y[n:], self._call()[0][0]])


def equations_for_diffrax(problem: Problem) -> AbstractSystem:
    """Return the equations of a problem as an integrator of diffrax's takes them: by machine code, where there is some."""
    evaluation = problem.compiled.plan.evaluation
    if evaluation is None:
        return problem.equations
    textbook = problem.compiled.textbook
    marks = mark_rows(problem.compiled, problem.ts[0], problem.q, problem.v, problem.length, problem.rate)
    return native_equations(textbook, marks, problem.equations, evaluation)


@eqx.filter_custom_jvp
def _accelerations(native: NativeEquations, t: Time, q: Vector, v: Vector) -> Vector:
    return native._find(Accelerate, t, q, v)


@_accelerations.def_jvp
def _(primals, tangents):
    plain = lambda native, *state: native.differentiated.accelerations(*state)  # noqa: E731
    return _accelerations(*primals), eqx.filter_jvp(plain, primals, tangents)[1]


@eqx.filter_custom_jvp
def _project(native: NativeEquations, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    found = jnp.split(native._find(ProjectStates, t, q, v), 2)
    return found[0], found[1]


@_project.def_jvp
def _(primals, tangents):
    native, t, *_ = primals
    projected = _project(*primals)
    correct = lambda native, *state: native.differentiated.correct(*state)  # noqa: E731
    return projected, eqx.filter_jvp(correct, (native, t, *projected), tangents)[1]
