"""Least squares by Levenberg-Marquardt, or by a method of optimistix, stepped from the host.

Each step asks for residuals and their Jacobian at one trial point of every fit that goes on. The methods see no more of them than
the triangle of their QR factors, which has the same sums of squares, gradients and steps. With J = U S V^T and the damping d,

    z_next = z - V (S^2 + d)^-1 S U^T r,

and d falls where the cost decreases as promised, and rises where it does not.

Source: J. J. More, The Levenberg-Marquardt algorithm, 1978.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

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
# The first damping, of the square of the largest singular value of J. Where a minimum is near there is none to speak of. Of first
# dampings from 1e-2 to 1e-6 and factors of 3.5 or 10, with these the most fits from 50 % off settle along the whole record.
FIRST_DAMPING, NO_DAMPING = 1e-3, 1e-16
TINY = 1e-300  # in the place of a zero that is divided by: quotients stay finite
SHORT_STEP = 0.3  # of an unknown: where the first Gauss-Newton step is no longer, a minimum is taken to be near
# Part of the decrease promised from which on the damping falls, and by how much; and by how much it rises after a refused step.
GOOD_DECREASE, LESS_DAMPING, MORE_DAMPING = 0.75, 0.1, 4.0
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
    steps_by: _Steps = _LevenbergMarquardt() if method is None else _OptimistixSteps(method, K, sets)
    at, trial = z.copy(), z.copy()
    going, ended, refused = np.ones(sets, bool), np.zeros(sets, bool), np.zeros(sets, int)
    best, bold = np.full(sets, np.inf), np.zeros(sets, bool)
    largest = np.ones(sets)
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
        better, before = costs < best, best
        refused = np.where(better, 0, refused + 1)
        at, best = np.where(better[:, None], trial, at), np.where(better, costs, best)
        reduced = np.where(better[:, None, None], triangles, reduced)
        linear = _Linear.of(reduced)
        size, cosine = linear.gauss_newton()
        if count == 0:
            going &= np.isfinite(costs)
            largest = np.maximum(linear.singular.max(1, initial=0.0), TINY)
            bold = undamped | (size <= SHORT_STEP)
            steps_by.begin(largest**2 * np.where(bold, NO_DAMPING, FIRST_DAMPING), at)
        ended |= going & ((size <= settled) | (cosine <= ORTHOGONAL) | ((size <= FINE_STEP) & (refused >= 2)))
        leader = int(np.argmin(best))
        history.append((float(best[leader]), float(size[leader])))
        report(f"step {count + 1}, cost {best.min():.4g}, {int(going.sum())} going")
        going &= ~ended & (refused < MOST_REFUSED)
        if not going.any():
            break
        again = bold & (refused == 1) & ~np.asarray(undamped)
        if again.any():  # no minimum was near, after all: from the best point on with damped steps
            bold = bold & ~again
            steps_by.begin(largest**2 * FIRST_DAMPING, at, again)
            trial, costs, triangles = at.copy(), np.where(again, best, costs), np.where(again[:, None, None], reduced, triangles)
        trial = steps_by.next(_Trial(trial, costs, triangles, np.where(again, np.inf, before)), at, best, linear)
    return Fit(at, best, ended, history)


class _Trial(NamedTuple):
    """What a step has led to: points, costs (infinite where nothing can be computed), triangles; and the best costs before."""

    z: np.ndarray
    cost: np.ndarray
    triangles: np.ndarray
    before: np.ndarray


class _Linear(NamedTuple):
    """Residuals of B fits around their best points, as singular values and vectors of J; `part` is U^T r."""

    part: Float[np.ndarray, "B K"]
    singular: Float[np.ndarray, "B K"]
    vt: Float[np.ndarray, "B K K"]
    size: Float[np.ndarray, "B"]  # of r

    @classmethod
    def of(cls, triangles: Float[np.ndarray, "B K+1 K+1"]) -> "_Linear":
        u, s, vt = np.linalg.svd(triangles[:, :-1, :-1])
        part = np.einsum("bij,bi->bj", u, triangles[:, :-1, -1])
        return cls(part, s, vt, np.linalg.norm(triangles[:, :, -1], axis=1))

    def gauss_newton(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest entry of each Gauss-Newton step in directions that show, and the part of r that it removes."""
        s = self.singular
        shows = s > INVISIBLE * s.max(1, initial=0.0)[:, None]
        step = np.einsum("bji,bj->bi", self.vt, np.where(shows, self.part / np.where(shows, s, 1.0), 0.0))
        cosine = np.linalg.norm(self.part, axis=1) / np.maximum(self.size, TINY)
        seen = shows.any(1)
        return np.where(seen, np.abs(step).max(1, initial=0.0), np.inf), np.where(seen, cosine, np.inf)

    def damped(self, damping: Float[np.ndarray, "B"]) -> tuple[np.ndarray, np.ndarray]:
        """Return each step with a damping, and the decrease of the cost that it promises."""
        s, d = self.singular, damping[:, None]
        left = d / np.maximum(s**2 + d, TINY)  # of the residuals along each direction
        coefficients = -s * self.part / np.maximum(s**2 + d, TINY)
        return np.einsum("bji,bj->bi", self.vt, coefficients), 0.5 * np.sum(self.part**2 * (1.0 - left**2), axis=1)


