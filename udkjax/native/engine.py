"""Trajectories by machine code: what of a problem they serve, and calls of them, from compiled JAX programs and from Python."""

import ctypes
import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from threading import Lock
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array

from udkjax.equations.code import Code
from udkjax.equations.programs import Equations
from udkjax.equations.scales import RANK_TOL
from udkjax.integrate.problem import DONE, Problem, Raw
from udkjax.integrate.tableau import Method, is_explicit, method_of
from udkjax.native import machine
from udkjax.native.ffi import handler
from udkjax.native.program import UnsupportedError
from udkjax.native.tangents import Forward
from udkjax.native.trajectory import INFO, INPUTS, OUTPUTS, Plan, Trajectory
from udkjax.native.walk import Reverse
from udkjax.pinv import Auto

FEW = 2  # members up to which one follows another: eight lanes take as long as two members
# Rows that count as redundant where a step is taken with care, and are not, leave what they hold back in velocities, as large as
# the threshold, and rounding errors are as large as a unit over its square: both are least at the third root of a unit.
CARE_TOL = np.finfo(float).eps ** (1 / 3)


class Kind(NamedTuple):
    """Which trajectory: all that its code depends on but the number of lanes."""

    code: Code
    method: "Tableau"
    projected: bool
    breaks: bool
    moving: tuple[bool, ...] | None = None  # of a run with derivatives: of which constants
    mode: str = "run"  # or "forward", or "reverse"


class Tableau:
    """A method, to be looked up by its numbers."""

    def __init__(self, method: Method):
        self.method = method
        self._key = tuple(np.asarray(x).tobytes() for x in method)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tableau) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


class Compiled:
    """The machine code of one kind of trajectory, in so many lanes."""

    def __init__(self, kind: Kind, width: int):
        plan = Plan(kind.code, kind.method.method, kind.projected, kind.breaks, width, machine.lanes())
        self.trajectory = trajectory = MODES[kind.mode](plan, kind.moving) if kind.moving is not None else Trajectory(plan)  # pyright: ignore
        main = handler(trajectory, "call_frame")
        text = "\n".join([trajectory.text(), *sorted(main.declared), main.text()])
        self.name, self._run = loaded(text)

    def __call__(self, inputs: Sequence[np.ndarray], shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
        """Outputs of these shapes, on as many threads as there are cores."""
        names, fields = self.trajectory, {}
        inputs = [np.ascontiguousarray(x, np.float64) for x in inputs]
        found = [np.full(shape, np.nan) for shape in shapes]
        for name, x in zip((*INPUTS, *names.inputs), inputs, strict=True):
            fields[name] = x.ctypes.data
            fields[f"{name} stride"] = math.prod(x.shape[1:]) if len(x) > 1 else 0
        fields |= {name: x.ctypes.data for name, x in zip((*OUTPUTS, *names.outputs), found, strict=True)}
        members, times = shapes[0][:2]
        following = ctypes.c_int64(0)
        fields |= {"members": members, "times": times, "knots": inputs[INPUTS.index("breaks")].shape[1]}
        fields |= {"directions": inputs[-1].shape[1] if names.along_directions else 0, "next": ctypes.addressof(following)}
        call = (ctypes.c_int64 * len(names.call))(*(fields[name] for name in names.call))
        threads = min(os.cpu_count() or 1, members)
        if threads == 1:
            self._run(ctypes.addressof(call))
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(lambda _: self._run(ctypes.addressof(call)), range(threads)))
        return found


_LOADED: dict[str, tuple[machine.Library, Any]] = {}
_LOADING = Lock()


def loaded(text: str) -> tuple[str, Any]:
    """Load the code of a module; return the name that XLA knows it by, and `run`.

    XLA takes one address for a name, and programs that it has compiled call that whenever they run: what was loaded once stays,
    and serves everyone who asks for the same text.
    """
    name = f"udkjax_{machine.digest(text)}"
    with _LOADING:
        if name not in _LOADED:
            library = machine.library(text)
            capsule = jax.ffi.pycapsule(ctypes.c_void_p(library["call_frame"]))
            jax.ffi.register_ffi_target(name, capsule, platform="cpu")
            _LOADED[name] = library, machine.function(library["run"], ctypes.c_void_p)
        return name, _LOADED[name][1]


MODES: dict[str, type[Trajectory]] = {"forward": Forward, "reverse": Reverse}


@lru_cache(maxsize=256)
def compiled(kind: Kind, width: int) -> Compiled:
    """The machine code of a kind of trajectory."""
    return Compiled(kind, width)


# --- as an operation of JAX: inputs and outputs have the members first, of an input that all share only one


