"""Derivatives against differences: whether those that identification uses are right, as far as differences can show.

With y(z) what the mechanism with the unknowns z would show, J d is compared with differences of y along directions d: each
unknown by itself, and some in which all of them move. Each evaluation closes the mechanism anew. J has an error of its own, being
that of the motion as it was integrated: by how much it changes at another tolerance. The floor up to which both can agree is that
error and those of the differences, noise and truncation (see `differences`), at the step where they are least. None of this looks
at how far they are apart; where that is more than the floor, the derivative is wrong, or there is none.

Along a chaotic motion even the smallest step leads to quite another one, and there is nothing to compare with. So steps are left
out whose h J d is more than all that a channel shows, if it moves at all.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.solution import CAUSES, Result
from udkjax.printing import PrintedTable, html_table, text_table
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.wording import join_names
from udkjax.study.differences import DIFFERENCE_STEPS, Differences, best_steps, differences, leave_out_far_steps, sizes
from udkjax.study.identify import prediction
from udkjax.study.identify.fit_problem import FitProblem, Residuals, build_problem
from udkjax.study.identify.parameters import ParametersLike
from udkjax.study.identify.prediction import TIGHT_TOL, TolerancePair
from udkjax.study.identify.record_reader import Data
from udkjax.study.identify.records import IdentificationError, label_prefixes

AGREEMENT = 3.0  # floors: a floor is a sum of sizes, each of which was measured once
USEFUL_PRECISION = 0.1  # of the derivative's size: where the floor is higher, agreement says little
RANDOM_DIRECTIONS = 3  # in which all unknowns move
OTHER_TOL = 0.01, 10.0  # of the tolerance: where errors are measured; the second where runs fail at the first
SMALLEST_TOL = 1e-14  # below it, step control follows rounding errors


class DisagreementPlace(NamedTuple):
    """A time (s) at which a derivative differs most from its difference; both are in units of the channel per unit of z."""

    record: int
    channel: str
    time: float
    derivative: float
    difference: float


@dataclass(frozen=True, eq=False, repr=False)
class GradientCheck:
    """A comparison of derivatives with differences, in D directions of z and S series: what one channel of one record shows.

    All sizes are root mean squares over the times of a series, in the channel's units per unit of z; not a number where runs did
    not come to their end. `print` shows, for each direction, the series that agrees worst.

    Attributes:
        title: the name of the mechanism.
        names: of the directions.
        directions: each of length one.
        series: record and channel; `labels` are what messages call it, `units` those of the channel.
        steps: of the differences.
        discrepancy: between derivatives and differences, by step.
        noise, truncation: errors of the differences, by step.
        derivative_error: errors of the derivatives.
        size: of the derivatives.
        places: places where each is furthest off (D, S).
        tol: tolerances of the integration.
        other_tol: tolerances that errors were measured with.
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

    @property
    def ok(self) -> bool:
        """True if derivatives and differences agree, up to the floor."""
        return bool(self.agrees.all())

    @property
    def agrees(self) -> Bool[np.ndarray, "D S"]:
        """For each direction and series, True if they agree."""
        return self.ratio <= AGREEMENT

    @cached_property
    def best(self) -> Int[np.ndarray, "D S"]:
        """The number of the step at which differences are best; -1 where there is none."""
        return best_steps(self.noise + self.truncation)

    def at_best(self, values: Float[np.ndarray, "D S H"]) -> Float[np.ndarray, "D S"]:
        """Return of values by step those at the best step."""
        found = np.take_along_axis(values, np.maximum(self.best, 0)[..., None], -1)[..., 0]
        return np.where(self.best < 0, np.nan, found)

    @property
    def step(self) -> Float[np.ndarray, "D S"]:
        """The step at which differences are best."""
        return self.at_best(np.broadcast_to(self.steps, self.noise.shape))

    @property
    def floor(self) -> Float[np.ndarray, "D S"]:
        """Up to what derivatives and differences can agree: noise, truncation, and the error of the derivative."""
        return self.at_best(self.noise + self.truncation) + self.derivative_error

    @property
    def ratio(self) -> Float[np.ndarray, "D S"]:
        """The discrepancy over the floor; not a number where one of them is not known."""
        discrepancy, floor = self.at_best(self.discrepancy), self.floor
        return np.where(discrepancy == 0.0, 0.0, discrepancy / np.where(floor == 0.0, np.finfo(float).tiny, floor))

    @property
    def worst(self) -> Int[np.ndarray, "D"]:
        """For each direction, the series that agrees worst."""
        return np.nan_to_num(self.ratio, nan=np.inf).argmax(1)

    @property
    def message(self) -> str:
        """Remarks on the check, one sentence a line."""
        return "\n".join(_sentences(self)) or "derivatives agree with differences as far as differences can tell"

    def __str__(self) -> str:
        return text_table(table := _table(self), len(table.rows))

    def _repr_html_(self) -> str:
        return html_table(_table(self))

    def __repr__(self) -> str:
        return f"GradientCheck(ok={self.ok}, {len(self.names)} directions, {len(self.series)} series)"