class _Steps(Protocol):
    """Proposes trial points, one for each fit."""

    def begin(self, damping: np.ndarray, z: np.ndarray, which: np.ndarray | None = None) -> None:
        """Begin (those fits again) with a first damping, at points z."""
        ...

    def next(self, trial: _Trial, at: np.ndarray, best: np.ndarray, linear: _Linear) -> np.ndarray:
        """Return the next points to try: `at` are the best ones until now, with costs `best`."""
        ...


class _LevenbergMarquardt:
    """Steps by Levenberg-Marquardt, whose damping follows how far promised decreases are kept."""

    def begin(self, damping: np.ndarray, z: np.ndarray, which: np.ndarray | None = None) -> None:
        self.damping = damping if which is None else np.where(which, damping, self.damping)
        self.promised = np.zeros(len(z)) if which is None else np.where(which, 0.0, self.promised)

    def next(self, trial: _Trial, at: np.ndarray, best: np.ndarray, linear: _Linear) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            kept = np.where(self.promised > 0.0, (trial.before - trial.cost) / np.maximum(self.promised, TINY), 0.5)
        factor = np.where(kept >= GOOD_DECREASE, LESS_DAMPING, np.where(kept > 0.0, 1.0, MORE_DAMPING))
        self.damping = self.damping * factor
        step, self.promised = linear.damped(self.damping)
        return at + step


class _OptimistixSteps:
    """Steps by a least-squares method of optimistix."""

    def __init__(self, method: "optimistix.AbstractLeastSquaresSolver", K: int, sets: int):
        self.start, self.step = _compiled_step(method, K, sets)
        self.state = self.start

    def begin(self, damping: np.ndarray, z: np.ndarray, which: np.ndarray | None = None) -> None:
        every = np.ones(len(z), bool) if which is None else which
        self.unit = 1.0 / np.sqrt(damping) if which is None else np.where(which, 1.0 / np.sqrt(damping), self.unit)
        self.y = jnp.asarray(z) if which is None else jnp.where(which[:, None], z, self.y)
        self.state = jax.tree.map(
            lambda old, new: np.where(every.reshape(-1, *[1] * (new.ndim - 1)), new, old), self.state, self.start
        )

    def next(self, trial: _Trial, at: np.ndarray, best: np.ndarray, linear: _Linear) -> np.ndarray:
        # What cannot be computed is a step to be refused: it costs a hundred times more than where we are.
        bad = ~np.isfinite(trial.cost)
        seen = np.where(bad[:, None, None], 0.0, trial.triangles * self.unit[:, None, None])
        seen[bad, -1, -1] = 10.0 * self.unit[bad] * np.sqrt(2.0 * best[bad] + 1.0)
        self.y, self.state, following = self.step(self.state, self.y, trial.z, seen)
        return np.array(following)


def _triangular_factor(r: np.ndarray, J: np.ndarray) -> np.ndarray:
    """Return R of the QR factors of [J r], its diagonal not negative: it has the same squares, gradients and steps."""
    stacked = np.concatenate([J, r[:, None]], axis=1)
    missing = stacked.shape[1] - len(stacked)
    R = np.linalg.qr(np.concatenate([stacked, np.zeros((missing, stacked.shape[1]))]) if missing > 0 else stacked, mode="r")
    return np.where(np.diag(R) < 0, -1.0, 1.0)[:, None] * R


def _linear(y: Array, known: tuple[Array, Array]) -> tuple[Array, None]:
    """Return residuals around a point, from the triangle there."""
    point, T = known
    return T[:, -1] + T[:, :-1] @ (y - point), None


@lru_cache(maxsize=32)
def _compiled_step(method: "optimistix.AbstractLeastSquaresSolver", K: int, sets: int) -> tuple[PyTree, Callable]:
    """Return the first state of a method, of arrays alone, and its compiled step, of `sets` fits at once."""
    given = jnp.zeros((sets, K)), (jnp.zeros((sets, K)), jnp.zeros((sets, K + 1, K + 1)))
    residual = jax.ShapeDtypeStruct((K + 1,), given[0].dtype)

    def begin(y: Array, known: tuple[Array, Array]) -> PyTree:
        return method.init(_linear, y, known, {}, residual, None, frozenset())

    first, fixed = eqx.partition(eqx.filter_vmap(begin)(*given), eqx.is_array)

    @jax.jit
    def step(state: PyTree, y: Array, trial: Array, triangles: Array) -> tuple[Array, PyTree, Array]:
        def one(state: PyTree, y: Array, trial: Array, T: Array) -> tuple[Array, PyTree]:
            state = eqx.tree_at(lambda s: s.y_eval, state, trial)
            y, state, _ = method.step(_linear, y, (trial, T), {}, state, frozenset())
            return y, state

        y, state = eqx.filter_vmap(one)(eqx.combine(state, fixed), y, trial, triangles)
        return y, eqx.filter(state, eqx.is_array), state.y_eval

    return first, step
