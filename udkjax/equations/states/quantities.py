"""Quantities of a motion: accelerations, multipliers, energies and violations of the constraints."""

from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from udkjax.annotations import NumberLike, Vector
from udkjax.argument_types import COORDINATES_OF_BODIES, HISTORY
from udkjax.equations.laws.abstract_system import AbstractSystem, ConstrainedRows, HistoryLike, times_of
from udkjax.equations.laws.formulations import Formulation
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.rows.analysis import Analysis, analysis_of
from udkjax.equations.states.scene_changes import SceneChanges, scene_along
from udkjax.equations.states.state_arrays import by_numpy, history_of, state_arrays
from udkjax.equations.states.textbook import TextbookEquations, prepare
from udkjax.equations.systems.general import ConstrainedSystem, prepare_general
from udkjax.pinv import SVD, Pseudoinverse
from udkjax.printing import prints_table, units
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import at_each, defined
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.model import Model, RunModel

Result = TypeVar("Result")


@prints_table
class Energy(NamedTuple):
    """Energies (J) at each time; the potential energy is that of gravity, zero at the origin, and of force elements."""

    kinetic: Float[Array, "T"]
    potential: Float[Array, "T"]

    _units = units(kinetic="J", potential="J")

    @property
    def total(self) -> Float[Array, "T"]:
        return self.kinetic + self.potential


@overload
def equations_of(
    system: Mechanism, method: Any = None, baumgarte: Any = None, *, analysis: Analysis | None = None
) -> TextbookEquations: ...


@overload
def equations_of(
    system: RunModel, method: Any = None, baumgarte: Any = None, formulation: Any = None, analysis: Analysis | None = None
) -> AbstractSystem: ...


def equations_of(
    system: RunModel,
    method: Pseudoinverse | None = None,
    baumgarte: Baumgarte | None = None,
    formulation: Formulation | None = None,
    analysis: Analysis | None = None,
) -> AbstractSystem:
    """Prepare the equations of motion of a mechanism or a system, by the Udwadia-Kalaba equation or another formulation.

    Args:
        system: The mechanism, or the `ConstrainedSystem`.
        method: The pseudoinverse; by default `Auto`.
        baumgarte: Gains of Baumgarte stabilization; None: no stabilization.
        formulation: Another formulation; None: the Udwadia-Kalaba equation.
        analysis: The mechanism's `Analysis`; by default computed here.

    Returns:
        The equations, ready to be evaluated at states (n,).
    """
    if isinstance(system, Mechanism):
        equations: AbstractSystem = prepare(system, method, baumgarte, analysis)
    else:
        equations = prepare_general(system, method, baumgarte)
    return equations if formulation is None else formulation.formulate(equations)


@overload
def accelerations(
    mechanism: Mechanism | ConstrainedSystem,
    t: NumberLike,
    q: Float[ArrayLike, "bodies 3"],
    v: Float[ArrayLike, "bodies 3"],
    method: Pseudoinverse | None = None,
    stabilization: Baumgarte | None = None,
    multipliers: Literal[False] = False,
    formulation: Formulation | None = None,
    analysis: Analysis | None = None,
) -> Float[Array, "bodies 3"]: ...


@overload
def accelerations(
    mechanism: Mechanism | ConstrainedSystem,
    t: NumberLike,
    q: Float[ArrayLike, "bodies 3"],
    v: Float[ArrayLike, "bodies 3"],
    method: Pseudoinverse | None = None,
    stabilization: Baumgarte | None = None,
    *,
    multipliers: Literal[True],
    formulation: Formulation | None = None,
    analysis: Analysis | None = None,
) -> tuple[Float[Array, "bodies 3"], Float[Array, "m"]]: ...


@checked
def accelerations(
    mechanism: Mechanism | ConstrainedSystem,
    t: NumberLike,
    q: Annotated[Float[ArrayLike, "bodies 3"], COORDINATES_OF_BODIES],
    v: Annotated[Float[ArrayLike, "bodies 3"], COORDINATES_OF_BODIES],
    method: Pseudoinverse | None = None,
    stabilization: Baumgarte | None = None,
    multipliers: bool = False,
    formulation: Formulation | None = None,
    analysis: Analysis | None = None,
) -> Float[Array, "bodies 3"] | tuple[Float[Array, "bodies 3"], Float[Array, "m"]]:
    """Return a = a_F + M^(-1/2) D^+ b, and on request lambda = -(D^+)^T D^+ b. The state need not be closed.

    A joint with set-valued friction whose speed is zero, up to 1e-9 of the scene's own speeds, sticks if the law allows it: its
    friction is the force that holds it. Else it begins to slide.

    Args:
        mechanism: The mechanism, or a `ConstrainedSystem`.
        t: Time (s).
        q: Coordinates (m, rad), (bodies, 3); for a `ConstrainedSystem`, q, v and a are (n,).
        v: Velocities (m/s, rad/s), in the shape of q.
        method: The pseudoinverse; by default `Auto`, which is `SVD` here.
        stabilization: `Baumgarte`, or None.
        multipliers: Whether to return lambda as well.
        formulation: Another formulation, which computes a but not lambda; None: the Udwadia-Kalaba equation.
        analysis: The mechanism's `Analysis`; by default computed here.

    Returns:
        a (m/s^2, rad/s^2) in the shape of q; with `multipliers` also lambda (m,) in N and N m, in the order of the rows, with
        the sign of M a + Psi_q^T lambda = F, and of minimum norm where constraints are redundant.
    """
    mechanism.require_masses("accelerations")
    analysis, model = analysis_of(mechanism) if analysis is None else analysis, mechanism.without_origin
    if analysis is not None and formulation is None and by_numpy(model, (t, q, v, analysis, stabilization), method):
        one_q, one_v = (np.reshape(np.asarray(x, float), (1, -1)) for x in (q, v))
        found = state_arrays(model).solve(np.reshape(np.asarray(t, float), 1), one_q, one_v, analysis, method, stabilization)
        a = found.a.reshape(np.shape(q))
        return jax.device_put((a, found.multipliers[0]) if multipliers else a)
    t, q, v = (jnp.asarray(x, jnp.result_type(float)) for x in (t, q, v))
    return _accelerations(model.traced(q.size), analysis, t, q, v, method, stabilization, formulation, multipliers)


