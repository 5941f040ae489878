"""Impacts of contacts with friction, followed from one small impulse to the next.

The rows of contacts, first the normal ones (n), then those along the lines (t), have the speeds y and the mobilities W: impulses
x change y by W x. An impact has two phases. In each of them s goes from 0 to 1; x' and y' = W x' are derivatives with respect to
s, c is the approach speed y_n <= 0 before the impact, L are the normal impulses of the compression; mu and e belong to a contact:

    compression:  0 <= x_n',        y_n >= (1 - s) c,    one of them an equality,
    expansion:    e L <= x_n',      y_n >= 0,            one of them an equality,
    both:         |x_t'| <= mu x_n';    x_t' = -mu x_n' sign(y_t) where the contact slides, y_t != 0; where it does not,
                  y_t' = 0, or x_t' = -mu x_n' sign(y_t').

All approach speeds thus vanish in proportion, and then all rebounds grow in proportion: Poisson's law. Between two changes of the
directions of sliding everything is linear. At each change a complementarity problem of the rates x' is solved, whose solution is
valid up to the next change. For one contact this is Routh's method. Where no contact changes its direction, the result is that
of one problem for each phase (Pfeiffer and Glocker, Multibody Dynamics with Unilateral Contacts, 1996, chapter 8).

Rows depend on each other where constraints leave fewer freedoms than there are rows: in one freedom, y_n and y_t vanish together.
The friction of a contact that slides is known nevertheless. If contacts could share an impulse in several ways, they share it as
if all rows had the same small compliance, in the units in which W_ii = 1. In the limit,

    z . x = 0    for each z with W z = 0, of the rows that are pressed or stick.

Two contacts on one freedom thus carry the same part of its momentum.

Where pressing a sliding contact drives it further in (as in Painleve's paradox), it stops sliding at once: the rest of the phase
is one problem, of the speeds at its end (Stewart and Trinkle 1996), with a solution unless constraints drive the contact in.

The work of all impulses is never positive: the expansion ends where it would have returned the work of the compression.
"""

import math
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.complementarity.linear import diagonal, eliminate, general_complementary_set, solve
from udkjax.complementarity.stick_or_slip import AT_REST
from udkjax.transforms.gradients import stop_gradients

# Compliance by which dependent rows find out which of them are pressed; their shares are those of its limit. It is large compared
# with rounding errors, and small compared with the mobilities, which are one. Within 1e-6 of the friction that locks a freedom, a
# contact may stick instead of sliding at 1e-6 of its speed.
COMPLIANCE = 1e-6
# Parts of a phase for each row: each contact stops sliding once or twice. The last part is one problem.
PHASE_PARTS_PER_ROW = 2
ROUNDING = 1e-12  # error of y = W x + b, relative to the largest x


class RubbingContacts(NamedTuple):
    """N contacts in an impact, F of which have friction. Of the R = N + F rows the normal ones come first.

    Units are those in which W_ii = 1.
    """

    W: Float[Any, "*m R R"]
    y: Float[Any, "*m R"]  # speeds before the impact
    restitution: Float[Any, "*m N"]
    friction: Float[Any, "*m F"]
    takes_part: Bool[Any, "*m N"]


class _Progress(NamedTuple):
    """State of an impact of N contacts, F of them with friction, at one value of s; R = N + F rows."""

    x: Any  # (R,): impulses
    y: Any  # (R,): speeds
    slides: Any  # (F,): direction of sliding, -1 or 1; 0: at rest
    approach: Any  # (N,): approach speed c; 0 in the expansion
    least: Any  # (N,): least impulse e L; 0 in the compression
    remains: Any  # 1 - s, the remaining fraction of the phase
    work: Any  # work of the impulses so far
    parts: Any  # number of parts of the phase so far
    at_once: Any  # whether the rest of the phase is one problem
    expands: Any  # whether the phase is the expansion
    done: Any


