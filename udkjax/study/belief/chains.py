"""Chains of Hamiltonian Monte Carlo in lanes: all take equally many steps, so that each step is one batch of runs.

The lengths of trajectories, which all chains share, vary about a quarter of a period of a normal density, from which draws are
nearly independent. The size of a step and the covariance, by which unknowns are scaled, are tuned between chunks.

Equations of motion are linear in masses and inertias. Where records know a sum of these much better than each of them, the
posterior is a thin straight ridge, which logarithms bend. Therefore, chains move in the ratio of a positive number to its mode,
or in its logarithm if its uncertainty reaches zero.
R. M. Neal, MCMC using Hamiltonian dynamics, Handbook of Markov Chain Monte Carlo (2011) 113.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.special import ndtri

from udkjax.study.identify.density.log_density import InferenceProblem

DRAWS_PER_CHUNK = 25  # number of draws in a chunk, between which tuning, storing and interruptions take place
# Length of trajectories for unit covariance, and the range of its random factor.
TRAJECTORY_LENGTH, LENGTH_FACTORS = np.pi / 2, (0.6, 1.4)
STEP_FACTORS = 0.8, 1.0  # range of the random factor of a step, which avoids periods of a trajectory that are multiples of it
FIRST_STEP, LARGEST_STEP = 0.5, 1.5  # for unit covariance; leapfrog is unstable from 2
DIVERGENT_ERROR = 1000.0  # error of the energy of a trajectory that has left the density
MOST_STEPS = 256  # largest number of steps of a trajectory
TARGET_ACCEPTANCE = 0.8  # mean acceptance to which the step is tuned
ACCEPTANCE_RANGE = 0.01, 0.995  # means beyond say only that the step is far too large or small
STEP_CHANGE = 0.3, 1.5  # limits of the ratio of successive steps
PRIOR_DRAWS = 1.0  # weight of the previous covariance in the next one, in draws for each unknown


LINEAR_DEVIATION = 0.5  # deviation of a logarithm below which the number itself is the coordinate; two of these do not reach zero
SOFT_RATIO = 0.1  # ratio to the mode below which such a coordinate turns into a logarithm, so that the number stays positive
LEAST_EXPONENT = -600.0  # least coordinate, relative to SOFT_RATIO, whose exponential is not rounded to zero


class ChainCoordinates(NamedTuple):
    """The coordinates w in which chains move, as functions of the unconstrained vector x.

    For entries that are `linear`, the ratio of a number to its mode is exp(x - mode) = s log(1 + exp(w / s)), with s = 0.1; this
    ratio is w itself unless w is small. For all other entries, w = x - mode.

    Attributes:
        mode: the unconstrained vector of the largest density.
        linear: mask of the entries whose coordinate is the ratio of the number to its mode.
    """

    mode: Float[np.ndarray, "K"]
    linear: Bool[np.ndarray, "K"]

    def x(self, w: Any, xp: Any = np) -> Any:
        """Return the unconstrained vectors x at coordinates w, both (..., K), by NumPy or, with `xp` `jax.numpy`, by JAX."""
        y = xp.maximum(xp.where(self.linear, w, SOFT_RATIO) / SOFT_RATIO, LEAST_EXPONENT)
        return self.mode + xp.where(self.linear, xp.log(SOFT_RATIO * xp.logaddexp(y, 0.0)), w)

    def log_slope(self, w: Any) -> Any:
        """Return the logarithm of the determinant of dx/dw at coordinates w (K,), by JAX."""
        y = jnp.maximum(jnp.where(self.linear, w, SOFT_RATIO) / SOFT_RATIO, LEAST_EXPONENT)
        slopes = -jnp.logaddexp(0.0, -y) - jnp.log(SOFT_RATIO * jnp.logaddexp(y, 0.0))
        return jnp.sum(jnp.where(self.linear, slopes, 0.0))

    def w(self, x: Float[np.ndarray, "... K"]) -> Float[np.ndarray, "... K"]:
        """Return the coordinates w of unconstrained vectors x."""
        ratio = np.exp(np.where(self.linear, x - self.mode, 0.0))
        return np.where(self.linear, ratio + SOFT_RATIO * np.log(-np.expm1(-ratio / SOFT_RATIO)), x - self.mode)


def coordinates_of(
    problem: InferenceProblem, mode: Float[np.ndarray, "K"], covariance: Float[np.ndarray, "K K"]
) -> ChainCoordinates:
    """Return the coordinates for a density with this mode and approximate covariance."""
    positive = np.array(problem.unknowns.kinds) == "positive"
    return ChainCoordinates(mode, positive & (np.sqrt(np.diag(covariance)) < LINEAR_DEVIATION))


class Tuning(NamedTuple):
    """The tuning of chains: the size of leapfrog steps for unit covariance, and the covariance (K, K) of the coordinates."""

    step: float
    covariance: Float[np.ndarray, "K K"]


class Randomness(NamedTuple):
    """The random numbers of D draws of C chains, from NumPy: compiling XLA's generator would take longer than a whole chain.

    Attributes:
        momentum: standard normal numbers (D, C, K).
        log_uniform: logarithms of uniform numbers (D, C), which decide acceptance.
        steps: numbers of leapfrog steps of the trajectories (D,).
        size: sizes of these steps, for unit covariance (D,).
    """

    momentum: Float[np.ndarray, "D C K"]
    log_uniform: Float[np.ndarray, "D C"]
    steps: Int[np.ndarray, "D"]
    size: Float[np.ndarray, "D"]

    @classmethod
    def of_chunk(cls, seed: int, k: int, step: float, shape: tuple[int, int]) -> "Randomness":
        """Return the random numbers of chunk k.

        Args:
            seed: seed of all chunks.
            k: number of the chunk.
            step: size of leapfrog steps for unit covariance, which is multiplied by a random factor for each draw.
            shape: numbers of chains and of unknowns (C, K).
        """
        random = np.random.default_rng([seed, k])
        size = step * random.uniform(*STEP_FACTORS, DRAWS_PER_CHUNK)
        steps = np.clip(
            np.round(TRAJECTORY_LENGTH * random.uniform(*LENGTH_FACTORS, DRAWS_PER_CHUNK) / size), 1, MOST_STEPS
        ).astype(int)
        return cls(
            random.standard_normal((DRAWS_PER_CHUNK, *shape)),
            -random.standard_exponential((DRAWS_PER_CHUNK, shape[0])),
            steps,
            size,
        )


class ChainState(NamedTuple):
    """The state of C chains: positions (C, K), logarithms of the density (C,), and their gradients (C, K).

    If the density of a chain is zero (the logarithm is -inf, the gradient zero), the next proposal of positive density is
    accepted.
    """

    position: Any
    logdensity: Any
    logdensity_grad: Any


DrawChunk = Mapping[str, np.ndarray]  # arrays of a chunk by name, draws first


def first_state(positions: Float[np.ndarray, "C K"]) -> ChainState:
    """Return the state of chains at positions where the density has not been evaluated, and counts as zero."""
    return ChainState(positions, np.full(len(positions), -np.inf), np.zeros(positions.shape))


def compile_draws(problem: InferenceProblem) -> Callable[..., tuple[ChainState, dict[str, Array]]]:
    """Return a compiled function that computes a chunk of draws of all chains.

    Its arguments are the `ChainCoordinates`, a root (K, K) of the covariance, the `Randomness` of the chunk, and the
    `ChainState`. It returns the state after the chunk, and arrays (D, C, ...) of the draws by name.
    """

    def chunk(
        problem: InferenceProblem,
        coordinates: ChainCoordinates,
        root: Float[Array, "K K"],
        randomness: Randomness,
        state: ChainState,
    ) -> tuple[ChainState, dict[str, Array]]:
        density = lambda w: problem.log_density(coordinates.x(w, jnp)) + coordinates.log_slope(w)  # noqa: E731
        densities = jax.vmap(jax.value_and_grad(density))

        def draw(state: ChainState, random: Randomness) -> tuple[ChainState, dict[str, Array]]:
            def leapfrog(_: Any, moving: tuple[Array, ChainState]) -> tuple[Array, ChainState]:
                p = moving[0] + 0.5 * random.size * moving[1].logdensity_grad @ root
                w = moving[1].position + random.size * p @ root.T
                value, slope = densities(w)
                return p + 0.5 * random.size * slope @ root, ChainState(w, value, slope)

            p, proposal = jax.lax.fori_loop(0, random.steps, leapfrog, (random.momentum, state))
            gain = proposal.logdensity - state.logdensity + 0.5 * jnp.sum(random.momentum**2 - p**2, axis=1)
            failed = ~jnp.isfinite(proposal.logdensity)
            gain = jnp.where(failed | jnp.isnan(gain), -jnp.inf, gain)
            accepted = random.log_uniform < gain
            chosen = lambda x, old: jnp.where(accepted.reshape(-1, *[1] * (x.ndim - 1)), x, old)  # noqa: E731
            after = jax.tree.map(chosen, proposal, state)
            found = {"position": after.position, "logdensity": after.logdensity, "acceptance": jnp.exp(jnp.minimum(gain, 0.0))}
            return after, found | {"failed": failed, "divergent": ~failed & (gain < -DIVERGENT_ERROR)}

        end, found = jax.lax.scan(draw, ChainState(*map(jnp.asarray, state)), randomness)
        found["log_density"] = found.pop("logdensity") - jax.vmap(jax.vmap(coordinates.log_slope))(found["position"])
        return end, found

    return problem.compiled("draws", chunk)


def tuned(first: Tuning, warmup: Sequence[DrawChunk]) -> Tuning:
    """Return the tuning that follows from the first one and the chunks of the warm-up so far.

    If the errors of the energy have a standard deviation s, 2 Phi(-s / 2) of the proposals are accepted, and s is proportional to
    the square of the step: this relation gives the step for the wanted acceptance. The covariance is that of the later half of
    the draws of all chains.
    """
    tunings = [first]
    for k in range(1, len(warmup) + 1):
        previous = tunings[-1]
        mean = np.clip(warmup[k - 1]["acceptance"].mean(), *ACCEPTANCE_RANGE)
        change = np.clip(np.sqrt(ndtri(1.0 - TARGET_ACCEPTANCE / 2) / ndtri(1.0 - mean / 2)), *STEP_CHANGE)
        step = min(float(previous.step * change), LARGEST_STEP)
        w = np.concatenate([chunk["position"].reshape(-1, len(previous.covariance)) for chunk in warmup[k // 2 : k]])
        covariance = covariance_of(previous.covariance, w) if k > 1 else previous.covariance
        tunings.append(Tuning(step, covariance))
    return tunings[-1]


def settled(first: Tuning, warmup: Sequence[DrawChunk]) -> Tuning:
    """Return the tuning after the warm-up: the covariance of its later half, and the geometric mean of the steps there."""
    later = [tuned(first, warmup[:k]).step for k in range(len(warmup) // 2, len(warmup) + 1)]
    return Tuning(float(np.exp(np.mean(np.log(later)))), tuned(first, warmup).covariance)


def covariance_of(previous: Float[np.ndarray, "K K"], w: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "K K"]:
    """Return a weighted mean of the previous covariance and that of the draws w, whose weight grows with their number."""
    K = len(previous)
    weight = PRIOR_DRAWS * K / (PRIOR_DRAWS * K + len(w))
    return (1.0 - weight) * np.cov(w.T, ddof=0).reshape(K, K) + weight * previous
