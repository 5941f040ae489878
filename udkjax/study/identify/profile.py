"""The profile likelihood of one unknown: how far it can go while all others make up for it.

With C(z) = r.r / 2 and one unknown z_k held, the others fitted anew, the curve

    psi = +-(2 (C(z_k) - C_min) / s^2)^(1/2)

is a straight line for a linear model, psi = (z_k - estimate) / standard error. All z_k with psi^2 below the quantile of chi^2
with one degree of freedom are a confidence interval that needs no linear model: it may be longer on one side, and it may be open.
(Venzon & Moolgavkar, Applied Statistics 37 (1988) 87; Raue et al., Bioinformatics 25 (2009) 1923.)
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LEVEL = 0.95
PARTS = 4.0  # steps from the estimate to the end of the interval, where the curve is a straight line
FIRST = 0.5  # of a dimensionless unknown: taken for a standard error that is not known
STRETCH = 2.0  # by how much a step may be longer than the one before
SHRINK = 0.1  # and by how much shorter
AT_END = 1e-3  # of psi at the end of the interval: near enough to it
STEPS = 30  # fits to one side
FAR = 20.0  # of a dimensionless unknown, a factor of a hundred million: who gets there is not held by the data
BETTER = 1e-6  # of the rise: costs that are lower than the estimate's by this are not rounding, nor a fit's last digits

_AT_BOUND = "the end of what was looked at"

Fit = Callable[[int, float, np.ndarray], tuple[np.ndarray, float]]


class Profile(NamedTuple):
    """The curve of one unknown, from its smallest value to its largest, and the confidence interval.

    `values` (N,) are x; `costs` (N,) are r.r / 2; `z` (N, K) are all unknowns. An end of the `interval` is infinite where the
    curve does not rise as far. `best` is the index of the lowest cost: not the estimate's where a better fit was met.
    """

    name: str
    values: Float[np.ndarray, "N"]
    costs: Float[np.ndarray, "N"]
    z: Float[np.ndarray, "N K"]
    interval: tuple[float, float]
    best: int
    text: str


class Side(NamedTuple):
    """What one side of a profile has found: z_k, all unknowns, costs; where the interval ends; why it is open, or nothing."""

    held: list[float]
    z: list[np.ndarray]
    costs: list[float]
    end: float
    open: str


def profile(
    fit: Fit,
    index: int,
    z: Float[np.ndarray, "K"],
    cost: float,
    step: float,
    *,
    level: float = LEVEL,
    noise: float = 1.0,
    degrees_of_freedom: float | None = None,
    bounds: tuple[float, float] = (-FAR, FAR),
    value: Callable[[float], float] = lambda z: z,
    name: str = "z",
    units: str = "",
    steps: int = STEPS,
) -> Profile:
    """Walk from an estimate z of the cost r.r / 2 both ways along the unknown `index`, to the ends of its confidence interval.

    `fit(index, held, z0)` minimizes the cost over all other unknowns, beginning at z0, and returns them all, and the cost; a cost
    that is not finite is a failure, before which the walk ends. `step` is a first guess of a standard error of z_k; steps adapt.
    Where the noise was estimated, it is `noise` times what residuals were divided by, and with its `degrees_of_freedom` the
    quantile is that of F with 1 and so many. `bounds` are those of z_k; `value` is x of z_k, which increases.
    """
    limit = quantile(level, degrees_of_freedom)
    rise = limit * noise**2
    ways = []
    for sign, bound in zip((-1.0, 1.0), bounds, strict=True):
        length = min(np.sqrt(limit) * (step if 0 < step < np.inf else FIRST), abs(bound - z[index]))
        ways.append(_walk(fit, index, np.asarray(z, float), cost, sign * length, bound, rise, steps))
    low, high = ways
    held = np.array([*low.held[::-1], z[index], *high.held])
    costs = np.array([*low.costs[::-1], cost, *high.costs])
    every = np.array([*low.z[::-1], z, *high.z])
    values = np.array([value(h) for h in held])
    ends = -np.inf if low.open else value(low.end), np.inf if high.open else value(high.end)
    best = int(np.argmin(costs))
    better = costs[best] < cost - BETTER * rise
    text = _text(name, units, level, ends, (low, high), value)
    if better:
        text += f"; a better fit was met at {values[best]:.6g}{f' {units}' if units else ''}: identify again from there"
    return Profile(name, values, costs, every, ends, best if better else len(low.held), text)


def quantile(level: float, degrees_of_freedom: float | None) -> float:
    """What psi^2 is at the ends of the interval: of chi^2 with one degree of freedom; of F, where the noise was estimated."""
    from scipy.stats import chi2, f

    return float(chi2.ppf(level, 1) if degrees_of_freedom is None else f.ppf(level, 1, degrees_of_freedom))


def _walk(fit: Fit, index: int, z: np.ndarray, cost: float, step: float, bound: float, rise: float, steps: int) -> Side:
    """One side: steps that raise psi by equal parts; where one went past the end, between the two points beside it."""
    end, sign = np.sqrt(rise), np.sign(step)
    inside: tuple[np.ndarray, float] = z, 0.0  # the last point within the interval, and its psi
    before, outside = None, None  # the point within before that one; the nearest beyond
    found: list[tuple[np.ndarray, float]] = []
    reason = f"not in {steps} steps"
    step = step / PARTS
    if sign == 0.0:
        return Side([], [], [], z[index], _AT_BOUND)
    for _ in range(steps):
        here, psi = inside
        if outside is not None:
            there, beyond = outside
            step = (there[index] - here[index]) * (max((end - psi) / (beyond - psi), SHRINK) if np.isfinite(beyond) else 0.5)
        held = sign * min(sign * (here[index] + step), sign * bound)
        part = 0.0 if before is None else (held - here[index]) / (here[index] - before[index])
        guess = here + part * (here - before) if before is not None else here.copy()
        guess[index] = held
        narrow = outside is not None and abs(held - here[index]) <= AT_END * abs(held - z[index])
        trial, value = fit(index, float(held), guess)
        if not np.isfinite(value):
            outside, reason = (guess, np.inf), "no fit was found beyond"
            if narrow:
                break
            continue
        found.append((trial, value))
        reached = np.sqrt(max(2.0 * (value - cost), 0.0))
        if abs(reached - end) <= AT_END * end:
            inside, reason = (trial, reached), ""
            break
        if reached > end:
            outside, reason = (trial, reached), "" if narrow else f"not in {steps} steps"
            if narrow:  # it jumps
                break
            continue
        slope = (reached - psi) / abs(held - here[index])
        # Where the curve falls there may be another minimum: no longer steps there.
        wanted = abs(step) if slope < 0.0 else min(end / PARTS, end - reached) / max(slope, 1e-300)
        step = sign * np.clip(wanted, SHRINK * abs(step), STRETCH * abs(step))
        before, inside = here, (trial, reached)
        if held == bound:
            reason = _AT_BOUND
            break
    found.sort(key=lambda point: sign * point[0][index])
    return Side(
        [float(p[index]) for p, _ in found], [p for p, _ in found], [c for _, c in found], float(inside[0][index]), reason
    )


def _text(name: str, units: str, level: float, ends: tuple[float, float], sides: tuple[Side, Side], value: Callable) -> str:
    """The interval in words, with how far was looked where it is open."""
    unit = f" {units}" if units else ""
    if np.isfinite(ends).all():
        low, high = (f"{end:.{_digits(ends)}g}" for end in ends)
        return f"{name} is between {low} and {high}{unit} ({100 * level:g} %)"
    known = [f"{word} {end:.4g}{unit}" for word, end in zip(("above", "below"), ends, strict=True) if np.isfinite(end)]
    looked = [
        f"no {which} end as far as {value(side.end):.4g}{unit} ({side.open})"
        for which, side in zip(("lower", "upper"), sides, strict=True)
        if side.open
    ]
    return f"{name} {f'is {known[0]} ({100 * level:g} %)' if known else 'is not known'}: {', '.join(looked)}"


def _digits(ends: tuple[float, float]) -> int:
    """Digits that tell the ends of an interval apart."""
    size, width = max(map(abs, ends)), ends[1] - ends[0]
    return max(4, 2 + int(np.ceil(np.log10(size / width)))) if width > 0 else 4