class _ImpactLaw(NamedTuple):
    """Data of one impact of N contacts, F of them with friction; R = N + F rows."""

    W: Any  # (R, R): mobilities
    friction: Any  # (F,): coefficients mu
    restitution: Any  # (N,): coefficients e
    takes_part: Any  # (N,): whether the contact is closed
    of_rows: Any  # (F,): the contact of each row along a line
    zero: Any  # speed that counts as zero
    xp: ModuleType

    @property
    def rubs(self) -> Any:
        """Mask of the rows along lines that have friction and whose contact is closed (F,)."""
        return self.takes_part[self.of_rows] & (self.friction > 0)


def rubbing_impact(contacts: RubbingContacts, of_rows: Int[np.ndarray, "F"], xp: ModuleType = jnp) -> Float[Any, "*m R"]:
    """Return the impulses x of an impact; NaN if constraints make a contact penetrate in spite of any impulse.

    Args:
        contacts: the contacts (N), and their state before the impact.
        of_rows: the contact of each row along a line.
        xp: jax.numpy, or NumPy, for which members are treated one after another.
    """

    def one(*contact: Any) -> Any:
        return _impact(RubbingContacts(*contact), of_rows, xp)

    if xp is not np:
        lead = contacts.y.shape[:-1]
        if lead and math.prod(lead) == 1:  # the single member of a run: as a batch it would go on after its end
            alone = (x.reshape(x.shape[x.ndim - k :]) for x, k in zip(contacts, (2, 1, 1, 1, 1), strict=True))
            return one(*alone).reshape(contacts.y.shape)
        return jnp.vectorize(one, signature="(r,r),(r),(n),(f),(n)->(r)")(*contacts)
    members = [
        np.broadcast_to(x, (*contacts.y.shape[:-1], *x.shape[x.ndim - k :]))
        for x, k in zip(contacts, (2, 1, 1, 1, 1), strict=True)
    ]
    found = [one(*(x[place] for x in members)) for place in np.ndindex(contacts.y.shape[:-1])]
    return np.array(found).reshape(contacts.y.shape)


def _impact(contacts: RubbingContacts, of_rows: Any, xp: ModuleType) -> Any:
    W, y, restitution, friction, takes_part = contacts
    N = len(restitution)
    size = xp.max(xp.where(takes_part, xp.abs(y[:N]), 0.0))
    law = _ImpactLaw(W, friction, restitution, takes_part, of_rows, xp.asarray(AT_REST.still * size), xp)
    none, one, no = xp.zeros_like(y), xp.ones_like(size), xp.asarray(False)
    approach = xp.where(takes_part, xp.minimum(y[:N], 0.0), 0.0)
    state = _Progress(none, y, none[N:], approach, none[:N], one, 0 * one, xp.asarray(0), no, no, no)
    state, most = _at_rest(law, state), 2 * (_most_parts(law) + 2)
    if xp is not np:
        step = lambda state, _: (jax.lax.cond(state.done, lambda s: s, partial(_advance, law), state), None)  # noqa: E731
        return jax.lax.scan(step, state, length=most)[0].x
    while not state.done:
        state = _advance(law, state)
    return state.x


def _most_parts(law: _ImpactLaw) -> int:
    return PHASE_PARTS_PER_ROW * (len(law.takes_part) + len(law.of_rows))


def _at_rest(law: _ImpactLaw, state: _Progress) -> _Progress:
    """Return a state whose `slides` are the signs of the present speeds of sliding; small speeds are set to zero."""
    xp, N = law.xp, len(law.takes_part)
    speed = xp.where(law.rubs & (xp.abs(state.y[N:]) <= law.zero), 0.0, state.y[N:])
    return state._replace(y=xp.concatenate([state.y[:N], speed]), slides=xp.sign(speed))


