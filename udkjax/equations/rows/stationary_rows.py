"""Constraints that hold a rotation to second order only, and the angles that hold it to first order.

A rod as long as the distance of two parallel guides, with an end in each, cannot turn: its length across the guides is
l cos(phi) = l, or phi^2 = 0. The gradient of this equation vanishes wherever it holds: Psi_q lacks a rank along the whole motion,
and neither Psi_q a = gamma nor a Newton step knows that the rod does not turn.

With N the left null space of Psi_q, N^T Psi_q = 0, velocities v = T y of the tangent space have accelerations only if

    N^T gamma(v) = 0,        or        y^T Q y = 0  for all  Q = T^T (lambda . Psi_qq) T,  lambda in N.

If one Q is l l^T, every motion has l . y = 0. Here l is the relative angular velocity at a pin whose force is part of lambda: the
pin does not turn, and an `Angle` of its two bodies says so to first order. In a singular configuration, where motions branch, Q
has both signs, and nothing is held.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from udkjax.equations.rows.dense_rows import CLEAR_TOL, DEPENDENT_TOL, DensePosition, KinematicRows
from udkjax.equations.rows.position_closure import CLOSURE, close_position
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Angle, Prismatic, Revolute
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.origin import Origin

# Largest part of l l^T that no Q has: closed positions err by up to 1e-6, the root of rounding errors of Psi.
SQUARE_FIT_TOL = 1e-5
REFINEMENTS = 3  # each doubles the number of right digits
SMALL_SINGULAR_VALUE = 1e-2  # singular values, relative to the largest, up to which gradients may vanish nearby
TESTED_POSITIONS = 4  # positions of the motion in which a pin must not turn either


class HeldPin(NamedTuple):
    """A pin whose angle stays constant in every motion although Psi_q lets it change."""

    name: str
    bodies: tuple[str, ...]
    angle: float  # theta2 - theta1 (rad)
    direction: float  # of the force in the pin that has no effect to first order, in ground axes (rad)

    def prismatic(self, mechanism: Mechanism, q: np.ndarray) -> Prismatic:
        """Return the prismatic joint that replaces the pin at a position q (n,): it lacks the row that has no effect."""
        base = self.bodies[0]
        angle = 0.0 if base == GROUND else float(q[3 * mechanism.body_names.index(base) + 2])
        return Prismatic(self.bodies, mechanism.joints[self.name].points, self.direction - angle, self.angle)


def held_pins(mechanism: Mechanism, rows: KinematicRows, q: np.ndarray, redundant: int = 0) -> tuple[HeldPin, ...]:
    """Return pins that do not turn although Psi_q lets them: the motion is the same with their angles held.

    Args:
        mechanism: the scene, with concrete numbers.
        rows: the rows of the mechanism.
        q: the coordinates (n,) of a position, which need not be closed.
        redundant: the number of rows that are redundant in the usual sense.
    """
    position = _closed(rows, q)
    if position is None or _rank(position) >= rows.count - redundant:
        return ()
    pins: list[HeldPin] = []
    while True:  # each pin may uncover another one, and is not found again
        holding = with_held_pins(mechanism, pins)
        found = next(_held(holding, KinematicRows(holding), position), None)
        if found is None:
            break
        pins.append(found)
    whole = all(_are_held(mechanism, pins, p) for p in _motion(with_held_pins(mechanism, pins), position)) if pins else False
    return tuple(pins) if whole else ()


def with_held_pins(mechanism: Mechanism, pins: Sequence[HeldPin]) -> Mechanism:
    """Return the mechanism with a further joint for each pin, an `Angle` that holds the angle between its bodies."""
    if not pins:
        return mechanism
    angles = {f"{pin.name}.angle": Angle(pin.bodies, pin.angle) for pin in pins}
    parts = (dict(mechanism.joints) | angles, mechanism.drivers, mechanism.forces, mechanism.gravity, mechanism.name)
    origin = None if mechanism.origin is None else Origin(with_held_pins(mechanism.origin.mechanism, pins))
    return Mechanism(mechanism.bodies, *parts, origin)


def _closed(rows: KinematicRows, q: np.ndarray) -> DensePosition | None:
    """Return a closed position near q where small singular values of D are zero; None if there is no closed position near q.

    Newton's method for Psi converges slowly to such a position.

    A gradient u . D that vanishes on the motion grows in proportion to the distance from it, along its right vector v.
    """
    at = rows.close(0.0, q)
    q = close_position(rows, 0.0, q, np) if at is None else at.q
    for _ in range(REFINEMENTS):
        _, length, D = rows.at(0.0, q)
        if not np.all(np.isfinite(D)):
            return at
        u, sigma, vt = np.linalg.svd(D)
        small = np.flatnonzero((sigma > DEPENDENT_TOL * sigma[0]) & (sigma <= SMALL_SINGULAR_VALUE * sigma[0]))
        for k in small:
            v = rows.metric * vt[k]
            growth = (u[:, k] / length) @ _second_derivatives(rows, 0.0, q, v[:, None])[0, 0]
            q = q - (sigma[k] / growth if abs(growth) > CLEAR_TOL else 0.0) * v
        moved = rows.close(0.0, q) if small.size else None
        at, q = (at, q) if moved is None else (moved, moved.q)
    return at


def _rank(position: DensePosition) -> int:
    """Return the rank of D with the threshold `CLEAR_TOL`.

    Near the motion, gradients that vanish on it are as large as the errors of the position.
    """
    return int(np.sum(position.sigma > CLEAR_TOL * position.sigma[0]))


def _held(mechanism: Mechanism, rows: KinematicRows, at: DensePosition) -> Iterator[HeldPin]:
    """Iterate over the pins that do not turn at a position, although Psi_q lets them."""
    _, length, D = rows.at(at.t, at.q)
    u, sigma, vt = np.linalg.svd(D)
    rank = int(np.sum(sigma > CLEAR_TOL * sigma[0]))
    stresses, tangents = u[:, rank:] / length[:, None], rows.metric[:, None] * vt[rank:].T
    if not stresses.size or not tangents.size:
        return
    curvatures = np.einsum("mk,abm->kab", stresses, _second_derivatives(rows, at.t, at.q, tangents))
    owners = np.array([name for name, _ in rows.names])
    for name, joint in mechanism.joints.items():
        if not isinstance(joint, Revolute) or f"{name}.angle" in mechanism.joints:
            continue
        places = [None if body == GROUND else 3 * mechanism.body_names.index(body) + 2 for body in joint.bodies]
        turn = sum(sign * tangents[k] for sign, k in zip((-1, 1), places, strict=True) if k is not None)
        square = np.outer(turn, turn)
        largest = np.abs(square).max()
        weights = np.linalg.lstsq(curvatures.reshape(len(curvatures), -1).T, square.ravel(), rcond=SQUARE_FIT_TOL)[0]
        error, stress = np.abs(np.einsum("k,kab->ab", weights, curvatures) - square).max(), stresses @ weights
        force = stress[owners == name]
        if largest > CLEAR_TOL and error <= SQUARE_FIT_TOL * largest and np.abs(force).max() > CLEAR_TOL * np.abs(stress).max():
            angles = [0.0 if k is None else float(at.q[k]) for k in places]
            yield HeldPin(name, tuple(joint.bodies), angles[1] - angles[0], float(np.arctan2(force[1], force[0])))


def _second_derivatives(rows: KinematicRows, t: Any, q: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """Return Psi_qq along all pairs of tangents (d, d, m), from gamma, which is quadratic in velocities."""
    d, at_rest = tangents.shape[1], rows.gamma(t, q, np.zeros(len(q)))

    def along(v: np.ndarray) -> np.ndarray:
        return at_rest - (rows.gamma(t, q, v) + rows.gamma(t, q, -v)) / 2

    squares, result = [along(v) for v in tangents.T], np.zeros((d, d, rows.count))
    for a in range(d):
        result[a, a] = squares[a]
        for b in range(a):
            mixed = (along(tangents[:, a] + tangents[:, b]) - squares[a] - squares[b]) / 2
            result[a, b] = result[b, a] = mixed
    return result


def _motion(mechanism: Mechanism, start: DensePosition) -> Iterator[DensePosition]:
    """Iterate over closed positions of a random motion, and of the drivers, from a position; none if this cannot be closed."""
    rows, random = KinematicRows(mechanism), np.random.default_rng(0)
    last, heading = rows.close(start.t, start.q), random.standard_normal(len(start.q))
    for k in range(TESTED_POSITIONS):
        if last is None:
            return
        step = rows.metric * last.tangent_part(heading)
        size = rows.step_size(step)
        t = rows.driver_time_step * (k + 1)
        moved = rows.close(t, last.q + (CLOSURE.longest_step * step / size if size > CLEAR_TOL else 0.0), give_up=True)
        last = last if moved is None else moved
        if moved is not None:
            yield moved


def _are_held(mechanism: Mechanism, pins: list[HeldPin], at: DensePosition) -> bool:
    """Return whether all pins are held at a position, each with the pins before it held by their angles."""
    for k, pin in enumerate(pins):
        holding = with_held_pins(mechanism, pins[:k])
        if pin.name not in {x.name for x in _held(holding, KinematicRows(holding), at)}:
            return False
    return True
