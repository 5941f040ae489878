"""The equations of motion by machine code, for integrators in Python: accelerations and projections as functions of a state.

Both functions are primitives of JAX with a batching rule. Their derivatives, of any order, are those of `TextbookEquations`.
"""

from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.annotations import Time, Vector
from udkjax.equations.laws.abstract_system import AbstractSystem, TangentPart
from udkjax.equations.laws.formulations import WrappedSystem
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.programs.scales import Scales
from udkjax.equations.rows.analysis import analyse
from udkjax.equations.states.textbook import TextbookEquations
from udkjax.equations.terms.structure import numbers_as_vector
from udkjax.integrate.compiled_mechanism import CompiledMechanism, compile_concrete, evaluation_of
from udkjax.integrate.native_engine import SceneInputs, mark_rows, scene_inputs
from udkjax.integrate.problem import Problem
from udkjax.native.loaded_code import machine_code
from udkjax.native.operations import Accelerate, StateOperation
from udkjax.native.primitive import native_p
from udkjax.pinv import SVD, OneOf, Pseudoinverse
from udkjax.scene.mechanism import Mechanism
from udkjax.transforms.gradients import stop_gradients


class NativeEquations(WrappedSystem):
    """`TextbookEquations` whose accelerations and projections are computed by machine code."""

    equations: TextbookEquations
    marks: Float[Array, "m"] | None  # of the rows, from `mark_rows`; None if the machine code needs none
    scene: SceneInputs  # at time zero: computed once, not in every step
    operation: Accelerate = eqx.field(static=True)

    @property
    def scales(self) -> Scales:
        return self.equations.scales

    def accelerations(self, t: Time, q: Vector, v: Vector) -> Vector:
        return _accelerations(self, t, q, v)

    def project(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        return _project(self, t, q, v)

    def tangent_part(self, t: Time, q: Vector, v: Vector, dq: Vector, dv: Vector) -> TangentPart:
        return TangentPart(*jnp.split(self._evaluate(self.operation.tangent_part, t, q, v, [dq, dv]), 2))

    def is_finite(self, t: Time, q: Vector, v: Vector) -> Bool[Array, ""]:
        return self.equations.is_finite(t, q, v)

    def _evaluate(self, operation: StateOperation, t: Time, q: Vector, v: Vector, further: Sequence[Any] = ()) -> Array:
        scene = self.scene
        if self.equations.mechanism.samples:
            numbers = [self.equations.mechanism.at(t), self.equations.baumgarte]
            scene = scene._replace(numbers=jax.tree.leaves(numbers))
        inputs = _pack(operation, scene, self.marks, t, q, v, jnp, further)
        return native_p.bind(*inputs, operation=operation, times=2)[0][0]

    @property
    def differentiated(self) -> TextbookEquations:
        """The equations that JAX differentiates: SVD replaces `OneOf`, as all methods have equal derivatives at constant rank."""
        method = self.equations.method
        return (
            replace(self.equations, method=SVD(method.rank_tol, method.relative)) if isinstance(method, OneOf) else self.equations
        )


def native_equations(compiled: CompiledMechanism, marks: Float[Array, "m"] | None) -> NativeEquations:
    """Return the equations by machine code; `marks` are those from `mark_rows`, None if the machine code needs none."""
    operation, textbook = compiled.plan.evaluation, compiled.textbook
    assert operation is not None  # checked by the caller
    scene = scene_inputs(compiled.equations, textbook.mechanism.at(0.0), operation.code.policy)
    scene = scene._replace(numbers=[numbers_as_vector(scene.numbers)])
    return NativeEquations(textbook, marks, stop_gradients(jax.tree.map(jnp.asarray, scene)), operation)


def _pack(
    operation: StateOperation,
    scene: SceneInputs,
    marks: Any,
    t: Any,
    q: Any,
    v: Any,
    xp: ModuleType,
    further: Sequence[Any] = (),
) -> list[Any]:
    """Return the inputs with which an operation evaluates equations at a state; `further` are its own additional inputs."""
    numbers = [*scene.numbers, *([] if marks is None else [marks]), *scene.thresholds]
    return operation.pack(numbers, xp.stack([t, t]), q, v, scene.settings, scene.rows, xp=xp, further=further)


class ConcreteRates:
    """The derivative (v, a) of a state (q, v) of a mechanism of concrete numbers, for integrators outside of JAX.

    Raises:
        ValueError: there is no machine code for the equations.
    """

    def __init__(self, mechanism: Mechanism, method: Pseudoinverse, baumgarte: Baumgarte | None = None):
        compiled = compile_concrete(mechanism, analyse(mechanism), method, baumgarte)
        operation, n = evaluation_of(compiled.equations), mechanism.q0.size
        unknown = operation is not None and operation.code.marks_rows and not operation.code.weighs_rows
        if operation is None or unknown or mechanism.samples:
            raise ValueError(f"there is no machine code for {type(method).__name__} of this mechanism")
        scene = scene_inputs(compiled.equations, compiled.textbook.mechanism, operation.code.policy, np)
        weights = compiled.textbook.scales.weights if operation.code.weighs_rows else None
        inputs = _pack(operation, scene, weights, 0.0, np.zeros(n), np.zeros(n), np)
        self._call = machine_code(operation, 1, 1).prepare(inputs, operation.shapes(inputs, 2))
        self._t, self._q, self._v = (self._call.inputs[operation.input_names.index(name)][0] for name in ("ts", "q", "v"))

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the derivative of y (2n,) at the time t (s)."""
        n = len(self._q)
        self._t[:], self._q[:], self._v[:] = t, y[:n], y[n:]
        return np.concatenate([y[n:], self._call()[0][0]])


def equations_for_diffrax(problem: Problem) -> AbstractSystem:
    """Return the equations of a problem for diffrax to integrate; machine code evaluates them if possible."""
    if problem.compiled.plan.evaluation is None:
        return problem.equations
    marks = mark_rows(problem.compiled, problem.ts[0], problem.q, problem.v, problem.length, problem.rate)
    return native_equations(problem.compiled, marks)


@eqx.filter_custom_jvp
def _accelerations(native: NativeEquations, t: Time, q: Vector, v: Vector) -> Vector:
    return native._evaluate(native.operation, t, q, v)


@_accelerations.def_jvp
def _(primals, tangents):
    plain = lambda native, *state: native.differentiated.accelerations(*state)  # noqa: E731
    return _accelerations(*primals), eqx.filter_jvp(plain, primals, tangents)[1]


@eqx.filter_custom_jvp
def _project(native: NativeEquations, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    projected = jnp.split(native._evaluate(native.operation.projection, t, q, v), 2)
    return projected[0], projected[1]


@_project.def_jvp
def _(primals, tangents):
    native, t, *_ = primals
    projected = _project(*primals)
    correct = lambda native, *state: native.differentiated.correct(*state)  # noqa: E731
    return projected, eqx.filter_jvp(correct, (native, t, *projected), tangents)[1]
