"""The profile likelihood of an unknown: the rise of the cost as the unknown varies and all others are refitted.

With C(z) = r.r / 2, z_k an unknown that is fixed while all others are refitted, and s the noise, the curve

    psi = +-(2 (C(z_k) - C_min) / s^2)^(1/2)

is a straight line for a linear model, psi = (z_k - estimate) / standard error. All z_k with psi^2 below the quantile of chi^2
with one degree of freedom form a confidence interval that does not assume a linear model; it may be asymmetric or open.
(Venzon & Moolgavkar, Applied Statistics 37 (1988) 87; Raue et al., Bioinformatics 25 (2009) 1923.)
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri, fdtri

from udkjax.extras import OptionalImport
from udkjax.study.identify.answers.uncertainty import Uncertainty
from udkjax.study.identify.problem.residuals import Residuals, residual_vector
from udkjax.study.identify.problem.unknowns import FARTHEST_UNKNOWN, Unknowns
from udkjax.study.identify.search.least_squares import FINE_STEP, Objective, minimize_squares

if TYPE_CHECKING:
    import xarray

CONFIDENCE = 0.95  # default level: about two standard errors to either side
STEPS_TO_END = 4.0  # number of steps from the estimate to the end of the interval if the curve is a straight line
UNKNOWN_ERROR = 0.5  # substituted for an unknown standard error of a dimensionless unknown
MOST_STRETCH, MOST_SHRINK = 2.0, 0.1  # limits of the ratio of successive steps
END_DISTANCE = 1e-3  # tolerance on the end of the interval, relative to psi there
MOST_FITS = 30  # largest number on each side; a straight curve needs STEPS_TO_END fits, a bent one more
BETTER_FIT = 1e-6  # decrease of the cost below the estimate's that is not rounding, relative to the rise

_AT_BOUND = "the limit of the search"

FitOthers: TypeAlias = Callable[[int, float, np.ndarray], tuple[np.ndarray, float]]


class ProfileLikelihood(NamedTuple):
    """The profile likelihood of a parameter: refitted costs over its values in increasing order, and a confidence interval.

    Attributes:
        name: name of the parameter.
        values: values x of the parameter.
        costs: costs r.r / 2 of the fits of all other unknowns.
        z: all unknowns of these fits.
        interval: confidence interval; an end is infinite if the curve does not rise to the limit.
        best: index of the lowest cost: that of the estimate, unless a better fit was found.
        text: the interval, and why an end is open, in words.
    """

    name: str
    values: Float[np.ndarray, "N"]
    costs: Float[np.ndarray, "N"]
    z: Float[np.ndarray, "N K"]
    interval: tuple[float, float]
    best: int
    text: str

    def __str__(self) -> str:
        return self.text


class _Side(NamedTuple):
    """One side of a profile, from the estimate outwards."""

    fixed: list[float]  # values of z_k
    z: list[np.ndarray]  # all unknowns
    costs: list[float]
    end: float  # end of the interval
    open: str  # the reason if the interval is open on this side, else ""


def fix_unknown(evaluate: Objective, index: int, value: float) -> Objective:
    """Return the residuals as a function of all unknowns except one, which is fixed at `value`."""

    def evaluate_others(z: Float[np.ndarray, "B K-1"]) -> Iterator[Residuals]:
        for block in evaluate(np.insert(z, index, value, axis=-1)):
            yield block._replace(J=np.delete(block.J, index, axis=2))

    return evaluate_others


def profile_likelihood(
    evaluate: Objective,
    unknowns: Unknowns,
    z: Float[np.ndarray, "K"],
    uncertainty: Uncertainty,
    name: str,
    level: float = CONFIDENCE,
) -> ProfileLikelihood:
    """Compute the profile likelihood of a parameter around an estimate z."""
    k, P = unknowns.names.index(name), len(unknowns.names)

    def fit(index: int, fixed: float, z0: np.ndarray) -> tuple[np.ndarray, float]:
        others = np.delete(z0, index)
        if not others.size:
            return z0, residual_cost(evaluate(z0[None]))
        refitted = minimize_squares(fix_unknown(evaluate, index, fixed), others, step_tol=FINE_STEP)
        return np.insert(refitted.z, index, fixed), refitted.cost

    def value(fixed: float) -> float:
        unknowns_at_value = z[:P].copy()
        unknowns_at_value[k] = fixed
        return float(unknowns.values(unknowns_at_value)[k])

    error = float(uncertainty.standard_errors[k] / abs(unknowns.dx_dz(z[:P])[k]))
    noise, freedom = estimated_noise(uncertainty)
    least, units = residual_cost(evaluate(z[None])), unknowns.units[k]
    return trace_profile(
        fit, k, z, least, error, level=level, noise=noise, degrees_of_freedom=freedom, value=value, name=name, units=units
    )


def residual_cost(blocks: Iterable[Residuals]) -> float:
    """Return r.r / 2 of the first set of unknowns; infinite if it cannot be computed."""
    r, ok = residual_vector(blocks)
    return float(0.5 * r @ r) if ok else np.inf


def estimated_noise(uncertainty: Uncertainty) -> tuple[float, float | None]:
    """Return the ratio of the estimated to the assumed noise, and its degrees of freedom; 1 and None if all noise was given.

    If the noise of several channels was estimated, residuals were divided by it, and the factors are 1 up to rounding.
    """
    scales = uncertainty.noise
    return (float(scales.mean()), uncertainty.degrees_of_freedom) if scales.size else (1.0, None)


def profiles_dataset(
    profiles: Sequence[ProfileLikelihood], values: Mapping[str, float], uncertainty: Uncertainty, level: float = CONFIDENCE
) -> "xarray.Dataset":
    """Return profile likelihoods as a dataset (see `Estimate.to_xarray`); `values` are the estimates of parameters, by name."""
    with OptionalImport():
        import xarray
    noise, freedom = estimated_noise(uncertainty)
    curves = np.full((2, len(profiles), max(len(profile.values) for profile in profiles)), np.nan)
    for k, profile in enumerate(profiles):
        at_estimate = np.argmin(np.abs(profile.values - values[profile.name]))
        curves[:, k, : len(profile.values)] = profile.values, 2.0 * (profile.costs - profile.costs[at_estimate]) / noise**2
    dims = "profile", "point"
    data = {
        "profile_value": (dims, curves[0]),
        "rise": (dims, curves[1]),
        "interval": (
            ("profile", "end"),
            np.array([profile.interval for profile in profiles]),
            {"level": level, "limit": quantile(level, freedom)},
        ),
    }
    return xarray.Dataset(data, {"profile": [profile.name for profile in profiles], "end": ["low", "high"]})


# --- the curve


def trace_profile(
    fit: FitOthers,
    index: int,
    z: Float[np.ndarray, "K"],
    cost: float,
    step: float,
    *,
    level: float = CONFIDENCE,
    noise: float = 1.0,
    degrees_of_freedom: float | None = None,
    count: int = 1,
    bounds: tuple[float, float] = (-FARTHEST_UNKNOWN, FARTHEST_UNKNOWN),
    value: Callable[[float], float] = lambda z: z,
    name: str = "z",
    units: str = "",
    steps: int = MOST_FITS,
) -> ProfileLikelihood:
    """Trace the profile likelihood of the unknown `index` from an estimate z in both directions, to the ends of its interval.

    Args:
        fit: (index, value, z0) -> (z, cost) minimizes the cost over all other unknowns, starting from z0; the walk ends before a
            failed fit, whose cost is not finite.
        index: index of the unknown.
        z: unknowns at the estimate (K,).
        cost: cost r.r / 2 at the estimate.
        step: standard error of the unknown, approximately.
        level: confidence level.
        noise: ratio of the estimated to the assumed noise.
        degrees_of_freedom: degrees of freedom of the estimated noise, for the quantile of F; None if the noise is known.
        count: number of parameters that the interval is for; more than one for a ray of a joint region.
        bounds: least and largest value of z_k.
        value: x as a function of z_k, increasing between the `bounds` of z_k.
        name: name of the parameter in the result.
        units: units of the parameter in the text.
        steps: maximum number of fits on each side.
    """
    limit = quantile(level, degrees_of_freedom, count)
    rise = limit * noise**2
    sides = []
    for sign, bound in zip((-1.0, 1.0), bounds, strict=True):
        length = min(np.sqrt(limit) * (step if 0 < step < np.inf else UNKNOWN_ERROR), abs(bound - z[index]))
        sides.append(_walk(fit, index, np.asarray(z, float), cost, sign * length, bound, rise, steps))
    low, high = sides
    fixed = np.array([*low.fixed[::-1], z[index], *high.fixed])
    costs = np.array([*low.costs[::-1], cost, *high.costs])
    unknowns = np.array([*low.z[::-1], z, *high.z])
    values = np.array([value(x) for x in fixed])
    ends = -np.inf if low.open else value(low.end), np.inf if high.open else value(high.end)
    best = int(np.argmin(costs))
    better = costs[best] < cost - BETTER_FIT * rise
    text = _text(name, units, level, ends, (low, high), value)
    if better:
        text += f"; a better fit was found at {values[best]:.6g}{f' {units}' if units else ''}: identify again from that guess"
    return ProfileLikelihood(name, values, costs, unknowns, ends, best if better else len(low.fixed), text)


def quantile(level: float, degrees_of_freedom: float | None, count: int = 1) -> float:
    """Return psi^2 at the ends of a confidence interval of `count` parameters.

    It is the quantile of chi^2 with `count` degrees of freedom; for noise estimated with `degrees_of_freedom`, `count` times that
    of F.
    """
    known = degrees_of_freedom is None
    return float(chdtri(count, 1.0 - level) if known else count * fdtri(count, degrees_of_freedom, level))


def _walk(fit: FitOthers, index: int, z: np.ndarray, cost: float, step: float, bound: float, rise: float, steps: int) -> _Side:
    """Return one side of a profile, by steps that raise psi equally; beyond the end, search between the two points around it.

    `step` is the signed distance to the expected end, where psi^2 is `rise`.
    """
    end, sign = np.sqrt(rise), np.sign(step)
    inside: tuple[np.ndarray, float] = z, 0.0  # the last point inside the interval, and its psi
    previous, outside = None, None  # the previous point inside; the nearest point outside
    points: list[tuple[np.ndarray, float]] = []
    reason = f"not reached in {steps} steps"
    step = step / STEPS_TO_END
    if sign == 0.0:
        return _Side([], [], [], z[index], _AT_BOUND)
    for _ in range(steps):
        current, psi = inside
        if outside is not None:
            far, beyond = outside
            step = (far[index] - current[index]) * (
                max((end - psi) / (beyond - psi), MOST_SHRINK) if np.isfinite(beyond) else 0.5
            )
        fixed = sign * min(sign * (current[index] + step), sign * bound)
        if fixed == current[index]:  # the step is below the rounding of the unknown
            break
        fraction = 0.0 if previous is None else (fixed - current[index]) / (current[index] - previous[index])
        guess = current + fraction * (current - previous) if previous is not None else current.copy()
        guess[index] = fixed
        narrow = outside is not None and abs(fixed - current[index]) <= END_DISTANCE * abs(fixed - z[index])
        trial, value = fit(index, float(fixed), guess)
        if not np.isfinite(value):
            outside, reason = (guess, np.inf), "no fit was found beyond"
            if narrow:
                break
            continue
        points.append((trial, value))
        reached = np.sqrt(max(2.0 * (value - cost), 0.0))
        if abs(reached - end) <= END_DISTANCE * end:
            inside, reason = (trial, reached), ""
            break
        if reached > end:
            outside, reason = (trial, reached), "" if narrow else f"not reached in {steps} steps"
            if narrow:  # psi jumps at the end
                break
            continue
        slope = (reached - psi) / abs(fixed - current[index])
        # A falling curve may lead to another minimum: do not lengthen the step.
        wanted = abs(step) if slope < 0.0 else min(end / STEPS_TO_END, end - reached) / max(slope, np.finfo(float).eps)
        step = sign * np.clip(wanted, MOST_SHRINK * abs(step), MOST_STRETCH * abs(step))
        previous, inside = current, (trial, reached)
        if fixed == bound:
            reason = _AT_BOUND
            break
    points.sort(key=lambda point: sign * point[0][index])
    return _Side(
        [float(p[index]) for p, _ in points], [p for p, _ in points], [c for _, c in points], float(inside[0][index]), reason
    )


def _text(name: str, units: str, level: float, ends: tuple[float, float], sides: tuple[_Side, _Side], value: Callable) -> str:
    """Return the interval in words; if it is open, with the limits of the search. `value` maps z_k to x."""
    unit = f" {units}" if units else ""
    if np.isfinite(ends).all():
        low, high = (f"{end:.{_digits(ends)}g}" for end in ends)
        return f"{name} is between {low} and {high}{unit} ({100 * level:g} %)"
    limited = [f"{word} {end:.4g}{unit}" for word, end in zip(("above", "below"), ends, strict=True) if np.isfinite(end)]
    searched = [
        f"no {which} end up to {value(side.end):.4g}{unit} ({side.open})"
        for which, side in zip(("lower", "upper"), sides, strict=True)
        if side.open
    ]
    return f"{name} {f'is {limited[0]} ({100 * level:g} %)' if limited else 'is undetermined'}: {', '.join(searched)}"


def _digits(ends: tuple[float, float]) -> int:
    """Return the number of digits that distinguish the ends of an interval."""
    size, width = max(map(abs, ends)), ends[1] - ends[0]
    return max(4, 2 + int(np.ceil(np.log10(size / width)))) if width > 0 else 4
