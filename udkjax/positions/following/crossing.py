"""A point of a curve at or near a meeting of branches, from points of the same branch on both sides.

At a meeting E has a second null vector, so Newton's method is inaccurate: its errors are r = sqrt(rounding) in q, r / distance in
q' and r / distance^2 in q''. But the branch is smooth. It is therefore followed to twelve values around the point, two to seven
steps h away on either side, where E is well conditioned; q, q' and q'' are those of the polynomials through these values, with
errors of order h^12. The differences from the polynomials through ten values bound the errors. The h with the smallest bound is
used, and accepted if the bound is small and the position closes up to rounding. The position does not close where branches merely
come close to each other, since the curve turns between them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.positions.following.curve import AbstractCurve

# Bounds on singular values sigma of E, relative to the largest. Near a meeting of branches, rounding errors are 1e-16 / sigma in
# q, 1e-16 / sigma^2 in q' and 1e-16 / sigma^3 in q'', which is interpolated below NEAR_LOSS; below LOST_RANK no digit is correct.
NEAR_LOSS, LOST_RANK = CLOSURE.digits.clear, 1e-5
# Largest scaled distance from a meeting at which a step along the tangent still crosses it; the tangent turns by about a degree.
CLOSE_DISTANCE = 0.02
# Values of h, scaled. Errors of the polynomials are 3e-10, 3e-15 and less with these, if the next singularity of q(s) is one unit
# away, and rounding errors of q'' are 2e-13, 2e-12 and 1e-11, if sigma grows by one per unit. With the smallest h the nearest
# point is at NEAR_LOSS.
SPACINGS = (0.04, 0.015, 0.005)
# Distances from the point to the nearest and the farthest of the twelve others, in steps of h. Interpolation multiplies
# their errors by 13. With fewer points the polynomials are less accurate; with more or nearer ones rounding errors grow.
NEAREST_NODE, FARTHEST_NODE = 2, 7
# Bounds on how the polynomials through twelve and ten values differ in q, q' and q'', scaled: a hundred times their error.
ACCEPTED_DIFFERENCES = (1e-9, 1e-7, 1e-5)
ROOT_STEPS = 6  # Newton steps to the extremum of a polynomial; each doubles the number of digits, two at the start


def weights(last: int) -> np.ndarray:
    """Return the weights of Lagrange interpolation at zero from the nodes -last..-NEAREST_NODE and NEAREST_NODE..last."""
    steps = nodes(last)
    return np.array([np.prod([-m / (k - m) for m in steps if m != k]) for k in steps])


def _slope_weights() -> np.ndarray:
    """Return the weights of values at the nodes, spaced by one, in the derivative at zero."""
    steps = nodes(FARTHEST_NODE)
    return weights(FARTHEST_NODE) * np.array([sum(-1 / m for m in steps if m != k) for k in steps])


def nodes(last: int) -> np.ndarray:
    """Return the positions of the nodes in units of h: -last..-NEAREST_NODE and NEAREST_NODE..last."""
    side = np.arange(NEAREST_NODE, last + 1)
    return np.concatenate([-side[::-1], side])


class Crossing(NamedTuple):
    """A point of a branch where branches meet, interpolated from both sides."""

    at: Float[Array, "n+1"]  # q and the value s
    slope: Float[Array, "n+1"]  # unit tangent of the curve
    dq: Float[Array, "n"]  # derivatives of q by s, as the next two
    ddq: Float[Array, "n"]
    dddq: Float[Array, "n"]
    spacing: Float[Array, ""]  # the step h


def _has_digits(curve: AbstractCurve, X: Array, tau: Array) -> Bool[Array, ""]:
    """Return True if enough digits of q'' are correct without interpolation."""
    by, xp, rule = curve.by, curve.by.xp, CLOSURE.digits
    sigma = by.map(curve.clearance, X + rule.arc * xp.array([0.0, -1.0, 1.0])[:, None] * tau)
    return rule.hold(sigma[0], xp.max(xp.abs(sigma - sigma[0])) / rule.arc)


def find_crossing(curve: AbstractCurve, X: Float[Array, "n+1"], tau: Float[Array, "n+1"]) -> tuple[Crossing, Bool[Array, ""]]:
    """Return a point of the branch with q', q'' and q''', interpolated from points on both sides.

    Args:
        curve: the curve.
        X: an approximation of the point, exact in the value.
        tau: the approximate direction of the branch.

    Returns:
        The crossing, and whether it is accepted; False if q'' is accurate enough without interpolation.
    """

    def tried(h: Float[Array, ""]) -> tuple[Array, Array, Array, Array, Array]:
        return _interpolate(curve, X, tau, h)

    def interpolated() -> tuple[Crossing, Bool[Array, ""]]:
        *values, doubt = by.map(tried, spacings)
        at, dq, ddq, dddq, h, doubt = (x[xp.argmin(doubt)] for x in (*values, spacings, doubt))
        slope = xp.append(dq * curve.units[-1] / curve.units[:-1], 1.0)
        slope = slope / xp.linalg.norm(slope) * xp.where(slope @ tau < 0, -1.0, 1.0)
        return Crossing(at, slope, dq, ddq, dddq, h), doubt < 1.0

    by, xp = curve.by, curve.by.xp
    spacings, unknown = xp.asarray(SPACINGS, X.dtype), xp.zeros_like(X[:-1])
    none = Crossing(X, tau, unknown, unknown, unknown, spacings[0]), xp.asarray(False)
    return by.cond(_has_digits(curve, X, tau), lambda: none, interpolated)


def find_toggle(curve: AbstractCurve, X: Float[Array, "n+1"], tau: Float[Array, "n+1"]) -> tuple[Array, Bool[Array, ""]]:
    """Return a toggle where branches meet: the extremum of the value along the branch, from points on both sides.

    q and the value are polynomials of the distance along tau.

    Args:
        curve: the curve.
        X: a point close to the toggle.
        tau: the approximate direction of the branch.

    Returns:
        The toggle, and whether it is accepted.
    """
    by, xp = curve.by, curve.by.xp
    toggles, doubt = by.map(lambda h: _extremum(curve, X, tau, h), xp.asarray(SPACINGS, X.dtype))
    best = xp.argmin(doubt)
    return toggles[best], doubt[best] < 1.0


def _extremum(curve: AbstractCurve, X: Array, tau: Array, h: Array) -> tuple[Array, Array]:
    """Return the point with the extreme value, from points h apart along tau, and an error bound; below 1 it is accepted."""
    by, xp = curve.by, curve.by.xp
    first_offsets = NEAREST_NODE * h * xp.array([-1.0, 1.0])[:, None] * tau

    def outward(state: tuple[Array, Array], k: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        previous, last = state
        predicted = xp.where(k == NEAREST_NODE, X + first_offsets, last + (last - previous))
        at, are_closed = by.map(curve.correct, predicted)
        inner = at + (xp.mean(at, 0) - at) / NEAREST_NODE  # one step h inside the nearest nodes
        return (xp.where(k == NEAREST_NODE, inner, last), at), (at, are_closed)

    start = xp.stack([X, X])
    _, (sides, closed) = by.scan(outward, (start, start), xp.arange(NEAREST_NODE, FARTHEST_NODE + 1.0))
    points = xp.concatenate([sides[::-1, 0], sides[:, 1]])  # (12, n + 1)
    abscissas = (points - X) @ tau / (FARTHEST_NODE * h)
    # Newton's divided differences, of all points and of all but the first
    differences, coefficients, without_first = points, [points[0]], [points[1]]
    for k in range(1, len(points)):
        differences = (differences[1:] - differences[:-1]) / (abscissas[k:] - abscissas[:-k])[:, None]
        coefficients.append(differences[0])
        without_first += [differences[1]] if k < len(points) - 2 else []
    root = xp.zeros((), X.dtype)
    for _ in range(ROOT_STEPS):
        _, slope, bend = _evaluate_at(root, coefficients, abscissas)
        root = xp.clip(root - slope[-1] / bend[-1], -1.0, 1.0)
    at = _evaluate_at(root, coefficients, abscissas)[0]
    doubt = xp.max(xp.abs(at - _evaluate_at(root, without_first, abscissas[1:])[0])) / ACCEPTED_DIFFERENCES[0]
    at = at - curve.plus(curve.slopes(at), NEAR_LOSS) @ curve.residual(at)  # close the part that E resolves well
    accepted = xp.all(closed) & curve.is_closed(at) & (xp.abs(root) < 1.0) & xp.isfinite(doubt)
    return at, xp.where(accepted, doubt, xp.inf)


def _evaluate_at(x: Array, coefficients: list[Array], abscissas: Array) -> tuple[Array, Array, Array]:
    """Return Newton's polynomial, its slope and its second derivative at x."""
    value, slope, bend = coefficients[-1], 0.0 * coefficients[-1], 0.0 * coefficients[-1]
    for k in range(len(coefficients) - 2, -1, -1):
        distance = x - abscissas[k]
        bend, slope, value = bend * distance + 2 * slope, slope * distance + value, value * distance + coefficients[k]
    return value, slope, bend


