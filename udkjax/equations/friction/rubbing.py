"""Friction that depends on the loads of joints, on arrays: the loads and the multipliers that belong to each other.

With friction G(q, v, lambda) on the right-hand side, M a + Psi_q^T lambda = F + G, the multipliers solve

    lambda = L(G(lambda)),        L(g) = -w (D^+)^T D^+ (b - D M^(-1/2) g),

with D, b, weights w and D^+ as in udwadia_kalaba.py: with redundant rows they are those of least norm, or with compliances those
of least elastic energy. Newton's method solves this from lambda = L(0). Loads have kinks where they change their signs, and with
strong friction its steps may go back and forth between two sets of signs, or end at a second solution, which is no motion
(friction_elimination.py): there 1 - L_g G_lambda has negative pivots. Then the solution is followed from L(0) on, in stages of
growing friction, lambda = L(s G(lambda)): at once, in `RunPrograms.STAGES`, or in shorter stages where one of these fails. Where
friction admits no motion (the mechanism jams), this does not end, and the multipliers are NaN. The implicit function theorem
gives derivatives of any order.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import NumberLike, Time, Vector
from udkjax.equations.friction.compliance import sharing
from udkjax.equations.laws import udwadia_kalaba as uk
from udkjax.equations.laws.udwadia_kalaba import Baumgarte, Weights
from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.terms import constraints
from udkjax.equations.terms.constraints import BodyArray, bodies
from udkjax.equations.terms.structure import RubbingJoint, rubbing_joints
from udkjax.pinv import Pseudoinverse
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME_AT_REST, Frame
from udkjax.scene.elements.forces import Wrench
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism
from udkjax.transforms.newton_steps import repeated_newton


def rubbing_names(mechanism: Mechanism) -> list[str]:
    """Return the joints whose friction depends on their load.

    Args:
        mechanism: The scene.

    Returns:
        Their names, in the order of the constraints.
    """
    return [name for name, x in zip(mechanism.constraints, rubbing_joints(mechanism), strict=True) if x is not None]


def rubbing_loads(
    mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray, multipliers: Float[Array, "m"]
) -> Float[Array, "n"]:
    """Return G, the loads of all friction that depends on the loads of joints.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).
        v: Velocities (m/s, rad/s), in the shape of q.
        multipliers: lambda (m,).

    Returns:
        Force x, force y (N) and torque (N m) on each body (n,).
    """
    return sum(single_rubbing_loads(mechanism, t, q, v, multipliers).values(), jnp.zeros(3 * len(mechanism.body_names)))


def single_rubbing_loads(
    mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray, multipliers: Float[Array, "m"]
) -> dict[str, Float[Array, "n"]]:
    """Return the loads (n,) of each friction that depends on the load of a joint, by the joint's name; see `rubbing_loads`."""
    time, places = jnp.asarray(t, jnp.result_type(float)), frames(mechanism, q, v)
    found: dict[str, Array] = {}
    for name, (joint, own) in _with_multipliers(mechanism, multipliers).items():
        wrenches = joint.loads(own, time, *(places[b] for b in joint.bodies))
        found[name] = _on_bodies(mechanism, joint.bodies, wrenches)
    return found


def terms_of_rubbing(
    mechanism: Mechanism, q: BodyArray, v: BodyArray, multipliers: Float[Array, "m"]
) -> dict[str, Float[Array, "3"]]:
    """Return the speed of sliding s (m/s), mu(s) and the load (N) of each friction that depends on a load, by its joint."""
    places = frames(mechanism, q, v)
    return {
        name: jnp.stack([jnp.asarray(x) for x in joint.friction.terms(joint.joint, own, *(places[b] for b in joint.bodies))])
        for name, (joint, own) in _with_multipliers(mechanism, multipliers).items()
    }


def _with_multipliers(mechanism: Mechanism, multipliers: Float[Array, "m"]) -> dict[str, tuple[RubbingJoint, list[Array]]]:
    """Return the joints with friction that depends on their load, and the multipliers of each, by name."""
    rows: dict[str, list[Array]] = {}
    for k, (owner, _) in enumerate(constraints.row_names(mechanism)):
        rows.setdefault(owner, []).append(multipliers[k])
    joints = zip(mechanism.constraints, rubbing_joints(mechanism), strict=True)
    return {name: (joint, rows[name]) for name, joint in joints if joint is not None}


