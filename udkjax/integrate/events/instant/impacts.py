"""Impacts and rest of contacts: all contacts that are closed at one instant, together.

A contact g(t, q) >= 0 has the rate g_dot = n v + g_t, n = g_q, and its impulse Lambda >= 0 acts along n^T; those of the joints
act along Psi_q^T, and keep Psi_dot = 0. With

    D = Psi_q M^(-1/2),        u_i = (I - D^+ D) M^(-1/2) n_i^T,        W_ij = u_i . u_j,

where u_i is the part of an impulse that the joints, redundant or not, do not absorb,

    v+ = v- + M^(-1/2) sum_i u_i Lambda_i,        g_dot+ = g_dot- + W Lambda.

Newton's law of restitution, with complementarity (Moreau 1988; Glocker, Set-Valued Force Laws, 2001, chapter 9):

    0 <= Lambda_i,        g_dot+_i + e_i g_dot-_i >= 0,        one of them zero.

No contact pulls or is penetrated, a single one has g_dot+ = -e g_dot-, and contacts lifted by others open. The contacts that take
part are closed and do not separate, g_dot- <= 0; others that the impact penetrates are hit next. For a scleronomic mechanism

    T+ - T- = (g_dot+ + g_dot-) . Lambda / 2 = sum_i (1 - e_i) g_dot-_i Lambda_i / 2 <= 0:

energy never grows, even with different restitutions. (It could grow if a separating contact were pushed back.) The law treats
all contacts of one instant as one impact: the first of three equal balls in a row, e = 1, bounces off the other two.

If one of the contacts has friction, the rows of its sliding along its line, s_dot, are among the n, with impulses

    |Lambda_s| <= mu Lambda_i,        s_dot+ = 0 within this limit, else opposite to Lambda_s,

and the law is Poisson's, followed from one small impulse to the next (`rubbing_impact`): friction opposes the sliding at each
moment of the impact, not only at its end.

Contacts whose g_dot stays zero are in complementarity in accelerations: 0 <= lambda, g_ddot = g_ddot(lambda = 0) + W lambda >= 0,
one of them zero. Those with lambda > 0 are held, as constraints. If one of them is too slow to rebound, the impact is repeated
with e = 0 for all of them. Contacts that this impact lifts hop, however slowly: no contact is held by a pull (`hops`).

Arrays are JAX's, for one state, or NumPy's, for several states (*m).
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.complementarity.linear import (
    diagonal,
    eliminate,
    solve_complementarity,
    times,
)
from udkjax.complementarity.rubbing_impacts import RubbingContacts, rubbing_impact
from udkjax.complementarity.stick_or_slip import AT_REST
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.states.textbook import TextbookEquations
from udkjax.integrate.events.law.crossings import ZERO_RATE_2_TOL, ZERO_RATE_TOL, ConditionValues
from udkjax.transforms.gradients import stop_gradients

BLOCKED_TOL, CLOSED_TOL, STILL_TOL, CARRIED_TOL = AT_REST.blocked, AT_REST.closed, AT_REST.still, AT_REST.carried
BLOCKED_IN_SYSTEM_TOL = 1e-13  # as BLOCKED_TOL, where u . u is a difference of products, with their rounding errors
# Speed before or after an impact, relative to a condition's scale per T: a pressed contact that is slower is at rest. Its rebound
# would rise by 1e-10 of that scale, a hundredth of the accuracy at usual tolerances.
REST_SPEED = 1e-5
# Bound on W_ij, relative to |u_i| |u_j|: below it, contacts i and j do not act on one another, and each has its own event. This
# ratio is a cosine, with rounding errors of 1e-15 times the condition number of the constraints, up to a thousand.
COUPLING_TOL = 1e-12

# Largest gap of an attached joint, relative to L, or in rad; and largest change of velocities, relative to the fastest, by which
# they violate the other constraints.
ATTACH_TOL = 1e-6

# The states of a contact at an event: not in contact, in contact and with restitution, in contact and without.
OPEN, REBOUNDS, SLOW = 0, 1, 2


class Contacts(NamedTuple):
    """The properties of the contacts among E events that do not depend on the state."""

    impacts: Bool[np.ndarray, "E"]  # events that are contacts
    hold: Bool[np.ndarray, "E"]  # contacts that are held at rest
    stop: Bool[np.ndarray, "E"]  # contacts that end the run at rest
    tangents: Int[np.ndarray, "E"]  # the row of the speed along the line of each contact with friction; -1: it has none
    restitution: Float[Any, "*m E"]  # coefficients of restitution
    friction: Float[Any, "*m E"]  # coefficients of friction
    rate: Float[Any, "*m"]  # characteristic rate of the system and the run (1/s)


class ContactRows(NamedTuple):
    """Rows of E conditions, projected by the constraints: their mobilities W, and the velocities that unit impulses give."""

    W: Float[Any, "*m E E"]
    directions: Float[Any, "*m E n"]  # M^(-1/2) u: the velocities that unit impulses give
    free: Bool[Any, "*m E"]  # whether the constraints let a condition change


class Impulses(NamedTuple):
    """Results of an impact: the impulses, the rates of the conditions after it, and whether contacts still penetrate."""

    impulse: Float[Any, "*m E"]  # in the unit of M v over that of the condition's derivative with respect to q: N s of a gap
    rate: Float[Any, "*m E"]  # g_dot+
    remaining: Bool[Any, "*m"]  # whether constraints still drive a contact to penetrate


class KnownContacts(NamedTuple):
    """States of the contacts at an event, as the run found them; its derivatives reuse them."""

    contact_state: Int[Any, "*m E"]  # OPEN, REBOUNDS or SLOW
    held: Bool[Any, "*m E"]  # whether each contact is held after the event


class ContactChanges(NamedTuple):
    """The contacts at an event, and their states after it."""

    v: Float[Any, "*m n"]  # velocities after the event
    contact_state: Int[Any, "*m E"]  # OPEN, REBOUNDS or SLOW, with those whose rebound was left out
    hits: Bool[Any, "*m E"]  # contacts that hit at the event
    held: Bool[Any, "*m E"]  # contacts that are held after the event
    rests: Bool[Any, "*m E"]  # contacts that do not separate after the event, held or not
    ends: Bool[Any, "*m E"]  # contacts whose rest ends the run
    carried: Bool[Any, "*m E"]  # contacts kept at zero by other held contacts
    blocked: Bool[Any, "*m"]  # whether constraints block an approaching contact


def contact_rows(
    equations: TextbookEquations, t: Float[Array, ""], q: Float[Array, "n"], normals: Float[Array, "E n"]
) -> ContactRows:
    """Return W and the directions of impulses along the `normals` dg/dq, with all constraints of the equations satisfied."""
    mechanism, w = equations.mechanism, equations.weights
    root, D = uk.inverse_sqrt_mass(mechanism), uk.D(mechanism, t, q, w)
    plus, given = uk.pseudoinverse(equations.method, D), root * normals
    u = jax.vmap(lambda u: u - plus @ (D @ u))(given)
    return rows_of_directions(normals, root * u, root**2)


def rows_of_directions(
    normals: Float[Any, "*m E n"], directions: Float[Any, "*m E n"], inverse_mass: Float[Any, "*m n"]
) -> ContactRows:
    """Return the rows of contacts where M is diagonal, from the directions of impulses, M^(-1/2) u, and 1 / M."""
    mobility = inverse_mass[..., None, :]
    W, given = directions / mobility @ directions.swapaxes(-1, -2), (normals**2 * mobility).sum(-1)
    return ContactRows(W, directions, (directions**2 / mobility).sum(-1) > BLOCKED_TOL * given)


def rows_of_mobilities(
    normals: Float[Any, "*m E n"], directions: Float[Any, "*m E n"], mobilities: Float[Any, "*m E n"]
) -> ContactRows:
    """Return the rows of contacts where M need not be diagonal, from M^(-1) n^T and P M^(-1) n^T: W = n P M^(-1) n^T."""
    W = normals @ directions.swapaxes(-1, -2)
    size, given = (normals * directions).sum(-1), (normals * mobilities).sum(-1)
    return ContactRows((W + W.swapaxes(-1, -2)) / 2, directions, size > BLOCKED_IN_SYSTEM_TOL * given)


def impulses_of_impact(
    rows: ContactRows,
    rate: Float[Any, "*m E"],
    restitution: Float[Any, "*m E"],
    closed: Bool[Any, "*m E"],
    floor: Float[Any, "*m E"],
    xp: ModuleType = jnp,
) -> Impulses:
    """Return the impulses of an impact by Newton's law with complementarity.

    Args:
        rows: the rows of all conditions.
        rate: g_dot before the impact.
        restitution: e of each contact, from 0 to 1.
        closed: mask of the contacts that take part; they do not separate.
        floor: tolerance on rates >= 0.
        xp: jax.numpy, or NumPy.
    """
    solution = solve_complementarity(rows.W, (1 + restitution) * rate, closed & rows.free, floor, xp)
    after = rate + times(rows.W, solution.x)
    limit = floor + STILL_TOL * _largest(rate, closed, xp)
    return Impulses(solution.x, after, xp.any(closed & (after < -limit), -1))


def impulses_with_friction(
    contacts: Contacts,
    rows: ContactRows,
    rate: Float[Any, "*m E"],
    restitution: Float[Any, "*m E"],
    closed: Bool[Any, "*m E"],
    floor: Float[Any, "*m E"],
    xp: ModuleType = jnp,
) -> Impulses:
    """Return the impulses of an impact with friction by Poisson's law of restitution (`rubbing_impact`).

    The arguments after `contacts` are those of `impulses_of_impact`.
    """
    normals = np.flatnonzero(contacts.impacts)
    rubbing = np.flatnonzero(contacts.tangents[normals] >= 0)  # among the normals
    along = contacts.tangents[normals[rubbing]]
    columns, E = np.concatenate([normals, along]), rows.W.shape[-1]
    free = rows.free[..., columns]
    size = xp.sqrt(xp.where(free, diagonal(rows.W, xp)[..., columns], 1.0))
    W = rows.W[..., columns, :][..., :, columns] / size[..., None, :] / size[..., :, None]
    W = xp.where(free[..., None, :] & free[..., :, None], W, 0.0)
    sizes = size[..., : len(normals)][..., rubbing], size[..., len(normals) :]
    coefficient = contacts.friction[..., normals[rubbing]] * sizes[1] / sizes[0]
    takes_part = (closed & rows.free)[..., normals]
    # Speeds that are zero but for rounding errors are no impact: their ratios are those of no motion, which may have no solution.
    approaches = xp.any(closed & rows.free & (rate < -floor), axis=-1, keepdims=True)
    speeds = xp.where(approaches, rate[..., columns] / size, 0.0)
    given = RubbingContacts(W, speeds, restitution[..., normals], coefficient, takes_part)
    impulse = (rubbing_impact(given, rubbing, xp) / size) @ np.eye(E)[columns]
    after = rate + times(rows.W, impulse)
    limit = floor + STILL_TOL * _largest(rate, closed, xp)
    return Impulses(impulse, after, xp.any(closed & ~(after >= -limit), -1))  # NaN: there is no solution


def _largest(x: Any, mask: Any, xp: ModuleType) -> Any:
    return xp.max(xp.where(mask, xp.abs(x), 0.0), axis=-1, keepdims=True)


def contact_states(
    contacts: Contacts,
    k: Int[Any, "*m"],
    held: Bool[Any, "*m E"],
    before: ConditionValues,
    W: Float[Any, "*m E E"],
    xp: ModuleType,
) -> Int[Any, "*m E"]:
    """Return the state of each contact in event k: OPEN if it takes no part, SLOW if it does without rebound, else REBOUNDS.

    If the event is of a contact (contact k hits, or contact k - E opens), this contact takes part, and so do the closed contacts
    that do not separate and that are joined to it: impulses on one change the speed of the other, directly or through others. In
    an event of another kind all closed contacts that do not separate take part. A contact is SLOW if its g_dot is small while it
    is pressed, and if it was not held.
    """
    h, rate, rate_2, _, scale = before
    E, system = h.shape[-1], contacts.rate[..., None]
    unit, impacts, is_own = scale * system, contacts.impacts, np.arange(E) == (k % E)[..., None]
    closed = impacts & (held | ((xp.abs(h) <= CLOSED_TOL * scale) & (rate <= ZERO_RATE_TOL * unit)) | is_own)
    size = xp.sqrt(diagonal(W, xp))
    acts = xp.abs(W) > COUPLING_TOL * size[..., None, :] * size[..., :, None]
    # A contact with friction acts by the row of its sliding, too, though its normal impulse may leave the other contact alone.
    sliding = np.where(contacts.tangents >= 0, contacts.tangents, np.arange(E))
    acts = acts | acts[..., sliding, :]
    acts = (acts | acts[..., sliding]) & closed[..., None, :] & closed[..., :, None]
    joined = is_own | ((k < E) & ~xp.asarray(impacts)[k % E])[..., None]
    for _ in range(int(np.sum(impacts)) - 1):
        joined = joined | xp.any(acts & joined[..., None, :], axis=-1)
    closed = closed & joined
    slow = xp.abs(rate) < REST_SPEED * unit
    pressed = rate_2 < -ZERO_RATE_2_TOL * unit * system
    return xp.where(closed, xp.where(slow & pressed & ~held, SLOW, REBOUNDS), OPEN)


def hit_contacts(
    contacts: Contacts,
    k: Int[Any, "*m"],
    v: Float[Any, "*m n"],
    held: Bool[Any, "*m E"],
    before: ConditionValues,
    rows: ContactRows,
    rate: Float[Any, "*m E"],
    second_rates: Callable[[Any], Any],
    known: KnownContacts | None,
    xp: ModuleType = jnp,
) -> ContactChanges:
    """Return the velocities after an impact of all closed contacts, and the contacts that then rest.

    Args:
        contacts: the properties of the contacts that do not depend on the state.
        k: the index of the event; E + i if contact i opens.
        v: the velocities that the next phase without its contacts allows.
        held: mask of the contacts that were held before.
        before: the conditions before the event.
        rows: the rows of the conditions in that phase.
        rate: the first rates of all conditions at v; of sliding along a line, the speeds.
        second_rates: maps velocities to the second rates of all conditions in that phase.
        known: the states of the contacts, as a run has determined them; None: they are determined here.
        xp: jax.numpy, or NumPy.
    """
    stop: Callable[[Any], Any] = (lambda x: x) if xp is np else stop_gradients
    scale, system = stop(before.scale), contacts.rate[..., None]
    floor = ZERO_RATE_TOL * scale * system
    contact_state = contact_states(contacts, k, held, before, rows.W, xp) if known is None else known.contact_state
    restitution = xp.where(contact_state == SLOW, 0.0, contacts.restitution)
    touches = contact_state > OPEN
    rubs = touches & (contacts.tangents >= 0)

    def impulses(restitution: Any) -> Impulses:
        found = impulses_of_impact(rows, rate, restitution, touches, floor, xp)
        if np.any(contacts.tangents >= 0) and (xp is not np or rubs.any()):
            rubbing = impulses_with_friction(contacts, rows, rate, restitution, touches, floor, xp)
            found = Impulses(*(_where_any(rubs, x, y, xp) for x, y in zip(rubbing, found, strict=True)))
        return found

    def velocities(impact: Impulses) -> Any:
        return v + (impact.impulse[..., None, :] @ rows.directions)[..., 0, :]

    if known is not None:
        impact, no = impulses(restitution), xp.zeros_like(touches)
        is_held = xp.where(contacts.impacts, known.held, held)  # locks of joints begin later, at the places of the joints then
        return ContactChanges(velocities(impact), contact_state, no, is_held, is_held, no, no, impact.remaining)
    # The set of held contacts is discrete, and has no derivatives.
    W, undifferentiated_rate, pressed = stop(rows.W), stop(rate), ZERO_RATE_2_TOL * scale * system**2
    may_stay = (touches) & rows.free & (np.arange(rate.shape[-1]) + rate.shape[-1] != k[..., None])
    still = xp.maximum(floor, STILL_TOL * _largest(undifferentiated_rate, touches, xp))
    slow = xp.maximum(still, REST_SPEED * scale * system)
    impact = impulses(restitution)
    stays, is_held = may_stay & (stop(impact.rate) <= slow), xp.where(touches, False, held)
    ends, carried = xp.zeros_like(stays), xp.zeros_like(stays)
    hits = (contact_state == REBOUNDS) & ~held & (undifferentiated_rate < -floor)
    if xp is not np or stays.any():
        pull = second_rates(stop(velocities(impact)))
        weak = xp.maximum(pressed, STILL_TOL * _largest(pull, stays, xp))

        def pressed_and_idle(stays: Any) -> tuple[Any, Any]:
            """Return masks of the contacts that are pressed, and of all that do not open."""
            solution = solve_complementarity(W, pull, stays, pressed, xp)
            return solution.passive & (solution.x > 0), xp.abs(solution.y) <= weak

        # A pressed contact that rebounds more slowly than `slow` comes to rest: the impact is computed again without the
        # rebounds of this contact and of contacts that depend on it. If other contacts then lift it, it is not held.
        presses, idle = pressed_and_idle(stays)
        rises = xp.any(presses & (stop(impact.rate) > still), axis=-1, keepdims=True)
        if xp is not np or rises.any():
            rests = presses | (stays & idle & _depends(W, presses, contacts.impacts, xp))
            contact_state = xp.where(rests & rises, SLOW, contact_state)  # recorded: derivatives follow this impact
            again = impulses(xp.where(rests & rises, 0.0, restitution))
            impact = Impulses(*(_where_any(rises, x, y, xp) for x, y in zip(again, impact, strict=True)))
        stays = may_stay & (stop(impact.rate) <= still)
        presses, idle = pressed_and_idle(stays)
        is_held = xp.where(touches, presses & contacts.hold, held)
        is_slow = may_stay & (stop(impact.rate) <= slow)
        carried = is_slow & ~is_held & idle & _depends(W, is_held, contacts.impacts, xp)
        ends, stays = presses & contacts.stop, stays | carried
    v = velocities(impact)
    return ContactChanges(v, contact_state, hits, is_held, stays, ends, carried, impact.remaining)


def _where_any(mask: Bool[Any, "*m E"], x: Any, y: Any, xp: ModuleType) -> Any:
    """Return the values x for members with any masked event, and y for all others."""
    chosen = xp.any(mask, axis=-1)
    return xp.where(chosen.reshape(*chosen.shape, *[1] * (x.ndim - chosen.ndim)), x, y)


def _depends(
    W: Float[Any, "*m E E"], held: Bool[Any, "*m E"], impacts: Bool[np.ndarray, "E"], xp: ModuleType
) -> Bool[Any, "*m E"]:
    """Return a mask of the contacts that are not held, but whose rows depend on those of the held ones."""
    among = np.flatnonzero(impacts)
    W, basis, places = W[..., among, :][..., among], held[..., among], np.eye(len(impacts), dtype=bool)[among]
    least = CARRIED_TOL * diagonal(W, xp)
    remainder, _ = eliminate(W, basis, least, xp)
    return xp.any((~basis & (diagonal(remainder, xp) <= least))[..., None] & places, axis=-2)
