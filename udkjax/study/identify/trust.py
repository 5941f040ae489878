"""Derivatives against differences: whether those that identification uses are right, as far as differences can tell.

With y(z) what the mechanism with the unknowns z would show, J d is compared with differences of y along directions d: each
unknown by itself, and some in which all of them move. Each evaluation closes the mechanism anew. J has an error of its own, being
that of the motion as it was integrated: by how much it changes at another tolerance. The floor up to which both can agree is that
error and those of the differences, noise and truncation (see `differences`), at the step where they are least. None of this looks
at how far they are apart; where that is more than the floor, the derivative is wrong, or there is none.

Along a chaotic motion even the smallest step leads to quite another one, and there is nothing to compare with: steps h at which
h J d is more than all that a channel shows are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.solution import CAUSES, Result
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify import program
from udkjax.study.identify.differences import STEPS, Differences, differences, sizes
from udkjax.study.identify.directions import listed
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.identify import TOL, posed
from udkjax.study.identify.problem import Evaluated, Problem
from udkjax.study.identify.results import labels, laid_out
from udkjax.study.identify.shooting import Shooting

RANDOM = 3  # directions in which all unknowns move
OTHER = 0.01, 10.0  # of the tolerance: where errors are measured; the second where runs do not come to their end at the first
LEAST = 1e-14  # tolerance: below it, step control follows rounding errors
WITHIN = 3.0  # floors: what counts as agreement. A floor is a sum of sizes, each of which was measured once
TELLING = 0.1  # of the derivative's size: where the floor is higher, agreement says little


class Place(NamedTuple):
    """Where a derivative is furthest from the difference: both, in the channel's units per unit of z, at that time (s)."""

    record: int
    channel: str
    time: float
    derivative: float
    difference: float


