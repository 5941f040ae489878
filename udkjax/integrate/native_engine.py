"""Machine code for problems: which ones it serves, and how their numbers go in and come out (native/)."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.equations.elements import has_pieces
from udkjax.equations.scene_programs import ScenePrograms, scene_programs
from udkjax.equations.structure import numbers_as_vector
from udkjax.equations.textbook import TextbookEquations
from udkjax.integrate.held_rows import SampleRows
from udkjax.integrate.packing import active_numbers, cotangent_tree, number_tangents, pack
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.integrate.solvers import is_explicit, method_of
from udkjax.native.layout import INFO, OUTPUTS
from udkjax.native.operations import Run, RunCotangents, RunTangents, Tableau
from udkjax.native.primitive import call_known, native_p, unsupported
from udkjax.native.record import PER_BREAKPOINT, STORED
from udkjax.native.steps import DONE, FALLBACK_RANK_SHARE
from udkjax.pinv import Auto, Elimination
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.scene.mechanism import Mechanism


def reason_for_diffrax(problem: Problem, adjoint: Any = None, meter: Any = None) -> str:
    """Why machine code cannot integrate a problem; empty where it can."""
    equations = problem.equations
    if adjoint is not None:
        return f"{type(adjoint).__name__} is an adjoint of diffrax"
    if meter is not None:
        return "a progress meter is diffrax's"
    if type(equations) is not TextbookEquations:
        return f"it knows the Udwadia-Kalaba equation of a mechanism, not {type(equations).__name__}"
    if not isinstance(equations.method, Auto | Elimination):
        return f"it eliminates, and {type(equations.method).__name__} was asked for"
    if isinstance(equations.method, Auto) and equations.redundant is None:
        return "which rows are redundant is not known"
    if not is_explicit(problem.solver):
        return f"{type(problem.solver).__name__} is no explicit Runge-Kutta method"
    if jax.default_backend() != "cpu":
        return f"it is for the CPU, and JAX runs on {jax.default_backend()}"
    if not jax.config.jax_enable_x64:
        return "it computes in float64, which JAX is told not to"
    missing = unsupported(_run(problem))
    return f"the scene takes {missing}, which is no arithmetic on numbers" if missing else ""


def packed(problem: Problem) -> tuple[Run, list[np.ndarray]]:
    """Return the operation of a problem whose numbers are all known, and its inputs."""
    operation = _run(problem)
    return operation, _inputs(problem, operation, np)


def integrate_known(problem: Problem) -> IntegratorOutput:
    """Integrate a problem whose numbers are all known, without tracing anything: `IntegratorOutput` of NumPy's arrays."""
    operation, inputs = packed(problem)
    return _output(call_known(operation, inputs, len(problem.ts)))


def integrate(problem: Problem) -> IntegratorOutput:
    """Integrate one problem; under vmap, as many as there are, in lanes."""
    operation = _run(problem)
    return _output(native_p.bind(*_inputs(problem, operation), operation=operation, times=len(problem.ts)))


def integrate_for_vjp(problem: Problem, active: Problem) -> tuple[IntegratorOutput, Array]:
    """Integrate a problem by the code that `vjp` takes: no other is compiled. Return the record that it walks back from, too."""
    operation, n, times = _run(problem, active, reverse=True), len(problem.q), len(problem.ts)
    none = (np.zeros(shape) for shape in ((1, 0), (1, 0, n), (1, 0, n), (0, times, 2 * n), (0, 2 * n)))
    found = native_p.bind(*_inputs(problem, operation), *none, operation=operation, times=times)
    return _output(found[: len(OUTPUTS)]), found[-1][0]


def independent_row_count(problem: Any) -> int:
    """Count the rows that elimination takes."""
    equations = problem.equations
    return len(equations.scales.rows) - len(equations.redundant or ())


def serves_derivatives(active: Problem) -> bool:
    """Return whether there is machine code for derivatives along `active` numbers of the scene and initial states."""
    served = lambda p: (p.equations.mechanism, p.equations.baumgarte, p.q, p.v)  # noqa: E731
    others = eqx.tree_at(served, active, (None,) * 4, is_leaf=lambda x: x is None)
    return not any(x is True for x in jax.tree.leaves(others))


def _numbers_of(problem: Any, change: Any = None) -> tuple[Any, Any]:
    """The numbers of a run, or a change of them; zeros stand for one row of what has samples."""
    of = problem if change is None else change
    return _rows_of(problem).stand_in(of.equations.mechanism), of.equations.baumgarte


def _marks_of(problem: Any, active: Any) -> tuple[Any, Any]:
    """Mark the numbers that are active."""
    return _rows_of(problem).stand_in(active.equations.mechanism, marks=True), active.equations.baumgarte


def _mechanism_of(problem: Any) -> Mechanism:
    return problem.equations.mechanism


def _rows_of(problem: Any) -> SampleRows:
    return SampleRows(problem.equations.mechanism, problem.breakpoints)