def _interpolate(curve: AbstractCurve, X: Array, tau: Array, h: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return the point with the value of X, q', q'' and q''', from values h apart, and an error bound, accepted below 1."""
    by, xp = curve.by, curve.by.xp
    slope = tau / xp.where(tau[-1] != 0, tau[-1], 1.0)
    signs = xp.array([-1.0, 1.0])
    first_offsets = NEAREST_NODE * h * signs[:, None] * slope

    def outward(state: tuple[Array, Array], k: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        previous, last = state
        predicted = xp.where(k == NEAREST_NODE, X + first_offsets, last + (last - previous))
        value = xp.where(k == NEAREST_NODE, predicted[:, -1:], (X[-1] + signs * k * h)[:, None])
        at, are_closed = by.map(lambda x: curve.correct(x, fixed=True), xp.concatenate([predicted[:, :-1], value], 1))
        inner = at + (xp.mean(at, 0) - at) / NEAREST_NODE  # one step h inside the nearest nodes
        return (xp.where(k == NEAREST_NODE, inner, last), at), (at, are_closed)

    start = xp.stack([X, X])
    _, (sides, closed) = by.scan(outward, (start, start), xp.arange(NEAREST_NODE, FARTHEST_NODE + 1.0))
    down, up = sides[:, 0], sides[:, 1]
    points = xp.concatenate([down[::-1], up])  # (12, n + 1)
    units = curve.units

    def at_point(x: Array) -> tuple[Array, Array]:
        dq, ddq, _ = curve.derivatives(x[-1] * units[-1], x[:-1] * units[:-1])
        return dq, ddq

    slopes = by.map(at_point, points)
    scaled = points[:, :-1], slopes[0] * units[-1] / units[:-1], slopes[1] * units[-1] ** 2 / units[:-1]
    twelve, ten = weights(FARTHEST_NODE), np.pad(weights(FARTHEST_NODE - 1), 1)
    q, dq, ddq = (xp.asarray(twelve @ x) for x in scaled)
    dddq = xp.asarray(_slope_weights() @ scaled[2]) / h
    doubts = [
        xp.max(xp.abs((twelve - ten) @ x), initial=0.0) / bound for x, bound in zip(scaled, ACCEPTED_DIFFERENCES, strict=True)
    ]
    at = xp.append(q, X[-1])
    E = xp.where(np.arange(len(at)) == len(at) - 1, 0.0, curve.slopes(at))
    at = at - curve.plus(E, NEAR_LOSS) @ curve.residual(at)  # close the part that E resolves well
    accepted = xp.all(closed) & curve.is_closed(at) & (tau[-1] != 0)
    doubt = xp.where(accepted, xp.max(xp.stack(doubts)), xp.inf)
    doubt = xp.where(xp.isfinite(doubt), doubt, xp.inf)
    dq, ddq, dddq = (x * units[:-1] / units[-1] ** k for k, x in ((1, dq), (2, ddq), (3, dddq)))
    return at, dq, ddq, dddq, doubt
