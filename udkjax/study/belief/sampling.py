"""`sample`: from a posterior density to draws, which are stored as they come."""

import os
from collections.abc import Mapping
from typing import Annotated

import jax
import numpy as np

from udkjax.argument_types import COUNT, NOT_NEGATIVE_COUNT
from udkjax.devices import computing_on_host
from udkjax.extras import BAYES_PACKAGES, require
from udkjax.integrate.solution import versions
from udkjax.progress import ProgressOption, report_progress
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.study.belief.chains import (
    DRAWS_PER_CHUNK,
    FIRST_STEP,
    ChainState,
    DrawChunk,
    Randomness,
    Tuning,
    compile_draws,
    coordinates_of,
    covariance_of,
    first_state,
    settled,
    tuned,
)
from udkjax.study.belief.posterior import Posterior
from udkjax.study.identify.answers.estimate import Estimate
from udkjax.study.identify.density.laplace import approximate
from udkjax.study.identify.density.log_density import InferenceProblem
from udkjax.study.identify.records.records import IdentificationError
from udkjax.study.sweep.fingerprint import JsonValue, describe_function, describe_model, describe_value
from udkjax.study.sweep.plan import Chunk as StoredChunk
from udkjax.study.sweep.store import open_store
from udkjax.study.sweep.sweep import PATH

SCALING_DRAWS = 256  # number of nearly independent draws whose covariance first scales the chains
WARMUP_DRAWS = 300  # default number of draws that tune the chains
STATE_PARTS = "logdensity", "logdensity_grad"  # parts of the state of chains that are stored besides the last draw