@dataclass(frozen=True, eq=False, repr=False)
class GradientCheck:
    """How derivatives compare with differences, in D directions of z and S series: what one channel of one record shows.

    All sizes are root mean squares over the times of a series, in the channel's units per unit of z; not a number where runs did
    not come to their end. `ok` says that all agree. `print` shows, for each direction, the series that agrees worst.
    """

    title: str
    names: tuple[str, ...]
    directions: Float[np.ndarray, "D K"]  # each of length one
    series: tuple[tuple[int, str], ...]  # record, and channel
    said: tuple[str, ...]  # of each series: what it is called
    units: tuple[str, ...]
    steps: Float[np.ndarray, "H"]
    differs: Float[np.ndarray, "D S H"]  # derivatives from differences, by step
    noise: Float[np.ndarray, "D S H"]
    truncation: Float[np.ndarray, "D S H"]
    own: Float[np.ndarray, "D S"]  # errors of the derivatives
    size: Float[np.ndarray, "D S"]  # of the derivatives
    places: tuple[tuple[Place, ...], ...]  # (D, S)
    tol: tuple[float, float]
    other: tuple[float, float]  # the tolerances that errors were measured with

    @property
    def ok(self) -> bool:
        """Whether derivatives and differences agree, up to the floor."""
        return bool(self.agrees.all())

    @property
    def agrees(self) -> Bool[np.ndarray, "D S"]:
        """The same, of each."""
        return self.at_best(self.differs) <= WITHIN * self.floor

    @cached_property
    def best(self) -> Int[np.ndarray, "D S"]:
        """The number of the step at which differences are best; -1 where there is none."""
        return _best(self.noise + self.truncation)

    def at_best(self, values: Float[np.ndarray, "D S H"]) -> Float[np.ndarray, "D S"]:
        """Of values by step, those at the best."""
        found = np.take_along_axis(values, np.maximum(self.best, 0)[..., None], -1)[..., 0]
        return np.where(self.best < 0, np.nan, found)

    @property
    def step(self) -> Float[np.ndarray, "D S"]:
        """The step at which differences are best."""
        return np.where(self.best < 0, np.nan, self.steps[self.best])

    @property
    def floor(self) -> Float[np.ndarray, "D S"]:
        """Up to what derivatives and differences can agree: noise, truncation, and the error of the derivative."""
        return self.at_best(self.noise + self.truncation) + self.own

    @property
    def worst(self) -> Int[np.ndarray, "D"]:
        """For each direction, the series that agrees worst."""
        return np.nan_to_num(self.at_best(self.differs) / self.floor, nan=np.inf).argmax(1)

    @property
    def message(self) -> str:
        """What there is to say, one sentence a line."""
        return "\n".join(_sentences(self)) or "derivatives agree with differences as far as differences can tell"

    def __str__(self) -> str:
        return _text(self)

    def __repr__(self) -> str:
        return f"GradientCheck(ok={self.ok}, {len(self.names)} directions, {len(self.series)} series)"


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
        steps = differences(y, y - beside, series)
        far = steps.steps[:, None] * sizes(slope, series) > steps.largest
        found.append(steps._replace(truncation=np.where(far, np.nan, steps.truncation)))
        places.append(_places(problem, series, slope, found[-1]))
    keys = [(int(problem.where[p[0], 0]), problem.channels[problem.where[p[0], 2]]) for p in series]
    of = [f"{label}, " for label in labels(problem.records)] if len(problem.records) > 1 else [""]
    return GradientCheck(
        title=problem.mechanism.name or "mechanism",
        names=(*names, *(f"all together, at random ({k + 1})" for k in range(len(random)))),
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


def _best(errors: np.ndarray) -> np.ndarray:
    known = np.where(np.isfinite(errors), errors, np.inf)
    return np.where(np.isfinite(known).any(-1), known.argmin(-1), -1)


def _places(
    problem: Problem | Shooting, series: Sequence[np.ndarray], slope: np.ndarray, found: Differences
) -> tuple[Place, ...]:
    places = []
    for rows, best in zip(series, _best((found.noise + found.truncation).T), strict=True):
        difference = found.values[best][rows]
        worst = int(np.argmax(np.abs(difference - slope[rows])))
        record, time, channel = problem.where[rows[worst]]
        name, t = problem.names[channel], float(problem.ts[record, time])
        places.append(Place(int(record), name, t, float(slope[rows[worst]]), float(difference[worst])))
    return tuple(places)


# --- words


def _sentences(check: GradientCheck) -> list[str]:
    found: dict[str, list[str]] = {}
    for d, (name, s) in enumerate(zip(check.names, check.worst, strict=True)):
        if sentence := _sentence(check, d, s):
            found.setdefault(sentence, []).append(name)
    return [f"{listed(names)}: {sentence}" for sentence, names in found.items()]


def _sentence(check: GradientCheck, d: int, s: int) -> str:
    """What there is to say of a direction and a series; nothing where all is well."""
    floor, size = check.floor[d, s], check.size[d, s]
    if np.isnan(check.noise[d, s]).all():
        return "cannot be compared, since runs beside it do not come to their end"
    if check.best[d, s] < 0:
        return "cannot be compared, since differences do not settle: the motion jumps, or is too sensitive"
    if not check.agrees[d, s]:
        return _apart(check, d, s)
    if floor > size:
        return f"the derivative is below {floor:.1g} {check.units[s]}".rstrip() + ", which is all that differences tell of it"
    return (
        f"differences tell the derivative to {floor / size:.0%}; to more with a smaller tolerance"
        if floor > TELLING * size
        else ""
    )


def _apart(check: GradientCheck, d: int, s: int) -> str:
    place, times = check.places[d][s], check.at_best(check.differs)[d, s] / check.floor[d, s]
    at = f"at t = {place.time:.6g} s" + (f" of {check.said[s]}" if len(check.series) > 1 else "")
    values = f"{at} the derivative is {place.derivative:.6g}, by differences {place.difference:.6g}"
    return f"{values}; they are {times:.2g} times further apart than both are off" if np.isfinite(times) else values


def _text(check: GradientCheck) -> str:
    several = len(check.series) > 1
    where = ["worst in"] if several else []
    cells: list[Sequence[str]] = [("direction", *where, "size", "differs by", "noise", "truncation", "own error", "step", "")]
    parts = [check.at_best(x) for x in (check.differs, check.noise, check.truncation)]
    for d, (name, s) in enumerate(zip(check.names, check.worst, strict=True)):
        size, differs = check.size[d, s], parts[0][d, s]
        whole = np.fmax(size, differs) or 1.0  # a derivative of zero differs by all of what differences are
        relative = [f"{part[d, s] / whole:.1e}" for part in (*parts, check.own)]
        verdict = "agrees" if check.agrees[d, s] else "not known" if check.best[d, s] < 0 else "DIFFERS"
        where = [check.said[s]] if several else []
        cells.append((name, *where, f"{size:.3g} {check.units[s]}".rstrip(), *relative, f"{check.step[d, s]:.0e}", verdict))
    title = f"{check.title}: derivatives against differences, at a tolerance of {check.tol[0]:.1g}"
    return "\n".join([title, *laid_out(cells), check.message])