def loads_of_friction(
    mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray, multipliers: Float[Array, "m"]
) -> dict[str, Float[Array, "n"]]:
    """Return the loads (n,) of each `Friction`, constant torques included, by the element's name; see `rubbing_loads`."""
    time, places = jnp.asarray(t, jnp.result_type(float)), frames(mechanism, q, v)
    by_joint, found = single_rubbing_loads(mechanism, t, q, v, multipliers), {}
    for name, force in mechanism.forces.items():
        if isinstance(force, Friction):
            attached = mechanism.joints[force.joint].frame_names
            constant = force.loads(time, *(places[b] for b in attached))
            total = jnp.zeros(3 * len(mechanism.body_names)) if constant is None else _on_bodies(mechanism, attached, constant)
            found[name] = total + by_joint[force.joint] if force.rubs else total
    return found


def _on_bodies(mechanism: Mechanism, attached: Sequence[str], wrenches: Sequence[Wrench]) -> Float[Array, "n"]:
    """Return the loads `wrenches` on the frames `attached` as loads on all coordinates; loads on the ground are left out."""
    names, total = mechanism.body_names, jnp.zeros((len(mechanism.body_names), 3))
    for body, wrench in zip(attached, wrenches, strict=True):
        if body != GROUND:
            total = total.at[names.index(body)].add(constraints.vector(list(wrench)))
    return total.ravel()


def frames(mechanism: Mechanism, q: BodyArray, v: BodyArray) -> dict[str, Frame]:
    """Return the moving frames of all bodies and of the ground, by name.

    Args:
        mechanism: The scene.
        q: Coordinates (m, rad), (n,) or (bodies, 3).
        v: Velocities (m/s, rad/s), in the shape of q.
    """
    places, speeds = bodies(q), bodies(v)
    return {GROUND: GROUND_FRAME_AT_REST} | {name: _frame(places[k], speeds[k]) for k, name in enumerate(mechanism.body_names)}


def _frame(place: Array, speed: Array) -> Frame:
    (x, y, angle), (vx, vy, omega) = place, speed
    return Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), vx, vy, omega)


def settled_multipliers(
    mechanism: Mechanism,
    t: Time,
    q: Vector,
    v: Vector,
    method: Pseudoinverse,
    baumgarte: Baumgarte | None = None,
    w: Weights = None,
    soft: Float[Array, "m"] | None = None,
) -> Float[Array, "m"]:
    """Return the solution of lambda = L(G(lambda)); NaN if friction admits none.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,).
        v: Velocities (m/s, rad/s), (n,).
        method: The pseudoinverse.
        baumgarte: Gains of Baumgarte stabilization; None: no stabilization.
        w: Weights of the rows (m,); None: all are one.
        soft: Compliances of the rows (m/N, rad/(N m)); None: loads of least norm.

    Returns:
        lambda (m,), in N and N m.
    """
    D, root = uk.D(mechanism, t, q, w), uk.inverse_sqrt_mass(mechanism)
    plus, b = uk.pseudoinverse(method, D), uk.b(mechanism, t, q, v, baumgarte, w)
    share = sharing(D, soft, jnp.ones(len(D)) if w is None else jnp.asarray(w))

    def multipliers(friction: Array) -> Array:
        return share(uk.weigh(w, -(plus.T @ (plus @ (b - D @ (root * friction))))))

    return settle(multipliers, mechanism, t, q, v) if rubbing_names(mechanism) else multipliers(jnp.zeros_like(q))


def settled_loads(
    multipliers: Callable[[Vector], Float[Array, "m"]], mechanism: Mechanism, t: Time, q: Vector, v: Vector
) -> Float[Array, "n"]:
    """Return G(lambda) with lambda = L(G(lambda)); zeros if no friction depends on the loads of joints.

    Args:
        multipliers: L, from loads (n,) to multipliers (m,); affine.
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,).
        v: Velocities (m/s, rad/s), (n,).

    Returns:
        Force x, force y (N) and torque (N m) on each body (n,).
    """
    if not rubbing_names(mechanism):
        return jnp.zeros_like(q)
    return rubbing_loads(mechanism, t, q, v, settle(multipliers, mechanism, t, q, v))


