"""Assembly: from the initial guess of a scene to positions and velocities that satisfy its constraints.

Positions by damped Gauss-Newton in the mass metric, with Psi of all rows,

    q <- q - s M^(-1/2) D^+ Psi,       D = Psi_q M^(-1/2),

the smallest change that removes the linearized residual; s limits the length of a step, so that the branch of the guess is kept,
and is halved until the residual falls: no step makes a state worse. Velocities by v - M^(-1/2) D^+ Psi_dot, which leaves the free
motion of the guess as it is and satisfies the drivers. D^+ is truncated, so redundant rows do no harm, and its derivative is the
one that all pseudoinverses share: gradients of the assembled state are right wherever the closed mechanism's rank is constant.
"""

import weakref
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int

from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.constraints import psi
from udkjax.equations.dense_rows import DenseRows
from udkjax.equations.position_closure import (
    CLOSED,
    ITERATIONS,
    TracedRows,
    close_position,
    damped_step,
    is_closed,
)
from udkjax.equations.redundancy import dependent_constraints
from udkjax.equations.scales import Scales, rank_tolerance
from udkjax.equations.structure import is_large
from udkjax.equations.textbook import prepare
from udkjax.integrate import native_engine
from udkjax.integrate.derivatives import Function, Linear, Mask, select
from udkjax.pinv import SVD
from udkjax.scene.fields import number
from udkjax.scene.mechanism import Mechanism


class State(eqx.Module):
    """Coordinates and velocities of all bodies: x, y (m) and angle (rad), and their rates, each (bodies, 3).

    Of a `ConstrainedSystem`: (n,) each.
    """

    q: Float[Array, "bodies 3"] | Float[Array, "n"]
    v: Float[Array, "bodies 3"] | Float[Array, "n"]

    def __init__(self, q: ArrayLike, v: ArrayLike):
        self.q, self.v = number(q), number(v)


class AssemblyError(ValueError):
    """A mechanism cannot be closed, or not moved as its drivers ask. `state` is the best that was found."""

    def __init__(self, message: str, state: State):
        super().__init__(message)
        self.state = state


class Closure(NamedTuple):
    """An assembled state, what is left of Psi (m, rad) and Psi_dot (m/s, rad/s), row by row, and the rank of D there."""

    state: State
    psi: Float[Array, "m"]
    psi_dot: Float[Array, "m"]
    rank: Int[Array, ""]
    scales: Scales

    @property
    def is_closed(self) -> Any:
        """Whether the residuals are within `CLOSED` of the scene's scales, or rounding."""
        given: Any = self.scales, self.state.q, self.state.v, self.psi, self.psi_dot
        xp: Any = np if _known(given) else jnp
        scales, q, v, psi, psi_dot = jax.tree.map(xp.asarray, given)
        return is_closed(scales, q.ravel(), v.ravel(), psi, psi_dot, xp)


def assemble(
    mechanism: Mechanism, t: ArrayLike = 0.0, state: State | None = None, throw: bool = True, analysis: Analysis | None = None
) -> State:
    """Close a mechanism at time t (s), from `state` or from the initial guess of its bodies.

    A state that satisfies all constraints is returned as it is, up to rounding. Differentiable to second order with respect to
    every number of the mechanism and the guess, also where constraints are redundant. `analysis` is that of `udkjax.analyse`, by
    default made here. Raises `AssemblyError`, which names the joints that stay open; with `throw=False`, or when numbers are
    traced, the best state found is returned instead.
    """
    closure = close(mechanism, t, state, analysis=analysis)
    if throw:
        require_closed(mechanism, closure)
    return closure.state


def close(
    mechanism: Mechanism,
    t: ArrayLike = 0.0,
    state: State | None = None,
    analysis: Analysis | None = None,
) -> Closure:
    """As `assemble`, with the residuals instead of an error.

    Where all numbers are known the closure is, too, also while something else is traced.
    """
    if not _known((mechanism, t, state)):
        analysis = analyse(mechanism) if analysis is None else analysis
        return _close(mechanism.without_origin, analysis, t, state)
    of, when, found = _latest.get(id(mechanism), (None, 0.0, None))
    if found is not None and state is None and of is not None and of() is mechanism and when == np.asarray(t).item():
        return found
    with jax.ensure_compile_time_eval():
        scales = (analyse(mechanism) if analysis is None else analysis).scales
        guess = State(mechanism.q0, mechanism.v0) if state is None else state
        q, v = (np.asarray(x, float).ravel() for x in (guess.q, guess.v))
        with np.errstate(all="ignore"):  # what is not finite does not close
            q, v, psi, psi_dot, rank = _assembled_at_once(mechanism, scales, np.asarray(t).item(), q, v)
        state_found = State(q.reshape(-1, 3), v.reshape(-1, 3))
        found = Closure(state_found, number(psi), number(psi_dot), jax.device_put(np.asarray(rank)), scales)
    if state is None:
        key = id(mechanism)
        _latest[key] = (weakref.ref(mechanism, lambda _: _latest.pop(key, None)), np.asarray(t).item(), found)
    return found


