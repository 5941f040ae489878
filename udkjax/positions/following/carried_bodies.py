"""Carried bodies, which are connected to a single other body, their carrier: a wheel on its axle, a pendulum on a link.

If a carrier moves, the bodies that it carries can move rigidly with it without opening their joints. So carried bodies limit no
coordinate of the other bodies, whose positions are computed as if the carried ones were absent.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import NumberLike
from udkjax.arrays import library_for
from udkjax.equations.rows.analysis import analyse
from udkjax.equations.rows.dense_rows import KinematicRows
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.positions.assembling.coordinates import Coordinate, element_of
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.origin import Origin

ANY_MOTION = (
    0.3,
    -0.2,
    0.7,
)  # in characteristic lengths and rad; generic, so invariance under it implies invariance in general


class CarriedBodies(NamedTuple):
    """The carried bodies of a mechanism: `carrier` has the index of each, with the index of its carrier; -1 is the ground."""

    carrier: dict[int, int]

    def without(self, mechanism: Mechanism) -> Mechanism:
        """Return the mechanism without the carried bodies, and without forces, on which positions do not depend."""
        names = [mechanism.body_names[k] for k in self.carrier]
        keeps = lambda element: not set(names) & set(mechanism.frames_of(element))  # noqa: E731
        joints = {name: x for name, x in mechanism.joints.items() if keeps(x)}
        drivers = {name: x for name, x in mechanism.drivers.items() if keeps(x)}
        bodies = {name: body for name, body in mechanism.bodies.items() if name not in names}
        with jax.ensure_compile_time_eval():
            origin = mechanism.origin and Origin(self.without(mechanism.origin.mechanism))
        return Mechanism(bodies, joints, drivers, {}, mechanism.gravity, mechanism.name, origin)

    def kept(self, count: int) -> np.ndarray:
        """Return the indices of the bodies that are not carried, in a mechanism of `count` bodies."""
        return np.array([k for k in range(count) if k not in self.carrier], int)

    def carry(self, start: Float[Array, "bodies 3"], others: Float[Array, "kept 3"]) -> Float[Array, "bodies 3"]:
        """Return the positions of all bodies: carried ones have the same pose relative to their carriers as at the start.

        If `others`, the positions of the bodies that are not carried, are not finite, all positions are infinite.
        """
        xp, kept = library_for((start, others)), self.kept(len(start))
        is_reached = xp.all(xp.isfinite(others))
        poses = dict(zip(kept.tolist(), xp.where(is_reached, others, 0.0), strict=True))
        for k, carrier in self.carrier.items():
            if carrier < 0:
                poses[k] = start[k]
                continue
            turn = poses[carrier][2] - start[carrier][2]
            (x, y), (c, s) = (start[k] - start[carrier])[:2], (xp.cos(turn), xp.sin(turn))
            poses[k] = poses[carrier] + xp.stack([c * x - s * y, s * x + c * y, start[k][2] - start[carrier][2]])
        all_poses = xp.stack([poses[k] for k in range(len(start))])
        return xp.where(is_reached, all_poses, xp.inf)


def carried_bodies(mechanism: Mechanism, driver: str | Coordinate, held: Mapping[str, NumberLike] | None) -> CarriedBodies:
    """Return the carried bodies of a mechanism, if degrees of freedom remain while a coordinate is driven, else no bodies.

    With all numbers traced, the degrees of freedom are unknown and no bodies are returned.
    """
    concrete = mechanism if mechanism.is_concrete else mechanism.origin and mechanism.origin.mechanism
    element, held_elements = element_of(mechanism, driver), [element_of(mechanism, name) for name in held or {}]
    if concrete is None:
        return CarriedBodies({})
    freedoms = analyse(concrete).degrees_of_freedom
    added_drivers = [name for name in (driver, *(held or {})) if not (isinstance(name, str) and name in concrete.drivers)]
    if freedoms is None or freedoms <= len(added_drivers):
        return CarriedBodies({})
    index = {name: k for k, name in enumerate(concrete.body_names)} | {GROUND: -1}
    attached = [concrete.frames_of(x) for x in concrete.constraints.values()]
    groups = [{index[body] for body in bodies} for bodies in (*attached, element.bodies, *(x.bodies for x in held_elements))]
    prescribed = {index[body] for x in (element, *held_elements) for body in x.bodies}
    carrier: dict[int, int] = {}
    for body in [-1, *range(len(concrete.body_names))]:
        for part in _parts_without(body, groups, len(concrete.body_names)):
            hangs = -1 not in part and not part & (prescribed | set(carrier)) and body not in carrier
            if hangs and (body < 0 or _is_carried(concrete, part, body)):
                carrier |= dict.fromkeys(sorted(part), body)
    return CarriedBodies(carrier)


def _parts_without(body: int, groups: list[set[int]], count: int) -> list[set[int]]:
    """Return the sets of bodies that are connected with each other without one body; `groups` has the bodies of each constraint.

    The ground is -1.
    """
    parts = [{k} for k in range(-1, count) if k != body]
    for group in groups:
        joined = [part for part in parts if part & group]
        if joined:
            parts = [part for part in parts if not part & group] + [set().union(*joined)]
    return parts


def _is_carried(mechanism: Mechanism, part: set[int], carrier: int) -> bool:
    """Return True if the constraints of a set of bodies, `part`, stay closed when it moves rigidly with its carrier."""
    rows, names = KinematicRows(mechanism), mechanism.body_names
    moving = {names[k] for k in part}
    of_part = [name for name, x in mechanism.constraints.items() if moving & set(mechanism.frames_of(x))]
    mask = np.array([owner in of_part for owner, _ in rows.names], bool)
    q = np.array(mechanism.q0, float)
    length, (dx, dy, turn) = float(rows.scales.length), ANY_MOTION
    moved, indices = q.copy(), [*part, carrier]
    c, s = np.cos(turn), np.sin(turn)
    moved[indices, :2] = q[indices, :2] @ np.array([[c, s], [-s, c]]) + length * np.array([dx, dy])
    moved[indices, 2] += turn
    change = (rows.psi(0.0, moved.ravel()) - rows.psi(0.0, q.ravel())) / rows.scales.rows
    return bool(np.all(np.abs(change[mask]) <= CLOSURE.tol))
