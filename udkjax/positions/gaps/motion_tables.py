"""Motions as tables: poses at many places of many bodies at a time, and bounds of their derivatives."""

import numpy as np
from jaxtyping import Float, Int

from udkjax.positions.gaps.motion import PolynomialMotion, de_casteljau

DERIVATIVE_ORDERS = 4  # of derivatives


class MotionTables:
    """A motion at places s = piece + t, with t from 0 to 1 within each piece; node k is the place s = k.

    The last axis of tables has piece p of body b at b * pieces + p.

    Attributes:
        starts: the first node of each chain of known pieces that follow each other.
        ends: the last node of each chain.
        piece_at: for each node, the index of the known piece that starts there, or else of the one that ends there.
        places: bounds over each piece of the first to fourth derivatives by u of the origin of each body; 0 where nothing is
            known.
        directions: the same bounds for a unit vector that turns with the body.
        lowest: the least coordinates of the origins of bodies at nodes (2, bodies).
        highest: the largest coordinates of the origins at nodes (2, bodies).
    """

    starts: Int[np.ndarray, "chains"]
    ends: Int[np.ndarray, "chains"]
    piece_at: Int[np.ndarray, "pieces+1"]
    places: Float[np.ndarray, "orders pieces"]
    directions: Float[np.ndarray, "orders pieces"]

    def __init__(self, motion: PolynomialMotion):
        known, pieces = motion.known, len(motion.known)
        self.motion, self.steps, self.pieces = motion, np.diff(motion.u), pieces
        self.starts = np.flatnonzero(known & ~np.append(False, known[:-1]))
        self.ends = np.flatnonzero(known & ~np.append(known[1:], False)) + 1
        self.piece_at = np.arange(pieces + 1) - ~np.append(known, False)
        controls = motion.points
        self.controls = controls.reshape(*controls.shape[:2], -1)
        ends = controls[:: len(controls) - 1, :2] if known.all() else controls[:: len(controls) - 1, :2, :, known]
        self.lowest, self.highest = ends.min((0, -1)), ends.max((0, -1))
        share = 1.0 / np.where(known, self.steps, np.inf)
        largest, stage = np.zeros((2, DERIVATIVE_ORDERS, *controls.shape[2:])), controls
        for k in range(min(DERIVATIVE_ORDERS, len(controls) - 1)):
            stage = (stage[1:] - stage[:-1]) * ((len(stage) - 1) * share)
            largest[0, k] = np.sqrt((stage[:, 0] * stage[:, 0] + stage[:, 1] * stage[:, 1]).max(0))
            largest[1, k] = np.abs(stage[:, 2]).max(0)
        if not known.all():
            largest = np.where(known, largest, 0.0)
        self.places, self.directions = (
            largest[0].reshape(DERIVATIVE_ORDERS, -1),
            turning(largest[1].reshape(DERIVATIVE_ORDERS, -1)),
        )
        self._over = {1: np.stack([self.places[:2], self.directions[:2]])}

    def over(self, count: int) -> Float[np.ndarray, "2 2 pieces"]:
        """Return bounds of first and second derivatives over `count` pieces, a power of two, beginning with each piece.

        The first axis is that of `places` and `directions`, the second that of the order.
        """
        if count not in self._over:
            half = self.over(count // 2).reshape(2, 2, -1, self.pieces)
            found = half.copy()
            np.maximum(half[..., : -(count // 2)], half[..., count // 2 :], out=found[..., : -(count // 2)])
            self._over[count] = found.reshape(2, 2, -1)
        return self._over[count]

    def parameters(self, s: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the parameters u at places s."""
        piece = self.piece_at[s.astype(int)]
        return self.motion.u[piece] + (s - piece) * self.steps[piece]

    def poses(self, body: Int[np.ndarray, "n"], s: Float[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses (3, n) of n bodies, each at its place s, and their derivatives by u."""
        piece = self.piece_at[s.astype(int)]
        return de_casteljau(self.controls.take(body * self.pieces + piece, -1), s - piece, self.steps[piece])


def turning(of_angles: Float[np.ndarray, "orders ..."]) -> Float[np.ndarray, "orders ..."]:
    """Return bounds of the derivatives of a unit vector from those of its angle, by complete Bell polynomials."""
    a, b, c, d = of_angles
    square = a * a
    return np.stack([a, b + square, c + a * (3 * b + square), d + 4 * a * c + 3 * b * b + square * (6 * b + square)])
