"""Trajectories by machine code: what of a problem they serve, and calls of them, from compiled JAX programs and from Python."""

import ctypes
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.equations.code import Code
from udkjax.equations.programs import Equations
from udkjax.equations.scales import RANK_TOL
from udkjax.integrate.batched import batched
from udkjax.integrate.problem import DONE, Problem, Raw
from udkjax.integrate.tableau import Method, is_explicit, method_of
from udkjax.native import machine
from udkjax.native.ffi import handler
from udkjax.native.program import UnsupportedError
from udkjax.native.trajectory import CALL, INFO, INPUTS, OUTPUTS, Plan, Trajectory
from udkjax.pinv import Auto

# Rows that count as redundant where a step is taken with care, and are not, leave what they hold back in velocities, as large as
# the threshold, and rounding errors are as large as a unit over its square: both are least at the third root of a unit.
CARE_TOL = np.finfo(float).eps ** (1 / 3)


class Compiled:
    """The machine code of one plan."""

    def __init__(self, plan: Plan):
        trajectory = Trajectory(plan)
        text = trajectory.text()
        self.name = f"udkjax_{machine.digest(text)}"
        main = handler("call_frame")
        self.library = machine.library("\n".join([text, *sorted(main.declared), main.text()]))
        self._run = machine.function(self.library["run"], ctypes.c_void_p)
        capsule = jax.ffi.pycapsule(ctypes.c_void_p(self.library["call_frame"]))
        jax.ffi.register_ffi_target(self.name, capsule, platform="cpu")

    def __call__(self, inputs: Sequence[np.ndarray], times: int, members: int) -> list[np.ndarray]:
        """All members, on as many threads as there are cores; inputs are (1 or members, length)."""
        inputs = [np.ascontiguousarray(x, np.float64) for x in inputs]
        n = inputs[INPUTS.index("q")].shape[1]
        shapes = {"ys": (members, times, 2 * n), "violation": (members, times), "info": (members, len(INFO) + 2 * n)}
        found = [np.full(shapes[name], np.nan) for name in OUTPUTS]
        following = ctypes.c_int64(0)
        call = (ctypes.c_int64 * len(CALL))()
        fields: dict[str, int] = {"members": members, "times": times, "knots": inputs[INPUTS.index("breaks")].shape[1]}
        fields |= {name: x.ctypes.data for name, x in zip(INPUTS, inputs, strict=True)}
        fields |= {f"{name} stride": x.shape[1] if len(x) > 1 else 0 for name, x in zip(INPUTS, inputs, strict=True)}
        fields |= {name: x.ctypes.data for name, x in zip(OUTPUTS, found, strict=True)}
        fields["next"] = ctypes.addressof(following)
        for k, name in enumerate(CALL):
            call[k] = fields[name]
        threads = min(os.cpu_count() or 1, members)
        if threads == 1:
            self._run(ctypes.addressof(call))
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(lambda _: self._run(ctypes.addressof(call)), range(threads)))
        return found

    def traced(self, inputs: Sequence[Array], times: int, members: int) -> Sequence[Array]:
        """The same as an operation of a compiled program."""
        n = inputs[INPUTS.index("q")].shape[1]
        shapes = [(members, times, 2 * n), (members, times), (members, len(INFO) + 2 * n)]
        results = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes]
        return jax.ffi.ffi_call(self.name, results, vmap_method="sequential")(*inputs)


@lru_cache(maxsize=256)
def compiled(code: Code, method: "Hashed", projected: bool, breaks: bool, width: int) -> Compiled:
    """The machine code for one structure and method."""
    return Compiled(Plan(code, method.method, projected, breaks, width, machine.lanes()))


class Hashed:
    """A tableau that can be looked up."""

    def __init__(self, method: Method):
        self.method = method
        self._key = tuple(np.asarray(x).tobytes() for x in method)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Hashed) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


# --- problems


