"""Loads of joints on their bodies, -Psi_q^T lambda: in chosen axes, about a chosen point, with a chosen rule for sharing.

With redundant constraints, equilibrium determines only some components (determinacy.py). Other components require an assumption:
by default the least norm, each row in units of its scale; or the least elastic energy (compliance.py).
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.annotations import Number, NumberLike
from udkjax.argument_types import ARRAYS_BY_NAME, HISTORY, NOT_NEGATIVE
from udkjax.arrays import ArrayLibrary, array_namespace, put_arrays
from udkjax.equations.friction.compliance import compliance_rows
from udkjax.equations.laws.abstract_system import HistoryLike, times_of
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.rows.determinacy import STATIC_RANK_TOL, UNIQUE_TOL, left_null_space
from udkjax.equations.states.scene_changes import SceneAlong, scene_along
from udkjax.equations.states.state_arrays import StateArrays, StateArraysOverTime, by_numpy, history_of, state_arrays
from udkjax.equations.states.textbook import prepare
from udkjax.equations.systems.general import ConstrainedSystem, prepare_general
from udkjax.equations.terms.constraints import psi_q
from udkjax.pinv import SVD, Pseudoinverse
from udkjax.programs.control_flow import by_numpy_arrays
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import at_each
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME, Frame, Point, between
from udkjax.scene.elements.drivers import Driver
from udkjax.scene.elements.joints import Constraint, Distance
from udkjax.scene.elements.rolling import RollingJoint
from udkjax.scene.mechanism import Mechanism

Axes = Literal["ground", "body", "joint"]
About = Literal["centre", "joint"]
ByBody = dict[str, dict[str, Array]]  # by joint or driver, then by body


@checked
def reactions(
    mechanism: Mechanism | ConstrainedSystem,
    solution: Annotated[HistoryLike, HISTORY],
    method: Pseudoinverse | None = None,
    stabilization: Baumgarte | None = None,
    frame: Axes = "ground",
    about: About = "centre",
    compliances: Annotated[Mapping[str, NumberLike], ARRAYS_BY_NAME] | None = None,
) -> dict[str, dict[str, Float[Array, "T 3"]]]:
    """Return the load -Psi_q^T lambda of each joint and driver on each of its bodies: `reactions(mech, sol)["A"]["link1"]`.

    Args:
        mechanism: the mechanism, or a `ConstrainedSystem`.
        solution: anything with ts (T,), q and v (T, bodies, 3). Along a `Kinematics` over the values of a driver, this driver
            has its rate and acceleration, all others are at rest, and time is zero.
        method: the pseudoinverse; by default `SVD`.
        stabilization: the run's `Baumgarte`, to include its terms.
        frame: the axes of the force. "ground"; "body": those of the loaded body; "joint": x along the `axis` of a joint, or
            of a driver of x or y, or along the line of a distance; for all others the axes of the last body of the joint.
        about: the reference point of the torque: the "centre" of mass, or the "joint": the pin that two bodies share (in a slot
            or prismatic joint the point of body 2), each body's own point for a distance; without points the centre of mass.
        compliances: compliances by joint name, one for each row (m/N for rows in metres, rad/(N m) for rows in radians), or one
            for both rows of a revolute. Redundant forces are shared with the least elastic energy; all other joints are rigid.
            Friction follows the shared loads, also if it then gives other accelerations than a run, which shares by least norm.

    Returns:
        The load (T, 3): force x, force y (N) and torque (N m), -Psi_q^T lambda of the constraint's rows. With redundant
        constraints only the components marked by `unique_reactions` are determined. The force of friction is not included: see
        `friction_loads`. If events of a `Solution` change the scene, the loads are those of the constraints that hold, contacts
        ("floor.contact") and joints that events add among them, zero for all others, and NaN if they are not known. Of a
        `ConstrainedSystem`: for "constraint" and "velocity_constraint" the "load" -A^T lambda on its coordinates (T, n), and the
        "multipliers" lambda (T, m) of its rows A.

    Raises:
        ValueError: a compliance is negative or belongs to an unknown joint, or a joint has the wrong number of compliances.
    """
    mechanism.require_masses("reactions")
    if isinstance(mechanism, ConstrainedSystem):
        if compliances is not None or (frame, about) != ("ground", "centre"):
            raise ValueError("the coordinates of a ConstrainedSystem have no frame: leave out frame, about and compliances")
        states = _states(solution)
        return _loads_of_rows(mechanism.traced(states[1].shape[-1]), *states, SVD() if method is None else method, stabilization)
    scene, method = scene_along(mechanism, solution), SVD() if method is None else method
    stabilization = scene.gains(stabilization)
    soft = None if compliances is None else compliance_rows(scene.mechanism, compliances)
    given = scene.ts, solution.q, solution.v, scene.analysis, stabilization
    if soft is None and scene.knowledge.is_constant and by_numpy(scene.mechanism, given, method):
        loads = _loads_by_numpy(*scene[:2], history_of(solution), method, stabilization, frame=frame, about=about)
    else:
        loads = _loads(*scene[:3], *_states(solution), method, stabilization, soft, frame, about)
    return _name_by_body(scene, loads, jnp.add)


@checked
def unique_reactions(
    mechanism: Mechanism,
    solution: Annotated[HistoryLike, HISTORY],
    frame: Axes = "ground",
    about: About = "centre",
    rank_tol: Annotated[NumberLike, NOT_NEGATIVE] = STATIC_RANK_TOL,
) -> dict[str, dict[str, Bool[Array, "T 3"]]]:
    """Mark the components of `reactions` that equilibrium determines, c^T lambda with c^T N = 0.

    N spans the null space of Psi_q^T: these components do not depend on how redundant forces are shared.

    Args:
        mechanism: The scene.
        solution: Times and states: anything with ts (T,), q and v (T, bodies, 3).
        frame: The axes of the force, as in `reactions`.
        about: The point of the torque, as in `reactions`.
        rank_tol: Singular values up to this fraction of the largest count as zero, as in `uniqueness`.

    Returns:
        For each joint and driver, and each of its bodies, booleans (T, 3) for force x, force y and torque.
    """
    scene = scene_along(mechanism, solution)
    given = scene.ts, solution.q, scene.analysis, rank_tol
    if scene.knowledge.is_constant and by_numpy(scene.mechanism, given):
        marks = _uniqueness_by_numpy(*scene[:2], history_of(solution)[:2], rank_tol, frame, about)
    else:
        marks = _uniqueness_of_loads(*scene[:3], *_states(solution)[:2], jnp.asarray(rank_tol), frame, about)
    return _name_by_body(scene, marks, jnp.logical_and)


@deferred
def _loads_of_rows(system: Any, ts: Array, q: Array, v: Array, method: Pseudoinverse, baumgarte: Baumgarte | None) -> ByBody:
    equations = prepare_general(system, method, baumgarte)
    loads, multipliers = at_each(lambda x, *at: (x.loads(*at), x.multipliers(*at)), equations, ts, q, v)
    m = 0 if system.constraint is None else int(np.prod(jax.eval_shape(system.constraint, ts[0], q[0]).shape))
    named = {"constraint": (loads[:, 0], multipliers[:, :m]), "velocity_constraint": (loads[:, 1], multipliers[:, m:])}
    return {
        name: {"load": load, "multipliers": rows} for name, (load, rows) in named.items() if getattr(system, name) is not None
    }


def _name_by_body(scene: SceneAlong, values: list[list[Array]], join: Callable[[Array, Array], Array]) -> ByBody:
    """Return `values`, listed by constraint and by body, as dictionaries by name; under `jit` these would lose their order.

    The values of constraints with one public name, which hold one after another, are joined.
    """
    constraints, found = scene.mechanism.constraints, {}
    bodies = {name: [b for b in dict.fromkeys(scene.mechanism.frames_of(x)) if b != GROUND] for name, x in constraints.items()}
    by_constraint = {name: dict(zip(bodies[name], x, strict=True)) for name, x in zip(bodies, values, strict=True)}
    if scene.names is None:
        return by_constraint
    for public, names in scene.names.items():
        found[public] = dict(by_constraint[names[0]])
        for name in names[1:]:
            for body, value in by_constraint[name].items():
                found[public][body] = join(found[public][body], value) if body in found[public] else value
    return found


def _split_by_body(
    mechanism: Mechanism,
    row_names: list[str],
    q: Any,
    by_row: Any,
    total: Callable[[Any], Any],
    frame: Axes,
    about: About,
) -> ByBody:
    """Return the loads of joints on bodies, in the chosen axes and about the chosen point, from the loads of rows (T, m, n).

    `total` converts the loads of a joint's rows on a body, (rows, T, 3), before axes and point are chosen.
    """
    body_index = {name: k for k, name in enumerate(mechanism.body_names)}
    body_frames = {name: _frame(q, index) for name, index in body_index.items()} | {GROUND: GROUND_FRAME}
    result: ByBody = {}
    xp, rows_of = array_namespace(q), _rows_by_owner(row_names)
    for name, element in mechanism.constraints.items():
        rows = np.array(rows_of[name])
        bodies = mechanism.frames_of(element)
        frames = [body_frames[body] for body in bodies]
        axes = _joint_angle(element, frames) if frame == "joint" else 0.0
        result[name] = {}
        for k, body in enumerate(bodies):
            if body == GROUND:
                continue
            load = total(xp.moveaxis(by_row[:, rows, 3 * body_index[body] : 3 * body_index[body] + 3], 1, 0))
            point = _joint_point(element, k, frames) if about == "joint" else None
            angle = frames[k].angle if frame == "body" else axes
            result[name][body] = load if point is None and frame == "ground" else _transform_load(load, frames[k], point, angle)
    return result


def _rows_by_owner(row_names: list[str]) -> dict[str, list[int]]:
    """Return the indices of the rows of each constraint, from the constraint of each row."""
    rows: dict[str, list[int]] = {}
    for k, owner in enumerate(row_names):
        rows.setdefault(owner, []).append(k)
    return rows


def _transform_load(load: Float[Array, "... 3"], body: Frame, point: Point | None, angle: Number) -> Float[Array, "... 3"]:
    """Transform a load about a centre of mass in ground axes to another point and to axes at an `angle` (rad)."""
    fx, fy, torque = load[..., 0], load[..., 1], load[..., 2]
    if point is not None:
        torque = torque - (point.x - body.x) * fy + (point.y - body.y) * fx
    xp = array_namespace(load, angle)
    cos, sin = xp.cos(angle), xp.sin(angle)
    return xp.stack([cos * fx + sin * fy, cos * fy - sin * fx, torque], axis=-1)


def _frame(q: Float[Array, "T n"], body: int) -> Frame:
    xp, (x, y, angle) = array_namespace(q), (q[:, 3 * body + k] for k in range(3))
    return Frame(x, y, angle, xp.cos(angle), xp.sin(angle))


def _joint_angle(element: Constraint, frames: list[Frame]) -> Number:
    """Return the angle (rad) of a joint's own axes relative to the ground."""
    if isinstance(element, Driver) and element.coordinate in ("x", "y"):
        return frames[0].angle if element.axis is None else frames[0].angle + element.axis
    if not isinstance(element, Driver) and getattr(element, "axis", None) is not None:  # of a user-defined joint, too
        holder = frames[1] if isinstance(element, RollingJoint) else frames[0]
        return holder.angle + element.axis  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(element, Distance) or (isinstance(element, Driver) and element.coordinate == "distance"):
        line = between(element.points, *frames)
        return array_namespace(line.x).arctan2(line.y, line.x)
    return frames[-1].angle


