"""Closing: the positions of contacts that come to rest, moved to zero without pushing others below it.

Contacts that are hit together are closed up to a tolerance, so the gaps g of those that then rest are nearly zero. A run brings
them to zero by its projection, which knows nothing of the other contacts. It could push a contact that has just been lifted below
zero: too little to matter, but the contact would be hit at once, again and again, while it hardly rises.

So there the positions obey the same complementarity as velocities. With the u_i and W of an impact (`impacts`),

    dq = M^(-1/2) sum_i u_i x_i,        g_i + (W x)_i = 0                             for contacts at rest,
                                        0 <= x_i,  g_i + (W x)_i >= 0, one of them zero,    for the others:

the smallest dq in the metric of M, to first order in gaps of a billionth of the scene. Joints that stick keep their places.
An attached joint may move bodies as well, and is treated alike.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from udkjax.complementarity.linear import diagonal, eliminate, solve_complementarity
from udkjax.integrate.events.instant.impacts import ATTACH_TOL, CARRIED_TOL, ContactRows
from udkjax.integrate.events.instant.runs import RunState
from udkjax.integrate.events.instant.system import System
from udkjax.integrate.events.law.crossings import ZERO_TOL
from udkjax.transforms.gradients import stop_gradients


class Gaps(NamedTuple):
    """The contacts at an event, in the positions before they are closed."""

    rows: ContactRows
    g: Float[Any, "*m E"]  # the values of the conditions
    scale: Float[Any, "*m E"]  # the scales of the conditions
    counts: Bool[Any, "*m E"]  # contacts that must not be pushed below zero


def close_contacts(system: System, gaps: Gaps, after: RunState) -> Float[Any, "*m n"]:
    """Return the positions after an event; they change only where contacts at rest would push others below zero.

    Args:
        system: the system.
        gaps: the gaps of the contacts at the event.
        after: the states after the event.
    """
    plan, xp, (rows, g, scale, counts) = system.plan, system.xp, gaps
    is_joint = np.isin(np.arange(plan.count), plan.forwards)
    rests = plan.held(after.phase, xp) & (plan.impacts | is_joint)
    b, floor = xp.where(plan.impacts, g, 0.0), ZERO_TOL * scale
    counts = counts & ~rests & (xp.abs(b) <= ATTACH_TOL * scale)
    if xp is np and not ((xp.abs(b) > floor) & (rests | (counts & (b < 0)))).any():
        return after.q
    # The derivatives of W are those of a change so small that they do not count; those of gaps close the contacts together.
    W, directions = (rows.W, rows.directions) if xp is np else stop_gradients((rows.W, rows.directions))
    least = CARRIED_TOL * diagonal(W, xp)
    remainder, closes = eliminate(W, rests, least, xp)
    counts = counts & (diagonal(remainder, xp) > least)
    solution = solve_complementarity(W, b, counts, floor, closes, xp)
    is_pushed = xp.any(solution.passive & ~closes, axis=-1)[..., None]
    return after.q + xp.where(is_pushed, (solution.x[..., None, :] @ directions)[..., 0, :], 0.0)
