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

from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.closing import rounding
from udkjax.equations.code import is_large
from udkjax.equations.programs import prepare
from udkjax.equations.rank_policy import REFUSE
from udkjax.equations.scales import rank_tolerance
from udkjax.integrate.assembly import Closure, State, close
from udkjax.pinv import Auto
from udkjax.scene.fields import number
from udkjax.scene.mechanism import Mechanism


def close_all(
    mechanisms: Mechanism, t: ArrayLike = 0.0, states: State | None = None, analysis: Analysis | None = None
) -> Closure:
    """Close a batch of mechanisms of one structure at time t (s), each at its own where there are several.

    Leaves have the members first, and so has the closure. From `states`, or from the guesses of their bodies. Each as `close`
    does, up to rounding; only the rank of a member that was closed before is not looked at further than whether it exceeds that
    of the rows not left out. `analysis` is that of all of them, or batched as they are. Differentiable forward.
    """
    analysis = analyse(mechanisms) if analysis is None else analysis
    size = len(jax.tree.leaves(mechanisms)[0])
    one_for_all = analysis.scales.length.ndim == 0
    analyses = jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), analysis) if one_for_all else analysis
    ts = jnp.broadcast_to(number(t), size)

    def one(k: Any) -> Closure:
        mechanism, t, state, analysis = jax.tree.map(lambda leaf: leaf[k], (mechanisms, ts, states, analyses))
        return close(mechanism, t, state, analysis=analysis)

    if analysis.redundant_rows is None or is_large(mechanisms) or not mechanisms.constraints:
        return jax.lax.map(one, jnp.arange(size))
    found, settled = jax.vmap(_as_it_is)(analyses, mechanisms, ts, states)

    def next_one(carry: tuple[Array, Closure]) -> tuple[Array, Closure]:
        left, found = carry
        k = jnp.argmax(left)
        return left.at[k].set(False), jax.tree.map(lambda x, y: x.at[k].set(y), found, one(k))

    return jax.lax.while_loop(lambda carry: jnp.any(carry[0]), next_one, (~settled, found))[1]


def _as_it_is(
    analysis: Analysis, mechanism: Mechanism, t: Float[Array, ""], state: State | None
) -> tuple[Closure, Bool[Array, ""]]:
    """The guess, moved by rounding errors at most, and whether that is its closure."""
    equations = prepare(mechanism, Auto(), analysis=analysis).with_policy(REFUSE)
    q, v = (mechanism.q0.ravel(), mechanism.v0.ravel()) if state is None else (state.q.ravel(), state.v.ravel())
    D = equations.weighted(t, q)[0]
    psi, psi_dot = equations.violation(t, q, v)
    scales = analysis.scales
    eps, rate = rounding(scales, q, jnp), jnp.maximum(scales.rate, scales.size(v))
    settled = (scales.violation(psi) <= eps) & (scales.violation(psi_dot) <= eps * rate)
    q1, v1 = equations.project(t, q, v)  # for its tangents, which are those of a closed state
    settled &= jnp.all(jnp.isfinite(q1)) & jnp.all(jnp.isfinite(v1))
    redundant = np.array(analysis.redundant_rows, int)
    kept = np.setdiff1d(np.arange(len(psi)), redundant)
    if len(redundant):
        D = jax.lax.stop_gradient(D)
        settled &= _redundant(D[kept], D[redundant], rank_tolerance(mechanism))
    state = State(q1.reshape(-1, 3), v1.reshape(-1, 3))
    return Closure(state, psi, psi_dot, jnp.asarray(len(kept)), scales), settled


def _redundant(K: Float[Array, "r n"], L: Float[Array, "k n"], rank_tol: Any) -> Bool[Array, ""]:
    """Whether the rows L that are left out lie in the span of the rows K that are kept.

    What they are outside of it bounds the next singular value of D, and the longest row is a lower bound of the largest one.
    """
    factor = jnp.linalg.cholesky(K @ K.T)
    outside = L - jax.scipy.linalg.cho_solve((factor, True), K @ L.T).T @ K
    longest = jnp.sqrt(jnp.maximum(jnp.max(jnp.sum(K**2, axis=1)), jnp.max(jnp.sum(L**2, axis=1))))
    return jnp.sqrt(jnp.sum(outside**2)) <= rank_tol * longest
