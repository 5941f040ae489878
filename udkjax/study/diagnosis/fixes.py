"""Changes that remove redundancy of constraints: all are tried on the Jacobian, and the best also on the mechanism.

A revolute is relaxed in one direction (it becomes a slot in one of its bodies), a weld or a prismatic joint in its angle or its
direction, and any constraint can be removed. A change removes redundancy if the removed rows carry part of the self-stress of a
dependent set; it preserves the mobility, since other constraints block the same motion.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from udkjax.scene.bodies import GROUND
from udkjax.scene.checks import SceneError
from udkjax.scene.joints import Angle, Constraint, Prismatic, Revolute, Slot, Weld
from udkjax.scene.mechanism import Mechanism
from udkjax.study.diagnosis.configuration import Configuration, RankedPositions, count_rank, singular_values
from udkjax.study.diagnosis.dependence import Dependency, stress_of

SMALLEST_PIVOT = 1e-3  # least ratio of the smallest nonzero singular values after and before a fix


class JointChange(NamedTuple):
    """A way to relax a constraint: its replacement, and its remaining rows."""

    text: str
    element: Constraint | None  # None if the constraint is removed
    slides: tuple[int, float] | None = None  # for a slot: index of the slotted body, and axis in its frame (rad)
    rows: tuple[int, ...] = ()  # remaining rows, if the change is not a slot

    def remaining_rows(self, rows: np.ndarray, q: np.ndarray, places: list[int | None]) -> np.ndarray:
        """Return the remaining rows of the constraint's Jacobian."""
        if self.slides is None:
            return rows[list(self.rows)]
        cos, sin = self._direction(q, places)
        return np.array([[-sin, cos]]) @ rows

    def alignment(self, force: np.ndarray, q: np.ndarray, places: list[int | None]) -> float:
        """Return the fraction of the stress (rows, redundancy) that a slot removes, from 0 to 1; 1 for any other change."""
        if self.slides is None:
            return 1.0
        return float(np.linalg.norm(self._direction(q, places) @ force[:2]) / np.linalg.norm(force[:2], 2))

    def _direction(self, q: np.ndarray, places: list[int | None]) -> np.ndarray:
        """Return the direction of the slot in ground axes."""
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
    held: tuple[str, ...] = ()  # pins among them that they hold to second order only


class _ChangesOfConstraint(NamedTuple):
    """The changes of a constraint that help according to the Jacobian, the best first."""

    constraint: str
    changes: list[tuple[int, float, JointChange]]  # redundant rows removed, conditioning after the change, and the change


def fixes_of(
    mechanism: Mechanism, positions: RankedPositions, at: list[Configuration], owners: list[str], dependency: Dependency
) -> list[Fix]:
    """Return the best verified change of each constraint of a dependent set, sorted by removed rows and conditioning.

    `at` are generic configurations; a change must help in all of them.
    """
    candidates = _candidates(mechanism, positions, at, owners, dependency)
    fixes = [_verify(mechanism, positions, at, candidate) for candidate in candidates]
    return sorted((fix for fix in fixes if fix), key=lambda fix: (-fix.removes, -fix.conditioning))


def best_fix(
    mechanism: Mechanism, positions: RankedPositions, at: list[Configuration], owners: list[str], sets: Sequence[Dependency]
) -> Fix | None:
    """Return the best fix of all sets, or None. Candidates are verified one by one, since this builds a mechanism."""
    candidates = [candidate for dependency in sets for candidate in _candidates(mechanism, positions, at, owners, dependency)]
    candidates.sort(key=lambda candidate: candidate.changes[0][:2], reverse=True)
    return next((fix for candidate in candidates if (fix := _verify(mechanism, positions, at, candidate))), None)


def _candidates(
    mechanism: Mechanism, positions: RankedPositions, at: list[Configuration], owners: list[str], dependency: Dependency
) -> list[_ChangesOfConstraint]:
    helpful, stresses = [], [stress_of(position.left, owners, dependency.constraints) for position in at]
    for name in dependency.constraints:
        options, indices, places = [], _rows_of(owners, name), _body_indices(mechanism, name)
        forces = [stress[indices] / positions.row_unit[indices, None] for stress in stresses]
        for change in changes_of(mechanism, name, at[0], forces[0]):
            removes, conditioning = _effect(indices, places, change, at, positions.rank_tol)
            if removes > 0 and conditioning > SMALLEST_PIVOT * min(c.smallest for c in at):
                aligned = min(change.alignment(force, c.q, places) for force, c in zip(forces, at, strict=True))
                options.append((removes, round(aligned, 6), round(conditioning, 12), change))
        options.sort(key=lambda option: option[:3], reverse=True)
        if options:
            helpful.append(
                _ChangesOfConstraint(name, [(removes, conditioning, change) for removes, _, conditioning, change in options])
            )
    return helpful


def _verify(
    mechanism: Mechanism, positions: RankedPositions, at: list[Configuration], candidates: _ChangesOfConstraint
) -> Fix | None:
    """Return the first of a constraint's changes whose effect on the mechanism is the same as on the Jacobian."""
    for removes, conditioning, change in candidates.changes:
        changed = apply_change(mechanism, candidates.constraint, change)
        if changed is not None and _removes_redundancy(changed, removes, at, positions.rank_tol):
            return Fix(candidates.constraint, change.text, removes, conditioning, changed)
    return None


