"""Derivatives of the positions of a driven mechanism, q(s), q' and q'', by the values and by all numbers of the mechanism.

In a generic configuration they are the derivatives of one step of Newton's method. Where branches meet, Psi_q loses rank, and a
change p of a number of the constraints changes q(s) near the value s* of the meeting by

    dq/dp = R / (s - s*) + a smooth part.

If the residue R is zero, the smooth part is the derivative of the branch; otherwise the branches separate, by the square root of
the change, and no derivative exists. Both parts are interpolated from points of the branch on both sides (crossing.py). R is
linear in the change:
numbers that each separate the branches, such as the lengths of two equal cranks, may not do so if changed together. Forward mode
returns the derivative along such a change; reverse mode, which treats each number alone, returns NaN.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.core
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from udkjax.annotations import TimeSeries
from udkjax.native.host.host_function import call_seldom
from udkjax.pinv.linear_primitive import linear_primitive
from udkjax.positions.following.continuation import Points
from udkjax.positions.following.crossing import FARTHEST_NODE, nodes, weights
from udkjax.positions.following.curve import Curve
from udkjax.programs.control_flow import sequential
from udkjax.programs.undefined import defined_along
from udkjax.programs.varying_axes import result_type
from udkjax.transforms.gradients import stop_gradients

# Bound on residues, relative to the largest (s - s*) dq/dp: smaller ones are rounding errors, amplified by E^+ up to 100 times.
RESIDUE_TOL = 1e-6
# Largest number of meetings in one call; at further ones, derivatives with respect to numbers of the constraints are NaN.
MOST_MEETINGS = 8

Three = tuple[TimeSeries, TimeSeries, TimeSeries]  # of q, q' and q''


def with_derivatives(curve: Curve, values: Float[Array, "T"], points: Points, regular: Bool[Array, "T"]) -> Three:
    """Return closed positions, q' and q'', with their derivatives with respect to the values and the numbers of the mechanism.

    Where branches meet (not `regular`), second derivatives are NaN.
    """
    return _with_derivatives(curve, values, *points[:3], points.dddq, points.spacing, regular)


@eqx.filter_custom_jvp
def _with_derivatives(curve, values, q, dq, ddq, dddq, spacing, regular) -> Three:
    return q, dq, ddq


@_with_derivatives.def_jvp
def _(primals, tangents):
    curve, values, *_, dddq, spacing, regular = primals
    found = _with_derivatives(*primals)
    moved, ds = tangents[:2]
    zeros = jax.tree.map(jnp.zeros_like, eqx.filter((curve, values), eqx.is_inexact_array))
    changes, changed = jax.tree.flatten(eqx.combine(tangents[:2], zeros))

    def regular_change(value: Array, at: tuple[Array, Array, Array], *ds: Array) -> list[Array]:
        """Return the changes of q, q' and q'' at one value; they are NaN where the positions `at` it are NaN."""

        def along(directions: list[Array]) -> Sequence[Array]:
            moving = jax.tree.unflatten(changed, directions)
            return eqx.filter_jvp(lambda curve, s: _newton(curve, s, at[0]), (curve, value), moving)[1]

        return defined_along(along, [*changes[:-1], *ds], at)

    at_regular = jax.vmap(regular_change)(values, found, changes[-1])
    at_meetings = _by_numbers(curve, values, found, spacing, regular, moved)
    if ds is not None:
        third = jnp.where(regular[:, None] | (spacing[:, None] > 0), dddq, jnp.nan)
        along = found[1], found[2], third + _ends_here(jnp.where(regular, 0.0, jnp.nan), curve, values)[:, None]
        at_meetings = tuple(x + y * ds[:, None] for x, y in zip(at_meetings, along, strict=True))
    return found, tuple(jnp.where(regular[:, None], x, y) for x, y in zip(at_regular, at_meetings, strict=True))