def _joint_point(element: Constraint, k: int, frames: list[Frame]) -> Point | None:
    """Return the point at which a joint acts on its body k, in ground coordinates; None if it has no points."""
    points = getattr(element, "points", None)
    if points is None or (isinstance(element, Driver) and element.coordinate == "angle"):
        return None
    has_two_points = isinstance(element, Distance) or (isinstance(element, Driver) and element.coordinate == "distance")
    holder = k if has_two_points else len(points) - 1  # for a slot, the pin
    return frames[holder].point(points[holder])


def _states(solution: HistoryLike) -> tuple[Array, Array, Array]:
    ts = jnp.asarray(times_of(solution))
    return ts, jnp.asarray(solution.q).reshape(len(ts), -1), jnp.asarray(solution.v).reshape(len(ts), -1)


@deferred
def _loads(mechanism, analysis, knowledge, ts, q, v, method, baumgarte, soft, frame, about):
    """Return lists of the loads -Psi_q^T lambda (T, 3) on the bodies of each constraint."""
    equations = prepare(mechanism, method, baumgarte, analysis).with_compliances(soft)

    def row_loads(equations, t, q, v, known):
        equations = equations.known(known)
        return -equations.jacobian(t, q) * equations.multipliers(t, q, v)[:, None]

    by_row = at_each(row_loads, equations, ts, q, v, knowledge.states(mechanism))
    rows = [name for name, _ in analysis.row_names]
    by_body = _split_by_body(mechanism, rows, q, by_row, lambda load: load.sum(0), frame, about)
    return [list(loads.values()) for loads in by_body.values()]


