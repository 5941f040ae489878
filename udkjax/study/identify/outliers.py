"""Outliers in records: residuals that are too large for the noise of the others."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from udkjax.study.identify.fit_problem import FitProblem
from udkjax.study.identify.records import label_prefixes, output_times
from udkjax.study.noise import outlier_rows
from udkjax.wording import plural

NOISE_FLOOR = 1e-6  # relative to a channel's scale: least noise of measurements
MOST_OUTLIERS_NAMED = 5  # outliers listed per channel, the largest; the others are counted


class Outlier(NamedTuple):
    """A measured value too far from the prediction to be noise."""

    record: int
    channel: str
    row: int  # index in the record, from 0
    time: float
    residual: float
    units: str
    deviations: float  # residual over the noise of the channel's other values


def find_outlier_rows(problem: FitProblem, r: Float[np.ndarray, "R"]) -> Bool[np.ndarray, "R"]:
    """Return a mask of the outliers from weighted residuals, channel by channel over all records."""
    found, channel = np.zeros(len(problem.index), bool), problem.index[:, 2]
    shows = np.abs(r * problem.sigma) > NOISE_FLOOR * problem.channel_scale[channel]
    for c in range(len(problem.channels)):
        own = np.flatnonzero(channel == c)
        found[own] = outlier_rows(r[own]) & shows[own]
    return found


def list_outliers(
    problem: FitProblem, rows: Bool[np.ndarray, "R"], residuals: Float[np.ndarray, "R"], sigma: Float[np.ndarray, "R"]
) -> tuple[Outlier, ...]:
    """Return the outliers, with residuals in the units of their channels and the noise of the other values."""
    found = []
    for k in np.flatnonzero(rows).tolist():
        record, time, c = problem.index[k].tolist()
        channel, before = problem.channels[c], output_times(problem.records[record])[1]
        place = record, channel.name, time - before, float(problem.ts[record, time])
        found.append(Outlier(*place, float(residuals[k]), channel.units, float(abs(residuals[k]) / sigma[k])))
    return tuple(found)


def outlier_sentences(problem: FitProblem, outliers: Sequence[Outlier], robust: bool) -> Iterator[str]:
    """Iterate over sentences that list the outliers of each channel of each record, with advice."""
    prefixes = label_prefixes(problem.records)
    for k, name in dict.fromkeys((one.record, one.channel) for one in outliers):
        own = sorted((one for one in outliers if (one.record, one.channel) == (k, name)), key=lambda one: -one.deviations)
        named = [
            f"row {one.row} ({one.time:.6g} s) by {f'{one.residual:.3g} {one.units}'.rstrip()}, "
            f"{one.deviations:.3g} standard deviations"
            for one in own[:MOST_OUTLIERS_NAMED]
        ]
        more = f" and {len(own) - MOST_OUTLIERS_NAMED} more" if len(own) > MOST_OUTLIERS_NAMED else ""
        cure = (
            "the robust loss gives outliers little weight"
            if robust
            else "outliers shift the estimate and enlarge the standard errors: replace them by nan, or use loss='huber'"
        )
        where = f"{prefixes[k]}{name}: {plural(len(own), 'outlier')} far from the prediction"
        yield f"{where}, {'; '.join(named)}{more}: {cure}"
