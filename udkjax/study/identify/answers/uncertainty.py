"""The uncertainty of identified unknowns, and the directions that the measurements do not determine.

With r the residuals (R,) divided by the standard deviations of the noise, and J = dr/dz (R, K), the Fisher information is J^T J,
and the covariance of the unknowns z is its inverse, both computed from the singular values of J = U S V^T. A direction of z whose
singular value is as small as the errors of J is not determined by the measurements. A parameter with a component in such
a direction is unknown; the variance of the others follows from the pseudoinverse. Nuisance unknowns, such as those of initial
states, are columns of J like all others; to omit them from the covariance afterwards is equivalent to the Schur complement.

If the noise of some residuals is unknown, it is estimated from them, s^2 = chi^2 / (R - gamma), with gamma the number of unknowns
that these residuals determine (MacKay, Neural Computation 4 (1992) 415): all K if there are no other residuals.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import chdtr, chdtrc

from udkjax.pinv.row_spaces import echelon, null_space
from udkjax.study.identify.problem.residuals import ReducedGroups, Reduction
from udkjax.study.identify.problem.unknowns import INVISIBLE_RATIO
from udkjax.study.noise import SIGNIFICANCE
from udkjax.wording import join_names, plural

POOR_ERROR = 0.5  # standard error reported as large, relative to the value or to the scale of a parameter of either sign
HIGH_CORRELATION = 0.98  # at this correlation, one combination of two parameters is ten times less accurate than the other one
LEAST_NOISE = 1e-15  # noise below this, relative to the assumed noise, is a rounding error
NOISE_ITERATIONS, EQUAL_NOISE = 50, 1e-10  # alternating updates of noise and gamma: largest number, relative tolerance
# Coefficients below this, relative to the largest of a direction, count as zero. Directions are as accurate as this if their
# singular value exceeds the errors of the Jacobian by the inverse factor.
SMALLEST_PART = 1e-3
COMMON_FACTOR_TOL = 1e-2  # relative difference of factors that are called a common factor


class UnknownValues(NamedTuple):
    """The K unknowns at an estimate: parameters first, then nuisance unknowns.

    `kinds` are "positive", "bounded" or "free", as in `parameters`; `dx_dz` are derivatives with respect to the dimensionless
    unknowns.
    """

    names: Sequence[str]
    units: Sequence[str]
    x: Float[np.ndarray, "K"]
    dx_dz: Float[np.ndarray, "K"]
    kinds: Sequence[str]

    def typical(self, k: int) -> float:
        """Return the size to compare the standard error of the k-th unknown with: its value, or the scale of a free one."""
        return float(abs(self.x[k]) or abs(self.dx_dz[k])) if self.kinds[k] == "bounded" else float(abs(self.dx_dz[k]))


class Direction(NamedTuple):
    """A change of unknowns that affects no measured quantity.

    `names` are those of the N unknowns that change, `coefficients` their changes in z relative to the largest, and `text`
    describes the change.
    """

    names: tuple[str, ...]
    coefficients: Float[np.ndarray, "N"]
    text: str


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """The uncertainty of P parameters.

    Attributes:
        values: all K unknowns at the estimate.
        standard_errors: standard errors of the parameters, in their units; inf for undetermined parameters.
        covariance: covariance of the parameters; NaN for undetermined ones.
        correlation: correlation of the parameters' errors.
        singular: singular values of J over all unknowns z.
        directions: right singular vectors of J.
        dead: parameters that no measured quantity depends on.
        flat: further directions that affect no measured quantity.
        chi2: sum of squares of the residuals divided by their noise, given or estimated.
        degrees_of_freedom: number of residuals minus number of determined directions.
        noise: for each group of residuals with unknown noise, its estimate relative to the assumed noise.
        rows: number of residuals.
        projector: W. The columns of U = J W, with J divided by the noise, are an orthonormal basis of the part of the measured
            residuals that the fit removes.
        state_errors: standard errors of the unknowns of initial states.
    """

    values: UnknownValues
    standard_errors: Float[np.ndarray, "P"]
    covariance: Float[np.ndarray, "P P"]
    correlation: Float[np.ndarray, "P P"]
    singular: Float[np.ndarray, "D"]
    directions: Float[np.ndarray, "D K"]
    dead: tuple[str, ...]
    flat: tuple[Direction, ...]
    chi2: float
    degrees_of_freedom: int
    noise: Float[np.ndarray, "G"]
    rows: int
    projector: Float[np.ndarray, "K D"]
    state_errors: Float[np.ndarray, "K-P"]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.values.names[: len(self.standard_errors)])

    @property
    def poor(self) -> tuple[str, ...]:
        """Names of parameters whose standard error is more than half of their value."""
        errors = enumerate(self.standard_errors)
        return tuple(self.values.names[k] for k, error in errors if POOR_ERROR * self.values.typical(k) < error < np.inf)

    @property
    def correlated(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of parameters that are hardly known apart, and the correlation of their errors."""
        return self.correlated_beyond(HIGH_CORRELATION)

    def correlated_beyond(self, least: float) -> tuple[tuple[str, str, float], ...]:
        """Return pairs of parameters whose errors have a correlation larger than `least`, of either sign, and the correlation."""
        with np.errstate(invalid="ignore"):
            pairs = np.argwhere(np.triu(np.abs(self.correlation) > least, 1))
        return tuple((self.names[i], self.names[j], float(self.correlation[i, j])) for i, j in pairs)

    def notes(self, name: str) -> list[str]:
        """Return remarks on the uncertainty of a parameter, a few words each."""
        sizes = [len(flat.names) for flat in self.flat if name in flat.names]
        notes = {
            "affects no measured quantity": name in self.dead,
            "undetermined together with others": max(sizes, default=0) > 1,
            "undetermined": max(sizes, default=0) == 1,
            "poorly determined": name in self.poor,
        }
        return [note for note, holds in notes.items() if holds]

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings about the numbers, one sentence each."""
        return tuple(_sentences(self))


def estimate_uncertainty(reduced: ReducedGroups, values: UnknownValues, parameters: int | None = None) -> Uncertainty:
    """Compute the uncertainty of unknowns: the covariance (J^T J)^-1, and the directions that J does not determine.

    The first `parameters` unknowns, by default all, are the parameters. Directions that only priors determine have the priors'
    uncertainty, however well other directions are measured.
    """
    K, P = len(values.names), len(values.names) if parameters is None else parameters
    size, prior_rows = np.linalg.norm(reduced.J, axis=0), reduced.prior_rows
    alive = np.flatnonzero((size > INVISIBLE_RATIO * size.max(initial=0.0)) | np.any(prior_rows != 0.0, axis=0))
    noise = _noise_scales(reduced.groups, alive)
    noise_known = np.isfinite(noise).all()
    scales = np.append(noise, 1.0) if noise_known else np.ones(len(reduced.groups))
    scaled = [group.J[:, alive] / scale for group, scale in zip(reduced.groups, scales, strict=True)]
    _, sigma, vt = np.linalg.svd(np.concatenate(scaled), full_matrices=False)
    shown = sigma > INVISIBLE_RATIO * sigma.max(initial=0.0)
    projector = vt[shown].T / sigma[shown]
    sigma, vt, shown = _with_priors(prior_rows[:, alive], sigma, vt, shown)
    x, dx_dz = (np.asarray(part, float)[alive] for part in (values.x, values.dx_dz))
    free = simplest_basis(null_space(vt[shown], 0.5), x, dx_dz, [values.kinds[k] for k in alive.tolist()])
    directions, flats = (_insert_columns(rows, alive, K) for rows in (vt, free))
    lost = np.any(flats != 0.0, axis=0)
    lost[np.setdiff1d(np.arange(K), alive)] = True
    factor = directions[shown].T / sigma[shown] * np.asarray(values.dx_dz)[:, None]  # (K, D)
    of_all = factor @ factor.T * (1.0 if noise_known else np.nan)  # covariance of parameters and initial states
    of_all[lost] = of_all[:, lost] = np.nan
    all_errors = np.where(lost, np.inf, np.sqrt(np.diag(of_all)))
    errors, covariance = all_errors[:P], of_all[:P, :P]
    correlation = covariance / np.outer(errors, errors)
    np.fill_diagonal(correlation, 1.0)
    np.fill_diagonal(covariance, errors**2)
    return Uncertainty(
        values=values,
        standard_errors=errors,
        covariance=covariance,
        correlation=correlation,
        singular=sigma,
        directions=directions,
        dead=tuple(values.names[k] for k in range(P) if k not in alive),
        flat=tuple(describe(values, row) for row in flats),
        chi2=float(sum(group.r @ group.r / scale**2 for group, scale in zip(reduced.groups, np.append(noise, 1.0), strict=True))),
        degrees_of_freedom=reduced.rows - int(shown.sum()),
        noise=noise,
        rows=reduced.rows,
        projector=_insert_columns(projector.T, alive, K).T,
        state_errors=all_errors[P:],
    )


def _with_priors(
    prior_rows: np.ndarray, sigma: np.ndarray, vt: np.ndarray, shown: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return sigma, vt and `shown` with the directions that only priors determine.

    A direction is determined if its singular value in the rows of the priors exceeds `INVISIBLE_RATIO` times the largest of these
    rows.
    """
    unshown = null_space(vt[shown], 0.5)
    if not len(unshown) or not len(prior_rows):
        return sigma, vt, shown
    _, prior_sigma, w = np.linalg.svd(prior_rows @ unshown.T, full_matrices=False)
    determined = prior_sigma > INVISIBLE_RATIO * np.linalg.norm(prior_rows, axis=1).max(initial=0.0)
    sigma, vt = np.concatenate([sigma[shown], prior_sigma[determined]]), np.concatenate([vt[shown], w[determined] @ unshown])
    return sigma, vt, np.ones(len(sigma), bool)


