"""Profiles of an estimate: the same least-squares problem, with one of its unknowns held."""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from udkjax.scene.checks import quoted, suggestion
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.fitting import descend
from udkjax.study.identify.problem import Evaluated
from udkjax.study.identify.profile import LEVEL, Profile, profile, quantile

if TYPE_CHECKING:
    from udkjax.study.identify.estimate import Estimate
    from udkjax.study.identify.fitting import LeastSquares

SETTLED = 1e-6  # change of an unknown, dimensionless, at which the others are fitted: their costs are then off by its square


class Held:
    """A problem in all unknowns but one, which has a value."""

    def __init__(self, problem: "LeastSquares", index: int, value: float):
        self.problem, self.index, self.value = problem, index, value
        self.program = problem.program

    def whole(self, z: Float[np.ndarray, "... K-1"]) -> Float[np.ndarray, "... K"]:
        """All unknowns."""
        return np.insert(z, self.index, self.value, axis=-1)

    def evaluate(self, z: Float[np.ndarray, "B K-1"], tol: tuple[float, float], horizon: float | None = None) -> Evaluated:
        """Residuals, and their Jacobian by the others."""
        found = self.problem.evaluate(self.whole(z), tol, horizon)
        return found._replace(J=np.delete(found.J, self.index, axis=2))


def profile_of(estimate: "Estimate", name: str, **choices: Any) -> Profile:
    """The profile likelihood of a parameter of an estimate, by its name. Raises `IdentificationError`: there is none such."""
    if name not in estimate.names:
        raise IdentificationError([f"{quoted(name)} was not identified{suggestion(name, estimate.names)}"])
    k, known, unknowns = estimate.names.index(name), estimate.knowledge, estimate.problem.unknowns
    P = len(estimate.names)
    slope = abs(float(unknowns.slopes(estimate.z[:P])[k]))
    found = estimate.problem.evaluate(estimate.z[None], estimate.tol)
    counted = found if estimate.loss is None else estimate.loss(found)
    noise, freedom = _noise(estimate)

    def value(z: float) -> float:
        every = estimate.z[:P].copy()
        every[k] = z
        return float(unknowns.values(every)[k])

    return profile(
        partial(_fit, estimate),
        k,
        estimate.z,
        float(0.5 * counted.r[0] @ counted.r[0]),
        float(known.standard_errors[k]) / slope,
        noise=noise,
        degrees_of_freedom=freedom,
        value=value,
        name=name,
        units=estimate.units[k],
        **choices,
    )


def with_profiles(data: Any, estimate: "Estimate", profiles: Sequence[Profile], level: float = LEVEL) -> Any:
    """Return the dataset with profile likelihoods: `rise`, twice the cost above the least over the noise, at values of each.

    `interval` is where the rise is below the `limit` of this confidence level.
    """
    import xarray

    noise, freedom = _noise(estimate)
    count = max(len(found.values) for found in profiles)
    parts = np.full((2, len(profiles), count), np.nan)
    for k, found in enumerate(profiles):
        own = np.argmin(np.abs(found.values - estimate.parameters[found.name]))
        parts[:, k, : len(found.values)] = found.values, 2.0 * (found.costs - found.costs[own]) / noise**2
    along = "profile", "point"
    more = xarray.Dataset(
        {
            "profile_value": (along, parts[0]),
            "rise": (along, parts[1]),
            "interval": (("profile", "end"), np.array([found.interval for found in profiles])),
        },
        {"profile": [found.name for found in profiles], "end": ["low", "high"]},
    )
    more["interval"].attrs = {"level": level, "limit": quantile(level, freedom)}
    return data.merge(more)


def _fit(estimate: "Estimate", index: int, value: float, z: Float[np.ndarray, "K"]) -> tuple[Float[np.ndarray, "K"], float]:
    """The other unknowns fitted, and the cost; infinite where nothing could be computed."""
    held = Held(estimate.problem, index, value)
    others = np.delete(z, index)
    if not others.size:
        found = held.evaluate(others[None], estimate.tol)
        found = found if estimate.loss is None else estimate.loss(found)
        return z, float(0.5 * found.r[0] @ found.r[0]) if found.ok[0] else np.inf
    fit = descend(held, others[None], estimate.tol, settled=SETTLED, loss=estimate.loss)
    return held.whole(fit.z[0]), float(fit.cost[0])


def _noise(estimate: "Estimate") -> tuple[float, float | None]:
    """The noise over what residuals are divided by, and degrees of freedom where it was estimated.

    Where several channels have a noise of their own, residuals were divided by it, and the factors are 1 but for the last digits.
    """
    known = estimate.knowledge
    return (float(known.noise.mean()), known.degrees_of_freedom) if known.noise.size else (1.0, None)