def _by_numbers(
    curve: Curve, values: Float[Array, "T"], found: Three, spacing: Float[Array, "T"], regular: Bool[Array, "T"], moved: Any
) -> Three:
    """Return the changes of q, q' and q'' with changes of numbers of the constraints, where branches meet; zero elsewhere."""
    changes = jax.tree.leaves(_constraints(moved.mechanism))
    zero = jnp.zeros_like(found[0])
    if not changes:
        return zero, zero, zero
    active = jax.tree.map(lambda x: x is not None, _constraints(moved.mechanism), is_leaf=lambda x: x is None)
    meetings = jnp.flatnonzero(~regular, size=min(MOST_MEETINGS, len(values)), fill_value=0)
    arguments = curve, values[meetings], tuple(x[meetings] for x in found), spacing[meetings], ~regular[meetings]
    operator = sequential(_matrices, *stop_gradients(arguments), active)
    change = jnp.concatenate([jnp.ravel(x) for x in changes])
    at_meetings = _bind(_Operator(*operator), change).reshape(len(meetings), 3, -1)
    is_missed = jnp.where(regular, 0.0, jnp.nan).at[meetings].set(0.0)
    nan_factor = is_missed + _ends_here(jnp.where(regular, 0.0, jnp.nan), curve, values)
    return tuple(zero.at[meetings].add(at_meetings[:, k]) + (nan_factor * jnp.sum(change))[:, None] for k in range(3))


def _constraints(mechanism: Any) -> list[Any]:
    return [*mechanism.joints.values(), *mechanism.drivers.values()]


def _matrices(
    curve: Curve, values: Array, found: Three, spacing: Array, counts: Array, active: PyTree
) -> tuple[Float[Array, "K 3 n P"], Float[Array, "K P n"]]:
    """Return the derivatives of q, q' and q'' by P numbers where branches meet, and the residues R, zero if they are rounding.

    Args:
        curve: the positions.
        values: K values at which branches meet.
        found: q, q' and q'' at these values.
        spacing: spacing of the neighbouring points of the branch; zero without neighbours.
        counts: mask of the values that are meetings.
        active: mask of the leaves of joints and drivers that are the P numbers.
    """
    chosen = jax.tree.leaves(eqx.filter(_constraints(curve.mechanism), active))
    K, n, P = len(values), curve.units.size - 1, sum(x.size for x in chosen)
    nothing = jnp.zeros((K, 3, n, P)), jnp.zeros((K, P, n))
    arguments = curve, values, found, spacing, active
    matrix, residue = jax.lax.cond(jnp.any(counts), lambda: call_seldom(_at_meetings, *arguments), lambda: nothing)
    return jnp.where(counts[:, None, None, None], matrix, 0.0), jnp.where(counts[:, None, None], residue, 0.0)


def _at_meetings(curve: Curve, values: Array, found: Three, spacing: Array, active: PyTree) -> tuple[Array, Array]:
    """Return the results of `_matrices` for values at which branches meet; NaN where there are no neighbouring points."""
    W, unit, steps = curve.units[:-1], curve.units[-1], nodes(FARTHEST_NODE)
    chosen, rest = eqx.partition(_constraints(curve.mechanism), active)
    numbers, unravel = ravel_pytree(chosen)
    offset = spacing[:, None] * steps  # scaled
    s = values[:, None] + offset * unit

    def closed(s: Array, ds: Array, q: Array, dq: Array, ddq: Array) -> tuple[Array, Array]:
        return curve.correct(jnp.append(q + ds * dq + 0.5 * ds**2 * ddq, s) / curve.units, fixed=True)

    X, is_closed = jax.vmap(jax.vmap(closed, (0, 0, None, None, None)))(s, offset * unit, *found)
    q = X[..., :-1] * W

    def moved(numbers: Array) -> list[Array]:
        varied = eqx.combine(unravel(numbers), rest)
        varied_curve = eqx.tree_at(lambda c: _constraints(c.mechanism), curve, varied)
        derivatives = jax.vmap(jax.vmap(lambda s, q: _newton(varied_curve, s, q)))(s, q)
        return [x / W * unit**k for k, x in enumerate(derivatives)]

    changes = jax.jacfwd(moved)(numbers)  # (K, 12, n, P) each
    ends = offset[:, :, None, None] * changes[0]
    size, residue = jnp.max(jnp.abs(ends), (1, 2)), jnp.einsum("j,kjnp->kpn", weights(FARTHEST_NODE), ends)
    residue = jnp.where(jnp.abs(residue) > RESIDUE_TOL * size[..., None], residue, 0.0)
    smooth = jnp.stack([jnp.einsum("j,kjnp->knp", weights(FARTHEST_NODE), x) / unit**k for k, x in enumerate(changes)], 1)
    usable = jnp.all(is_closed, 1) & (spacing > 0)
    return jnp.where(usable[:, None, None, None], smooth * W[:, None], jnp.nan), residue


