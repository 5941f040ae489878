"""Agreement of derivatives with finite differences: its measures, the verdict, and messages about disagreement."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.printing import PrintedTable, html_table, text_table
from udkjax.study.differences import best_steps
from udkjax.study.identify.problem.prediction import TolerancePair
from udkjax.wording import join_names

AGREEMENT_RATIO = 3.0  # largest discrepancy, in floors, that is agreement; the parts of a floor are single samples of errors
# Steps with floors up to this factor above the smallest are used as well. Truncation is estimated from the next finer step, whose
# noise is four times as large, so smaller truncation errors are unknown.
SIMILAR_FLOOR_RATIO = 4.5
USEFUL_PRECISION = 0.1  # largest floor, relative to the derivative, at which agreement is meaningful


class DisagreementPlace(NamedTuple):
    """The time (s) at which a derivative and its difference disagree most, and both (in channel units per unit of z)."""

    record: int
    channel: str
    time: float
    derivative: float
    difference: float


@dataclass(frozen=True, eq=False, repr=False)
class GradientCheck:
    """A comparison of derivatives with finite differences, in D directions of z and S series (a channel of a record each).

    All sizes are root mean squares over the times of a series, in the channel's units per unit of z; NaN if runs failed. `print`
    shows the series with the worst agreement for each direction.

    Attributes:
        title: the name of the mechanism.
        names: names of the directions.
        directions: the directions, of unit length.
        series: record and channel of each series; `labels` are their names in messages, `units` the channels' units.
        steps: steps of the differences.
        discrepancy: discrepancy between derivatives and differences, by step.
        noise, truncation: errors of the differences, by step.
        derivative_error: errors of the derivatives.
        size: root mean squares of the derivatives.
        places: times of the worst disagreement (D, S).
        tol: tolerances of the integration.
        other_tol: tolerances at which errors were estimated.
        order: 1 for derivatives, 2 for second derivatives along the directions, compared with differences of derivatives.
    """

    title: str
    names: tuple[str, ...]
    directions: Float[np.ndarray, "D K"]
    series: tuple[tuple[int, str], ...]
    labels: tuple[str, ...]
    units: tuple[str, ...]
    steps: Float[np.ndarray, "H"]
    discrepancy: Float[np.ndarray, "D S H"]
    noise: Float[np.ndarray, "D S H"]
    truncation: Float[np.ndarray, "D S H"]
    derivative_error: Float[np.ndarray, "D S"]
    size: Float[np.ndarray, "D S"]
    places: tuple[tuple[DisagreementPlace, ...], ...]
    tol: TolerancePair
    other_tol: TolerancePair
    order: int = 1

    @property
    def ok(self) -> bool:
        """True if derivatives and differences agree in all directions and series."""
        return bool(self.agrees.all())

    @property
    def agrees(self) -> Bool[np.ndarray, "D S"]:
        """Mask of the directions and series in which the discrepancy is at most `AGREEMENT_RATIO` times the floor."""
        return self.ratio <= AGREEMENT_RATIO

    @cached_property
    def best(self) -> Int[np.ndarray, "D S"]:
        """Index of the step with the most accurate differences; -1 if no step has a known error."""
        return best_steps(self.noise + self.truncation)

    def at_best(self, values: Float[np.ndarray, "D S H"]) -> Float[np.ndarray, "D S"]:
        """Return the values at the best step of each direction and series; NaN where there is no best step."""
        best_values = np.take_along_axis(values, np.maximum(self.best, 0)[..., None], -1)[..., 0]
        return np.where(self.best < 0, np.nan, best_values)

    @property
    def step(self) -> Float[np.ndarray, "D S"]:
        """The step with the most accurate differences."""
        return self.at_best(np.broadcast_to(self.steps, self.noise.shape))

    @property
    def floor(self) -> Float[np.ndarray, "D S"]:
        """The discrepancy that errors explain: noise, truncation, and the error of the derivative."""
        return self.at_best(self.noise + self.truncation) + self.derivative_error

    @property
    def ratio(self) -> Float[np.ndarray, "D S"]:
        """The least ratio of the discrepancy to the floor among the steps that are about as accurate as the best; NaN if unknown.

        A derivative that is wrong is wrong at all of these steps, while a difference may be off at one of them.
        """
        floors = self.noise + self.truncation + self.derivative_error[..., None]
        alike = floors <= SIMILAR_FLOOR_RATIO * self.floor[..., None]
        ratios = np.where(self.discrepancy == 0.0, 0.0, self.discrepancy / np.where(floors == 0.0, np.finfo(float).tiny, floors))
        least = np.min(np.where(alike & ~np.isnan(ratios), ratios, np.inf), -1)
        return np.where(np.isinf(least), self.at_best(ratios), least)

    @property
    def worst(self) -> Int[np.ndarray, "D"]:
        """Index of the series with the worst agreement, for each direction."""
        return np.nan_to_num(self.ratio, nan=np.inf).argmax(1)

    @property
    def message(self) -> str:
        """Remarks on the check, one sentence per line."""
        kind = "second derivatives" if self.order == 2 else "derivatives"
        return "\n".join(_sentences(self)) or f"{kind} agree with finite differences, to within the errors of both"

    def __str__(self) -> str:
        return text_table(table := _table(self), len(table.rows))

    def _repr_html_(self) -> str:
        return html_table(_table(self))

    def __repr__(self) -> str:
        return f"GradientCheck(ok={self.ok}, {len(self.names)} directions, {len(self.series)} series)"


def _sentences(check: GradientCheck) -> list[str]:
    directions: dict[str, list[str]] = {}
    for d, (name, s) in enumerate(zip(check.names, check.worst, strict=True)):
        if sentence := _sentence(check, d, s):
            directions.setdefault(sentence, []).append(name)
    count = len(check.names)
    return [f"{'all directions' if len(names) == count > 1 else join_names(names)}: {text}" for text, names in directions.items()]


def _sentence(check: GradientCheck, d: int, s: int) -> str:
    """Return a sentence about the problem in direction d and series s; "" if there is no problem."""
    floor, size = check.floor[d, s], check.size[d, s]
    if np.isnan(check.noise[d, s]).all():
        return "cannot be compared, since runs with nearby values fail"
    if check.best[d, s] < 0:
        return "cannot be compared, since differences do not converge: the motion jumps, or is too sensitive"
    if not check.agrees[d, s]:
        place, times = check.places[d][s], check.ratio[d, s]
        of = f" of {check.labels[s]}" if len(check.series) > 1 else ""
        kind = "second derivative" if check.order == 2 else "derivative"
        values = f"the {kind} is {place.derivative:.6g}, by differences {place.difference:.6g}"
        remark = f": {times:.2g} times the discrepancy that the errors of both explain" if np.isfinite(times) else ""
        return f"at t = {place.time:.6g} s{of} {values}{remark}"
    if floor > size:
        return f"the derivative is smaller than the accuracy of differences, {floor:.1g} {check.units[s]}".rstrip()
    if floor > USEFUL_PRECISION * size:
        return f"differences are accurate to {floor / size:.0%} only; a smaller tolerance makes them more accurate"
    return ""


def _table(check: GradientCheck) -> PrintedTable:
    several = len(check.series) > 1
    where = ["worst in"] if several else []
    cells, heads = [], ("direction", *where, "size", "differs by", "noise", "truncation", "its error", "step", "")
    errors = [check.at_best(x) for x in (check.discrepancy, check.noise, check.truncation)]
    for d, (name, s) in enumerate(zip(check.names, check.worst, strict=True)):
        size = check.size[d, s]
        scale = np.fmax(size, errors[0][d, s]) or 1.0  # a zero derivative differs by the whole difference
        relative = [f"{values[d, s] / scale:.1e}" for values in (*errors, check.derivative_error)]
        verdict = "agrees" if check.agrees[d, s] else "unknown" if check.best[d, s] < 0 else "DIFFERS"
        where = [check.labels[s]] if several else []
        cells.append((name, *where, f"{size:.3g} {check.units[s]}".rstrip(), *relative, f"{check.step[d, s]:.0e}", verdict))
    kind = "second derivatives" if check.order == 2 else "derivatives"
    title = f"{check.title}: {kind} against finite differences, at a tolerance of {check.tol[0]:.1g}"
    return PrintedTable(title, cells, heads, check.message.splitlines())
