"""Forms of dyads: two links between a joint P on one link and a joint Q on another, with a slide in the place of a pin or not.

A form places its links, and passes their loads on by equilibrium. Its numbers `one` and `two` are

    PINS: the lengths P-R and Q-R; the pin R joins both links.
    RAIL: the length P-R, and the angle of a rail through Q on the other link, on which the second link slides; its pin is R.
    SLIDE: the distance of P from a line of the first link, on which the second link slides; its pin is Q. `two` is a usual
        length of the first link, from which random places are drawn: it moves nothing. R is the foot of P on the line.

The frame of a link has its origin at its pin P or Q, or R on a rail; its x axis points to R or along the slide.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

PINS, RAIL, SLIDE = range(3)
TINY = 1e-30  # squared length (RMS radii), far below rounding: keeps divisions finite where two points coincide
# Distance (RMS radii) that the line of a sliding link counts to be away from its pin at least: where the pins P and Q of a line
# through P nearly meet, the link turns too fast, as where its transmission angle vanishes.
LEAST_ARM = 0.05


class Dyads(NamedTuple):
    """Dyads of one form at angles of the crank: joints P, Q, R, and the unit numbers exp(i angle) of both links, (K, T) each.

    `one` and `two` (K, 1) are the numbers of the form; `cosine` (K, T) is that of the angle between both links.
    """

    P: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    turn1: np.ndarray
    turn2: np.ndarray
    one: np.ndarray
    two: np.ndarray
    cosine: np.ndarray


class DyadForces(NamedTuple):
    """Internal forces of dyads in equilibrium, and derivatives that follow from them, for three measures (K, 3, T).

    Attributes:
        force: the force from the first link on the second one, at Q, or at R on a rail, complex.
        couple: the couple on the link that carries the rail.
        by_one: derivatives of the measures with respect to `one`.
        by_two: derivatives of the measures with respect to `two`.
    """

    force: np.ndarray
    couple: np.ndarray | float
    by_one: np.ndarray
    by_two: np.ndarray | float


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the scalar products of vectors."""
    return np.real(a) * np.real(b) + np.imag(a) * np.imag(b)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors a and b: the moments of forces b at arms a."""
    return np.real(a) * np.imag(b) - np.imag(a) * np.real(b)


def lanes_of_forms(form: np.ndarray) -> Iterator[tuple[int, Any]]:
    """Yield each form that occurs among K dyads, with an index of the dyads that have it."""
    if (form == form[0]).all():
        yield int(form[0]), slice(None)
    else:
        yield from ((kind, np.flatnonzero(form == kind)) for kind in np.unique(form))


def place(
    form: int,
    P: np.ndarray,
    Q: np.ndarray,
    turn: np.ndarray,
    one: np.ndarray,
    two: np.ndarray,
    side: np.ndarray,
    least: float,
) -> tuple[Dyads, np.ndarray]:
    """Return the positions of dyads of a form, and the origins of their second links.

    Args:
        form: PINS, RAIL or SLIDE.
        P: the joints P (K, T).
        Q: the joints Q.
        turn: the unit numbers exp(i angle) of the links that carry Q.
        one: `one` of the form, as above (K, 1).
        two: `two` of the form.
        side: 1 or -1, the side of P-Q on which R is (K, 1).
        least: the sine of the angle between both links that replaces a smaller one, where a dyad cannot be closed.
    """
    way = Q - P
    square = np.real(way) ** 2 + np.imag(way) ** 2 + TINY
    if form == PINS:
        cosine = (one * one + two * two - square) / (2.0 * one * two)
        across = side * one * two * _sine(cosine, least) / square
        R = P + way * (0.5 + 0.5 * (one * one - two * two) / square + 1j * across)
        return Dyads(P, Q, R, (R - P) / one, (R - Q) / two, one, two, cosine), Q
    if form == RAIL:
        turn2 = turn * np.exp(1j * two)
        cosine = cross(turn2, way) / one
        turn1 = turn2 * (side * _sine(cosine, least) + 1j * cosine)
        R = P + one * turn1
        return Dyads(P, Q, R, turn1, turn2, one, two, cosine), R
    length = np.sqrt(square)
    turn1 = way / (length * (side * _sine(one / length, least) + 1j * one / length))
    return Dyads(P, Q, P + 1j * one * turn1, turn1, turn1, one, two, np.hypot(one, LEAST_ARM) / length), Q


def _sine(cosine: np.ndarray, least: float) -> np.ndarray:
    return np.sqrt(np.maximum(1.0 - cosine * cosine, least * least))


def balance(
    form: int, dyads: Dyads, moment1: np.ndarray, force2: np.ndarray, moment2: np.ndarray, squeeze: np.ndarray
) -> DyadForces:
    """Return the internal forces of dyads whose links carry loads (K, 3, T).

    Args:
        form: PINS, RAIL or SLIDE.
        dyads: the positions of the dyads.
        moment1: the moment on the first link, about its origin.
        force2: the force on the second link, complex.
        moment2: the moment on the second link, about its origin.
        squeeze: the derivative of the third measure with respect to the cosine (K, T).
    """
    P, Q, R, turn1, turn2, one, two, cosine = dyads
    e1, e2, s = turn1[:, None], turn2[:, None], squeeze
    if form == PINS:
        sine = one[:, None] * two[:, None] * cross(e1, e2) + TINY
        a1, a2 = moment1 * two[:, None] / sine, moment2 * one[:, None] / sine
        g = a1 * e2 + a2 * e1
        by_one, by_two = -dot(g, e1), dot(g, e2)
        by_one[:, 2] += s * (1.0 / two - cosine / one)
        by_two[:, 2] += s * (1.0 / one - cosine / two)
        g[:, 2] -= s / (one * two) * (Q - P)
        return DyadForces(g, 0.0, by_one, by_two)
    if form == RAIL:  # the second link is free along the rail, the first about P
        along = -dot(e2, force2)
        across = (moment1 / one[:, None] - along * cross(e1, e2)) / dot(e1, e2)
        g = (along + 1j * across) * e2
        by_one, couple = -dot(g, e1), moment2.copy()
        by_one[:, 2] -= s * cosine / one
        g[:, 2] += 1j * s / one * turn2
        couple[:, 2] -= s * dot(turn1, turn2)
        return DyadForces(g, couple, by_one, cross((R - Q)[:, None], force2 + g) + couple)
    way = Q - P
    square = np.real(way) ** 2 + np.imag(way) ** 2 + TINY
    a = (moment1 + moment2) / dot(way, turn1)[:, None]
    g, by_one = 1j * a * e1, -a
    by_one[:, 2] += s * one / np.sqrt((one * one + LEAST_ARM**2) * square)
    g[:, 2] -= s * cosine / square * way
    return DyadForces(g, 0.0, by_one, 0.0)
