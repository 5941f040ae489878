"""What comes of comparing derivatives with differences: numbers for machines, a table and sentences for people."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.study.identify.directions import listed
from udkjax.study.identify.results import laid_out

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
        return self.ratio <= WITHIN

    @cached_property
    def best(self) -> Int[np.ndarray, "D S"]:
        """The number of the step at which differences are best; -1 where there is none."""
        return best_of(self.noise + self.truncation)

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
    def ratio(self) -> Float[np.ndarray, "D S"]:
        """How many floors derivatives and differences are apart; not a number where one of them is not known."""
        differs, floor = self.at_best(self.differs), self.floor
        return np.where(differs == 0.0, 0.0, differs / np.where(floor == 0.0, np.finfo(float).tiny, floor))

    @property
    def worst(self) -> Int[np.ndarray, "D"]:
        """For each direction, the series that agrees worst."""
        return np.nan_to_num(self.ratio, nan=np.inf).argmax(1)

    @property
    def message(self) -> str:
        """What there is to say, one sentence a line."""
        return "\n".join(_sentences(self)) or "derivatives agree with differences as far as differences can tell"

    def __str__(self) -> str:
        return _text(self)

    def __repr__(self) -> str:
        return f"GradientCheck(ok={self.ok}, {len(self.names)} directions, {len(self.series)} series)"


def best_of(errors: Float[np.ndarray, "... H"]) -> Int[np.ndarray, "..."]:
    """The number of the least error; -1 where none is known."""
    known = np.where(np.isfinite(errors), errors, np.inf)
    return np.where(np.isfinite(known).any(-1), known.argmin(-1), -1)


# --- words


def _sentences(check: GradientCheck) -> list[str]:
    found: dict[str, list[str]] = {}
    for d, (name, s) in enumerate(zip(check.names, check.worst, strict=True)):
        if sentence := _sentence(check, d, s):
            found.setdefault(sentence, []).append(name)
    every = len(check.names)
    return [f"{'all directions' if len(of) == every > 1 else listed(of)}: {sentence}" for sentence, of in found.items()]


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
    if floor > TELLING * size:
        return f"differences tell the derivative to {floor / size:.0%}; with a smaller tolerance they tell more"
    return ""


def _apart(check: GradientCheck, d: int, s: int) -> str:
    place, times = check.places[d][s], check.ratio[d, s]
    at = f"at t = {place.time:.6g} s" + (f" of {check.said[s]}" if len(check.series) > 1 else "")
    values = f"{at} the derivative is {place.derivative:.6g}, by differences {place.difference:.6g}"
    return f"{values}: {times:.2g} times as far apart as errors of both explain" if np.isfinite(times) else values


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
