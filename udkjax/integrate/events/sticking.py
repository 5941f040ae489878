"""Decisions about joints with set-valued friction: whether they stick, or in which direction they slide.

Joints that are at rest relative to each other carry any force within their limits; joints that slide carry their friction. A
joint i at rest, with acceleration a_i, force f_i and limit c_i, obeys

    |f_i| <= c_i,        a_i = 0 where |f_i| < c_i,        f_i = -c_i sign(a_i) where a_i is not zero.

Limits depend on the loads of the joints, and these on the forces, so that the law is not a linear complementarity problem. It is
solved by pivots (Murty 1974; Judice and Pires 1994): a joint is either within its limit, or at it in one direction. Each set is
evaluated by the equations of motion, with locked joints as constraints; a locked joint whose force is beyond its limit goes to
it, and a joint at its limit that accelerates against its direction returns. If several joints are at rest, pivots begin with the
solution for limits that are found by repetition: with given limits the law is a quadratic program with bounds, which has one
solution for the accelerations.

Where the joints of a mechanism at rest lock each other, their forces are not unique. As many joints are locked as have
independent rows; the others are kept at rest by these, with the forces that they had. If a locked joint reaches its limit,
another one takes its place, until all that could be are at their limits: only then does the mechanism move.

Arrays are JAX's, for one member, or NumPy's, for several (*m).
"""

from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.events.impacts import BLOCKED, CARRIED, CLOSED, STILL
from udkjax.integrate.events.runs import MemberIndices, MemberRuns, RunState, take
from udkjax.integrate.events.system import System, condition_values
from udkjax.integrate.solution import Result
from udkjax.transforms.gradients import stop_gradients

# Number of repetitions for the limits, with sweeps of a projected Gauss-Seidel method in each, and the change of the shares of
# the limits by the last. Pivots correct what these leave: they decide where pivots begin, and so their number.
REPETITIONS, SWEEPS, SAME_SHARE = 10, 20, 1e-6
# Number of pivots of all joints that violate their law, for each joint; then only the first such joint pivots, which ends.
BLOCK_STEPS, SINGLE_STEPS = 2, 8


class FrictionModes(NamedTuple):
    """The modes of joints that may stick."""

    locked: Bool[Any, "*m F"]
    direction: Float[Any, "*m F"]  # of sliding, or of the limit that is reached; 0: within the limit
    at_rest: Bool[Any, "*m F"]  # joints that others keep at rest
    driven: Bool[Any, "*m F"]  # joints at rest without a motion of their own, which wait for drivers


class _JointsAtRest(NamedTuple):
    """The joints at one instant, those at rest among them."""

    rest: Bool[Any, "*m F"]  # whether their speeds are zero
    sliding: Float[Any, "*m F"]  # the directions of all others
    W: Float[Any, "*m F F"]  # accelerations of joints at unit forces of others, rows of unit size; zero where nothing can move
    locked: Bool[Any, "*m F"]  # before
    unit: Float[Any, "*m F"]  # size of accelerations that are not zero


class _Pivot(NamedTuple):
    within: Any  # whether the force of a joint at rest is within its limit
    departs: Any  # whether others move a joint that is at rest at this instant alone
    direction: Any
    steps: Any
    done: Any


def modes_of(system: System, members: MemberIndices, at: RunState) -> FrictionModes:
    """Return the modes of the joints of members."""
    plan, sides = system.plan, system.sides(members, at.joints)
    direction, rest = (sides[..., plan.directions_of_sliding + k] for k in range(2))
    return FrictionModes(plan.locked(at.phase), direction, rest > 0.5, rest > 1.5)


