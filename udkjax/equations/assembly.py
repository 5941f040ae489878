"""Assembly: from the initial guess of a scene to positions and velocities that satisfy its constraints.

Positions by damped Gauss-Newton in the mass metric, with Psi of all rows,

    q <- q - s M^(-1/2) D^+ Psi,       D = Psi_q M^(-1/2),

the smallest change that removes the linearized residual; s limits the length of a step, so that the branch of the guess is kept,
and is halved until the residual falls: no step makes a state worse. Velocities by v - M^(-1/2) D^+ Psi_dot, which leaves the free
motion of the guess as it is and satisfies the drivers. D^+ is truncated, so redundant rows do no harm, and its derivative is the
one that all pseudoinverses share: gradients of the assembled state are right wherever the closed mechanism's rank is constant.
"""

import weakref
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int

from udkjax.equations.closing import HALVINGS, ITERATIONS, assembled, assembled_by_numpy, assembled_by_scipy, direction, limited
from udkjax.equations.motion import MechanismMotion
from udkjax.equations.programs import is_large, prepare_to_close
from udkjax.equations.redundancy import dependent_constraints, redundant_rows
from udkjax.scene.fields import number
from udkjax.scene.mechanism import Mechanism

# Of the size of the coordinates (m, rad): what counts as closed. Rounding leaves 1e-15; a scene that cannot be closed leaves what
# its lengths are wrong by.
CLOSED = 1e-9


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


def assemble(mechanism: Mechanism, t: ArrayLike = 0.0, state: State | None = None, throw: bool = True) -> State:
    """Close a mechanism at time t (s), from `state` or from the initial guess of its bodies.

    A state that satisfies all constraints is returned as it is, up to rounding. Differentiable to second order with respect to
    every number of the mechanism and the guess, also where constraints are redundant. Raises `AssemblyError`, which names the
    joints that stay open; with `throw=False`, or when numbers are traced, the best state found is returned instead.
    """
    closure = close(mechanism, t, state)
    if throw:
        require_closed(mechanism, closure)
    return closure.state


def close(mechanism: Mechanism, t: ArrayLike = 0.0, state: State | None = None, forward: bool = False) -> Closure:
    """As `assemble`, with the residuals instead of an error.

    Where all numbers are known the closure is, too, also while something else is traced. With `forward` it has derivatives by
    forward mode only, which take no more steps than closing does.
    """
    if not _known((mechanism, t, state)):
        return _close(mechanism, t, state, forward)
    of, when, found = _latest.get(id(mechanism), (None, 0.0, None))
    if found is not None and state is None and of is not None and of() is mechanism and when == np.asarray(t).item():
        return found
    with jax.ensure_compile_time_eval():
        guess = State(mechanism.q0, mechanism.v0) if state is None else state
        by_numpy = assembled_by_scipy if is_large(mechanism) else assembled_by_numpy
        q, v, psi, psi_dot, rank = by_numpy(mechanism, t, guess.q, guess.v)
        found = Closure(State(q.reshape(-1, 3), v.reshape(-1, 3)), number(psi), number(psi_dot), jax.device_put(np.asarray(rank)))
    if state is None:
        key = id(mechanism)
        _latest[key] = (weakref.ref(mechanism, lambda _: _latest.pop(key, None)), np.asarray(t).item(), found)
    return found


# How each mechanism that still exists was last assembled: who simulates it again need not close it again.
_latest: dict[int, tuple[Any, float, Closure | None]] = {}


@eqx.filter_jit
def _close(mechanism: Mechanism, t: ArrayLike, state: State | None, forward: bool) -> Closure:
    guess = State(mechanism.q0, mechanism.v0) if state is None else state
    q, v = number(guess.q).ravel(), number(guess.v).ravel()
    closed = _closed_forward if forward else _closed
    q, v, psi, psi_dot, rank = assembled(prepare_to_close(mechanism), closed, number(t), q, v)
    return Closure(State(q.reshape(-1, 3), v.reshape(-1, 3)), psi, psi_dot, jnp.asarray(rank))


def _known(tree: Any) -> bool:
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def is_closed(closure: Closure) -> Any:
    """Whether the residuals are rounding errors (see `CLOSED`)."""
    xp: Any = np if _known(closure) else jnp
    parts = (closure.state.q, closure.state.v, closure.psi, closure.psi_dot)
    q, v, psi, psi_dot = (xp.max(xp.abs(xp.asarray(x)), initial=0.0) for x in parts)
    tol = max(CLOSED, 64.0 * float(jnp.finfo(closure.psi.dtype).eps))
    return (psi <= tol * (1.0 + q)) & (psi_dot <= tol * (1.0 + v))


