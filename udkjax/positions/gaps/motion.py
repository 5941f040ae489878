"""Motions of bodies as polynomials between poses, in Bezier form: their control points bound their derivatives.

The parameter u of a motion driven by a driver is the driver's value s; but if the driver's range ends at toggles, u is the angle
in s = lower + (upper - lower) (1 - cos u) / 2, because positions at a toggle are smooth functions of u, not of s. The parameter
of a run is time.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.arrays import FULL_TURN
from udkjax.positions.assembling.channels import StateHistory
from udkjax.positions.assembling.coordinates import Coordinate, value_of
from udkjax.positions.following.kinematics import kinematics
from udkjax.positions.following.travel import travel
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError

FIRST_POSES = 361  # of a drive: a degree apart over a turn
# Relative to the mechanism's size: a pose is added halfway between two where the polynomial has a larger error.
POLYNOMIAL_TOL = 1e-11
MOST_HALVINGS = 8
PosesAndRates = Float[np.ndarray, "n 3 bodies 3"]  # positions of bodies and, last, of the ground, with two derivatives by u


class PolynomialMotion(NamedTuple):
    """A motion of bodies, with one polynomial of their poses in each interval (piece) of a parameter u.

    Attributes:
        u: the parameters at which the polynomials meet.
        points: the control points of x, y (m) and angle (rad) of each body, with the ground last; NaN where nothing is known.
        known: mask of the intervals with a polynomial: those of positive length with finite control points.
        unit: the unit of the driver's values, or "s" for a run.
        value: a function that returns the values of the driver (rad, m) or the times (s) at parameters u.
        toggles: whether the range ends at toggles.
    """

    u: Float[np.ndarray, "pieces+1"]
    points: Float[np.ndarray, "degree+1 3 bodies pieces"]
    known: Bool[np.ndarray, "pieces"]
    unit: str
    value: Callable[[Any], Any] = np.asarray
    toggles: bool = False

    @classmethod
    def of(cls, u: Float[np.ndarray, "n"], points: np.ndarray, unit: str) -> "PolynomialMotion":
        """Return the motion with these control points, whose parameter is the driver's value or time."""
        return cls(u, points, np.isfinite(points.reshape(-1, len(u) - 1).sum(0)) & (np.diff(u) > 0), unit)

    @property
    def missing(self) -> float:
        """The fraction of the range of u without polynomials."""
        return max(0.0, 1.0 - float(np.diff(self.u)[self.known].sum() / (self.u[-1] - self.u[0])))

    def at(self, u: Any, piece: Int[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses (n, bodies, 3) at parameters u in the given pieces, and their derivatives by u."""
        h = np.diff(self.u)[piece]
        q, v = de_casteljau(self.points[..., piece], (u - self.u[piece]) / h, h)
        return q.T, v.T


def de_casteljau(stage: Any, t: Any, h: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the values and the slopes of polynomials in Bezier form.

    Args:
        stage: their control points (degree+1, ...).
        t: the places, as fractions of the intervals, from 0 to 1.
        h: the lengths of the intervals.
    """
    degree = len(stage) - 1
    while len(stage) > 2:
        stage = stage[:-1] + t * (stage[1:] - stage[:-1])
    way = stage[1] - stage[0]
    return stage[0] + t * way, degree * way / h


def motion_of_run(run: StateHistory) -> PolynomialMotion:
    """Return the motion of a run: between output times, the cubics through positions and velocities."""
    ts, q, v = (np.asarray(x, float) for x in (run.ts, run.q, getattr(run, "slopes", run.v)))
    third, ends = np.diff(ts) / 3, np.empty((2, 3, q.shape[1] + 1, len(ts)))
    ends[0, :, :-1], ends[1, :, :-1] = q.T, v.T
    ends[:, :, -1] = 0.0 * ends[:, :, 0]  # the ground
    (q0, v0), (q1, v1) = ends[..., :-1], ends[..., 1:]
    motion = PolynomialMotion.of(ts, np.stack([q0, q0 + third * v0, q1 - third * v1, q1]), getattr(run, "unit", "") or "s")
    if not motion.known.any():
        raise ValueError("the run has no two states after each other, so that nothing moves between them")
    return motion


def motion_of_drive(mechanism: Mechanism, driver: str | Coordinate, values: Any, held: Any) -> PolynomialMotion:
    """Return the motion of a driven mechanism from the least to the largest of `values`; None: one turn, or between toggles.

    Raises a `SceneError` if `values` is None and an end of the driver's range is not known.
    """
    sample = partial(_poses, mechanism, driver, held)
    if values is None:
        limits = travel(mechanism, driver, None, held)
        lower, upper = float(limits.lower), float(limits.upper)
        if np.isfinite([lower, upper]).all():
            return _between_toggles(sample, lower, upper, np.stack([limits.lower_q, limits.upper_q]), limits.unit)
        if limits.unit != "rad" or np.isfinite([lower, upper]).any():
            problem = f"the range of {driver!r} from {lower:.6g} to {upper:.6g} {limits.unit} has an end that is not known"
            raise SceneError([f"{problem}; give the first and the last value, values=[first, last]"], mechanism.name)
        lower, unit = float(value_of(mechanism, driver)(mechanism.q0)), limits.unit
        upper = lower + FULL_TURN
    else:
        lower, upper = float(np.min(np.asarray(values))), float(np.max(np.asarray(values)))
        unit = kinematics(mechanism, driver, np.array([lower]), held=held).unit
    return _follow(sample, np.linspace(lower, upper, FIRST_POSES), unit)


def _poses(mechanism: Mechanism, driver: Any, held: Any, values: Float[np.ndarray, "n"]) -> PosesAndRates:
    motion = kinematics(mechanism, driver, values, held=held)
    x = np.stack([np.asarray(x) for x in (motion.q, motion.v, motion.a)], 1)
    return np.concatenate([x, 0.0 * x[:, :, :1]], 2)


def _between_toggles(
    sample: Callable[[Any], PosesAndRates], lower: float, upper: float, ends: np.ndarray, unit: str
) -> PolynomialMotion:
    half = 0.5 * (upper - lower)

    def value(u: Any) -> Any:
        return lower + half * (1 - np.cos(u))

    def by_angle(u: Float[np.ndarray, "n"]) -> PosesAndRates:
        x, (slope, bend) = sample(value(u)), half * np.array([np.sin(u), np.cos(u)])[:, :, None, None]
        return np.stack([x[:, 0], x[:, 1] * slope, x[:, 2] * slope**2 + x[:, 1] * bend], 1)

    places = np.concatenate([ends, np.zeros((2, 1, 3))], 1)
    motion = _follow(by_angle, np.linspace(0.0, np.pi, FIRST_POSES), unit, places)
    return motion._replace(value=value, toggles=True)


def _follow(
    sample: Callable[[Any], PosesAndRates], u: Float[np.ndarray, "n"], unit: str, toggles: Any = None
) -> PolynomialMotion:
    """Return the motion through sampled poses; intervals are halved until the polynomials agree with samples halfway.

    Args:
        sample: a function that returns poses and two derivatives by u at parameters.
        u: the first parameters.
        unit: the unit of the driver's values.
        toggles: the poses (2, bodies, 3) at both ends, if these are toggles, where derivatives cannot be sampled; otherwise None.
    """
    x = sample(u if toggles is None else u[1:-1])
    if toggles is not None:
        x = np.concatenate([np.zeros_like(x[:1]), x, np.zeros_like(x[:1])])
    places = x[np.isfinite(x).all((1, 2, 3)), 0, :-1, :2]
    size = np.array([*[float(np.ptp(places, axis=(0, 1)).max()) or 1.0] * 2, 1.0]) if len(places) else 1.0
    check = np.arange(len(u) - 1)
    for turn in range(MOST_HALVINGS + 1):
        if toggles is not None:
            x[0], x[-1] = _toggle(u[1] - u[0], x[1], toggles[0]), _toggle(u[-2] - u[-1], x[-2], toggles[1])
        motion = PolynomialMotion.of(u, _control_points(np.diff(u), x[:-1], x[1:]), unit)
        check = check[motion.known[check]]
        if turn == MOST_HALVINGS or not len(check):
            break
        middle = u[check] + 0.5 * np.diff(u)[check]
        between = sample(middle)
        off = (np.abs(motion.at(middle, check)[0] - between[:, 0]).max(1) / size).max(1)
        u, x = np.insert(u, check + 1, middle), np.insert(x, check + 1, between, axis=0)
        far = np.flatnonzero(off > 64 * POLYNOMIAL_TOL)  # half the length has 1/64 of the error
        check = np.sort(np.concatenate([check[far] + far, check[far] + far + 1]))
    if not motion.known.any():
        raise ValueError("no two neighbouring values of the driver are reached")
    return motion


def _control_points(h: Any, one: PosesAndRates, other: PosesAndRates) -> Float[np.ndarray, "6 3 bodies pieces"]:
    """Return the control points of polynomials of degree five, from positions and two derivatives at both ends of intervals h."""
    (q0, v0, a0), (q1, v1, a1) = (x.transpose(1, 3, 2, 0) for x in (one, other))
    b1, b4 = q0 + h * v0 / 5, q1 - h * v1 / 5
    return np.stack([q0, b1, 2 * b1 - q0 + h * h * a0 / 20, 2 * b4 - q1 + h * h * a1 / 20, b4, q1])


def _toggle(h: float, near: Float[np.ndarray, "3 bodies 3"], q: Float[np.ndarray, "bodies 3"]) -> np.ndarray:
    """Return the pose q at a toggle with two derivatives: those of the cubic through q and, at the distance h, the sample `near`.

    `near` has the next pose and its two derivatives. Angles of q are shifted by whole turns towards it.
    """
    place = q.copy()
    place[:, 2] += 2 * np.pi * np.round((near[0, :, 2] - place[:, 2]) / (2 * np.pi))
    # near = place + h c1 + h^2 c2 + h^3 c3, and its two derivatives
    d0, d1, d2 = near[0] - place, h * near[1], h * h * near[2]
    c3 = d0 - d1 + d2 / 2
    c2 = d2 / 2 - 3 * c3
    return np.stack([place, (d1 - 2 * c2 - 3 * c3) / h, 2 * c2 / h**2])