def fix_of_held_pin(
    mechanism: Mechanism, positions: RankedPositions, at: Configuration, name: str, joint: Prismatic
) -> Fix | None:
    """Return the change of a pin that does not turn to a prismatic joint; None if it does not help."""
    axis = _half_turn(float(joint.axis))
    text = f'make it a prismatic joint along {np.rad2deg(axis):.4g} degrees of the frame of "{joint.bodies[0]}": it does not turn'
    changed = apply_change(mechanism, name, JointChange(text, Prismatic(joint.bodies, joint.points, axis, joint.angle)))
    if changed is None:
        return None
    after = RankedPositions(changed, positions.rank_tol).at(at.t, at.q)
    removes = at.redundancy - after.redundancy
    return Fix(name, text, removes, after.smallest, changed) if removes > 0 and after.rank > at.rank else None


def apply_change(mechanism: Mechanism, name: str, change: JointChange) -> Mechanism | None:
    """Return the mechanism with a changed constraint; None if another element needs the original, such as friction."""
    joints, drivers = dict(mechanism.joints), dict(mechanism.drivers)
    if change.element is not None:
        joints[name] = change.element
    else:
        joints.pop(name, None)
        drivers.pop(name, None)
    try:
        return Mechanism(mechanism.bodies, joints, drivers, mechanism.forces, mechanism.gravity, mechanism.name)
    except SceneError:
        return None


def _rows_of(owners: list[str], name: str) -> list[int]:
    return [k for k, owner in enumerate(owners) if owner == name]


def _body_indices(mechanism: Mechanism, name: str) -> list[int | None]:
    """Return the indices of a constraint's bodies; None for the ground."""
    bodies = mechanism.frames_of(mechanism.constraints[name])
    return [None if body == GROUND else mechanism.body_names.index(body) for body in bodies]


def changes_of(mechanism: Mechanism, name: str, at: Configuration, force: np.ndarray) -> Iterator[JointChange]:
    """Iterate over the ways to relax a constraint with the multipliers `force` (rows, redundancy) of the stress."""
    element = mechanism.constraints[name]
    yield JointChange("remove it", None)
    if isinstance(element, Revolute):
        largest = np.linalg.svd(force)[0][:, 0]  # direction of the largest force
        direction = np.arctan2(largest[1], largest[0])
        for k, body in enumerate(element.bodies):
            angle = 0.0 if body == GROUND else at.q[3 * mechanism.body_names.index(body) + 2]
            axis = _half_turn(direction - angle)
            other = element.bodies[1 - k]
            slot = Slot((body, other), (element.points[k], element.points[1 - k]), axis=axis)
            text = f'make it a slot along {np.rad2deg(axis):.4g} degrees of the frame of "{body}", for a pin of "{other}"'
            yield JointChange(text, slot, (k, axis))
    if isinstance(element, Weld):
        yield JointChange("make it a revolute", Revolute(element.bodies, element.points), None, (0, 1))
    if isinstance(element, Prismatic):
        slot = Slot(element.bodies, element.points, element.axis)
        yield JointChange("make it a slot, free to turn", slot, None, (0,))
        yield JointChange("hold only the angle", Angle(element.bodies, element.angle), None, (1,))


def _half_turn(angle: float) -> float:
    """Return the direction of the same line in (-90, 90] degrees, without rounding errors of multiples of 90 degrees."""
    angle = float(np.remainder(angle + np.pi / 2, np.pi) - np.pi / 2)
    near = round(angle / (np.pi / 2)) * np.pi / 2
    angle = near if abs(angle - near) < 1e-9 else angle
    return angle + np.pi if angle < -np.pi / 2 + 1e-9 else angle + 0.0


def _effect(
    indices: list[int], places: list[int | None], change: JointChange, at: list[Configuration], rank_tol: float
) -> tuple[int, float]:
    """Return the number of redundant rows that a change removes, and the conditioning after it.

    The number is -1 if the mobility changes or the number differs between positions. `indices` are the rows of the constraint,
    `places` the indices of its bodies.
    """
    falls, conditioning = -1, np.inf
    for k, position in enumerate(at):
        other_rows = np.delete(position.J, indices, axis=0)
        remaining = np.concatenate([other_rows, change.remaining_rows(position.J[indices], position.q, places)])
        sigma = singular_values(remaining)
        rank = count_rank(sigma, rank_tol)
        fall = position.redundancy - (len(remaining) - rank)
        if rank != position.rank or (k and fall != falls):
            return -1, float(conditioning)
        falls, conditioning = fall, min(conditioning, sigma[rank - 1] / sigma[0] if rank else 1.0)
    return falls, float(conditioning)


def _removes_redundancy(changed: Mechanism, removes: int, at: list[Configuration], rank_tol: float) -> bool:
    """Return True if in all positions the changed mechanism is closed, has the same mobility, and fewer redundant rows."""
    positions = RankedPositions(changed, rank_tol)
    ranked = [positions.at(position.t, position.q) for position in at]
    closed = all(
        np.max(np.abs(positions.rows.residual(c.t, c.q)), initial=0.0) < rank_tol * max(1.0, positions.rows.scales.size(c.q, np))
        for c in ranked
    )
    alike = all(
        c.rank == position.rank and c.redundancy == position.redundancy - removes for c, position in zip(ranked, at, strict=True)
    )
    return closed and alike
