"""Motions of four-bars that were found: which of their positions does each driver reach from another one of the same branch."""

from typing import NamedTuple

import numpy as np

from udkjax.study.position_batch import PositionBatch
from udkjax.study.synthesis.drawn_four_bar import DrawnFourBar
from udkjax.study.synthesis.four_bars import Classification, FourBars

REACHED_TOL = 1e-6  # of the extent of the places: how near to its place the traced point comes


class _BranchMotion(NamedTuple):
    """One motion: the four-bar, the position it is drawn in, and the positions it is to pass, at values of the driver."""

    member: int
    first: int
    positions: list[int]
    values: list[float]


def check_motions(drawn: DrawnFourBar, bars: FourBars, found: Classification) -> np.ndarray:
    """Return which positions (M, J) motions confirm: each branch's are passed from the first one of them on.

    A mechanism, drawn in that position, is driven by its crank, closed again at each value; the traced point has to come to its
    place at the value that the classification says, without leaving its branch.
    """
    M, J = found.values.shape
    confirmed = np.zeros((M, J), bool)
    motions = [motion for m in range(M) for motion in _motions_of(m, found)]
    if not motions:
        return confirmed
    longest = max(len(motion.values) for motion in motions)
    members, first = (np.array([getattr(motion, name) for motion in motions]) for name in ("member", "first"))
    ends = np.array([motion.values + motion.values[-1:] * (longest - len(motion.values)) for motion in motions])
    start = drawn.drawn_values(bars.crank_angles[members, first])
    names = [f"pin.{name}" for name in drawn.pins.values()]
    batch = PositionBatch(drawn.mechanism, drawn.driver, names)
    moved = batch(drawn.places(bars, members, first), start[:, None] + drawn.sign * (ends - ends[:, :1]))
    body = moved.bodies.index(drawn.coupler)
    place = moved.q[:, :, body, 0] + 1j * moved.q[:, :, body, 1]
    turn = np.exp(1j * (moved.q[:, :, body, 2] - moved.q[:, :1, body, 2]))
    traced = place + turn * (bars.P[first] - place[:, 0])[:, None]
    tol = REACHED_TOL * np.max(np.abs(bars.P - bars.P.mean()))
    for k, motion in enumerate(motions):
        for n, j in enumerate(motion.positions):
            confirmed[motion.member, j] |= bool(moved.reached[k, n] and np.abs(traced[k, n] - bars.P[j]) <= tol)
    return confirmed


def _motions_of(m: int, found: Classification) -> list[_BranchMotion]:
    """Return motions along each branch: of a crank that turns one turn, else from the first position one way, and the other."""
    motions = []
    for branch in range(found.branches[m].max() + 1):
        places = np.flatnonzero(found.branches[m] == branch)
        first, values = int(places[0]), found.values[m]
        away = values[places] - values[first]
        if found.turns[m]:
            away = np.mod(away, 2 * np.pi)
        for way in (1, -1):
            of_way = places[(away * way >= 0)]
            order = of_way[np.argsort(np.abs(away[away * way >= 0]), kind="stable")]
            if way > 0 or len(order) > 1:
                steps = [float(away[np.flatnonzero(places == j)[0]]) for j in order]
                motions.append(_BranchMotion(m, first, [int(j) for j in order], steps))
    return motions