def _insert_columns(rows: np.ndarray, columns: np.ndarray, count: int) -> np.ndarray:
    table = np.zeros((len(rows), count))
    table[:, columns] = rows
    return table


def _noise_scales(reduced: Sequence[Reduction], alive: np.ndarray) -> np.ndarray:
    """Return the ratio of the estimated to the assumed noise of each group of residuals with unknown noise.

    It is NaN for a group with no more residuals than unknowns that it determines. `alive` are the indices of the unknowns on
    which residuals depend; the last item of `reduced` has the residuals with known noise.
    """
    groups, factors = reduced[:-1], [group.J[:, alive] for group in reduced]
    sums, counts = np.array([group.r @ group.r for group in groups]), np.array([group.count for group in groups], float)
    s2 = sums / np.maximum(counts, 1.0)
    for _ in range(NOISE_ITERATIONS if groups else 0):
        scaled = [factor / s for factor, s in zip(factors, [*np.sqrt(np.where(s2 > 0, s2, 1.0)), 1.0], strict=True)]
        u, sigma, _ = np.linalg.svd(np.concatenate(scaled), full_matrices=False)
        leverage = np.sum(u[:, sigma > INVISIBLE_RATIO * sigma.max(initial=0.0)] ** 2, axis=1)
        ends = np.cumsum([len(factor) for factor in factors])[:-1]
        determined = np.array([factor.sum() for factor in np.split(leverage, ends)[: len(groups)]])
        left = counts - determined
        previous, s2 = s2, np.where(left > EQUAL_NOISE * counts, sums / np.where(left > 0, left, 1.0), np.nan)
        if np.isnan(s2).any() or np.all(np.abs(s2 - previous) <= EQUAL_NOISE * s2):
            break
    return np.maximum(np.sqrt(s2), LEAST_NOISE)


