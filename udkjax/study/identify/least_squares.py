"""Least squares by optimistix, stepped from the host.

Each step asks for residuals and their Jacobian at one trial point of every fit that goes on; the method, compiled once for a
number of unknowns, sees them as a linear function. It sees no more of them than the triangle of their QR factors, which has the
same sums of squares, gradients and steps.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from udkjax.study.identify.problem import INVISIBLE, Residuals
from udkjax.study.identify.unknowns import FAR

if TYPE_CHECKING:  # imported where a fit begins: it takes a second
    import optimistix

# Gauss-Newton steps, the largest change of a dimensionless unknown, at which a fit has settled: on the way; where the integration
# is loose too; where costs have to be exact to the square of it; and at the end, where smaller steps change nothing that shows.
COARSE_STEP, LOOSE_STEP, FINE_STEP, EXACT_STEP = 1e-3, 1e-5, 1e-6, 1e-10
# Steps at most: on the way or beside a minimum; from a first guess, which if it has not settled then is on its way to nowhere;
# and to the end.
FEW_STEPS, SOME_STEPS, STEPS = 15, 30, 60
# Cosine of the angle between residuals and what the unknowns can change of them, at which a fit has settled: times the root of
# their number it is a Gauss-Newton step in standard errors, of which a thousandth changes nothing either.
ORTHOGONAL = 1e-5
# What residuals are multiplied by, over the largest singular value of J: the method's first damping is 1 / FIRST_DAMPING^2 of its
# square. Where a minimum is near there is none to speak of. Of FIRST_DAMPING from 10 to 1000 and factors of 3.5 or 10, with these
# the most fits from 50 % off settle along the whole record.
FIRST_DAMPING, NO_DAMPING = 30.0, 1e8
TINY = 1e-300  # in the place of a zero that is divided by: quotients stay finite
SHORT_STEP = 0.3  # of an unknown: where the first Gauss-Newton step is no longer, a minimum is taken to be near
GOOD_DECREASE, DAMPING_FACTOR = 0.75, 10.0  # part of the decrease promised from which on the damping falls, and by how much
MOST_REFUSED = 8  # steps one after another, before a fit is given up

Objective: TypeAlias = Callable[[np.ndarray], Residuals]  # residuals and their Jacobian at B sets of K unknowns (B, K)
Report: TypeAlias = Callable[[str], None]  # is called with a text after each step
History: TypeAlias = list[tuple[float, float]]  # cost, and largest change of an unknown by the next step: after each step


class Fit(NamedTuple):
    """Where B fits ended: unknowns, costs r.r / 2, whether they settled, and how the best of them went."""

    z: Float[np.ndarray, "B K"]
    cost: Float[np.ndarray, "B"]
    settled: Bool[np.ndarray, "B"]
    history: History  # of the best fit

    def take(self, which: Int[np.ndarray, "n"]) -> "Fit":
        """Return some of the fits."""
        return Fit(self.z[which], self.cost[which], self.settled[which], self.history)

    def join(self, other: "Fit") -> "Fit":
        """Return these fits, then others."""
        z, cost, settled = (np.concatenate(pair) for pair in zip(self[:3], other[:3], strict=True))
        return Fit(z, cost, settled, self.history)


def minimize_squares(
    evaluate: Objective,
    z: Float[np.ndarray, "B K"],
    steps: int = STEPS,
    settled: float = EXACT_STEP,
    undamped: bool = False,
    method: "optimistix.AbstractLeastSquaresSolver | None" = None,
    report: Report = lambda text: None,
) -> Fit:
    """Minimize r.r / 2 by Levenberg-Marquardt, or another `method`, from several first guesses.

    A fit has settled where its Gauss-Newton step is below `settled` (dimensionless); `undamped` says that the guesses are at a
    minimum already, up to the tolerance of the integration.
    """
    sets, K = z.shape
    start, step = _compiled_step(method, K, sets)
    state, y, at, trial = start, jnp.asarray(z), z.copy(), z.copy()
    going, ended, refused = np.ones(sets, bool), np.zeros(sets, bool), np.zeros(sets, int)
    best = np.full(sets, np.inf)
    unit = np.ones(sets)
    reduced = np.zeros((sets, K + 1, K + 1))
    history: History = []
    for count in range(steps):
        active = np.flatnonzero(going)
        asked = active[np.abs(trial[active]).max(1, initial=0.0) < FAR]
        costs, triangles = np.full(sets, np.inf), np.zeros((sets, K + 1, K + 1))
        if len(asked):
            found = evaluate(trial[asked])
            for k, r, J, ok in zip(asked, found.r, found.J, found.ok, strict=True):
                if ok:
                    costs[k], triangles[k] = 0.5 * r @ r, _triangular_factor(r, J)
        better = costs < best
        if count == 0:
            going &= np.isfinite(costs)
            largest = np.array([max(np.linalg.norm(t[:-1, :-1], 2), TINY) for t in triangles])
            bold = undamped | (_gauss_newton(triangles)[0] <= SHORT_STEP)
            unit = np.where(bold, NO_DAMPING, FIRST_DAMPING) / largest
        refused = np.where(better, 0, refused + 1)
        at, best = np.where(better[:, None], trial, at), np.where(better, costs, best)
        reduced = np.where(better[:, None, None], triangles, reduced)
        size, cosine = _gauss_newton(reduced)
        ended |= going & ((size <= settled) | (cosine <= ORTHOGONAL) | ((size <= FINE_STEP) & (refused >= 2)))
        leader = int(np.argmin(best))
        history.append((float(best[leader]), float(size[leader])))
        report(f"step {count + 1}, cost {best.min():.4g}, {int(going.sum())} going")
        going &= ~ended & (refused < MOST_REFUSED)
        if not going.any():
            break
        again = bold & (refused == 1) & ~np.asarray(undamped)
        if again.any():  # no minimum was near, after all: from the best point on with damped steps
            bold, unit = bold & ~again, np.where(again, FIRST_DAMPING / largest, unit)
            state = jax.tree.map(lambda x, y, w=again: np.where(w.reshape(-1, *[1] * (x.ndim - 1)), y, x), state, start)
            trial, triangles, costs = (
                np.where(again.reshape(-1, *[1] * (x.ndim - 1)), y, x)
                for x, y in ((trial, at), (triangles, reduced), (costs, best))
            )
            y = np.where(again[:, None], at, y)
        # What cannot be computed is a step to be refused: it costs a hundred times more than where we are.
        bad = ~np.isfinite(costs)
        seen = np.where(bad[:, None, None], 0.0, triangles * unit[:, None, None])
        seen[bad, -1, -1] = 10.0 * unit[bad] * np.sqrt(2.0 * best[bad] + 1.0)
        y, state, following = step(state, y, trial, seen)
        trial = np.array(following)
    return Fit(at, best, ended, history)


def _triangular_factor(r: np.ndarray, J: np.ndarray) -> np.ndarray:
    """Return R of the QR factors of [J r], its diagonal not negative: it has the same squares, gradients and steps."""
    stacked = np.concatenate([J, r[:, None]], axis=1)
    missing = stacked.shape[1] - len(stacked)
    R = np.linalg.qr(np.concatenate([stacked, np.zeros((missing, stacked.shape[1]))]) if missing > 0 else stacked, mode="r")
    return np.where(np.diag(R) < 0, -1.0, 1.0)[:, None] * R


def _gauss_newton(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest entry of each Gauss-Newton step in directions that show, and the part of r that it removes."""
    sizes, cosines = np.full(len(triangles), np.inf), np.full(len(triangles), np.inf)
    for k, T in enumerate(triangles):
        u, s, vt = np.linalg.svd(T[:-1, :-1])
        if not s.size or s[0] == 0.0:
            continue
        part = u.T @ T[:-1, -1]
        shows = s > INVISIBLE * s[0]
        sizes[k] = np.abs(vt[shows].T @ (part[shows] / s[shows])).max(initial=0.0)
        cosines[k] = np.linalg.norm(part) / max(np.linalg.norm(T[:, -1]), TINY)
    return sizes, cosines


