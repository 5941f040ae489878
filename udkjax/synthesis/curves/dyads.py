"""Linkages of dyads in lanes, many at once: every position by an intersection of circles or lines, derivatives by statics.

Link 0 is the ground, link 1 the crank, link 2 a second crank that turns `ratio` times as fast, by a belt. Dyad d adds the links
3 + 2 d, with its joint P on one link, and 4 + 2 d, with its joint Q on another one; `dyad_forms` says how these two are joined.
The drawing pin is a point of the last dyad's first link. The frame of a crank has its origin at its pivot.

The numbers x of a linkage are: the place of O (2), the part of the turn that draws the curve (rad), the pivot of the second crank
(2) and its angle at the beginning (rad), for each dyad the places of P and Q on their links (4) and the two numbers of its form,
and the place of the drawing pin on its link (2). Places are complex numbers.
"""

from typing import Any, NamedTuple

import numpy as np

from udkjax.synthesis.curves.dyad_forms import SLIDE, Dyads, balance, cross, dot, lanes_of_forms, place

BASE_LINKS = 3  # links without dyads
HEAD_NUMBERS, DYAD_NUMBERS, TAIL_NUMBERS = 6, 6, 2  # numbers before the dyads, of each dyad, and after them
SPAN_INDEX, SECOND_PIVOT, SECOND_ANGLE = 2, 3, 5  # indices of the part of the turn, and of the second crank's pivot and angle
GEARED_CRANK = 2  # number of the second crank


class Topology(NamedTuple):
    """Structures of K linkages of D dyads.

    Attributes:
        first: number of the link that carries P (K, D).
        second: number of the link that carries Q (K, D).
        side: 1 or -1, the side of P-Q on which R is (K, D).
        form: PINS, RAIL or SLIDE of `dyad_forms` (K, D).
        ratio: turns of the second crank for one of the crank, a whole number; 0 if there is none (K,).
    """

    first: np.ndarray
    second: np.ndarray
    side: np.ndarray
    form: np.ndarray
    ratio: np.ndarray

    def take(self, which: Any) -> "Topology":
        """Return the structures that `which`, a mask or indices, selects."""
        return Topology(*(a[which] for a in self))

    @property
    def dyads(self) -> int:
        """The number of dyads."""
        return self.first.shape[1]


class DyadPositions(NamedTuple):
    """Positions of K linkages at T angles of the crank.

    Attributes:
        origins: origins of all links (L, K, T).
        turns: unit numbers exp(i angle) of all links (L, K, T).
        ends: joints R (D, K, T).
        cosines: cosines of the angles between the two links of each dyad, beyond 1 where it cannot be closed (D, K, T).
        pin: the drawing pin (K, T).
    """

    origins: np.ndarray
    turns: np.ndarray
    ends: np.ndarray
    cosines: np.ndarray
    pin: np.ndarray


def number_count(dyads: int) -> int:
    """Return the length of the vector x of a linkage with this number of dyads."""
    return HEAD_NUMBERS + DYAD_NUMBERS * dyads + TAIL_NUMBERS


def _complex(x: np.ndarray, k: int) -> np.ndarray:
    return (x[:, k] + 1j * x[:, k + 1])[:, None]


def positions(x: np.ndarray, topology: Topology, theta: np.ndarray, least: float = 0.05) -> DyadPositions:
    """Return the positions of linkages (K, numbers) at angles (K, T) of the crank.

    Where a dyad cannot be closed, the sine of the angle between its links is replaced by `least`.
    """
    (K, T), D = theta.shape, topology.dyads
    z, u = np.zeros((BASE_LINKS + 2 * D, K, T), complex), np.ones((BASE_LINKS + 2 * D, K, T), complex)
    ends, cosines, lanes = np.empty((D, K, T), complex), np.empty((D, K, T)), np.arange(K)
    z[1], u[1] = _complex(x, 0), np.exp(1j * theta)
    if topology.ratio.any():
        z[GEARED_CRANK], u[GEARED_CRANK] = (
            _complex(x, SECOND_PIVOT),
            np.exp(1j * (topology.ratio[:, None] * theta + x[:, SECOND_ANGLE, None])),
        )
    for d in range(D):
        k = HEAD_NUMBERS + DYAD_NUMBERS * d
        A, B = topology.first[:, d], topology.second[:, d]
        P = z[A, lanes] + u[A, lanes] * _complex(x, k)
        Q = z[B, lanes] + u[B, lanes] * _complex(x, k + 2)
        z[BASE_LINKS + 2 * d] = P
        one, two, side = x[:, k + 4, None], x[:, k + 5, None], topology.side[:, d, None]
        for form, w in lanes_of_forms(topology.form[:, d]):
            at, z[BASE_LINKS + 2 * d + 1, w] = place(form, P[w], Q[w], u[B, lanes][w], one[w], two[w], side[w], least)
            u[BASE_LINKS + 2 * d, w], u[BASE_LINKS + 2 * d + 1, w] = at.turn1, at.turn2
            ends[d, w], cosines[d, w] = at.R, at.cosine
    last = BASE_LINKS + 2 * D - 2
    return DyadPositions(z, u, ends, cosines, z[last] + u[last] * _complex(x, x.shape[1] - TAIL_NUMBERS))


