"""Four-bars in their positions: joints as complex numbers, cognates, kinds by Grashof, circuits, branches and order.

The positions of a four-bar form circuits; to change its circuit, the four-bar has to be taken apart. A driver moves it along a
branch of a circuit, from one dead point to the next, or all the way round.
"""

from itertools import permutations
from typing import NamedTuple

import numpy as np

from udkjax.synthesis.complete.balls import Ball, ComplexBall
from udkjax.synthesis.complete.certificate import Certificate

GRASHOF_KINDS = (
    "double crank",
    "crank-rocker",
    "double rocker",
    "rocker-crank",
    "triple rocker",
)  # by the shortest link; the last if Grashof's condition is not met
IN_ORDER, CIRCUIT, BRANCH, ORDER = 0, 1, 2, 3  # defects of a motion through all positions
DEFECTS = ("none", "circuit", "branch", "order")


class FourBars(NamedTuple):
    """M four-bars in J positions.

    Attributes:
        O: the fixed joint of the crank, the driven link (M,).
        C: the fixed joint of the rocker (M,).
        A: the moving joint of the crank (M, J).
        B: the moving joint of the rocker (M, J).
        P: the traced point (J,).
    """

    O: np.ndarray  # noqa: E741  # as it is drawn
    C: np.ndarray
    A: np.ndarray
    B: np.ndarray
    P: np.ndarray

    def take(self, which: np.ndarray) -> "FourBars":
        """Return the four-bars that `which`, a mask or indices, selects."""
        return FourBars(self.O[which], self.C[which], self.A[which], self.B[which], self.P)

    def swapped(self) -> "FourBars":
        """Return the same four-bars, with crank and rocker exchanged."""
        return FourBars(self.C, self.O, self.B, self.A, self.P)

    def cognates(self) -> "tuple[FourBars, FourBars, FourBars]":
        """Return Roberts's three cognates of each four-bar; the point traces the same curve in all three."""
        return self, self._other(), self.swapped()._other()

    def _other(self) -> "FourBars":
        """Return the cognate on the crank's pivot and the third pivot; crank and coupler exchange their places.

        From c - a = k (b - a), k = AP / AB, and b - a = (A - a) + (B - A) + (b - B) follows
        c - a = (P - A) + k (A - a) + k (b - B): the links of the cognate, one after the other.
        """
        k = ((self.P[:1] - self.A[:, 0]) / (self.B[:, 0] - self.A[:, 0]))[:, None]
        A = self.O[:, None] + self.P - self.A
        return FourBars(self.O, self.O + k[:, 0] * (self.C - self.O), A, A + k * (self.A - self.O[:, None]), self.P)

    @property
    def lengths(self) -> np.ndarray:
        """Lengths of frame, crank, coupler and rocker (4, M)."""
        ends = (self.O - self.C, self.A[:, 0] - self.O, self.B[:, 0] - self.A[:, 0], self.B[:, 0] - self.C)
        return np.abs(np.stack(ends))

    @property
    def crank_angles(self) -> np.ndarray:
        """Angles of the crank (rad), from -pi to pi (M, J)."""
        return np.angle(self.A - self.O[:, None])

    @property
    def transmission(self) -> np.ndarray:
        """The signed sine of the angle between coupler and rocker (M, J): zero at a dead point of the crank."""
        coupler, rocker = self.B - self.A, self.C[:, None] - self.B
        return np.imag(coupler.conj() * rocker) / (np.abs(coupler) * np.abs(rocker))


def stack_four_bars(batches: list[FourBars]) -> FourBars:
    """Return several batches of four-bars through the same points as one batch."""
    O, C, A, B = (np.concatenate([getattr(batch, name) for batch in batches]) for name in FourBars._fields[:-1])  # noqa: E741
    return FourBars(O, C, A, B, batches[0].P)


class Classification(NamedTuple):
    """Kinds of M four-bars, and circuits, branches and order of their J positions.

    Attributes:
        kind: indices of GRASHOF_KINDS (M,).
        turns: whether the crank turns fully (M,).
        circuits: the circuit of each position (M, J), numbered from that of the first position, 0.
        branches: the branch of each position (M, J), numbered in the same way.
        order: indices of the positions in the order of a motion along the circuit of the first one (M, J), padded with -1.
        defect: indices of DEFECTS (M,).
        values: angles of the crank (rad), continuous if there is no defect (M, J).
    """

    kind: np.ndarray
    turns: np.ndarray
    circuits: np.ndarray
    branches: np.ndarray
    order: np.ndarray
    defect: np.ndarray
    values: np.ndarray


def classify(bars: FourBars) -> Classification:
    """Return the kinds of four-bars, and the circuits, branches and order of their positions, from lengths and angles."""
    lengths = bars.lengths
    total, longest, shortest = lengths.sum(axis=0), lengths.max(axis=0), lengths.min(axis=0)
    is_grashof = 2.0 * (shortest + longest) < total
    kind = np.where(is_grashof, np.argmin(lengths, axis=0), len(GRASHOF_KINDS) - 1)
    turns = is_grashof & (kind <= 1)
    side = np.sign(bars.transmission)
    angle = _relative_angles(bars, lengths)
    # A crank that turns has one branch in each of two circuits. A crank of a Grashof linkage that rocks has two, one on each
    # side of the frame; all other linkages have one circuit. Each of these has two branches.
    circuit = np.where(turns[:, None], side, np.where(is_grashof[:, None], np.sign(angle), 0.0))
    branch = np.where(turns[:, None], circuit, 4.0 * circuit + side)
    circuits, branches = _counted(circuit), _counted(branch)
    # Place along the circuit, as an angle: with dead points the crank angle rises on one branch and falls on the other.
    circle = np.where(turns[:, None], np.mod(angle, 2 * np.pi), np.where(side > 0, angle, 4 * np.pi - angle))
    order = _order(circle, circuits == 0)
    values = _values(angle, turns)
    defect = np.where(
        (circuits > 0).any(axis=1),
        CIRCUIT,
        np.where(_goes_round(order), np.where((branches > 0).any(axis=1), BRANCH, IN_ORDER), ORDER),
    )
    steps = np.diff(values, axis=1)
    one_way = (steps > 0).all(axis=1) | (steps < 0).all(axis=1)
    defect = np.where((defect == IN_ORDER) & ~turns & ~one_way, ORDER, defect)
    first = bars.crank_angles[:, :1]
    return Classification(kind, turns, circuits, branches, order, defect, first + values - values[:, :1])


