"""Multiple shooting: records in pieces, each with an initial state of its own, that are held together while they are fitted.

Along a chaotic record errors grow like exp(lambda t), so what a whole record says of a parameter has as many minima as it has
digits. A piece that is shorter than 1 / lambda has one. With s_p the state that piece p begins with, and F_p where it
leads, the fit is of

    sum r_p(z, s_p)^2 + w^2 sum (F_p(z, s_p) - s_{p+1})^2,

whose w grows from where pieces go their own ways to where they are one motion up to the errors of its integration. The first
state is that of the record; of each other one as many positions and rates are unknown as the mechanism has degrees of freedom.
H. G. Bock, Recent advances in parameter identification techniques for ODE, 1983; the growing weight: H. Voss, J. Timmer and
J. Kurths, Nonlinear dynamical system identification from uncertain and indirect measurements, 2004.
"""

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from udkjax.integrate.assembly import State
from udkjax.study.identify.initial_states import unknowns_of_state
from udkjax.study.identify.least_squares import COARSE_STEP, FEW_STEPS, FINE_STEP, SOME_STEPS, STEPS, Fit, Loss, minimize_squares
from udkjax.study.identify.optimizer import Method, minimize
from udkjax.study.identify.prediction import Members, Prediction, Predictor, Tolerances
from udkjax.study.identify.problem import RESIDUALS_PER_UNKNOWN, Problem, Residuals
from udkjax.study.identify.records import Record, Start

MOST_PIECES = 60  # of all records: the algebra is that of dense matrices
CONTINUED = 1e-2  # of the largest singular value: what a piece shows less of its initial state stays as the piece before leads to
LEAST_MOTION = 1e-3  # of the largest: how little a coordinate is taken to move in a piece
# w of defects over how far coordinates move in a piece, where residuals are over how far their channels move.
WEIGHTS = tuple(10.0**k for k in range(-2, 5))


class Piece(NamedTuple):
    """A part of a record: which record, and its samples from `first` up to `end`, which begins the next."""

    record: int
    first: int
    end: int


