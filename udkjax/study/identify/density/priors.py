"""Prior densities of unknowns, by name.

A prior is the mean and standard deviation of a normal distribution, cut off at the bounds of the number; a function of JAX that
returns the logarithm of the density; or an object with such a function as `log_prob` (distributions of numpyro) or `logpdf`.
Without a prior, a number is uniform between its bounds, above zero if it is positive, or everywhere; and a standard deviation of
noise has a uniform logarithm.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from inspect import isclass
from typing import Annotated, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import log_ndtr

from udkjax.argument_types import ArgumentRequirement
from udkjax.requirements import ArgumentTypeError, GivenArguments, describe
from udkjax.study.identify.problem.fit_problem import weighted
from udkjax.study.identify.problem.unknowns import Unknowns
from udkjax.study.identify.records.records import IdentificationError
from udkjax.wording import quote, suggestion

LogDensityOfNumber: TypeAlias = Callable[[Array], Any]


def _require_priors(name: str, value: Any, given: GivenArguments) -> None:
    if value is not None and not (isinstance(value, Mapping) and all(isinstance(key, str) for key in value)):
        example = '{"body.link1.mass": (1.0, 0.1)}'
        raise ArgumentTypeError(f"{name} must map names of parameters to priors, such as {example}, {describe(value)}")


Priors: TypeAlias = Annotated[Mapping[str, Any] | None, ArgumentRequirement("priors by name", _require_priors)]


class PriorDensity:
    """The logarithm of the prior density of all unknowns, as a function of JAX of their values x (K,).

    Attributes:
        proper: mask (K,) of the unknowns whose prior has a finite integral.
    """

    def __init__(self, unknowns: Unknowns, functions: Mapping[int, LogDensityOfNumber], scales: Sequence[int]):
        """Take normal priors (mean, deviation) from the unknowns, and other priors from `functions`, by the index of the unknown.

        `scales` are the indices of the unknowns that are standard deviations of noise.
        """
        self.unknowns, self.functions = unknowns, dict(functions)
        of_function = np.isin(np.arange(len(unknowns.names)), list(functions))
        self.normal = np.flatnonzero(np.isfinite(unknowns.sigma) & ~of_function)
        given = of_function | np.isfinite(unknowns.sigma)
        self.scales = np.setdiff1d(scales, np.flatnonzero(given)).astype(int)
        bounded = np.array(unknowns.kinds) == "bounded"
        self.proper = given | bounded
        widths = (unknowns.high - unknowns.low)[bounded & ~given]
        self.constant = -float(np.log(widths).sum()) - sum(_log_normalization(unknowns, k) for k in self.normal.tolist())

    def __call__(self, x: Float[Array, "K"]) -> Float[Array, ""]:
        """Return the logarithm of the density at the values x."""
        u, normal = self.unknowns, self.normal
        total = self.constant - 0.5 * jnp.sum(weighted(x[normal], u.mean[normal], u.sigma[normal]) ** 2)
        total -= jnp.sum(jnp.log(x[self.scales]))
        for k, function in self.functions.items():
            total += jnp.asarray(function(x[k]))
        return total


def _log_normalization(u: Unknowns, k: int) -> float:
    """Return the logarithm of the integral of exp(-(x - mean)^2 / (2 sigma^2)) over the values that the k-th number can take."""
    size = np.log(u.sigma[k] * np.sqrt(2.0 * np.pi))
    if u.kinds[k] == "free":
        return float(size)
    low, high = (0.0, np.inf) if u.kinds[k] == "positive" else (u.low[k], u.high[k])
    ends = np.array([(low - u.mean[k]) / u.sigma[k], (high - u.mean[k]) / u.sigma[k]])
    if ends[0] > 0.0:  # the other tail, which does not lose digits
        ends = -ends[::-1]
    below, above = log_ndtr(ends)
    return float(size + above + np.log1p(-np.exp(below - above)))


def with_normal_priors(unknowns: Unknowns, priors: Mapping[str, Any]) -> tuple[Unknowns, dict[str, LogDensityOfNumber]]:
    """Return the parameters with their normal priors, and all other priors as functions that return the log density, by name.

    The other priors are those given as functions or distributions, and normal ones of unknowns that are not parameters.

    Raises:
        IdentificationError: lists every prior that is neither (mean, deviation) nor a function or distribution.
    """
    mean, sigma, functions, problems = unknowns.mean.copy(), unknowns.sigma.copy(), dict[str, LogDensityOfNumber](), list[str]()
    for name, prior in priors.items():
        function: Any = next((getattr(prior, key) for key in ("log_prob", "logpdf") if hasattr(prior, key)), prior)
        if callable(function) and not isclass(prior):
            functions[name] = function
            continue
        try:
            numbers = np.asarray(prior, float)
        except (TypeError, ValueError):
            numbers = np.zeros(0)
        if numbers.shape != (2,) or not np.isfinite(numbers).all() or not numbers[1] > 0.0:
            kinds = "(mean, standard deviation > 0), a function of JAX that returns the log density, or a distribution of numpyro"
            problems.append(f"priors: {quote(name)} must be {kinds}, not {prior!r:.60}")
        elif name in unknowns.names:
            mean[unknowns.names.index(name)], sigma[unknowns.names.index(name)] = numbers
        else:
            functions[name] = _normal(*numbers.tolist())
    if problems:
        raise IdentificationError(problems)
    return replace(unknowns, mean=mean, sigma=sigma), functions


def _normal(mean: float, sigma: float) -> LogDensityOfNumber:
    """Return the logarithm of a normal density as a function, for unknowns other than parameters: initial states and noise."""
    return lambda x: -0.5 * weighted(x, np.asarray(mean), sigma) ** 2 - np.log(sigma * np.sqrt(2.0 * np.pi))


def require_priors_of(unknowns: Unknowns, functions: Mapping[str, LogDensityOfNumber]) -> None:
    """Require that each function belongs to an unknown, and can be differentiated by JAX.

    Raises:
        IdentificationError: lists every mistake.
    """
    problems, names = [], unknowns.names
    for name, function in functions.items():
        if name not in names:
            problems.append(f"priors: no unknown {quote(name)}{suggestion(name, names)}")
            continue
        try:
            shape = jax.eval_shape(jax.grad(lambda x, function=function: jnp.asarray(function(x))), jnp.ones(())).shape
            assert shape == ()
        except Exception as error:
            cure = "use jax.scipy.stats or numpyro.distributions; functions of NumPy and SciPy have no derivatives"
            problems.append(f"priors: {quote(name)} is not a function of JAX of one number ({type(error).__name__}): {cure}")
    if problems:
        raise IdentificationError(problems)