@checked
def violation(mechanism: Mechanism | ConstrainedSystem, solution: Annotated[HistoryLike, HISTORY]) -> Float[Array, "T m"]:
    """Return Psi at each time of a solution.

    Args:
        mechanism: The mechanism, or a `ConstrainedSystem`.
        solution: Times and states: anything with ts (T,), q and v (T, bodies, 3).

    Returns:
        Psi (T, m), in m or rad: the rows of the joints in their order, then those of the drivers. For a `ConstrainedSystem` the
        rows of Psi, then those of phi. Rows of a constraint are zero while events of a `Solution` have released it. Along a
        `Kinematics` over the values of a driver, its row is the coordinate minus the value, and the rows of all other drivers
        are the changes of their coordinates, which they hold.
    """
    changes: SceneChanges | None = getattr(solution, "scene_changes", None)
    driver: str | None = getattr(solution, "values_of", None)
    if by_numpy(mechanism, (solution.ts, solution.q)):
        ts, q = history_of(solution)[:2]
        psi = jax.device_put(state_arrays(mechanism.without_origin).psi(ts, q))
    else:
        psi = _evaluate_along(mechanism, solution, _residuals)
    if driver is not None and mechanism.has_bodies:
        return _over_values(mechanism, psi, driver, solution.ts)
    return psi if changes is None else jnp.where(changes.rows_that_hold(mechanism), psi, 0.0)


def _over_values(mechanism: Any, psi: Float[Array, "T m"], driver: str, values: Any) -> Float[Array, "T m"]:
    """Convert Psi with all drivers at time 0 to Psi along the values of one driver.

    The rows of all other drivers are relative to the first position that is finite.
    """
    names = mechanism.driver_names
    if not names:
        return psi
    rows = psi[:, -len(names) :]
    change = rows - rows[jnp.argmax(jnp.isfinite(rows).all(1))]
    if driver in names:
        k = names.index(driver)
        change = change.at[:, k].set(rows[:, k] + mechanism.drivers[driver].motion(0.0) - values)
    return psi.at[:, -len(names) :].set(change)


@checked
def energy(mechanism: Mechanism | ConstrainedSystem, solution: Annotated[HistoryLike, HISTORY]) -> Energy:
    """Return T = v^T M v / 2 and V at each time of a solution.

    Args:
        mechanism: The mechanism, or a `ConstrainedSystem`, whose V is its potential, zero without one.
        solution: Times and states: anything with ts (T,), q and v (T, bodies, 3).

    Returns:
        The `Energy`, kinetic and potential (T,), in J.
    """
    mechanism.require_masses("energies")
    if by_numpy(mechanism, (solution.ts, solution.q, solution.v)):
        return Energy(*jax.device_put([*state_arrays(mechanism.without_origin).energy(*history_of(solution)).T]))
    return _evaluate_along(mechanism, solution, _energy)


@checked
def efforts(
    mechanism: Mechanism,
    solution: Annotated[HistoryLike, HISTORY],
    method: Pseudoinverse | None = None,
    stabilization: Baumgarte | None = None,
) -> dict[str, Float[Array, "T"]]:
    """Return the effort of each driver, which acts on the driver's second body along the driven coordinate: -lambda of its row.

    Args:
        mechanism: The mechanism.
        solution: Times and states: anything with ts (T,), q and v (T, bodies, 3); a `Kinematics` as for `reactions`.
        method: The pseudoinverse; by default `SVD`. A redundant driver gets its share of the minimum-norm multipliers.
        stabilization: The run's `Baumgarte`, to include its terms.

    Returns:
        By the name of each driver an array (T,): the torque (N m) if it drives an angle, the force (N) if it drives a length; NaN
        where the states are NaN, and zero while an event of a `Solution` has released the driver.
    """
    mechanism.require_masses("efforts")
    if not mechanism.driver_names:
        return {}
    scene, method = scene_along(mechanism, solution), SVD() if method is None else method
    analysis, stabilization = scene.analysis, scene.gains(stabilization)
    given = scene.ts, solution.q, solution.v, analysis, stabilization
    if scene.knowledge.is_constant and by_numpy(scene.mechanism, given, method):
        arrays, (ts, q, v) = state_arrays(scene.mechanism), history_of(solution)
        pieces = [arrays.solve(ts[p], q[p], v[p], analysis, method, stabilization) for p in arrays.pieces(len(ts))]
        multipliers = jax.device_put(np.concatenate([piece.multipliers for piece in pieces]))
    else:
        ts, q, v = (jnp.asarray(x) for x in given[:3])
        multipliers = _multipliers(*scene[:3], ts, q, v, method, stabilization)
    rows = {owner: k for k, (owner, _) in enumerate(analysis.row_names)}
    return {name: -multipliers[:, rows[name]] for name in mechanism.driver_names}


