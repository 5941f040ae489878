"""Assembly of a batch, which costs next to nothing for members whose guess is closed already.

Closing takes singular values, a hundred times what one right-hand side takes. A guess that is closed up to rounding errors, and
in which the rows left out as redundant are redundant, needs none of them: to see that takes one evaluation of Psi and the
triangular factors of D D^T, for all members at once. Those that need more are closed as always, one after another.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from udkjax.equations.assembly import Closure, State, close
from udkjax.equations.programs import is_large, prepare, rank_tolerance
from udkjax.pinv import Auto
from udkjax.scene.fields import number
from udkjax.scene.mechanism import Mechanism

ROUNDING = 32.0  # eps of the size of the coordinates: what is left of Psi in a guess that was computed to be closed


def close_all(mechanisms: Mechanism, t: ArrayLike = 0.0, states: State | None = None) -> Closure:
    """Close a batch of mechanisms of one structure at time t (s), each at its own where there are several.

    Leaves have the members first, and so has the closure. From `states`, or from the guesses of their bodies. Each as `close`
    does, up to rounding; only the rank of a member that was closed before is not looked at further than whether it exceeds that
    of the rows not left out. Differentiable forward.
    """
    size = len(jax.tree.leaves(mechanisms)[0])
    ts = jnp.broadcast_to(number(t), size)

    def one(k: Any) -> Closure:
        mechanism, t, state = jax.tree.map(lambda leaf: leaf[k], (mechanisms, ts, states))
        return close(mechanism, t, state, forward=True)

    if mechanisms.left_out is None or is_large(mechanisms) or not mechanisms.constraints:
        return jax.lax.map(one, jnp.arange(size))
    found, settled = jax.vmap(_as_it_is)(mechanisms, ts, states)

    def next_one(carry: tuple[Array, Closure]) -> tuple[Array, Closure]:
        left, found = carry
        k = jnp.argmax(left)
        return left.at[k].set(False), jax.tree.map(lambda x, y: x.at[k].set(y), found, one(k))

    return jax.lax.while_loop(lambda carry: jnp.any(carry[0]), next_one, (~settled, found))[1]


def _as_it_is(mechanism: Mechanism, t: Float[Array, ""], state: State | None) -> tuple[Closure, Bool[Array, ""]]:
    """The guess, moved by rounding errors at most, and whether that is its closure."""
    equations = prepare(mechanism, Auto()).quick
    q, v = (mechanism.q0.ravel(), mechanism.v0.ravel()) if state is None else (state.q.ravel(), state.v.ravel())
    D, psi, _ = equations.weighted(t, q)
    psi_dot = equations.violation(t, q, v)[1]
    eps = ROUNDING * float(jnp.finfo(psi.dtype).eps)
    settled = (_size(psi) <= eps * (1.0 + _size(q))) & (_size(psi_dot) <= eps * (1.0 + _size(v)))
    q1, v1 = equations.project(t, q, v)  # for its tangents, which are those of a closed state
    settled &= jnp.all(jnp.isfinite(q1)) & jnp.all(jnp.isfinite(v1))
    kept = np.setdiff1d(np.arange(len(psi)), np.array(mechanism.left_out, int))
    if mechanism.left_out:
        settled &= _redundant(jax.lax.stop_gradient(D), kept, mechanism)
    state = State(q1.reshape(-1, 3), v1.reshape(-1, 3))
    return Closure(state, psi, psi_dot, jnp.asarray(len(kept))), settled


def _redundant(D: Float[Array, "m n"], kept: np.ndarray, mechanism: Mechanism) -> Bool[Array, ""]:
    """Whether the rows left out lie in the span of those kept.

    What they are outside of it bounds the next singular value of D, and the longest row is a lower bound of the largest one.
    """
    K, L = D[kept], D[np.array(mechanism.left_out)]
    factor = jnp.linalg.cholesky(K @ K.T)
    outside = L - jax.scipy.linalg.cho_solve((factor, True), K @ L.T).T @ K
    longest = jnp.sqrt(jnp.max(jnp.sum(D**2, axis=1)))
    return jnp.sqrt(jnp.sum(outside**2)) <= rank_tolerance(mechanism) * longest


def _size(x: Any) -> Any:
    return jnp.max(jnp.abs(x), initial=0.0)