def _assembled_at_once(mechanism: Mechanism, scales: Scales, t: float, q: np.ndarray, v: np.ndarray) -> Any:
    """q and v closed, what is left of Psi and Psi_dot, and the rank of D, of known numbers."""
    if not is_large(mechanism):  # for which it takes longer to compile anything
        return DenseRows(mechanism, scales).assemble(t, q, v)
    if native_engine.closes(mechanism):
        return native_engine.closed_at_once(mechanism, scales, rank_tolerance(mechanism), t, q, v)
    from udkjax.equations.sparse_rows import SparseRows  # and with it SciPy, which small scenes do without

    return SparseRows(mechanism).assemble(t, q, v)


# How each mechanism that still exists was last assembled: who simulates it again need not close it again.
_latest: dict[int, tuple[Any, float, Closure | None]] = {}


@eqx.filter_jit
def _close(mechanism: Mechanism, analysis: Analysis, t: ArrayLike, state: State | None) -> Closure:
    guess = State(mechanism.q0, mechanism.v0) if state is None else state
    q, v = number(guess.q).ravel(), number(guess.v).ravel()
    close = _by_machine_code if native_engine.closes(mechanism) else _assembled
    q, v, psi, psi_dot, rank = close(mechanism, analysis, number(t), q, v)
    return Closure(State(q.reshape(-1, 3), v.reshape(-1, 3)), psi, psi_dot, jnp.asarray(rank), analysis.scales)


def _assembled(mechanism: Mechanism, analysis: Analysis, t: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any, Any]:
    return TracedRows(prepare(mechanism, SVD(), analysis=analysis)).assemble(_closed, t, q, v)


class Assembly(Function):
    """q and v of a closed state, of the numbers of a mechanism and a guess. `rest` is what else they depend on."""

    rest: Any
    tree: Any = eqx.field(static=True)
    is_plain: bool = eqx.field(static=True, default=False)

    @property
    def plain(self) -> "Assembly":
        return replace(self, is_plain=True)

    def guess(self, xs: list[Array]) -> tuple[Any, ...]:
        """The mechanism, its analysis, and t, q and v."""
        return eqx.combine(jax.tree.unflatten(self.tree, xs), self.rest)

    def __call__(self, xs: list[Array]) -> list[Array]:
        return list(_assembled(*self.guess(xs))[:2])

    def shapes(self, xs: list[Array]) -> list[tuple[int, ...]]:
        *_, q, v = self.guess(xs)
        return [q.shape, v.shape]

    def forward(self, xs: list[Array], moving: Mask, vs: list[Array], run: Any) -> list[Array]:
        guess, which = self._native(xs, moving)
        if guess is None:
            return super().forward(xs, moving, vs, run)
        rest = iter(vs)
        change = jax.tree.unflatten(self.tree, [next(rest) if m else None for m in moving])
        return list(native_engine.closed_along(guess, _native_inputs(which), _native_inputs(change)))

    def backward(self, xs: list[Array], moving: Mask, ws: list[Array], run: Any) -> list[Array]:
        guess, which = self._native(xs, moving)
        if guess is None:
            return super().backward(xs, moving, ws, run)
        found = native_engine.closed_back(guess, _native_inputs(which), *ws)
        pairs = zip(*(jax.tree.leaves(tree, is_leaf=lambda x: x is None) for tree in (_native_inputs(which), found)), strict=True)
        return [bar for m, bar in pairs if m is True]

    def _native(self, xs: list[Array], moving: Mask) -> tuple[Any, Any]:
        """What machine code takes, if it closes the mechanism and has derivatives along what is moving."""
        which = jax.tree.unflatten(self.tree, moving)
        mechanism, analysis, t, q, v = self.guess(xs)
        others = any(m is True for m in jax.tree.leaves((which[1], which[2])))
        if self.is_plain or others or not native_engine.closes(mechanism):
            return None, None
        return (mechanism, analysis.scales, rank_tolerance(mechanism), t, q, v), which


def _native_inputs(tree: Any) -> tuple[Any, Any, Any]:
    """Of a mechanism, an analysis, t, q and v: what machine code has derivatives along."""
    mechanism, _, _, q, v = tree
    return mechanism, q, v


def _by_machine_code(mechanism: Mechanism, analysis: Analysis, t: Any, q: Any, v: Any) -> tuple[Any, Any, Any, Any, Any]:
    arrays, rest = eqx.partition((mechanism, analysis, t, q, v), eqx.is_inexact_array)
    xs, tree = jax.tree.flatten(arrays)
    return _closed_by_code(Assembly(rest, tree), xs)