def simplest_basis(
    free: Float[np.ndarray, "D K"], x: Float[np.ndarray, "K"], dx_dz: Float[np.ndarray, "K"], kinds: Sequence[str]
) -> Float[np.ndarray, "D K"]:
    """Return sparse rows with the span of the orthonormal rows `free`.

    If the span contains the direction that changes all positive and bounded unknowns by a common factor, it is the first row.
    """
    basis = echelon(free, SMALLEST_PART)
    relative = np.array([kind != "free" for kind in kinds], bool) & (x != 0.0) & np.any(basis != 0.0, axis=0)
    if len(basis) < 2 or not relative.any():
        return basis
    factor = np.where(relative, x / dx_dz, 0.0)
    outside = factor - free.T @ (free @ factor)
    if np.linalg.norm(outside) > SMALLEST_PART * np.linalg.norm(factor):
        return basis
    # The factor replaces the direction that contributes most to it.
    share = np.abs(np.linalg.lstsq(basis.T, factor, rcond=None)[0]) * np.linalg.norm(basis, axis=1)
    return np.concatenate([factor[None], np.delete(basis, int(np.argmax(share)), axis=0)])


# --- text


def _sentences(result: Uncertainty) -> Iterator[str]:
    values = result.values
    if result.dead:
        it = "it" if len(result.dead) == 1 else "them"
        yield f"no measured quantity depends on {join_names(result.dead)}: do not identify {it}, or measure other quantities"
    for flat in result.flat:
        cure = "fix one of them, give one a prior, or measure more" if len(flat.names) > 1 else "fix it, or measure more"
        yield f"no measured quantity changes with {flat.text}: {cure}"
    if not np.isfinite(result.noise).all():
        few = f"{plural(result.rows, 'residual')} {'is' if result.rows == 1 else 'are'} too few"
        yield f"{few} to estimate the noise, and standard errors are unknown: give the noise, or more data"
    for name in result.poor:
        k = list(values.names).index(name)
        error, unit = result.standard_errors[k], f" {values.units[k]}".rstrip()
        percent = f" ({100 * error / abs(values.x[k]):.0f} %)" if values.x[k] else ""
        yield f"{name} is poorly determined: {values.x[k]:.4g}{unit} with a standard error of {error:.2g}{unit}{percent}"
    for one, other, rho in result.correlated:
        yield f"{one} and {other} are hard to distinguish: the correlation of their errors is {rho:.4f}"
    if not result.noise.size and result.degrees_of_freedom > 0:
        yield from _noise_sentence(result.chi2, result.degrees_of_freedom)


