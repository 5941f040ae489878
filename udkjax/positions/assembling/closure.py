"""Closure of a mechanism as a function of its numbers, by machine code or JAX, with derivatives of any order."""

import operator
from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Float, PyTree

from udkjax.annotations import Number, Time
from udkjax.equations import constraints
from udkjax.equations.programs.scales import Scales
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.rows.position_closure import CLOSURE, Assembly, close_position, damped_step
from udkjax.equations.states.quantities import equations_of
from udkjax.equations.states.textbook import TextbookEquations
from udkjax.pinv import SVD
from udkjax.positions.assembling import native_closing
from udkjax.programs.undefined import defined_along
from udkjax.scene.elements.drivers import Motion
from udkjax.scene.mechanism import Mechanism
from udkjax.transforms.gradients import stop_gradients
from udkjax.transforms.linear_map import DifferentiableFunction, Linear
from udkjax.transforms.traced_numbers import Mask, TreeOfNumbers, select, split_numbers

Closed = Assembly[Array]
NativeGuess = tuple[Mechanism, Scales, Array, Array, Array]  # mechanism, scales, t, q, v


class MotionFrom(Motion):
    """The motion law t -> motion(start + t); machine code has derivatives with respect to the number `start` (s), but not t."""

    motion: Motion
    start: Number

    def __call__(self, t):
        return self.motion(self.start + t)


def from_moment(mechanism: Mechanism, t: Float[Array, ""]) -> Mechanism:
    """Return a mechanism whose drivers have, at time zero, the values that they had at time t."""
    if not mechanism.drivers:
        return mechanism
    motions = lambda x: [driver.motion for driver in x.drivers.values()]  # noqa: E731
    return eqx.tree_at(motions, mechanism, [MotionFrom(motion, t) for motion in motions(mechanism)])


class TracedRows(NamedTuple):
    """The constraints of a mechanism with traced numbers, in the interface `Rows` with which `close_position` closes them."""

    equations: TextbookEquations

    @classmethod
    def of(cls, mechanism: Mechanism, analysis: Analysis) -> "TracedRows":
        """Return the constraints of a mechanism, with the scales of its analysis."""
        return cls(equations_of(mechanism, SVD(), analysis=analysis))

    @property
    def scales(self) -> Scales:
        return self.equations.scales

    def residual(self, t: Time, q: Array) -> Array:
        return constraints.psi(self.equations.mechanism, t, q) / self.scales.rows

    def correction(self, t: Time, q: Array) -> Array:
        plus, psi, root = self.equations.linearized_position(t, q)
        return -root * (plus @ psi)

    def project(self, t: Time, q: Array, v: Array) -> tuple[Array, Array]:
        """Return v after a Newton step towards Psi_dot = 0, and the rank of D."""
        plus, residual, root = self.equations.linearized_velocity(t, q, v)
        return v - root * (plus @ residual), plus.rank


def close_by_jax(mechanism: Mechanism, analysis: Analysis, t: Float[Array, ""], q: Float[Array, "n"], v: Array) -> Closed:
    """Return q and v of the closed state near a guess, the residuals Psi and Psi_dot, and the rank of D."""
    rows, rank = TracedRows.of(mechanism, analysis), 0
    if mechanism.constraints:
        q = _close_position(rows, t, q)
        for _ in range(CLOSURE.velocities):
            v, rank = rows.project(t, q, v)
    return q, v, *rows.equations.violation(t, q, v), rank


def close_by_machine_code(
    mechanism: Mechanism, analysis: Analysis, t: Float[Array, ""], q: Float[Array, "n"], v: Array
) -> Closed:
    """Return the same results as `close_by_jax`, computed by machine code."""
    guess, inputs = split_numbers((_with_fixed_loads(mechanism), analysis, t, q, v))
    return _close_by_code(AssemblyFunction(guess), inputs)


