"""The study of the paper repeated: pseudoinverses, tolerances, stabilizations, and its errors.

The paper's five-bar parallelogram is released from rest and simulated for 20 s by five pseudoinverses, at three tolerances, with
and without Baumgarte's stabilization; its section 6 lists the results. Here each run is compared with the exact solution, and
better runs are added to the paper's. `study` returns everything as one dataset.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from udkjax.equations import Baumgarte, energy
from udkjax.equations.states.textbook import prepare
from udkjax.integrate import Projection, Result, simulate
from udkjax.integrate.solvers import solver_named
from udkjax.pinv import SVD, Auto, Elimination, GramSchmidt, Greville, Householder, OneOf, Pseudoinverse, Varga
from udkjax.positions.assembling.assembly import State, assemble
from udkjax.scene import Mechanism
from udkjax.scene.library import parallelogram
from udkjax.study.accuracy import exact_coordinates
from udkjax.threads import thread_count

from . import vode
from .cases import FIRST_STEP, FULL, RANK_HELD, Case, Program, Scope, plan
from .record import dataset

INSTANTS = 401  # times at which each run is examined
START = -45.0  # degrees. Inferred: the paper does not print its initial state, and -45 fits its tables best, then -50
NUDGE = 1e-16  # m, rad: differences between the starts of the group "start", the rounding of a coordinate
DENSE = {"SVD": SVD(), "Varga": Varga(), "Greville": Greville(), "Householder": Householder(), "GramSchmidt": GramSchmidt()}

Tell = Callable[[str, float], None]  # the current work, and the part of all work that is done


def study(
    scope: Scope = FULL, start: float = START, seed: int = 0, solver: str = "Adams", tell: Tell = lambda what, part: None
) -> Any:
    """Run the study and return it as an xarray Dataset: one entry a run, its verdict, its counts, and its history.

    The linkage is released from rest with its links at `start` (degrees); `solver` is the integrator of the paper's runs; `seed`
    chooses the starts that differ by rounding.
    """
    begun = time.perf_counter()
    mech = parallelogram(np.radians(start))
    state = assemble(mech)
    cases = plan(scope, solver)
    waiting = sum(program.seconds for program in {case.program for case in cases}) / thread_count()
    total = waiting + sum(case.seconds for case in cases)
    programs = _compiled(mech, state, cases, scope.max_steps, lambda what, part: tell(what, part * waiting / total))
    compiled = time.perf_counter() - begun

    sigma = np.linalg.svd(np.asarray(_matrices(mech, *(jnp.asarray(x)[None] for x in (0.0, state.q, state.v)))[0][0]))[1][0]
    done, rows = waiting, []
    for number, case in enumerate(cases):
        tell(f"run {number + 1} of {len(cases)}", done / total)
        inputs = _inputs(case, state, sigma, seed)
        sol, seconds = _timed(partial(programs[case.program], *inputs), scope.repeats if case.timed else 1, scope.patience)
        rows.append(_row(mech, case, inputs, sol, seconds))
        done += case.seconds
    tell("done", 1.0)
    times = {"seconds": time.perf_counter() - begun, "seconds_compiling": compiled}
    settings = {
        "scope": scope.name,
        "max_steps": scope.max_steps,
        "start": start,
        "seed": seed,
        "solver": solver,
        "instants": INSTANTS,
    }
    return dataset(mech, state, cases, rows, settings, times)


def _compiled(mech: Mechanism, state: State, cases: list[Case], max_steps: int, tell: Tell) -> dict[Program, Callable]:
    """Compile all programs, on one thread per core: XLA does it without Python's lock."""
    numbers = (jnp.linspace(0.0, 1.0, INSTANTS), state, *(jnp.asarray(x) for x in (1e-6, 1e-6, 0.0, 0.0, 0.0)))

    def build(program: Program) -> Callable:
        if program.solver == vode.NAME:
            return partial(vode.run, mech, partial(pseudoinverse, program.method), FIRST_STEP, max_steps)
        return jax.jit(partial(_run, mech, program, max_steps)).lower(*numbers).compile()

    programs = sorted({case.program for case in cases})
    done, total = 0.0, sum(program.seconds for program in programs)
    with ThreadPoolExecutor(thread_count()) as pool:
        made = {pool.submit(build, program): program for program in programs}
        for number, future in enumerate(as_completed(made), 1):
            done += made[future].seconds
            tell(f"compiled {number} of {len(programs)}", done / total)
    return {program: future.result() for future, program in made.items()}


