"""CPU time and error of one run of the paper's linkage by other programs, each with its own best settings, and by the default."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks.peers import MODULES, PEERS_OF
from benchmarks.peers.peer import Peer, Problem, Run
from benchmarks.scripts import solve

START, CAP = -45.0, 1.0  # degrees; s of CPU time, after which a curve ends
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
REGULARIZATION = 1e-10  # of the script: the most accurate one
SMOKE = (0.5, (1e-6,))  # s of the run, tolerances


def _ours(problem: Problem) -> Run:
    mechanism = udk.library.parallelogram(problem.angle)

    @jax.jit
    def run(tol):
        return udk.simulate(mechanism, problem.ts, rtol=tol, atol=tol, throw=False).q

    return lambda tol: np.asarray(run(tol)).reshape(-1, 12)


def _script(problem: Problem) -> Run:
    run, y0 = jax.jit(solve(problem.ts, REGULARIZATION)), jnp.concatenate([jnp.asarray(problem.q0), jnp.zeros(12)])
    return lambda tol: np.asarray(run(y0, tol))


def peers(smoke: bool) -> list[dict[str, Any]]:
    """Return the name, knob (what sets the accuracy), error (m, rad) and seconds of each run, by every installed program."""
    own = (
        Peer("udkjax", "udkjax", "tolerance", TOLERANCES, _ours),
        Peer("a script with diffrax", "diffrax", "tolerance", TOLERANCES[:-1], _script),
    )
    others = () if smoke else tuple(peer for module in MODULES for peer in PEERS_OF[module] if peer.batch == 1)
    found = []
    for peer in (*own, *others):
        if peer.available():
            end, knobs = SMOKE if smoke else (peer.end, peer.knobs[:: 2 if peer in others else 1])
            found += [{"name": peer.name} | row for row in peer.curve(START, knobs, end, CAP)]
    return found