def _shapes(inputs: Sequence[Any], kind: Kind, times: int) -> list[tuple[int, ...]]:
    n = inputs[INPUTS.index("q")].shape[1]
    members = max(x.shape[0] for x in inputs)
    shapes: list[tuple[int, ...]] = [(members, times, 2 * n), (members, times), (members, len(INFO) + 2 * n)]
    if kind.mode == "forward":
        directions = inputs[-1].shape[1]
        shapes += [(members, directions, times, 2 * n), (members, directions, 2 * n)]
    if kind.mode == "reverse":
        assert kind.moving is not None
        shapes += [(members, sum(kind.moving)), (members, n), (members, n)]
    return shapes


def _code(inputs: Sequence[Any], kind: Kind) -> Compiled:
    return compiled(kind, machine.lanes() if max(x.shape[0] for x in inputs) > FEW else 1)


def _at_once(*inputs: Any, kind: Kind, times: int) -> list[Array]:
    found = _code(inputs, kind)([np.asarray(x) for x in inputs], _shapes(inputs, kind, times))
    return [jnp.asarray(x) for x in found]


def _compiled_into(*inputs: Any, kind: Kind, times: int) -> Sequence[Array]:
    results = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in _shapes(inputs, kind, times)]
    return jax.ffi.ffi_call(_code(inputs, kind).name, results)(*inputs)


def _abstract(*inputs: Any, kind: Kind, times: int) -> list[Any]:
    return [jax.core.ShapedArray(shape, np.dtype(float)) for shape in _shapes(inputs, kind, times)]