def gradients(
    x: np.ndarray,
    topology: Topology,
    at: DyadPositions,
    share: np.ndarray,
    pulls: np.ndarray,
    pushes: np.ndarray,
    squeeze: np.ndarray,
) -> np.ndarray:
    """Return derivatives (K, numbers, 3, T) of the pin's x and y, and of a third measure, with respect to all numbers.

    The derivative of a point in a direction is the work of a unit force there, so that they follow from equilibrium, from the
    last dyad to the crank.

    Args:
        x: the numbers of the linkages (K, numbers).
        topology: their structures.
        at: their positions.
        share: derivative of the crank's angle with respect to the part of the turn that draws the curve (T,).
        pulls: derivatives of the third measure with respect to the joints P and Q (2, D, K, T), complex.
        pushes: derivatives of the third measure with respect to the joints R (D, K, T), complex.
        squeeze: derivatives of the third measure with respect to the cosines (D, K, T).
    """
    z, u = at.origins, at.turns
    L, K, T = z.shape
    D, lanes = topology.dyads, np.arange(K)
    force, moment = np.zeros((L, K, 3, T), complex), np.zeros((L, K, 3, T))
    result = np.zeros((K, x.shape[1], 3, T))

    def load(link: np.ndarray | int, w: Any, point: np.ndarray, f: np.ndarray, k: int) -> None:
        which = (link, lanes[w])
        arm, local = (point - z[which])[:, None], np.conj(f) * u[which][:, None]
        force[which] += f
        moment[which] += cross(arm, f)
        result[w, k] += np.real(local)
        result[w, k + 1] -= np.imag(local)

    unit, every = np.zeros((K, 3, T), complex), slice(None)
    unit[:, 0], unit[:, 1] = 1.0, 1j
    load(L - 2, every, at.pin, unit, x.shape[1] - TAIL_NUMBERS)
    for d in range(D - 1, -1, -1):
        k, first, second = HEAD_NUMBERS + DYAD_NUMBERS * d, BASE_LINKS + 2 * d, BASE_LINKS + 2 * d + 1
        A, B, one, two = topology.first[:, d], topology.second[:, d], x[:, k + 4, None], x[:, k + 5, None]
        force[first][:, 2] += pulls[0, d] + pushes[d]
        moment[first][:, 2] += cross(at.ends[d] - z[first], pushes[d])
        force[second][:, 2] += pulls[1, d]
        P, Q, point = z[first], z[B, lanes] + u[B, lanes] * _complex(x, k + 2), z[second]
        for form, w in lanes_of_forms(topology.form[:, d]):
            dyads = Dyads(P[w], Q[w], at.ends[d, w], u[first, w], u[second, w], one[w], two[w], at.cosines[d, w])
            found = balance(form, dyads, moment[first, w], force[second, w], moment[second, w], squeeze[d, w])
            outward = dyads.turn1 * (1j if form == SLIDE else 1.0)
            result[w, k + 4] += found.by_one
            result[w, k + 4, 2] += dot(outward, pushes[d, w])
            result[w, k + 5] += found.by_two
            moment[B[w], lanes[w]] += found.couple
            load(A[w], w, P[w], force[first, w] - found.force, k)
            load(B[w], w, point[w], force[second, w] + found.force, k + 2)
    for k, crank in ((0, 1), (SECOND_PIVOT, GEARED_CRANK)):
        result[:, k] += np.real(force[crank])
        result[:, k + 1] += np.imag(force[crank])
    result[:, SECOND_ANGLE] += moment[GEARED_CRANK]
    result[:, SPAN_INDEX] += (moment[1] + topology.ratio[:, None, None] * moment[GEARED_CRANK]) * share
    return result
