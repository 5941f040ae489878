"""Machine code for problems: which ones it serves, and how their numbers go in and come out (native/)."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.equations.elements import has_pieces
from udkjax.equations.loop_programs import LoopPrograms, loop_programs
from udkjax.equations.scales import Scales
from udkjax.equations.scene_programs import EliminationPrograms, elimination_programs, scene_programs
from udkjax.equations.structure import is_large
from udkjax.equations.textbook import TextbookEquations
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.integrate.solvers import is_explicit, method_of
from udkjax.native.layout import INFO, INPUTS, OUTPUTS, SETTINGS
from udkjax.native.operation import Kind, Tableau, generate, machine_code, native_p, shapes_of
from udkjax.native.program import UnsupportedError
from udkjax.native.steps import DONE, FALLBACK_RANK_SHARE
from udkjax.native.tableau import EULER
from udkjax.pinv import Auto, Elimination
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.scene.mechanism import Mechanism

# --- closing


def closes(mechanism: Mechanism) -> bool:
    """Whether machine code can close a mechanism."""
    if jax.default_backend() != "cpu" or not jax.config.jax_enable_x64:
        return False
    try:
        generate(_closing(mechanism), 1)
    except UnsupportedError:
        return False
    return True


def closed(mechanism: Mechanism, scales: Scales, tol: Any, t: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any, Any]:
    """q closed, v as the constraints allow it, what is left of Psi and Psi_dot, and the rank of D, from a guess at time t."""
    return _parts(native_p.bind(*_guess(mechanism, scales, tol, t, q, v), kind=_closing(mechanism), times=2), len(q))


def closed_at_once(mechanism: Mechanism, scales: Scales, tol: Any, t: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any, Any]:
    """As `closed`, of known numbers, without tracing anything."""
    kind, inputs = _closing(mechanism), _guess(mechanism, scales, tol, t, q, v, np)
    return _parts(machine_code(kind, 1)(inputs, shapes_of(inputs, kind, 2)), len(q))


def _parts(found: Sequence[Any], n: int) -> tuple[Any, Any, Any, Any, Any]:
    state, residuals, rank = (x[0] for x in found)
    m = len(residuals) // 2
    return state[:n], state[n:], residuals[:m], residuals[m:], rank[0].astype(int)


def closed_along(guess: Any, moving: Any, change: Any) -> tuple[Array, Array]:
    """The changes of q and v along a `change` of what is moving of (mechanism, scales, tol, t, q, v)."""
    (mechanism, *_, q, _), (*_, dq, dv) = guess, change
    n, kind = len(q), _closing(mechanism, _moving_of_closing(mechanism, moving[0]), "closing forward")
    numbers = _vector(_moved(mechanism, moving[0], change[0], kind.active or ()), jnp)
    along = [numbers, *(jnp.zeros(n) if dx is None else dx for dx in (dq, dv))]
    dstate = native_p.bind(*_guess(*guess), *(x[None, None] for x in along), kind=kind, times=2)[-1][0, 0]
    return dstate[:n], dstate[n:]


def closed_back(guess: Any, moving: Any, qbar: Array, vbar: Array) -> Any:
    """The cotangents of what is moving, from those of q and v."""
    mechanism = guess[0]
    kind = _closing(mechanism, _moving_of_closing(mechanism, moving[0]), "closing reverse")
    bars = jnp.concatenate([qbar, vbar])[None]
    numbers, *states = (x[0] for x in native_p.bind(*_guess(*guess), bars, kind=kind, times=2)[-3:])
    found = _taken_apart(numbers, mechanism, moving[0], kind.active or ())
    return found, *(x if m is True else None for x, m in zip(states, moving[-2:], strict=True))


def _moving_of_closing(mechanism: Mechanism, moving: Any) -> tuple[bool, ...]:
    """Of the numbers of closing: which have derivatives. Loops do not tell them apart."""
    numbers = _numbers_moving(mechanism, moving)
    return (True,) * len(numbers) if is_large(mechanism) else numbers


def _numbers_moving(numbers: Any, moving: Any) -> tuple[bool, ...]:
    """Of the numbers of a tree and two thresholds: which are marked in `moving`."""
    leaves = zip(*(_leaves(tree) for tree in (numbers, moving)), strict=True)
    return (*(m is True for x, m in leaves if x is not None for _ in range(np.size(x))), False, False)


def _moved(numbers: Any, moving: Any, change: Any, wanted: Sequence[bool]) -> list[Any]:
    """The changes of the numbers that are `wanted`, in order: zeros of those that do not move."""
    found, place = [], 0
    for x, m, dx in zip(*(_leaves(tree) for tree in (numbers, moving, change)), strict=True):
        if x is not None:
            if m is True:
                found.append(dx)
            elif wanted[place]:
                found.append(jnp.zeros(np.shape(x)))
            place += np.size(x)
    return [*found, jnp.zeros(sum(wanted[place:]))]


def _taken_apart(bars: Any, numbers: Any, moving: Any, wanted: Sequence[bool]) -> Any:
    """The tree of the cotangents of what is moving, from those of the numbers that are `wanted`, in order."""
    leaves, tree = jax.tree.flatten(numbers, is_leaf=lambda x: x is None)
    parts, place, found = [], 0, 0
    for x, m in zip(leaves, _leaves(moving), strict=True):
        size = 0 if x is None else np.size(x)
        count = sum(wanted[place : place + size])
        parts.append(bars[found : found + count].reshape(np.shape(x)) if m is True else None)
        place, found = place + size, found + count
    return jax.tree.unflatten(tree, parts)


def _leaves(tree: Any) -> list[Any]:
    return jax.tree.leaves(tree, is_leaf=lambda x: x is None)


def _guess(mechanism: Mechanism, scales: Scales, tol: Any, t: Any, q: Any, v: Any, xp: Any = jnp) -> list[Any]:
    settings = {"length": scales.length, "fallback_tol": tol, "rtol": 1.0, "atol": 1.0, "smallest": 1.0, "omega": 1.0}
    given = {
        "numbers": _vector([*jax.tree.leaves(mechanism), tol**2 if is_large(mechanism) else 0.0, 0.0], xp),
        "ts": _vector([t, t], xp),
        "q": q,
        "v": v,
        "settings": _vector([settings.get(name, 0.0) for name in SETTINGS], xp),
        "rows": scales.rows,
        "breaks": xp.zeros(0),
    }
    arrays = [xp.asarray(given[name], float)[None] for name in INPUTS]
    return arrays if xp is np else stop_gradients(arrays)


def _closing(mechanism: Mechanism, moving: tuple[bool, ...] | None = None, mode: str = "closing") -> Kind:
    programs = loop_programs(mechanism) if is_large(mechanism) else scene_programs(mechanism)
    return Kind(programs, Tableau(EULER), projected=False, breaks=False, active=moving, mode=mode)


# --- problems


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
    if is_large(equations.mechanism) and _has_pieces(equations.mechanism):
        return "an element of a large scene is smooth in pieces of the state"
    if jax.default_backend() != "cpu":
        return f"it is for the CPU, and JAX runs on {jax.default_backend()}"
    if not jax.config.jax_enable_x64:
        return "it computes in float64, which JAX is told not to"
    try:
        generate(_kind(problem), 1)
    except UnsupportedError as error:
        return f"the scene takes {error}, which is no arithmetic on numbers"
    return ""


def known(problem: Problem) -> IntegratorOutput:
    """Integrate a problem whose numbers are all known, without tracing anything: `IntegratorOutput` of NumPy's arrays."""
    kind, inputs = _kind(problem), _inputs(problem, xp=np)
    return _raw(machine_code(kind, 1)(inputs, shapes_of(inputs, kind, len(problem.ts))))


