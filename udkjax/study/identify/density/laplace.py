"""The normal approximation of a posterior density at its mode, in the unconstrained vector.

The curvature of the likelihood is that of Gauss and Newton, J^T J of the weighted residuals; the exact curvatures of the prior
and, where it is positive, of the transforms are added. Importance weights, the ratios of the density to the approximation at
draws of the approximation, show whether it may be trusted. They are reliable if the exponent k of a generalized Pareto
distribution of the largest weights is below 1 - 1 / log10(S) for S draws. The weighted means and standard deviations of the draws
are then those of the density, and have to be near the approximation's.
A. Vehtari et al., Pareto smoothed importance sampling, Journal of Machine Learning Research 25 (2024) 72; the estimate of k:
J. Zhang & M. A. Stephens, Technometrics 51 (2009) 316.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udkjax.study.identify.density.log_density import InferenceProblem
from udkjax.study.identify.problem.residuals import reduce_groups
from udkjax.study.identify.problem.unknowns import INVISIBLE_RATIO
from udkjax.study.identify.records.records import IdentificationError
from udkjax.study.noise import NOISE_FLOOR
from udkjax.wording import join_names

IMPORTANCE_DRAWS = 1023  # number of importance weights
# A quarter of the weights, with the center, is tried first. From these, k has a standard deviation of 0.2 from seed to seed, and
# errors relative to the largest ones that are trusted have one of 0.25.
QUARTER_OF_DRAWS, CLEAR_MARGIN = 255, 0.4
# Largest error of a mean, in standard deviations, and of a standard deviation, as a factor; 95 % intervals then cover 87 %.
MOST_SHIFT, MOST_RATIO = 0.25, 1.25
TRUSTED_EXPONENT = 1.0 - 1.0 / np.log10(IMPORTANCE_DRAWS)  # largest k with which so many importance weights have a reliable mean
# Most steps of Newton's method, most halvings of each, and the step (in standard deviations) that ends it.
NEWTON_STEPS, HALVINGS, LAST_STEP = 40, 12, 1e-6
FARTHEST_STEP = 2.0  # largest step of an unknown, which is dimensionless: a factor of 7 for a positive number
VISIBLE_PART = 0.1  # component of an undetermined direction, relative to the largest, from which an unknown is named


@dataclass(frozen=True, eq=False)
class Laplace:
    """The normal approximation of a posterior density, in the unconstrained vector of `InferenceProblem.log_density`.

    Attributes:
        problem: the density.
        mode: the vector (K,) of the largest density.
        root: a matrix (K, K) with the covariance root root^T.
        k: exponent of the largest importance weights, which are reliable up to 0.67.
        shift: largest error of a mean of the vector, in standard deviations, by these weights; trusted up to 0.25.
        ratio: largest ratio of a standard deviation to the approximation's, or its inverse; trusted up to 1.25.
        log_evidence: logarithm of the integral of the density, by importance sampling.
        log_evidence_error: standard error of `log_evidence`.
        trials: vectors (S, K) drawn from the approximation.
        log_weights: logarithms (S,) of their importance weights, the ratios of the density to the approximation.
    """

    problem: InferenceProblem
    mode: Float[np.ndarray, "K"]
    root: Float[np.ndarray, "K K"]
    k: float
    shift: float
    ratio: float
    log_evidence: float
    log_evidence_error: float
    trials: Float[np.ndarray, "S K"]
    log_weights: Float[np.ndarray, "S"]

    @property
    def covariance(self) -> Float[np.ndarray, "K K"]:
        """Covariance of the unconstrained vector."""
        return self.root @ self.root.T

    @property
    def trusted(self) -> bool:
        """True if the importance weights are reliable and confirm the means and standard deviations."""
        return self.k < TRUSTED_EXPONENT and self.shift < MOST_SHIFT and self.ratio < MOST_RATIO

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Values at the mode and standard deviations by name, the latter to first order."""
        u = self.problem.unknowns
        errors = np.sqrt(np.diag(self.covariance)) * u.dx_dz(self.mode)
        return dict(zip(u.names, zip(u.values(self.mode).tolist(), errors.tolist(), strict=True), strict=True))

    @property
    def message(self) -> str:
        """The verdict, in a sentence."""
        if self.trusted:
            return f"the normal approximation may be trusted (k = {self.k:.2f})"
        errors = (
            f"k = {self.k:.2f}, means are off by up to {self.shift:.2f} deviations, deviations by a factor of {self.ratio:.2f}"
        )
        return f"the normal approximation is poor ({errors}): sample the posterior"

    def draws(self, count: int, seed: int = 0) -> Float[np.ndarray, "count K"]:
        """Return `count` unconstrained vectors drawn from the approximation."""
        return self.mode + np.random.default_rng(int(seed)).standard_normal((count, len(self.mode))) @ self.root.T

    def starts(self, count: int, seed: int = 0) -> Float[np.ndarray, "count K"]:
        """Return `count` vectors that are nearly draws of the density itself, by resampling the trials with their weights.

        They are different, unless there are fewer trials of positive density.
        """
        order = np.argsort(-(self.log_weights + np.random.default_rng(int(seed)).gumbel(size=len(self.log_weights))))
        return np.resize(self.trials[order[: min(count, np.isfinite(self.log_weights).sum())]], (count, len(self.mode)))

    def __repr__(self) -> str:
        numbers = ", ".join(f"{name}: {value:.6g} +- {error:.2g}" for name, (value, error) in self.parameters.items())
        return f"Laplace({numbers}; {self.message})"


