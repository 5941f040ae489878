"""Assembly: from the initial guess of a scene to positions and velocities that satisfy its constraints.

Positions by damped Gauss-Newton in the mass metric, with Psi of all rows,

    q <- q - s M^(-1/2) D^+ Psi,       D = Psi_q M^(-1/2),

the smallest change that removes the linearized residual. s limits the length of a step, to stay on the branch of the guess, and
is halved until the residual decreases. Velocities are v - M^(-1/2) D^+ Psi_dot: the drivers are satisfied, and the free motion of
the guess is unchanged. D^+ is truncated, so redundant rows do no harm, and has the derivative that all pseudoinverses share:
gradients of the assembled state are right if the rank of the closed mechanism is constant. They treat the characteristic length
as fixed, although it affects the result from guesses so far away that steps are limited.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from udkjax.annotations import NumberLike, Numbers
from udkjax.argument_types import checks_instances, require_coordinates
from udkjax.arrays import (
    ROUNDING,
    float_type,
    is_traced,
    is_within_jit,
    make_module,
    number,
    number_called,
    put_arrays,
    without_derivatives,
)
from udkjax.equations.programs.scales import Scales
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.rows.dense_rows import DenseRows
from udkjax.equations.rows.position_closure import CLOSURE, is_closed
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.equations.terms.element_programs import has_rheonomic_joints
from udkjax.positions.assembling import native_closing
from udkjax.positions.assembling.closure import close_by_jax, close_by_machine_code, from_moment
from udkjax.positions.assembling.given_state import GivenState, GivenValues
from udkjax.positions.assembling.open_rows import explain_open
from udkjax.positions.assembling.system_closure import close_system
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_number, units
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.programs.undefined import defined, whole
from udkjax.requirements import ArgumentError, GivenArguments
from udkjax.scene.arguments import checked
from udkjax.scene.elements.rolling import rolling_joints
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.description import size_of
from udkjax.scene.suspicions import body_sizes


class State(PrintsTable):
    """Coordinates and velocities of all bodies: x, y (m) and angle (rad), and their rates, each (bodies, 3).

    For a `ConstrainedSystem`: (n,) each.

    Args:
        q: coordinates (bodies, 3): x, y (m) and angle (rad).
        v: their rates (bodies, 3): m/s and rad/s.
    """

    q: Float[Array, "bodies 3"] | Float[Array, "n"]
    v: Float[Array, "bodies 3"] | Float[Array, "n"]

    def __init__(self, q: Numbers, v: Numbers):
        self.q, self.v = number_called("q")(q), number_called("v")(v)

    _units = units(q="m, m, rad", v="m/s, m/s, rad/s")

    def _table(self) -> PrintedTable:
        if np.ndim(self.q) == 2 and np.shape(self.q)[1] == 3:
            return poses_table("state", (), self.q, self.v)
        return fields_table(self, self._units if np.ndim(self.q) > 2 else {}, f"states {np.shape(self.q)}")


class AssemblyError(ValueError):
    """A mechanism cannot be closed, or its drivers ask for an impossible motion.

    Attributes:
        message: the joints that stay open.
        state: the best `State` found.
    """

    def __init__(self, message: str, state: State):
        super().__init__(message)
        self.state = state


class Closure(NamedTuple):
    """An assembled state, its residuals Psi (m, rad) and Psi_dot (m/s, rad/s) by row, and the rank of D."""

    state: State
    psi: Float[Array, "m"]
    psi_dot: Float[Array, "m"]
    rank: Int[Array, ""]
    scales: Scales
    is_closed: Bool[Array, ""]  # whether the residuals are within `CLOSURE.tol` of the scene's scales, or rounding


@checks_instances(State)
def _check_state(name: str, value: State, given: GivenArguments) -> None:
    for part in ("q", "v"):
        require_coordinates(f"{name}.{part}", getattr(value, part), given, flat=False)
    shapes = np.shape(value.q), np.shape(value.v)
    if shapes[0] != shapes[1]:
        raise ArgumentError(f"{name}.v must have the shape of {name}.q, {shapes[0]}; it has the shape {shapes[1]}")


@checks_instances(Closure)
def _check_closure(name: str, value: Closure, given: GivenArguments) -> None:
    _check_state(name, value.state, given)


@checked
def assemble(
    mechanism: Mechanism | ConstrainedSystem,
    t: NumberLike = 0.0,
    state: State | None = None,
    throw: bool = True,
    analysis: Analysis | None = None,
    given: GivenValues | None = None,
) -> State:
    """Return a state with Psi(t, q) = 0 and Psi_dot(t, q, v) = 0, near a given one.

    A state that satisfies all constraints is returned unchanged, up to rounding. The result has first and second derivatives with
    respect to every number of the mechanism and of the guess, even with redundant constraints.

    Args:
        mechanism: the mechanism, or a `ConstrainedSystem`, which has first derivatives only.
        t: time (s).
        state: the state to start from; by default the initial guess of the bodies, or q0 and v0 of the system.
        throw: whether a mechanism that cannot be closed raises; with False, or where numbers are traced, the best state found is
            returned instead.
        analysis: the mechanism's `Analysis`; by default computed here.
        given: values that the state must have, by name; everything else follows from the constraints, near the state to start
            from. Of a mechanism coordinates (`body.link1.angle`, `joint.A.angle`, in rad or m) and velocities
            (`body.link1.omega`, `joint.A.omega`, `pin.A.vx`); of a `ConstrainedSystem` `q[0]` and `v[0]`. They may be traced.

    Returns:
        A `State`: q and v (bodies, 3): x, y in m and angle in rad, and their rates.

    Raises:
        AssemblyError: joints stay open, or given values contradict them or each other; it names them and carries the best state
            found.
        ArgumentError: a given name is unknown.
    """
    if given is not None:
        return _assemble_given(mechanism, t, state, throw, GivenState(mechanism, given))
    closure = close(mechanism, t, state, analysis=analysis)
    if throw:
        require_closed(mechanism, closure, t, state)
    return closure.state


def _assemble_given(
    mechanism: Mechanism | ConstrainedSystem, t: NumberLike, state: State | None, throw: bool, given: GivenState
) -> State:
    """Return the state that `assemble` returns with given values: its position is closed first, then its velocity."""
    if state is None and mechanism.q0 is not None and mechanism.v0 is not None:
        state = State(mechanism.q0, mechanism.v0)
    try:
        closed = assemble(given.at_position(), t, state, throw)
        moving = State(closed.q, closed.v if state is None else state.v)
        return assemble(given.at_velocity(t, closed.q), t, moving, throw)
    except AssemblyError as error:
        raise AssemblyError(f"with {given} given: {error}", error.state) from None


def _close_system(system: ConstrainedSystem, t: NumberLike, state: State | None = None) -> Closure:
    """Close a user-defined system as `close` does, from a given state or the guess q0, v0 of the system.

    Raises:
        ValueError: there is neither a state nor a guess.
    """
    if state is None and system.q0 is None:
        raise ValueError("a ConstrainedSystem without q0 has no initial guess: give a state near a closed one, State(q, v)")
    q, v = (system.q0, system.v0) if state is None else (state.q, state.v)
    given = (jnp.asarray(x, jnp.result_type(float)) for x in (t, q, v))
    q, v, psi, rates, rank, scales = close_system(system.traced(np.size(q)), *given)
    sizes = jnp.stack([jnp.max(jnp.abs(x), initial=0.0) for x in (psi, rates)])
    tol = max(CLOSURE.tol, ROUNDING / np.finfo(float).eps * float(jnp.finfo(q.dtype).eps))
    closed = jnp.max(sizes) <= tol * jnp.maximum(1.0, jnp.max(jnp.abs(v), initial=0.0))
    return Closure(State(q, v), psi, rates, rank, scales, closed)


def close(
    mechanism: Mechanism | ConstrainedSystem,
    t: NumberLike = 0.0,
    state: State | None = None,
    analysis: Analysis | None = None,
) -> Closure:
    """Return the state to which `assemble` closes a mechanism, with its residuals; no error is raised if it stays open.

    The closure of concrete numbers of a mechanism is concrete, even while something else is traced.
    """
    if not isinstance(mechanism, Mechanism):
        return _close_system(mechanism, t, state)
    if not mechanism.is_concrete or is_traced((t, state)):
        state = _with_closed_positions(mechanism, t, state)
        analysis = analyse(mechanism) if analysis is None else analysis
        compiled = _close if is_within_jit() else _close_compiled  # under jit concrete numbers become tracers, too
        moment = mechanism.without_origin.at(t)
        if isinstance(t, Tracer) and not has_rheonomic_joints(moment):
            moment, t = from_moment(moment, t), 0.0
        return compiled(moment, analysis, t, state)
    if analysis is not None and isinstance(analysis.scales.length, Tracer):
        analysis = None  # a traced analysis cannot be cached
    return _closure_of_concrete(mechanism, np.asarray(t).item(), state, analysis)


def _with_closed_positions(mechanism: Mechanism, t: NumberLike, state: State | None) -> State | None:
    """Return the guess with its positions closed for all joints except rolling ones; `state` if there are no rolling joints."""
    if not (names := rolling_joints(mechanism)):
        return state
    positions = close(mechanism.without_joints(names), t, state).state.q
    return State(positions, mechanism.v0 if state is None else state.v)


@cached_by_identity  # a second run of a mechanism reuses its closure
def _closure_of_concrete(mechanism: Mechanism, t: float, state: State | None, analysis: Analysis | None) -> Closure:
    with jax.ensure_compile_time_eval():
        state = _with_closed_positions(mechanism, t, state)
        scales = (analyse(mechanism) if analysis is None else analysis).scales
        guess = (mechanism.q0, mechanism.v0) if state is None else (state.q, state.v)
        q, v = (np.asarray(x, float).ravel() for x in guess)
        with np.errstate(all="ignore"):  # non-finite states are reported as open
            q, v, psi, psi_dot, rank = _close_concrete(mechanism, scales, t, q, v)
            closed = is_closed(jax.tree.map(np.asarray, scales), q, v, psi, psi_dot, np)
        dtype = float_type()
        floats = [np.array(x, dtype) for x in (q.reshape(-1, 3), v.reshape(-1, 3), psi, psi_dot)]
        q, v, psi, psi_dot, rank, closed = put_arrays([*floats, np.asarray(rank), np.asarray(closed)])
        return Closure(make_module(State, q=q, v=v), psi, psi_dot, rank, scales, closed)


def _close_concrete(mechanism: Mechanism, scales: Scales, t: float, q: np.ndarray, v: np.ndarray) -> tuple:
    """Return q and v of the closed state near a guess, the residuals Psi and Psi_dot, and the rank of D, of concrete numbers."""
    if scene_programs(mechanism).is_small:  # compiling anything takes longer
        return DenseRows(mechanism, scales).assemble(t, q, v)
    if native_closing.can_close(mechanism):
        return native_closing.close_concrete(mechanism.at(t), scales, t, q, v)
    from udkjax.equations.rows.sparse_rows import SparseRows  # imports SciPy, which small scenes need not

    return SparseRows(mechanism).assemble(t, q, v)


def _close(mechanism: Mechanism, analysis: Analysis, t: NumberLike, state: State | None) -> Closure:
    guess = State(mechanism.q0, mechanism.v0) if state is None else state
    q, v = number(guess.q).ravel(), number(guess.v).ravel()
    close = close_by_machine_code if native_closing.can_close(mechanism) else close_by_jax
    q, v, psi, psi_dot, rank = close(mechanism, analysis, number(t), q, v)
    q, v = whole(q, v)
    closed = is_closed(analysis.scales, q, v, psi, psi_dot, jnp)
    return Closure(State(q.reshape(-1, 3), v.reshape(-1, 3)), psi, psi_dot, jnp.asarray(rank), analysis.scales, closed)


_close_compiled = deferred(defined(_close))


def require_closed(
    mechanism: Mechanism | ConstrainedSystem, closure: Closure, t: NumberLike = 0.0, guess: State | None = None
) -> None:
    """Raise an `AssemblyError` if the closure of a guess at time t (s) is not closed; traced values are not checked."""
    closed = closure.is_closed
    if isinstance(closed, Tracer) or closed:
        return
    mechanism, closure, t, guess = without_derivatives((mechanism, closure, t, guess))
    if is_traced((mechanism, closure, t, guess)):  # other numbers of a batch
        return
    if not isinstance(mechanism, Mechanism):
        q, v = (mechanism.q0, mechanism.v0) if guess is None else (guess.q, guess.v)
        if q is not None and v is not None and (cause := mechanism.cause_at(t, q, v)):
            raise AssemblyError(cause, closure.state)
        worst = [float(jnp.max(jnp.abs(x), initial=0.0)) for x in (closure.psi, closure.psi_dot)]
        message = f"the constraints stay violated, Psi by {worst[0]:.3g} and velocities by {worst[1]:.3g}"
        raise AssemblyError(f"{message}: start nearer to a state that satisfies them", closure.state)
    mechanism.with_parameters({})  # numbers changed as leaves of a tree have not been checked: raises an error that names them
    names = [name for name, _ in analyse(mechanism).row_names]
    psi, psi_dot, rows = (np.asarray(x) for x in (closure.psi, closure.psi_dot, closure.scales.rows))
    q = np.asarray(mechanism.q0 if guess is None else guess.q).ravel()
    raise AssemblyError(explain_open(mechanism, np.asarray(t).item(), q, names, psi, psi_dot, rows), closure.state)


# Fraction of a body's size. Gaps from rough drawings or from numbers of three digits are smaller; larger moves may come from a
# mistyped number, and are reported.
WORTH_SAYING = 0.01


class AssemblyWarning(UserWarning):
    """Assembly moved a body by more than a hundredth of its size from its initial guess."""


def moves_of_assembly(mechanism: Mechanism, q: Float[Array, "bodies 3"]) -> tuple[str, ...]:
    """Return a sentence for each body that assembly, with the result q, has moved by more than `WORTH_SAYING` of its size."""
    change = np.asarray(q) - np.asarray(mechanism.q0)
    distance, angle = np.hypot(change[:, 0], change[:, 1]), np.abs(change[:, 2])
    if not np.any(change):
        return ()
    return tuple(_moves(mechanism, distance, angle))


def _moves(mechanism: Mechanism, distances: np.ndarray, angles: np.ndarray) -> Iterator[str]:
    sizes = body_sizes(mechanism)
    for name, distance, angle in zip(mechanism.body_names, distances, angles, strict=True):
        if distance + angle * sizes[name] > WORTH_SAYING * sizes[name]:
            parts = {f"{distance:.2g} m": distance, f"{np.degrees(angle):.2g} deg": angle * sizes[name]}
            amount = " and ".join(text for text, part in parts.items() if part > ROUNDING * sizes[name])
            yield f"assembly moved {name} by {amount}"


def moves_from_guess(mechanism: Mechanism, t: Array | np.ndarray, closure: Any) -> str:
    """Return a warning if assembly at time t (s) moved a body far from its initial guess, else "".

    The result is also "" if t is traced, if the closure is not closed, and if drivers may have moved the bodies before t. Other
    numbers are concrete.
    """
    if isinstance(t, Tracer) or (t and mechanism.drivers) or not closure.is_closed:
        return ""  # later the drivers decide where the bodies are
    moves = moves_of_assembly(mechanism, closure.state.q)
    cure = "if you did not intend this, a number of these bodies or of their joints is wrong; see udk.check"
    return f"{'; '.join(moves)}: {cure}" if moves else ""


def poses_table(title: str, names: Sequence[str], q: ArrayLike, v: ArrayLike | None = None) -> PrintedTable:
    """Return a table of coordinates q and, if given, velocities v (bodies, 3); if `names` is empty, bodies are numbered."""
    arrays = [np.asarray(x, float) for x in ((q,) if v is None else (q, v))]
    heads = ["body", "x (m)", "y (m)", "angle (rad)", "vx (m/s)", "vy (m/s)", "omega (rad/s)"][: 1 + 3 * len(arrays)]
    scales = [scale for x in arrays for scale in (size_of(x), size_of(x), float(np.nanmax(np.abs(x[..., 2]), initial=0.0)))]
    rows = [
        [names[k] if names else str(k), *map(format_number, np.concatenate([x[k] for x in arrays]), [""] * len(scales), scales)]
        for k in range(len(arrays[0]))
    ]
    return PrintedTable(title, rows, heads)
