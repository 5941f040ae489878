"""Least squares by a method of optimistix, stepped from the host.

Each step asks for residuals and their Jacobian at one trial point of every fit that goes on; the method, compiled once for a
number of unknowns, sees them as a linear function. It sees no more of them than the triangle of their QR factors, which has the
same sums of squares, gradients and steps.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from udkjax.study.identify.problem import Evaluated

STEPS = 60
SETTLED = 1e-10  # of an unknown, dimensionless: a Gauss-Newton step below it changes nothing that can be told
# Cosine of the angle between residuals and what the unknowns can change of them: times the root of their number it is a
# Gauss-Newton step in standard errors, of which a thousandth changes nothing either.
NOTHING = 1e-5
ROUNDED, TWICE = 1e-6, 2  # a Gauss-Newton step as short as this that is refused twice is lost in the errors of the integration
FLAT = 1e-9  # of the largest singular value: directions that a step is not expected to be known in
FAR = 20.0  # of an unknown: a positive parameter a hundred million times too large is not looked at
# What residuals are multiplied by, over the largest singular value: the method's first damping is 1 / FIRST^2 of its square.
# Where a minimum is near there is none to speak of. Of FIRST from 10 to 1000 and growth 3.5 or 10, with these the most fits from
# 50 % off settle along the whole record.
FIRST, NEAR = 30.0, 1e8
BOLD = 0.3  # of an unknown: where the first Gauss-Newton step is no longer, a minimum is taken to be near
GOOD, GROWTH = 0.75, 10.0  # part of the decrease promised from which on the damping falls, and by how much
STUCK = 8  # steps refused one after another


class LeastSquares(Protocol):
    """What is minimized: residuals and their Jacobian at sets of unknowns (B, K). `program` counts what is computed."""

    @property
    def program(self) -> Any: ...

    def evaluate(self, z: Any, tol: tuple[float, float], horizon: float | None = None) -> Evaluated: ...


class Fit(NamedTuple):
    """Where fits ended, B of them: unknowns (B, K), costs r.r / 2 (B,), whether they settled, and what they took."""

    z: Float[np.ndarray, "B K"]
    cost: Float[np.ndarray, "B"]
    settled: Bool[np.ndarray, "B"]
    evaluations: int
    history: list[tuple[float, ...]]  # of the best fit: cost and largest change of an unknown, step by step


def descend(
    problem: LeastSquares,
    z: Float[np.ndarray, "B K"],
    tol: tuple[float, float],
    horizon: float | None = None,
    steps: int = STEPS,
    settled: float = SETTLED,
    near: bool = False,
    method: Any = None,
    loss: Callable[[Evaluated], Evaluated] | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Fit:
    """Minimize r.r / 2 from several first guesses; each until its Gauss-Newton step is below `settled`.

    `near`: the guesses are at a minimum, up to the tolerance of the integration; steps are not damped.
    """
    if hasattr(method, "descend"):  # not by least squares: descent.py
        return method.descend(problem, z, tol, horizon, settled, loss, tell)
    sets, K = z.shape
    start, step = _machine(method, K, sets)
    state, y, at, trial = start, jnp.asarray(z), z.copy(), z.copy()
    going, ended, refused = np.ones(sets, bool), np.zeros(sets, bool), np.zeros(sets, int)
    best = np.full(sets, np.inf)
    unit = np.ones(sets)
    reduced = np.zeros((sets, K + 1, K + 1))
    history: list[tuple[float, ...]] = []
    for count in range(steps):
        active = np.flatnonzero(going)
        asked = active[np.abs(trial[active]).max(1, initial=0.0) < FAR]
        costs, triangles = np.full(sets, np.inf), np.zeros((sets, K + 1, K + 1))
        if len(asked):
            found = problem.evaluate(trial[asked], tol, horizon)
            found = found if loss is None else loss(found)
            for k, r, J, ok in zip(asked, found.r, found.J, found.ok, strict=True):
                if ok:
                    costs[k], triangles[k] = 0.5 * r @ r, _triangle(r, J)
        better = costs < best
        if count == 0:
            going &= np.isfinite(costs)
            largest = np.array([max(np.linalg.norm(t[:-1, :-1], 2), 1e-300) for t in triangles])
            bold = near | (_newton(triangles)[0] <= BOLD)
            unit = np.where(bold, NEAR, FIRST) / largest
        refused = np.where(better, 0, refused + 1)
        at, best = np.where(better[:, None], trial, at), np.where(better, costs, best)
        reduced = np.where(better[:, None, None], triangles, reduced)
        size, cosine = _newton(reduced)
        ended |= going & ((size <= settled) | (cosine <= NOTHING) | ((size <= ROUNDED) & (refused >= TWICE)))
        leader = int(np.argmin(best))
        history.append((float(best[leader]), float(size[leader])))
        tell(f"step {count + 1}, cost {best.min():.4g}, {int(going.sum())} going")
        going &= ~ended & (refused < STUCK)
        if not going.any():
            break
        again = bold & (refused == 1) & ~np.asarray(near)  # it was not near, after all: from the best point on with damped steps
        if again.any():
            bold, unit = bold & ~again, np.where(again, FIRST / largest, unit)
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
    return Fit(at, best, ended, problem.program.calls, history)


def _triangle(r: np.ndarray, J: np.ndarray) -> np.ndarray:
    """R of [J r]: of as many residuals as unknowns, and one that none of them changes. Its diagonal is not negative."""
    stacked = np.concatenate([J, r[:, None]], axis=1)
    missing = stacked.shape[1] - len(stacked)
    R = np.linalg.qr(np.concatenate([stacked, np.zeros((missing, stacked.shape[1]))]) if missing > 0 else stacked, mode="r")
    return np.where(np.diag(R) < 0, -1.0, 1.0)[:, None] * R


def _newton(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest entry of the Gauss-Newton step in directions that are known, and the part of the residuals that it takes."""
    sizes, cosines = np.full(len(triangles), np.inf), np.full(len(triangles), np.inf)
    for k, T in enumerate(triangles):
        u, s, vt = np.linalg.svd(T[:-1, :-1])
        if not s.size or s[0] == 0.0:
            continue
        part = u.T @ T[:-1, -1]
        known = s > FLAT * s[0]
        sizes[k] = np.abs(vt[known].T @ (part[known] / s[known])).max(initial=0.0)
        cosines[k] = np.linalg.norm(part) / max(np.linalg.norm(T[:, -1]), 1e-300)
    return sizes, cosines


