"""Derivatives against differences: whether those that identification uses are right, as far as differences can tell.

With y(z) what the mechanism with the unknowns z would show, J d is compared with differences of y along directions d: each
unknown by itself, and some in which all of them move. Each evaluation closes the mechanism anew. J has an error of its own, being
that of the motion as it was integrated: by how much it changes at another tolerance. The floor up to which both can agree is that
error and those of the differences, noise and truncation (see `differences`), at the step where they are least. None of this looks
at how far they are apart; where that is more than the floor, the derivative is wrong, or there is none.

Along a chaotic motion even the smallest step leads to quite another one, and there is nothing to compare with. So steps are left
out whose h J d is more than all that a channel shows, if it moves at all.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from udkjax.integrate.solution import CAUSES, Result
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify import program
from udkjax.study.identify.agreement import GradientCheck, Place, best_of
from udkjax.study.identify.differences import STEPS, Differences, differences, sizes
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.posing import TOL, posed
from udkjax.study.identify.problem import Evaluated, Problem
from udkjax.study.identify.results import labels
from udkjax.study.identify.shooting import Shooting

RANDOM = 3  # directions in which all unknowns move
OTHER = 0.01, 10.0  # of the tolerance: where errors are measured; the second where runs do not come to their end at the first
MOVES = 1e-2  # of what a channel shows: the least change that is more than that of a small step
LEAST = 1e-14  # tolerance: below it, step control follows rounding errors


def check_gradients(
    mechanism: Mechanism,
    data: Any,
    parameters: Sequence[Any] | str,
    *,
    tol: float = TOL,
    ignore: Sequence[str] = (),
    seed: int = 0,
    **settings: Any,
) -> GradientCheck:
    """Compare the derivatives that identification uses with differences, at the first guess of the parameters.

    Arguments are those of `identify`; of the data, only times, names of channels and starts matter. Directions are each unknown
    by itself, and a few in which all of them move, which `seed` decides about; in each, the mechanism is closed anew and run
    forty times, by the program that `identify` uses. At an estimate there is `Estimate.check_gradients`.

    Raises `IdentificationError` as `identify` does, and where the motion itself does not come to its end.
    """
    problem = posed(mechanism, data, parameters, settings, ignore=ignore, seed=seed)
    return compare(problem, np.zeros(problem.K), (tol, tol), seed)


def compare(problem: Problem | Shooting, z: Float[np.ndarray, "K"], tol: tuple[float, float], seed: int = 0) -> GradientCheck:
    """Compare the derivatives of a problem at z with differences, at tolerances of the integration."""
    rows, names = len(problem.where), problem.all_names[: problem.K - problem.tied]
    here = problem.evaluate(z[None], tol)
    _require_run(here)
    other, there = _other(problem, z, tol)
    series = problem.series()
    random = np.random.default_rng(seed).standard_normal((RANDOM if problem.K > 1 else 0, problem.K))
    directions = np.concatenate([np.eye(problem.K)[: len(names)], random / np.linalg.norm(random, axis=1, keepdims=True)])
    J, change = (problem.sigma[:, None] * part[0, :rows] for part in (here.J, here.J - there.J))
    slopes = directions @ J.T
    found, places = [], []
    for d, slope in zip(directions, slopes, strict=True):
        points = z + np.concatenate([STEPS, -STEPS])[:, None] * d
        y, beside = (_seen(problem, points, by).reshape(2, len(STEPS), rows).swapaxes(0, 1) for by in (tol, other))
        found.append(_without_far(differences(y, y - beside, series), sizes(slope, series), series))
        places.append(_places(problem, series, slope, found[-1]))
    keys = [(int(problem.where[p[0], 0]), problem.channels[problem.where[p[0], 2]]) for p in series]
    of = [f"{label}, " for label in labels(problem.records)] if len(problem.records) > 1 else [""]
    return GradientCheck(
        title=problem.mechanism.name or "mechanism",
        names=(*names, *(f"random direction {k + 1}" for k in range(len(random)))),
        directions=directions,
        series=tuple((k, channel.name) for k, channel in keys),
        said=tuple(of[k] + channel.name for k, channel in keys),
        units=tuple(channel.units for _, channel in keys),
        steps=found[0].steps,
        differs=np.stack([sizes(f.values - slope, series).T for f, slope in zip(found, slopes, strict=True)]),
        noise=np.stack([f.noise.T for f in found]),
        truncation=np.stack([f.truncation.T for f in found]),
        own=sizes(directions @ change.T, series),
        size=sizes(slopes, series),
        places=tuple(places),
        tol=tol,
        other=other,
    )


def _ran(found: Evaluated) -> bool:
    return bool(found.code[0] == Result.successful and np.isfinite(found.r[0]).all())


def _require_run(found: Evaluated) -> None:
    if not _ran(found):
        code = Result(int(found.code[0]))
        cause = "some of its channels are not numbers" if code == Result.successful else CAUSES[code]
        raise IdentificationError([f"there are no derivatives to be checked: {cause}"])


def _other(problem: Problem | Shooting, z: np.ndarray, tol: tuple[float, float]) -> tuple[tuple[float, float], Evaluated]:
    """Tolerances at which runs come to their end, and what there is at z."""
    smaller, larger = ((max(factor * tol[0], LEAST), max(factor * tol[1], LEAST)) for factor in OTHER)
    if smaller[0] < tol[0] and smaller[1] < tol[1]:
        found = problem.evaluate(z[None], smaller)
        if _ran(found):
            return smaller, found
    found = problem.evaluate(z[None], larger)
    _require_run(found)
    return larger, found


def _seen(problem: Problem | Shooting, z: Float[np.ndarray, "B K"], tol: tuple[float, float]) -> Float[np.ndarray, "B R"]:
    """What channels show, in their units; no numbers where a run does not come to its end."""
    rows = len(problem.where)
    # As many at a time as are computed one by one: lanes are another program.
    together = max(1, (program.MANY - 1) // len(getattr(problem, "pieces", problem.records)))
    parts = [problem.evaluate(z[k : k + together], tol) for k in range(0, len(z), together)]
    r, code = np.concatenate([part.r for part in parts]), np.concatenate([part.code for part in parts])
    seen = r[:, :rows] * problem.sigma + problem.y[problem.there]
    return np.where((code == Result.successful)[:, None], seen, np.nan)


def _without_far(found: Differences, size: Float[np.ndarray, "S"], series: Sequence[np.ndarray]) -> Differences:
    """Differences without the steps that lead to quite another motion."""
    h = found.steps[:, None]
    far = (h * size > found.largest) & (h * sizes(found.values, series) > MOVES * found.largest)
    return found._replace(truncation=np.where(far, np.nan, found.truncation))


def _places(
    problem: Problem | Shooting, series: Sequence[np.ndarray], slope: np.ndarray, found: Differences
) -> tuple[Place, ...]:
    places = []
    for rows, best in zip(series, best_of((found.noise + found.truncation).T), strict=True):
        difference = found.values[best][rows]
        worst = int(np.argmax(np.abs(difference - slope[rows])))
        record, time, channel = problem.where[rows[worst]]
        name, t = problem.names[channel], float(problem.ts[record, time])
        places.append(Place(int(record), name, t, float(slope[rows[worst]]), float(difference[worst])))
    return tuple(places)