def _linear(y: Array, known: tuple[Array, Array]) -> tuple[Array, None]:
    """Return residuals around a point, from the triangle there."""
    point, T = known
    return T[:, -1] + T[:, :-1] @ (y - point), None


@lru_cache(maxsize=32)
def _compiled_step(method: "optimistix.AbstractLeastSquaresSolver | None", K: int, sets: int) -> tuple[PyTree, Callable]:
    """Return the first state of a method, of arrays alone, and its compiled step, of `sets` fits at once."""
    import optimistix

    solver = method
    if solver is None:
        search = optimistix.ClassicalTrustRegion(high_cutoff=GOOD_DECREASE, high_constant=DAMPING_FACTOR)
        solver = eqx.tree_at(lambda s: s.search, optimistix.LevenbergMarquardt(rtol=0.0, atol=0.0), search)
    given = jnp.zeros((sets, K)), (jnp.zeros((sets, K)), jnp.zeros((sets, K + 1, K + 1)))
    residual = jax.ShapeDtypeStruct((K + 1,), given[0].dtype)

    def begin(y: Array, known: tuple[Array, Array]) -> PyTree:
        return solver.init(_linear, y, known, {}, residual, None, frozenset())

    first, fixed = eqx.partition(eqx.filter_vmap(begin)(*given), eqx.is_array)

    @jax.jit
    def step(state: PyTree, y: Array, trial: Array, triangles: Array) -> tuple[Array, PyTree, Array]:
        def one(state: PyTree, y: Array, trial: Array, T: Array) -> tuple[Array, PyTree]:
            state = eqx.tree_at(lambda s: s.y_eval, state, trial)
            y, state, _ = solver.step(_linear, y, (trial, T), {}, state, frozenset())
            return y, state

        y, state = eqx.filter_vmap(one)(eqx.combine(state, fixed), y, trial, triangles)
        return y, eqx.filter(state, eqx.is_array), state.y_eval

    return first, step