def _relative_angles(bars: FourBars, lengths: np.ndarray) -> np.ndarray:
    """Return angles between crank and frame, continuous where the crank of a triple rocker passes the line of the frame."""
    angle = np.angle((bars.A - bars.O[:, None]) / (bars.C - bars.O)[:, None])
    frame, crank, coupler, rocker = lengths
    inward = (np.abs(frame - crank) >= np.abs(coupler - rocker)) & (np.abs(frame - crank) <= coupler + rocker)
    outward = (frame + crank <= coupler + rocker) & ~inward
    return np.where(outward[:, None], np.mod(angle, 2 * np.pi), angle)


def _counted(labels: np.ndarray) -> np.ndarray:
    """Return labels (M, J) numbered from 0 in order of first occurrence."""
    counted = np.zeros(labels.shape, int)
    for j in range(1, labels.shape[1]):
        same = labels[:, :j] == labels[:, j : j + 1]
        earlier = np.argmax(same, axis=1)
        counted[:, j] = np.where(
            same.any(axis=1), np.take_along_axis(counted, earlier[:, None], 1)[:, 0], counted[:, :j].max(axis=1) + 1
        )
    return counted


def _order(circle: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Return the indices of positions in their order along a circle from the first one (M, J), padded with -1.

    `circle` has the angles of positions along the circle; positions of which `exists` is False are left out.
    """
    away = np.where(exists, circle, np.inf)
    away = np.where(away < circle[:, :1], away + 1e3, away)
    order = np.argsort(away, axis=1, kind="stable")
    return np.where(np.take_along_axis(exists, order, 1), order, -1)


def _goes_round(order: np.ndarray) -> np.ndarray:
    """Return a mask (M,) of the four-bars that pass the positions in cyclic order, in either direction."""
    J = order.shape[1]
    return (order == np.arange(J)).all(axis=1) | (order == -np.arange(J) % J).all(axis=1)


def _values(angle: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return crank angles (M, J) along a motion; those of a crank that turns fully are continuous, in the shorter direction."""
    ahead, back = (np.cumsum(np.mod(sign * np.diff(angle, axis=1, prepend=angle[:, :1]), 2 * np.pi), axis=1) for sign in (1, -1))
    shorter = np.where((ahead[:, -1] <= back[:, -1])[:, None], ahead, -back)
    return np.where(turns[:, None], angle[:, :1] + shorter, angle)


# --- boxes that contain exact solutions


class FourBarBoxes(NamedTuple):
    """Balls that contain the joints of M exact four-bars in the first position, relative to the first place of the goal.

    O and C are the fixed joints, A and B the moving ones.
    """

    O: ComplexBall  # noqa: E741  # as it is drawn
    C: ComplexBall
    A: ComplexBall
    B: ComplexBall


def cognate_joints(boxes: Certificate) -> tuple[FourBarBoxes, FourBarBoxes, FourBarBoxes]:
    """Return the joints of all three cognates of the solutions in boxes, in the order of `FourBars.cognates`."""
    u = boxes.balls
    x, r, y, s = (ComplexBall(u.part(k), u.part(k + 1)) for k in (0, 2, 4, 6))
    a, b = x - r, y - s
    return FourBarBoxes(a, b, x, y), _other(a, b, x, y), _other(b, a, y, x)


def _other(a: ComplexBall, b: ComplexBall, x: ComplexBall, y: ComplexBall) -> FourBarBoxes:
    k = x / (x - y)
    joint = a - x
    return FourBarBoxes(a, a + k * (b - a), joint, joint + k * (x - a))


def radius_of(boxes: FourBarBoxes, bars: FourBars, origin: complex, scale: float) -> np.ndarray:
    """Return the largest distance (M,) (m) between the rounded pins of four-bars and the exact ones."""
    start = ComplexBall(Ball.of(np.real(origin)), Ball.of(np.imag(origin)))
    size = ComplexBall(Ball.of(scale), Ball.of(0.0))
    pins = (bars.O, bars.C, bars.A[:, 0], bars.B[:, 0])
    return np.max([(start + size * box).distance(pin) for box, pin in zip(boxes, pins, strict=True)], axis=0, initial=0.0)


def certainly_different(boxes: Certificate) -> np.ndarray:
    """Return the indices of the boxes that are proven to contain other classes than all boxes before them.

    The three pivots of their cognates differ in any order.
    """
    first, second, _ = cognate_joints(boxes)
    pivots, count = (first.O, first.C, second.C), boxes.middle.shape[1]
    rows, columns = np.arange(count)[:, None], np.arange(count)[None, :]
    meet = np.array([[p.part(rows).overlaps(q.part(columns)) for q in pivots] for p in pivots])
    same = np.any([meet[0, i] & meet[1, j] & meet[2, k] for i, j, k in permutations(range(3))], axis=0)
    return np.flatnonzero(~np.tril(same, -1).any(axis=1))
