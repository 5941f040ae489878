"""Chains of Hamiltonian Monte Carlo in lanes: all take equally many steps, so that each step is one batch of runs.

The lengths of trajectories, which all chains share, vary about a quarter of a period of a normal density, from which draws are
nearly independent. The size of a step and the covariance, by which unknowns are scaled, are tuned between chunks.

Equations of motion are linear in masses and inertias. Where records know a sum of these much better than each of them, the
posterior is a thin straight ridge, which logarithms bend. Therefore, chains move in the ratio of a positive number to its mode,
or in its logarithm if its uncertainty reaches zero.
R. M. Neal, MCMC using Hamiltonian dynamics, Handbook of Markov Chain Monte Carlo (2011) 113.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import ndtri

from udkjax.extras import OptionalImport
from udkjax.study.identify.density.log_density import InferenceProblem

DRAWS = 25  # number of draws in a chunk, between which tuning, storing and interruptions take place
LENGTH, LENGTHS = np.pi / 2, (0.6, 1.4)  # of trajectories for unit covariance, and the range of its random factor
STEP_FACTORS = 0.8, 1.0  # range of the random factor of a step, which avoids periods of a trajectory that are multiples of it
FIRST_STEP, LARGEST_STEP = 0.5, 1.5  # for unit covariance; leapfrog is unstable from 2
MOST_STEPS = 256  # largest number of steps of a trajectory
ACCEPTANCE = 0.8  # mean acceptance to which the step is tuned
ACCEPTANCE_RANGE = 0.01, 0.995  # means beyond say only that the step is far too large or small
STEP_CHANGE = 0.3, 1.5  # limits of the ratio of successive steps
PRIOR_DRAWS = 1.0  # weight of the previous covariance in the next one, in draws for each unknown


LINEAR_DEVIATION = 0.5  # deviation of a logarithm below which the number itself is the coordinate; two of these do not reach zero
SOFT = 0.1  # ratio to the mode below which such a coordinate turns into a logarithm, so that the number stays positive
LEAST = -600.0  # least coordinate, relative to SOFT, whose exponential is not rounded to zero


class ChainCoordinates(NamedTuple):
    """The coordinates w of chains, of the unconstrained vector x with its mode.

    Where `linear`, the ratio of a number to its mode is exp(x - mode) = s log(1 + exp(w / s)), with s = 0.1, which is w unless
    it is small; elsewhere w = x - mode.
    """

    mode: Float[np.ndarray, "K"]
    linear: Bool[np.ndarray, "K"]

    def x(self, w: Any, xp: Any = np) -> Any:
        """Return unconstrained vectors (..., K), by NumPy or JAX."""
        y = xp.maximum(xp.where(self.linear, w, SOFT) / SOFT, LEAST)
        return self.mode + xp.where(self.linear, xp.log(SOFT * xp.logaddexp(y, 0.0)), w)

    def log_slope(self, w: Any) -> Any:
        """Return the logarithm of the determinant of dx/dw (K, K), by JAX."""
        y = jnp.maximum(jnp.where(self.linear, w, SOFT) / SOFT, LEAST)
        slopes = -jnp.logaddexp(0.0, -y) - jnp.log(SOFT * jnp.logaddexp(y, 0.0))
        return jnp.sum(jnp.where(self.linear, slopes, 0.0))

    def w(self, x: Float[np.ndarray, "... K"]) -> Float[np.ndarray, "... K"]:
        """Return the coordinates of unconstrained vectors."""
        ratio = np.exp(np.where(self.linear, x - self.mode, 0.0))
        return np.where(self.linear, ratio + SOFT * np.log(-np.expm1(-ratio / SOFT)), x - self.mode)


def coordinates_of(
    problem: InferenceProblem, mode: Float[np.ndarray, "K"], covariance: Float[np.ndarray, "K K"]
) -> ChainCoordinates:
    """Return the coordinates for a density with this mode and approximate covariance."""
    positive = np.array(problem.unknowns.kinds) == "positive"
    return ChainCoordinates(mode, positive & (np.sqrt(np.diag(covariance)) < LINEAR_DEVIATION))


class Tuning(NamedTuple):
    """The size of steps for unit covariance, and the covariance (K, K) of the coordinates."""

    step: float
    covariance: Float[np.ndarray, "K K"]


class ChainState(NamedTuple):
    """The state of C chains: positions (C, K), logarithms of the density (C,), and their gradients (C, K).

    With a density of zero, -inf, and zero gradient, the next proposal of positive density is accepted.
    """

    position: Any
    logdensity: Any
    logdensity_grad: Any


DrawChunk = Mapping[str, np.ndarray]  # arrays of a chunk by name, draws first


def first_state(positions: Float[np.ndarray, "C K"]) -> ChainState:
    """Return the state of chains at positions where the density has not been evaluated."""
    return ChainState(positions, np.full(len(positions), -np.inf), np.zeros(positions.shape))


def compile_draws(problem: InferenceProblem) -> Callable[..., tuple[ChainState, dict[str, Array]]]:
    """Return a compiled function of coordinates, a key, the tuning and the state; it returns the next state, and draws."""
    with OptionalImport():
        from blackjax.mcmc import hmc
    kernel = hmc.build_kernel()

    def draw(
        problem: InferenceProblem, coordinates: ChainCoordinates, tuning: Tuning, state: Any, key: Array
    ) -> tuple[Any, dict[str, Array]]:
        density = lambda w: problem.log_density(coordinates.x(w, jnp)) + coordinates.log_slope(w)  # noqa: E731
        of_length, of_step, of_chains = jax.random.split(key, 3)
        step = tuning.step * jax.random.uniform(of_step, minval=STEP_FACTORS[0], maxval=STEP_FACTORS[1])
        length = LENGTH * jax.random.uniform(of_length, minval=LENGTHS[0], maxval=LENGTHS[1])
        steps = jnp.clip(jnp.round(length / step), 1, MOST_STEPS).astype(int)
        one = lambda key, state: kernel(key, state, density, step, tuning.covariance, steps)  # noqa: E731
        state, info = jax.vmap(one)(jax.random.split(of_chains, len(state.position)), state)
        failed = ~jnp.isfinite(info.proposal.logdensity)
        found = {
            "position": state.position,
            "log_density": state.logdensity - jax.vmap(coordinates.log_slope)(state.position),
            "acceptance": info.acceptance_rate,
            "failed": failed,
        }
        return state, found | {"divergent": info.is_divergent & ~failed, "steps": steps}

    def chunk(
        problem: InferenceProblem, coordinates: ChainCoordinates, key: Array, tuning: Tuning, state: ChainState
    ) -> tuple[ChainState, dict[str, Array]]:
        begin, one = hmc.HMCState(*map(jnp.asarray, state)), partial(draw, problem, coordinates, tuning)
        end, found = jax.lax.scan(one, begin, jax.random.split(key, DRAWS))
        return ChainState(*end), found

    return problem.compiled("draws", chunk)


def tuned(first: Tuning, warmup: Sequence[DrawChunk]) -> Tuning:
    """Return the tuning that follows from the first one and the chunks of the warm-up so far.

    The errors of the energy, whose size is proportional to the square of the step, decide acceptance, 2 Phi(-s / 2) for errors
    of deviation s. The covariance is that of the later half of the draws of all chains.
    """
    tunings = [first]
    for k in range(1, len(warmup) + 1):
        previous = tunings[-1]
        mean = np.clip(warmup[k - 1]["acceptance"].mean(), *ACCEPTANCE_RANGE)
        change = np.clip(np.sqrt(ndtri(1.0 - ACCEPTANCE / 2) / ndtri(1.0 - mean / 2)), *STEP_CHANGE)
        step = min(float(previous.step * change), LARGEST_STEP)
        covariance = _covariance(previous.covariance, warmup[k // 2 : k]) if k > 1 else previous.covariance
        tunings.append(Tuning(step, covariance))
    return tunings[-1]


def settled(first: Tuning, warmup: Sequence[DrawChunk]) -> Tuning:
    """Return the tuning after the warm-up: the covariance of its later half, and the mean step there."""
    later = [tuned(first, warmup[:k]).step for k in range(len(warmup) // 2, len(warmup) + 1)]
    return Tuning(float(np.exp(np.mean(np.log(later)))), tuned(first, warmup).covariance)


def _covariance(previous: Float[np.ndarray, "K K"], chunks: Sequence[DrawChunk]) -> Float[np.ndarray, "K K"]:
    """Return the covariance of draws; with few of them, partly the previous one."""
    K = len(previous)
    w = np.concatenate([chunk["position"].reshape(-1, K) for chunk in chunks])
    weight = PRIOR_DRAWS * K / (PRIOR_DRAWS * K + len(w))
    return (1.0 - weight) * np.cov(w.T).reshape(K, K) + weight * previous
