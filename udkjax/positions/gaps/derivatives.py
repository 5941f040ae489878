"""Derivatives of least gaps with respect to numbers p of the mechanism, by the equations of the pose with the least gap.

That pose solves equations F(y, p) = 0, where y consists of z = (q, s) and further unknowns. Besides Psi(z) = 0 the equations are,
with g the gap: grad_z (g + lambda Psi) = 0 at a smooth minimum, g_1 = g_2 at a kink, where two features have the same gap,
s = const at an end of the range, and Psi_q w = 0, |w| = 1 at a toggle. Two steps of Newton's method with one Jacobian give first
and second derivatives of y; only that pose is differentiated, never the motion that leads to it.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.arrays import library_for, without_derivatives
from udkjax.positions.following.curve import Curve
from udkjax.positions.following.drive import drive
from udkjax.positions.gaps.convex import Feature, gap_at
from udkjax.positions.gaps.motion import PolynomialMotion
from udkjax.positions.gaps.search import Least
from udkjax.positions.gaps.shapes import ConvexPart
from udkjax.programs.deferred import deferred

SINGULAR_TOL = 1e-9  # of the largest singular value of the Jacobian: redundant rows, and gaps that are constant along a motion
NEWTON_STEPS = 3  # of Newton's method to the concrete pose, from the polynomials' rounding
CHORD_STEPS = 2  # with the Jacobian there: each makes one more order of the derivatives right


class DrivenPoses(NamedTuple):
    """Poses and constraints of a driven mechanism as functions of z = (q, s) in the units of a curve; s is the driver's value."""

    curve: Curve

    def psi(self, z: Array) -> Array:
        return self.curve.residual(z)

    def q(self, z: Array) -> Array:
        return (z * self.curve.units)[:-1].reshape(-1, 3)


class RunPoses(NamedTuple):
    """Poses on the cubic between two output times of a run as a function of z = (t,), with t from 0 to 1; no constraints."""

    ts: Float[Array, "2"]
    states: Float[Array, "2 2 bodies 3"]  # positions and velocities at both

    def psi(self, z: Array) -> Array:
        return jnp.zeros(0)

    def q(self, z: Array) -> Array:
        (q0, q1), (v0, v1) = self.states
        h, t = self.ts[1] - self.ts[0], z[0]
        b, c = q0 + h * v0 / 3, q1 - h * v1 / 3
        return (1 - t) ** 3 * q0 + 3 * t * (1 - t) ** 2 * b + 3 * t**2 * (1 - t) * c + t**3 * q1


PosesNear = DrivenPoses | RunPoses


class ClosestPair(NamedTuple):
    """The features at which two parts are closest: one, or two at a kink. All attributes but `bodies` and `radius` are stacked.

    Attributes:
        bodies: the indices of the bodies of both parts; the ground's is the last.
        corner: a corner of one part in the frame of its body (m), (features, 2).
        start: the start of an edge of the other part, in the frame of its body.
        end: the end of that edge.
        of_a: whether the corner belongs to the first part.
        side: as in `Feature`.
        at: as in `Feature`.
        radius: the sum of the radii of both parts (m).
    """

    bodies: Any
    corner: Array
    start: Array
    end: Array
    of_a: Any
    side: Any
    at: Any
    radius: Any

    def gap(self, q: Float[Array, "bodies 3"], k: int = 0) -> Array:
        """Return the gap (m) at feature k in the pose q, in which these features stay the closest ones."""
        poses = jnp.concatenate([q, jnp.zeros((1, 3))])[self.bodies]
        one, other = jnp.where(self.of_a[k], poses, poses[::-1])
        places = _placed(one, self.corner[k]), _placed(other, self.start[k]), _placed(other, self.end[k])
        return gap_at(*places, self.side[k], self.at[k])[0] - self.radius


def differentiable_gaps(
    mechanism: Any,
    driver: Any,
    run: Any,
    held: Any,
    parts: Sequence[ConvexPart],
    order: Sequence[str],
    least: Sequence[Least],
    m: PolynomialMotion,
) -> list[Array]:
    """Return the distances of least gaps (m) with first and second derivatives with respect to every traced number.

    Args:
        mechanism: the mechanism, with traced numbers.
        driver: the driver or coordinate; not used with a `run`.
        run: the run or `Kinematics`; None with a driver.
        held: values that other drivers or coordinates hold, by name, or None.
        parts: convex parts of the links, with traced numbers.
        order: names of the bodies in the order of poses, with the ground last.
        least: the least gaps that `search` has found for the concrete numbers.
        m: the motion of the concrete numbers.
    """
    curve = None if run is not None else Curve.of(drive(mechanism, driver, 0.0, held))
    found = []
    for x in least:
        q, v = (y[0, :-1] for y in m.at(np.array([x.u]), np.array([x.piece])))
        place: PosesNear
        if curve is None:
            place, z = _cubic(run, x.piece), (np.array([x.u]) - m.u[x.piece]) / np.diff(m.u)[x.piece]
        else:
            place, z = DrivenPoses(curve), np.append(q, m.value(x.u)) / np.asarray(without_derivatives(curve.units))
        kind = "kink" if len(x.features) > 1 else "end" if x.fixed else "smooth"
        if kind == "end" and m.toggles:
            kind = "toggle"
        found.append(_moved(kind, place, _pair(x, parts, order), z, v, x.distance))
    return found


