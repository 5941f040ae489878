"""Machine code for problems: which ones it serves, and how their numbers go in and come out (native/)."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.equations.code import Code, code, is_large, structure
from udkjax.equations.large_code import LargeCode, large_code
from udkjax.equations.programs import WITH_CARE, Equations
from udkjax.equations.scales import Scales
from udkjax.integrate.problem import Problem, Raw
from udkjax.integrate.tableau import is_explicit, method_of
from udkjax.integrate.undifferentiated import undifferentiated
from udkjax.native.operation import Kind, Tableau, compiled, native_p, shapes_of, written
from udkjax.native.program import UnsupportedError
from udkjax.native.steps import DONE
from udkjax.native.tableau import EULER
from udkjax.native.trajectory import INFO, INPUTS, OUTPUTS, SETTINGS
from udkjax.pinv import Auto
from udkjax.scene.mechanism import Mechanism

# --- closing


def closes(mechanism: Mechanism) -> bool:
    """Whether machine code can close a mechanism."""
    if jax.default_backend() != "cpu" or not jax.config.jax_enable_x64:
        return False
    try:
        written(_closing(mechanism), 1)
    except UnsupportedError:
        return False
    return True


def closed(mechanism: Mechanism, scales: Scales, tol: Any, t: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any, Any]:
    """q closed, v as the constraints allow it, what is left of Psi and Psi_dot, and the rank of D, from a guess at time t."""
    return _parts(native_p.bind(*_guess(mechanism, scales, tol, t, q, v), kind=_closing(mechanism), times=2), len(q))


def closed_at_once(mechanism: Mechanism, scales: Scales, tol: Any, t: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any, Any]:
    """As `closed`, of known numbers, without tracing anything."""
    kind, inputs = _closing(mechanism), _guess(mechanism, scales, tol, t, q, v, np)
    return _parts(compiled(kind, 1)(inputs, shapes_of(inputs, kind, 2)), len(q))


def _parts(found: Sequence[Any], n: int) -> tuple[Any, Any, Any, Any, Any]:
    state, residuals, rank = (x[0] for x in found)
    m = len(residuals) // 2
    return state[:n], state[n:], residuals[:m], residuals[m:], rank[0].astype(int)


def closed_along(guess: Any, moving: Any, change: Any) -> tuple[Array, Array]:
    """The changes of q and v along a `change` of what is moving of (mechanism, scales, tol, t, q, v)."""
    (mechanism, *_, q, _), (*_, dq, dv) = guess, change
    n, kind = len(q), _closing(guess[0], _numbers_moving(mechanism, moving[0]), "closing forward")
    numbers = _vector(_moved(mechanism, moving[0], change[0]), jnp)
    along = [numbers, *(jnp.zeros(n) if dx is None else dx for dx in (dq, dv))]
    dstate = native_p.bind(*_guess(*guess), *(x[None, None] for x in along), kind=kind, times=2)[-1][0, 0]
    return dstate[:n], dstate[n:]


def closed_back(guess: Any, moving: Any, qbar: Array, vbar: Array) -> Any:
    """The cotangents of what is moving, from those of q and v."""
    mechanism, n = guess[0], len(qbar)
    kind = _closing(mechanism, _numbers_moving(mechanism, moving[0]), "closing reverse")
    bars = jnp.concatenate([qbar, vbar])[None]
    numbers, *states = (x[0] for x in native_p.bind(*_guess(*guess), bars, kind=kind, times=2)[-3:])
    found, parts = 0, []
    leaves, tree = jax.tree.flatten(mechanism, is_leaf=lambda x: x is None)
    for x, m in zip(leaves, jax.tree.leaves(moving[0], is_leaf=lambda x: x is None), strict=True):
        size = 0 if x is None or (m is not True and not is_large(mechanism)) else np.size(x)
        parts.append(numbers[found : found + size].reshape(np.shape(x)) if m is True else None)
        found += size
    assert len(states[0]) == n
    return jax.tree.unflatten(tree, parts), *(x if m is True else None for x, m in zip(states, moving[-2:], strict=True))


def _moved(mechanism: Mechanism, moving: Any, change: Any) -> list[Any]:
    """The changes of the numbers that `_numbers_moving` marks, in order."""
    trees = (jax.tree.leaves(tree, is_leaf=lambda x: x is None) for tree in (mechanism, moving, change))
    leaves = [(x, m is True, dx) for x, m, dx in zip(*trees, strict=True) if x is not None]
    if is_large(mechanism):
        return [*(dx if m else jnp.zeros(np.shape(x)) for x, m, dx in leaves), jnp.zeros(2)]
    return [dx for _, m, dx in leaves if m]


def _numbers_moving(mechanism: Mechanism, moving: Any) -> tuple[bool, ...]:
    """Of the numbers of a scene and two thresholds: which have derivatives. Loops do not tell them apart."""
    if is_large(mechanism):
        return (True,) * (sum(np.size(x) for x in jax.tree.leaves(mechanism)) + 2)
    leaves = zip(*(jax.tree.leaves(tree, is_leaf=lambda x: x is None) for tree in (mechanism, moving)), strict=True)
    return (*(m is True for x, m in leaves if x is not None for _ in range(np.size(x))), False, False)


def _guess(mechanism: Mechanism, scales: Scales, tol: Any, t: Any, q: Any, v: Any, xp: Any = jnp) -> list[Any]:
    settings = {"length": scales.length, "care": tol, "rtol": 1.0, "atol": 1.0, "smallest": 1.0, "omega": 1.0}
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
    return arrays if xp is np else undifferentiated(arrays)


def _closing(mechanism: Mechanism, moving: tuple[bool, ...] | None = None, mode: str = "closing") -> Kind:
    large = is_large(mechanism)
    programs = large_code(*structure(mechanism), (), False, "drop") if large else code(mechanism, (), False, None)
    return Kind(programs, Tableau(EULER), projected=False, breaks=False, moving=moving, mode=mode)


# --- problems


def unserved(problem: Problem, adjoint: Any = None, meter: Any = None) -> str:
    """Why machine code cannot integrate a problem; empty where it can."""
    equations = problem.equations
    if adjoint is not None:
        return f"{type(adjoint).__name__} is an adjoint of diffrax"
    if meter is not None:
        return "a progress meter is diffrax's"
    if problem.length is None or not (type(equations) is Equations or getattr(equations, "by_levels", False)):
        return f"it knows the Udwadia-Kalaba equation of a mechanism by elimination, not {type(equations).__name__}"
    if not is_explicit(problem.solver):
        return f"{type(problem.solver).__name__} is no explicit Runge-Kutta method"
    if problem.pieces is not None and isinstance(getattr(equations, "code", None), LargeCode):
        return "an element of a large scene is smooth in pieces of the state"
    if jax.default_backend() != "cpu":
        return f"it is for the CPU, and JAX runs on {jax.default_backend()}"
    if not jax.config.jax_enable_x64:
        return "it computes in float64, which JAX is told not to"
    try:
        written(_kind(problem), 1)
    except UnsupportedError as error:
        return f"the scene takes {error}, which is no arithmetic on numbers"
    return ""


def serves(problem: Problem) -> bool:
    """Whether machine code can integrate a problem: one of scalar expressions, by an explicit Runge-Kutta method, on the CPU."""
    return not unserved(problem)


def known(problem: Problem) -> Raw:
    """Integrate a problem whose numbers are all known, without tracing anything: `Raw` of NumPy's arrays."""
    kind, inputs = _kind(problem), _inputs(problem, xp=np)
    return _raw(compiled(kind, 1)(inputs, shapes_of(inputs, kind, len(problem.ts))))


