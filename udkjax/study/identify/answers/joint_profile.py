"""Joint confidence regions of two parameters: an ellipse by their covariance, and a curve by their profile likelihood.

The region contains all pairs of values for which twice the cost, minimized over all other unknowns and relative to the noise,
exceeds its minimum by less than the quantile of chi^2 with two degrees of freedom (of 2 F, for estimated noise). Its edge is
searched on rays from the estimate, which are equally spaced in the coordinates in which the ellipse is a circle: in a linear
model, the edge is the ellipse.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.study.identify.answers.profile_likelihood import (
    CONFIDENCE,
    estimated_noise,
    fix_unknown,
    quantile,
    residual_cost,
    trace_profile,
)
from udkjax.study.identify.answers.uncertainty import Uncertainty
from udkjax.study.identify.problem.unknowns import FARTHEST_UNKNOWN, Unknowns
from udkjax.study.identify.records.records import IdentificationError
from udkjax.study.identify.search.least_squares import FINE_STEP, Objective, minimize_squares
from udkjax.wording import plural, quote, suggestion

RAYS = 32  # number of rays to the edge of a region; an ellipse through as many points looks smooth


class JointProfile(NamedTuple):
    """The joint confidence region of two parameters.

    Attributes:
        names: names of the two parameters.
        edge: their values (N, 2) on the edge of the region, in order; NaN where the region is open.
        ellipse: their values (N, 2) on the edge in the linear model, by the standard errors and their correlation.
        level: confidence level.
        text: the extent of the region in words.
    """

    names: tuple[str, str]
    edge: Float[np.ndarray, "N 2"]
    ellipse: Float[np.ndarray, "N 2"]
    level: float
    text: str

    def __str__(self) -> str:
        return self.text


def confidence_ellipse(
    uncertainty: Uncertainty, names: Sequence[str], level: float = CONFIDENCE, count: int = RAYS
) -> Float[np.ndarray, "N 2"]:
    """Return points on the edge of the joint confidence region of two parameters, by their covariance; NaN if it is unknown."""
    which = [uncertainty.names.index(name) for name in names]
    covariance = uncertainty.covariance[np.ix_(which, which)]
    if not np.isfinite(covariance).all():
        return np.full((count, 2), np.nan)
    size = np.sqrt(quantile(level, estimated_noise(uncertainty)[1], 2))
    return np.asarray(uncertainty.values.x)[which] + size * _circle(count) @ _root(covariance).T


def joint_profile(
    evaluate: Objective,
    unknowns: Unknowns,
    z: Float[np.ndarray, "K"],
    uncertainty: Uncertainty,
    names: tuple[str, str],
    level: float = CONFIDENCE,
) -> JointProfile:
    """Return the joint confidence region of two parameters, whose edge is searched around an estimate z.

    Args:
        evaluate: the weighted residuals as a function of the unknowns.
        unknowns: the parameters of the fit.
        z: the unknowns at the estimate (K,).
        uncertainty: the uncertainty of the estimate.
        names: names of the two parameters.
        level: confidence level.

    Raises:
        IdentificationError: a parameter was not identified, is the same as the other, or is not determined by the records.
    """
    require_two(names, unknowns.names)
    errors = dict(zip(uncertainty.names, uncertainty.standard_errors, strict=True))
    if lost := [name for name in names if not np.isfinite(errors[name])]:
        cure = "`profile` says how far it can go; give it a prior, or measure more"
        raise IdentificationError([f"the records do not determine {name}: {cure}" for name in lost])
    P, which = len(unknowns.names), [unknowns.names.index(name) for name in names]
    first, last = sorted(which)
    slopes = unknowns.dx_dz(z[:P])[which]
    root = _root(uncertainty.covariance[np.ix_(which, which)] / np.outer(slopes, slopes))
    noise, freedom = estimated_noise(uncertainty)
    least, others = residual_cost(evaluate(z[None])), np.delete(z, which)

    def moved(z: np.ndarray, distance: float, along: np.ndarray) -> np.ndarray:
        z = z.copy()
        z[which] = z[which] + distance * along
        return z

    def ends(along: Float[np.ndarray, "2"]) -> tuple[float, float]:
        """Return the distances to the edge in both directions along a line through the estimate; infinite where it is open.

        Distances are relative to `along`, changes of the two unknowns by one standard deviation.
        """

        def fit(index: int, distance: float, start: np.ndarray) -> tuple[np.ndarray, float]:
            there = moved(z, distance, along)
            if not others.size:
                return np.array([distance]), residual_cost(evaluate(there[None]))
            objective = fix_unknown(fix_unknown(evaluate, last, there[last]), first, there[first])
            refitted = minimize_squares(objective, start[1:], step_tol=FINE_STEP)
            return np.append(distance, refitted.z), refitted.cost

        far = np.min((FARTHEST_UNKNOWN - np.abs(z[which])) / np.maximum(np.abs(along), np.finfo(float).tiny))
        given = {"level": level, "noise": noise, "degrees_of_freedom": freedom, "count": 2, "bounds": (-far, far)}
        return trace_profile(fit, 0, np.append(0.0, others), least, 1.0, **given).interval

    directions = _circle(RAYS)[: RAYS // 2] @ root.T
    lows, highs = np.array([ends(along) for along in directions]).T
    distances = np.append(highs, -lows)
    along = np.concatenate([directions, -directions])
    points = [
        unknowns.values(moved(z[:P], d, a))[which] if np.isfinite(d) else [np.nan] * 2
        for d, a in zip(distances, along, strict=True)
    ]
    edge = np.array(points)
    return JointProfile(names, edge, confidence_ellipse(uncertainty, names, level), level, _text(names, unknowns, edge, level))


def require_two(names: tuple[str, str], known: Sequence[str]) -> None:
    """Require that two names are different, and that both are names of identified parameters.

    Raises:
        IdentificationError: a parameter was not identified, or is the same as the other.
    """
    problems = [f"{quote(name)} was not identified{suggestion(name, known)}" for name in names if name not in known]
    if not problems and names[0] == names[1]:
        problems = [f"a joint region needs two different parameters, not {quote(names[0])} twice"]
    if problems:
        raise IdentificationError(problems)


def _circle(count: int) -> Float[np.ndarray, "N 2"]:
    angles = 2.0 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _root(covariance: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
    """Return the lower triangular root of a covariance, whose correlation may be 1 or beyond by rounding."""
    one, other = np.sqrt(np.diag(covariance))
    rho = covariance[0, 1] / (one * other)
    return np.array([[one, 0.0], [rho * other, np.sqrt(max(1.0 - rho**2, 0.0)) * other]])


def _text(names: tuple[str, str], unknowns: Unknowns, edge: np.ndarray, level: float) -> str:
    closed = np.isfinite(edge[:, 0])
    if not closed.any():
        return f"{names[0]} and {names[1]}: the joint region is open in all directions ({100 * level:g} %)"
    units = [unknowns.units[unknowns.names.index(name)] for name in names]
    ranges = [
        f"{name} from {low:.4g} to {high:.4g} {unit}".rstrip()
        for name, low, high, unit in zip(names, edge[closed].min(0), edge[closed].max(0), units, strict=True)
    ]
    still = f"; open in {plural(int((~closed).sum()), 'direction')} of {len(edge)}" if not closed.all() else ""
    return f"{' and '.join(ranges)}, jointly ({100 * level:g} %){still}"