@eqx.filter_custom_jvp
def _closed_by_code(function: Assembly, xs: list[Array]) -> tuple[Any, Any, Any, Any, Any]:
    mechanism, analysis, t, q, v = function.guess(xs)
    return native_engine.closed(mechanism, analysis.scales, rank_tolerance(mechanism), t, q, v)


@_closed_by_code.def_jvp
def _(primals, tangents):
    function, xs = primals
    found = _closed_by_code(function, xs)
    moving = tuple(dx is not None for dx in tangents[1])
    linear = Linear(function=function, xs=xs, run=(), moving=moving)
    return found, (*linear.applied(select(tangents[1], moving)), None, None, None)


def _known(tree: Any) -> bool:
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def require_closed(mechanism: Mechanism, closure: Closure) -> None:
    """Raise an `AssemblyError` where a closure is not closed; traced values pass."""
    closed = closure.is_closed
    if isinstance(closed, Tracer) or closed:
        return
    names = analyse(mechanism).row_names
    psi, psi_dot, rows = (np.asarray(x) for x in (closure.psi, closure.psi_dot, closure.scales.rows))
    open_position = bool(np.max(np.abs(psi) / rows) > CLOSED) or not np.all(np.isfinite(psi))
    residual = psi if open_position else psi_dot
    worst: dict[str, tuple[float, float]] = {}  # over the row's scale, and as it is
    for (name, _), r, unit in zip(names, residual, rows, strict=True):
        worst[name] = max(worst.get(name, (0.0, 0.0)), (abs(float(r)) / float(unit), abs(float(r))))
    largest = max(size for size, _ in worst.values())
    listed = sorted((n for n in worst if not worst[n][0] <= CLOSED * largest), key=lambda n: -worst[n][0])
    text = ", ".join(f'"{n}" ({worst[n][1]:.2g})' for n in listed[:8]) + (", ..." if len(listed) > 8 else "")
    if open_position:
        cause = f"the mechanism cannot be closed near its initial guess; open (m, rad): {text}"
        cure = "check the points and lengths of these joints, or bring the initial positions and angles closer to a closed state"
    else:
        cause = f"no velocities satisfy all constraints in this position; left over (m/s, rad/s): {text}"
        cure = "a driver asks for a motion that the joints forbid here: start elsewhere, or change the driver's motion"
    raise AssemblyError(f"{cause}. {cure[0].upper()}{cure[1:]}.", closure.state)


class Check(NamedTuple):
    """What there is to know of a mechanism's constraints before it moves."""

    bodies: int
    coordinates: int
    rows: int
    rank: int  # in general: elsewhere than in a singular configuration
    degrees_of_freedom: int
    redundant: tuple[tuple[str, int], ...]  # rows that can be left out: the constraint and the row within it
    dependent: tuple[str, ...]  # the constraints that depend on each other
    residual_before: float  # the largest |Psi| (m, rad) as given, and assembled
    residual_after: float
    closed: bool


def check(mechanism: Mechanism) -> Check:
    """Count rows, rank and degrees of freedom, name redundant rows, and say how well the initial guess closes."""
    closure = close(mechanism)
    before = psi(mechanism, 0.0, mechanism.q0)
    rows = len(before)
    closed = bool(closure.is_closed)
    found = analyse(mechanism)
    rank = int(closure.rank) if found.rank is None or not closed else found.rank
    return Check(
        bodies=len(mechanism.body_names),
        coordinates=3 * len(mechanism.body_names),
        rows=rows,
        rank=rank,
        degrees_of_freedom=3 * len(mechanism.body_names) - rank,
        redundant=found.redundant if closed else (),
        dependent=dependent_constraints(mechanism, np.asarray(closure.state.q)) if closed else (),
        residual_before=float(jnp.abs(before).max(initial=0.0)),
        residual_after=float(jnp.abs(closure.psi).max(initial=0.0)),
        closed=closed,
    )


@jax.custom_jvp
def _closed(rows: TracedRows, t: Any, q: Any) -> Any:
    return close_position(rows, t, q)


def _closed_plain(rows: TracedRows, t: Any, q: Any) -> Any:
    """The same steps as `_closed`, in a loop of fixed length that reverse mode can follow.

    A step that no longer lowers the residual is taken in the derivative all the same: at a closed state it changes nothing but
    the tangent, which it projects to the manifold.
    """

    def body(q, _):
        ahead, better = damped_step(rows, t, q)
        return jnp.where(better, ahead, q + rows.correction(t, q)), None

    return jax.lax.scan(body, q, None, length=ITERATIONS)[0]


@_closed.defjvp
def _(primals, tangents):
    _, tangent = jax.jvp(_closed_plain, primals, tangents)
    return _closed(*primals), tangent