@checked
def friction_loads(
    mechanism: Mechanism,
    solution: Annotated[HistoryLike, HISTORY],
    method: Pseudoinverse | None = None,
    stabilization: Baumgarte | None = None,
) -> dict[str, dict[str, Float[Array, "T 3"]]]:
    """Return the load of each friction on the bodies of its joint: `friction_loads(mech, sol)["rub"]["link1"]`.

    A joint that sticks carries the force that keeps it at rest. With gravity, all other force elements and `reactions`, these
    loads are the mass times the accelerations of a body.

    Args:
        mechanism: The scene.
        solution: Times and states: anything with ts (T,), q and v (T, bodies, 3). A `Solution` tells which joints stick; else
            those do that are at rest, as the law says.
        method: The pseudoinverse; by default `SVD`.
        stabilization: The run's `Baumgarte`, to include its terms.

    Returns:
        For each friction and each body of its joint the load (T, 3) about the centre of mass: force x, force y (N) and torque
        (N m). That of a contact with friction "floor" is named "floor.contact friction".
    """
    mechanism.require_masses("loads of friction")
    scene = scene_along(mechanism, solution)
    frictions = {name: force for name, force in scene.mechanism.forces.items() if isinstance(force, Friction)}
    if not frictions:
        return {}
    ts, q, v = (jnp.asarray(x, float) for x in (scene.ts, solution.q, solution.v))
    by_name = _friction_loads(*scene[:3], ts, q, v, SVD() if method is None else method, scene.gains(stabilization))
    bodies = {
        name: [b for b in dict.fromkeys(scene.mechanism.frames_of(force)) if b != GROUND] for name, force in frictions.items()
    }
    names = mechanism.body_names
    return {name: {b: by_name[name][:, names.index(b)] for b in bodies[name]} for name in frictions}


# Top-level functions, so that compiled programs are reused by later calls.


@deferred
@defined
def _accelerations(mechanism, analysis, t, q, v, method, baumgarte, formulation, multipliers):
    equations, flat = equations_of(mechanism, method, baumgarte, formulation, analysis), (q.ravel(), v.ravel())
    if multipliers and isinstance(equations, TextbookEquations):
        a, found = equations.motion(t, *flat)
        return a.reshape(q.shape), found
    a = equations.accelerations(t, *flat).reshape(q.shape)
    return (a, equations.multipliers(t, *flat)) if multipliers else a


@deferred
def _multipliers(mechanism, analysis, knowledge, ts, q, v, method, baumgarte):
    def of_state(equations, t, q, v, known):
        found = equations.known(known).multipliers(t, q.ravel(), v.ravel())
        return jnp.where(jnp.all(jnp.isfinite(q) & jnp.isfinite(v)), found, jnp.nan)

    return at_each(of_state, prepare(mechanism, method, baumgarte, analysis), ts, q, v, knowledge.states(mechanism))


@deferred
def _friction_loads(mechanism, analysis, knowledge, ts, q, v, method, baumgarte):
    equations = prepare(mechanism, method, baumgarte, analysis)

    def of_state(equations, t, q, v, known):
        found = equations.known(known).friction_loads(t, q.ravel(), v.ravel())
        return {name: load.reshape(q.shape) for name, load in found.items()}

    return at_each(of_state, equations, ts, q, v, knowledge.states(mechanism))


def _residuals(equations: ConstrainedRows, t: Array, q: Vector, v: Vector) -> Array:
    return equations.residuals(t, q, v)


def _energy(equations: ConstrainedRows, t: Array, q: Vector, v: Vector) -> Energy:
    return Energy(*equations.energy(t, q, v))


def _evaluate_along(mechanism: Model, solution: HistoryLike, quantity: Callable[..., Result]) -> Result:
    model = mechanism.without_origin.traced(np.shape(solution.q)[-1])
    return _evaluate(model, analysis_of(mechanism), times_of(solution), solution.q, solution.v, quantity)


@deferred
def _evaluate(mechanism, analysis, ts, q, v, quantity):
    equations = equations_of(mechanism, SVD(), analysis=analysis)
    ts, q, v = jnp.asarray(ts), jnp.asarray(q).reshape(len(ts), -1), jnp.asarray(v).reshape(len(ts), -1)
    return at_each(quantity, equations, ts, q, v)