def jvp(problem: Problem, active: Problem, change: Problem) -> tuple[IntegratorOutput, tuple[Array, Array, Array]]:
    """Integrate a problem, with the changes of positions, velocities and the end along a `change` of what is active."""
    operation, n = _run(problem, active), len(problem.q)
    tangents = number_tangents(_numbers_of(problem), _marks_of(problem, active), _numbers_of(problem, change))
    along = jnp.asarray(numbers_as_vector(tangents))
    dq, dv = (jnp.zeros(n) if dx is None else dx for dx in (change.q, change.v))
    directions = [along, dq, dv]
    if operation.sampled:
        directions.insert(0, _rows_of(problem).changes(_mechanism_of(change)))
    *found, dys, dend = native_p.bind(
        *_inputs(problem, operation), *(x[None, None] for x in directions), operation=operation, times=len(problem.ts)
    )
    return _output(found), (dys[0, 0, :, :n], dys[0, 0, :, n:], dend[0, 0])


def vjp(problem: Problem, active: Problem, run: tuple[Sequence[Array], Array], ys: Array, end: Array) -> Problem:
    """The cotangents of what is `active`, from those of the states at the output times (T, 2n) and of the end (2n,).

    `run` is what `integrate_for_vjp` has left: q and v (T, n), if there are outputs between the first and the last; the record.
    """
    operation, (states, record) = _run(problem, active, reverse=True), run
    states = states or [np.zeros((len(problem.ts), len(problem.q)))] * 2
    given = [x[None] for x in (record, *states, ys, end)]
    found = native_p.bind(*_inputs(problem, operation), *given, operation=operation, times=len(problem.ts))
    numbersbar, qbar, vbar = found[len(OUTPUTS) : len(OUTPUTS) + 3]
    none = jax.tree.map(lambda m: None, active, is_leaf=lambda x: x is None)
    mechanism, baumgarte = cotangent_tree(numbersbar[0], _numbers_of(problem), _marks_of(problem, active))
    if operation.sampled:
        mechanism = _rows_of(problem).with_cotangents(mechanism, _mechanism_of(active), found[len(OUTPUTS) + 3][0])
    q, v = qbar[0] if active.q is True else None, vbar[0] if active.v is True else None
    places = lambda p: (p.equations.mechanism, p.equations.baumgarte, p.q, p.v)  # noqa: E731
    return eqx.tree_at(places, none, (mechanism, baumgarte, q, v), is_leaf=lambda x: x is None)


def _programs(problem: Problem) -> ScenePrograms:
    """The programs of a problem's scene: with pivots that are refused, where the method falls back on a rank-revealing one."""
    equations: Any = problem.equations
    mechanism, rows, baumgarte = equations.mechanism, equations.redundant or (), equations.baumgarte is not None
    policy = RankPolicy.DROP if isinstance(equations.method, Elimination) else RankPolicy.REFUSE
    return scene_programs(mechanism, rows, baumgarte, policy)


def _run(problem: Any, active: Problem | None = None, reverse: bool = False) -> Run:
    """The operation of a problem: a run, or one with tangents or cotangents of what is active."""
    programs, mechanism, breaks = _programs(problem), problem.equations.mechanism, problem.breakpoints
    settings: dict[str, Any] = {
        "code": programs if active is None else programs.for_derivatives,
        "method": Tableau(method_of(problem.solver)),
        "projected": problem.projected,
        "breaks": breaks is not None or _has_pieces(mechanism),
        "sampled": _rows_of(problem).places(mechanism),
    }
    if active is None:
        return Run(**settings)
    settings["active"] = active_numbers(_numbers_of(problem), _marks_of(problem, active))
    if not reverse:
        return RunTangents(**settings)
    points = problem.points or STORED + PER_BREAKPOINT * (0 if breaks is None else len(breaks))
    return RunCotangents(**settings, points=points)


def _has_pieces(mechanism: Mechanism) -> bool:
    return any(has_pieces(e) for e in (*mechanism.constraints.values(), *mechanism.forces.values()))


def _inputs(problem: Any, operation: Run, xp: ModuleType = jnp) -> list[Any]:
    """Return the arrays that machine code takes, for one member."""
    equations: TextbookEquations = problem.equations
    method: Any = equations.method
    rank_tol = method.rank_tol
    safe_tol: Any = method.branch_tol if isinstance(method, Auto) else rank_tol**2
    fallback_tol = FALLBACK_RANK_SHARE * rank_tol
    drop_tol = fallback_tol**2 if operation.code.policy is RankPolicy.FALL_BACK else safe_tol
    settings = {
        "rtol": problem.rtol,
        "atol": problem.atol,
        "smallest": problem.smallest,
        "first": 0.0 if problem.h is None else problem.h,
        "length": problem.length,
        "omega": problem.rate,
        "fallback_tol": fallback_tol,
        "max_steps": problem.max_steps,
    }
    numbers, samples = [*jax.tree.leaves(_numbers_of(problem)), drop_tol, safe_tol], _rows_of(problem)
    further = [samples.rows(xp)] if samples.samples else []
    breaks, rows = samples.breakpoints(xp), equations.scales.rows
    return pack(operation, numbers, problem.ts, problem.q, problem.v, settings, rows, breaks, xp, further)


def _output(found: Sequence[Any]) -> IntegratorOutput:
    q, v, violation, info = (x[0] for x in found)
    code, t, tried, accepted, evaluations, written = (info[k] for k in range(len(INFO)))
    number = np.arange(len(q))
    reached = (number <= written) & (number < len(q) - 1) | (code == DONE)
    counts = (x.astype(int) for x in (tried, accepted, evaluations))
    return IntegratorOutput(q, v, violation, reached, code.astype(int), t, info[len(INFO) :], *counts)
