"""Multiple shooting: records cut into pieces, each with its own initial state, and fitted with penalties on the gaps.

Along a chaotic record errors grow like exp(lambda t); the cost of a whole record therefore has very many minima in a parameter.
A piece shorter than 1 / lambda has a single minimum. With s_p the initial state of piece p, and F_p its final state, the fit
minimizes

    sum r_p(z, s_p)^2 + w^2 sum (F_p(z, s_p) - s_{p+1})^2,

with a weight w that grows until the nearly independent pieces are one motion, continuous up to integration errors. The first
state is that of the record; each other state has an unknown position and rate for each degree of freedom.
H. G. Bock, Recent advances in parameter identification techniques for ODE, 1983; the growing weight: H. Voss, J. Timmer and
J. Kurths, Nonlinear dynamical system identification from uncertain and indirect measurements, 2004.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from udkjax.positions.assembling.assembly import State
from udkjax.study.identify.problem.fit_problem import RESIDUALS_PER_UNKNOWN, FitProblem, RunEnds
from udkjax.study.identify.problem.initial_states import InitialStateUnknowns, state_unknowns
from udkjax.study.identify.problem.prediction import Prediction, Predictor, Runs, TolerancePair
from udkjax.study.identify.problem.residuals import Residuals
from udkjax.study.identify.problem.unknowns import apply_values, with_conditions
from udkjax.study.identify.search.least_squares import (
    COARSE_STEP,
    FEW_STEPS,
    FINAL_STEPS,
    FINE_STEP,
    SOME_STEPS,
    Fit,
    Objective,
    minimize_squares,
)
from udkjax.study.identify.search.optimizer import Minimizer

MOST_PIECES = 60  # largest number of pieces of all records, since the linear algebra is dense
# Singular values below this, relative to the largest, belong to components of a piece's initial state that stay close to the end
# of the previous piece.
CONTINUED_PART = 1e-2
LEAST_MOTION = 1e-3  # least motion of a coordinate in a piece, relative to the largest
# w, with gaps relative to the motion of coordinates in a piece, and residuals relative to the scales of their channels.
GAP_WEIGHTS = tuple(10.0**k for k in range(-2, 5))


class Piece(NamedTuple):
    """A part of a record: its samples from `first` up to `end`, which is the first of the next piece."""

    record: int
    first: int
    end: int


class MultipleShooting(FitProblem):
    """A problem in pieces. Its residuals are those of the whole problem, in the same order, followed by the defects (gaps).

    The unknowns z are those of the whole problem, followed by those of the initial states of pieces.

    Attributes:
        whole: the problem that is cut into pieces.
        weight: weight w of the defects, relative to the motion of coordinates in a piece.
        pieces: N parts of records, each with a run; `following` are the indices of pieces that continue another one.
        guess: the first guess (K,), with initial states of pieces along the records.
        scale: typical motion of the coordinates in a piece (S,).
    """

    def __init__(self, whole: FitProblem, z: Float[np.ndarray, "K"], tol: TolerancePair, samples: float = RESIDUALS_PER_UNKNOWN):
        """Cut the records, and compute initial states of all pieces along them from the unknowns z of the whole problem.

        Raises:
            NoFitInPieces: no record can be cut, or a piece cannot be simulated.
        """
        super().__init__(whole.mechanism, whole.unknowns, whole.records, whole.settings)
        self.predictor = Predictor(whole.mechanism, whole.unknowns.targets, whole.channels, whole.settings, ends=True)
        self.whole, self.weight = whole, GAP_WEIGHTS[0]
        first = whole.records[0]
        free = self._unknowns_at(0, whole.unknowns.guess, first.t0, first.start.state)
        n, self.S = free.basis.shape[1:]
        self.pieces = cut_records(whole, max(samples * self.S, len(whole.index) / MOST_PIECES))
        records, N = np.array([piece.record for piece in self.pieces]), len(self.pieces)
        self.beginnings = np.array([p for p, piece in enumerate(self.pieces) if not piece.first])
        self.following = np.setdiff1d(np.arange(N), self.beginnings)
        if not (self.S and len(self.following)):  # without degrees of freedom, pieces have no unknowns of their own
            raise NoFitInPieces
        times, self.run, self.time = _piece_tables(whole, self.pieces)
        self.constrained = len(self.following) * self.S
        self.K, self.extra_rows = whole.K + self.constrained, whole.extra_rows + self.constrained
        self.all_names += tuple(f"piece {p + 1}: {name}" for p in self.following for name in free.names)
        self.all_units += free.units * len(self.following)
        self.state_sizes = np.concatenate([self.state_sizes, *[free.sizes] * len(self.following)])
        self.columns, bases = np.full((N, self.S), -1), np.zeros((N, 2, n, self.S))
        S = whole.columns.shape[1]
        begun = whole.beginnings
        self.columns[self.beginnings, :S], bases[self.beginnings, ..., :S] = whole.columns[begun], whole.runs.bases[begun]
        self.columns[self.following] = whole.K + np.arange(self.constrained).reshape(-1, self.S)
        of_record = begun[records]
        q, v, conditions = jax.tree.map(lambda leaf: leaf[of_record], (whole.runs.q, whole.runs.v, whole.runs.conditions))
        if q is None:
            q, v = (np.repeat(np.asarray(x)[None], N, axis=0) for x in (self.mechanism.q0, self.mechanism.v0))
        self.runs = Runs(times, q, v, bases, conditions)
        self.inverse = np.zeros((N, self.S, 2 * n))
        self.guess, self.scale = self._guess_along(z, tol)

    def _unknowns_at(self, record: int, x: np.ndarray, t: float, guess: State | None) -> InitialStateUnknowns:
        """Return the unknowns of the closed states near a guess, at a time t of a record, with parameters x."""
        mech = apply_values(with_conditions(self.mechanism, self.records[record]), self.unknowns.targets, x)
        return state_unknowns(mech, t, guess, "both", "start")

    def _begin_at(self, p: int, state: np.ndarray, x: np.ndarray) -> None:
        """Set the guess of the initial state of piece p to a closed state (2, n), with parameters x."""
        q, v = state.reshape(2, *self.mechanism.state_shape())
        basis = self._unknowns_at(self.pieces[p].record, x, float(self.runs.ts[p, 0]), State(q, v)).basis
        self.runs.bases[p], self.inverse[p] = basis, np.linalg.pinv(basis.reshape(-1, self.S))
        assert self.runs.q is not None and self.runs.v is not None
        self.runs.q[p], self.runs.v[p] = q, v
        for _ in range(2):  # compensate for parameters that change the guess
            guess = self.predictor.guess(self.members_of(np.array([p]), x[None], np.zeros((1, self.S))), 0)
            self.runs.q[p] += q - guess.q
            self.runs.v[p] += v - guess.v

    def _guess_along(self, z: np.ndarray, tol: TolerancePair) -> tuple[np.ndarray, np.ndarray]:
        """Return the unknowns with initial states of the pieces, and the typical motion of coordinates in a piece (S,).

        The initial states are computed in sequence: each is the final state of the previous piece, corrected to fit the piece's
        measurements.

        Raises:
            NoFitInPieces: a piece cannot be simulated.
        """
        P = len(self.unknowns.names)
        x = self.unknowns.values(z[:P])
        unknowns, moved = np.concatenate([z, np.zeros(self.K - len(z))]), []
        ends = np.zeros((2, 2, 0))
        for p, piece in enumerate(self.pieces):
            columns = self.columns[p]
            if piece.first:
                self._begin_at(p, ends[1], x)  # the previous piece belongs to the same record
                fit = minimize_squares(self._residuals_of_piece(p, x, tol), np.zeros(self.S), FEW_STEPS, COARSE_STEP)
                unknowns[columns] = fit.z if np.isfinite(fit.cost) else 0.0
            ends = np.asarray(self._predict_piece(p, x, np.where(columns < 0, 0.0, unknowns[columns])[None], tol).ends)[0]
            if not np.isfinite(ends).all():
                raise NoFitInPieces
            if piece.first:
                moved.append(self.inverse[p] @ (ends[1] - ends[0]).ravel())
        size = np.sqrt(np.mean(np.square(moved), axis=0)) if moved else np.ones(self.S)
        return unknowns, np.maximum(size, LEAST_MOTION * size.max(initial=0.0))

    def _predict_piece(self, p: int, x: np.ndarray, shift: Float[np.ndarray, "B S"], tol: TolerancePair) -> Prediction:
        return self.predictor(self.members_of(np.full(len(shift), p), np.tile(x, (len(shift), 1)), shift), tol)

    def _residuals_of_piece(self, p: int, x: np.ndarray, tol: TolerancePair) -> Objective:
        """Return the residuals of a piece as a function of its initial state, damped towards the previous piece's final state."""
        rows, S, damping = np.flatnonzero(self.run == p), self.S, None
        entries, sigma, measured = (self.time[rows], self.index[rows, 2]), self.sigma[rows], self.measured[rows]

        def evaluate(shift: Float[np.ndarray, "B S"]) -> Iterator[Residuals]:
            nonlocal damping
            prediction = self._predict_piece(p, x, shift, tol)
            r, J = (prediction.y[:, *entries] - measured) / sigma, prediction.dy[:, *entries, len(x) :] / sigma[:, None]
            damping = float(CONTINUED_PART * np.linalg.norm(J[0], 2)) if damping is None else damping
            damped = np.broadcast_to(damping * np.eye(S), (len(shift), S, S))
            yield Residuals(np.concatenate([r, damping * shift], 1), np.concatenate([J, damped], 1), prediction.code)

        return evaluate

    def further_rows(self, ends: RunEnds | None, z: Float[np.ndarray, "B K"]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Iterate over the residuals of priors and of continuity, (F_p - s_{p+1}) / scale * weight."""
        yield from super().further_rows(ends, z)
        assert ends is not None
        sets, preceding, following = len(z), self.following - 1, self.following
        (states, slopes), inverse = ends, self.inverse[following]
        weight = self._defect_weight / self.scale
        gap = (states[:, preceding, 1] - states[:, following, 0]).reshape(sets, len(following), -1)
        defects = np.einsum("psn,bpn->bps", inverse, gap) * weight
        J = 0.0
        for sign, pieces, which in ((1.0, preceding, 1), (-1.0, following, 0)):
            flat = slopes[:, pieces, which].reshape(sets, len(following), -1, slopes.shape[-1])
            by_both = sign * weight[:, None] * np.einsum("psn,bpnk->bpsk", inverse, flat)
            J = J + self.by_unknowns(by_both.reshape(sets, -1, slopes.shape[-1]), np.repeat(pieces, self.S), z)
        yield defects.reshape(sets, -1), np.asarray(J)

    @property
    def _defect_weight(self) -> float:
        """Weight of defects relative to the scale of coordinates, for residuals in standard deviations."""
        return float(self.weight / np.median(self.sigma / self.channel_scale[self.index[:, 2]]))

    def gaps(self, z: np.ndarray, tol: TolerancePair) -> np.ndarray:
        """Return the largest defect for each set of unknowns (B,), relative to the motion of coordinates in a piece."""
        defects = deque(self.row_blocks(z, tol), maxlen=1)[0]
        return np.abs(defects.r).max(1, initial=0.0) / self._defect_weight


class NoFitInPieces(Exception):
    """Records cannot be fitted in pieces.

    They are too short to be cut, or no state of the mechanism is free; or a piece cannot be simulated with the first guess, so
    that the initial state of the next piece is unknown.
    """


def fit_pieces(
    problem: FitProblem,
    z: Float[np.ndarray, "K"],
    tol: TolerancePair,
    minimizer: Minimizer,
    samples: float = RESIDUALS_PER_UNKNOWN,
) -> tuple[MultipleShooting, Fit]:
    """Fit the records in pieces, from unknowns z of the problem; return the problem in pieces and its fit.

    Each piece has at least `samples` residuals for each unknown of its initial state.

    Raises:
        NoFitInPieces: no record can be cut, or a piece cannot be simulated with the first guess.
    """
    shooting = MultipleShooting(problem, z, tol, samples)
    fit, history = Fit(shooting.guess, np.inf, False, []), []
    for weight in GAP_WEIGHTS:
        shooting.weight = weight
        labelled = minimizer.with_label(f"pieces, weight of the gaps {weight:.0e}")
        steps, step_tol = (FINAL_STEPS, FINE_STEP) if weight == GAP_WEIGHTS[-1] else (SOME_STEPS, COARSE_STEP)
        fit = labelled.minimize(shooting, fit.z, tol, None, steps, step_tol)
        history += fit.history
        if weight > GAP_WEIGHTS[0] and not fit.converged:  # with larger weights, the fit would be even farther from a minimum
            break
    return shooting, fit._replace(history=history)


def cut_records(problem: FitProblem, least: float) -> tuple[Piece, ...]:
    """Cut the records into pieces of at least `least` residuals."""
    pieces = []
    for k in range(len(problem.records)):
        numbers = problem.present[k].sum(1)
        last, first, count = max(int(np.flatnonzero(numbers)[-1]), 1), 0, 0  # a piece has a duration, also of a single sample
        left = numbers.sum()
        for i in range(1, last):
            count += numbers[i - 1]
            left -= numbers[i - 1]
            if count >= least and left >= least:
                pieces.append(Piece(k, first, i))
                first, count = i, 0
        pieces.append(Piece(k, first, last))
    return tuple(pieces)


def _piece_tables(problem: FitProblem, pieces: Sequence[Piece]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the padded times of pieces, each ending where the next begins, and the piece and time index of each residual."""
    length = max(piece.end - piece.first for piece in pieces) + 1
    record, time, _ = problem.index.T
    ts, which, time_index = [], np.zeros(len(record), int), np.zeros(len(record), int)
    for p, piece in enumerate(pieces):
        piece_times = problem.ts[piece.record, piece.first : piece.end + 1]
        between = np.linspace(piece_times[-2], piece_times[-1], length - len(piece_times) + 2)
        ts.append(np.concatenate([piece_times[:-2], between]))
        own_rows = (record == piece.record) & (time >= piece.first) & (time <= piece.end)  # the next piece overwrites its rows
        which[own_rows], time_index[own_rows] = p, np.where(time[own_rows] == piece.end, length - 1, time[own_rows] - piece.first)
    return np.stack(ts), which, time_index