def _is_unique(coefficients: Any, N: Any, unit: Any, xp: ArrayLibrary) -> Any:
    """Return True where c^T N = 0, for coefficients c (rows, T, 3) of three components, and the rows (T, rows, m) of N.

    `unit` are the units of the components: a torque over the length is a force.
    """
    size = xp.max(xp.linalg.norm(coefficients, axis=0) / unit, axis=-1, keepdims=True)
    return xp.linalg.norm(xp.einsum("rtc,trk->tck", coefficients, N), axis=-1) <= UNIQUE_TOL * unit * size


@deferred
def _uniqueness_of_loads(mechanism, analysis, knowledge, ts, q, rank_tol, frame, about):
    """Return lists as `_loads` does, with marks (T, 3) of the components that equilibrium determines."""

    def terms(t, q, known):
        scene = known.put_in(mechanism)
        return psi_q(scene, t, q), left_null_space(scene, t, q, analysis, rank_tol).basis

    Psi_q, N = jax.vmap(terms)(ts, q, known := knowledge.states(mechanism))
    rows = [name for name, _ in analysis.row_names]
    unit = jnp.stack([1.0, 1.0, analysis.length])
    unique, rows_of = partial(_is_unique, unit=unit, xp=jnp), _rows_by_owner(rows)
    by_body = _split_by_body(mechanism, rows, q, Psi_q / analysis.row_units[:, None], lambda c: c, frame, about)
    is_known = jnp.ones((len(ts), 1), bool) if known.unknown is None else ~known.unknown[:, None]
    return [
        [unique(coefficients, N[:, np.array(rows_of[name])]) & is_known for coefficients in loads.values()]
        for name, loads in by_body.items()
    ]


