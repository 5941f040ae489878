"""An estimate as a table, as text, and as a dataset."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from udkjax.integrate.solution import scene_text, versions

if TYPE_CHECKING:
    from udkjax.study.identify.estimate import Estimate

FORMAT = "udkjax identification 1"
MOST = 12  # digits of a number that is said to people
NOISES = 6  # channels whose noise is said


class Row(NamedTuple):
    """A number that was found: a parameter, or by how much a start was moved."""

    parameter: str
    value: float
    standard_error: float
    units: str
    first_guess: float
    note: str


def rows(estimate: "Estimate") -> list[Row]:
    """What was found, in the order in which it was asked for; then what was found of starts."""
    known, unknowns = estimate.knowledge, estimate.problem.unknowns
    found = [
        Row(name, float(value), float(error), units, float(first), _note(estimate, name))
        for name, value, error, units, first in zip(
            estimate.names, estimate.values, known.standard_errors, estimate.units, unknowns.start, strict=True
        )
    ]
    units = dict(zip(estimate.problem.all_names, estimate.problem.all_units, strict=True))
    for name, (change, error) in estimate.start_values.items():
        found.append(Row(name, change, error, units[name], 0.0, "added to the guess of the start"))
    return found


def _note(estimate: "Estimate", name: str) -> str:
    known, found = estimate.knowledge, []
    if name in known.dead:
        found.append("shows in nothing that was measured")
    if any(name in flat.names for flat in known.flat):
        found.append("cannot be told from others" if any(len(f.names) > 1 for f in known.flat if name in f.names) else "unknown")
    if name in known.poor:
        found.append("poorly known")
    if name in estimate.at_bounds:
        found.append("at a bound")
    return ", ".join(found)


def text(estimate: "Estimate") -> str:
    """The same to be read: the table, how the fit ended, how large the residuals are, and all that is to be said."""
    problem, known = estimate.problem, estimate.knowledge
    numbers, count = len(problem.where), len(problem.records)
    title = estimate.mechanism.name or "mechanism"
    head = f"{title}: {_count(len(estimate.names), 'parameter')} from {_count(numbers, 'number')} in {_count(count, 'record')}"
    cells = [("parameter", "value", "standard error", "unit", "first guess", "")]
    for row in rows(estimate):
        error = "unknown" if not math.isfinite(row.standard_error) else f"{row.standard_error:.2g}"
        value = rounded(row.value, row.standard_error)
        cells.append((row.parameter, value, error, row.units, f"{row.first_guess:.6g}", row.note))
    ended = "settled" if estimate.converged else "not settled"
    agreed = f", {estimate.agreeing} of {estimate.guesses} first guesses led here" if estimate.guesses > 1 else ""
    facts = {"fit": f"{ended} after {_count(estimate.evaluations, 'evaluation')} in {estimate.seconds:.1f} s{agreed}"}
    if problem.known.any():
        facts["chi^2"] = f"{known.chi2:.4g} with {known.degrees_of_freedom} degrees of freedom"
    if not problem.known.all():
        facts["noise, estimated"] = ", ".join(_noises(estimate))
    width = max(map(len, facts))
    lines = [head, *laid_out(cells), *(f"  {name:<{width}}  {said}" for name, said in facts.items())]
    return "\n".join([*lines, estimate.message])


def _noises(estimate: "Estimate") -> list[str]:
    """What the noise of each channel was estimated to be."""
    problem, found = estimate.problem, []
    for c, channel in enumerate(problem.channels):
        mine = (problem.where[:, 2] == c) & ~problem.known
        if mine.any():
            record = int(problem.where[np.argmax(mine), 0])
            sigma = np.nanmedian(estimate.noise[record][channel.name])
            found.append(f"{channel.name} {sigma:.3g} {channel.units}".rstrip())
    return found[:NOISES] + ([f"and {len(found) - NOISES} more"] if len(found) > NOISES else [])


def rounded(value: float, error: float) -> str:
    """A value with as many digits as its standard error allows, and one more."""
    if not (math.isfinite(error) and error > 0 and value):
        return f"{value:.6g}"
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(error)) + 2
    return f"{value:#.{min(max(digits, 2), MOST)}g}".rstrip(".")


def laid_out(cells: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, its columns below each other."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  " + "  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)).rstrip() for row in cells]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def dataset(estimate: "Estimate") -> Any:
    """Return an xarray Dataset: what was measured, what the mechanism shows, and what is known of the parameters.

    `measured`, `predicted`, `residual` (the one minus the other) and `noise` are along record, sample and channel, at `time`
    (record, sample); not a number where nothing was measured. `correlated` is the probability that white noise leaves residuals
    as correlated as these. `cost` and `change` (the largest change of an unknown by the next step) are those of each trial.
    """
    import xarray

    problem, known = estimate.problem, estimate.knowledge
    records, names = problem.records, problem.names
    size = max(len(record.times) for record in records)
    shape = len(records), size, len(names)
    time = np.full(shape[:2], np.nan)
    parts = {name: np.full(shape, np.nan) for name in ("measured", "predicted", "residual", "noise")}
    white = np.full((shape[0], shape[2]), np.nan)
    for k, record in enumerate(records):
        time[k, : len(record.times)] = record.times
        for channel, predicted in estimate.predicted[k].items():
            place = k, slice(len(record.times)), names.index(channel)
            residual = estimate.residuals[k][channel]
            columns = predicted + residual, predicted, residual, estimate.noise[k][channel]
            for part, values in zip(parts.values(), columns, strict=True):
                part[place] = values
            if (k, channel) in estimate.whiteness:
                white[k, place[2]] = estimate.whiteness[k, channel].p
    measured = {name: (("record", "sample", "channel"), values) for name, values in parts.items()}
    P = "parameter"
    of_parameters = {
        "first_guess": (P, problem.unknowns.start),
        "value": (P, estimate.values),
        "standard_error": (P, known.standard_errors),
        "correlation": ((P, "other_parameter"), known.correlation),
    }
    cost, change = np.array(estimate.history, float).reshape(-1, 2).T
    trials = {"cost": ("trial", cost), "change": ("trial", change)}
    coords = {
        "record": labels(records),
        "time": (("record", "sample"), time, {"units": "s"}),
        "channel": list(names),
        "channel_units": ("channel", [channel.units for channel in problem.channels]),
        P: list(estimate.names),
        "parameter_units": (P, list(estimate.units)),
    }
    attributes = {
        "title": estimate.mechanism.name,
        "format": FORMAT,
        "success": int(estimate.success),
        "message": estimate.message,
        "tolerance": estimate.tol[0],
        **{f"version_{name}": value for name, value in versions().items()},
        "scene": scene_text(estimate.mechanism),
    }
    correlated = {"correlated": (("record", "channel"), white)}
    return xarray.Dataset({**measured, **correlated, **of_parameters, **trials}, coords, attributes)


def labels(records: Sequence[Any]) -> list[str]:
    """The names of records; those that have none, or one of their own no more, are numbered."""
    names = [record.name for record in records]
    return [name if name and names.count(name) == 1 else f"{name or 'record'} {k + 1}" for k, name in enumerate(names)]