def _advance(law: _ImpactLaw, state: _Progress) -> _Progress:
    """Return the state at the next change of contacts, or at the end of the phase.

    Contacts change if one closes, or stops sliding. If no rates obey the law, the result is the same state with `at_once` set.
    """
    xp, N, at_once = law.xp, len(law.takes_part), state.at_once
    gap = state.y[:N] - state.remains * state.approach
    closed = law.takes_part & ((gap <= law.zero) | at_once)
    along = xp.zeros_like(state.y[N:])
    b = xp.where(at_once, state.y / state.remains, xp.concatenate([state.approach, along]))
    slides = xp.where(at_once, along, state.slides)
    rates, is_found = _rates(law, b, state.least, slides, closed)
    rates = xp.where(at_once & ~is_found, xp.nan, rates)  # constraints drive a contact in

    change = law.W @ rates
    closing = xp.concatenate([change[:N] + state.approach, slides * change[N:]])
    left = xp.concatenate([gap, xp.abs(state.y[N:])])
    counts = xp.concatenate([law.takes_part & ~closed, slides != 0]) & (closing < 0)
    first = xp.min(xp.where(counts, left / xp.where(counts, -closing, 1.0), xp.inf))
    ends = ~(first < state.remains * (1 - AT_REST.still))
    step = xp.where(ends, state.remains, first)

    work, power = state.y @ rates, rates @ change / 2
    too_much = _end_of_work(state.work, work, power, xp)
    ends, step = ends | (too_much < step), xp.where(too_much < step, too_much, step)
    x, y = state.x + step * rates, state.y + step * change
    moved = state._replace(
        x=x,
        y=y,
        approach=xp.where(ends, 0.0, state.approach),
        least=xp.where(ends, law.restitution * x[:N], state.least),
        remains=xp.where(ends, 1.0, state.remains - step),
        work=state.work + step * (work + step * power),
        parts=xp.where(ends, 0, state.parts + 1),
        at_once=~ends & (state.parts + 1 >= _most_parts(law)),
        expands=state.expands | ends,
        done=state.expands & ends,
    )
    moved = _at_rest(law, moved)
    goes, fails = is_found | at_once, state._replace(at_once=xp.asarray(True))
    if xp is np:
        return moved if goes else fails
    choose = lambda mask, x, y: jax.tree.map(lambda x, y: xp.where(mask, x, y), x, y)  # noqa: E731
    return choose(goes, moved, fails)


def _end_of_work(before: Any, work: Any, power: Any, xp: ModuleType) -> Any:
    """Return the positive root s of before + work s + power s^2, which is negative at s = 0; infinity if it stays negative."""
    grows = (before < 0) & (work >= 0) & (power > 0)
    a, b, c = (xp.where(grows, x, y) for x, y in ((power, 1.0), (work, 1.0), (before, -1.0)))
    return xp.where(grows, -2 * c / (b + xp.sqrt(b * b - 4 * a * c)), xp.inf)


