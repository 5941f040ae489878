"""Check of the derivatives that identification uses against finite differences.

With y(z) the values predicted with the unknowns z, J d is compared with differences of y along directions d: each unknown by
itself, and some random combinations of all, unless directions are given. Second derivatives of y along d are compared with
differences of J d. Each evaluation closes the mechanism again. The integration error of J is estimated by its change at another
tolerance. The floor up to which J d and differences can agree is the sum of this error and the errors of differences, noise and
truncation (see `differences`), at the step where these are smallest. It does not depend on the discrepancy: if the discrepancy
exceeds the floor, the derivative is wrong, or does not exist.

Along a chaotic motion even the smallest step leads to an entirely different motion, which cannot be compared. Steps are
therefore excluded if h J d exceeds the values of a channel and the channel changes.
"""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Float

from udkjax.argument_types import NOT_NEGATIVE, NOT_NEGATIVE_COUNT
from udkjax.equations.rows.analysis import Analysis
from udkjax.integrate.solution import CAUSES, Result
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.study.differences import DIFFERENCE_STEPS, Differences, DifferenceSums, best_steps, leave_out_far_steps
from udkjax.study.identify.answers.gradient_agreement import DisagreementPlace, GradientCheck
from udkjax.study.identify.problem import prediction
from udkjax.study.identify.problem.directions import Directions, given_directions, usual_directions
from udkjax.study.identify.problem.fit_problem import FitProblem, build_problem
from udkjax.study.identify.problem.parameters import ParametersLike
from udkjax.study.identify.problem.prediction import TIGHT_TOL, TolerancePair
from udkjax.study.identify.problem.residuals import Residuals
from udkjax.study.identify.problem.windows import BLOCK_BYTES
from udkjax.study.identify.records.record_reader import Data
from udkjax.study.identify.records.records import IdentificationError, label_prefixes

OTHER_TOL = 0.01, 10.0  # tolerances, relative to the given one, to estimate errors; the second is used if runs fail at the first
SMALLEST_TOL = 1e-14  # below this, the step controller responds to rounding errors


# The numbers (R,) of rows, the values (B, R) predicted with B sets of unknowns, and how their runs ended (B,).
_Values: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]


@checked
@concrete_only()
def check_gradients(
    mechanism: Mechanism,
    data: Data,
    parameters: ParametersLike,
    *,
    tol: Annotated[float, NOT_NEGATIVE] = TIGHT_TOL,
    ignore: Sequence[str] = (),
    seed: Annotated[int, NOT_NEGATIVE_COUNT] = 0,
    order: Literal[1, 2] = 1,
    directions: Directions | None = None,
    **settings: Any,
) -> GradientCheck:
    """Compare the derivatives that `identify` uses with finite differences, at the first guess of the parameters.

    The directions are each unknown by itself, so that each entry of the Jacobian is compared, and some random combinations; in
    each direction, the mechanism is closed and simulated forty times. With `order=2`, the second derivative of the predicted
    values along each direction is compared with differences of the first one: d^T H d with the Hessian H of each value. Memory
    holds a block of rows of the Jacobian, however long the records are. For the same check at an estimate, see
    `Estimate.check_gradients`.

    Args:
        mechanism: mechanism with the first guesses.
        data: records, as for `identify`; only times, names of channels and initial states are used.
        parameters: parameters, as for `identify`.
        tol: tolerance of the integration, relative and absolute.
        ignore: columns of tables that are not read.
        seed: seed of the random directions.
        order: 1 for first derivatives, 2 for second ones.
        directions: other directions by name, each the changes of unknowns by their names, in the units of these; other unknowns
            do not change. The sizes of directions do not matter.
        settings: further arguments of `simulate`.

    Returns:
        The comparison; `ok` is True if all derivatives agree, and `print` shows a table.

    Raises:
        IdentificationError: as for `identify`, the motion cannot be simulated to its end, or a direction names no unknown, or
            changes none.
    """
    Analysis.require_masses(mechanism, "free motions")
    problem, tol = build_problem(mechanism, data, parameters, settings, ignore=ignore, seed=seed), float(tol)
    return compare_gradients(problem, np.zeros(problem.K), (tol, tol), seed, order, directions)