def _noise_sentence(chi2: float, freedom: int) -> Iterator[str]:
    """Yield a sentence if the residuals are significantly larger or smaller than the given noise; otherwise nothing."""
    ratio = np.sqrt(chi2 / freedom)
    numbers = f"chi^2 = {chi2:.4g} with {freedom} degrees of freedom"
    if chdtrc(freedom, chi2) < SIGNIFICANCE:
        size, why = f"{ratio:.3g}", "the model omits something, or the noise is larger"
    elif chdtr(freedom, chi2) < SIGNIFICANCE:
        size, why = f"only {ratio:.3g}", "the noise is smaller, or its samples are not independent"
    else:
        return
    end = "standard errors follow from the given noise"
    yield f"residuals are {size} times as large as the given noise ({numbers}): {why}; {end}"


def describe(values: UnknownValues, coefficients: Float[np.ndarray, "K"]) -> Direction:
    """Return the direction in z with these coefficients.

    Its text says that the parameters change by a common factor, or how much each of them changes if the largest change is one
    percent.
    """
    nonzero = np.flatnonzero(coefficients).tolist()
    x, change = (np.asarray(a, float)[nonzero] for a in (values.x, values.dx_dz))
    change = change * coefficients[nonzero]
    names, kinds = [values.names[k] for k in nonzero], [values.kinds[k] for k in nonzero]
    relative = np.array([kind != "free" and value != 0.0 for kind, value in zip(kinds, x, strict=True)])
    factors = np.where(relative, change / np.where(relative, x, 1.0), 0.0)
    if len(nonzero) > 1 and relative.all() and np.all(np.abs(factors / factors[0] - 1.0) < COMMON_FACTOR_TOL):
        text = f"{join_names(names)} by a common factor"
    else:
        reference = factors if relative.any() else coefficients[nonzero]
        unit = 0.01 / reference[np.argmax(np.abs(reference))]
        parts = [
            f"{name} {100 * unit * f:+.3g} %" if percent else f"{name} {unit * dx:+.3g} {values.units[k]}".rstrip()
            for name, percent, f, dx, k in zip(names, relative, factors, change, nonzero, strict=True)
        ]
        text = parts[0] + (f" with {join_names(parts[1:])}" if len(parts) > 1 else "")
    return Direction(tuple(names), coefficients[nonzero] / np.abs(coefficients).max(), text)