def _rates(law: _ImpactLaw, b: Any, least: Any, slides: Any, closed: Any) -> tuple[Any, Any]:
    """Return the rates x' for which x' and y = W x' + b are complementary, and whether they obey the law of the impact.

    Args:
        law: the contacts.
        b: y for x' = 0.
        least: lower bounds on normal x'.
        slides: directions of sliding; where they are 0, the rows along the line are complementary, too.
        closed: mask of the contacts whose normal rows are complementary; the others have x' = least.
    """
    W, xp, N, F = law.W, law.xp, len(closed), len(slides)
    rests = law.rubs & (slides == 0) & (closed | (least > 0))[law.of_rows]
    known = xp.concatenate([least, -law.friction * slides * least[law.of_rows]])
    owns = np.arange(N) == law.of_rows[:, None]
    columns = xp.concatenate([xp.eye(N), (-law.friction * slides)[:, None] * owns])
    columns = xp.concatenate([columns, *[sign * np.eye(N + F)[:, N:] for sign in (1.0, -1.0)]], axis=1)
    rows = np.vstack([np.eye(N + F)[:N], *[sign * np.eye(N + F)[N:] for sign in (1.0, -1.0)]])

    fixed = W, columns, b, known, least, law.friction, rests, closed
    W0, C, b0, known, least0, mu, at_rest, may_press = fixed if xp is np else stop_gradients(fixed)
    # If a contact that may take part depends on others, all contacts yield a little.
    taking = xp.concatenate([may_press, at_rest])
    _, independent = eliminate(W0, taking, AT_REST.carried * diagonal(W0, xp), xp)
    compliance = COMPLIANCE * xp.any(taking & ~independent)
    W0 = W0 + compliance * np.eye(N + F)
    zero = xp.zeros((F, F))
    bound = xp.concatenate([mu[:, None] * owns, -np.eye(F) + zero, -np.eye(F) + zero, zero], axis=1)
    M = xp.concatenate(
        [xp.concatenate([rows @ W0 @ C, np.vstack([np.zeros((N, F)), np.eye(F), np.eye(F)]) + 0 * C[:1, :1]], axis=1), bound]
    )
    q = xp.concatenate([rows @ (b0 + W0 @ known), mu * least0[law.of_rows]])
    passive, is_solved = general_complementary_set(M, q, xp.concatenate([may_press, at_rest, at_rest, at_rest]), xp)
    presses, forwards, backwards, limited = (passive[k : k + n] for k, n in ((0, N), (N, F), (N + F, F), (N + 2 * F, F)))
    limited = limited & ~(forwards & backwards)  # if both are positive, they are two parts of one force
    sticks = at_rest & ~limited & (forwards | backwards)
    direction = xp.where(at_rest, xp.where(limited, 1.0 * backwards - 1.0 * forwards, 0.0), slides)

    x = _in_modes(law, b, least, xp.concatenate([presses & may_press, sticks]), direction)
    y = W @ x + b
    push, most = xp.max(xp.abs(x)), xp.max(xp.abs(b))
    size, push = AT_REST.still * most + (ROUNDING + 2 * compliance) * push, (AT_REST.still + 2 * compliance) * push
    obeys = [
        is_solved,
        xp.all(xp.where(closed, y[:N] >= -size, True)),
        xp.all(x[:N] >= least - push),
        xp.all(xp.where(sticks, xp.abs(y[N:]) <= size, True)),
        xp.all(xp.where(at_rest, xp.abs(x[N:]) <= law.friction * x[law.of_rows] + push, True)),
    ]
    return x, xp.all(xp.asarray(obeys))


def _in_modes(law: _ImpactLaw, b: Any, least: Any, equal: Any, direction: Any) -> Any:
    """Return x for given modes: W x + b = 0 in the rows `equal`; dependent rows among these share x as the module describes."""
    W, xp, N = law.W, law.xp, len(least)
    R = N + len(direction)
    fixed = W if xp is np else stop_gradients(W)
    _, independent = eliminate(fixed, equal, AT_REST.carried * diagonal(fixed, xp), xp)
    dependent, unit = equal & ~independent, np.eye(R)
    pairs = independent[:, None] & independent
    # A row z . x = 0 for each dependent row: z is one there, and minus the row's combination of the independent ones.
    combination = xp.linalg.solve(xp.where(pairs, W, unit), xp.where(independent[:, None] & dependent, W, 0.0)).T
    floor = xp.concatenate([least, xp.zeros(R - N)])
    slip = xp.concatenate(
        [
            xp.zeros((N, R)),
            xp.where((np.arange(R) == law.of_rows[:, None]) & ~equal[N:, None], (law.friction * direction)[:, None], 0.0),
        ]
    )
    matrix = xp.where(independent[:, None], W, unit - combination + slip)
    right = xp.where(independent, -b, floor - combination @ floor)
    x = solve(matrix, right, xp)
    normal = xp.where(equal[:N], x[:N], least)
    return xp.concatenate([normal, xp.where(equal[N:], x[N:], -law.friction * direction * normal[law.of_rows])])