def require_closed(mechanism: Mechanism, closure: Closure) -> None:
    """Raise an `AssemblyError` where a closure is not closed; traced values pass."""
    closed = is_closed(closure)
    if isinstance(closed, Tracer) or closed:
        return
    equations = prepare_to_close(mechanism)
    worst: dict[str, float] = {}
    q, psi, psi_dot = (np.asarray(x) for x in (closure.state.q, closure.psi, closure.psi_dot))
    open_position = bool(np.abs(psi).max() > CLOSED * (1.0 + np.abs(q).max()))
    residual = psi if open_position else psi_dot
    for (name, _), r in zip(equations.row_names, residual, strict=True):
        worst[name] = max(worst.get(name, 0.0), abs(float(r)))
    listed = sorted((n for n in worst if worst[n] > CLOSED), key=lambda n: -worst[n])
    names = ", ".join(f'"{n}" ({worst[n]:.2g})' for n in listed[:8]) + (", ..." if len(listed) > 8 else "")
    if open_position:
        cause = f"the mechanism cannot be closed near its initial guess; open (m, rad): {names}"
        cure = "check the points and lengths of these joints, or bring the initial positions and angles closer to a closed state"
    else:
        cause = f"no velocities satisfy all constraints in this position; left over (m/s, rad/s): {names}"
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
    equations = prepare_to_close(mechanism)
    before = equations.violation(0.0, mechanism.q0.ravel(), mechanism.v0.ravel())[0]
    names, rows = equations.row_names, len(before)
    closed = bool(is_closed(closure))
    left_out = redundant_rows(mechanism) if closed else None
    rank = int(closure.rank) if left_out is None else rows - len(left_out)
    return Check(
        bodies=len(mechanism.body_names),
        coordinates=3 * len(mechanism.body_names),
        rows=rows,
        rank=rank,
        degrees_of_freedom=3 * len(mechanism.body_names) - rank,
        redundant=tuple(names[i] for i in left_out or ()),
        dependent=dependent_constraints(mechanism, np.asarray(closure.state.q)) if closed else (),
        residual_before=float(jnp.abs(before).max(initial=0.0)),
        residual_after=float(jnp.abs(closure.psi).max(initial=0.0)),
        closed=closed,
    )


def _size(equations: MechanismMotion, t: Any, q: Any) -> Any:
    return jnp.linalg.norm(equations.violation(t, q, q)[0])


def _step(equations: MechanismMotion, t: Any, q: Any) -> tuple[Any, Any]:
    """One damped step, and whether it made the residual smaller."""
    step = limited(direction(equations, t, q), jnp)
    here, ahead = jax.lax.stop_gradient((q, step))
    equations = jax.lax.stop_gradient(equations)
    size = _size(equations, t, here)

    def worse(trial):
        scale, k = trial
        return (k < HALVINGS) & ~(_size(equations, t, here + scale * ahead) < size)

    scale, k = jax.lax.while_loop(worse, lambda trial: (0.5 * trial[0], trial[1] + 1), (jnp.ones(()), 0))
    better = k < HALVINGS
    return jnp.where(better, q + scale * step, q), better


def _steps(equations: MechanismMotion, t: Any, q: Any) -> Any:
    """Steps until none makes the residual smaller."""

    def unfinished(carry):
        _, better, k = carry
        return better & (k < ITERATIONS)

    def body(carry):
        q, _, k = carry
        return *_step(equations, t, q), k + 1

    return jax.lax.while_loop(unfinished, body, (q, jnp.array(True), 0))[0]


_closed = jax.custom_jvp(_steps)


def _closed_forward(equations: MechanismMotion, t: Any, q: Any) -> Any:
    """The same; forward mode follows the steps as they are, and one more, which projects the tangent: see `_closed_plain`."""
    q = _steps(equations, t, q)
    return q + direction(equations, t, q)


def _closed_plain(equations: MechanismMotion, t: Any, q: Any) -> Any:
    """The same steps as `_closed`, in a loop of fixed length that reverse mode can follow.

    A step that no longer lowers the residual is taken in the derivative all the same: at a closed state it changes nothing but
    the tangent, which it projects to the manifold.
    """

    def body(q, _):
        ahead, better = _step(equations, t, q)
        settled = q + direction(equations, t, q)
        return jnp.where(better, ahead, settled), None

    return jax.lax.scan(body, q, None, length=ITERATIONS)[0]


@_closed.defjvp
def _(primals, tangents):
    _, tangent = jax.jvp(_closed_plain, primals, tangents)
    return _closed(*primals), tangent