def approximate(problem: InferenceProblem, x: Float[np.ndarray, "K"], seed: int = 0, quick: bool = False) -> Laplace:
    """Return the normal approximation of a density at its mode, which is found from a vector x near it.

    If `quick`, only a quarter of the importance weights is computed where these leave no doubt about the verdict.

    Raises:
        IdentificationError: neither the records nor a prior determine some unknowns, records without given noise fit exactly, or
            the density is zero at the mode.
    """
    x = np.asarray(x, float)
    value, gradient, curvature = expand(problem, x)
    for _ in range(NEWTON_STEPS):
        step, size = _newton_step(gradient, curvature)
        if size <= LAST_STEP:
            break
        step *= min(1.0, FARTHEST_STEP / np.abs(step).max())
        for halving in range(HALVINGS):
            trial = expand(problem, x + 0.5**halving * step)
            if trial[0] >= value:
                x, (value, gradient, curvature) = x + 0.5**halving * step, trial
                break
        else:
            break
    _require_noise(problem, x)
    return weigh(problem, x, _root(problem, curvature), seed, quick)


def weigh(
    problem: InferenceProblem, x: Float[np.ndarray, "K"], root: Float[np.ndarray, "K K"], seed: int = 0, quick: bool = False
) -> Laplace:
    """Return the normal approximation of a density with center x and covariance root root^T, judged by importance weights.

    If `quick`, only a quarter of the importance weights is computed where these leave no doubt about the verdict.

    Raises:
        IdentificationError: the density is zero at the center, or everywhere around it.
    """
    K, log_det = len(x), np.linalg.slogdet(root)[1]
    normal = np.random.default_rng(int(seed)).standard_normal((IMPORTANCE_DRAWS, K))
    trials = x + normal @ root.T
    constant = 0.5 * K * np.log(2.0 * np.pi) + log_det
    points, densities = np.concatenate([x[None], trials]), np.zeros(0)
    for part in np.split(points, len(points) // (QUARTER_OF_DRAWS + 1)):  # equal parts share a compiled function
        densities = np.append(densities, problem.log_densities(part))
        count, positive = len(densities) - 1, np.isfinite(densities)
        if not positive[0] or not positive[1:].any():
            where = f"all {count} vectors drawn around its mode" if positive[0] else "its mode, where a run fails"
            cure = "give a prior or bounds that keep the numbers where the mechanism runs, or a larger max_steps"
            raise IdentificationError([f"the posterior density is zero at {where}: {cure}"])
        weights = densities[1:] + 0.5 * np.sum(normal[:count] ** 2, 1) + constant
        k, (shift, ratio) = pareto_exponent(weights), _errors(normal[:count] @ root.T, weights, root)
        worst = max(shift / MOST_SHIFT, np.log(ratio) / np.log(MOST_RATIO))
        if quick and abs(k - TRUSTED_EXPONENT) > CLEAR_MARGIN and abs(worst - 1.0) > CLEAR_MARGIN:
            break
    top = weights.max()
    ratios = np.exp(weights - top)
    error = float(ratios.std() / ratios.mean() / np.sqrt(count))
    evidence = float(top + np.log(ratios.mean())), error
    return Laplace(problem, x, root, k, shift, ratio, *evidence, trials[:count], weights)


def _errors(
    distances: Float[np.ndarray, "S K"], log_weights: Float[np.ndarray, "S"], root: Float[np.ndarray, "K K"]
) -> tuple[float, float]:
    """Return the largest error of a mean (in standard deviations) and of a standard deviation (a factor), by importance weights.

    `distances` are draws of the approximation relative to its center.
    """
    weights = np.exp(log_weights - np.logaddexp.reduce(log_weights))
    size = np.sqrt(np.sum(root**2, axis=1))
    means = weights @ distances
    ratios = np.sqrt(weights @ (distances - means) ** 2) / size
    return float(np.abs(means / size).max()), float(np.exp(np.abs(np.log(np.maximum(ratios, np.finfo(float).tiny))).max()))


def _require_noise(problem: InferenceProblem, x: Float[np.ndarray, "K"]) -> None:
    """Raise an error if estimated noise is so small that it is rounding: the density would grow without limit as it decreases."""
    fit, sizes = problem.fit_problem, problem.unknowns.values(x)[problem.fit_problem.K :]
    least = [NOISE_FLOOR * fit.channel_scale[channel] for _, channel in problem.scales.values()]
    names = [name.removeprefix("noise of ") for name, size, low in zip(problem.scales, sizes, least, strict=True) if size < low]
    if names:
        cure = f"give the noise of {join_names(names)}, noise=..."
        raise IdentificationError([f"the records fit to rounding, as simulated ones do: {cure}"])


def expand(problem: InferenceProblem, x: Float[np.ndarray, "K"]) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the log density at x up to a constant, its gradient, and the negative of its second derivatives by Gauss and Newton.

    The log density is -inf if a run fails.
    """
    least_squares = problem.fit_problem
    K, rows = least_squares.K, len(least_squares.index)
    prior, gradient, second = (np.array(part, float) for part in problem.prior_curvature(x))
    curvature, prior_gradient = -second, gradient.copy()
    blocks = list(least_squares.row_blocks(x[None, :K], problem.tol))
    if not all(block.ok[0] for block in blocks) or not np.isfinite(prior):
        return -np.inf, gradient, curvature
    used = np.concatenate([np.ones(rows, bool), np.zeros(least_squares.extra_rows, bool)])
    reduced = reduce_groups(blocks, K, least_squares.noise_groups(), 0, used)
    scale = np.append(problem.factors * np.exp(x[K:]), 1.0)
    value = float(prior)
    for g, (group, size) in enumerate(zip(reduced.groups, scale, strict=True)):
        J, r = group.J / size, group.r / size
        value -= 0.5 * r @ r
        gradient[:K] -= J.T @ r
        curvature[:K, :K] += J.T @ J
        if g < len(problem.factors):  # the noise of the group is an unknown
            value -= group.count * x[K + g]
            gradient[K + g] += r @ r - group.count
            curvature[K + g, K + g] += 2.0 * r @ r
            curvature[:K, K + g] -= 2.0 * J.T @ r
            curvature[K + g, :K] -= 2.0 * J.T @ r
    # Second derivatives of the transforms: of a number near zero, whose logarithm is the unknown, nearly all of the curvature.
    u, z = least_squares.unknowns, x[: len(least_squares.unknowns.names)]
    bend = -(gradient - prior_gradient)[: len(z)] * u.d2x_dz2(z) / np.maximum(u.dx_dz(z), np.finfo(float).tiny)
    curvature[np.arange(len(z)), np.arange(len(z))] += np.maximum(bend, 0.0)
    return float(value), gradient, curvature


def _newton_step(gradient: np.ndarray, curvature: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the step to the mode in the directions in which the density is concave, and its size in standard deviations."""
    scale, s, v = _spectrum(curvature)
    shown = s > INVISIBLE_RATIO * s.max()
    along = (v.T @ (gradient / scale))[shown] / s[shown]
    return (v[:, shown] @ along) / scale, float(np.abs(along * np.sqrt(s[shown])).max(initial=0.0))


def _spectrum(curvature: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the scales of the unknowns, and eigenvalues and eigenvectors of the curvature in units of these."""
    scale = np.sqrt(np.maximum(np.abs(np.diag(curvature)), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(curvature / np.outer(scale, scale))
    return scale, values, vectors


def _root(problem: InferenceProblem, curvature: np.ndarray) -> np.ndarray:
    """Return a root (K, K) of the covariance, the inverse of the curvature.

    Raises:
        IdentificationError: the curvature vanishes in some directions.
    """
    scale, s, v = _spectrum(curvature)
    blind = np.abs(np.diag(curvature)) <= INVISIBLE_RATIO**2 * np.abs(np.diag(curvature)).max()
    flat = v[:, s <= INVISIBLE_RATIO * s.max()]
    if flat.size or blind.any():
        part = np.max(np.abs(flat), axis=1, initial=0.0)
        names = [name for k, name in enumerate(problem.names) if blind[k] or part[k] > VISIBLE_PART * part.max()]
        cure = "give one of them a prior or bounds, fix it, or measure more"
        raise IdentificationError([f"neither the records nor a prior determine {join_names(names)}: {cure}"])
    return (v / np.sqrt(s)) / scale[:, None]


def pareto_exponent(weights: Float[np.ndarray, "S"]) -> float:
    """Return the exponent k of the generalized Pareto distribution of the largest weights, given the logarithms of all weights.

    It is -inf if all weights are equal.
    """
    count = len(weights)
    tail = int(min(0.2 * count, 3.0 * np.sqrt(count)))
    ordered = np.exp(np.sort(weights) - np.max(weights))
    excess = ordered[-tail:] - ordered[-tail - 1]
    if excess[-1] <= np.finfo(float).eps * ordered[-1]:
        return -np.inf  # all weights are equal
    grid = 30 + int(np.sqrt(tail))
    quartile = excess[int(tail / 4 + 0.5) - 1]
    trials = 1.0 / excess[-1] + (1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3.0 * quartile)
    k = np.mean(np.log1p(-trials[:, None] * excess), axis=1)
    likelihood = tail * (np.log(-trials / k) - k - 1.0)
    share = np.exp(likelihood - likelihood.max())
    best = np.sum(trials * share) / share.sum()
    found = float(np.mean(np.log1p(-best * excess)))
    return (tail * found + 10.0 * 0.5) / (tail + 10.0)  # a weak prior at 1/2