@checked
@concrete_only()
def sample(
    density: InferenceProblem | Estimate,
    *,
    chains: Annotated[int, COUNT] = 8,
    draws: Annotated[int, COUNT] = 1000,
    warmup: Annotated[int, COUNT] = WARMUP_DRAWS,
    seed: Annotated[int, NOT_NEGATIVE_COUNT] = 0,
    out: Annotated[str | os.PathLike[str], PATH] | None = None,
    progress: ProgressOption = None,
) -> Posterior:
    """Draw parameters from their posterior density, by chains of Hamiltonian Monte Carlo that run side by side.

    The chains start from the normal approximation at the mode (`Estimate.laplace`), which also scales the unknowns. Where a run
    fails, a proposal is rejected. Ctrl-C returns the draws so far, once the warm-up is over.

    Args:
        density: the problem from `inference`, or an estimate from `identify`.
        chains: number of chains.
        draws: number of draws of each chain.
        warmup: number of earlier draws, which only tune the chains, in whole chunks of 25.
        seed: seed of all random numbers.
        out: a folder for finished chunks of draws. The same call continues from these, to the same numbers; with more `draws`,
            it appends to them.
        progress: as for `identify`.

    Returns:
        The draws, by name and in the units of the parameters, and how far they may be trusted.

    Raises:
        IdentificationError: neither the records nor a prior determine some parameters, records without given noise fit to
            rounding, or no chain moves.
        StoreError: `out` cannot be written to, or contains another posterior.
    """
    require(*BAYES_PACKAGES)
    problem = density.posterior if isinstance(density, Estimate) else density
    first = -(-warmup // DRAWS_PER_CHUNK)
    total = first + -(-draws // DRAWS_PER_CHUNK)
    settings = {"chains": chains, "warmup": first * DRAWS_PER_CHUNK, "seed": seed}
    done: list[DrawChunk] = []
    with open_store(out, {**settings, **_fingerprint(problem)} if out is not None else {}, "posterior") as store:
        stored = {int(index[0]): data for index, data in store.read_chunks()}

        def finished(k: int, data: DrawChunk) -> DrawChunk:
            if k not in stored:
                store.write(StoredChunk(k, 0, np.array([k]), 1.0), data)
            return data

        start = finished(0, stored[0] if 0 in stored else _start(density, problem, chains, seed))
        coordinates = coordinates_of(problem, start["mode"], start["covariance"])
        w = coordinates.w(start["x"])
        begin = tuning = Tuning(FIRST_STEP, covariance_of(start["covariance"], np.unique(w, axis=0)))
        state, compute = first_state(w[:chains]), compile_draws(problem)
        try:
            with report_progress(progress, total * DRAWS_PER_CHUNK, "sample") as report, computing_on_host():
                for k in range(1, total + 1):
                    if k not in stored:
                        randomness = Randomness.of_chunk(seed, k, tuning.step, state.position.shape)
                        root = np.linalg.cholesky(tuning.covariance)
                        state, found = jax.tree.map(np.asarray, compute(coordinates, root, randomness, state))
                        stored_state = {name: getattr(state, name) for name in STATE_PARTS}
                        done.append(finished(k, {**found, "steps": randomness.steps, **stored_state}))
                    else:
                        done.append(stored[k])
                    state = ChainState(done[-1]["position"][-1], *(done[-1][name] for name in STATE_PARTS))
                    if k <= first:
                        _require_movement(done, k == first)
                        tuning = (settled if k == first else tuned)(begin, done)
                    report(k * DRAWS_PER_CHUNK, "warm-up" if k <= first else "")
        except KeyboardInterrupt:
            if len(done) <= first:
                raise
    return Posterior.of(problem, coordinates, done[first:], draws, tuning.step)


def _start(density: InferenceProblem | Estimate, problem: InferenceProblem, chains: int, seed: int) -> DrawChunk:
    """Return arrays by name: the mode, the covariance there, and vectors x that are nearly draws of the density.

    The first of these vectors, one for each chain, are the starts of the chains.
    """
    estimated = isinstance(density, Estimate)
    approximation = density.laplace(seed, quick=False) if estimated else approximate(problem, problem.start, seed)
    starts = approximation.starts(max(chains, SCALING_DRAWS), seed)
    return {"x": starts, "mode": approximation.mode, "covariance": approximation.covariance}


def _require_movement(warmup: list[DrawChunk], ended: bool) -> None:
    """Raise an error if no chain has reached a positive density, or if no chain has moved by the end of the warm-up."""
    if not np.isfinite(warmup[-1]["logdensity"]).any():
        cure = "give priors or bounds that keep the numbers where the mechanism runs, or a larger max_steps"
        raise IdentificationError(
            [f"the density is zero wherever the {DRAWS_PER_CHUNK} first proposals of the chains went: {cure}"]
        )
    if ended and not any(chunk["acceptance"].any() for chunk in warmup):
        cure = "use a longer warmup, or start nearer to the mode, as with the result of `identify`"
        raise IdentificationError([f"no chain accepted any proposal of its warm-up: {cure}"])


def _fingerprint(problem: InferenceProblem) -> Mapping[str, JsonValue]:
    """Return the inputs that determine the draws of a density, by name, to tell whether stored draws belong to it."""
    fit, u = problem.fit_problem, problem.unknowns
    numbers = np.stack([u.guess, u.low, u.high, u.scale, u.mean, u.sigma], axis=1).tolist()
    return {
        **describe_model(fit.mechanism, int(np.prod(fit.mechanism.state_shape()))),
        "unknowns": {name: [kind, *map(repr, row)] for name, kind, row in zip(u.names, u.kinds, numbers, strict=True)},
        "targets": {
            name: list(target.names) if target.function is None else describe_value(repr(target.function))
            for name, target in zip(u.names, u.targets, strict=True)
        },
        "priors": {u.names[k]: describe_function(f, np.ones(())) for k, f in problem.prior.functions.items()},
        "measured": describe_value(fit.measured),
        "noise": describe_value(problem.sigma),
        "runs": [describe_value(np.asarray(x)) for x in jax.tree.leaves(fit.runs)],
        "settings": {name: describe_value(x) for name, x in fit.settings.items() if name != "analysis"},
        "max_steps": problem.max_steps,
        "tol": list(problem.tol),
        "versions": {k: v for k, v in versions().items() if k != "python"},
    }