class _Operator(eqx.Module):
    """The linear map from changes of the numbers to changes of the positions, with its transpose."""

    matrix: Float[Array, "K 3 n P"]
    residue: Float[Array, "K P n"]
    is_transposed: bool = eqx.field(static=True, default=False)


def _apply(operator: _Operator, vector: Array) -> Array:
    matrix, residue = operator.matrix, operator.residue
    if operator.is_transposed:
        out = vector.reshape(matrix.shape[:3])
        wanted = jnp.any(out != 0, (1, 2))
        separates = jnp.any(wanted[:, None] & jnp.any(residue != 0, 2), 0)
        cotangent = jnp.einsum("kinp,kin->p", jnp.where(wanted[:, None, None, None], matrix, 0.0), out)
        return jnp.where(separates, jnp.nan, cotangent)
    used = jnp.where(vector != 0, matrix, 0.0)
    total, terms = (jnp.einsum("kpn,p->kn", x, y) for x, y in ((residue, vector), (jnp.abs(residue), jnp.abs(vector))))
    separates = jnp.any(jnp.abs(total) > RESIDUE_TOL * jnp.max(terms, 1, keepdims=True), 1)
    return jnp.where(separates[:, None, None], jnp.nan, jnp.einsum("kinp,p->kin", used, vector)).ravel()


@eqxi.filter_primitive_def
def _shape(operator, vector):
    K, three, n, P = operator.matrix.shape
    return result_type((P if operator.is_transposed else K * three * n,), jax.tree.leaves((operator, vector)), vector.dtype)


@eqxi.filter_primitive_jvp
def _derivative(primals, tangents):
    operator, vector = primals
    change = jnp.zeros_like(vector) if tangents[1] is None else tangents[1]
    return _bind(operator, vector), _bind(operator, change)


@eqxi.filter_primitive_transpose(materialise_zeros=True)  # pyright: ignore
def _transpose(inputs, cotangent):
    operator, _ = inputs
    transposed = _Operator(operator.matrix, operator.residue, not operator.is_transposed)
    return jax.tree.map(lambda _: None, operator), _bind(transposed, cotangent)


_moving_p = linear_primitive("where_branches_meet", _apply, _shape, _derivative, _transpose)


def _bind(operator: _Operator, vector: Array) -> Array:
    return eqxi.filter_primitive_bind(_moving_p, operator, vector)


@eqx.filter_custom_jvp
def _ends_here(factor: Float[Array, "T"], curve: Curve, values: Float[Array, "T"]) -> Float[Array, "T"]:
    """Return zeros whose derivatives with respect to all numbers of the curve and all values are `factor`, which is 0 or NaN."""
    return jnp.zeros_like(factor)


@_ends_here.def_jvp
def _(primals, tangents):
    total = sum((jnp.sum(x) for x in jax.tree.leaves(tangents[1:])), jnp.zeros(()))
    return jnp.zeros_like(primals[0]), primals[0] * total


def _newton(curve: Curve, s: Float[Array, ""], q: Float[Array, "n"]) -> tuple[Array, Array, Array]:
    X = jnp.append(q, s) / curve.units
    E = curve.slopes(X)
    q = ((X - curve.plus(E.at[:, -1].set(0.0)) @ curve.residual(X)) * curve.units)[:-1]
    dq, ddq, _ = curve.derivatives(s, q)
    return q, dq, ddq


@eqx.filter_custom_jvp
def with_derivative(curve: Curve, x: Float[Array, "n+1"]) -> Float[Array, ""]:
    """Return the value s at a toggle x = (q, s), with the derivatives of the value at the nearest point of the curve."""
    return x[-1]


@with_derivative.def_jvp
def _(primals, tangents):
    curve, x = primals
    moving = eqx.combine(tangents[0], jax.tree.map(jnp.zeros_like, eqx.filter(curve, eqx.is_inexact_array)))
    X = x / jax.lax.stop_gradient(curve.units)
    nearest = lambda curve: ((X - curve.plus(curve.slopes(X)) @ curve.residual(X)) * curve.units)[-1]  # noqa: E731
    return with_derivative(*primals), eqx.filter_jvp(nearest, (curve,), (moving,))[1]