def solve(problem: Problem) -> Raw:
    """Integrate one problem; under vmap, as many as there are, in lanes."""
    return _raw(native_p.bind(*_inputs(problem), kind=_kind(problem), times=len(problem.ts)))


def recorded(problem: Any, moving: Any) -> Raw:
    """Integrate a problem by the code that `pulled` takes: no other is compiled."""
    kind, n, times = _kind(problem, _moving(problem, moving), "reverse"), len(problem.q), len(problem.ts)
    none = jnp.zeros((0, times, 2 * n)), jnp.zeros((0, 2 * n))
    return _raw(native_p.bind(*_inputs(problem, kind.code), *none, kind=kind, times=times)[: len(OUTPUTS)])


def serves_derivatives(problem: Problem, moving: Any) -> bool:
    """Whether there is machine code for the derivatives along what is `moving`: numbers of the scene, and initial states."""
    if not serves(problem):
        return False
    given = eqx.tree_at(lambda p: (p.equations, p.pieces), moving, (None, None), is_leaf=lambda x: x is None)
    others = eqx.tree_at(lambda p: (p.q, p.v), given, (False, False), is_leaf=lambda x: x is None)
    return not any(x is True for x in jax.tree.leaves((others, _fixed(moving.equations))))


def _fixed(equations: Any) -> Any:
    """What equations hold besides what follows from the numbers of the scene."""
    numbers = _of_numbers if hasattr(equations, "numbers") else _of_constants
    return eqx.tree_at(numbers, equations, (None,) * len(numbers(equations)), is_leaf=lambda x: x is None)


def _of_constants(equations: Any) -> tuple[Any, ...]:
    return equations.constants, equations.textbook.mechanism, equations.textbook.baumgarte


def _of_numbers(equations: Any) -> tuple[Any, ...]:
    return equations.constants, equations.numbers, equations.given, equations.baumgarte


def pushed(problem: Any, moving: Any, change: Any) -> tuple[Raw, tuple[Array, Array, Array]]:
    """Integrate a problem, with the changes of positions, velocities and the end along a `change` of what is moving."""
    kind = _kind(problem, _moving(problem, moving), "forward")
    if isinstance(problem.equations.code, LargeCode):
        constants = change.equations.constants if moving.equations.constants is True else jnp.zeros(0)
    else:
        pairs = zip(change.equations.constants, moving.equations.constants, strict=True)
        constants = _vector([jnp.zeros(0), *(dx for dx, m in pairs if m is True)], jnp)
    n = len(problem.q)
    dq, dv = (jnp.zeros(n) if dx is None else dx for dx in (change.q, change.v))
    *found, dys, dend = native_p.bind(
        *_inputs(problem, kind.code), *(x[None, None] for x in (constants, dq, dv)), kind=kind, times=len(problem.ts)
    )
    return _raw(found), (dys[0, 0, :, :n], dys[0, 0, :, n:], dend[0, 0])