def _linear(y: Any, known: Any) -> tuple[Any, None]:
    """Residuals around a point, from the triangle there."""
    point, T = known
    return T[:, -1] + T[:, :-1] @ (y - point), None


@lru_cache(maxsize=32)
def _machine(method: Any, K: int, sets: int) -> tuple[Any, Callable]:
    """The method's first state, of arrays alone, and its step, of `sets` fits at once."""
    import optimistix

    solver = method
    if solver is None:
        search = optimistix.ClassicalTrustRegion(high_cutoff=GOOD, high_constant=GROWTH)
        solver = eqx.tree_at(lambda s: s.search, optimistix.LevenbergMarquardt(rtol=0.0, atol=0.0), search)
    given = jnp.zeros((sets, K)), (jnp.zeros((sets, K)), jnp.zeros((sets, K + 1, K + 1)))
    residual = jax.ShapeDtypeStruct((K + 1,), given[0].dtype)

    def begun(y: Any, known: Any) -> Any:
        return solver.init(_linear, y, known, {}, residual, None, frozenset())

    first, fixed = eqx.partition(eqx.filter_vmap(begun)(*given), eqx.is_array)

    @jax.jit
    def step(state: Any, y: Any, trial: Any, triangles: Any) -> tuple[Any, Any, Any]:
        def one(state: Any, y: Any, trial: Any, T: Any) -> tuple[Any, Any]:
            state = eqx.tree_at(lambda s: s.y_eval, state, trial)
            y, state, _ = solver.step(_linear, y, (trial, T), {}, state, frozenset())
            return y, state

        y, state = eqx.filter_vmap(one)(eqx.combine(state, fixed), y, trial, triangles)
        return y, eqx.filter(state, eqx.is_array), state.y_eval

    return first, step
