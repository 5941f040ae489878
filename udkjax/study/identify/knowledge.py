"""What measured motion says of the unknowns: how well each is known, and what it does not say at all.

With r the residuals (R,) divided by the standard deviations of the noise, and J = dr/dz (R, K), the Fisher information is J^T J,
and the covariance of the unknowns z its inverse; both from the singular values of J = U S V^T. A direction of z whose singular
value is as small as the errors of J does not show in what was measured. Nothing is known of a parameter that takes part in one;
of the others, what the pseudoinverse says. Unknowns that nobody asked for, such as those of starts, are columns of J like all
others: leaving them out of the covariance afterwards is the Schur complement.

Where the noise of some residuals is not known, it is estimated from them, s^2 = chi^2 / (R - gamma), with gamma the number of
unknowns that these residuals determine (MacKay, Neural Computation 4 (1992) 415): all K of them where there is nothing else.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.study.identify.directions import listed, null_space, reduced

# Of the largest singular value: what cannot be told from none. A change that leaves the equations of motion as they are has
# 1e-16, whatever the tolerance; derivatives at tolerances of 1e-7 have errors of 1e-8, far smaller ones at 1e-11.
FLAT = 1e-8
PART = 1e-3  # of the largest coefficient of a flat direction: unknowns with less of it take no part
ALIKE = 1e-2  # by how much the factors of a common one may differ
POOR = 0.5  # standard error relative to the value; of a parameter of either sign, to its scale
CORRELATED = 0.98  # of two parameters: their difference is known ten times worse than their sum
DOUBTFUL = 1e-3  # probability that chance alone makes chi^2 this large, or this small: below it the noise is not as given
LEAST = 1e-15  # of what residuals were divided by: noise below it is rounding
ROUNDS = 50  # of the noise, and of what is determined with such noise, in turn
SETTLED = 1e-10


class Values(NamedTuple):
    """The unknowns at the estimate, K of them: parameters first, then those that nobody asked for.

    `kinds` are "positive", "bounded" or "free", as in `parameters`.
    """

    names: Sequence[str]
    units: Sequence[str]
    x: Float[np.ndarray, "K"]
    dx_dz: Float[np.ndarray, "K"]
    kinds: Sequence[str]

    def typical(self, k: int) -> float:
        """What a standard error is compared with: the value; of a parameter of either sign, its scale."""
        return float(abs(self.x[k]) or abs(self.dx_dz[k])) if self.kinds[k] == "bounded" else float(abs(self.dx_dz[k]))


class Direction(NamedTuple):
    """A change of unknowns that no measured quantity shows: the coefficients in z, and the same in words."""

    names: tuple[str, ...]
    coefficients: Float[np.ndarray, "N"]
    text: str


@dataclass(frozen=True, eq=False)
class Knowledge:
    """What is known of P parameters.

    Variances and standard errors of those that are not known are inf, their covariances and correlations not a number.
    `singular` (D,) and `directions` (D, K) are those of J over all unknowns z. `noise` has, for each group of residuals whose
    noise was estimated, the factor by which it is larger than what they were divided by. `projection` (R, D) is U, without flat
    directions: what of the residuals the fit takes away.
    """

    values: Values
    standard_errors: Float[np.ndarray, "P"]
    covariance: Float[np.ndarray, "P P"]  # of x
    correlation: Float[np.ndarray, "P P"]
    singular: Float[np.ndarray, "D"]
    directions: Float[np.ndarray, "D K"]
    dead: tuple[str, ...]  # no measured quantity depends on them
    flat: tuple[Direction, ...]
    chi2: float  # of residuals divided by the noise, given or estimated
    degrees_of_freedom: int
    noise: Float[np.ndarray, "G"]
    projection: Float[np.ndarray, "R D"]

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the parameters."""
        return tuple(self.values.names[: len(self.standard_errors)])

    @property
    def poor(self) -> tuple[str, ...]:
        """Parameters whose standard error is more than half of their value."""
        errors = enumerate(self.standard_errors)
        return tuple(self.values.names[k] for k, error in errors if POOR * self.values.typical(k) < error < np.inf)

    @property
    def correlated(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of parameters that are hardly known apart, and their correlation."""
        with np.errstate(invalid="ignore"):
            pairs = np.argwhere(np.triu(np.abs(self.correlation) > CORRELATED, 1))
        return tuple((self.names[i], self.names[j], float(self.correlation[i, j])) for i, j in pairs)

    @property
    def texts(self) -> tuple[str, ...]:
        """All that is wrong, or to be known before the numbers are used, one sentence each; nothing where all is well."""
        return tuple(_sentences(self))


def knowledge(
    J: Float[np.ndarray, "R K"],
    r: Float[np.ndarray, "R"],
    values: Values,
    known_noise: bool | ArrayLike = True,
    parameters: int | None = None,
    flat: float = FLAT,
    priors: int = 0,
) -> Knowledge:
    """Say what weighted residuals and their Jacobian tell of the first `parameters` unknowns (default: all).

    `known_noise` is True or False for all residuals; or, for each of them, the group of residuals (0, 1, ...) whose common noise
    is to be estimated, or -1 where it is known. The last rows may be those of `priors`, whose noise is known: what only they tell
    is as known as they say, however much better other directions are measured.
    """
    K = len(values.names)
    P = K if parameters is None else parameters
    size, before = np.linalg.norm(J, axis=0), J[len(J) - priors :]
    alive = np.flatnonzero((size > flat * size.max(initial=0.0)) | np.any(before != 0.0, axis=0))
    group = np.full(len(r), -1 if known_noise else 0) if isinstance(known_noise, bool) else np.asarray(known_noise, int)
    noise = _noise(J[:, alive], r, group, flat)
    scale = np.append(noise, 1.0)[group]
    known = np.isfinite(scale).all()
    u, sigma, vt = np.linalg.svd(J[:, alive] / (scale[:, None] if known else 1.0), full_matrices=False)
    kept = sigma > flat * sigma.max(initial=0.0)
    sigma, vt, u, kept = _told_before(before[:, alive], sigma, vt, u, kept, flat)
    free = null_space(vt[kept], 0.5)
    directions, flats = (_spread(rows, alive, K) for rows in (vt, _flats(free, values, alive)))
    lost = np.any(flats != 0.0, axis=0)
    lost[np.setdiff1d(np.arange(K), alive)] = True
    root = directions[kept].T / sigma[kept] * np.asarray(values.dx_dz)[:, None]  # (K, D)
    covariance = (root @ root.T)[:P, :P] * (1.0 if known else np.nan)
    errors = np.where(lost[:P], np.inf, np.sqrt(np.diag(covariance)))
    covariance[lost[:P]] = covariance[:, lost[:P]] = np.nan
    correlation = covariance / np.outer(errors, errors)
    np.fill_diagonal(correlation, 1.0)
    np.fill_diagonal(covariance, errors**2)
    return Knowledge(
        values=values,
        standard_errors=errors,
        covariance=covariance,
        correlation=correlation,
        singular=sigma,
        directions=directions,
        dead=tuple(values.names[k] for k in range(P) if k not in alive),
        flat=tuple(direction(values, row) for row in flats),
        chi2=float(np.sum((r / scale) ** 2)),
        degrees_of_freedom=len(r) - int(kept.sum()),
        noise=noise,
        projection=u[:, kept],
    )


def _told_before(before: np.ndarray, sigma: np.ndarray, vt: np.ndarray, u: np.ndarray, kept: np.ndarray, flat: float) -> tuple:
    """Singular values and directions with those that no measurement tells, but priors do: by their own size."""
    none = null_space(vt[kept], 0.5)
    if not len(none) or not len(before):
        return sigma, vt, u, kept
    _, told, w = np.linalg.svd(before @ none.T, full_matrices=False)
    some = told > flat * np.linalg.norm(before, axis=1).max(initial=0.0)
    rows = np.concatenate([np.zeros((len(u) - len(before), int(some.sum()))), (before @ none.T @ w[some].T) / told[some]])
    sigma, vt = np.concatenate([sigma[kept], told[some]]), np.concatenate([vt[kept], w[some] @ none])
    return sigma, vt, np.concatenate([u[:, kept], rows], axis=1), np.ones(len(sigma), bool)


def _flats(free: np.ndarray, values: Values, alive: np.ndarray) -> np.ndarray:
    """Directions that span what no measurement shows, each of few unknowns; first a common factor of several, if there is one."""
    found = reduced(free, PART)
    x, change = (np.asarray(a, float)[alive] for a in (values.x, values.dx_dz))
    relative = np.array([values.kinds[k] != "free" for k in alive], bool) & (x != 0.0) & np.any(found != 0.0, axis=0)
    if len(found) < 2 or not relative.any():
        return found
    factor = np.where(relative, x / change, 0.0)
    outside = factor - free.T @ (free @ factor)
    if np.linalg.norm(outside) > PART * np.linalg.norm(factor):
        return found
    # It stands for the direction that is most of it.
    share = np.abs(np.linalg.lstsq(found.T, factor, rcond=None)[0]) * np.linalg.norm(found, axis=1)
    return np.concatenate([factor[None], np.delete(found, int(np.argmax(share)), axis=0)])


def _spread(rows: np.ndarray, columns: np.ndarray, count: int) -> np.ndarray:
    whole = np.zeros((len(rows), count))
    whole[:, columns] = rows
    return whole


def _noise(J: np.ndarray, r: np.ndarray, group: np.ndarray, flat: float) -> np.ndarray:
    """The factor s of each group of residuals; not a number where a group has no more residuals than it determines unknowns."""
    groups = [np.flatnonzero(group == g) for g in range(group.max(initial=-1) + 1)]
    sums, counts = np.array([r[g] @ r[g] for g in groups]), np.array([len(g) for g in groups], float)
    # R of QR stands for the rows of a group: all that is asked of them is J^T J.
    parts = [np.linalg.qr(J[g], mode="r") for g in (*groups, np.flatnonzero(group < 0))]
    s2 = sums / np.maximum(counts, 1.0)
    for _ in range(ROUNDS if groups else 0):
        scaled = [part / s for part, s in zip(parts, [*np.sqrt(np.where(s2 > 0, s2, 1.0)), 1.0], strict=True)]
        u, sigma, _ = np.linalg.svd(np.concatenate(scaled), full_matrices=False)
        leverage = np.sum(u[:, sigma > flat * sigma.max(initial=0.0)] ** 2, axis=1)
        ends = np.cumsum([len(part) for part in parts])[:-1]
        determined = np.array([part.sum() for part in np.split(leverage, ends)[: len(groups)]])
        left = counts - determined
        before, s2 = s2, np.where(left > SETTLED * counts, sums / np.where(left > 0, left, 1.0), np.nan)
        if np.isnan(s2).any() or np.all(np.abs(s2 - before) <= SETTLED * s2):
            break
    return np.maximum(np.sqrt(s2), LEAST)


# --- words


def direction(values: Values, coefficients: Float[np.ndarray, "K"]) -> Direction:
    """Say a direction of z: as a common factor where it is one, else with one percent of the unknown that changes most."""
    there = np.flatnonzero(coefficients).tolist()
    x, change = (np.asarray(a, float)[there] for a in (values.x, values.dx_dz))
    change = change * coefficients[there]
    names, kinds = [values.names[k] for k in there], [values.kinds[k] for k in there]
    relative = np.array([kind != "free" and value != 0.0 for kind, value in zip(kinds, x, strict=True)])
    factors = np.where(relative, change / np.where(relative, x, 1.0), 0.0)
    if len(there) > 1 and relative.all() and np.all(np.abs(factors / factors[0] - 1.0) < ALIKE):
        text = f"{listed(names)} by a common factor"
    else:
        reference = factors if relative.any() else coefficients[there]
        unit = 0.01 / reference[np.argmax(np.abs(reference))]
        parts = [
            f"{name} {100 * unit * f:+.3g} %" if percent else f"{name} {unit * dx:+.3g} {values.units[k]}".rstrip()
            for name, percent, f, dx, k in zip(names, relative, factors, change, there, strict=True)
        ]
        text = parts[0] + (f" with {listed(parts[1:])}" if len(parts) > 1 else "")
    return Direction(tuple(names), coefficients[there] / np.abs(coefficients).max(), text)


def _sentences(known: Knowledge) -> Iterator[str]:
    values = known.values
    if known.dead:
        yield f"no measured quantity depends on {listed(known.dead)}: leave out what does not show, or measure what does"
    for flat in known.flat:
        one = "fix one of them, give one a prior, or measure more" if len(flat.names) > 1 else "fix it, or measure more"
        yield f"no measured quantity shows {flat.text}: {one}"
    if not np.isfinite(known.noise).all():
        yield (
            f"{known.projection.shape[0]} residuals leave nothing from which to estimate the noise: standard errors are not "
            "known; give the noise, or more data"
        )
    for name in known.poor:
        k = list(values.names).index(name)
        error, unit = known.standard_errors[k], f" {values.units[k]}".rstrip()
        percent = f" ({100 * error / abs(values.x[k]):.0f} %)" if values.x[k] else ""
        yield f"{name} is poorly known: {values.x[k]:.4g}{unit} with a standard error of {error:.2g}{unit}{percent}"
    for one, other, rho in known.correlated:
        yield f"{one} and {other} are hardly known apart: their errors have the correlation {rho:.4f}"
    if not known.noise.size and known.degrees_of_freedom > 0:
        yield from _of_the_noise(known.chi2, known.degrees_of_freedom)


def _of_the_noise(chi2: float, freedom: int) -> Iterator[str]:
    """Whether residuals are as large as the noise that was given."""
    from scipy.stats import chi2 as law

    ratio = np.sqrt(chi2 / freedom)
    numbers = f"chi^2 = {chi2:.4g} with {freedom} degrees of freedom"
    if law.sf(chi2, freedom) < DOUBTFUL:
        yield (
            f"residuals are {ratio:.3g} times as large as the noise given ({numbers}): the model leaves something out, or the "
            "noise is larger; standard errors are those of the noise given"
        )
    elif law.cdf(chi2, freedom) < DOUBTFUL:
        yield (
            f"residuals are only {ratio:.3g} times as large as the noise given ({numbers}): the noise is smaller, or its samples "
            "are not independent; standard errors are those of the noise given"
        )