def settle(
    multipliers: Callable[[Vector], Float[Array, "m"]], mechanism: Mechanism, t: Time, q: Vector, v: Vector
) -> Float[Array, "m"]:
    """Solve lambda = L(G(lambda)) by Newton's method; the result is NaN if that does not converge.

    Args:
        multipliers: L, from loads (n,) to multipliers (m,); affine.
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,).
        v: Velocities (m/s, rad/s), (n,).

    Returns:
        lambda (m,), with derivatives of any order.
    """
    friction, root = jax.jit(partial(rubbing_loads, mechanism, t, q, v)), jax.lax.stop_gradient(uk.inverse_sqrt_mass(mechanism))

    def remainder(x: Array, share: Array | float = 1.0) -> Array:
        return x - multipliers(share * friction(x))

    def attempt(x: Array, share: Array, begins: Array) -> tuple[Array, Array, Array]:
        """Return the last Newton iterate with a share of friction, True if it fails, and the number of its negative pivots."""

        def step(x: Array) -> tuple[Array, Array, Array]:
            def parts(x: Array) -> tuple[Array, tuple[Array, Array]]:
                loads = friction(x)
                left = x - multipliers(share * loads)
                return left, (left, loads)

            slope, (left, before) = jax.jacfwd(parts, has_aux=True)(x)
            new = x - jnp.linalg.solve(slope, left)
            after = friction(new)
            return new, jnp.linalg.norm(root * (after - before)), jnp.linalg.norm(root * after)

        found, is_open = repeated_newton(step, x, begins)
        negative = _negative_pivots(jax.jacfwd(lambda x: remainder(x, share))(found))
        return found, is_open | (negative % 2 == 1), negative

    def solve(_: Callable[[Array], Array], start: Array) -> Array:
        longest, shortest = 1 / RunPrograms.STAGES, 1 / RunPrograms.STAGES**2

        def grow(state: _Growth) -> _Growth:
            share = jnp.minimum(state.reached + state.stage, 1.0)
            x, fails, negative = attempt(state.x, share, state.goes_on)
            fails = fails | ((negative > 0) & (state.stage > 1.5 * longest))
            reached, x = jnp.where(fails, state.reached, share), jnp.where(fails, state.x, x)
            stage = jnp.where(fails, jnp.minimum(state.stage / 2, longest), state.stage)
            return _Growth(x, reached, stage, (reached < 1 - shortest / 2) & (stage > 0.75 * shortest))

        at_once = _Growth(start, jnp.zeros(()), jnp.ones(()), jnp.asarray(True))
        grown = jax.lax.while_loop(lambda x: x.goes_on, grow, at_once)
        return jnp.where(grown.reached < 1 - shortest / 2, jnp.nan, grown.x)

    def solve_for_tangent(linear: Callable[[Array], Array], y: Array) -> Array:
        return jnp.linalg.solve(jax.jacfwd(linear)(y), y)

    start = jax.lax.stop_gradient(multipliers(jnp.zeros(q.size)))
    return jax.lax.custom_root(remainder, start, solve, solve_for_tangent)


class _Growth(NamedTuple):
    """State of a continuation in the share of friction: solution x, share reached, next increment, and whether it continues."""

    x: Array
    reached: Array  # the share of friction for which x is the solution
    stage: Array  # the next increment of the share
    goes_on: Array


def _negative_pivots(matrix: Float[Array, "m m"]) -> Array:
    """Return the number of negative pivots of an elimination without exchanges."""

    def eliminate(k: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        rest, count = state
        pivot, below = rest[k, k], jnp.arange(len(matrix)) > k
        factors = jnp.where(below, rest[:, k], 0.0) / jnp.where(pivot == 0, 1.0, pivot)
        return rest - factors[:, None] * rest[k], count + (pivot < 0)

    return jax.lax.fori_loop(0, len(matrix), eliminate, (matrix, jnp.asarray(0)))[1]
