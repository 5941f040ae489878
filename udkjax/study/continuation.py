"""Follow the positions of a driven mechanism: a curve Psi(s, q) = 0 of values s and coordinates q, by its arc length.

The curve is smooth also where the mechanism is at a toggle: there s turns back (ds/dsigma = 0 along the arc sigma), which is a
simple root of a smooth function. With X = (q, s), each measured by its scale, and E = dPsi/dX of weighted rows,

    tangent    tau = (I - E^+ E) tau_before, of unit length: it keeps its direction, so that the curve is never turned around;
    predictor  X + h tau;        corrector  X <- X - E^+ Psi(X), the smallest change that removes the residual.

A step counts if the corrector converges near the prediction and the tangent has turned little; else it is halved. So the branch
stays the same, or the curve is lost and says so. E^+ is truncated: redundant constraints do no harm, and where branches meet,
which costs E rank, the old tangent leads across.

A value so near to a meeting of branches that its own E is of no use is found across it (crossing.py).

Source: Allgower, Georg, Introduction to Numerical Continuation Methods (2003), chapters 2 and 9.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.equations.structure import ArrayLibrary
from udkjax.printing import PrintsWords
from udkjax.study.control_flow import ControlFlow, sequential
from udkjax.study.crossing import CLOSE_DISTANCE, LOST_RANK, NEAR_LOSS, Crossing, find_crossing
from udkjax.study.curve import AbstractCurve

FIRST_STEP, LONGEST_ARC, SHORTEST_ARC = 0.1, 0.3, 1e-9  # steps along the arc; one is a characteristic length, or a radian
LARGEST_BEND = 0.95  # cosine of the angle by which the tangent may turn in a step: 18 degrees; branches that cross differ by more
PREDICTION_TOL = 0.3  # of a step: how far its end may lie from the prediction
MAX_SECANTS = 60  # until a root is rounding; ten are usual
MAX_TRIALS = 2000  # steps besides those to the values asked for: some hundred turns
AT_TOGGLE = 8.0  # units of rounding within which a value is that of a toggle


class Reached(PrintsWords):
    """Outcome for one value of a driver."""

    closed = 0
    singular = 1  # closed; branches meet here, and velocities are those of the one that is followed, from both of its sides
    beyond_limit = 2  # a toggle, the limit of travel, lies before it
    lost = 3  # no step, however short, follows the branch
    open = 4  # the mechanism cannot be closed where it starts
    not_determined = 5  # closed; but velocities do not follow from the driver's: a toggle, or branches that cannot be told apart

    @classmethod
    def has_position(cls, status: Int[Array, "..."]) -> Bool[Array, "..."]:
        """Tell of which values the position is known."""
        return (status == cls.closed) | (status == cls.singular) | (status == cls.not_determined)


class Points(NamedTuple):
    """Positions along the values, their derivatives by the value, and what became of each; and the toggle, if one was met."""

    q: Float[Array, "T n"]
    dq: Float[Array, "T n"]
    ddq: Float[Array, "T n"]
    status: Int[Array, "T"]
    dddq: Float[Array, "T n"]  # where branches meet
    spacing: Float[Array, "T"]  # of the points of the branch beside it, likewise: h in crossing.py
    limit: Float[Array, ""]  # the value at the toggle; infinite where none was met
    limit_q: Float[Array, "n"]


class _State(NamedTuple):
    X: Float[Array, "n+1"]
    tau: Float[Array, "n+1"]
    h: Float[Array, ""]
    k: Int[Array, ""]  # the next value
    trials: Int[Array, ""]
    event: Int[Array, ""]  # a `Reached`; `_FOLD` where a toggle lies within the next step, `_LANDS` where X is the next value's
    points: Points


_FOLD, _LANDS = -1, -2  # events beside the outcomes of `Reached`


def follow(
    curve: AbstractCurve,
    s: Float[Array, ""],
    q: Float[Array, "n"],
    values: Float[Array, "T"],
    points: Points,
    first: int | Int[Array, ""],
) -> Points:
    """Find positions at values[first:], one after another, from a position q at the value s; those before are in `points`.

    Of a batch one member follows another: side by side all would take as many steps as the slowest. Without derivatives.
    """
    if curve.by.xp is np:
        with np.errstate(all="ignore"):  # what is not finite closes nothing
            return _follow(curve, s, q, values, points, first) if first < len(values) else points
    return sequential(_follow, curve, s, q, values, points, first)


def _follow(
    curve: AbstractCurve,
    s: Float[Array, ""],
    q: Float[Array, "n"],
    values: Float[Array, "T"],
    points: Points,
    first: int | Int[Array, ""],
) -> Points:
    by, xp = curve.by, curve.by.xp
    X, closed = curve.correct(xp.append(q, s) / curve.units, fixed=True)
    targets = values / curve.units[-1]
    tau = curve.tangent(X, xp.append(xp.zeros_like(X[:-1]), 1.0))
    one, k = xp.asarray(FIRST_STEP, X.dtype), xp.asarray(first)
    start = xp.where(closed, _LANDS, Reached.open)  # where branches meet, one of them is taken
    state = _State(X, tau, one, k, xp.asarray(0), start, points)

    def is_unfinished(state: _State) -> Bool[Array, ""]:
        return (state.k < len(values)) & (state.event == Reached.closed)

    def body(state: _State) -> _State:
        state = by.while_loop(is_unfinished, lambda state: _step(curve, targets, state), state)
        state = by.cond(state.event == _FOLD, lambda: _find_fold(curve, targets, state), lambda: state)
        return _record(curve, state)

    def goes_on(state: _State) -> Bool[Array, ""]:
        return (is_unfinished(state) | (state.event == _LANDS)) & (state.trials < MAX_TRIALS + 4 * len(values))

    state = by.while_loop(goes_on, body, state)
    event = xp.where(is_unfinished(state), Reached.lost, state.event)
    status = xp.where(np.arange(len(values)) >= state.k, event, state.points.status)
    return state.points._replace(status=status)


def _step(curve: AbstractCurve, targets: Float[Array, "T"], state: _State) -> _State:
    """Take one step towards the next value, or right to it."""
    xp = curve.by.xp
    X, tau, h, k, trials, event, points = state
    target = targets[k]
    way = xp.where(target >= X[-1], 1.0, -1.0)
    tau = tau * xp.where(tau[-1] * way >= 0, 1.0, -1.0)
    slope = xp.abs(tau[-1])
    wanted = xp.abs(target - X[-1]) / xp.where(slope > 0, slope, 1.0)
    lands = (wanted <= h) & (slope > 0) | (target == X[-1])
    eta = xp.where(lands, xp.where(target == X[-1], 0.0, wanted), h)
    ahead = X + eta * tau
    ahead = xp.append(ahead[:-1], xp.where(lands, target, ahead[-1]))
    at, closed = curve.correct(ahead, fixed=lands)
    turned = curve.tangent(at, tau)
    rounding = 64 * np.finfo(X.dtype).eps * xp.maximum(1.0, xp.max(xp.abs(X)))
    near = xp.linalg.norm(at - ahead) <= PREDICTION_TOL * eta + rounding
    good = near & (turned @ tau >= LARGEST_BEND) & closed
    good = good & ~(lands & (eta > CLOSE_DISTANCE) & (curve.clearance(at) < NEAR_LOSS))  # only a close tangent leads across
    folds = good & (turned[-1] * tau[-1] < 0) & (eta > 0)
    passed = good & ~lands & ~folds & ((target - at[-1]) * way < 0)  # too far: the next one is shorter
    counts = good & ~folds & ~passed
    lands = lands & counts
    shorter = xp.where(passed, 0.5 * eta, xp.where(good, h, 0.5 * eta))
    longer = xp.where(turned @ tau > 1 - 0.25 * (1 - LARGEST_BEND), xp.minimum(1.5 * h, LONGEST_ARC), h)
    lost = ~good & (0.5 * eta < SHORTEST_ARC)
    return _State(
        X=xp.where(counts, at, X),
        tau=xp.where(counts, turned, tau),
        h=xp.where(folds, eta, xp.where(counts, longer, shorter)),
        k=k,
        trials=trials + 1,
        event=xp.where(
            folds,
            _FOLD,
            xp.where(lands, _LANDS, xp.where(lost | (trials > MAX_TRIALS + 4 * len(targets)), Reached.lost, event)),
        ),
        points=points,
    )


def _record(curve: AbstractCurve, state: _State) -> _State:
    """Store the point of the curve that is the next value's, where it is one, unless it is that of the start.

    Near where branches meet, it and its derivatives are those of the branch's points on both sides.
    """
    by, xp = curve.by, curve.by.xp
    X, tau, k, points, lands = state.X, state.tau, state.k, state.points, state.event == _LANDS
    stores = lands & (state.trials > 0)
    clearance = curve.clearance(X)
    dq, ddq, rank = curve.derivatives(X[-1] * curve.units[-1], X[:-1] * curve.units[:-1])
    here = Crossing(X, tau, dq, ddq, xp.zeros_like(dq), xp.zeros((), X.dtype))

    def beside() -> tuple[Crossing, Array]:
        other, is_known = find_crossing(curve, X, tau)
        return jax.tree.map(lambda x, y: xp.where(is_known, x, y), other, here), is_known

    found, is_known = by.cond(lands & (clearance < NEAR_LOSS), beside, lambda: (here, xp.asarray(False)))
    X, tau, dq, ddq, dddq, spacing = found
    deficient = rank < len(X) - 1
    doubtful = ~is_known & (deficient | (clearance < LOST_RANK))
    status = xp.where(doubtful, Reached.not_determined, xp.where(deficient, Reached.singular, Reached.closed))
    dq, ddq = (xp.where(doubtful, xp.nan, x) for x in (dq, ddq))
    new = {"q": X[:-1] * curve.units[:-1], "dq": dq, "ddq": ddq, "status": status, "dddq": dddq, "spacing": spacing}
    old = points._asdict()
    points = points._replace(**{name: by.put(old[name], k, xp.where(stores, x, old[name][k])) for name, x in new.items()})
    event = xp.where(lands, Reached.closed, state.event)
    return state._replace(X=X, tau=tau, k=k + stores, event=event, points=points)


def _find_fold(curve: AbstractCurve, targets: Float[Array, "T"], state: _State) -> _State:
    """Find the toggle within the next step, and the next value if it lies before."""
    by, xp = curve.by, curve.by.xp
    X, tau, h, k, _, _, points = state
    target, way = targets[k], xp.sign(tau[-1])

    def point_at(sigma: Float[Array, ""]) -> tuple[Array, Array]:
        at = curve.correct(X + sigma * tau)[0]
        return at, curve.tangent(at, tau)

    def find(end: Float[Array, ""], of_value: Bool[Array, ""]) -> tuple[Array, tuple[Array, Array, Array]]:
        """Return where the tangent turns back, or where the target is, before `end`."""

        def ahead(sigma: Float[Array, ""]) -> Float[Array, ""]:
            at, tangent = point_at(sigma)
            return way * xp.where(of_value, target - at[-1], tangent[-1])

        sigma = _root(ahead, end, by)
        return sigma, (sigma, *point_at(sigma))

    _, (sigma, (fold, landed), (_, turned)) = by.scan(find, h, xp.array([False, True]))
    room = AT_TOGGLE * float(np.finfo(X.dtype).eps) * xp.maximum(1.0, xp.abs(fold[-1]))
    before = (target - fold[-1]) * way <= room
    x = fold * curve.units
    landed = xp.where(xp.abs(target - fold[-1]) <= room, fold, landed)  # which is known to rounding, and not to its root
    points = points._replace(
        limit=xp.where(before, points.limit, x[-1]),
        limit_q=xp.where(before, points.limit_q, x[:-1]),
    )
    return state._replace(
        X=xp.where(before, landed, X),
        tau=xp.where(before, turned, tau),
        h=xp.maximum(h - sigma[1], SHORTEST_ARC),
        event=xp.where(before, _LANDS, Reached.beyond_limit),
        points=points,
    )


def _root(f: Callable[[Array], Array], end: Float[Array, ""], by: ControlFlow) -> Float[Array, ""]:
    """Return where f, positive at 0, becomes negative before `end`, to rounding; the end, where it does not.

    By the rule of Illinois: secants of a bracket, of which a side that stays counts half.
    """
    xp, rounding = by.xp, 2 * float(np.finfo(end.dtype).eps)

    def halve(state: tuple[Array, ...]) -> tuple[Array, ...]:
        a, fa, b, fb, k, _ = state
        slope = fb - fa
        c = xp.clip(b - fb * (b - a) / xp.where(slope != 0, slope, 1.0), xp.minimum(a, b), xp.maximum(a, b))
        fc = f(c)
        crosses = fc * fb < 0
        done = (xp.abs(c - b) <= rounding * end) | (fc == 0)
        return xp.where(crosses, b, a), xp.where(crosses, fb, 0.5 * fa), c, fc, k + 1, done

    # One evaluation for both ends: what is traced once compiles in half the time.
    at_start, at_end = by.map(f, xp.stack([xp.zeros_like(end), end]))
    state = xp.zeros_like(end), at_start, end, at_end, xp.asarray(0), at_end >= 0
    return by.while_loop(lambda s: (s[4] < MAX_SECANTS) & ~s[5], halve, state)[2]


def no_points(count: int, n: int, xp: ArrayLibrary) -> Points:
    """Return points of which none is known yet."""
    q, dq, ddq, dddq = (xp.zeros((count, n)) for _ in range(4))
    status = xp.full(count, int(Reached.lost))
    return Points(q, dq, ddq, status, dddq, xp.zeros(count), xp.asarray(np.inf), xp.full(n, np.inf))
