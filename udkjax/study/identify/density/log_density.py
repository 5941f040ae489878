"""The logarithm of a posterior density, as a pure function of JAX of an unconstrained vector.

With y the measured and yhat the predicted values, sigma the standard deviations of the noise, and p the prior density of the
unknowns x, which are transforms x(z) of the components of a vector z,

    log p(z | y) = log p(x(z)) + sum log(dx/dz) - sum ((yhat - y) / sigma)^2 / 2 - sum log(sigma (2 pi)^(1/2)).

The transforms are those of `identify`: a positive number is the exponential of a component, a bounded one a logistic function;
dx/dz is their Jacobian, so that priors are densities of the numbers themselves.
"""

from collections.abc import Callable, Mapping
from copy import copy
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Numbers
from udkjax.arrays import is_traced
from udkjax.integrate.solution import CAUSES, Result
from udkjax.study.identify.density.priors import LogDensityOfNumber, PriorDensity, require_priors_of
from udkjax.study.identify.problem.fit_problem import FitProblem, weighted
from udkjax.study.identify.problem.prediction import Predictor, TolerancePair
from udkjax.study.identify.problem.residuals import reduce_groups
from udkjax.study.identify.problem.unknowns import Target, Unknown, Unknowns
from udkjax.study.identify.records.records import IdentificationError
from udkjax.study.members import member_threads
from udkjax.study.noise import NOISE_FLOOR

# Largest number of steps of a run, relative to those at the start. With numbers far from the start, such as masses times 1e13, a
# run could take minutes, and all other chains of a batch would wait for it.
MOST_STEPS = 20
# Runs of a batch whose outputs stay in the processor's cache: 1,024 four-bars with 500 outputs take half the time.
BATCH_RUNS = 16
# Runs of a thread: of a quarter of the weights of a normal approximation, two threads have one part each.
THREAD_RUNS = 8 * BATCH_RUNS


