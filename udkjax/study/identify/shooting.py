"""Multiple shooting: records in pieces, each with a start of its own, that are held together while they are fitted.

Along a chaotic record errors grow like exp(lambda t), so what a whole record says of a parameter has as many minima as it has
digits. A piece that is shorter than 1 / lambda has one. With s_p the start of piece p, and F_p where it leads, the fit is of

    sum r_p(z, s_p)^2 + w^2 sum (F_p(z, s_p) - s_{p+1})^2,

whose w grows from where pieces go their own ways to where they are one motion up to the errors of its integration. The first
start is that of the record; of each other one as many positions and rates are unknown as the mechanism has degrees of freedom.
H. G. Bock, Recent advances in parameter identification techniques for ODE, 1983; the growing weight: H. Voss, J. Timmer and
J. Kurths, Nonlinear dynamical system identification from uncertain and indirect measurements, 2004.
"""

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from udkjax.integrate.assembly import State
from udkjax.study.identify.fitting import Fit, descend
from udkjax.study.identify.problem import Evaluated, Problem
from udkjax.study.identify.program import Members, Predicted, Program
from udkjax.study.identify.records import Record, Start
from udkjax.study.identify.starts import start_unknowns

SAMPLES = 3.0  # residuals of a piece, per unknown of its start
PIECES = 60  # of all records at most: the algebra is that of dense matrices
KEPT = 1e-2  # of the best known direction of a start: what its piece tells worse than this stays as the piece before leads to
ALONE = 15, 1e-3  # steps for the start of one piece, and the change at which they are enough
LEAST = 1e-3  # of the largest: how little a coordinate is taken to move in a piece
# Of a defect, over how far coordinates move in a piece, where residuals are over how far their channels move.
WEIGHTS = tuple(10.0**k for k in range(-2, 5))
ON_THE_WAY = 30, 1e-3  # steps with one weight, and the change of an unknown at which they are enough
END = 60, 1e-7  # the same with the last


class Piece(NamedTuple):
    """A part of a record: which record, and its samples from `first` up to `end`, which begins the next."""

    record: int
    first: int
    end: int


