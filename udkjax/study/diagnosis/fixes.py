"""Changes of a constraint that remove redundancy; fix_search.py tries them.

A revolute is relaxed in one direction (it becomes a slot in one of its bodies), a weld or a prismatic joint in its angle or its
direction, and any constraint can be removed. A change removes redundancy if the removed rows carry part of the self-stress of a
dependent set; it preserves the mobility, since other constraints block the same motion.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Angle, Constraint, Prismatic, Revolute, Slot, Weld
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.study.diagnosis.configuration import Configuration, RankedPositions


class JointChange(NamedTuple):
    """A way to relax a constraint: its replacement, and its remaining rows."""

    text: str
    make: Callable[[], Constraint] | None  # makes the replacement; None if the constraint is removed
    slides: tuple[int, float] | None = None  # for a slot: index of the slotted body, and axis in its frame (rad)
    rows: tuple[int, ...] = ()  # remaining rows, if the change is not a slot

    def remaining_rows(self, rows: np.ndarray, q: np.ndarray, places: list[int | None]) -> np.ndarray:
        """Return the rows of the constraint's Jacobian that remain of `rows`, those before the change.

        `q` are the coordinates (n,), and `places` the indices of the constraint's bodies (`body_indices`).
        """
        if self.slides is None:
            return rows[list(self.rows)]
        cos, sin = self._direction(q, places)
        return np.array([[-sin, cos]]) @ rows

    def removed_rows(self, count: int, q: np.ndarray, places: list[int | None]) -> np.ndarray:
        """Return the removed rows as orthonormal combinations of the `count` rows of the constraint."""
        if self.slides is None:
            return np.delete(np.eye(count), list(self.rows), axis=0)
        return self._direction(q, places)[None]

    def alignment(self, force: np.ndarray, q: np.ndarray, places: list[int | None]) -> float:
        """Return the fraction of the stress (rows, redundancy) that a slot removes, from 0 to 1; 1 for any other change."""
        if self.slides is None:
            return 1.0
        return float(np.linalg.norm(self._direction(q, places) @ force[:2]) / np.linalg.norm(force[:2], 2))

    def _direction(self, q: np.ndarray, places: list[int | None]) -> np.ndarray:
        """Return the direction of the slot in ground axes, a unit vector."""
        body, axis = self.slides or (0, 0.0)
        index = places[body]
        angle = axis + (0.0 if index is None else q[3 * index + 2])
        return np.array([np.cos(angle), np.sin(angle)])


class Fix(NamedTuple):
    """A verified change of a constraint: it removes `removes` redundant rows, and preserves the mobility."""

    constraint: str
    change: str  # in words
    removes: int
    conditioning: float  # smallest nonzero over largest singular value of the scaled Jacobian, in the worst position
    mechanism: Mechanism


class Redundancy(NamedTuple):
    """A minimal set of dependent constraints: if any one is removed, the others are independent."""

    constraints: tuple[str, ...]
    count: int  # number of their redundant rows
    permanent: bool  # True if dependent in every position, False if in this configuration only
    fixes: tuple[Fix, ...]  # verified changes; empty if not permanent
    held: tuple[str, ...] = ()  # pins among the constraints whose angles the set holds to second order only


def fix_of_held_pin(
    mechanism: Mechanism, positions: RankedPositions, at: Configuration, name: str, joint: Prismatic
) -> Fix | None:
    """Return the fix that replaces a pin, which does not turn, by a prismatic joint; None if this does not help.

    It helps if it removes redundant rows and raises the rank.
    """
    axis = _half_turn(float(joint.axis))
    text = f'make it a prismatic joint along {np.rad2deg(axis):.4g} degrees of the frame of "{joint.bodies[0]}": it does not turn'
    changed = apply_change(mechanism, name, JointChange(text, lambda: Prismatic(joint.bodies, joint.points, axis, joint.angle)))
    if changed is None:
        return None
    after = RankedPositions(changed, positions.rank_tol).at(at.t, at.q)
    removes = at.redundancy - after.redundancy
    return Fix(name, text, removes, after.smallest, changed) if removes > 0 and after.rank > at.rank else None


def apply_change(mechanism: Mechanism, name: str, change: JointChange) -> Mechanism | None:
    """Return the mechanism with a changed constraint; None if another element needs the original, such as friction."""
    joints, drivers = dict(mechanism.joints), dict(mechanism.drivers)
    if change.make is not None:
        joints[name] = change.make()
    else:
        joints.pop(name, None)
        drivers.pop(name, None)
    try:
        return Mechanism(mechanism.bodies, joints, drivers, mechanism.forces, mechanism.gravity, mechanism.name)
    except SceneError:
        return None


def body_indices(mechanism: Mechanism, name: str) -> list[int | None]:
    """Return the indices of a constraint's bodies among those of the mechanism; None for the ground."""
    bodies = mechanism.frames_of(mechanism.constraints[name])
    return [None if body == GROUND else mechanism.body_names.index(body) for body in bodies]


def changes_of(mechanism: Mechanism, name: str, at: Configuration, force: Callable[[], np.ndarray]) -> Iterator[JointChange]:
    """Iterate over the ways to relax a constraint, those that remove more rows first.

    `force` returns the constraint's multipliers (rows, redundancy) in the states of self-stress.
    """
    element = mechanism.constraints[name]
    yield JointChange("remove it", None)
    if isinstance(element, Revolute):
        largest = np.linalg.svd(force())[0][:, 0]  # direction of the largest force
        direction = np.arctan2(largest[1], largest[0])
        for k, body in enumerate(element.bodies):
            angle = 0.0 if body == GROUND else at.q[3 * mechanism.body_names.index(body) + 2]
            axis = _half_turn(direction - angle)
            other = element.bodies[1 - k]
            text = f'make it a slot along {np.rad2deg(axis):.4g} degrees of the frame of "{body}", for a pin of "{other}"'
            yield JointChange(text, partial(_slot, element, k, axis), (k, axis))
    if isinstance(element, Weld):
        yield JointChange("make it a revolute", lambda: Revolute(element.bodies, element.points), None, (0, 1))
    if isinstance(element, Prismatic):
        slot = lambda: Slot(element.bodies, element.points, element.axis)  # noqa: E731
        yield JointChange("make it a slot, free to turn", slot, None, (0,))
        yield JointChange("hold only the angle", lambda: Angle(element.bodies, element.angle), None, (1,))


def _slot(pin: Revolute, k: int, axis: float) -> Slot:
    """Return the slot along an axis (rad) in body k of a pin, in which the pin's point of the other body slides."""
    return Slot((pin.bodies[k], pin.bodies[1 - k]), (pin.points[k], pin.points[1 - k]), axis=axis)


def _half_turn(angle: float) -> float:
    """Return the angle (rad) of the same line in (-pi/2, pi/2], without rounding errors of multiples of 90 degrees."""
    angle = float(np.remainder(angle + np.pi / 2, np.pi) - np.pi / 2)
    near = round(angle / (np.pi / 2)) * np.pi / 2
    angle = near if abs(angle - near) < 1e-9 else angle
    return angle + np.pi if angle < -np.pi / 2 + 1e-9 else angle + 0.0