class MultipleShooting(Problem):
    """A problem in pieces. Its first residuals are those of the whole problem, in the same order; defects follow.

    The unknowns z are those of the whole problem, then those of the initial states of pieces, in m, rad and s.

    Attributes:
        whole: the problem that is cut.
        weight: w of the defects, over how far coordinates move in a piece.
        pieces: N parts of records; `following` are those that another leads to.
        guess: the first guess (K,): pieces along the records.
    """

    def __init__(self, whole: Problem, z: Float[np.ndarray, "K"], tol: Tolerances, samples: float = RESIDUALS_PER_UNKNOWN):
        """Cut the records, and find initial states of all pieces along them with the unknowns z of the whole problem."""
        vars(self).update(vars(whole))
        self.whole, self.weight = whole, WEIGHTS[0]
        free = unknowns_of_state(whole.mechanism, whole.unknowns, _with_free_state(whole.records[0]), "start")
        n, self.S = free.basis.shape[1:]
        self.pieces = cut_records(whole, max(samples * self.S, len(whole.index) / MOST_PIECES))
        self.times, self.piece, self.time = _piece_tables(whole, self.pieces)
        self.predictor = Predictor(whole.mechanism, whole.unknowns.targets, whole.channels, whole.predictor.settings, ends=True)
        N = len(self.pieces)
        self.following = np.array([p for p, piece in enumerate(self.pieces) if piece.first], int)
        self.constrained = len(self.following) * self.S
        self.K, self.extra_rows = whole.K + self.constrained, whole.extra_rows + self.constrained
        self.columns = np.full((N, self.S), -1)
        self.columns[self.following] = whole.K + np.arange(self.constrained).reshape(-1, self.S)
        self.more_names = tuple(f"piece {p + 1}: {name}" for p in self.following for name in free.names)
        self.more_units = free.units * len(self.following)
        self.q, self.v = np.zeros((2, N, n // 3, 3))
        self.bases, self.inverse = np.zeros((N, 2, n, self.S)), np.zeros((N, self.S, 2 * n))
        members = whole.members(z[None])
        self.conditions = jax.tree.map(lambda leaf: leaf[[piece.record for piece in self.pieces]], members.conditions)
        for p, piece in enumerate(self.pieces):
            if not piece.first:
                self._begin_with_record(p, members)
        self.guess, self.scale = self._guess_along(z, tol)

    @property
    def all_names(self) -> tuple[str, ...]:
        """Names of all K unknowns."""
        return (*self.whole.all_names, *self.more_names)

    @property
    def all_units(self) -> tuple[str, ...]:
        """Units of all K unknowns."""
        return (*self.whole.all_units, *self.more_units)

    def members(self, z: Float[np.ndarray, "B K"], horizon: float | None = None) -> Members:
        """Return members of the whole problem: the records from their beginning on."""
        return self.whole.members(z[:, : self.whole.K], horizon)

    def members_of(self, pieces: np.ndarray, x: np.ndarray, shift: np.ndarray) -> Members:
        """Return the members of some pieces, with parameters x (M, P) and shifts of their initial states (M, S)."""
        conditions = jax.tree.map(lambda leaf: leaf[pieces], self.conditions)
        return Members(x, shift, self.times[pieces], self.q[pieces], self.v[pieces], self.bases[pieces], conditions)

    def _begin_with_record(self, p: int, members: Members) -> None:
        """Let the first piece of a record begin as the record does."""
        k, mech = self.pieces[p].record, self.mechanism
        self.q[p], self.v[p] = (mech.q0, mech.v0) if members.q is None or members.v is None else (members.q[k], members.v[k])
        S = self.whole.columns.shape[1]
        self.columns[p, :S], self.bases[p, ..., :S] = self.whole.columns[k], self.whole.bases[k]

    def _begin_at(self, p: int, state: np.ndarray, x: np.ndarray) -> None:
        """Let a piece begin beside a closed state (2, n)."""
        record = _with_free_state(self.records[self.pieces[p].record], State(*state.reshape(2, -1, 3)), self.times[p, 0])
        basis = unknowns_of_state(self.mechanism, dataclasses.replace(self.unknowns, guess=x), record, "start").basis
        self.bases[p], self.inverse[p] = basis, np.linalg.pinv(basis.reshape(-1, self.S))
        self.q[p], self.v[p] = state.reshape(2, -1, 3)
        for _ in range(2):  # what the values of parameters will move the guess by is taken off before
            found = self.predictor.guess(self.members_of(np.array([p]), x[None], np.zeros((1, self.S))), 0)
            self.q[p] += state[0].reshape(-1, 3) - found.q
            self.v[p] += state[1].reshape(-1, 3) - found.v

    def _guess_along(self, z: np.ndarray, tol: Tolerances) -> tuple[np.ndarray, np.ndarray]:
        """Find initial states of the pieces one after another, and how far the coordinates move in a piece (S,).

        Each begins where the piece before leads to, moved to fit what was measured in its own.
        """
        P = len(self.unknowns.names)
        x = self.unknowns.values(z[:P])
        found, moved = np.concatenate([z, np.zeros(self.K - len(z))]), []
        ends = np.zeros((2, 2, 0))
        for p, piece in enumerate(self.pieces):
            state = _InitialStateOfPiece(self, p, x)
            columns = self.columns[p]
            if piece.first:
                self._begin_at(p, ends[1], x)  # the piece before is of the same record
                fit = minimize_squares(state, np.zeros((1, self.S)), tol, None, FEW_STEPS, COARSE_STEP)
                found[columns] = np.where(np.isfinite(fit.cost[0]), fit.z[0], 0.0)
            ends = np.asarray(state.predict(np.where(columns < 0, 0.0, found[columns])[None], tol).ends)[0]
            if not np.isfinite(ends).all():
                raise PieceFailed
            if piece.first:
                moved.append(self.inverse[p] @ (ends[1] - ends[0]).ravel())
        size = np.sqrt(np.mean(np.square(moved), axis=0)) if moved else np.ones(self.S)
        return found, np.maximum(size, LEAST_MOTION * size.max(initial=0.0))

    def evaluate(self, z: Float[np.ndarray, "B K"], tol: Tolerances, horizon: float | None = None) -> Residuals:
        """Compute residuals and Jacobian: of all records, of priors, and of continuity, (F_p - s_{p+1}) / scale * weight."""
        sets, P, N = len(z), len(self.unknowns.names), len(self.pieces)
        x = np.repeat(self.unknowns.values(z[:, :P]), N, axis=0)
        shift = np.where(self.columns < 0, 0.0, z[:, self.columns])
        found = self.predictor(self.members_of(np.tile(np.arange(N), sets), x, shift.reshape(sets * N, self.S)), tol)
        parts = map(np.asarray, (found.y, found.dy, found.ends, found.d_ends))
        y, dy, ends, d_ends = (part.reshape(sets, N, *part.shape[1:]) for part in parts)
        at = self.piece, self.time, self.index[:, 2]
        rows = (y[:, *at] - self.y[self.present]) / self.sigma
        by = dy[:, *at] / self.sigma[:, None]
        before, weight = self.following - 1, self._defect_weight / self.scale
        gap = (ends[:, before, 1] - ends[:, self.following, 0]).reshape(sets, len(self.following), -1)
        defects = np.einsum("psn,bpn->bps", self.inverse[self.following], gap) * weight
        J_defects = 0.0
        for sign, pieces, which in ((1.0, before, 1), (-1.0, self.following, 0)):
            flat = d_ends[:, pieces, which].reshape(sets, len(self.following), -1, P + self.S)
            by_both = sign * weight[:, None] * np.einsum("psn,bpnk->bpsk", self.inverse[self.following], flat)
            J_defects = J_defects + self.by_unknowns(by_both.reshape(sets, -1, P + self.S), np.repeat(pieces, self.S), z)
        J = self.by_unknowns(by, self.piece, z)
        r, J = self.with_priors(z, rows, J)
        code = found.code.reshape(sets, N).max(1)
        return Residuals(np.concatenate([r, defects.reshape(sets, -1)], 1), np.concatenate([J, J_defects], 1), code)

    @property
    def _defect_weight(self) -> float:
        """The weight of defects over the scale of coordinates, where residuals are in standard deviations."""
        return float(self.weight / np.median(self.sigma / self.channel_scale[self.index[:, 2]]))

    def gaps(self, z: np.ndarray, tol: Tolerances) -> np.ndarray:
        """Return the largest defect (B,), over how far coordinates move in a piece."""
        r = self.evaluate(z, tol).r[:, len(self.index) + self.whole.extra_rows :]
        return np.abs(r).max(1, initial=0.0) / self._defect_weight


class PieceFailed(Exception):
    """A piece could not be computed with the first guess: it says nothing of where the next begins."""


class _InitialStateOfPiece:
    """The initial state of one piece as a problem: what was measured in it, and being near to where the piece before leads to."""

    def __init__(self, shooting: MultipleShooting, p: int, x: np.ndarray):
        self.shooting, self.p, self.x = shooting, p, x
        self.damping: float | None = None
        self.rows = np.flatnonzero(shooting.piece == p)

    def predict(self, shift: Float[np.ndarray, "B S"], tol: Tolerances) -> Prediction:
        """Predict the piece."""
        members = self.shooting.members_of(np.full(len(shift), self.p), np.tile(self.x, (len(shift), 1)), shift)
        return self.shooting.predictor(members, tol)

    def evaluate(self, z: Float[np.ndarray, "B S"], tol: Tolerances, horizon: float | None = None) -> Residuals:
        """Compute residuals and their Jacobian."""
        shooting, rows, P, S = self.shooting, self.rows, len(self.x), self.shooting.S
        found = self.predict(z, tol)
        at, sigma = (shooting.time[rows], shooting.index[rows, 2]), shooting.sigma[rows]
        r = (found.y[:, *at] - shooting.y[shooting.present][rows]) / sigma
        J = found.dy[:, *at, P:] / sigma[:, None]
        if self.damping is None:
            self.damping = float(CONTINUED * np.linalg.norm(J[0], 2))
        damped = np.broadcast_to(self.damping * np.eye(S), (len(z), S, S))
        return Residuals(np.concatenate([r, self.damping * z], 1), np.concatenate([J, damped], 1), found.code)


def fit_pieces(
    problem: Problem,
    z: Float[np.ndarray, "K"],
    tol: Tolerances,
    samples: float = RESIDUALS_PER_UNKNOWN,
    report: Callable[[str], None] = lambda text: None,
    method: Method = None,
    loss: Loss = None,
) -> tuple[MultipleShooting, Fit]:
    """Fit the records in pieces, from unknowns z of the problem.

    Args:
        problem: the whole problem.
        z: first guess (K,).
        tol: tolerances of the integration.
        samples: residuals of a piece at least, per unknown of its initial state.
        report, method, loss: see `minimize_squares`.

    Returns:
        The problem in pieces, and the fit of its unknowns.

    Raises:
        PieceFailed: along the first guess.
    """
    shooting = MultipleShooting(problem, z, tol, samples)
    fit, history = Fit(shooting.guess[None], np.full(1, np.inf), np.zeros(1, bool), []), []
    for weight in WEIGHTS:
        shooting.weight = weight
        say = lambda text, w=weight: report(f"pieces held together by {w:.0e}: {text}")  # noqa: E731
        steps, settled = (STEPS, FINE_STEP) if weight == WEIGHTS[-1] else (SOME_STEPS, COARSE_STEP)
        # From one weight to the next the Gauss-Newton step is right, but for a few: these take damped ones.
        for undamped in (False,) if weight == WEIGHTS[0] else (True, False):
            fit = minimize(shooting, fit.z, tol, None, steps, settled, undamped, method, loss, say)
            history += fit.history
            if fit.settled[0]:
                break
        if weight > WEIGHTS[0] and not fit.settled[0]:  # with larger weights they would only be farther from a minimum
            break
    return shooting, fit._replace(history=history)


def cut_records(problem: Problem, least: float) -> tuple[Piece, ...]:
    """Cut the records into pieces of at least as many residuals."""
    found = []
    for k in range(len(problem.records)):
        numbers = problem.present[k].sum(1)
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


def _piece_tables(problem: Problem, pieces: Sequence[Piece]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times of all pieces, padded, the last where the next piece begins; and the piece and time of each residual."""
    length = max(piece.end - piece.first for piece in pieces) + 1
    record, time, _ = problem.index.T
    ts, which, at = [], np.zeros(len(record), int), np.zeros(len(record), int)
    for p, piece in enumerate(pieces):
        own = problem.ts[piece.record, piece.first : piece.end + 1]
        between = np.linspace(own[-2], own[-1], length - len(own) + 2)
        ts.append(np.concatenate([own[:-2], between]))
        own_rows = (record == piece.record) & (time >= piece.first) & (time <= piece.end)  # the next takes back what is its own
        which[own_rows], at[own_rows] = p, np.where(time[own_rows] == piece.end, length - 1, time[own_rows] - piece.first)
    return np.stack(ts), which, at


def _with_free_state(record: Record, state: State | None = None, t0: float | None = None) -> Record:
    """Return a record whose whole initial state is to be estimated, from a state at another time."""
    record = copy.copy(record)
    record.start = Start(record.start.state if state is None else state, "both")
    record.t0 = record.t0 if t0 is None else t0
    return record