# --- by NumPy, in pieces


def _loads_by_numpy(
    mechanism: Mechanism, analysis: Analysis, history: StateArraysOverTime, *choices: Any, frame: Axes, about: About
) -> list[list[Array]]:
    """Return the results of `_loads` by NumPy, for concrete numbers."""
    arrays, rows = state_arrays(mechanism), [name for name, _ in analysis.row_names]

    def of_piece(ts: np.ndarray, q: np.ndarray, v: np.ndarray) -> ByBody:
        found = arrays.solve(ts, q, v, analysis, *choices)
        by_row = -arrays.dense(found.entries) * found.multipliers[:, :, None]
        return _split_by_body(numbers, rows, q, by_row, lambda load: load.sum(0), frame, about)

    numbers = by_numpy_arrays(mechanism)
    return _joined(arrays, history, of_piece)


def _uniqueness_by_numpy(
    mechanism: Mechanism, analysis: Analysis, history: tuple[np.ndarray, np.ndarray], rank_tol: Any, frame: Axes, about: About
) -> list[list[Array]]:
    """Return the results of `_uniqueness_of_loads` by NumPy, for concrete numbers."""
    arrays, rows = state_arrays(mechanism), [name for name, _ in analysis.row_names]
    rows_of, scales = _rows_by_owner(rows), np.asarray(analysis.row_units)
    unit = np.stack([1.0, 1.0, float(analysis.length)])

    def of_piece(ts: np.ndarray, q: np.ndarray) -> ByBody:
        N, _ = arrays.left_null_space(ts, q, analysis, float(rank_tol))
        by_row = arrays.jacobian(ts, q) / scales[:, None]
        by_body = _split_by_body(numbers, rows, q, by_row, lambda c: c, frame, about)
        return {
            name: {body: _is_unique(c, N[:, rows_of[name]], unit, np) for body, c in loads.items()}
            for name, loads in by_body.items()
        }

    numbers = by_numpy_arrays(mechanism)
    return _joined(arrays, history, of_piece)


def _joined(arrays: StateArrays, history: tuple[np.ndarray, ...], of_piece: Callable[..., ByBody]) -> list[list[Array]]:
    """Return a quantity of each constraint and body along a history, evaluated in pieces, as lists by constraint and body."""
    pieces = [of_piece(*(x[p] for x in history)) for p in arrays.pieces(len(history[0]))]
    return put_arrays(
        [[np.concatenate([piece[name][body] for piece in pieces]) for body in loads] for name, loads in pieces[0].items()]
    )