def compare_gradients(
    problem: FitProblem,
    z: Float[np.ndarray, "K"],
    tol: TolerancePair,
    seed: int = 0,
    order: int = 1,
    directions: Directions | None = None,
) -> GradientCheck:
    """Compare the derivatives of a problem at z with finite differences, at given tolerances of the integration."""
    names, d = usual_directions(problem, seed) if directions is None else given_directions(problem, z, directions)
    tol = _completed_tol(problem, z, [tol])
    smaller, larger = ((max(factor * tol[0], SMALLEST_TOL), max(factor * tol[1], SMALLEST_TOL)) for factor in OTHER_TOL)
    tols = tol, _completed_tol(problem, z, [smaller, larger] if smaller[0] < tol[0] and smaller[1] < tol[1] else [larger])
    series, errors, found = problem.series(), [], list[Differences]()
    together = max(1, int(BLOCK_BYTES // (8 * len(tols) * len(problem.index))))
    for first in range(0, len(d), together):
        some = d[first : first + together]
        for along, slopes in zip(some, (_slopes if order == 1 else _curvatures)(problem, z, some, tols), strict=True):
            found.append(_compare(problem, z, along, slopes[0], tols, series, order))
            errors.append([np.sqrt(np.mean((slopes[0, rows] - slopes[1, rows]) ** 2)) for rows in series])
    keys = [(int(problem.index[p[0], 0]), problem.channels[problem.index[p[0], 2]]) for p in series]
    return GradientCheck(
        title=problem.mechanism.name or "mechanism",
        names=names,
        directions=d,
        series=tuple((k, channel.name) for k, channel in keys),
        labels=tuple(label_prefixes(problem.records)[k] + channel.name for k, channel in keys),
        units=tuple(channel.units for _, channel in keys),
        steps=found[0].steps,
        discrepancy=np.stack([f.discrepancy.T for f in found]),
        noise=np.stack([f.noise.T for f in found]),
        truncation=np.stack([f.truncation.T for f in found]),
        derivative_error=np.array(errors),
        size=np.stack([f.derivative_size for f in found]),
        places=tuple(_places(problem, f) for f in found),
        tol=tol,
        other_tol=tols[1],
        order=order,
    )


def _completed_tol(problem: FitProblem, z: Float[np.ndarray, "K"], tols: Sequence[TolerancePair]) -> TolerancePair:
    """Return the first of some tolerances at which all runs are completed and all channels are finite.

    Raises:
        IdentificationError: there is no such tolerance.
    """
    code = Result.successful
    for tol in tols:
        found = [(int(block.code[0]), np.isfinite(block.r[0]).all()) for block in problem.row_blocks(z[None], tol)]
        code = Result(max(code for code, _ in found))
        if code == Result.successful and all(finite for _, finite in found):
            return tol
    cause = "some channels are NaN" if code == Result.successful else CAUSES[code]
    raise IdentificationError([f"there are no derivatives to check: {cause}"])


def _slopes(
    problem: FitProblem, z: Float[np.ndarray, "K"], directions: Float[np.ndarray, "D K"], tols: Sequence[TolerancePair]
) -> Float[np.ndarray, "D tols R"]:
    """Return J d for each of some directions d at each of the tolerances, in the units of the channels."""
    slopes = np.zeros((len(directions), len(tols), len(problem.index)))
    for k, tol in enumerate(tols):
        for block in problem.row_blocks(z[None], tol):
            rows = block.row_numbers[block.row_numbers < len(problem.index)]
            slopes[:, k, rows] = directions @ (problem.sigma[rows, None] * block.J[0, : len(rows)]).T
    return slopes


def _curvatures(
    problem: FitProblem, z: Float[np.ndarray, "K"], directions: Float[np.ndarray, "D K"], tols: Sequence[TolerancePair]
) -> Float[np.ndarray, "D tols R"]:
    """Return the second derivatives of the predicted values along each direction at each tolerance, in the units of channels."""
    return np.stack([[problem.second_derivatives(z, d, tol) for tol in tols] for d in directions])


def _compare(
    problem: FitProblem,
    z: Float[np.ndarray, "K"],
    d: Float[np.ndarray, "K"],
    slopes: Float[np.ndarray, "R"],
    tols: Sequence[TolerancePair],
    series: Sequence[np.ndarray],
    order: int,
) -> Differences:
    """Return differences along the direction d, compared with the derivatives `slopes` along it at the first of two tolerances.

    The second tolerance gives the integration errors. With `order` 2, derivatives of first order are differenced.
    """
    along = d if order == 2 else None
    series_of = np.full(len(problem.index), -1)
    series_of[np.concatenate(series)] = np.repeat(np.arange(len(series)), [len(rows) for rows in series])
    points = z + np.concatenate([DIFFERENCE_STEPS, -DIFFERENCE_STEPS])[:, None] * d
    # Batches small enough to be computed one by one, since a program with vector lanes would have to be compiled.
    most = min(problem.sets_together, max(1, (prediction.FEWEST_IN_LANES - 1) // len(problem.columns)))
    size = max(n for n in range(1, len(points) + 1) if len(points) % n == 0 and n <= most)
    batches = [points[k : k + size] for k in range(0, len(points), size)]
    sums, failed = DifferenceSums(len(series)), np.zeros((len(tols), len(points)), bool)
    for blocks in zip(*(_values(problem, batch, tol, along) for tol in tols for batch in batches), strict=True):
        rows = blocks[0][0]
        used = series_of[rows] >= 0
        y, code = (np.concatenate(x).reshape(len(tols), len(points), -1) for x in list(zip(*blocks, strict=True))[1:])
        failed |= (code != Result.successful).any(2)
        y = y[:, :, used].reshape(len(tols), 2, len(DIFFERENCE_STEPS), -1).swapaxes(1, 2)
        sums.add(y[0], y[0] - y[1], series_of[rows[used]], slopes[rows[used]], rows[used])
    return leave_out_far_steps(sums.differences(failed.any(0).reshape(2, -1).T))


def _values(
    problem: FitProblem, z: Float[np.ndarray, "B K"], tol: TolerancePair, along: Float[np.ndarray, "K"] | None
) -> Iterator[_Values]:
    """Iterate over blocks of rows: their numbers, the predicted values of channels in their units, and how runs ended.

    If a direction is given, the derivatives along it take the place of the values. Derivatives, which are computed in any case,
    are dropped at once: several such iterators are suspended together.
    """

    def values(block: Residuals) -> _Values:
        rows = block.row_numbers[block.row_numbers < len(problem.index)]
        if along is not None:
            return rows, (block.J[:, : len(rows)] @ along) * problem.sigma[rows], block.code
        return rows, block.r[:, : len(rows)] * problem.sigma[rows] + problem.measured[rows], block.code

    return map(values, problem.row_blocks(z, tol))


def _places(problem: FitProblem, computed: Differences) -> tuple[DisagreementPlace, ...]:
    best, places = best_steps((computed.noise + computed.truncation).T), []
    for row, derivative, difference in np.take_along_axis(computed.worst, best[None, :, None], 0)[0].tolist():
        record, time, channel = problem.index[int(row)]
        where = int(record), problem.channel_names[channel], float(problem.ts[record, time])
        places.append(DisagreementPlace(*where, derivative, difference))
    return tuple(places)
