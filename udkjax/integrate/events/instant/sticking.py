"""Decisions of runs about joints with set-valued friction: whether they stick, or in which direction they slide.

The law and its solution are in `complementarity.stick_or_slip`. A run adds what it knows: which joint has stopped or reached its
limit, which joints stuck before, and which contacts do not separate.

Arrays are JAX's, for one member, or NumPy's, for several (*m).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from udkjax.complementarity.stick_or_slip import AT_REST, ContactsAtRest, FrictionModes, JointsAtRest, Response
from udkjax.integrate.events.instant.runs import MemberIndices, MemberRuns, RunState, take
from udkjax.integrate.events.instant.system import System, condition_values
from udkjax.integrate.events.law.crossings import ZERO_RATE_2_TOL
from udkjax.integrate.solution import Result
from udkjax.transforms.gradients import stop_gradients


def modes_of(system: System, members: MemberIndices, at: RunState) -> FrictionModes:
    """Return the modes of the joints and contacts of members at states."""
    plan, sides = system.plan, system.sides(members, at.joints)
    direction, rest = (sides[..., plan.directions_of_sliding + k] for k in range(2))
    held = plan.held(at.phase, system.xp) & plan.impacts
    return FrictionModes(plan.locked(at.phase), direction, rest > 0.5, rest > 1.5, held)


def with_modes(system: System, members: MemberIndices, at: RunState, modes: FrictionModes) -> RunState:
    """Return the states with other modes; NumPy arrays of sides change in place."""
    plan, xp = system.plan, system.xp
    sides = system.sides(members, at.joints)
    values = modes.sides(xp)
    sides = xp.concatenate([values.reshape(*values.shape[:-2], -1), sides[..., plan.first_kink_side :]], axis=-1)
    phase = at.phase
    if plan.has_rubbing_contacts:
        phase = plan.with_contacts(plan.without_contacts(phase), modes.held, xp)
    return at._replace(phase=plan.with_locks(phase, modes.locked, xp), joints=system.with_sides(members, at.joints, sides))


def settle_friction(
    system: System,
    members: MemberIndices,
    at: RunState,
    stopped: Int[Any, "*m"],
    given: FrictionModes | None = None,
    resting: Bool[Any, "*m E"] | None = None,
) -> tuple[RunState, Int[Any, "*m"]]:
    """Decide which joints stick, and in which direction the others slide; return the states with these modes.

    Args:
        system: the system.
        members: the indices of the members; None: all.
        at: their states, whose phases and sides have the modes of the joints before.
        stopped: the event of each member: of a joint that has stopped, or, plus E, of one that reaches its limit; -1: another.
        given: the modes, if a run has decided already.
        resting: contacts that do not separate, which may be held or not; None: those that are held.

    Returns:
        The states, with velocities that the locked joints allow; the `Result` of the members, not successful where no modes obey
        the law.
    """
    xp = system.xp
    before, code = modes_of(system, members, at), xp.full(at.t.shape, int(Result.successful))
    if given is None:
        found, code, rest = _decide(system, members, at if xp is np else stop_gradients(at), before, stopped, resting)
    else:
        found, rest = given, None
    new = found.locked & ~before.locked
    after = with_modes(system, members, _with_locks(system, members, at, new), found)
    if xp is np and not new.any():
        return after, code
    v = _known_velocities(found, rest, new) if xp is np else None
    v = system.project(members, after)[1] if v is None else v
    return after._replace(v=xp.where(xp.any(new, axis=-1)[..., None], v, after.v)), code


def _with_locks(system: System, members: MemberIndices, at: RunState, new: Bool[Any, "*m F"]) -> RunState:
    """Return the states with the locks of the masked joints added at the present positions."""
    others = len(system.plan.added_by) - len(system.plan.sticking)
    new = system.xp.concatenate([system.xp.zeros((len(at.t), others), bool), new], axis=-1)
    return at._replace(joints=system.add_joints(members, new, at.q, at.joints))


def begin_with_friction(system: System, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
    """Return the runs at their start, with the modes of the joints of members decided."""
    state, found = settle_friction(system, members, runs.state(members), take(runs.event, members) * 0 - 1)
    settles = found == Result.successful
    code = system.xp.where(settles, take(runs.code, members), found)
    return runs.put(members, v=state.v, phase=state.phase, code=code, running=settles)._replace(joints=state.joints)


class Rest(NamedTuple):
    """Modes in which locks keep all slow joints at rest, and the velocities that these locks allow."""

    modes: FrictionModes
    v: Any


def _with_rest(system: System, members: MemberIndices, at: RunState, modes: FrictionModes) -> Rest:
    """Return the modes with velocities at which locked joints are at rest.

    Otherwise a stiff damper would turn the error of a speed that should be zero into a force.
    """
    xp = system.xp
    if xp is np and not modes.locked.any():
        return Rest(modes, at.v)
    _, v, _ = system.project(members, with_modes(system, members, at, modes))
    return Rest(modes, xp.where(xp.any(modes.locked, axis=-1)[..., None], v, at.v))


def _known_velocities(found: FrictionModes, rest: Rest | None, new: Bool[Any, "m F"]) -> Any:
    """Return the velocities that the locks in `found` allow, if they are those of `rest`; None if they are not known yet."""
    if rest is None:
        return None
    same = (found.locked == rest.modes.locked).all(1) & (found.held == rest.modes.held).all(1)
    return rest.v if same[new.any(1)].all() else None


def _decide(
    system: System,
    members: MemberIndices,
    at: RunState,
    before: FrictionModes,
    stopped: Int[Any, "*m"],
    resting: Bool[Any, "*m E"] | None,
) -> tuple[FrictionModes, Int[Any, "*m"], Rest]:
    plan, xp = system.plan, system.xp
    may_change = before.held if resting is None else (resting & plan.held_at_rest) | before.held
    may_change = may_change & plan.has_rubbing_contacts
    E, forwards = plan.count, plan.forwards
    free = with_modes(system, members, at, before._replace(locked=before.locked & False))
    values, state_values = condition_values(system, members, free, is_directed=True)
    rate = take(system.rate, members)[..., None]
    scale, speed = values.scale[..., forwards], values.h[..., forwards]
    is_stopped, leaves = ([stopped[..., None] == start + forwards + k for k in (0, 1)] for start in (0, E))
    rest = is_stopped[0] | is_stopped[1] | (xp.abs(speed) <= AT_REST.closed * scale)
    unit, most = ZERO_RATE_2_TOL * values.scale * rate**2, int(plan.impacts.sum()) if plan.has_rubbing_contacts else 0
    contacts = ContactsAtRest(plan.contacts_that_rub, before.held, may_change, unit, most)
    if xp is np and not rest.any() and not may_change.any():
        modes = FrictionModes(rest, xp.sign(speed) * contacts.active(before.held), rest, rest, before.held)
        return modes, xp.full(at.t.shape, int(Result.successful)), Rest(modes, at.v)
    normals, directions = (x[..., forwards, :] for x in (state_values.by_v, state_values.directions))
    inverse_mass = take(system.inverse_mass, members)[..., None, :]
    mobility, W = (normals**2 * inverse_mass).sum(-1), directions / inverse_mass @ directions.swapaxes(-1, -2)
    # Drivers that have just begun to move a joint take it along slowly: it does not wait for them again at another's event.
    is_determined = xp.diagonal(W, axis1=-2, axis2=-1) <= AT_REST.blocked * mobility
    goes_on = (before.direction * speed > 0) & ~before.at_rest & ~before.locked & is_determined
    rest = rest & (~goes_on | is_stopped[0] | is_stopped[1])
    at = _with_locks(system, members, at, rest & ~before.locked)
    rested = before.locked | before.at_rest
    joints = JointsAtRest.of(rest, xp.sign(speed), W, mobility, before.locked, rested, scale * rate, xp, contacts)
    locked = joints.independent(rest & contacts.active(before.held), xp)
    at_rest = _with_rest(system, members, at, before._replace(locked=locked))
    at = at._replace(v=at_rest.v)

    def respond(modes: FrictionModes) -> Response:
        found = system.look(members, with_modes(system, members, at, modes), has_forces=True)
        ahead, back = (found.forces[..., forwards + k] for k in (0, 1))
        return Response(found.rate[..., forwards], ahead, back, found.forces, found.rate_2)

    left = xp.where(leaves[0], 1.0, xp.where(leaves[1], -1.0, 0.0))
    kept = xp.where(before.at_rest & rest, before.direction, 0.0)
    started = before.driven & (is_stopped[0] | is_stopped[1])  # its speed, in one of both directions, has become negative
    direction = xp.where(left != 0, left, xp.where(started, xp.where(is_stopped[0], -1.0, 1.0), kept))
    modes, failed, by_contacts = joints.decide(respond, direction, started, (left != 0) | started, xp)
    code = xp.where(by_contacts, int(Result.painleve_paradox), int(Result.event_impossible))
    return modes, xp.where(failed, code, int(Result.successful)), at_rest