def _run(mech: Mechanism, program: Program, max_steps: int, ts, state, tol, rank_tol, number, alpha, beta) -> Any:
    return simulate(
        mech,
        ts,
        state,
        rtol=tol,
        atol=tol,
        method=pseudoinverse(program.method, rank_tol, number),
        stabilization=Projection() if program.projected else Baumgarte(alpha, beta),
        solver=solver_named(program.solver),
        dt0=None if program.projected else FIRST_STEP,
        drift_tol=np.inf,  # a run continues, however open the loops
        max_steps=max_steps,
        throw=False,
    )


def pseudoinverse(name: str, rank_tol: Any, number: Any) -> Pseudoinverse:
    """Return the paper's methods with their threshold in the units of D; the others have their own default."""
    if name in DENSE:
        return OneOf.absolute(rank_tol, methods=tuple(DENSE.values()), number=number)
    return {"Auto": Auto, "Elimination": Elimination}[name]()


def _inputs(case: Case, state: State, sigma: float, seed: int) -> tuple:
    """Return the arguments of a program. `sigma` is the largest singular value of D at the start."""
    if case.start:
        nudge = np.random.default_rng((seed, case.start)).normal(scale=NUDGE, size=state.q.shape)
        state = State(state.q + nudge, state.v)
    rank_tol = RANK_HELD * sigma if case.rank_tol is None else case.rank_tol
    numbers = (jnp.asarray(x, float) for x in (case.tol, rank_tol, number_of(case.method), case.alpha, case.beta))
    return (jnp.linspace(0.0, case.end, INSTANTS), state, *numbers)


def number_of(method: str) -> int:
    """Return the number of one of the paper's methods; zero for others, whose programs do not need it."""
    return list(DENSE).index(method) if method in DENSE else 0


def _timed(run: Callable, repeats: int, patience: float) -> tuple[Any, list[float]]:
    """Return a solution, and the wall time (s) of each repeat of the run; no further repeat after `patience` (s)."""
    seconds: list[float] = []
    sol: Any = None
    while len(seconds) < repeats and sum(seconds) <= patience:
        begun = time.perf_counter()
        sol = jax.block_until_ready(run())
        seconds.append(time.perf_counter() - begun)
    return sol, seconds


def _row(mech: Mechanism, case: Case, inputs: tuple, sol: Any, seconds: list[float]) -> dict[str, Any]:
    """Return the record of one run."""
    ts, state, _, rank_tol, *_ = inputs
    D, psi, psi_dot = (np.asarray(x) for x in _matrices(mech, ts, sol.q, sol.v))
    q, alive = np.asarray(sol.q), np.isfinite(np.asarray(sol.q)).all((1, 2))
    sigma, rank = np.full((len(ts), min(D.shape[1:])), np.nan), np.full(len(ts), np.nan)
    sigma[alive] = np.linalg.svd(D[alive], compute_uv=False)
    if case.method in DENSE:
        rank = np.where(alive, np.asarray(_ranks(pseudoinverse(case.method, rank_tol, number_of(case.method)), D)), np.nan)
    exact = exact_coordinates(mech, ts, state.q, state.v)
    assert exact is not None
    total = np.asarray(energy(mech, sol).total)
    return {
        "time": np.asarray(ts),
        "angle": q[:, 0, 2],
        "angle_error": np.abs(q - exact)[..., 2].max(1),
        "position_error": np.abs(q - exact)[..., :2].max((1, 2)),
        "psi2": (psi**2).sum(1),
        "psi_dot2": (psi_dot**2).sum(1),
        "energy": total - total[0],
        "sigma_11": sigma[:, -2],
        "sigma_12": sigma[:, -1],
        "sigma_1": sigma[:, 0],
        "rank": rank,
        "rank_tol": float(rank_tol) if case.method in DENSE else np.nan,
        "end": float(sol.time),
        "result": Result(int(sol.code)).name,
        "cpu": np.nan if case.solver == vode.NAME else float(np.median(seconds)),
        "repeats": len(seconds),
        **{key: int(value) for key, value in sol.stats.items()},
    }


@eqx.filter_jit
def _matrices(mech: Mechanism, ts, q, v) -> tuple:
    """Return D, Psi and Psi_dot of all rows at each time."""
    equations: Any = prepare(mech, SVD())

    def one(t, q, v):
        return equations.linearized_position(t, q)[0].matrix, *equations.violation(t, q, v)

    return jax.vmap(one)(ts, q.reshape(len(q), -1), v.reshape(len(v), -1))


@eqx.filter_jit
def _ranks(method: Pseudoinverse, D) -> Any:
    return jax.vmap(method.rank)(D)