def solve(problem: Problem) -> IntegratorOutput:
    """Integrate one problem; under vmap, as many as there are, in lanes."""
    return _raw(native_p.bind(*_inputs(problem), kind=_kind(problem), times=len(problem.ts)))


def recorded(problem: Any, moving: Any) -> IntegratorOutput:
    """Integrate a problem by the code that `vjp` takes: no other is compiled."""
    kind, n, times = _kind(problem, _moving(problem, moving), "reverse"), len(problem.q), len(problem.ts)
    none = jnp.zeros((0, times, 2 * n)), jnp.zeros((0, 2 * n))
    return _raw(native_p.bind(*_inputs(problem, kind.code), *none, kind=kind, times=times)[: len(OUTPUTS)])


def independent_row_count(problem: Any) -> int:
    """How many rows elimination takes."""
    equations = problem.equations
    return len(equations.scales.rows) - len(equations.redundant or ())


def serves_derivatives(moving: Any) -> bool:
    """Whether there is machine code for the derivatives along what is `moving`: numbers of the scene, and initial states."""
    served = lambda p: (p.equations.mechanism, p.equations.baumgarte, p.q, p.v)  # noqa: E731
    others = eqx.tree_at(served, moving, (None,) * 4, is_leaf=lambda x: x is None)
    return not any(x is True for x in jax.tree.leaves(others))


def _numbers_of(problem: Any) -> Any:
    return problem.equations.mechanism, problem.equations.baumgarte


def _gains(baumgarte: Any) -> list[Any]:
    return [] if baumgarte is None else [baumgarte.alpha, baumgarte.beta]


def jvp(problem: Any, moving: Any, change: Any) -> tuple[IntegratorOutput, tuple[Array, Array, Array]]:
    """Integrate a problem, with the changes of positions, velocities and the end along a `change` of what is moving."""
    kind, n = _kind(problem, _moving(problem, moving), "forward"), len(problem.q)
    along = _vector(_moved(_numbers_of(problem), _numbers_of(moving), _numbers_of(change), kind.active or ()), jnp)
    dq, dv = (jnp.zeros(n) if dx is None else dx for dx in (change.q, change.v))
    *found, dys, dend = native_p.bind(
        *_inputs(problem, kind.code), *(x[None, None] for x in (along, dq, dv)), kind=kind, times=len(problem.ts)
    )
    return _raw(found), (dys[0, 0, :, :n], dys[0, 0, :, n:], dend[0, 0])


