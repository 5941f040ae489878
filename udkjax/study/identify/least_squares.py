"""Least squares by Levenberg-Marquardt: several fits at once, each with a damping of its own.

Each step asks for residuals and their Jacobian at one trial point of every fit that goes on. With J = U S V^T and the damping d,

    z_next = z - V (S^2 + d)^-1 S U^T r,

and d falls where the cost decreases as promised, and rises where it does not.

Source: J. J. More, The Levenberg-Marquardt algorithm, 1978.
"""

from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.study.identify.fit_problem import INVISIBLE_RATIO, Residuals
from udkjax.study.identify.unknowns import FARTHEST_UNKNOWN

# Gauss-Newton steps, the largest change of a dimensionless unknown, at which a fit has settled: on the way; where the integration
# is loose too; where costs have to be exact to the square of it; and at the end, where smaller steps change nothing that shows.
COARSE_STEP, LOOSE_STEP, FINE_STEP, EXACT_STEP = 1e-3, 1e-5, 1e-6, 1e-10
# Steps at most: on the way or beside a minimum; from a first guess, which if it has not settled then is on its way to nowhere;
# and to the end.
FEW_STEPS, SOME_STEPS, STEPS = 15, 30, 60
# Cosine of the angle between residuals and what the unknowns can change of them, at which a fit has settled: times the root of
# their number it is a Gauss-Newton step in standard errors, of which a thousandth changes nothing either.
ORTHOGONAL_COSINE = 1e-5
# The first damping, of the square of the largest singular value of J. Where a minimum is near there is none to speak of. Of first
# dampings from 1e-2 to 1e-6 and factors of 3.5 or 10, with these the most fits from 50 % off settle along the whole record.
FIRST_DAMPING, NO_DAMPING = 1e-3, 1e-16
SHORT_STEP = 0.3  # of an unknown: where the first Gauss-Newton step is no longer, a minimum is taken to be near
# Part of the decrease promised from which on the damping falls, and by how much; and by how much it rises after a refused step.
GOOD_DECREASE, LESS_DAMPING, MORE_DAMPING = 0.75, 0.1, 4.0
MOST_REFUSED_STEPS = 8  # steps one after another, before a fit is given up

Objective: TypeAlias = Callable[[np.ndarray], Residuals]  # residuals and their Jacobian at B sets of K unknowns (B, K)
Report: TypeAlias = Callable[[str], None]  # is called with a text after each step
History: TypeAlias = list[tuple[float, float]]  # cost, and largest change of an unknown by the next step: after each step


class End(NamedTuple):
    """The end of one fit: unknowns, cost r.r / 2, whether it settled, and how it went."""

    z: Float[np.ndarray, "K"]
    cost: float
    settled: bool
    history: History


class Fit(NamedTuple):
    """The ends of B fits: unknowns, costs r.r / 2, whether they settled, and how the best of them went."""

    z: Float[np.ndarray, "B K"]
    cost: Float[np.ndarray, "B"]
    settled: Bool[np.ndarray, "B"]
    history: History  # of the best fit

    @classmethod
    def of(cls, ends: Sequence[End]) -> "Fit":
        """Return where some fits ended as one."""
        z, cost, settled, _ = zip(*ends, strict=True)
        return cls(np.array(z), np.array(cost), np.array(settled), min(ends, key=lambda end: end.cost).history)

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
    report: Report = lambda text: None,
) -> Fit:
    """Minimize r.r / 2 from several first guesses.

    A fit has settled where its Gauss-Newton step is below `settled` (dimensionless); `undamped` says that the guesses are at a
    minimum already, up to the tolerance of the integration.
    """
    fits = [_minimize(guess, steps, settled, undamped) for guess in z]
    trials = {k: next(fit) for k, fit in enumerate(fits)}
    ended: dict[int, End] = {}
    best, count = np.inf, 0
    while trials:
        found, count = evaluate(np.array(list(trials.values()))), count + 1
        for k, r, J, ok in zip(list(trials), found.r, found.J, found.ok, strict=True):
            linear = _Linear.of(r, J) if ok else None
            best = best if linear is None else min(best, linear.cost)
            try:
                trials[k] = fits[k].send(linear)
            except StopIteration as end:
                ended[k] = end.value
                del trials[k]
        report(f"step {count}, cost {best:.4g}, {len(trials)} going")
    return Fit.of([ended[k] for k in range(len(fits))])


class _Linear(NamedTuple):
    """Residuals around a point, as singular values and vectors of J; `part` is U^T r."""

    part: Float[np.ndarray, "K"]
    singular: Float[np.ndarray, "K"]
    vt: Float[np.ndarray, "K K"]
    cost: float

    @classmethod
    def of(cls, r: Float[np.ndarray, "R"], J: Float[np.ndarray, "R K"]) -> "_Linear":
        u, s, vt = np.linalg.svd(J, full_matrices=False)
        return cls(r @ u, s, vt, float(0.5 * r @ r))

    def gauss_newton(self) -> tuple[float, float]:
        """Return the largest entry of the Gauss-Newton step in directions that show, and the cosine of the angle of r to J."""
        shows = self.singular > INVISIBLE_RATIO * self.singular.max(initial=0.0)
        if not shows.any():
            return np.inf, np.inf
        step = (self.part[shows] / self.singular[shows]) @ self.vt[shows]
        size = np.sqrt(2.0 * self.cost)
        return float(np.abs(step).max()), float(np.linalg.norm(self.part) / size) if size else 0.0

    def damped(self, damping: float) -> tuple[np.ndarray, float]:
        """Return the step with a damping, and the decrease of the cost that it promises."""
        left = damping / (self.singular**2 + damping)  # of the residuals along each direction
        step = -(self.singular * self.part / (self.singular**2 + damping)) @ self.vt
        return step, float(0.5 * np.sum(self.part**2 * (1.0 - left**2)))


def _minimize(
    guess: Float[np.ndarray, "K"], steps: int, settled: float, undamped: bool
) -> Generator[np.ndarray, "_Linear | None", End]:
    """Minimize from one guess: yield points to try, and take residuals around each; None where they cannot be computed."""
    linear = yield guess
    if linear is None:
        return End(guess, np.inf, False, [(np.inf, np.inf)])
    at, refused, history = guess, 0, []
    largest = max(float(linear.singular.max(initial=0.0)) ** 2, np.finfo(float).tiny)
    near = undamped or linear.gauss_newton()[0] <= SHORT_STEP
    damping = largest * (NO_DAMPING if near else FIRST_DAMPING)
    while True:
        size, cosine = linear.gauss_newton()
        history.append((linear.cost, size))
        if size <= settled or cosine <= ORTHOGONAL_COSINE or (size <= FINE_STEP and refused >= 2):
            return End(at, linear.cost, True, history)
        if refused >= MOST_REFUSED_STEPS or len(history) >= steps:
            return End(at, linear.cost, False, history)
        step, promised = linear.damped(damping)
        trial = at + step
        found = (yield trial) if np.abs(trial).max() < FARTHEST_UNKNOWN else None
        kept = -np.inf if found is None else (linear.cost - found.cost) / max(promised, np.finfo(float).tiny)
        if found is not None and found.cost < linear.cost:
            at, linear, refused = trial, found, 0
        else:
            refused += 1
        if refused and near and not undamped:  # no minimum was near, after all: from the best point on with damped steps
            near, damping = False, largest * FIRST_DAMPING
        elif refused or kept >= GOOD_DECREASE:
            damping *= MORE_DAMPING if refused else LESS_DAMPING
