"""Positions on one branch over values of a driver: the first one, and the others by machine code, then by continuation."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udkjax.annotations import NumberLike
from udkjax.arrays import library_for
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.positions.assembling.assembly import State, close
from udkjax.positions.following.branches import SAME_POSITION_TOL
from udkjax.positions.following.continuation import Points, Reached, follow, no_points
from udkjax.positions.following.curve import AbstractCurve, Curve, NumpyCurve
from udkjax.positions.following.drive import Drive, Driven, drive
from udkjax.positions.following.march import MarchResult, can_march, march, march_at_once
from udkjax.positions.following.position_derivatives import with_derivative, with_derivatives
from udkjax.programs.control_flow import BY_JAX, ControlFlow
from udkjax.scene.mechanism import Mechanism
from udkjax.transforms.gradients import stop_gradients


def start_on_branch(
    mechanism: Mechanism, driver: Drive, start: NumberLike, state: State | None, held: Mapping[str, NumberLike] | None
) -> tuple[Driven, Float[Array, "n"]]:
    """Return the driven mechanism, and the closed position near `state` from which it is followed.

    Args:
        mechanism: the mechanism.
        driver: a driver or coordinate; None: all drivers, along time.
        start: the time (s) at which the position is closed if `driver` is None.
        state: a state near the position; None: the initial guess.
        held: values that other drivers or coordinates hold, by name.
    """
    driven = drive(mechanism, driver, 0.0, held)
    if driver is None:
        return driven, _assemble(driven.mechanism, start, state, driven.analysis)
    q = _assemble(mechanism, 0.0, state, analyse(mechanism))
    if held:
        at_rest = State(q.reshape(-1, 3), jnp.zeros((len(q) // 3, 3)))
        q = _assemble(driven.mechanism, driven.value(q), at_rest, driven.analysis)
    return driven, q


def _assemble(mechanism: Mechanism, t: NumberLike, state: State | None, analysis: Analysis) -> Float[Array, "n"]:
    q = close(mechanism, t, state, analysis=analysis).state.q
    return library_for(q).ravel(q)


def solve_on_branch(
    driven: Driven, s: Float[Array, ""], q: Float[Array, "n"], values: Float[Array, "T"], by: ControlFlow, fast: bool = True
) -> Points:
    """Return the positions at the values, followed from the position q at the value s.

    If `fast`, machine code computes them as long as its steps are reliable. Continuation computes the others.
    """
    xp, is_traced = by.xp, by is BY_JAX
    curve = (Curve if is_traced else NumpyCurve).of(driven)
    points, first = no_points(len(values), len(q), xp), xp.asarray(0)
    given = driven.mechanism, driven.analysis, driven.unit, s, q, values
    if fast and can_march(driven.mechanism, driven.analysis):
        found = march(*stop_gradients(given)) if is_traced else march_at_once(*given)
        first = _count_on_branch(curve, s, q, values, found)
        if is_traced or first < len(values):
            s, q = _place_to_go_on(s, q, values, found, first, xp)
        points = points._replace(q=found.q, dq=found.dq, ddq=found.ddq, status=xp.zeros_like(points.status))
    if not is_traced:
        points = follow(curve, s, q, values, points, first)
        has_position = Reached.has_position(points.status)
        if has_position.all():
            return points
        known = {name: np.where(has_position[:, None], getattr(points, name), np.nan) for name in ("q", "dq", "ddq")}
        return points._replace(**known)
    assert isinstance(curve, Curve)
    points = follow(*stop_gradients((curve, s, q, values)), points, first)
    return _with_derivatives(curve, q, values, points)


def _count_on_branch(
    curve: AbstractCurve, s: Float[Array, ""], q: Float[Array, "n"], values: Float[Array, "T"], march_result: MarchResult
) -> Int[Array, ""] | int:
    """Return the number of positions from the first one on that machine code trusts and that are on the branch of the start.

    The side changes where the branch meets another, and where machine code jumps to a neighbouring branch. Continuation with
    shorter steps distinguishes the two cases. For concrete numbers it does so here, beginning at the previous value; for traced
    numbers positions are counted up to the first change, and continuation computes the others.
    """
    if isinstance(curve, Curve):
        is_same_side = march_result.side == march_result.first_side
        return jnp.sum(jnp.cumprod(is_same_side & (np.arange(len(values)) < march_result.trusted)))
    trusted = int(march_result.trusted)
    if (march_result.side[:trusted] == march_result.first_side).all():
        return trusted
    previous_sides = np.append(march_result.first_side, march_result.side[:-1])
    for k in np.flatnonzero(march_result.side[:trusted] != previous_sides[:trusted]).tolist():
        s, q = (values[k - 1], march_result.q[k - 1]) if k else (s, q)
        reached = follow(curve, s, q, values[k : k + 1], no_points(1, len(q), np), 0)
        distance = np.abs(reached.q[0] - march_result.q[k]) / curve.units[:-1]
        if not (Reached.has_position(reached.status[0]) and np.max(distance) <= SAME_POSITION_TOL):
            return k
    return trusted


def _place_to_go_on(
    s: Float[Array, ""],
    q: Float[Array, "n"],
    values: Float[Array, "T"],
    march_result: MarchResult,
    first: Int[Array, ""] | int,
    xp: Any,
) -> tuple[Any, Any]:
    """Return the value and the position from which continuation finds the position at values[first]."""
    last, following = xp.maximum(first - 1, 0), xp.minimum(first, len(values) - 1)
    some, m = first > 0, march_result
    side = xp.where(some, m.side[last], m.first_side)
    # Machine code may have come nearer, on the same branch.
    is_nearer = (first == m.trusted) & (first < len(values)) & (m.side[following] == side)
    s, q = xp.where(some, values[last], s), xp.where(some, m.q[last], q)
    return xp.where(is_nearer, m.reached, s), xp.where(is_nearer, m.q[-1], q)


def _with_derivatives(curve: Curve, q: Float[Array, "n"], values: Float[Array, "T"], points: Points) -> Points:
    has_position = Reached.has_position(points.status)
    safe = jnp.where(has_position[:, None], points.q, jax.lax.stop_gradient(q))
    regular = ~has_position | (points.status == Reached.closed)
    derivatives = with_derivatives(curve, values, points._replace(q=safe), regular)
    q, dq, ddq = (jnp.where(has_position[:, None], x, jnp.nan) for x in derivatives)
    limited = jnp.isfinite(points.limit)
    X = jnp.where(limited, jnp.append(points.limit_q, points.limit), jax.lax.stop_gradient(jnp.append(safe[0], values[0])))
    limit = jnp.where(limited, with_derivative(curve, X), jnp.inf)
    return points._replace(q=q, dq=dq, ddq=ddq, limit=limit)
