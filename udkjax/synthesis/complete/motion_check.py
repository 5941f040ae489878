"""Verification by motions: the positions that the driver reaches from another position of the same branch."""

from functools import cache
from typing import NamedTuple

import numpy as np

from udkjax.positions.following.position_batch import PositionBatch
from udkjax.scene.drawing import Drawing
from udkjax.synthesis.complete.four_bars import Classification, FourBars

REACHED_TOL = 1e-6  # largest distance of the traced point from its place, relative to the extent of the places


class _BranchMotion(NamedTuple):
    """A motion: the four-bar, the position in which it is drawn, and the positions to pass with values of the driver."""

    member: int
    first: int
    positions: list[int]
    values: list[float]


def check_motions(bars: FourBars, classification: Classification) -> np.ndarray:
    """Return a mask of the positions (M, J) that motions reach; each branch is followed from its first position.

    A four-bar drawn in that position is driven by its crank and closed at each value; the traced point of the coupler has to
    reach its place at the value that the classification computed, without leaving the branch.
    """
    M, J = classification.values.shape
    confirmed = np.zeros((M, J), bool)
    motions = [motion for m in range(M) for motion in _motions_of(m, classification)]
    if not motions:
        return confirmed
    longest = max(len(motion.values) for motion in motions)
    members, first = (np.array([getattr(motion, name) for motion in motions]) for name in ("member", "first"))
    ends = np.array([motion.values + motion.values[-1:] * (longest - len(motion.values)) for motion in motions])
    start = bars.crank_angles[members, first]
    joints = {"O": bars.O[members], "C": bars.C[members], "A": bars.A[members, first], "B": bars.B[members, first]}
    pins = {f"pin.{name}": np.stack([np.real(z), np.imag(z)], 1) for name, z in joints.items()}
    moved = skeleton()(pins, start[:, None] + ends - ends[:, :1])
    body = moved.bodies.index("coupler")
    origin = moved.q[:, :, body, 0] + 1j * moved.q[:, :, body, 1]
    turn = np.exp(1j * (moved.q[:, :, body, 2] - moved.q[:, :1, body, 2]))
    traced = origin + turn * (bars.P[first] - origin[:, 0])[:, None]
    tol = REACHED_TOL * np.max(np.abs(bars.P - bars.P.mean()))
    for k, motion in enumerate(motions):
        for n, j in enumerate(motion.positions):
            confirmed[motion.member, j] |= bool(moved.reached[k, n] and np.abs(traced[k, n] - bars.P[j]) <= tol)
    return confirmed


@cache
def skeleton() -> PositionBatch:
    """Return the compiled solver for positions of four-bars by their pins O, A, B, C, which is cached."""
    pins = {"O": (0.0, 0.0), "A": (3.0, 4.0), "B": (12.0, 9.0), "C": (10.0, 0.0)}
    links = {name: {"pins": list(ends), "mass": 1.0} for name, ends in (("crank", "OA"), ("coupler", "AB"), ("rocker", "CB"))}
    mechanism = Drawing(pins, links, ground=["O", "C"]).mechanism()
    return PositionBatch(mechanism, "body.crank.angle", [f"pin.{name}" for name in pins])


def _motions_of(m: int, classification: Classification) -> list[_BranchMotion]:
    """Return the motions of four-bar m along each branch: a turn of the crank, or both directions from the first position."""
    motions = []
    for branch in range(classification.branches[m].max() + 1):
        places = np.flatnonzero(classification.branches[m] == branch)
        first, values = int(places[0]), classification.values[m]
        away = values[places] - values[first]
        if classification.turns[m]:
            away = np.mod(away, 2 * np.pi)
        for sign in (1, -1):
            of_way = places[(away * sign >= 0)]
            order = of_way[np.argsort(np.abs(away[away * sign >= 0]), kind="stable")]
            if sign > 0 or len(order) > 1:
                steps = [float(away[np.flatnonzero(places == j)[0]]) for j in order]
                motions.append(_BranchMotion(m, first, [int(j) for j in order], steps))
    return motions