class InferenceProblem:
    """The posterior density of parameters, as a function of an unconstrained vector x, which is zero at the start.

    Args:
        problem: records, parameters and normal priors, as a problem of least squares; usually made by `udkjax.inference`.
        functions: the other priors, functions of JAX that return the log density, by name.
        tol: tolerances of the integration, relative and absolute.
        z: unknowns of the problem, at whose residuals the noise that is not given starts; by default those of the start.

    Attributes:
        names: names of the unknowns: parameters, changes of initial states, and standard deviations of noise that is not given
            ("noise of body.crank.angle"), which is one more number for each channel.
        units: units of the unknowns.
        start: the vector (K,) of the scene's own numbers.
        max_steps: largest number of steps of a run; beyond, the density is zero.
    """

    def __init__(
        self,
        problem: FitProblem,
        functions: Mapping[str, LogDensityOfNumber],
        tol: TolerancePair,
        z: Float[np.ndarray, "K"] | None = None,
    ):
        self.fit_problem, self.tol = problem, tol
        z = np.zeros(problem.K) if z is None else z
        self.groups = problem.noise_groups()[: len(problem.index)]
        steps = self._scale_noise(z)
        self.unknowns = _all_unknowns(problem, self.scales)
        self.names, self.units = self.unknowns.names, self.unknowns.units
        self.start = np.zeros(len(self.names))
        require_priors_of(self.unknowns, functions)
        of_noise = range(problem.K, len(self.names))
        self.prior = PriorDensity(self.unknowns, {self.names.index(n): f for n, f in functions.items()}, of_noise)
        self.max_steps = int(problem.settings.get("max_steps", MOST_STEPS * steps))
        settings = {**problem.settings, "max_steps": self.max_steps}
        self.predictor = Predictor(problem.mechanism, problem.unknowns.targets, problem.channels, settings)
        self._require_support()
        self.programs: dict[str, Any] = {}  # compiled functions, which copies for other measured values share

    def _scale_noise(self, z: np.ndarray) -> int:
        """Set the standard deviations of noise that is not given to those of the residuals at z.

        Return the largest number of steps of a run at z.

        Raises:
            IdentificationError: a run fails.
        """
        problem = self.fit_problem
        used = np.concatenate([np.ones(len(problem.index), bool), np.zeros(problem.extra_rows, bool)])
        code = problem.code(z, self.tol)
        if code != Result.successful:
            cure = "change the scene's numbers, or the first guess of a Parameter"
            raise IdentificationError([f"the records cannot be simulated at the start: {CAUSES[Result(code)]}; {cure}"])
        reduced = reduce_groups(problem.row_blocks(z[None], self.tol), problem.K, problem.noise_groups(), 0, used)
        sizes = [np.sqrt(group.r @ group.r / group.count) for group in reduced.groups[:-1]]
        scales = np.ones(len(sizes))
        for g, size in enumerate(sizes):
            row = int(np.argmax(self.groups == g))
            scales[g] = max(size, NOISE_FLOOR * problem.channel_scale[problem.index[row, 2]] / problem.sigma[row])
        self.factors = scales
        self.sigma = problem.sigma * np.append(scales, 1.0)[self.groups]
        self.scales = {
            f"noise of {problem.channel_names[problem.index[row, 2]]}": (float(self.sigma[row]), problem.index[row, 2])
            for row in (int(np.argmax(self.groups == g)) for g in range(len(scales)))
        }
        runs = np.arange(len(problem.runs.ts))
        taken = problem.predictor(problem.members(z[None], runs), self.tol).steps
        return int(np.max(taken)) if taken is not None else 1

    def _require_support(self) -> None:
        """Raise an error if the prior density is zero at the start."""
        x = self.unknowns.values(self.start)
        bad = [k for k, f in self.prior.functions.items() if not np.isfinite(np.asarray(f(jnp.asarray(x[k]))))]
        if bad:
            cure = "start where its density is positive, Parameter(..., guess=...), or change the prior"
            raise IdentificationError([f"priors: {self.names[k]} has no density at its start, {x[k]:.6g}: {cure}" for k in bad])

    def log_density(self, x: Float[Array, "K"] | Numbers) -> Float[Array, ""]:
        """Return the logarithm of the posterior density, up to a constant of the records.

        It is a pure function of JAX (`jit`, `vmap`, `grad`, `hessian`). Where a run fails or takes more than `max_steps` steps,
        it is -inf with zero gradient.

        Args:
            x: the unconstrained vector (K,): zero at the start; a positive number is its start times exp(x), a bounded one a
                logistic function, others their start plus a scale times x. The Jacobian of these transforms is included.
        """
        density = jax.custom_jvp(self._log_density)
        density.defjvp(self._slope)
        return density(jnp.asarray(x, float))

    def with_measured(self, measured: Float[Array, "R"] | Numbers) -> "InferenceProblem":
        """Return the problem with other measured values, in the order of record, time and channel, as of a repeated experiment.

        Its start is the same, and it shares compiled functions with this problem. The values may be traced by JAX.
        """
        other = copy(self)
        other.fit_problem = copy(self.fit_problem)
        wanted = self.fit_problem.measured.shape
        values: Any = measured if isinstance(measured, Array) else np.asarray(measured, float)
        if values.shape != wanted:
            raise IdentificationError(
                [f"measured: must be of shape {wanted}, one number for each measured value, not {values.shape}"]
            )
        other.fit_problem.measured = values
        return other

    def log_prior(self, x: Float[Array, "K"] | Numbers) -> Float[Array, ""]:
        """Return the part of `log_density` that does not depend on the records, including the Jacobian of the transforms."""
        x = jnp.asarray(x, float)
        return self.prior(self.unknowns.values(x, jnp)) + jnp.sum(self.unknowns.log_dx_dz(x, jnp))

    def parameters(self, x: Float[Array, "K"] | Numbers) -> dict[str, Any]:
        """Return the numbers of the unknowns at x by name, in `units`; for several vectors (..., K), arrays (...)."""
        values = self.unknowns.values(jnp.asarray(x, float), jnp)
        return {name: values[..., k] for k, name in enumerate(self.names)}

    def log_likelihoods(self, x: Float[Array, "K"] | Numbers) -> Float[Array, "R"]:
        """Return the logarithm of the likelihood of each measured value, in the order of record, time and channel."""
        return self._likelihoods(jnp.asarray(x, float))[0]

    def predicted(self, x: Float[Array, "K"] | Numbers) -> Float[Array, "R"]:
        """Return the predicted value for each measured one, in the units of its channel."""
        return self._predict(jnp.asarray(x, float))[0]

    def _predict(self, x: Array) -> tuple[Array, Array]:
        problem = self.fit_problem
        runs = np.arange(len(problem.runs.ts))
        found = self.predictor.traced(problem.members(x[None, : problem.K], runs, xp=jnp), self.tol)
        return found["y"][problem.run, problem.time, problem.index[:, 2]], found["code"]

    def _likelihoods(self, x: Array) -> tuple[Array, Array]:
        predicted, code = self._predict(x)
        sigma = self.sigma * jnp.exp(jnp.append(x[self.fit_problem.K :], 0.0))[self.groups]
        r = weighted(predicted, self.fit_problem.measured, sigma)
        # Without the barrier, XLA's CPU compiler (jaxlib 0.12.0) loses the terms of r in sums of more than 4096 of these.
        return jax.lax.optimization_barrier(-0.5 * r**2 - jnp.log(sigma * np.sqrt(2.0 * np.pi))), code

    def _log_density(self, x: Array) -> Array:
        each, code = self._likelihoods(x)
        total = self.log_prior(x) + jnp.sum(each)
        return jnp.where(jnp.all(code == Result.successful) & jnp.isfinite(total), total, -jnp.inf)

    def _slope(self, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        value, slopes = jax.value_and_grad(self._log_density)(primals[0])
        return value, jnp.dot(jnp.where(jnp.isfinite(value), slopes, 0.0), tangents[0])

    def prior_curvature(self, x: Float[Array, "K"] | Numbers) -> tuple[Array, Array, Array]:
        """Return `log_prior` at x, its gradient (K,) and its second derivatives (K, K), by a compiled function."""

        def curvature(problem: "InferenceProblem", x: Array) -> tuple[Array, Array, Array]:
            gradient = jax.grad(problem.log_prior)
            return problem.log_prior(x), gradient(x), jax.jacfwd(gradient)(x)

        return self.compiled("prior", curvature)(x)

    def log_densities(self, x: Float[Array, "B K"] | Numbers) -> Float[Array, "B"]:
        """Return `log_density` of B vectors, by a compiled function; if there are many vectors, by all threads."""

        def densities(problem: "InferenceProblem", x: Array) -> Array:
            each = jax.vmap(problem.log_density)
            if len(x) <= BATCH_RUNS:
                return each(x)
            batches = jnp.pad(x, ((0, -len(x) % BATCH_RUNS), (0, 0)), mode="edge").reshape(-1, BATCH_RUNS, x.shape[1])
            return jax.lax.map(each, batches).reshape(-1)[: len(x)]

        compiled = self.compiled("densities", densities)
        if is_traced(x) or np.shape(x)[0] <= THREAD_RUNS:
            return compiled(x)
        points = np.asarray(x, float)
        parts = np.pad(points, ((0, -len(points) % THREAD_RUNS), (0, 0)), mode="edge").reshape(-1, THREAD_RUNS, points.shape[1])
        each = member_threads().map(lambda part: np.asarray(compiled(part)), parts)
        return jnp.asarray(np.concatenate(list(each))[: len(points)])

    def compiled(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a compiled function of some arguments, `function(problem, *arguments)` for this problem.

        It is compiled once for each `name`, and shared by the problems that `with_measured` returns.
        """
        if name not in self.programs:
            self.programs[name] = jax.jit(lambda measured, *args: function(self.with_measured(measured), *args))
        return partial(self.programs[name], self.fit_problem.measured)


def _all_unknowns(problem: FitProblem, scales: Mapping[str, tuple[float, int]]) -> Unknowns:
    """Return parameters, changes of initial states, and standard deviations of noise, all with their transforms."""
    u, P = problem.unknowns, len(problem.unknowns.names)
    numbers = zip(u.guess, u.low, u.high, u.scale, u.mean, u.sigma, strict=True)
    text = zip(u.names, u.units, u.targets, u.kinds, strict=True)
    parameters = [Unknown(*one, True, *own) for one, own in zip(text, numbers, strict=True)]
    no = np.nan
    states = [
        Unknown(name, unit, Target(), "free", True, 0.0, no, no, size, no, no)
        for name, unit, size in zip(problem.all_names[P:], problem.all_units[P:], problem.state_sizes.tolist(), strict=True)
    ]
    noise = [
        Unknown(name, problem.channels[c].units, Target(), "positive", True, size, no, no, size, no, no)
        for name, (size, c) in scales.items()
    ]
    return Unknowns.of([*parameters, *states, *noise])
