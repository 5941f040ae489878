"""Impacts and rest of contacts: all that are closed at one instant, together.

A contact g(t, q) >= 0 has the rate g_dot = n v + g_t, n = g_q, and its impulse Lambda >= 0 acts along n^T; those of the joints
act along Psi_q^T, and keep Psi_dot = 0. With

    D = Psi_q M^(-1/2),        u_i = (I - D^+ D) M^(-1/2) n_i^T,        W_ij = u_i . u_j,

where u_i is the part of an impulse that the joints do not take, however redundant they are,

    v+ = v- + M^(-1/2) sum_i u_i Lambda_i,        g_dot+ = g_dot- + W Lambda.

Newton's law of restitution, with complementarity (Moreau 1988; Glocker, Set-Valued Force Laws, 2001, chapter 9):

    0 <= Lambda_i,        g_dot+_i + e_i g_dot-_i >= 0,        one of them zero.

No contact pulls, none is penetrated, one alone has g_dot+ = -e g_dot-, and one that the others lift opens. Those take part that
are closed and do not separate already, g_dot- <= 0: contacts that their impact penetrates hit next. So of a scleronomic
mechanism

    T+ - T- = (g_dot+ + g_dot-) . Lambda / 2 = sum_i (1 - e_i) g_dot-_i Lambda_i / 2 <= 0:

energy never grows, of different restitutions either. (With a contact that separates and is pushed back, Newton's law could.) The
law treats what happens at one instant as one impact: the first of three equal balls in a row, e = 1, bounces off the other two.

Contacts whose g_dot stays zero are in complementarity in accelerations: 0 <= lambda, g_ddot = g_ddot(lambda = 0) + W lambda >= 0,
one of them zero. Those with lambda > 0 are held, as constraints.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.textbook import TextbookEquations
from udkjax.integrate.events.actions import Impact
from udkjax.integrate.events.complementarity import solve_complementarity
from udkjax.integrate.events.crossings import ZERO_RATE, ZERO_RATE_2
from udkjax.integrate.events.hybrid import ConditionValues, Hybrid, RunState
from udkjax.integrate.gradients import stop_gradients

# (u . u) / (n M^(-1) n): the square of the sine between a contact's row and those of the constraints, in the metric of M. At a
# sine of 1e-8, half of the digits, u is what rounding leaves of the difference of two rows, and no impulse follows from it.
BLOCKED = 1e-16
# Of a condition's scale: contacts that are no farther from zero when another one hits are hit with it. It is above the errors of
# a run at ordinary tolerances in what is symmetric, and what is done too early by it lasts 1e-9 T. Of the fastest approach in an
# impact, or of the strongest pull: less of another contact is zero, since the rows of these contacts are known that well.
CLOSED = STILL = 1e-9
# The square of the sine between the row of a contact and those of contacts that are held: below it they hold it, too. A row that
# depends on others in theory has a sine of some CLOSED over the distance of the contacts, here down to a thousandth of L.
CARRIED = (1e3 * CLOSED) ** 2
# Of a condition's scale per T: an impact slower than this, where the contact is pressed on, is rest. Its rebound rises by 1e-10
# of that scale, a hundredth of what ordinary tolerances tell from zero.
REST = 1e-5
# Of |u_i| |u_j|: two contacts whose W_ij is below that do not act on one another; each has an event of its own. It is a cosine,
# of which rounding leaves 1e-15, or more by the condition number of the constraints, up to a thousand.
COUPLED = 1e-12

OPEN, TOUCHES, SLOW = 0, 1, 2  # the states of a contact at an event: not closed, closed, closed and without restitution


class ContactRows(NamedTuple):
    """The rows of all conditions, as far as constraints leave them."""

    W: Float[Array, "E E"]
    directions: Float[Array, "E n"]  # M^(-1/2) u: the velocities that unit impulses give
    free: Bool[Array, "E"]  # whether the constraints leave a condition any motion


class Impulses(NamedTuple):
    """The results of an impact."""

    impulse: Float[Array, "E"]  # in the unit of M v over that of the condition's derivative by q: N s of a gap
    rate: Float[Array, "E"]  # g_dot+
    remaining: Bool[Array, ""]  # whether a contact is still penetrated: the constraints drive it


class ContactChanges(NamedTuple):
    """The contacts at an event, and what becomes of them."""

    v: Float[Array, "n"]  # after it
    closed: Int[Array, "E"]  # OPEN, TOUCHES or SLOW
    hits: Bool[Array, "E"]
    held: Bool[Array, "E"]  # after it
    ends: Bool[Array, "E"]  # events that come to rest, and end the run by that
    carried: Bool[Array, "E"]  # held at zero by others that are held
    blocked: Bool[Array, ""]  # the constraints leave a contact that approaches no motion


def contact_rows(
    equations: TextbookEquations, t: Float[Array, ""], q: Float[Array, "n"], normals: Float[Array, "E n"]
) -> ContactRows:
    """Return W and the directions of impulses along the `normals` dg/dq, with all constraints of the equations kept."""
    mechanism, w = equations.mechanism, equations.weights
    root, D = uk.inverse_sqrt_mass(mechanism), uk.D(mechanism, t, q, w)
    plus, given = uk.pseudoinverse(equations.method, D), root * normals
    u = jax.vmap(lambda u: u - plus @ (D @ u))(given)
    free = jnp.sum(u**2, 1) > BLOCKED * jnp.sum(given**2, 1)
    return ContactRows(u @ u.T, root * u, free)


def impulses_of_impact(
    rows: ContactRows,
    rate: Float[Array, "E"],
    restitution: Float[Array, "E"],
    closed: Bool[Array, "E"],
    floor: Float[Array, "E"],
) -> Impulses:
    """Return the impulses of an impact by Newton's law with complementarity.

    Args:
        rows: of all conditions.
        rate: g_dot before it.
        restitution: e of each contact, from 0 to 1.
        closed: mask of the contacts that take part; they do not separate.
        floor: a rate above minus that is not negative.
    """
    found = solve_complementarity(rows.W, (1 + restitution) * rate, closed & rows.free, floor)
    after = rate + rows.W @ found.x
    limit = floor + STILL * jnp.max(jnp.where(closed, jnp.abs(rate), 0.0))
    return Impulses(found.x, after, jnp.any(closed & (after < -limit)))


def contact_states(
    hybrid: Hybrid, k: Int[Array, ""], held: Bool[Array, "E"], values: ConditionValues, W: Float[Array, "E E"]
) -> Int[Array, "E"]:
    """Return the state of each contact in event k: OPEN where it takes no part, TOUCHES, or SLOW where it is too slow to rebound.

    Those take part that are closed, do not separate and, where the event is of a contact, act on it, or on one that does. A
    contact is slow whose g_dot is small while it is pressed on.
    """
    E = hybrid.count
    h, rate, rate_2, scale = (x[:E] for x in (values.h, values.rate, values.rate_2, values.scale))
    unit, impacts, own = scale * hybrid.rate, jnp.array(hybrid.impacts), jnp.arange(E) == k % E
    closed = impacts & (held | ((jnp.abs(h) <= CLOSED * scale) & (rate <= ZERO_RATE * unit)) | own)
    size = jnp.sqrt(jnp.diagonal(W))
    acts = (jnp.abs(W) > COUPLED * size * size[:, None]) & closed & closed[:, None]
    joined = own | ((k < E) & ~impacts[k % E])
    for _ in range(int(np.sum(hybrid.impacts)) - 1):
        joined = joined | jnp.any(acts & joined, axis=1)
    closed = closed & joined
    slow = jnp.abs(rate) < REST * unit
    pressed = rate_2 < -ZERO_RATE_2 * unit * hybrid.rate
    return jnp.where(closed, jnp.where(slow & pressed & ~held, SLOW, TOUCHES), OPEN)


def hit_contacts(
    hybrid: Hybrid,
    k: Int[Array, ""],
    state: RunState,
    held: Bool[Array, "E"],
    values: ConditionValues,
    closed: Int[Array, "E"] | None,
) -> ContactChanges:
    """Apply an impact to all contacts that are closed, and find those that then rest.

    Args:
        hybrid: the system.
        k: the number of the event; from `hybrid.count` on, of the contact that lets go.
        state: the state before, in the phase that is to follow but for contacts.
        held: mask of the contacts that were held before.
        values: the conditions before the event; their scales are used.
        closed: the contacts, as in `ContactChanges`; None where they are to be found.
    """
    E = hybrid.count
    t, q, v, phase, added = state
    free_phase = hybrid.without_contacts(phase)
    scale = stop_gradients(values.scale[:E])
    floor = ZERO_RATE * scale * hybrid.rate
    rate, normals = hybrid.conditions_and_rates(t, q, v)[1], jax.jacfwd(hybrid.conditions, 1)(t, q, v)
    of_phase = lambda p, t, q, normals, added: contact_rows(hybrid.textbook(p, added), t, q, normals)  # noqa: E731
    rows = hybrid.in_phase(free_phase, of_phase, t, q, normals, added, among=hybrid.contact_free_phases)
    closed = contact_states(hybrid, k, held, values, rows.W) if closed is None else closed
    restitution = jnp.where(closed == SLOW, 0.0, _restitutions(hybrid))
    found = impulses_of_impact(rows, rate, restitution, closed > OPEN, floor)
    v = v + found.impulse @ rows.directions

    # Without derivatives from here on: which contacts are held is a choice.
    rows, rate, after = stop_gradients((rows, rate, RunState(t, q, v, free_phase, added)))
    fastest = jnp.max(jnp.where(closed > OPEN, jnp.abs(rate), 0.0))
    stays = (closed > OPEN) & rows.free & (found.rate <= jnp.maximum(floor, STILL * fastest))
    stays = stays & (jnp.arange(E) + E != k)
    pull = hybrid.second_rates(t, q, after.v, hybrid.accelerations(after, among=hybrid.contact_free_phases))
    pressed = ZERO_RATE_2 * scale * hybrid.rate**2
    rest = solve_complementarity(rows.W, pull, stays, pressed)
    presses = rest.passive & (rest.x > 0)
    is_held = jnp.where(closed > OPEN, presses & hybrid.rests("hold"), held)
    resting = stays & ~is_held & (jnp.abs(rest.y) <= jnp.maximum(pressed, STILL * jnp.max(jnp.where(stays, jnp.abs(pull), 0.0))))
    hits = (closed == TOUCHES) & ~held & (rate < -floor)
    ends = presses & hybrid.rests("stop")
    return ContactChanges(v, closed, hits, is_held, ends, resting & _depends(rows.W, is_held), found.remaining)


def _depends(W: Float[Array, "E E"], on: Bool[Array, "E"]) -> Bool[Array, "E"]:
    """Return a mask of the rows that depend on some of the others, which do not depend on one another."""
    both = on & on[:, None]
    parts = jnp.where(on[:, None], W, 0.0)
    rest = jnp.diagonal(W) - jnp.sum(parts * jnp.linalg.solve(jnp.where(both, W, jnp.eye(len(W))), parts), 0)
    return ~on & (rest <= CARRIED * jnp.diagonal(W))


def _restitutions(hybrid: Hybrid) -> Float[Array, "E"]:
    return jnp.stack([e.action.restitution if isinstance(e.action, Impact) else jnp.zeros(()) for e in hybrid.events])
