"""Decisions of runs about joints with set-valued friction: whether they stick, or in which direction they slide.

The law and its solution are in `equations.stick_or_slip`. A run adds what it knows: which joint has stopped or reached its limit,
and which joints stuck before.

Arrays are JAX's, for one member, or NumPy's, for several (*m).
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from udkjax.complementarity.stick_or_slip import AT_REST, FrictionModes, JointsAtRest
from udkjax.integrate.events.runs import MemberIndices, MemberRuns, RunState, take
from udkjax.integrate.events.system import System, condition_values
from udkjax.integrate.solution import Result
from udkjax.transforms.gradients import stop_gradients


def modes_of(system: System, members: MemberIndices, at: RunState) -> FrictionModes:
    """Return the modes of the joints of members."""
    plan, sides = system.plan, system.sides(members, at.joints)
    direction, rest = (sides[..., plan.directions_of_sliding + k] for k in range(2))
    return FrictionModes(plan.locked(at.phase), direction, rest > 0.5, rest > 1.5)


def with_modes(system: System, members: MemberIndices, at: RunState, modes: FrictionModes) -> RunState:
    """Return the states with other modes; NumPy arrays of sides change in place."""
    plan, xp = system.plan, system.xp
    sides = system.sides(members, at.joints)
    values = modes.sides(xp)
    sides = xp.concatenate([values.reshape(*values.shape[:-2], -1), sides[..., plan.first_kink_side :]], axis=-1)
    return at._replace(phase=plan.with_locks(at.phase, modes.locked, xp), joints=system.with_sides(members, at.joints, sides))


def settle_friction(
    system: System, members: MemberIndices, at: RunState, stopped: Int[Any, "*m"], given: FrictionModes | None = None
) -> tuple[RunState, Bool[Any, "*m"]]:
    """Decide which joints stick, and in which direction the others slide.

    Args:
        system: the system.
        members: the members.
        at: their states, whose phases and sides have the modes of the joints before.
        stopped: the event of each member: of a joint that has stopped, or, plus E, of one that reaches its limit; -1: another.
        given: the modes, if they are known.

    Returns:
        The states, with velocities that the locked joints allow; a mask of the members for which no modes obey the law.
    """
    xp = system.xp
    before, failed = modes_of(system, members, at), xp.zeros(at.t.shape, bool)
    if given is None:
        found, failed = _decide(system, members, at if xp is np else stop_gradients(at), before, stopped)
    else:
        found = given
    new = found.locked & ~before.locked
    after = with_modes(system, members, _with_locks(system, members, at, new), found)
    if xp is np and not new.any():
        return after, failed
    _, v = system.project(members, after)
    return after._replace(v=xp.where(xp.any(new, axis=-1)[..., None], v, after.v)), failed


def _with_locks(system: System, members: MemberIndices, at: RunState, new: Bool[Any, "*m F"]) -> RunState:
    """Return the states with the locks of the masked joints at their places."""
    others = len(system.plan.added_by) - len(system.plan.sticking)
    new = system.xp.concatenate([system.xp.zeros((len(at.t), others), bool), new], axis=-1)
    return at._replace(joints=system.add_joints(members, new, at.q, at.joints))


def begin_with_friction(system: System, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
    """Return the runs with the modes of all joints at their start."""
    state, failed = settle_friction(system, members, runs.state(members), take(runs.event, members) * 0 - 1)
    code = system.xp.where(failed, Result.event_impossible, take(runs.code, members))
    return runs.put(members, v=state.v, phase=state.phase, code=code, running=~failed)._replace(joints=state.joints)


def _decide(
    system: System, members: MemberIndices, at: RunState, before: FrictionModes, stopped: Int[Any, "*m"]
) -> tuple[FrictionModes, Bool[Any, "*m"]]:
    plan, xp = system.plan, system.xp
    E, forwards = plan.count, plan.forwards
    free = with_modes(system, members, at, before._replace(locked=before.locked & False))
    values, state_values = condition_values(system, members, free, is_directed=True)
    rate = take(system.rate, members)[..., None]
    scale, speed = values.scale[..., forwards], values.h[..., forwards]
    is_stopped, leaves = ([stopped[..., None] == start + forwards + k for k in (0, 1)] for start in (0, E))
    rest = is_stopped[0] | is_stopped[1] | (xp.abs(speed) <= AT_REST.closed * scale)
    if xp is np and not rest.any():
        return FrictionModes(rest, xp.sign(speed), rest, rest), xp.zeros(at.t.shape, bool)
    normals, directions = (x[..., forwards, :] for x in (state_values.by_v, state_values.directions))
    inverse_mass = take(system.inverse_mass, members)[..., None, :]
    mobility, W = (normals**2 * inverse_mass).sum(-1), directions / inverse_mass @ directions.swapaxes(-1, -2)
    at = _with_locks(system, members, at, rest & ~before.locked)
    joints = JointsAtRest.of(rest, xp.sign(speed), W, mobility, before.locked, scale * rate, xp)

    def respond(modes: FrictionModes) -> tuple[Any, Any, Any]:
        found = system.look(members, with_modes(system, members, at, modes), has_forces=True)
        return found.rate[..., forwards], found.forces[..., forwards], found.forces[..., forwards + 1]

    left = xp.where(leaves[0], 1.0, xp.where(leaves[1], -1.0, 0.0))
    kept = xp.where(before.at_rest & rest, before.direction, 0.0)
    started = before.driven & (is_stopped[0] | is_stopped[1])  # its speed, in one of both directions, has become negative
    direction = xp.where(left != 0, left, xp.where(started, xp.where(is_stopped[0], -1.0, 1.0), kept))
    return joints.decide(respond, direction, started, (left != 0) | started, xp)