@checked
def check_gradients(
    mechanism: Mechanism,
    data: Data,
    parameters: ParametersLike,
    *,
    tol: float = TIGHT_TOL,
    ignore: Sequence[str] = (),
    seed: int = 0,
    **settings: Any,
) -> GradientCheck:
    """Compare the derivatives that `identify` uses with differences, at the first guess of the parameters.

    Directions are each unknown by itself, and a few in which all of them move; in each, the mechanism is closed anew and run
    forty times. At an estimate there is `Estimate.check_gradients`.

    Args:
        mechanism: with first guesses.
        data: records, as for `identify`; only times, names of channels and initial states matter.
        parameters: parameters, as for `identify`.
        tol: tolerance of the integration, relative and absolute.
        ignore: columns of tables that are not read.
        seed: of the directions in which all unknowns move.
        settings: of `simulate`.

    Returns:
        The comparison: `ok` says whether all derivatives agree, `print` shows a table.

    Raises:
        IdentificationError: as `identify` does, and where the motion itself does not come to its end.
    """
    problem = build_problem(mechanism, data, parameters, settings, ignore=ignore, seed=seed)
    return compare_gradients(problem, np.zeros(problem.K), (tol, tol), seed)


def compare_gradients(problem: FitProblem, z: Float[np.ndarray, "K"], tol: TolerancePair, seed: int = 0) -> GradientCheck:
    """Compare the derivatives of a problem at z with differences, at tolerances of the integration."""
    rows, names = len(problem.index), problem.all_names[: problem.K - problem.constrained]
    _, residuals = _evaluate_first(problem, z, [tol])
    smaller, larger = ((max(factor * tol[0], SMALLEST_TOL), max(factor * tol[1], SMALLEST_TOL)) for factor in OTHER_TOL)
    others = [smaller, larger] if smaller[0] < tol[0] and smaller[1] < tol[1] else [larger]
    other, with_other = _evaluate_first(problem, z, others)
    series = problem.series()
    random = np.random.default_rng(seed).standard_normal((RANDOM_DIRECTIONS if problem.K > 1 else 0, problem.K))
    directions = np.concatenate([np.eye(problem.K)[: len(names)], random / np.linalg.norm(random, axis=1, keepdims=True)])
    J, error = (problem.sigma[:, None] * part[0, :rows] for part in (residuals.J, residuals.J - with_other.J))
    derivatives = directions @ J.T
    found, places = [], []
    for d, slope in zip(directions, derivatives, strict=True):
        points = z + np.concatenate([DIFFERENCE_STEPS, -DIFFERENCE_STEPS])[:, None] * d
        y, y_other = (_predict(problem, points, by).reshape(2, len(DIFFERENCE_STEPS), rows).swapaxes(0, 1) for by in (tol, other))
        found.append(leave_out_far_steps(differences(y, y - y_other, series), sizes(slope, series), series))
        places.append(_places(problem, series, slope, found[-1]))
    keys = [(int(problem.index[p[0], 0]), problem.channels[problem.index[p[0], 2]]) for p in series]
    prefixes = label_prefixes(problem.records)
    return GradientCheck(
        title=problem.mechanism.name or "mechanism",
        names=(*names, *(f"random direction {k + 1}" for k in range(len(random)))),
        directions=directions,
        series=tuple((k, channel.name) for k, channel in keys),
        labels=tuple(prefixes[k] + channel.name for k, channel in keys),
        units=tuple(channel.units for _, channel in keys),
        steps=found[0].steps,
        discrepancy=np.stack([sizes(f.values - slope, series).T for f, slope in zip(found, derivatives, strict=True)]),
        noise=np.stack([f.noise.T for f in found]),
        truncation=np.stack([f.truncation.T for f in found]),
        derivative_error=sizes(directions @ error.T, series),
        size=sizes(derivatives, series),
        places=tuple(places),
        tol=tol,
        other_tol=other,
    )


