"""Machine code that closes mechanisms (native/closing.py): which it serves, and how their numbers go in and come out."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from udkjax.equations.scales import Scales
from udkjax.equations.scene_programs import scene_programs
from udkjax.equations.structure import numbers_as_vector
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.native_numbers import active_numbers, cotangent_tree, number_tangents
from udkjax.native.layout import INPUTS, SETTINGS
from udkjax.native.operation import Kind, Tableau, machine_code, native_p, shapes_of, unsupported
from udkjax.native.tableau import EULER
from udkjax.scene.mechanism import Mechanism

# What closing finds: q, v, what is left of Psi and of Psi_dot, and the rank of D.
Closed = tuple[Array, Array, Array, Array, Array]


def can_close(mechanism: Mechanism) -> bool:
    """Whether machine code can close a mechanism."""
    if jax.default_backend() != "cpu" or not jax.config.jax_enable_x64:
        return False
    return not unsupported(_closing(mechanism))


def close(mechanism: Mechanism, scales: Scales, tol: ArrayLike, t: ArrayLike, q: Any, v: Any) -> Closed:
    """q closed, v as the constraints allow it, what is left of Psi and Psi_dot, and the rank of D, from a guess at time t."""
    return _unpack(native_p.bind(*_inputs(mechanism, scales, tol, t, q, v), kind=_closing(mechanism), times=2), len(q))


def close_known(mechanism: Mechanism, scales: Scales, tol: ArrayLike, t: ArrayLike, q: Any, v: Any) -> Closed:
    """As `close`, of known numbers, without tracing anything."""
    kind, inputs = _closing(mechanism), _inputs(mechanism, scales, tol, t, q, v, np)
    return _unpack(machine_code(kind, 1, False)(inputs, shapes_of(inputs, kind, 2)), len(q))


def _unpack(found: Sequence[Any], n: int) -> Closed:
    state, residuals, rank = (x[0] for x in found)
    m = len(residuals) // 2
    return state[:n], state[n:], residuals[:m], residuals[m:], rank[0].astype(int)


def close_jvp(guess: Any, active: Any, change: Any) -> tuple[Array, Array]:
    """The changes of q and v along a `change` of what is active of (mechanism, scales, tol, t, q, v)."""
    (mechanism, *_, q, _), (*_, dq, dv) = guess, change
    n, kind = len(q), _closing(mechanism, active_numbers(mechanism, active[0]), "closing forward")
    numbers = jnp.asarray(numbers_as_vector(number_tangents(mechanism, active[0], change[0])))
    along = [numbers, *(jnp.zeros(n) if dx is None else dx for dx in (dq, dv))]
    dstate = native_p.bind(*_inputs(*guess), *(x[None, None] for x in along), kind=kind, times=2)[-1][0, 0]
    return dstate[:n], dstate[n:]


def close_vjp(guess: Any, active: Any, qbar: Array, vbar: Array) -> Any:
    """The cotangents of what is active, from those of q and v."""
    mechanism = guess[0]
    kind = _closing(mechanism, active_numbers(mechanism, active[0]), "closing reverse")
    bars = jnp.concatenate([qbar, vbar])[None]
    numbers, *states = (x[0] for x in native_p.bind(*_inputs(*guess), bars, kind=kind, times=2)[-3:])
    found = cotangent_tree(numbers, mechanism, active[0])
    return found, *(x if m is True else None for x, m in zip(states, active[-2:], strict=True))


def _inputs(
    mechanism: Mechanism, scales: Scales, tol: ArrayLike, t: ArrayLike, q: Any, v: Any, xp: ModuleType = jnp
) -> list[Any]:
    """Those of a run of the closing code, of one member: by JAX without derivatives, by NumPy as they are."""
    settings = {"length": scales.length, "fallback_tol": tol, "rtol": 1.0, "atol": 1.0, "smallest": 1.0, "omega": 1.0}
    given = {
        "numbers": numbers_as_vector([*mechanism.numbers, tol**2, 0.0]),
        "ts": numbers_as_vector([t, t]),
        "q": q,
        "v": v,
        "settings": numbers_as_vector([settings.get(name, 0.0) for name in SETTINGS]),
        "rows": scales.rows,
        "breaks": xp.zeros(0),
    }
    arrays = [xp.asarray(given[name], float)[None] for name in INPUTS]
    return arrays if xp is np else stop_gradients(arrays)


def _closing(mechanism: Mechanism, active: tuple[bool, ...] | None = None, mode: str = "closing") -> Kind:
    return Kind(scene_programs(mechanism).with_all_rows, Tableau(EULER), projected=False, breaks=False, active=active, mode=mode)