def with_modes(system: System, members: MemberIndices, at: RunState, modes: FrictionModes) -> RunState:
    """Return the states with other modes; NumPy arrays of sides change in place."""
    plan, xp = system.plan, system.xp
    sides = system.sides(members, at.joints)
    values = xp.stack(
        [xp.where(modes.locked, 0.0, modes.direction), xp.where(modes.locked, 0.0, 1.0 * modes.at_rest + modes.driven)], axis=-1
    )
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
    rest = is_stopped[0] | is_stopped[1] | (xp.abs(speed) <= CLOSED * scale)
    normals, directions = (x[..., forwards, :] for x in (state_values.by_v, state_values.directions))
    W, mobility = normals @ directions.swapaxes(-1, -2), (normals**2 * take(system.inverse_mass, members)[..., None, :]).sum(-1)
    diagonal = xp.diagonal(W, axis1=-2, axis2=-1)
    moves = diagonal > BLOCKED * mobility
    size = xp.sqrt(xp.where(moves, diagonal, 1.0))
    if xp is np and not rest.any():
        return FrictionModes(rest, xp.sign(speed), rest, rest), xp.zeros(at.t.shape, bool)
    at = _with_locks(system, members, at, rest & ~before.locked)
    W = xp.where(moves[..., None, :] & moves[..., :, None], W / size[..., None, :] / size[..., :, None], 0.0)
    candidates = _JointsAtRest(rest, xp.sign(speed), W, before.locked, scale * rate)

    left = xp.where(leaves[0], 1.0, xp.where(leaves[1], -1.0, 0.0))
    kept = xp.where(before.at_rest & rest, before.direction, 0.0)
    started = before.driven & (is_stopped[0] | is_stopped[1])  # its speed, in one of both directions, has become negative
    direction = xp.where(left != 0, left, xp.where(started, xp.where(is_stopped[0], -1.0, 1.0), kept))
    if len(forwards) > 1 and (xp is not np or (rest.sum(axis=-1) > 1).any()):
        direction = xp.where((left != 0) | started, direction, _guess(system, members, at, candidates, size, direction))
    start = _Pivot(rest & (direction == 0), started, direction, xp.asarray(0), xp.zeros(at.t.shape, bool))
    most = (BLOCK_STEPS + SINGLE_STEPS) * len(forwards) + 8

    def step(pivot: _Pivot) -> _Pivot:
        modes = _modes(candidates, pivot, xp)
        trial = with_modes(system, members, at, modes)
        found = system.look(members, trial, has_forces=True)
        a = found.rate[..., forwards]
        reserves = [found.forces[..., forwards + k] for k in (0, 1)]
        floor = STILL * xp.maximum(xp.abs(reserves[0]), xp.abs(reserves[1]))
        beyond = [modes.locked & (x < -floor) for x in reserves]
        least = STILL * xp.maximum(xp.max(xp.abs(a), axis=-1, keepdims=True), candidates.unit)
        departs = modes.at_rest & (xp.abs(a) > least)
        returns = rest & ~pivot.within & ~modes.at_rest & (modes.direction * a < -least)
        violates = beyond[0] | beyond[1] | departs | returns
        first = xp.cumsum(violates, axis=-1) == 1
        violates_now = xp.where(pivot.steps < BLOCK_STEPS * len(forwards), violates, violates & first)
        is_known = xp.all(xp.isfinite(a), axis=-1)
        done = pivot.done | (is_known & ~xp.any(violates, axis=-1))
        changes = violates_now & ~done[..., None]
        new = xp.where(departs, xp.sign(a), xp.where(beyond[0], 1.0, xp.where(beyond[1], -1.0, 0.0)))
        return _Pivot(
            within=xp.where(changes, returns, pivot.within),
            departs=xp.where(changes, departs, pivot.departs),
            direction=xp.where(changes, new, pivot.direction),
            steps=pivot.steps + 1,
            done=done,
        )

    def goes_on(pivot: _Pivot) -> Any:
        return ~xp.all(pivot.done) & (pivot.steps < most)

    if xp is np:
        pivot = start
        while goes_on(pivot):
            pivot = step(pivot)
    else:
        pivot = jax.lax.while_loop(goes_on, step, start)
    return _modes(candidates, pivot, xp), ~pivot.done


def _guess(
    system: System, members: MemberIndices, at: RunState, known: _JointsAtRest, size: Any, direction: Float[Any, "*m F"]
) -> Float[Any, "*m F"]:
    """Return the direction of each joint at rest at its limit, 0 within it, for limits that are nearly right."""
    plan, xp, F = system.plan, system.xp, len(system.plan.forwards)
    none, mobile = known.rest & False, xp.diagonal(known.W, axis1=-2, axis2=-1) > 0

    def improve(share: Any) -> Any:
        """Return the forces as shares of the limits, from those before."""
        trial = with_modes(system, members, at, FrictionModes(none, xp.where(known.rest, share, known.sliding), known.rest, none))
        found = system.look(members, trial, has_forces=True)
        a, limit = found.rate[..., plan.forwards] / size, size * found.forces[..., plan.forwards]
        force = share * limit
        for _ in range(SWEEPS):
            for i in range(F):
                new = xp.clip(force[..., i] + a[..., i], -limit[..., i], limit[..., i])
                change = xp.where(known.rest[..., i] & mobile[..., i], new - force[..., i], 0.0)
                force = force + xp.where(np.arange(F) == i, change[..., None], 0.0)
                a = a - known.W[..., :, i] * change[..., None]
        new = force / xp.where(limit > 0, limit, 1.0)
        return xp.where(xp.isfinite(new), new, 0.0)

    share = xp.where(known.rest, direction, 0.0)
    if xp is np:
        for _ in range(REPETITIONS):
            before, share = share, improve(share)
            if np.all(np.abs(share - before) < SAME_SHARE):
                break
    else:
        share = jax.lax.fori_loop(0, REPETITIONS, lambda _, x: improve(x), share)
    return xp.where(xp.abs(share) > 1 - CLOSED, xp.sign(share), 0.0)


def _modes(known: _JointsAtRest, pivot: _Pivot, xp: ModuleType) -> FrictionModes:
    """Return the modes of a set of joints within their limits: as many locked ones as have independent rows."""
    locked, remainder = xp.zeros_like(known.rest), known.W
    F = known.W.shape[-1]
    wanted = known.rest & pivot.within
    for preferred in (wanted & known.locked, wanted & ~known.locked):
        for i in range(F):
            size = remainder[..., i, i]
            takes = preferred[..., i] & (size > CARRIED)
            column = remainder[..., :, i]
            part = column[..., :, None] * column[..., None, :] / xp.where(takes, size, 1.0)[..., None, None]
            remainder = xp.where(takes[..., None, None], remainder - part, remainder)
            locked = locked | (takes[..., None] & (np.arange(F) == i))
    moves = xp.diagonal(remainder, axis1=-2, axis2=-1) > CARRIED
    at_rest = known.rest & ~locked & ~moves & ~pivot.departs
    driven = at_rest & (xp.diagonal(known.W, axis1=-2, axis2=-1) == 0)
    direction = xp.where(known.rest, xp.where(pivot.within, 0.0, pivot.direction), known.sliding)
    return FrictionModes(locked, direction, at_rest, driven)
