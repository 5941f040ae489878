"""Follow the positions of a driven mechanism: a curve Psi(s, q) = 0 of values s and coordinates q, by its arc length.

The curve is smooth even at a toggle of the mechanism, where s turns back (ds/dsigma = 0 along the arc sigma): a toggle is
a simple root of a smooth function. With X = (q, s), each measured by its scale, and E = dPsi/dX of weighted rows,

    tangent    tau = (I - E^+ E) tau_before, scaled to unit length: it keeps its direction along the curve;
    predictor  X + h tau;        corrector  X <- X - E^+ Psi(X), the smallest change that removes the residual.

A step is accepted if the corrector converges near the prediction and the tangent has turned little; otherwise it is halved. So
the branch stays the same, or the status is `lost`. E^+ is truncated: constraints may be redundant, and where
branches meet and E loses rank, a step along the old tangent crosses the meeting.

The sign of det [E; tau] changes where a branch meets another, and also where a step jumps to a neighbouring branch: such a step
is accepted only if it is short. Branches closer to each other than such a step are treated as meeting.

At values so close to a meeting of branches that E is useless, positions are interpolated across it (crossing.py).

Source: Allgower, Georg, Introduction to Numerical Continuation Methods (2003), chapters 2 and 9.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.arrays import ArrayLibrary
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.equations.terms.scale_program import RANK_TOL
from udkjax.native.host.host_function import call_seldom
from udkjax.positions.following.crossing import CLOSE_DISTANCE, LOST_RANK, NEAR_LOSS, Crossing, find_crossing, find_toggle
from udkjax.positions.following.curve import AbstractCurve
from udkjax.printing import PrintsWords
from udkjax.programs.control_flow import sequential

FIRST_STEP, LONGEST_ARC, SHORTEST_ARC = 0.1, 0.3, 1e-9  # steps along the arc, in characteristic lengths or radians
LARGEST_BEND = 0.95  # cosine of the largest turn of the tangent in a step, 18 degrees; crossing branches differ by more
PREDICTION_TOL = 0.3  # largest distance of a step's end from the prediction, relative to the step
MAX_SECANTS = 60  # largest number of secant steps to a root; ten are usual
MAX_TRIALS = 2000  # extra steps between requested values: enough for some hundred turns
TOGGLE_TOL = 8.0  # tolerance, in units of rounding, within which a value equals that of a toggle

T = TypeVar("T")


class Reached(PrintsWords):
    """The outcome of following a branch to one value of a driver."""

    closed = 0
    singular = 1  # closed; branches meet, and velocities on the followed branch are interpolated from both sides
    beyond_limit = 2  # a toggle, the limit of travel, comes first
    lost = 3  # no step, however short, follows the branch
    open = 4  # the mechanism cannot be closed at the start
    not_determined = 5  # closed, but the driver does not determine velocities: a toggle, or branches too close to each other

    @classmethod
    def has_position(cls, status: Int[Array, "..."]) -> Bool[Array, "..."]:
        """Return a mask of the values with a position."""
        return (status == cls.closed) | (status == cls.singular) | (status == cls.not_determined)


class Points(NamedTuple):
    """Positions at the values of a driver, their derivatives with respect to the value, and a `Reached` for each value.

    If the motion ended at a toggle, `limit` and `limit_q` are its value and its position.
    """

    q: Float[Array, "T n"]
    dq: Float[Array, "T n"]
    ddq: Float[Array, "T n"]
    status: Int[Array, "T"]
    dddq: Float[Array, "T n"]  # only where branches meet
    spacing: Float[Array, "T"]  # spacing h of neighbouring points on the branch (crossing.py), where branches meet
    limit: Float[Array, ""]  # the value at the toggle; infinite without a toggle
    limit_q: Float[Array, "n"]


class _Search(NamedTuple):
    """A bracketed root along the arc, searched by the Illinois method (regula falsi that halves a retained end)."""

    sigma: Float[Array, ""]  # arc at the last evaluation
    value: Float[Array, ""]
    other: Float[Array, ""]  # the other side of the bracket
    other_value: Float[Array, ""]
    tries: Int[Array, ""]


class _State(NamedTuple):
    X: Float[Array, "n+1"]
    tau: Float[Array, "n+1"]
    side: Float[Array, ""]  # side of a meeting of branches, `AbstractCurve.tangent`
    h: Float[Array, ""]
    k: Int[Array, ""]  # the next value
    trials: Int[Array, ""]
    event: Int[Array, ""]  # a `Reached`, or one of the events below
    search: _Search
    points: Points


# Events in addition to the outcomes of `Reached`: the start is not closed yet; X is the point of the next value; a search for a
# toggle within the next step; a search for the next value before that toggle.
_START, _LANDS, _TOGGLE, _VALUE = -1, -2, -3, -4


def follow(
    curve: AbstractCurve,
    s: Float[Array | np.ndarray, ""],
    q: Float[Array | np.ndarray, "n"],
    values: Float[Array | np.ndarray, "T"],
    points: Points,
    first: int | Int[Array, ""],
) -> Points:
    """Return `points` with the positions at values[first:], followed in sequence from the position q at the value s.

    Members of a batch run one after another: in lockstep all would take as many steps as the slowest. No derivatives.
    """
    if curve.by.xp is np:
        with np.errstate(all="ignore"):  # non-finite positions are not closed
            return _follow(curve, s, q, values, points, first) if first < len(values) else points
    return sequential(_follow, curve, s, q, values, points, first)


def _follow(
    curve: AbstractCurve,
    s: Float[Array | np.ndarray, ""],
    q: Float[Array | np.ndarray, "n"],
    values: Float[Array | np.ndarray, "T"],
    points: Points,
    first: int | Int[Array, ""],
) -> Points:
    by, xp = curve.by, curve.by.xp
    X, targets = xp.append(q, s) / curve.units, values / curve.units[-1]
    zero, no_steps = xp.zeros((), X.dtype), xp.asarray(0)
    state = _State(
        X=X,
        tau=xp.append(xp.zeros_like(X[:-1]), 1.0),
        side=xp.ones((), X.dtype),
        h=xp.asarray(FIRST_STEP, X.dtype),
        k=xp.asarray(first),
        trials=no_steps,
        event=xp.asarray(_START),
        search=_Search(zero, zero, zero, zero, no_steps),
        points=points,
    )
    max_trials = MAX_TRIALS + 4 * len(values)

    def is_underway(state: _State) -> Bool[Array, ""]:
        return (state.k < len(values)) & ((state.event == Reached.closed) | (state.event == _START) | (state.event <= _TOGGLE))

    def body(state: _State) -> _State:
        return _record(curve, by.while_loop(is_underway, lambda state: _try(curve, targets, max_trials, state), state))

    def goes_on(state: _State) -> Bool[Array, ""]:
        return (is_underway(state) | (state.event == _LANDS)) & (state.trials < max_trials)

    state = by.while_loop(goes_on, body, state)
    event = xp.where(is_underway(state), Reached.lost, state.event)
    status = xp.where(np.arange(len(values)) >= state.k, event, state.points.status)
    return state.points._replace(status=status)


def _try(curve: AbstractCurve, targets: Float[Array, "T"], most: int, state: _State) -> _State:
    """Return the state after a trial, which corrects one point: the start, the end of a step, or a point of a search.

    All use a single call of the corrector, since each traced call adds compile time.
    """
    xp = curve.by.xp
    X, h, target, starts, searches = state.X, state.h, targets[state.k], state.event == _START, state.event <= _TOGGLE
    way = xp.where(target >= X[-1], 1.0, -1.0)
    sign = xp.where(starts | (state.tau[-1] * way >= 0), 1.0, -1.0)
    tau = sign * state.tau
    slope = xp.abs(tau[-1])
    needed = xp.where(target == X[-1], 0.0, xp.abs(target - X[-1]) / xp.where(slope > 0, slope, 1.0))
    lands = ~searches & ~starts & ((needed <= h) & (slope > 0) | (target == X[-1]))
    eta = xp.where(starts, 0.0, xp.where(searches, _secant(state.search, xp), xp.where(lands, needed, h)))
    predicted = X + eta * tau
    predicted = xp.append(predicted[:-1], xp.where(lands, target, predicted[-1]))
    corrected, closed = curve.correct(predicted, fixed=lands | starts)
    tangent, side, clearance = curve.tangent(corrected, tau)

    def begin() -> _State:  # at a meeting of branches, on any of them
        return state._replace(X=corrected, tau=tangent, side=side, event=xp.where(closed, _LANDS, Reached.open))

    def narrow() -> _State:
        return _narrow(curve, state, target, way, eta, corrected, tangent, clearance)

    def advance() -> _State:
        return _advance(
            curve,
            state._replace(tau=tau, side=sign * state.side),
            target,
            way,
            eta,
            lands,
            predicted,
            corrected,
            closed,
            tangent,
            side,
            clearance,
            most,
        )

    cond = curve.by.cond
    return cond(starts, begin, lambda: cond(searches, narrow, advance))


def _choose(condition: Bool[Array, ""], a: T, b: T, xp: ArrayLibrary) -> T:
    return jax.tree.map(lambda x, y: y if x is y else xp.where(condition, x, y), a, b)


def _advance(
    curve: AbstractCurve,
    state: _State,
    target: Float[Array, ""],
    way: Float[Array, ""],
    eta: Float[Array, ""],
    lands: Bool[Array, ""],
    predicted: Float[Array, "n+1"],
    corrected: Float[Array, "n+1"],
    closed: Bool[Array, ""],
    tangent: Float[Array, "n+1"],
    side: Float[Array, ""],
    clearance: Float[Array, ""],
    max_trials: int,
) -> _State:
    """Return the state after a step of length eta; if the step is not accepted, the old state with a shorter next step.

    `predicted` is the prediction, and `corrected` the corrected point, with the tangent `tangent`. The target is in the direction
    with the sign `way`; a step that `lands` ends at the target's value.
    """
    xp, X, tau, h = curve.by.xp, state.X, state.tau, state.h
    # At a fixed value a rounding error of the residual moves the point by its size over the slope of the value, at a toggle by
    # its root.
    slope = xp.where(lands, xp.maximum(xp.abs(tau[-1]), np.finfo(X.dtype).eps ** 0.5), 1.0)
    rounding = 64 * np.finfo(X.dtype).eps * xp.maximum(1.0, xp.max(xp.abs(X))) / slope
    near = xp.linalg.norm(corrected - predicted) <= PREDICTION_TOL * eta + rounding
    # A residual remains in directions that E^+ truncates; it is of second order in the step, and corrected in the next step.
    closed = closed | (~lands & (clearance <= RANK_TOL) & (curve.violation(corrected) <= CLOSURE.tol))
    good = near & (tangent @ tau >= LARGEST_BEND) & closed
    good = good & ~(lands & (eta > CLOSE_DISTANCE) & (clearance < NEAR_LOSS))  # the tangent crosses a meeting only from nearby
    good = good & ((side == state.side) | (eta <= CLOSE_DISTANCE))  # else the point is on a neighbouring branch
    folds = good & (tangent[-1] * tau[-1] < 0) & (eta > 0)
    passed = good & ~lands & ~folds & ((target - corrected[-1]) * way < 0)  # beyond the target: retry with a shorter step
    is_accepted = good & ~folds & ~passed
    shorter = xp.where(passed, 0.5 * eta, xp.where(good, h, 0.5 * eta))
    longer = xp.where(tangent @ tau > 1 - 0.25 * (1 - LARGEST_BEND), xp.minimum(1.5 * h, LONGEST_ARC), h)
    lost = ~good & (0.5 * eta < SHORTEST_ARC) | (state.trials > max_trials)
    event = xp.where(lands & is_accepted, _LANDS, xp.where(lost, Reached.lost, state.event))
    bracket = _Search(eta, way * tangent[-1], xp.zeros_like(eta), way * tau[-1], xp.zeros_like(state.search.tries))
    return state._replace(
        X=xp.where(is_accepted, corrected, X),
        tau=xp.where(is_accepted, tangent, tau),
        side=xp.where(is_accepted, side, state.side),
        h=xp.where(folds, eta, xp.where(is_accepted, longer, shorter)),
        trials=state.trials + 1,
        event=xp.where(folds, _TOGGLE, event),
        search=bracket,
    )


def _secant(search: _Search, xp: ArrayLibrary) -> Float[Array, ""]:
    a, fa, b, fb = search.other, search.other_value, search.sigma, search.value
    slope = fb - fa
    return xp.clip(b - fb * (b - a) / xp.where(slope != 0, slope, 1.0), xp.minimum(a, b), xp.maximum(a, b))


def _narrow(
    curve: AbstractCurve,
    state: _State,
    target: Float[Array, ""],
    way: Float[Array, ""],
    sigma: Float[Array, ""],
    at: Float[Array, "n+1"],
    tangent: Float[Array, "n+1"],
    clearance: Float[Array, ""],
) -> _State:
    """Return the state of a search, for a toggle or then for a value before the toggle, after an evaluation at sigma."""
    xp, last, end = curve.by.xp, state.search, state.h
    for_value = state.event == _VALUE
    value = way * xp.where(for_value, target - at[-1], tangent[-1])
    crosses = value * last.value < 0
    other = xp.where(crosses, last.sigma, last.other), xp.where(crosses, last.value, 0.5 * last.other_value)
    ended = (xp.abs(sigma - last.sigma) <= 2 * float(np.finfo(end.dtype).eps) * end) | (value == 0)
    ended = ended | (last.tries + 1 >= MAX_SECANTS)
    narrowed = state._replace(search=_Search(sigma, value, *other, last.tries + 1))

    def across() -> Array:
        toggle, is_found = _at_seldom(curve, find_toggle, at, state.tau)
        return xp.where(is_found, toggle, at)

    at = curve.by.cond(ended & ~for_value & (clearance < NEAR_LOSS), across, lambda: at)
    # The toggle is found: the target is beyond it, equal up to rounding, or before it.
    tolerance = TOGGLE_TOL * float(np.finfo(at.dtype).eps) * xp.maximum(1.0, xp.abs(at[-1]))
    distance = (target - at[-1]) * way
    x, points = at * curve.units, state.points
    beyond = points._replace(limit=x[-1], limit_q=x[:-1])
    remaining = xp.maximum(end - sigma, SHORTEST_ARC)
    event = xp.where(distance > tolerance, Reached.beyond_limit, xp.where(distance >= -tolerance, _LANDS, _VALUE))
    start = (target - state.X[-1]) * way
    bracket = _Search(sigma, distance, xp.zeros_like(sigma), start, xp.zeros_like(last.tries))
    at_toggle = state._replace(event=event, search=bracket, h=xp.where(event == _LANDS, remaining, end))
    at_toggle = at_toggle._replace(X=xp.where(event == _LANDS, at, state.X), tau=xp.where(event == _LANDS, tangent, state.tau))
    at_toggle = at_toggle._replace(points=_choose(event == Reached.beyond_limit, beyond, points, xp))
    at_value = state._replace(X=at, tau=tangent, h=remaining, event=xp.full_like(state.event, _LANDS))
    return _choose(ended, _choose(for_value, at_value, at_toggle, xp), narrowed, xp)


def _at_seldom(curve: AbstractCurve, function: Callable[..., T], *arguments: Array) -> T:
    """Return function(curve, *arguments); in a traced program the host evaluates it, so that it need not be compiled."""
    return function(curve, *arguments) if curve.by.xp is np else call_seldom(function, curve, *arguments)


def _record(curve: AbstractCurve, state: _State) -> _State:
    """Return the state in which the current point is stored if it has the next value and is not the start.

    Near a meeting of branches, the point and its derivatives are interpolated from points of the branch on both sides.
    """
    by, xp = curve.by, curve.by.xp
    X, tau, k, points, lands = state.X, state.tau, state.k, state.points, state.event == _LANDS
    stores = lands & (state.trials > 0)
    clearance = curve.clearance(X)
    dq, ddq, rank = curve.derivatives(X[-1] * curve.units[-1], X[:-1] * curve.units[:-1])
    current = Crossing(X, tau, dq, ddq, xp.zeros_like(dq), xp.zeros((), X.dtype))

    def across() -> tuple[Crossing, Array]:
        other, is_found = _at_seldom(curve, find_crossing, X, tau)
        return jax.tree.map(lambda x, y: xp.where(is_found, x, y), other, current), is_found

    crossing, is_found = by.cond(lands & (clearance < NEAR_LOSS), across, lambda: (current, xp.asarray(False)))
    X, tau, dq, ddq, dddq, spacing = crossing
    deficient = rank < len(X) - 1
    doubtful = ~is_found & (deficient | (clearance < LOST_RANK))
    status = xp.where(doubtful, Reached.not_determined, xp.where(deficient, Reached.singular, Reached.closed))
    dq, ddq = (xp.where(doubtful, xp.nan, x) for x in (dq, ddq))
    new = {"q": X[:-1] * curve.units[:-1], "dq": dq, "ddq": ddq, "status": status, "dddq": dddq, "spacing": spacing}
    old = points._asdict()
    points = points._replace(**{name: by.put(old[name], k, xp.where(stores, x, old[name][k])) for name, x in new.items()})
    event = xp.where(lands, Reached.closed, state.event)
    return state._replace(X=X, tau=tau, k=k + stores, event=event, points=points)


def no_points(count: int, n: int, xp: ArrayLibrary) -> Points:
    """Return points for `count` values, all without a position yet."""
    q, dq, ddq, dddq = (xp.zeros((count, n)) for _ in range(4))
    status = xp.full(count, int(Reached.lost))
    return Points(q, dq, ddq, status, dddq, xp.zeros(count), xp.asarray(np.inf), xp.full(n, np.inf))
