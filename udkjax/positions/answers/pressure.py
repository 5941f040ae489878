"""Pressure angles of cams: between the contact force on a follower and the follower's direction of motion."""

from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.argument_types import HISTORY
from udkjax.arrays import ROUNDING
from udkjax.equations.rows.redundancy import kinematic_rows
from udkjax.positions.assembling.channels import StateHistory
from udkjax.positions.assembling.coordinates import Coordinate, value_of
from udkjax.positions.following.drive import Drive, only_driver
from udkjax.programs.deferred import deferred
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Cam
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote

FREE_MOTION_TOL = 1e3 * ROUNDING  # relative to the largest singular value: motions with less are free


@checked
@concrete_only()
def pressure_angle(
    mechanism: Mechanism, motion: Annotated[StateHistory, HISTORY], cam: str, driver: Drive = None
) -> Float[np.ndarray, "T"]:
    """Return the pressure angle (rad, 0 to pi/2) of a cam: from the normal at its contact to the follower's direction of motion.

    With the driver held and the cam taken away, the follower can move in one way, w at the contact. With the normal n of the
    cam there, the angle is acos(|n . w| / |w|). It is thus defined in dwells as well. The cam drives its follower best at zero,
    and not at all at pi/2.

    Args:
        mechanism: a mechanism of one degree of freedom once its drivers hold; its numbers are not traced.
        motion: anything with q (T, bodies, 3), a `Kinematics` or a `Solution`.
        cam: name of a `Cam`, whose follower is not the ground.
        driver: a driver or coordinate, as for `kinematics`; by default the only driver.

    Returns:
        The angle (T,) in rad; NaN in a singular position, and where a value is not reached.

    Raises:
        SceneError: there is no such cam or driver, or without the cam the follower has not one way to move.
    """
    q = np.asarray(motion.q, float)
    angles, reached = np.full(len(q), np.nan), np.isfinite(q).all((1, 2))
    angles[reached] = pressure_angles(mechanism, q[reached], cam, driver)
    return angles


def pressure_angles(mechanism: Mechanism, q: Float[np.ndarray, "T bodies 3"], cam: str, driver: Drive) -> Float[np.ndarray, "T"]:
    """Return the pressure angles (rad) of a cam in the positions q, as `pressure_angle` does; all positions are finite."""
    cams = [name for name, joint in mechanism.joints.items() if isinstance(joint, Cam)]
    if cam not in cams:
        raise SceneError([f"{quote(cam)} is not a cam; there are {', '.join(map(quote, cams)) or 'none'}"], mechanism.name)
    joint = mechanism.joints[cam]
    assert isinstance(joint, Cam)
    follower = joint.bodies[1]
    if follower == GROUND:
        raise SceneError([f"{quote(cam)}: its second body, the follower, is the ground: exchange the two"], mechanism.name)
    rows = kinematic_rows(mechanism)
    own = [name == cam for name, _ in rows.names]
    D = np.stack([rows.dense(rows.at(0.0, x.ravel())[2]) for x in q])
    held = _slopes(mechanism, driver, q) * rows.metric
    ways = _null_vectors(np.concatenate([D[:, ~np.array(own)], held], 1)) * rows.metric
    if np.isnan(ways).all():
        problem = f"{quote(cam)}: without it and with its driver held, the follower has not one way to move"
        raise SceneError([problem], mechanism.name)
    k = mechanism.body_names.index(follower)
    force, way = (x.reshape(len(q), -1, 3)[:, k] for x in (D[:, own][:, 0] / rows.metric, ways))
    c, s = np.cos(q[:, k, 2]), np.sin(q[:, k, 2])
    x, y = np.asarray(joint.points, float)[1]
    arm = np.stack([c * x - s * y, s * x + c * y], 1)
    normal = force[:, :2] / np.linalg.norm(force[:, :2], axis=1, keepdims=True)
    along = np.sum(force * way, axis=1) / np.linalg.norm(force[:, :2], axis=1)
    across = normal[:, 0] * way[:, 1] - normal[:, 1] * way[:, 0] + way[:, 2] * np.sum(normal * arm, axis=1)
    return np.arctan2(np.abs(across), np.abs(along))


def _slopes(mechanism: Mechanism, driver: Drive, q: Float[np.ndarray, "T bodies 3"]) -> Float[np.ndarray, "T k n"]:
    """Return the gradient by q of a coordinate without a driver, with k = 1 row; for a driver, which has a row of Psi, k = 0."""
    driver = only_driver(mechanism) if driver is None else driver
    if isinstance(driver, str) and driver in mechanism.drivers:
        return np.zeros((len(q), 0, q[0].size))
    return np.stack([np.asarray(_slope(mechanism, driver, jnp.asarray(x))).reshape(1, -1) for x in q])


@deferred
def _slope(mechanism: Mechanism, driver: str | Coordinate, q: Float[Array, "bodies 3"]) -> Float[Array, "bodies 3"]:
    return jax.grad(value_of(mechanism, driver))(q)


def _null_vectors(rows: Float[np.ndarray, "T rows n"]) -> Float[np.ndarray, "T n"]:
    """Return the null vector of each of T Jacobians whose null space has dimension one; NaN for the others."""
    values, vectors = np.linalg.svd(rows)[1:]
    free = rows.shape[2] - np.sum(values > FREE_MOTION_TOL * values[:, :1], axis=1)
    return np.where(free[:, None] == 1, vectors[:, -1], np.nan)