def _with_fixed_loads(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism without derivatives with respect to its loads, on which a closed state does not depend.

    Derivatives with respect to these alone then need no machine code for closing.
    """
    loads = lambda m: [m.gravity, *m.forces.values()]  # noqa: E731
    return eqx.tree_at(loads, mechanism, stop_gradients(loads(mechanism)))


class AssemblyFunction(DifferentiableFunction):
    """q and v of a closed state as a function of the numbers of a guess: a mechanism, its analysis, and t, q and v."""

    guess: TreeOfNumbers

    @property
    def orders(self) -> int:
        return 2 if self._has_second else 1

    @property
    def _has_second(self) -> bool:
        """True if machine code has second derivatives, for which no rows may contradict each other off the manifold."""
        return self.guess.rest[1].redundant_rows == ()

    def __call__(self, inputs: list[Array]) -> list[Array]:
        mechanism, analysis, t, q, v = self.guess(inputs)
        if not mechanism.constraints:
            return [q, v]
        rows = TracedRows.of(mechanism, analysis)
        q = _close_position_plain(rows, t, q)
        return [q, rows.project(t, q, v)[0]]  # a second projection would remove rounding errors

    def shapes(self, inputs: list[Array]) -> list[tuple[int, ...]]:
        *_, q, v = self.guess(inputs)
        return [q.shape, v.shape]

    def forward(self, inputs: list[Array], has_tangent: Mask, tangents: list[Array], run: PyTree) -> list[Array]:
        guess, which = self._native(inputs, has_tangent)
        if guess is None:
            return super().forward(inputs, has_tangent, tangents, run)
        change = self.guess.changes(has_tangent, tangents)
        return list(native_closing.close_jvp(guess, _native_inputs(which), _native_inputs(change)))

    def backward(self, inputs: list[Array], has_tangent: Mask, cotangents: list[Array], run: PyTree) -> list[Array]:
        guess, which = self._native(inputs, has_tangent)
        if guess is None:
            return super().backward(inputs, has_tangent, cotangents, run)
        found = native_closing.close_vjp(guess, _native_inputs(which), *cotangents)
        pairs = zip(*(jax.tree.leaves(tree, is_leaf=lambda x: x is None) for tree in (_native_inputs(which), found)), strict=True)
        return [bar for m, bar in pairs if m is True]

    def twice(
        self, inputs: list[Array], active: Mask, tangents: list[Array], others: Mask, other_tangents: list[Array]
    ) -> list[Array]:
        guess, which = self._native(inputs, tuple(map(operator.or_, active, others)))
        if guess is None or not self._has_second:
            return super().twice(inputs, active, tangents, others, other_tangents)
        changes = (
            (_native_inputs(self.guess.marks(mask)), _native_inputs(self.guess.changes(mask, dxs)))
            for mask, dxs in ((active, tangents), (others, other_tangents))
        )
        return list(native_closing.second_derivative(guess, _native_inputs(which), *changes))

    def _native(self, inputs: list[Array], has_tangent: Mask) -> tuple[NativeGuess, PyTree] | tuple[None, None]:
        """Return the arguments of machine code, and the guess with True for the inputs that have tangents.

        Both are None if machine code has no derivatives with respect to one of these inputs.
        """
        which = self.guess.marks(has_tangent)
        mechanism, analysis, t, q, v = self.guess(inputs)
        others = any(m is True for m in jax.tree.leaves((which[1], which[2])))
        if others or not native_closing.can_close(mechanism):
            return None, None
        return (mechanism, analysis.scales, t, q, v), which


def _native_inputs(tree: PyTree) -> PyTree:
    """Return the mechanism, q and v of a guess: the inputs along which machine code has derivatives."""
    mechanism, _, _, q, v = tree
    return mechanism, q, v


@eqx.filter_custom_jvp
def _close_by_code(function: AssemblyFunction, inputs: list[Array]) -> Closed:
    mechanism, analysis, t, q, v = function.guess(inputs)
    return native_closing.close(mechanism, analysis.scales, t, q, v)


@_close_by_code.def_jvp
def _(primals, tangents):
    function, inputs = primals
    found = _close_by_code(function, inputs)
    has_tangent = tuple(dx is not None for dx in tangents[1])
    if not any(has_tangent):
        return found, (None,) * len(found)
    linear = Linear(function=function, inputs=inputs, run=(), active=has_tangent)
    return found, (*defined_along(linear.applied, select(tangents[1], has_tangent), found[:2]), None, None, None)


@jax.custom_jvp
def _close_position(rows: TracedRows, t: Array, q: Array) -> Array:
    return close_position(rows, t, q)


def _close_position_plain(rows: TracedRows, t: Array, q: Array) -> Array:
    """Return the position after the steps of `_close_position`, taken in a loop of fixed length, for reverse mode.

    Even steps that no longer lower the residual are taken: at a closed state they only project the tangent to the manifold.
    """

    def body(q, _):
        return damped_step(rows, t, q, goes_on=True)[0], None

    return jax.lax.scan(body, q, None, length=CLOSURE.steps)[0]


@_close_position.defjvp
def _(primals, tangents):
    _, tangent = jax.jvp(_close_position_plain, primals, tangents)
    return _close_position(*primals), tangent
