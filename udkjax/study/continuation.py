"""Follow the positions of a driven mechanism: a curve Psi(s, q) = 0 of values s and coordinates q, by its arc length.

The curve is smooth also where the mechanism is at a toggle: there s turns back (ds/dsigma = 0 along the arc sigma), which is a
simple root of a smooth function. With X = (q, s), each measured by its scale, and E = dPsi/dX of weighted rows,

    tangent    tau = (I - E^+ E) tau_before, of unit length: it keeps its direction, so that the curve is never turned around;
    predictor  X + h tau;        corrector  X <- X - E^+ Psi(X), the smallest change that removes the residual.

A step counts if the corrector converges near the prediction and the tangent has turned little; else it is halved. So the branch
stays the same, or the curve is lost and says so. E^+ is truncated: redundant constraints do no harm, and where branches meet,
which costs E rank, the old tangent leads across.

Source: Allgower, Georg, Introduction to Numerical Continuation Methods (2003), chapters 2 and 9.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.equations.constraints import gamma, psi
from udkjax.equations.position_closure import ROUNDING_UNITS
from udkjax.equations.scales import RANK_TOL
from udkjax.pinv import SVD, Plus
from udkjax.printing import PrintsWords
from udkjax.scene.mechanism import Mechanism
from udkjax.study.drive import Driven
from udkjax.study.sequential import sequential

FIRST, LONGEST, SHORTEST = 0.1, 0.3, 1e-9  # steps along the arc; one is a characteristic length, or a radian
STRAIGHT = 0.95  # cosine of the angle by which the tangent may turn in a step: 18 degrees; branches that cross differ by more
SLACK = 0.3  # of a step: how far its end may lie from the prediction
NEWTON = 8  # corrections; three are usual
SECANTS = 60  # until a root is rounding; ten are usual
TRIALS = 2000  # steps besides those to the values asked for: some hundred turns
SAME = 8.0  # units of rounding within which a value is that of a toggle


class Reached(PrintsWords):
    """What became of one value of a driver."""

    closed = 0
    singular = 1  # closed; but branches meet here, or a toggle lies here: velocities do not follow from the driver's
    beyond_limit = 2  # a toggle, the limit of travel, lies before it
    lost = 3  # no step, however short, follows the branch
    open = 4  # the mechanism cannot be closed where it starts


class Points(NamedTuple):
    """Positions along the values, their derivatives by the value, and what became of each; and the toggle, if one was met."""

    q: Float[Array, "T n"]
    dq: Float[Array, "T n"]
    ddq: Float[Array, "T n"]
    status: Int[Array, "T"]
    limit: Float[Array, ""]  # the value at the toggle; not a number where none was met
    limit_q: Float[Array, "n"]


class _State(NamedTuple):
    X: Float[Array, "n+1"]
    tau: Float[Array, "n+1"]
    h: Float[Array, ""]
    k: Int[Array, ""]  # the next value
    trials: Int[Array, ""]
    event: Int[Array, ""]  # a `Reached`; `_FOLD` where a toggle lies within the next step
    points: Points


_FOLD = -1
_Correction = tuple[Array, Array, Array]  # X, corrections so far, whether it is closed


class Curve(eqx.Module):
    """The positions of a driven mechanism, as a curve in scaled coordinates and value."""

    mechanism: Mechanism
    weights: Float[Array, "m"]
    units: Float[Array, "n+1"]
    rows: Float[Array, "m"]

    @classmethod
    def of(cls, driven: Driven) -> "Curve":
        scales = driven.analysis.scales
        units = jnp.append(scales.coordinates(driven.analysis.coordinates), driven.unit)
        return cls(driven.mechanism, scales.weights, units, scales.rows)

    def residual(self, X: Float[Array, "n+1"]) -> Float[Array, "m"]:
        x = X * self.units
        return self.weights * psi(self.mechanism, x[-1], x[:-1])

    def slopes(self, X: Float[Array, "n+1"]) -> Float[Array, "m n+1"]:
        return jax.jacfwd(self.residual)(X)

    def is_closed(self, X: Float[Array, "n+1"]) -> Bool[Array, ""]:
        """Whether the residual is what rounding leaves of it."""
        size = jnp.max(jnp.abs(self.residual(X) / (self.weights * self.rows)), initial=0.0)
        return size <= ROUNDING_UNITS * float(jnp.finfo(X.dtype).eps) * jnp.maximum(1.0, jnp.max(jnp.abs(X)))

    def correct(self, X: Float[Array, "n+1"], fixed: Bool[Array, ""] | bool = False) -> tuple[Array, Bool[Array, ""]]:
        """Return the nearest point of the curve; `fixed`: of the same value. And whether there is one."""
        if not len(self.rows):  # nothing binds the coordinates
            return X, jnp.asarray(True)

        def body(state: _Correction) -> _Correction:
            X, k, _ = state
            E = self.slopes(X)
            E = jnp.where(fixed & (jnp.arange(len(X)) == len(X) - 1), 0.0, E)
            return X - plus(E) @ self.residual(X), k + 1, self.is_closed(X)

        def is_unfinished(state: _Correction) -> Bool[Array, ""]:  # the last correction is that of a closed point, to rounding
            _, k, closed = state
            return (k < NEWTON) & ~closed

        X, _, closed = jax.lax.while_loop(is_unfinished, body, (X, jnp.asarray(0), jnp.asarray(False)))
        return X, closed

    def tangent(self, X: Float[Array, "n+1"], before: Float[Array, "n+1"]) -> Float[Array, "n+1"]:
        E = self.slopes(X)
        tau = before - plus(E) @ (E @ before)
        size = jnp.linalg.norm(tau)
        return tau / jnp.where(size > 0, size, 1.0)


def plus(E: Float[Array, "m n"]) -> Plus:
    """Return E^+, truncated."""
    return SVD(RANK_TOL).plus(E)


def derivatives(curve: Curve, s: Float[Array, ""], q: Float[Array, "n"]) -> tuple[Array, Array, Array]:
    """Return q' = dq/ds and q'' (n,) at a closed position, and the rank of Psi_q: Psi_q q' = -Psi_s, Psi_q q'' = gamma."""
    W, w, mechanism = curve.units[:-1], curve.weights, curve.mechanism
    E = w[:, None] * jax.jacfwd(lambda q: psi(mechanism, s, q))(q) * W
    inverse = plus(E)
    rate = jax.jvp(lambda s: psi(mechanism, s, q), (s,), (jnp.ones_like(s),))[1]
    dq = -W * (inverse @ (w * rate))
    return dq, W * (inverse @ (w * gamma(mechanism, s, q, dq))), inverse.rank


def follow(
    curve: Curve,
    s: Float[Array, ""],
    q: Float[Array, "n"],
    values: Float[Array, "T"],
    points: Points,
    first: int | Int[Array, ""],
) -> Points:
    """Find positions at values[first:], one after another, from a position q at the value s; those before are in `points`.

    Of a batch one member follows another: side by side all would take as many steps as the slowest. Without derivatives.
    """
    return sequential(_follow, curve, s, q, values, points, first)


def _follow(
    curve: Curve, s: Float[Array, ""], q: Float[Array, "n"], values: Float[Array, "T"], points: Points, first: Int[Array, ""]
) -> Points:
    X, closed = curve.correct(jnp.append(q, s) / curve.units, fixed=True)
    targets = values / curve.units[-1]
    tau = curve.tangent(X, jnp.zeros_like(X).at[-1].set(1.0))
    one, first = jnp.asarray(FIRST, X.dtype), jnp.asarray(first)
    start = jnp.where(closed, Reached.closed, Reached.open)
    state = _State(X, tau, one, first, jnp.asarray(0), start, points)

    def is_unfinished(state: _State) -> Bool[Array, ""]:
        return (state.k < len(values)) & (state.event == Reached.closed)

    def body(state: _State) -> _State:
        state = jax.lax.while_loop(is_unfinished, lambda state: _step(curve, targets, state), state)
        return _find_fold(curve, targets, state)

    def goes_on(state: _State) -> Bool[Array, ""]:
        return is_unfinished(state) & (state.trials < TRIALS + 4 * len(values))

    state = jax.lax.while_loop(goes_on, body, state)
    event = jnp.where(is_unfinished(state), Reached.lost, state.event)
    status = jnp.where(jnp.arange(len(values)) >= state.k, event, state.points.status)
    return state.points._replace(status=status)


def _step(curve: Curve, targets: Float[Array, "T"], state: _State) -> _State:
    """Take one step towards the next value, or right to it."""
    X, tau, h, k, trials, event, points = state
    target = targets[k]
    way = jnp.where(target >= X[-1], 1.0, -1.0)
    tau = tau * jnp.where(tau[-1] * way >= 0, 1.0, -1.0)
    slope = jnp.abs(tau[-1])
    wanted = jnp.abs(target - X[-1]) / jnp.where(slope > 0, slope, 1.0)
    lands = (wanted <= h) & (slope > 0) | (target == X[-1])
    eta = jnp.where(lands, jnp.where(target == X[-1], 0.0, wanted), h)
    ahead = X + eta * tau
    ahead = ahead.at[-1].set(jnp.where(lands, target, ahead[-1]))
    at, closed = curve.correct(ahead, fixed=lands)
    turned = curve.tangent(at, tau)
    near = jnp.linalg.norm(at - ahead) <= SLACK * eta + 64 * jnp.finfo(X.dtype).eps * jnp.maximum(1.0, jnp.max(jnp.abs(X)))
    good = near & (turned @ tau >= STRAIGHT) & closed
    folds = good & (turned[-1] * tau[-1] < 0) & (eta > 0)
    passed = good & ~lands & ~folds & ((target - at[-1]) * way < 0)  # too far: the next one is shorter
    counts = good & ~folds & ~passed
    lands = lands & counts
    shorter = jnp.where(passed, 0.5 * eta, jnp.where(good, h, 0.5 * eta))
    longer = jnp.where(turned @ tau > 1 - 0.25 * (1 - STRAIGHT), jnp.minimum(1.5 * h, LONGEST), h)
    lost = ~good & (0.5 * eta < SHORTEST)
    return _State(
        X=jnp.where(counts, at, X),
        tau=jnp.where(counts, turned, tau),
        h=jnp.where(folds, eta, jnp.where(counts, longer, shorter)),
        k=k + lands,
        trials=trials + 1,
        event=jnp.where(folds, _FOLD, jnp.where(lost | (trials > TRIALS + 4 * len(targets)), Reached.lost, event)),
        points=_record(curve, points, k, at, lands),
    )


def _record(curve: Curve, points: Points, k: Int[Array, ""], X: Float[Array, "n+1"], which: Bool[Array, ""]) -> Points:
    """Store a point of the curve as that of values[k], where `which` is true."""
    x = X * curve.units
    dq, ddq, rank = derivatives(curve, x[-1], x[:-1])
    new = x[:-1], dq, ddq, jnp.where(rank < len(x) - 1, Reached.singular, Reached.closed)
    q, dq, ddq, status = (x.at[k].set(jnp.where(which, y, x[k])) for x, y in zip(points[:4], new, strict=True))
    return Points(q, dq, ddq, status, points.limit, points.limit_q)


def _find_fold(curve: Curve, targets: Float[Array, "T"], state: _State) -> _State:
    """Find the toggle within the next step, if there is one, and the next value if it lies before."""
    X, tau, h, k, _, event, points = state
    folds, k = event == _FOLD, jnp.minimum(k, len(targets) - 1)
    target, way = targets[k], jnp.sign(tau[-1])

    def point_at(sigma: Float[Array, ""]) -> tuple[Array, Array]:
        at = curve.correct(X + sigma * tau)[0]
        return at, curve.tangent(at, tau)

    def find(end: Float[Array, ""], of_value: Bool[Array, ""]) -> tuple[Array, tuple[Array, Array, Array]]:
        """Return where the tangent turns back, or where the target is, before `end`."""

        def ahead(sigma: Float[Array, ""]) -> Float[Array, ""]:
            at, tangent = point_at(sigma)
            return way * jnp.where(of_value, target - at[-1], tangent[-1])

        sigma = _root(ahead, end)
        return sigma, (sigma, *point_at(sigma))

    _, (sigma, (fold, landed), (_, turned)) = jax.lax.scan(find, h, jnp.array([False, True]))
    room = SAME * float(jnp.finfo(X.dtype).eps) * jnp.maximum(1.0, jnp.abs(fold[-1]))
    before = (target - fold[-1]) * way <= room
    lands, ends = folds & before, folds & ~before
    x = fold * curve.units
    points = _record(curve, points, k, landed, lands)
    points = points._replace(
        limit=jnp.where(ends, x[-1], points.limit),
        limit_q=jnp.where(ends, x[:-1], points.limit_q),
    )
    return state._replace(
        X=jnp.where(lands, landed, X),
        tau=jnp.where(lands, turned, tau),
        h=jnp.where(folds, jnp.maximum(h - sigma[1], SHORTEST), h),
        k=state.k + lands,
        event=jnp.where(lands, Reached.closed, jnp.where(ends, Reached.beyond_limit, event)),
        points=points,
    )


def _root(f: Callable[[Array], Array], end: Float[Array, ""]) -> Float[Array, ""]:
    """Return where f, positive at 0, becomes negative before `end`, to rounding; the end, where it does not.

    By the rule of Illinois: secants of a bracket, of which a side that stays counts half.
    """
    rounding = 2 * float(jnp.finfo(end.dtype).eps)

    def halve(state: tuple[Array, ...]) -> tuple[Array, ...]:
        a, fa, b, fb, k, _ = state
        slope = fb - fa
        c = jnp.clip(b - fb * (b - a) / jnp.where(slope != 0, slope, 1.0), jnp.minimum(a, b), jnp.maximum(a, b))
        fc = f(c)
        crosses = fc * fb < 0
        done = (jnp.abs(c - b) <= rounding * end) | (fc == 0)
        return jnp.where(crosses, b, a), jnp.where(crosses, fb, 0.5 * fa), c, fc, k + 1, done

    # One evaluation for both ends: what is traced once compiles in half the time.
    at_start, at_end = jax.lax.map(f, jnp.stack([jnp.zeros_like(end), end]))
    state = jnp.zeros_like(end), at_start, end, at_end, jnp.asarray(0), at_end >= 0
    return jax.lax.while_loop(lambda s: (s[4] < SECANTS) & ~s[5], halve, state)[2]


def no_points(count: int, n: int) -> Points:
    """Return points of which none is known yet."""
    nothing = jnp.full((count, n), jnp.nan)
    status = jnp.full(count, int(Reached.lost))
    return Points(nothing, nothing, nothing, status, jnp.asarray(np.nan), jnp.full(n, jnp.nan))
