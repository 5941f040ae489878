"""Hops too small to follow: a contact comes to rest at the top of such a hop, where this needs no impulse.

Where a contact lands, contacts at rest may be lifted by its impulse, however slow it is. They hop, land, and lift it in turn:
their speeds fall geometrically, without end. To stop all of them at a landing, one of them would have to pull.

At the top of a hop the contact does not move. If the top is as close to zero as contacts that are hit together, the contact is
closed there, and can be held with the others without any impulse. So an event at which such a hop ends is moved to its top, a
moment earlier in the same smooth motion.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool

from udkjax.integrate.events.instant.impacts import CLOSED_TOL, REST_SPEED
from udkjax.integrate.events.instant.runs import RECORD_FIELDS, MemberIndices, MemberRuns, take
from udkjax.integrate.events.instant.system import System, condition_values
from udkjax.integrate.events.law.crossings import ZERO_RATE_2_TOL, ZERO_TOL

TIME_FIELD = RECORD_FIELDS.index("event_time")
# Longest time (T) from the top of a hop to its end. The state at the top follows by a step of third order, with an error of
# ZERO_TOL.
LONGEST_FALL = ZERO_TOL ** (1 / 3)


def ends_hop(system: System, runs: MemberRuns) -> Bool[Any, "B"]:
    """Return a mask of the members in which a contact lands, perhaps from a hop, while other contacts are held."""
    plan, xp, is_event = system.plan, system.xp, (runs.event >= 0) & (runs.event < system.plan.count)
    lands = is_event & xp.asarray(plan.impacts)[runs.event % plan.count]
    return runs.running & lands & (runs.count > 0) & xp.any(plan.held(runs.phase, xp), axis=-1)


def return_to_top(system: System, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
    """Return the runs with members back at the top of the hop that ends at their event, if it is too small to follow."""
    xp, system_rate, landing = system.xp, take(system.rate, members), runs.state(members)
    (t, q, v), row, event = landing[:3], np.arange(len(landing.t)), take(runs.event, members)
    last = runs.record[TIME_FIELD][row if members is None else members, take(runs.count, members) - 1]

    values, _ = condition_values(system, members, landing)
    scale = xp.maximum(values.scale, take(runs.scale, members))[row, event]
    rate, rate_2, unit = values.rate[row, event], values.rate_2[row, event], scale * system_rate
    falls = (rate < 0) & (rate > -REST_SPEED * unit) & (rate_2 < -ZERO_RATE_2_TOL * unit * system_rate)
    since = xp.where(falls, rate / xp.where(falls, rate_2, -1.0), 0.0)  # the time from the top to the landing
    is_small = falls & (since * system_rate <= LONGEST_FALL) & (-rate * since <= 2 * CLOSED_TOL * scale)
    h, a = xp.where(is_small, since, 0.0)[:, None], values.a
    start = landing._replace(t=t - h[:, 0], q=q - h * v + h**2 / 2 * a, v=v - h * a)
    at_start = system.look(members, start)
    q, v = q - h * v + h**2 / 6 * (2 * a + at_start.a), v - h / 2 * (a + at_start.a)

    # The acceleration changes during the hop, so the contact still moves: it stops after one more step, as small as this change.
    by_q, rate_2 = at_start.by_q[row, event], at_start.rate_2[row, event]
    rate = at_start.rate[row, event] + xp.sum(by_q * (v - start.v), axis=-1)
    h = xp.where(is_small, rate / xp.where(rate_2 < 0, rate_2, -1.0), 0.0)[:, None]
    t, q, v = start.t - h[:, 0], q - h * v, v - h * at_start.a
    # The motion is smooth, and the contact has risen since the last event: at the top itself there is no further event.
    returns = is_small & (rate_2 < 0) & (xp.abs(h[:, 0]) <= LONGEST_FALL * since) & (t - last > since / 2)
    before = runs.state(members)
    return runs.put(
        members,
        t=xp.where(returns, t, before.t),
        q=xp.where(returns[:, None], q, before.q),
        v=xp.where(returns[:, None], v, before.v),
    )
