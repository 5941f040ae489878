"""Joints with set-valued friction at one instant: which of them stick, and in which direction the others slide.

A joint at rest carries any force within its limit; a joint that slides carries its friction. A joint i at rest, with
acceleration a_i, force f_i and limit c_i, obeys

    |f_i| <= c_i,        a_i = 0 where |f_i| < c_i,        f_i = -c_i sign(a_i) where a_i is not zero.

Limits depend on the loads of the joints, and these on the forces, so the law is not a linear complementarity problem. It is
solved by pivots (Murty 1974; Judice and Pires 1994): each joint is either within its limit, or at its limit in one direction. The
equations of motion are solved for these modes, with locked joints as constraints. Then a locked joint whose force exceeds the
limit is set to its limit, and a joint at its limit that accelerates against its direction is locked again. If several joints are
at rest, the first modes come from a fixed-point iteration of the limits: with given limits the law is a quadratic program with
bounds, whose accelerations are unique.

Where the joints of a mechanism at rest lock each other, their forces are not unique. Only joints with independent rows are
locked; they keep the others at rest, whose forces stay as they were. If a locked joint reaches its limit, another one is locked
instead. The mechanism moves once no joint is left that could be locked.

Arrays are JAX's, for one member, or NumPy's, for several (*m).
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Bool, Float

# Iterations for the limits, sweeps of a projected Gauss-Seidel method in each, and the change of the forces, as shares of their
# limits, at which iterations end. They decide with which modes pivots begin, and so only the number of pivots.
REPETITIONS, SWEEPS, SAME_SHARE = 10, 20, 1e-6
# Pivots per joint: at first of all joints that violate their law, then only of the first such joint, which does not cycle.
BLOCK_STEPS, SINGLE_STEPS = 2, 8


SIDES = 2  # numbers that represent the mode of a joint


class RestTolerances(NamedTuple):
    """Bounds below which contacts and joints are at rest, or constraints leave them no motion."""

    # Bound on (u . u) / (n M^(-1) n), the square of the sine of the angle between the row of a contact or joint and those of the
    # constraints, in the metric of M. At a sine of 1e-8, half of the digits, u is merely the rounding error of a difference of
    # two rows, and no impulse follows from it.
    blocked: float = 1e-16
    # Relative to the scale of a condition: contacts this close to zero are hit together with another one, joints this slow are
    # at rest. This bound exceeds the errors of a symmetric mechanism at usual tolerances, and advances a hit by 1e-9 T at most.
    closed: float = 1e-9
    # Relative to the fastest approach in an impact, or to the strongest pull: smaller values of other contacts are zero, to the
    # accuracy of their rows.
    still: float = 1e-9
    # Bound on the squared sine of the angle between the row of a contact or joint and those of held ones: below it, they hold
    # this one, too. A dependent row has a sine of about `closed` over the distance of contacts, here down to a thousandth of L.
    carried: float = (1e3 * 1e-9) ** 2


AT_REST = RestTolerances()


Response: TypeAlias = tuple[Any, Any, Any]  # accelerations along the joints; limit minus force, in both directions (*m, F)


class FrictionModes(NamedTuple):
    """The modes of joints that may stick."""

    locked: Bool[Any, "*m F"]
    direction: Float[Any, "*m F"]  # of sliding, or of the limit that is reached; 0: within the limit
    at_rest: Bool[Any, "*m F"]  # joints that others keep at rest
    driven: Bool[Any, "*m F"]  # joints at rest without a motion of their own, which wait for drivers

    def sides(self, xp: ModuleType) -> Float[Any, "*m F 2"]:
        """Return the modes as numbers: the direction, and one for a joint at rest, two for one that waits for drivers."""
        direction = xp.where(self.locked, 0.0, self.direction)
        return xp.stack([direction, xp.where(self.locked, 0.0, 1.0 * self.at_rest + self.driven)], axis=-1)


class _Pivot(NamedTuple):
    within: Any  # whether the force of a joint at rest is within its limit
    departs: Any  # whether others move a joint that is at rest only at this instant
    direction: Any
    steps: Any
    done: Any


class JointsAtRest(NamedTuple):
    """The joints at one instant, those at rest among them."""

    rest: Bool[Any, "*m F"]  # whether their speeds are zero
    sliding: Float[Any, "*m F"]  # the directions of all others
    W: Float[Any, "*m F F"]  # accelerations of joints at unit forces of others, rows of unit size; zero where nothing can move
    size: Float[Any, "*m F"]  # roots of the accelerations at unit forces: the units of W
    locked: Bool[Any, "*m F"]  # before
    unit: Float[Any, "*m F"]  # size of accelerations that are not zero

    @classmethod
    def of(cls, rest: Any, sliding: Any, W: Any, mobility: Any, locked: Any, unit: Any, xp: ModuleType) -> "JointsAtRest":
        """Return the joints, from W and from the accelerations (*m, F) at unit forces without constraints."""
        diagonal = xp.diagonal(W, axis1=-2, axis2=-1)
        moves = diagonal > AT_REST.blocked * mobility
        size = xp.sqrt(xp.where(moves, diagonal, 1.0))
        W = xp.where(moves[..., None, :] & moves[..., :, None], W / size[..., None, :] / size[..., :, None], 0.0)
        return cls(rest, sliding, W, size, locked, unit)

    def decide(
        self,
        respond: Callable[[FrictionModes], Response],
        direction: Float[Any, "*m F"],
        departs: Bool[Any, "*m F"],
        is_given: Bool[Any, "*m F"],
        xp: ModuleType,
    ) -> tuple[FrictionModes, Bool[Any, "*m"]]:
        """Return modes that obey the law, and a mask of the members for which none are found.

        Args:
            respond: evaluates the equations of motion in given modes.
            direction: the first guess of the direction in which a joint at rest is at its limit; 0: within it.
            departs: the first guess whether others move a joint that is at rest only at this instant.
            is_given: whether the first direction is known to be right.
            xp: jax.numpy, or NumPy.
        """
        F = self.rest.shape[-1]
        if F > 1 and (xp is not np or (self.rest.sum(axis=-1) > 1).any()):
            direction = xp.where(is_given, direction, self._guess(respond, direction, xp))
        start = _Pivot(self.rest & (direction == 0), departs, direction, xp.asarray(0), ~xp.any(self.rest, axis=-1))
        most = (BLOCK_STEPS + SINGLE_STEPS) * F + 8

        def step(pivot: _Pivot) -> _Pivot:
            modes = self._modes(pivot, xp)
            a, *reserves = respond(modes)
            floor = AT_REST.still * xp.maximum(xp.abs(reserves[0]), xp.abs(reserves[1]))
            beyond = [modes.locked & (x < -floor) for x in reserves]
            least = AT_REST.still * xp.maximum(xp.max(xp.abs(a), axis=-1, keepdims=True), self.unit)
            departs = modes.at_rest & (xp.abs(a) > least)
            returns = self.rest & ~pivot.within & ~modes.at_rest & (modes.direction * a < -least)
            violates = beyond[0] | beyond[1] | departs | returns
            first = xp.cumsum(violates, axis=-1) == 1
            violates_now = xp.where(pivot.steps < BLOCK_STEPS * F, violates, violates & first)
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
        return self._modes(pivot, xp), ~pivot.done

    def _guess(
        self, respond: Callable[[FrictionModes], Response], direction: Float[Any, "*m F"], xp: ModuleType
    ) -> Float[Any, "*m F"]:
        """Return the direction of each joint at rest at its limit, 0 within it, for approximate limits."""
        F, none, mobile = self.rest.shape[-1], self.rest & False, xp.diagonal(self.W, axis1=-2, axis2=-1) > 0

        def improve(share: Any) -> Any:
            """Return the next iterate of the forces, as shares of the limits."""
            a, limit, _ = respond(FrictionModes(none, xp.where(self.rest, share, self.sliding), self.rest, none))
            a, limit = a / self.size, self.size * limit
            force = share * limit
            for _ in range(SWEEPS):
                for i in range(F):
                    new = xp.clip(force[..., i] + a[..., i], -limit[..., i], limit[..., i])
                    change = xp.where(self.rest[..., i] & mobile[..., i], new - force[..., i], 0.0)
                    force = force + xp.where(np.arange(F) == i, change[..., None], 0.0)
                    a = a - self.W[..., :, i] * change[..., None]
            new = force / xp.where(limit > 0, limit, 1.0)
            return xp.where(xp.isfinite(new), new, 0.0)

        share = xp.where(self.rest, direction, 0.0)
        if xp is np:
            for _ in range(REPETITIONS):
                before, share = share, improve(share)
                if np.all(np.abs(share - before) < SAME_SHARE):
                    break
        else:
            share = jax.lax.fori_loop(0, REPETITIONS, lambda _, x: improve(x), share)
        return xp.where(xp.abs(share) > 1 - AT_REST.closed, xp.sign(share), 0.0)

    def _modes(self, pivot: _Pivot, xp: ModuleType) -> FrictionModes:
        """Return the modes for given joints within their limits; of these, joints with independent rows are locked."""
        locked, remainder = xp.zeros_like(self.rest), self.W
        F = self.W.shape[-1]
        wanted = self.rest & pivot.within
        for preferred in (wanted & self.locked, wanted & ~self.locked):
            for i in range(F):
                size = remainder[..., i, i]
                takes = preferred[..., i] & (size > AT_REST.carried)
                column = remainder[..., :, i]
                part = column[..., :, None] * column[..., None, :] / xp.where(takes, size, 1.0)[..., None, None]
                remainder = xp.where(takes[..., None, None], remainder - part, remainder)
                locked = locked | (takes[..., None] & (np.arange(F) == i))
        moves = xp.diagonal(remainder, axis1=-2, axis2=-1) > AT_REST.carried
        at_rest = self.rest & ~locked & ~moves & ~pivot.departs
        driven = at_rest & (xp.diagonal(self.W, axis1=-2, axis2=-1) == 0)
        direction = xp.where(self.rest, xp.where(pivot.within, 0.0, pivot.direction), self.sliding)
        return FrictionModes(locked, direction, at_rest, driven)