def vjp(problem: Any, moving: Any, ys: Array, end: Array) -> Problem:
    """The cotangents of what is `moving`, from those of the states at the output times (T, 2n) and of the end (2n,)."""
    kind = _kind(problem, _moving(problem, moving), "reverse")
    bars = [ys[None], end[None]]
    numbersbar, qbar, vbar = native_p.bind(*_inputs(problem, kind.code), *bars, kind=kind, times=len(problem.ts))[len(OUTPUTS) :]
    none = jax.tree.map(lambda m: None, moving, is_leaf=lambda x: x is None)
    numbers = _taken_apart(numbersbar[0], _numbers_of(problem), _numbers_of(moving), kind.active or ())
    q, v = qbar[0] if moving.q is True else None, vbar[0] if moving.v is True else None
    return eqx.tree_at(lambda p: (*_numbers_of(p), p.q, p.v), none, (*numbers, q, v), is_leaf=lambda x: x is None)


def _moving(problem: Any, moving: Any) -> tuple[bool, ...]:
    """Of the numbers of a run: which have derivatives. Loops do not tell them apart."""
    numbers = _numbers_moving(_numbers_of(problem), _numbers_of(moving))
    return (any(numbers),) * len(numbers) if is_large(problem.equations.mechanism) else numbers


def _programs(problem: Problem) -> EliminationPrograms | LoopPrograms:
    """The programs of a problem's scene: with pivots that are refused, where the method falls back on a rank-revealing one."""
    equations: Any = problem.equations
    mechanism, rows, baumgarte = equations.mechanism, equations.redundant or (), equations.baumgarte is not None
    drops = isinstance(equations.method, Elimination)
    if is_large(mechanism):
        return loop_programs(mechanism, rows, baumgarte, RankPolicy.DROP if drops else RankPolicy.FALL_BACK)
    return elimination_programs(mechanism, rows, baumgarte, RankPolicy.DROP if drops else RankPolicy.REFUSE)


def _kind(problem: Any, moving: tuple[bool, ...] | None = None, mode: str = "run") -> Kind:
    programs, mechanism = _programs(problem), problem.equations.mechanism
    breaks = problem.breakpoints is not None or _has_pieces(mechanism)
    method = Tableau(method_of(problem.solver))
    return Kind(programs if moving is None else programs.for_derivatives, method, problem.projected, breaks, moving, mode)


def _has_pieces(mechanism: Mechanism) -> bool:
    return any(has_pieces(e) for e in (*mechanism.constraints.values(), *mechanism.forces.values()))


def _inputs(problem: Any, code: Any = None, xp: Any = jnp) -> list[Any]:
    """Those of a run, of one member."""
    equations: TextbookEquations = problem.equations
    method: Any = equations.method
    rank_tol = method.rank_tol
    safe_tol = method.branch_tol if isinstance(method, Auto) else rank_tol**2
    programs = _programs(problem) if code is None else code
    drop_tol = (FALLBACK_RANK_SHARE * rank_tol) ** 2 if programs.policy is RankPolicy.FALL_BACK else safe_tol
    first = 0.0 if problem.h is None else problem.h
    fallback_tol = FALLBACK_RANK_SHARE * rank_tol
    settings = [
        problem.rtol,
        problem.atol,
        problem.smallest,
        first,
        problem.length,
        problem.rate,
        fallback_tol,
        problem.max_steps,
    ]
    given = {
        "numbers": _vector([*jax.tree.leaves(equations.mechanism), *_gains(equations.baumgarte), drop_tol, safe_tol], xp),
        "ts": problem.ts,
        "q": problem.q,
        "v": problem.v,
        "settings": _vector(settings, xp),
        "rows": equations.scales.rows,
        "breaks": xp.zeros(0) if problem.breakpoints is None else problem.breakpoints,
    }
    arrays = [xp.asarray(given[name], float)[None] for name in INPUTS]
    return arrays if xp is np else stop_gradients(arrays)


def _vector(parts: Sequence[Any], xp: Any) -> Any:
    return xp.concatenate([xp.zeros(0), *(xp.ravel(xp.asarray(x, float)) for x in parts)])


def _raw(found: Sequence[Any]) -> IntegratorOutput:
    q, v, violation, info = (x[0] for x in found)
    code, t, tried, accepted, evaluations, written = (info[k] for k in range(len(INFO)))
    number = np.arange(len(q))
    reached = (number <= written) & (number < len(q) - 1) | (code == DONE)
    counts = (x.astype(int) for x in (tried, accepted, evaluations))
    return IntegratorOutput(q, v, violation, reached, code.astype(int), t, info[len(INFO) :], *counts)