def serves(problem: Problem) -> bool:
    """Whether machine code can integrate a problem: one of scalar expressions, by an explicit Runge-Kutta method, on the CPU."""
    equations = problem.equations
    if type(equations) is not Equations or problem.pieces is not None or problem.length is None:
        return False
    if not is_explicit(problem.solver) or jax.default_backend() != "cpu" or not jax.config.jax_enable_x64:
        return False
    try:
        _compiled(problem, 1)
    except UnsupportedError:
        return False
    return True


def solve(problem: Problem) -> Raw:
    """Integrate one problem; under vmap, as many as there are, in lanes."""
    return batched(problem, _single, _many)


def _single(problem: Problem) -> Raw:
    inputs = [build(take(problem))[None] for take, build in _INPUTS.values()]
    found = _raw(_compiled(problem, 1).traced([*inputs], len(problem.ts), 1), len(problem.ts))
    return jax.tree.map(lambda x: x[0], found)


def _many(arrays: Any, batched: Any, static: Any, size: int) -> Raw:
    """What differs from member to member has the members first."""
    inputs = []
    for take, build in _INPUTS.values():
        known, rest, each = take(arrays), take(static), take(batched)
        axes = jax.tree.map(lambda b: 0 if b is True else None, each)
        if jax.tree.leaves(axes):
            inputs.append(jax.vmap(lambda x, b=build, r=rest: b(eqx.combine(x, r)), (axes,))(known))
        else:
            inputs.append(build(eqx.combine(known, rest))[None])
    problem = eqx.combine(arrays, static)
    times = problem.ts.shape[-1]
    return _raw(_compiled(problem, machine.lanes()).traced(inputs, times, size), times)


def _compiled(problem: Problem, width: int) -> Compiled:
    method = Hashed(method_of(problem.solver))
    return compiled(problem.equations.code, method, problem.projected, problem.breakpoints is not None, width)


def _numbers(of: Any) -> Array:
    mechanism, baumgarte, method = of
    gains = [] if baumgarte is None else [baumgarte.alpha, baumgarte.beta]
    drop = method.branch_tol if isinstance(method, Auto) else method.rank_tol**2
    return _vector([*jax.tree.leaves(mechanism), *gains, drop])


def _settings(of: Any) -> Array:
    rtol, atol, smallest, h, length, rate, method, max_steps = of
    care = method.rank_tol * (CARE_TOL / RANK_TOL)
    return _vector([rtol, atol, smallest, 0.0 if h is None else h, length, rate, care, max_steps])


def _vector(parts: Sequence[Any]) -> Array:
    return jnp.concatenate([jnp.ravel(jnp.asarray(x, float)) for x in parts])


def _textbook(p: Any) -> Any:
    return p.equations.textbook


# Of each input, what of a problem it is made of, and how.
_INPUTS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Array]]] = {
    "numbers": (lambda p: (_textbook(p).mechanism, _textbook(p).baumgarte, _textbook(p).method), _numbers),
    "ts": (lambda p: p.ts, lambda x: x),
    "q": (lambda p: p.q, lambda x: x),
    "v": (lambda p: p.v, lambda x: x),
    "settings": (
        lambda p: (p.rtol, p.atol, p.smallest, p.h, p.length, p.rate, _textbook(p).method, p.max_steps),
        _settings,
    ),
    "rows": (lambda p: _textbook(p).scales.rows, lambda x: x),
    "breaks": (lambda p: p.breakpoints, lambda x: jnp.zeros(0) if x is None else x),
}


def _raw(found: Sequence[Array], times: int) -> Raw:
    ys, violation, info = found
    q, v = jnp.split(ys, 2, axis=2)
    code, t, tried, accepted, evaluations, written = (info[:, k] for k in range(len(INFO)))
    number = jnp.arange(times)
    reached = (number <= written[:, None]) & (number < times - 1) | (code[:, None] == DONE)
    counts = (x.astype(int) for x in (tried, accepted, evaluations))
    return Raw(q, v, violation, reached, code.astype(int), t, info[:, len(INFO) :], *counts)