def _batched(inputs: Sequence[Any], axes: Sequence[int | None], kind: Kind, times: int) -> tuple[list[Any], list[int | None]]:
    """A batch is more members; but one of directions alone, more directions."""
    size = next(x.shape[axis] for x, axis in zip(inputs, axes, strict=True) if axis is not None)
    first = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(inputs, axes, strict=True)]
    ways = len(MODES["forward"].inputs) if kind.mode == "forward" else 0
    shared = len(inputs) - ways
    if ways and all(axis is None for axis in axes[:shared]):

        def directions(x: Any, axis: int | None) -> Any:
            x = jnp.broadcast_to(x, (size, *x.shape)) if axis is None else x
            x = jnp.moveaxis(x, 0, 1)
            return x.reshape(x.shape[0], x.shape[1] * x.shape[2], *x.shape[3:])

        given = [directions(x, axis) for x, axis in zip(first[shared:], axes[shared:], strict=True)]
        found = native_p.bind(*first[:shared], *given, kind=kind, times=times)
        changes = [x.reshape(x.shape[0], size, x.shape[1] // size, *x.shape[2:]) for x in found[len(OUTPUTS) :]]
        return [*found[: len(OUTPUTS)], *changes], [*[None] * len(OUTPUTS), *[1] * len(changes)]
    members = max(x.shape[0 if axis is None else 1] for x, axis in zip(first, axes, strict=True))

    def each(x: Any, axis: int | None) -> Any:
        if axis is None and x.shape[0] == 1:
            return x
        x = x[None] if axis is None else x
        return jnp.broadcast_to(x, (size, members, *x.shape[2:])).reshape(size * members, *x.shape[2:])

    found = native_p.bind(*(each(x, axis) for x, axis in zip(first, axes, strict=True)), kind=kind, times=times)
    return [x.reshape(size, members, *x.shape[1:]) for x in found], [0] * len(found)


native_p = Primitive("native_trajectory")
native_p.multiple_results = True
native_p.def_impl(_at_once)
native_p.def_abstract_eval(_abstract)
batching.primitive_batchers[native_p] = _batched
mlir.register_lowering(native_p, mlir.lower_fun(_compiled_into), platform="cpu")


# --- problems


def serves(problem: Problem) -> bool:
    """Whether machine code can integrate a problem: one of scalar expressions, by an explicit Runge-Kutta method, on the CPU."""
    equations = problem.equations
    if type(equations) is not Equations or problem.pieces is not None or problem.length is None:
        return False
    if not is_explicit(problem.solver) or jax.default_backend() != "cpu" or not jax.config.jax_enable_x64:
        return False
    try:
        compiled(_kind(problem), 1)
    except UnsupportedError:
        return False
    return True


def solve(problem: Problem) -> Raw:
    """Integrate one problem; under vmap, as many as there are, in lanes."""
    return _raw(native_p.bind(*_inputs(problem), kind=_kind(problem), times=len(problem.ts)))


def serves_derivatives(problem: Problem, moving: Problem) -> bool:
    """Whether there is machine code for the derivatives along what is `moving`: numbers of the scene, and initial states."""
    if not serves(problem):
        return False
    moved = eqx.tree_at(lambda p: (p.q, p.v, p.equations), moving, (False, False, None), is_leaf=lambda x: x is None)
    equations = eqx.tree_at(
        lambda e: (e.constants, e.textbook.mechanism, e.textbook.baumgarte),
        moving.equations,
        (None, None, None),
        is_leaf=lambda x: x is None,
    )
    return not any(x is True for x in jax.tree.leaves((moved, equations)))


def pushed(problem: Problem, moving: Problem, change: Problem) -> tuple[Raw, tuple[Array, Array, Array]]:
    """Integrate a problem, with the changes of positions, velocities and the end along a `change` of what is moving."""
    kind = _kind(problem, _moving(problem, moving), "forward")
    constants = [dx for dx, m in zip(change.equations.constants, moving.equations.constants, strict=True) if m is True]
    n = len(problem.q)
    dq, dv = (jnp.zeros(n) if dx is None else dx for dx in (change.q, change.v))
    along = [jnp.stack(constants) if constants else jnp.zeros(0), dq, dv]
    *found, dys, dend = native_p.bind(
        *_inputs(problem, kind.code), *(x[None, None] for x in along), kind=kind, times=len(problem.ts)
    )
    return _raw(found), (dys[0, 0, :, :n], dys[0, 0, :, n:], dend[0, 0])


def pulled(problem: Problem, moving: Problem, ys: Array, end: Array) -> Problem:
    """The cotangents of what is `moving`, from those of the states at the output times (T, 2n) and of the end (2n,)."""
    kind = _kind(problem, _moving(problem, moving), "reverse")
    bars = [ys[None], end[None]]
    cbar, qbar, vbar = native_p.bind(*_inputs(problem, kind.code), *bars, kind=kind, times=len(problem.ts))[len(OUTPUTS) :]
    found = iter(cbar[0])
    assert kind.moving is not None
    by_node = {s.index: next(found) for s, m in zip(kind.code.constants, kind.moving, strict=True) if m}
    pairs = zip(problem.equations.code.constants, moving.equations.constants, strict=True)
    constants = [by_node[s.index] if m is True else None for s, m in pairs]
    none = jax.tree.map(lambda m: None, moving, is_leaf=lambda x: x is None)
    zeros = jax.tree.map(
        lambda m, x: jnp.zeros_like(x) if m is True else None, moving.equations, problem.equations, is_leaf=lambda x: x is None
    )
    equations = eqx.tree_at(lambda e: e.constants, zeros, constants, is_leaf=lambda x: x is None)
    return eqx.tree_at(
        lambda p: (p.equations, p.q, p.v),
        none,
        (equations, qbar[0] if moving.q is True else None, vbar[0] if moving.v is True else None),
        is_leaf=lambda x: x is None,
    )


def _moving(problem: Problem, moving: Problem) -> tuple[bool, ...]:
    """Of the constants of the code that watches: which have derivatives."""
    code = problem.equations.code
    moves = {s.index for s, m in zip(code.constants, moving.equations.constants, strict=True) if m is True}
    return tuple(s.index in moves for s in _watching(code).constants)


def _watching(code: Code) -> Code:
    """The code of derivatives: it leaves out what depends on other rows, where a step is taken with care."""
    return code.watching if code.elimination == "check" else code


def _kind(problem: Problem, moving: tuple[bool, ...] | None = None, mode: str = "run") -> Kind:
    code = problem.equations.code
    method = Tableau(method_of(problem.solver))
    return Kind(
        code if moving is None else _watching(code), method, problem.projected, problem.breakpoints is not None, moving, mode
    )


def _inputs(problem: Problem, code: Code | None = None) -> list[Array]:
    """Those of a run, of one member."""
    textbook = problem.equations.textbook
    method, baumgarte = textbook.method, textbook.baumgarte
    gains = [] if baumgarte is None else [baumgarte.alpha, baumgarte.beta]
    care = method.rank_tol * (CARE_TOL / RANK_TOL)
    thresholds = [method.branch_tol] if isinstance(method, Auto) else [method.rank_tol**2]
    if code is not None and code.elimination == "watch":
        thresholds = [care**2, *thresholds]
    first = 0.0 if problem.h is None else problem.h
    settings = [problem.rtol, problem.atol, problem.smallest, first, problem.length, problem.rate, care, problem.max_steps]
    given = {
        "numbers": _vector([*jax.tree.leaves(textbook.mechanism), *gains, *thresholds]),
        "ts": problem.ts,
        "q": problem.q,
        "v": problem.v,
        "settings": _vector(settings),
        "rows": textbook.scales.rows,
        "breaks": jnp.zeros(0) if problem.breakpoints is None else problem.breakpoints,
    }
    return [jax.lax.stop_gradient(jnp.asarray(given[name], float))[None] for name in INPUTS]


def _vector(parts: Sequence[Any]) -> Array:
    return jnp.concatenate([jnp.ravel(jnp.asarray(x, float)) for x in parts])


def _raw(found: Sequence[Array]) -> Raw:
    ys, violation, info = (x[0] for x in found)
    q, v = jnp.split(ys, 2, axis=1)
    code, t, tried, accepted, evaluations, written = (info[k] for k in range(len(INFO)))
    number = jnp.arange(len(ys))
    reached = (number <= written) & (number < len(ys) - 1) | (code == DONE)
    counts = (x.astype(int) for x in (tried, accepted, evaluations))
    return Raw(q, v, violation, reached, code.astype(int), t, info[len(INFO) :], *counts)
