"""Mechanisms closed by machine code (native/closing/closing.py): support, inputs, outputs and derivatives."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from udkjax.equations.programs.scales import Scales
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.terms.structure import numbers_as_vector
from udkjax.native.loaded_code import call_concrete
from udkjax.native.packing import ActiveNumbers
from udkjax.native.position_operations import Close
from udkjax.native.primitive import native_p
from udkjax.native.unsupported import unsupported
from udkjax.scene.mechanism import Mechanism

# Results of closing: q, v, the residuals Psi and Psi_dot, and the rank of D.
Closed = tuple[Array, Array, Array, Array, Array]


def can_close(mechanism: Mechanism) -> bool:
    """Return True if machine code can close the mechanism: it supports all elements, and JAX uses float64."""
    return jax.config.jax_enable_x64 and not unsupported(_close(mechanism).code)


def close(mechanism: Mechanism, scales: Scales, t: ArrayLike, q: Any, v: Any) -> Closed:
    """Return q and v that satisfy the constraints at time t, the residuals Psi and Psi_dot, and the rank of D."""
    return _unpack(native_p.bind(*_inputs(mechanism, scales, t, q, v), operation=_close(mechanism), times=2), len(q))


def close_concrete(mechanism: Mechanism, scales: Scales, t: ArrayLike, q: Any, v: Any) -> Closed:
    """Return the results of `close` for a mechanism of concrete numbers, without tracing anything."""
    return _unpack(call_concrete(_close(mechanism), _inputs(mechanism, scales, t, q, v, np), 2), len(q))


def _unpack(found: Sequence[Any], n: int) -> Closed:
    state, residuals, rank = (x[0] for x in found)
    m = len(residuals) // 2
    return state[:n], state[n:], residuals[:m], residuals[m:], rank[0].astype(int)


def close_jvp(guess: Any, active: Any, change: Any) -> tuple[Array, Array]:
    """Return the directional derivatives of q and v of the closed state.

    Args:
        guess: mechanism, scales, t, q and v from which the state is closed.
        active: the tree (mechanism, q, v) with True for the numbers that change.
        change: the same tree with the changes of these numbers.
    """
    operation = _close(guess[0]).with_tangents(ActiveNumbers(guess[0], active[0]).mask)
    return _close_along(guess, operation, (active, change))


def second_derivative(guess: Any, active: Any, *changes: tuple[Any, Any]) -> tuple[Array, Array]:
    """Return the second derivatives of q and v of the closed state along two changes.

    Args:
        guess: mechanism, scales, t, q and v from which the state is closed.
        active: the tree (mechanism, q, v) with True for the numbers that change in at least one of both.
        changes: the trees `active` and `change`, as for `close_jvp`, of each change.
    """
    operation = _close(guess[0]).with_second_tangents(ActiveNumbers(guess[0], active[0]).mask)
    return _close_along(guess, operation, *changes)


def _close_along(guess: Any, operation: Close, *changes: tuple[Any, Any]) -> tuple[Array, Array]:
    mechanism, n, directions = guess[0], len(guess[-1]), []
    for active, (numbers, dq, dv) in changes:
        directions.append(ActiveNumbers(mechanism, active[0]).tangents(numbers))
        directions += [np.zeros(n) if dx is None else dx for dx in (dq, dv)]
    dstate = native_p.bind(*_inputs(*guess), *(x[None, None] for x in directions), operation=operation, times=2)[-1][0, 0]
    return dstate[:n], dstate[n:]


def close_vjp(guess: Any, active: Any, qbar: Array, vbar: Array) -> Any:
    """Return the cotangents of the active numbers, as a tree (mechanism, q, v), from those of q and v of the closed state.

    `guess` and `active` are those of `close_jvp`.
    """
    mechanism = guess[0]
    which = ActiveNumbers(mechanism, active[0])
    operation = _close(mechanism).with_cotangents(which.mask)
    bars = jnp.concatenate([qbar, vbar])[None]
    numbers, *states = (x[0] for x in native_p.bind(*_inputs(*guess), bars, operation=operation, times=2)[-3:])
    results = which.cotangents(numbers)
    return results, *(x if m is True else None for x, m in zip(states, active[-2:], strict=True))


def _inputs(mechanism: Mechanism, scales: Scales, t: ArrayLike, q: Any, v: Any, xp: ModuleType = jnp) -> list[Any]:
    settings, ts = {"length": scales.length, "fallback_tol": scales.rank_tol}, numbers_as_vector([t, t])
    numbers = [*mechanism.numbers, scales.rank_tol**2, 0.0]
    return _close(mechanism).pack(numbers, ts, q, v, settings, scales.rows, xp=xp)


def _close(mechanism: Mechanism) -> Close:
    return Close(scene_programs(mechanism).with_all_rows)
