"""Outliers in records: residuals that are too large for the noise of the others."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from udkjax.study.identify.problem.fit_problem import FitProblem
from udkjax.study.identify.records.records import label_prefixes, output_times
from udkjax.study.noise import NOISE_FLOOR, outlier_rows
from udkjax.wording import plural

MOST_OUTLIERS_NAMED = 5  # number of listed outliers per channel, the largest; the others are counted


class Outlier(NamedTuple):
    """A measured value too far from the prediction to be noise."""

    record: int
    channel: str
    row: int  # index in the record, from 0
    time: float
    residual: float
    units: str
    deviations: float  # ratio of the residual to the noise of the channel's other values


def find_outlier_rows(problem: FitProblem, r: Float[np.ndarray, "R"]) -> Bool[np.ndarray, "R"]:
    """Return a mask of the outliers among weighted residuals r; each channel of all records is examined by itself."""
    mask, channel = np.zeros(len(problem.index), bool), problem.index[:, 2]
    shows = np.abs(r * problem.sigma) > NOISE_FLOOR * problem.channel_scale[channel]
    for c in range(len(problem.channels)):
        of_channel = np.flatnonzero(channel == c)
        mask[of_channel] = outlier_rows(r[of_channel]) & shows[of_channel]
    return mask


def list_outliers(
    problem: FitProblem, rows: Bool[np.ndarray, "R"], residuals: Float[np.ndarray, "R"], sigma: Float[np.ndarray, "R"]
) -> tuple[Outlier, ...]:
    """Return the outliers at the marked rows.

    `residuals` are in the units of their channels, and `sigma` is the noise of the other values.
    """
    outliers = []
    for k in np.flatnonzero(rows).tolist():
        record, time, c = problem.index[k].tolist()
        channel, padding = problem.channels[c], output_times(problem.records[record])[1]
        location = record, channel.name, time - padding, float(problem.ts[record, time])
        outliers.append(Outlier(*location, float(residuals[k]), channel.units, float(abs(residuals[k]) / sigma[k])))
    return tuple(outliers)


def outlier_sentences(problem: FitProblem, outliers: Sequence[Outlier], robust: bool) -> Iterator[str]:
    """Iterate over sentences that list the outliers of each channel of each record, with advice.

    `robust` is True if the loss reduces the influence of outliers.
    """
    prefixes = label_prefixes(problem.records)
    for k, name in dict.fromkeys((outlier.record, outlier.channel) for outlier in outliers):
        of_channel = sorted(
            (outlier for outlier in outliers if (outlier.record, outlier.channel) == (k, name)),
            key=lambda outlier: -outlier.deviations,
        )
        named = [
            f"row {outlier.row} ({outlier.time:.6g} s) by {f'{outlier.residual:.3g} {outlier.units}'.rstrip()}, "
            f"{outlier.deviations:.3g} standard deviations"
            for outlier in of_channel[:MOST_OUTLIERS_NAMED]
        ]
        more = f" and {len(of_channel) - MOST_OUTLIERS_NAMED} more" if len(of_channel) > MOST_OUTLIERS_NAMED else ""
        cure = (
            "the robust loss gives outliers little weight"
            if robust
            else "outliers shift the estimate and enlarge the standard errors: replace them by nan, or use loss='huber'"
        )
        where = f"{prefixes[k]}{name}: {plural(len(of_channel), 'outlier')} far from the prediction"
        yield f"{where}, {'; '.join(named)}{more}: {cure}"