class Shooting:
    """A problem in pieces. Its residuals, records and noise are those of the whole problem, in the same order; defects follow.

    The unknowns z are those of the whole problem, then those of the starts of pieces, in m, rad and s.
    """

    def __init__(self, whole: Problem, z: Float[np.ndarray, "K"], tol: tuple[float, float], samples: float = SAMPLES):
        """Cut the records, and find starts of all pieces along them with the unknowns z of the whole problem."""
        self.whole, self.weight = whole, WEIGHTS[0]
        free = start_unknowns(whole.mechanism, whole.unknowns, _begun(whole.records[0]), "start")
        n, self.S = free.basis.shape[1:]
        self.names_of_starts, self.units_of_starts = free.names, free.units
        self.pieces = cut(whole, max(samples * self.S, len(whole.where) / PIECES))
        self.times, self.piece, self.time = _tables(whole, self.pieces)
        self.program = Program(whole.mechanism, whole.unknowns.targets, whole.channels, whole.program.settings, ends=True)
        N = len(self.pieces)
        self.led = np.array([p for p, piece in enumerate(self.pieces) if piece.first], int)  # by the pieces before them
        self.columns = np.full((N, self.S), -1)
        self.columns[self.led] = whole.K + np.arange(len(self.led) * self.S).reshape(-1, self.S)
        self.K = whole.K + len(self.led) * self.S
        self.q, self.v = np.zeros((2, N, n // 3, 3))
        self.bases, self.inverse = np.zeros((N, 2, n, self.S)), np.zeros((N, self.S, 2 * n))
        members = whole.members(z[None])
        self.conditions = jax.tree.map(lambda leaf: leaf[[piece.record for piece in self.pieces]], members.conditions)
        for p, piece in enumerate(self.pieces):
            if not piece.first:
                self._begin(p, members)
        self.guess, self.scale = self._along(z, tol)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.__dict__["whole"], name)

    @property
    def all_names(self) -> tuple[str, ...]:
        """The names of all unknowns."""
        nodes = (f"piece {p + 1}: {name}" for p in self.led for name in self.names_of_starts)
        return (*self.whole.all_names, *nodes)

    @property
    def all_units(self) -> tuple[str, ...]:
        """The units of all unknowns."""
        return (*self.whole.all_units, *self.units_of_starts * len(self.led))

    @property
    def more(self) -> int:
        """Rows that are not of what was measured: of priors and of continuity."""
        return self.whole.more + len(self.led) * self.S

    @property
    def tied(self) -> int:
        """Unknowns that continuity decides about."""
        return len(self.led) * self.S

    def members(self, z: Float[np.ndarray, "B K"], horizon: float | None = None) -> Members:
        """Members of the whole problem: what the records are like from their beginning on."""
        return self.whole.members(z[:, : self.whole.K], horizon)

    def _begin(self, p: int, members: Members) -> None:
        """The first piece of a record begins as the record does."""
        k, mech = self.pieces[p].record, self.mechanism
        self.q[p], self.v[p] = (mech.q0, mech.v0) if members.q is None else (members.q[k], members.v[k])
        columns = self.whole.columns[k]
        if columns is not None:
            at, start = columns
            own = len(start.names)
            self.columns[p, :own], self.bases[p, ..., :own] = at + np.arange(own), start.basis

    def _place(self, p: int, state: np.ndarray, x: np.ndarray) -> None:
        """Let a piece begin at a closed state (2, n), of which it is to move away."""
        record = _begun(self.records[self.pieces[p].record], State(*state.reshape(2, -1, 3)), self.times[p, 0])
        start = start_unknowns(self.mechanism, dataclasses.replace(self.unknowns, start=x), record, "start")
        self.bases[p], self.inverse[p] = start.basis, np.linalg.pinv(start.basis.reshape(-1, self.S))
        self.q[p], self.v[p] = state.reshape(2, -1, 3)
        for _ in range(2):  # what the values of parameters will move the guess by is taken off before
            q, v = self.program.guess(self.members_of(np.array([p]), x[None], np.zeros((1, self.S))), 0)
            self.q[p] += state[0].reshape(-1, 3) - q
            self.v[p] += state[1].reshape(-1, 3) - v

    def members_of(self, pieces: np.ndarray, x: np.ndarray, shift: np.ndarray) -> Members:
        conditions = jax.tree.map(lambda leaf: leaf[pieces], self.conditions)
        return Members(x, shift, self.times[pieces], self.q[pieces], self.v[pieces], self.bases[pieces], conditions)

    def _along(self, z: np.ndarray, tol: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
        """Starts of the pieces, one after another: where the piece before leads to, moved to fit what was measured in its own.

        Also how far the coordinates move in a piece (S,).
        """
        P = len(self.unknowns.names)
        x = self.unknowns.values(z[:P])
        found, moved = np.concatenate([z, np.zeros(self.K - len(z))]), []
        ends: Any = None
        for p, piece in enumerate(self.pieces):
            one = _One(self, p, x, tol)
            columns = self.columns[p]
            if piece.first:
                self._place(p, ends[1], x)  # the piece before is of the same record
                fit = descend(one, np.zeros((1, self.S)), tol, None, *ALONE)
                found[columns] = np.where(np.isfinite(fit.cost[0]), fit.z[0], 0.0)
            ends = one.predicted(np.where(columns < 0, 0.0, found[columns])[None]).end
            ends = np.asarray(ends)[0]
            if not np.isfinite(ends).all():
                raise Lost
            if piece.first:
                moved.append(self.inverse[p] @ (ends[1] - ends[0]).ravel())
        size = np.sqrt(np.mean(np.square(moved), axis=0)) if moved else np.ones(self.S)
        return found, np.maximum(size, LEAST * size.max(initial=0.0))

    def evaluate(self, z: Float[np.ndarray, "B K"], tol: tuple[float, float], horizon: float | None = None) -> Evaluated:
        """Residuals and Jacobian: of all records, of priors, and of continuity, (F_p - s_{p+1}) / scale * weight."""
        sets, P, N = len(z), len(self.unknowns.names), len(self.pieces)
        x = np.repeat(self.unknowns.values(z[:, :P]), N, axis=0)
        shift = np.where(self.columns < 0, 0.0, z[:, self.columns])
        found = self.program(self.members_of(np.tile(np.arange(N), sets), x, shift.reshape(sets * N, self.S)), tol)
        parts: Any = found.y, found.slope, found.end, found.end_slope
        y, slope, end, end_slope = (part.reshape(sets, N, *part.shape[1:]) for part in parts)
        at = self.piece, self.time, self.where[:, 2]
        rows = (y[:, *at] - self.y[self.there]) / self.sigma
        by = slope[:, *at] / self.sigma[:, None]
        before, weight = self.led - 1, self._held / self.scale
        gap = (end[:, before, 1] - end[:, self.led, 0]).reshape(sets, len(self.led), -1)
        defects = np.einsum("psn,bpn->bps", self.inverse[self.led], gap) * weight
        along = []
        for sign, pieces, which in ((1.0, before, 1), (-1.0, self.led, 0)):
            flat = end_slope[:, pieces, which].reshape(sets, len(self.led), -1, P + self.S)
            by_both = sign * weight[:, None] * np.einsum("psn,bpnk->bpsk", self.inverse[self.led], flat)
            along.append(self._spread(by_both.reshape(sets, -1, P + self.S), np.repeat(pieces, self.S), z))
        J = self._spread(by, self.piece, z)
        r, J = self.whole.with_priors(z[:, : self.whole.K], rows, J)
        code = found.code.reshape(sets, N).max(1)
        return Evaluated(np.concatenate([r, defects.reshape(sets, -1)], 1), np.concatenate([J, along[0] + along[1]], 1), code)

    def _spread(self, by: np.ndarray, piece: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Derivatives by x and by the start of the piece of each row, (B, R, P + S), as those by z: (B, R, K)."""
        sets, P = len(z), len(self.unknowns.names)
        J = np.zeros((*by.shape[:2], self.K + 1))  # the last column takes what is no unknown
        np.put_along_axis(J, np.broadcast_to(self.columns[piece] % (self.K + 1), (sets, len(piece), self.S)), by[..., P:], 2)
        J[..., :P] = by[..., :P] * self.unknowns.slopes(z[:, :P])[:, None]
        return J[..., : self.K]

    @property
    def _held(self) -> float:
        """The weight of defects in standard deviations."""
        return float(self.weight / np.median(self.sigma / self.spread[self.where[:, 2]]))

    def gaps(self, z: np.ndarray, tol: tuple[float, float]) -> np.ndarray:
        """Defects (B,): the largest, over how far coordinates move in a piece."""
        r = self.evaluate(z, tol).r[:, len(self.where) + self.whole.more :]
        return np.abs(r).max(1, initial=0.0) / self._held


class Lost(Exception):
    """A piece could not be computed with the first guess: it says nothing of where the next begins."""


class _One:
    """The start of one piece, alone: what was measured in it, and its being near to where the piece before leads to."""

    def __init__(self, shooting: Shooting, p: int, x: np.ndarray, tol: tuple[float, float]):
        self.shooting, self.p, self.x, self.tol = shooting, p, x, tol
        self.program, self.kept = shooting.program, None
        self.rows = np.flatnonzero(shooting.piece == p)

    def predicted(self, shift: Float[np.ndarray, "B S"]) -> Predicted:
        members = self.shooting.members_of(np.full(len(shift), self.p), np.tile(self.x, (len(shift), 1)), shift)
        return self.program(members, self.tol)

    def evaluate(self, z: Float[np.ndarray, "B S"], tol: tuple[float, float], horizon: float | None = None) -> Evaluated:
        shooting, rows, P = self.shooting, self.rows, len(self.x)
        found = self.predicted(z)
        at, sigma = (shooting.time[rows], shooting.where[rows, 2]), shooting.sigma[rows]
        r = (found.y[:, *at] - shooting.y[shooting.there][rows]) / sigma
        J = found.slope[:, *at, P:] / sigma[:, None]
        if self.kept is None:
            self.kept = KEPT * np.linalg.norm(J[0], 2)
        S = shooting.S
        kept = np.broadcast_to(self.kept * np.eye(S), (len(z), S, S))
        return Evaluated(np.concatenate([r, self.kept * z], 1), np.concatenate([J, kept], 1), found.code)


def shoot(
    problem: Problem,
    z: Float[np.ndarray, "K"],
    tol: tuple[float, float],
    samples: float = SAMPLES,
    tell: Callable[[str], None] = lambda text: None,
    **choices: Any,
) -> tuple[Shooting, Fit]:
    """Fit the records in pieces of at least `samples` residuals per unknown of a start, from unknowns z of the problem."""
    shooting = Shooting(problem, z, tol, samples)
    fit, history = Fit(shooting.guess[None], np.full(1, np.inf), np.zeros(1, bool), 0, []), []
    for weight in WEIGHTS:
        shooting.weight = weight
        say = lambda text, w=weight: tell(f"pieces held together by {w:.0e}: {text}")  # noqa: E731
        limits = END if weight == WEIGHTS[-1] else ON_THE_WAY
        # From one weight to the next the Gauss-Newton step is right, but for a few: these take damped ones.
        for near in (False,) if weight == WEIGHTS[0] else (True, False):
            fit = descend(shooting, fit.z, tol, None, *limits, near=near, tell=say, **choices)
            history += fit.history
            if fit.settled[0]:
                break
        if weight > WEIGHTS[0] and not fit.settled[0]:  # held together more they would only be farther from a minimum
            break
    return shooting, fit._replace(history=history)


def cut(problem: Problem, least: float) -> tuple[Piece, ...]:
    """The records in pieces of at least as many residuals."""
    found = []
    for k in range(len(problem.records)):
        numbers = problem.there[k].sum(1)
        last, first, count = int(np.flatnonzero(numbers)[-1]), 0, 0
        left = numbers.sum()
        for i in range(1, last):
            count += numbers[i - 1]
            left -= numbers[i - 1]
            if count >= least and left >= least:
                found.append(Piece(k, first, i))
                first, count = i, 0
        found.append(Piece(k, first, last))
    return tuple(found)


def _tables(problem: Problem, pieces: Sequence[Piece]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times of all pieces, of one length and with that of the next start as their last; the piece and time of each residual."""
    length = max(piece.end - piece.first for piece in pieces) + 1
    record, time, _ = problem.where.T
    ts, which, at = [], np.zeros(len(record), int), np.zeros(len(record), int)
    for p, piece in enumerate(pieces):
        own = problem.ts[piece.record, piece.first : piece.end + 1]
        between = np.linspace(own[-2], own[-1], length - len(own) + 2)
        ts.append(np.concatenate([own[:-2], between]))
        mine = (record == piece.record) & (time >= piece.first) & (time <= piece.end)  # the next takes back what is its own
        which[mine], at[mine] = p, np.where(time[mine] == piece.end, length - 1, time[mine] - piece.first)
    return np.stack(ts), which, at


def _begun(record: Record, state: State | None = None, t0: float | None = None) -> Record:
    """A record with all of its start to be estimated, from a state at another time."""
    record = copy.copy(record)
    record.start = Start(record.start.state if state is None else state, "both")
    record.t0 = record.t0 if t0 is None else t0
    return record