def _moved(kind: str, place: PosesNear, pair: ClosestPair, z: np.ndarray, v: np.ndarray, distance: float) -> Array:
    """Return a least gap with its derivatives.

    Args:
        kind: "smooth", "kink", "end" or "toggle": the equations to solve.
        place: poses and constraints as functions of z.
        pair: the closest features.
        z: the concrete solution, up to the errors of the motion's polynomials.
        v: the derivatives of the pose by the motion's parameter (bodies, 3).
        distance: the least gap (m) of the concrete numbers, which is the value of the result.
    """
    given = without_derivatives((place, pair))
    more = np.zeros(given[0].psi(z).size if kind == "smooth" else 0)
    if kind == "toggle":
        way = np.ravel(v) / np.asarray(given[0].curve.units)[:-1]
        more = way / np.linalg.norm(way)
    y, fixed, plus = np.append(z, more), (z, more), np.zeros((0, 0))
    for _ in range(NEWTON_STEPS):
        F, J = map(np.asarray, _equations_at(kind, *given, fixed, y))
        plus = np.linalg.pinv(J, rcond=SINGULAR_TOL)
        y = y - plus @ F
    found = _gap_by_chords(kind, place, pair, fixed, y, plus)
    return distance + (found - jax.lax.stop_gradient(found))


def _equations(kind: str, place: PosesNear, pair: ClosestPair, fixed: tuple[Any, Any], y: Any) -> Array:
    """Return F(y), which is zero in the pose of the least gap.

    Args:
        kind: "smooth", "kink", "end" or "toggle".
        place: poses and constraints as functions of z.
        pair: the closest features.
        fixed: z at the start, and at a toggle a unit vector that normalizes w.
        y: z, followed by lambda at a smooth minimum and by w at a toggle.
    """
    start, more = fixed
    z, extra = y[: len(start)], y[len(start) :]
    psi = place.psi(z)

    def gap(z: Array, k: int = 0) -> Array:
        return pair.gap(place.q(z), k)

    if kind == "smooth":
        return jnp.append(psi, jax.grad(lambda z: gap(z) + extra @ place.psi(z))(z))
    if kind == "kink":
        return jnp.append(psi, gap(z) - gap(z, 1))
    if kind == "end":
        return jnp.append(psi, z[-1] - start[-1])
    turned = jax.jvp(place.psi, (z,), (jnp.append(extra, 0.0),))[1]
    return jnp.concatenate([psi, turned, jnp.array([more @ extra - 1.0])])


@deferred
def _equations_at(kind: str, *given: Any) -> tuple[Array, Array]:
    of = partial(_equations, kind, *given[:-1])
    return of(given[-1]), jax.jacfwd(of)(given[-1])


@deferred
def _gap_by_chords(kind: str, place: PosesNear, pair: ClosestPair, fixed: Any, y: Any, plus: Any) -> Array:
    step = lambda y, _: (y - plus @ _equations(kind, place, pair, fixed, y), None)  # noqa: E731
    y = jax.lax.scan(step, y, length=CHORD_STEPS)[0]
    return pair.gap(place.q(y[: len(fixed[0])]))


def _cubic(run: Any, k: int) -> RunPoses:
    ts, q, v = (jnp.asarray(x)[k : k + 2] for x in (run.ts, run.q, getattr(run, "slopes", run.v)))
    return RunPoses(ts, jnp.stack([q, v]))


def _pair(x: Least, parts: Sequence[ConvexPart], order: Sequence[str]) -> ClosestPair:
    pair = [parts[k] for k in x.parts]

    def corners(feature: Feature) -> tuple[Any, ...]:
        one, other = (part.corners for part in (pair if feature.of_a else pair[::-1]))
        return one[feature.corner], other[feature.start], other[feature.end], feature.of_a, feature.side, feature.at

    places = [library_for(x).stack(x) for x in zip(*(corners(feature) for feature in x.features), strict=True)]
    bodies = np.array([order.index(part.body) for part in pair])
    return ClosestPair._make((bodies, *places, pair[0].radius + pair[1].radius))


def _placed(pose: Array, point: Array) -> Array:
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    return pose[:2] + jnp.stack([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]])
