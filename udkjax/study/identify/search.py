"""Which first guesses a fit sets out from, and along which records: no more than a fit needs.

A long record has many minima: one for each number of swings by which a guess can be wrong. So a fit that does not explain the
whole record from its first guess begins with the first few samples, which have one minimum, and takes more and more of the
record, each time from where it was; and where that fails too, from other guesses beside the first. What is left are records
of chaotic motion: see shooting.py.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.study.identify.fitting import Fit, descend
from udkjax.study.identify.problem import Evaluated, Problem
from udkjax.study.identify.shooting import Lost, Shooting, shoot
from udkjax.study.identify.unknowns import Unknowns

# Tolerance of the integration on the way, and the change of an unknown below which it decides: what is left is polished away at
# the end.
LOOSE, SETTLED = 1e-7, 1e-5
CHAOTIC = 100.0  # times larger derivatives in the second halves of records than in the first: t^2 makes 4 of it
SHOTS = 4  # guesses from which the records are looked at in pieces
PIECEWISE = 1e-9  # tolerance of the integration of pieces: what holds them together is no better
TRIED = 25  # steps from a first guess along the whole record: a fit that does not settle in them is on its way to nowhere
ON_THE_WAY = 15, 1e-3  # steps along a part of a record, and the change of an unknown at which they are enough
SAMPLES = 3.0  # residuals per unknown in the first part of a record that is looked at
GROWTH = 2.0  # of the part of the record that is looked at
BESIDE = 0.5  # of a value: how far other guesses are from the first
GUESSES = 15  # others than the first, where it does not lead to a fit
EXPLAINED = 1e-3  # of what the channels show: residuals below this are taken for a fit, whatever their noise
LIKELY = 2.0  # mean square of residuals whose noise is known, at which they are taken for a fit
WHITE = 4.0  # standard deviations of the correlation of neighbouring residuals, up to which they are taken for noise
SAME = 1e-4  # of an unknown: fits this near are at one minimum

Strategy = Literal["auto", "pieces"]


class Found(NamedTuple):
    """The best fit, how many of how many first guesses led there, and what was done, in words."""

    fit: Fit
    agreeing: int
    guesses: int
    ways: tuple[str, ...]
    history: list[tuple[float, ...]]
    problem: Problem | Shooting  # that the unknowns of the fit are of


def search(
    problem: Problem,
    z: Float[np.ndarray, "B K"],
    tol: tuple[float, float],
    more: int = GUESSES,
    seed: int = 0,
    tell: Callable[[str], None] = lambda text: None,
    strategy: Strategy = "auto",
    **choices: Any,
) -> Found:
    """Find the unknowns that explain the records best, from first guesses (B, K) and, if needed, `more` beside the first.

    Where all that fails, and the guesses do not agree or the motion is chaotic, the records are cut into pieces; with the
    strategy "pieces" at once.
    """
    loose = max(tol[0], LOOSE), max(tol[1], LOOSE)
    if strategy == "pieces":
        along = growing(problem, z, loose, tell, **choices)
        if found := in_pieces(problem, np.concatenate([along.z, z]), tol, tell, **choices):
            return found._replace(history=along.history + found.history)
    ways, history, tried = ["whole records"], [], [z]
    fit = descend(problem, z, loose, None, TRIED, SETTLED, tell=_telling(tell, "whole records"), **choices)
    history += fit.history
    if not explains(problem, fit, loose, choices.get("loss")):
        ways.append("growing records")
        other = growing(problem, z, loose, tell, **choices)
        history += other.history
        tried = [other.z, z]
        fit = _better(fit, other)
    if more and not explains(problem, fit, loose, choices.get("loss")):
        ways.append(f"{more} more first guesses")
        guesses = beside(problem.unknowns, z[0], more, seed)
        other = growing(problem, guesses, loose, tell, **choices)
        history += other.history
        z = np.concatenate([z, guesses])
        tried.append(other.z)
        fit = _together(fit, other)
    best = int(np.argmin(fit.cost))
    there = np.abs(fit.z - fit.z[best]).max(1) <= SAME * (1.0 + np.abs(fit.z[best]).max())
    agreeing = int((there & np.isfinite(fit.cost)).sum())
    only = Fit(fit.z[best : best + 1], fit.cost[best : best + 1], fit.settled[best : best + 1], fit.evaluations, fit.history)
    lost = 2 * agreeing < len(z) or chaotic(problem, only.z, loose)  # else it is the mechanism that does not move like that
    if more and lost and not explains(problem, only, loose, choices.get("loss")):
        found = in_pieces(problem, np.concatenate(tried), tol, tell, **choices)
        if found:
            return found._replace(guesses=len(z), ways=(*ways, *found.ways), history=history + found.history)
    return Found(only, agreeing, len(z), tuple(ways), history, problem)


def in_pieces(
    problem: Problem, z: Float[np.ndarray, "B K"], tol: tuple[float, float], tell: Callable[[str], None], **choices: Any
) -> Found | None:
    """Fit the records in pieces, from the most promising guesses until one explains them; None: none does.

    Where the motion is not so chaotic that whole records are beyond the errors of their integration, the fit is of these.
    """
    loose = max(tol[0], PIECEWISE), max(tol[1], PIECEWISE)
    for k, guess in enumerate(promising(problem, z, loose)[:SHOTS]):
        try:
            pieces, fit = shoot(problem, guess, loose, tell=tell, **choices)
        except Lost:
            continue
        if explains(pieces, fit, loose, choices.get("loss")):
            history = fit.history
            found = Found(fit, 1, k + 1, ("records in pieces",), history, pieces)
            say = _telling(tell, "whole records")
            whole = descend(problem, fit.z[:, : problem.K], tol, None, TRIED, SETTLED, near=True, tell=say, **choices)
            if explains(problem, whole, tol, choices.get("loss")):
                return found._replace(fit=whole, history=history + whole.history, problem=problem)
            return found
    return None


def chaotic(problem: Problem, z: Float[np.ndarray, "1 K"], tol: tuple[float, float]) -> bool:
    """Whether what a change does grows along a record as it does not where motions only fall out of step: like t or t^2."""
    record, time, _ = problem.where.T
    late = problem.ts[record, time] > 0.5 * (problem.ts[record, 0] + problem.ts[record, -1])
    J = np.abs(problem.evaluate(z, tol).J[0, : len(problem.where), : len(problem.unknowns.names)])
    with np.errstate(invalid="ignore", divide="ignore"):
        return bool((J[late].max(0, initial=0.0) / J[~late].max(0, initial=0.0) > CHAOTIC).any())


def promising(problem: Problem, z: Float[np.ndarray, "B K"], tol: tuple[float, float]) -> Float[np.ndarray, "B K"]:
    """Guesses, the best first: those that leave least of the records and of their first parts, which all count alike."""
    with np.errstate(divide="ignore"):
        logs = [np.log(np.sum(np.square(problem.evaluate(z, tol, part).r), axis=1)) for part in horizons(problem)]
    return z[np.argsort(np.nan_to_num(np.sum(logs, axis=0), nan=np.inf), kind="stable")]


def growing(
    problem: Problem, z: Float[np.ndarray, "B K"], tol: tuple[float, float], tell: Callable[[str], None], **choices: Any
) -> Fit:
    """Fit more and more of the records, each time from where the fits of the part before have ended."""
    parts = horizons(problem)
    steps, settled = ON_THE_WAY
    history = []
    for k, part in enumerate(parts):
        say = _telling(tell, f"{part:.0%} of the records")
        if k < len(parts) - 1:
            fit = descend(problem, z, tol, part, steps, settled, tell=say, **choices)
            z = np.where(np.isfinite(fit.cost)[:, None], fit.z, z)
        else:
            fit = descend(problem, z, tol, settled=SETTLED, tell=say, **choices)
        history += fit.history
    return fit._replace(history=history)  # pyright: ignore[reportPossiblyUnboundVariable]


def horizons(problem: Problem) -> list[float]:
    """Parts of the records to look at, one after another: the last is all of them."""
    record, time, _ = problem.where.T
    ts = problem.ts
    passed = np.sort((ts[record, time] - ts[record, 0]) / (ts[record, -1] - ts[record, 0]))
    enough = min(int(SAMPLES * problem.K), len(passed) - 1)
    first = max(float(passed[enough]), 1e-6)
    count = max(0, int(np.ceil(np.log(1.0 / first) / np.log(GROWTH))))
    return [GROWTH ** (k - count) for k in range(count)] + [1.0]


def beside(u: Unknowns, z: Float[np.ndarray, "K"], count: int, seed: int) -> Float[np.ndarray, "B K"]:
    """Guesses beside a first one: each parameter within a half of its value, or anywhere between its bounds.

    Unknowns of starts, which come after the parameters, are moved by a little.
    """
    from scipy.stats import qmc

    P = len(u.names)
    unit = qmc.Sobol(len(z), rng=seed).random(1 << max(0, int(np.ceil(np.log2(count)))))[:count]
    x0 = u.values(z[None, :P])[0]
    bounded = np.array([kind == "bounded" for kind in u.kinds])
    size = np.where([kind == "positive" for kind in u.kinds], x0, u.scale)
    low, high = np.where(bounded, u.low, x0 - BESIDE * size), np.where(bounded, u.high, x0 + BESIDE * size)
    inside = 0.02 + 0.96 * unit[:, :P]  # bounds themselves are infinitely far
    starts = z[P:] + 0.1 * (unit[:, P:] - 0.5)
    return np.concatenate([u.unknowns(low + (high - low) * inside), starts], axis=1)


def explains(problem: Problem | Shooting, fit: Fit, tol: tuple[float, float], loss: Any) -> bool:
    """Whether the best of some fits leaves nothing but noise."""
    best = int(np.argmin(fit.cost))
    if not (np.isfinite(fit.cost[best]) and fit.settled[best]):
        return False
    found: Evaluated = problem.evaluate(fit.z[best : best + 1], tol)
    if not found.ok[0]:
        return False
    r = found.r[0, : len(problem.where)]
    size = np.mean(r[problem.known] ** 2) <= LIKELY if problem.known.any() else True
    rest = r[~problem.known]
    if size and (not rest.size or np.sqrt(np.mean(rest**2)) <= EXPLAINED):
        return True
    return all(white(r[places]) for places in problem.series())


def white(r: np.ndarray) -> bool:
    """Whether residuals in the order of time are not correlated with those before them."""
    power = r @ r
    return len(r) < 3 or power == 0.0 or abs(r[1:] @ r[:-1]) / power <= WHITE / np.sqrt(len(r))


def _better(one: Fit, two: Fit) -> Fit:
    """The better of two fits from each guess."""
    which = two.cost < one.cost
    z = np.where(which[:, None], two.z, one.z)
    cost, settled = np.where(which, two.cost, one.cost), np.where(which, two.settled, one.settled)
    return Fit(z, cost, settled, two.evaluations, one.history)


def _together(one: Fit, two: Fit) -> Fit:
    """Fits from some guesses, then those from others."""
    z, cost, settled = (np.concatenate(pair) for pair in zip(one[:3], two[:3], strict=True))
    return Fit(z, cost, settled, two.evaluations, one.history)


def _telling(tell: Callable[[str], None], what: str) -> Callable[[str], None]:
    return lambda text: tell(f"{what}: {text}")