def pulled(problem: Any, moving: Any, ys: Array, end: Array) -> Problem:
    """The cotangents of what is `moving`, from those of the states at the output times (T, 2n) and of the end (2n,)."""
    kind = _kind(problem, _moving(problem, moving), "reverse")
    bars = [ys[None], end[None]]
    cbar, qbar, vbar = native_p.bind(*_inputs(problem, kind.code), *bars, kind=kind, times=len(problem.ts))[len(OUTPUTS) :]
    if isinstance(problem.equations.code, LargeCode):
        constants: Any = cbar[0] if moving.equations.constants is True else None
    else:
        found = iter(cbar[0])
        assert kind.moving is not None
        by_node = {s.index: next(found) for s, m in zip(kind.code.constants, kind.moving, strict=True) if m}
        pairs = zip(problem.equations.code.constants, moving.equations.constants, strict=True)
        constants = [by_node[s.index] if m is True else None for s, m in pairs]
    none = jax.tree.map(lambda m: None, moving, is_leaf=lambda x: x is None)

    def zeros(moving: Any, values: Any) -> Any:
        return jax.tree.map(lambda m, x: jnp.zeros_like(x) if m is True else None, moving, values, is_leaf=lambda x: x is None)

    equations = zeros(moving.equations, problem.equations)
    equations = eqx.tree_at(lambda e: e.constants, equations, constants, is_leaf=lambda x: x is None)
    pieces = zeros(moving.pieces, problem.pieces)  # where they meet, motions are smooth enough not to depend on when that is
    return eqx.tree_at(
        lambda p: (p.equations, p.pieces, p.q, p.v),
        none,
        (equations, pieces, qbar[0] if moving.q is True else None, vbar[0] if moving.v is True else None),
        is_leaf=lambda x: x is None,
    )


def _moving(problem: Any, moving: Any) -> tuple[bool, ...]:
    """Of the constants of the code that watches: which have derivatives."""
    code = problem.equations.code
    if isinstance(problem.equations.code, LargeCode):  # all or none
        return (moving.equations.constants is True,) * len(code.constants)
    moves = {s.index for s, m in zip(code.constants, moving.equations.constants, strict=True) if m is True}
    return tuple(s.index in moves for s in _watching(code).constants)


def _watching(code: Code) -> Code:
    """The code of derivatives: it leaves out what depends on other rows, where a step is taken with care."""
    return code.watching


def _kind(problem: Any, moving: tuple[bool, ...] | None = None, mode: str = "run") -> Kind:
    code = problem.equations.code
    method, breaks = Tableau(method_of(problem.solver)), problem.breakpoints is not None or problem.pieces is not None
    return Kind(code if moving is None else _watching(code), method, problem.projected, breaks, moving, mode)


def _inputs(problem: Any, code: Code | None = None, xp: Any = jnp) -> list[Any]:
    """Those of a run, of one member."""
    equations = problem.equations
    large = isinstance(equations.code, LargeCode)
    textbook: Any = equations if large else equations.textbook
    method, rank_tol, baumgarte = textbook.method, textbook.method.rank_tol, textbook.baumgarte
    gains = [] if baumgarte is None else [baumgarte.alpha, baumgarte.beta]
    least = method.branch_tol if isinstance(method, Auto) else rank_tol**2
    drop = (WITH_CARE * rank_tol) ** 2 if (code or equations.code).elimination == "watch" else least
    numbers = [textbook.given] if large else [*jax.tree.leaves(textbook.mechanism), *gains]
    first = 0.0 if problem.h is None else problem.h
    care = WITH_CARE * rank_tol
    settings = [problem.rtol, problem.atol, problem.smallest, first, problem.length, problem.rate, care, problem.max_steps]
    given = {
        "numbers": _vector([*numbers, drop, least], xp),
        "ts": problem.ts,
        "q": problem.q,
        "v": problem.v,
        "settings": _vector(settings, xp),
        "rows": textbook.scales.rows,
        "breaks": xp.zeros(0) if problem.breakpoints is None else problem.breakpoints,
    }
    arrays = [xp.asarray(given[name], float)[None] for name in INPUTS]
    return arrays if xp is np else undifferentiated(arrays)


def _vector(parts: Sequence[Any], xp: Any) -> Any:
    return xp.concatenate([xp.ravel(xp.asarray(x, float)) for x in parts])


def _raw(found: Sequence[Any]) -> Raw:
    q, v, violation, info = (x[0] for x in found)
    code, t, tried, accepted, evaluations, written = (info[k] for k in range(len(INFO)))
    number = np.arange(len(q))
    reached = (number <= written) & (number < len(q) - 1) | (code == DONE)
    counts = (x.astype(int) for x in (tried, accepted, evaluations))
    return Raw(q, v, violation, reached, code.astype(int), t, info[len(INFO) :], *counts)