def _evaluate_first(problem: FitProblem, z: np.ndarray, tols: Sequence[TolerancePair]) -> tuple[TolerancePair, Residuals]:
    """Return the first of some tolerances at which runs come to their end, and the residuals with it."""
    for tol in tols:
        found = problem.evaluate(z[None], tol)
        if found.code[0] == Result.successful and np.isfinite(found.r[0]).all():
            return tol, found
    code = Result(int(found.code[0]))
    cause = "some of its channels are not numbers" if code == Result.successful else CAUSES[code]
    raise IdentificationError([f"there are no derivatives to be checked: {cause}"])


def _predict(problem: FitProblem, z: Float[np.ndarray, "B K"], tol: TolerancePair) -> Float[np.ndarray, "B R"]:
    """Return the predictions of channels, in their units; nan where a run does not come to its end."""
    rows = len(problem.index)
    # Few at a time, so that they are computed one by one: lanes would have to be compiled.
    together = max(1, (prediction.FEWEST_IN_LANES - 1) // len(problem.columns))
    parts = [problem.evaluate(z[k : k + together], tol) for k in range(0, len(z), together)]
    r, code = np.concatenate([part.r for part in parts]), np.concatenate([part.code for part in parts])
    values = r[:, :rows] * problem.sigma + problem.y[problem.present]
    return np.where((code == Result.successful)[:, None], values, np.nan)


def _places(
    problem: FitProblem, series: Sequence[np.ndarray], slope: np.ndarray, found: Differences
) -> tuple[DisagreementPlace, ...]:
    places = []
    for rows, best in zip(series, best_steps((found.noise + found.truncation).T), strict=True):
        difference = found.values[best][rows]
        worst = int(np.argmax(np.abs(difference - slope[rows])))
        record, time, channel = problem.index[rows[worst]]
        name, t = problem.channel_names[channel], float(problem.ts[record, time])
        places.append(DisagreementPlace(int(record), name, t, float(slope[rows[worst]]), float(difference[worst])))
    return tuple(places)


# --- words


def _sentences(check: GradientCheck) -> list[str]:
    found: dict[str, list[str]] = {}
    for d, (name, s) in enumerate(zip(check.names, check.worst, strict=True)):
        if sentence := _sentence(check, d, s):
            found.setdefault(sentence, []).append(name)
    count = len(check.names)
    return [f"{'all directions' if len(names) == count > 1 else join_names(names)}: {text}" for text, names in found.items()]


def _sentence(check: GradientCheck, d: int, s: int) -> str:
    """Return a sentence on a direction and a series; nothing where all is well."""
    floor, size = check.floor[d, s], check.size[d, s]
    if np.isnan(check.noise[d, s]).all():
        return "cannot be compared, since runs beside it do not come to their end"
    if check.best[d, s] < 0:
        return "cannot be compared, since differences do not settle: the motion jumps, or is too sensitive"
    if not check.agrees[d, s]:
        place, times = check.places[d][s], check.ratio[d, s]
        of = f" of {check.labels[s]}" if len(check.series) > 1 else ""
        values = f"the derivative is {place.derivative:.6g}, by differences {place.difference:.6g}"
        remark = f": {times:.2g} times as far apart as errors of both explain" if np.isfinite(times) else ""
        return f"at t = {place.time:.6g} s{of} {values}{remark}"
    if floor > size:
        return f"the derivative is below {floor:.1g} {check.units[s]}".rstrip() + ", which is all that differences tell of it"
    if floor > USEFUL_PRECISION * size:
        return f"differences tell the derivative to {floor / size:.0%}; with a smaller tolerance they tell more"
    return ""


def _table(check: GradientCheck) -> PrintedTable:
    several = len(check.series) > 1
    where = ["worst in"] if several else []
    cells, heads = [], ("direction", *where, "size", "differs by", "noise", "truncation", "own error", "step", "")
    parts = [check.at_best(x) for x in (check.discrepancy, check.noise, check.truncation)]
    for d, (name, s) in enumerate(zip(check.names, check.worst, strict=True)):
        size = check.size[d, s]
        whole = np.fmax(size, parts[0][d, s]) or 1.0  # a derivative of zero differs by all of what differences are
        relative = [f"{part[d, s] / whole:.1e}" for part in (*parts, check.derivative_error)]
        verdict = "agrees" if check.agrees[d, s] else "not known" if check.best[d, s] < 0 else "DIFFERS"
        where = [check.labels[s]] if several else []
        cells.append((name, *where, f"{size:.3g} {check.units[s]}".rstrip(), *relative, f"{check.step[d, s]:.0e}", verdict))
    title = f"{check.title}: derivatives against differences, at a tolerance of {check.tol[0]:.1g}"
    return PrintedTable(title, cells, heads, check.message.splitlines())
