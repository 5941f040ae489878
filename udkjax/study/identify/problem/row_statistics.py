"""Statistics of a fit that depend on each row of its Jacobian, from further passes over the blocks."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float

from udkjax.study.identify.problem.fit_problem import FitProblem
from udkjax.study.identify.problem.prediction import TolerancePair
from udkjax.study.identify.problem.residuals import Reduction, Residuals
from udkjax.study.identify.problem.unknowns import INVISIBLE_RATIO
from udkjax.study.noise import HatBands


def residuals_of_others(
    problem: FitProblem, z: Float[np.ndarray, "K"], tol: TolerancePair, outlying: Bool[np.ndarray, "R"]
) -> Float[np.ndarray, "R"]:
    """Return the residuals of a fit without the outliers, to first order; NaN at the outliers."""
    inliers, reduced = np.concatenate([~outlying, np.ones(problem.extra_rows, bool)]), Reduction(problem.K)
    for block in problem.row_blocks(z[None], tol):
        used = inliers[block.row_numbers]
        reduced.add(block.r[0, used], block.J[0, used])
    step = np.linalg.lstsq(reduced.J, reduced.r, rcond=INVISIBLE_RATIO)[0]
    residuals = np.concatenate([block.r[0] - block.J[0] @ step for block in problem.row_blocks(z[None], tol)])
    return np.where(outlying, np.nan, residuals[: len(outlying)])


def hat_bands(
    problem: FitProblem,
    blocks: Iterable[Residuals],
    projector: Float[np.ndarray, "K D"],
    scale: Float[np.ndarray, "R"],
    used: Bool[np.ndarray, "R"],
) -> dict[tuple[int, int], Float[np.ndarray, "L n"]]:
    """Return `HatBands.values` of U = J W for each record and channel, by the indices of these.

    W is the `projector`, and rows of J are divided by `scale`. Only the rows that are `used` count.
    """
    record, _, channel = problem.index.T
    series = record * len(problem.channels) + channel
    counts = np.bincount(series[used], minlength=len(problem.records) * len(problem.channels))
    bands = [HatBands(count, projector.shape[1]) for count in counts.tolist()]
    for block in blocks:
        rows = block.row_numbers[: block.count_before(len(series))]
        U = block.J[0, : len(rows)] @ projector / scale[rows, None]
        of_row = np.where(used[rows], series[rows], -1)
        for number in np.unique(of_row[of_row >= 0]).tolist():
            bands[number].add(U[of_row == number])
    return {divmod(number, len(problem.channels)): own.values for number, own in enumerate(bands)}
