"""Joints with set-valued friction at one instant: which of them stick, and in which direction the others slide.

A joint at rest carries any force within its limit; a joint that slides carries its friction. A joint i at rest, with
acceleration a_i, force f_i and limit c_i, obeys

    |f_i| <= c_i,        a_i = 0 where |f_i| < c_i,        f_i = -c_i sign(a_i) where a_i is not zero.

Limits depend on the loads of the joints, and these on the forces, so the law is not a linear complementarity problem. It is
solved by pivots (Murty 1974; Judice and Pires 1994): each joint is either within its limit, or at its limit in one direction. The
equations of motion are solved for these modes, with locked joints as constraints. Then a locked joint whose force exceeds the
limit is set to its limit, and a joint at its limit that accelerates against its direction is locked again. If several joints
have come to rest together, or pivots do not end, the first modes come from a fixed-point iteration of the limits: with given
limits the law is a quadratic program with bounds, whose accelerations are unique.

Where the joints of a mechanism at rest lock each other, their forces are not unique. Only joints with independent rows are
locked; they keep the others at rest, whose forces stay as they were. If a locked joint reaches its limit, another one is locked
instead. The mechanism moves once no joint is left that could be locked.

A contact with friction is such a joint, too, while it is closed. Its normal force N >= 0 is its load, and depends on the friction
of all. Contacts at rest then take part in the pivots, with their second rates g'':

    N >= 0,        g'' >= 0,        one of them zero:

one that would pull opens, and one that would be penetrated is held. Where no set obeys both laws, it is Painleve's paradox.

Arrays are JAX's, for one member, or NumPy's, for several (*m).
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.complementarity.linear import eliminate

# Iterations for the limits, sweeps of a projected Gauss-Seidel method in each, and the change of forces, as shares of their
# limits, at which sweeps end. They decide with which modes pivots begin, and so only the number of pivots.
LIMIT_ITERATIONS, SWEEPS, SHARE_TOL = 10, 20, 1e-6
# Pivots per joint: at first of all joints that violate their law, then only of the first such joint, which does not cycle.
BLOCK_STEPS, SINGLE_STEPS = 2, 8


SIDES = 2  # numbers that represent the mode of a joint
NO_CONTACTS = np.zeros(0)


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


class Response(NamedTuple):
    """Response of F joints to given modes: their accelerations, and the margins between their friction forces and the limits."""

    accelerations: Float[Any, "*m F"]  # along the joints
    forwards: Float[Any, "*m F"]  # limits minus forces in the positive direction
    backwards: Float[Any, "*m F"]  # limits plus forces
    normal: Any = NO_CONTACTS  # forces of the contacts (*m, E)
    rates: Any = NO_CONTACTS  # second rates of the contacts (*m, E)


class ContactsAtRest(NamedTuple):
    """Contacts (E) at one instant, some of which are those of joints with friction."""

    of_joints: Int[np.ndarray, "F"]  # the contact of each joint; -1: the joint is not in a contact
    held: Bool[Any, "*m E"]  # whether each contact is held before the search for modes
    may_change: Bool[Any, "*m E"]  # contacts that do not separate, which may be held or not
    unit: Any  # size of second rates that are not zero (*m, E)
    most: int  # the largest number of contacts that may change

    @classmethod
    def none(cls, count: int) -> "ContactsAtRest":
        """Return the record of no contacts, for `count` joints."""
        nothing = NO_CONTACTS.astype(bool)
        return cls(np.full(count, -1), nothing, nothing, NO_CONTACTS, 0)

    def active(self, held: Bool[Any, "*m E"]) -> Bool[Any, "*m F"]:
        """Return a mask of the joints that may rub while some contacts are held."""
        if (self.of_joints < 0).all():
            return np.ones(len(self.of_joints), bool)
        return (self.of_joints < 0) | held[..., np.maximum(self.of_joints, 0)]

    def wrong(self, held: Bool[Any, "*m E"], found: Response, xp: ModuleType) -> Bool[Any, "*m E"]:
        """Return a mask of the contacts that are held and pull, or are not held and would be penetrated."""

        def negative(x: Any, mask: Any, floor: Any) -> Any:
            size = xp.max(xp.where(mask, xp.abs(x), 0.0), axis=-1, keepdims=True)
            return mask & ~(x >= -xp.maximum(floor, AT_REST.still * size))

        if not self.most:
            return self.may_change
        pull = negative(found.normal, self.may_change & held, 0.0)
        return pull | negative(found.rates, self.may_change & ~held, self.unit)


class FrictionModes(NamedTuple):
    """Modes of F joints with set-valued friction (locked, sliding or kept at rest by others), and of E contacts."""

    locked: Bool[Any, "*m F"]
    direction: Float[Any, "*m F"]  # of sliding, or of the limit that is reached; 0: within the limit
    at_rest: Bool[Any, "*m F"]  # joints that others keep at rest
    driven: Bool[Any, "*m F"]  # joints at rest without a motion of their own, which wait for drivers
    held: Bool[Any, "*m E"] = NO_CONTACTS.astype(bool)  # contacts at rest

    def sides(self, xp: ModuleType) -> Float[Any, "*m F 2"]:
        """Return each mode as two numbers: the direction of sliding, and the kind of rest; both are 0 for a locked joint.

        The second number is 1 for a joint that others keep at rest, 2 if the joint waits for drivers, else 0.
        """
        direction = xp.where(self.locked, 0.0, self.direction)
        return xp.stack([direction, xp.where(self.locked, 0.0, 1.0 * self.at_rest + self.driven)], axis=-1)


class Decision(NamedTuple):
    """Result of the search for modes that obey the friction law."""

    modes: FrictionModes
    failed: Bool[Any, "*m"]  # whether no modes were found that obey the law
    by_contacts: Bool[Any, "*m"]  # whether contacts violated their law in the last modes tried


class _Pivot(NamedTuple):
    """State of the search for modes by principal pivots, one change at a time."""

    modes: FrictionModes  # as they follow from the other fields
    held: Any  # (E,): whether each contact is held
    within: Any  # whether the force of a joint at rest is within its limit
    departs: Any  # whether others move a joint that is at rest only at this instant
    direction: Any  # (F,): direction of sliding, or of the limit that is reached
    steps: Any  # number of pivots so far
    done: Any
    failed: Any
    by_contacts: Any  # whether a contact is held that pulls, or not held that would be penetrated


class JointsAtRest(NamedTuple):
    """State of F joints with set-valued friction at one instant, and the mobilities W that decide which of them stick."""

    rest: Bool[Any, "*m F"]  # whether their speeds are zero
    sliding: Float[Any, "*m F"]  # the directions of all others
    W: Float[
        Any, "*m F F"
    ]  # mobilities: accelerations of joints at unit forces of others, rows of unit size; zero where nothing can move
    size: Float[Any, "*m F"]  # roots of the accelerations at unit forces: the units of W
    locked: Bool[Any, "*m F"]  # whether the joint was locked before
    rested: Bool[Any, "*m F"]  # whether the joint was at rest before, locked or kept at rest by others
    unit: Float[Any, "*m F"]  # characteristic accelerations: those smaller than `AT_REST.still` of them are zero
    contacts: ContactsAtRest

    @classmethod
    def of(
        cls,
        rest: Any,
        sliding: Any,
        W: Any,
        mobility: Any,
        locked: Any,
        rested: Any,
        unit: Any,
        xp: ModuleType,
        contacts: ContactsAtRest | None = None,
    ) -> "JointsAtRest":
        """Return the joints, with W scaled to rows of unit size.

        Args:
            rest: Mask of the joints whose speeds are zero.
            sliding: Directions in which the others slide.
            W: Accelerations of the joints (*m, F, F) at unit forces, with the constraints.
            mobility: Acceleration of each joint (*m, F) at its own unit force without constraints; a joint cannot move if its
                diagonal entry of W is negligible compared with this.
            locked: Mask of the joints that were locked before.
            rested: Mask of the joints that were at rest before.
            unit: Characteristic accelerations of the joints: those smaller than `AT_REST.still` of them are zero.
            xp: jax.numpy, or NumPy.
            contacts: The contacts; None: there are none.
        """
        diagonal = xp.diagonal(W, axis1=-2, axis2=-1)
        moves = diagonal > AT_REST.blocked * mobility
        size = xp.sqrt(xp.where(moves, diagonal, 1.0))
        W = xp.where(moves[..., None, :] & moves[..., :, None], W / size[..., None, :] / size[..., :, None], 0.0)
        contacts = ContactsAtRest.none(rest.shape[-1]) if contacts is None else contacts
        return cls(rest, sliding, W, size, locked, rested, unit, contacts)

    def independent(self, wanted: Bool[Any, "*m F"], xp: ModuleType) -> Bool[Any, "*m F"]:
        """Return a mask of some of the `wanted` joints, whose locks keep all of these at rest.

        Joints that were locked before are preferred.
        """
        return self._eliminate(wanted, xp)[1]

    def _eliminate(self, wanted: Bool[Any, "*m F"], xp: ModuleType) -> tuple[Any, Bool[Any, "*m F"]]:
        """Return the mobilities of all joints once the joints that `independent` selects are locked, and the mask of these."""
        remainder, locked = self.W, wanted & False
        least = xp.full(self.W.shape[:-1], AT_REST.carried)
        for preferred in (wanted & self.locked, wanted & ~self.locked):
            remainder, taken = eliminate(remainder, preferred, least, xp)
            locked = locked | taken
        return remainder, locked

    def decide(
        self,
        respond: Callable[[FrictionModes], Response],
        direction: Float[Any, "*m F"],
        departs: Bool[Any, "*m F"],
        is_given: Bool[Any, "*m F"],
        xp: ModuleType,
    ) -> Decision:
        """Search for modes that obey the law of friction, and that of contacts.

        Args:
            respond: solves the equations of motion for given modes.
            direction: the first guess of the direction in which a joint at rest is at its limit; 0: within it.
            departs: the first guess whether others move a joint that is at rest only at this instant.
            is_given: whether the first direction is known to be right.
            xp: jax.numpy, or NumPy.

        Returns:
            The modes, and whether the search failed.
        """
        F, contacts = self.rest.shape[-1], self.contacts
        E, count = contacts.held.shape[-1], F + contacts.most
        is_settled = ~(xp.any(self.rest, axis=-1) | xp.any(contacts.may_change, axis=-1))
        most = (BLOCK_STEPS + SINGLE_STEPS) * count + 8

        def step(pivot: _Pivot) -> _Pivot:
            modes = pivot.modes
            found, active = respond(modes), contacts.active(modes.held)
            a, reserves = found.accelerations, (found.forwards, found.backwards)
            # A force that could cause only an acceleration that is zero is zero, as where the load of a joint vanishes at rest.
            smallest = self.unit / self.size**2
            floor = AT_REST.still * xp.maximum(xp.maximum(xp.abs(reserves[0]), xp.abs(reserves[1])), smallest)
            beyond = [modes.locked & (x < -floor) for x in reserves]
            least = AT_REST.still * xp.maximum(xp.max(xp.abs(a), axis=-1, keepdims=True), self.unit)
            departs = modes.at_rest & (xp.abs(a) > least)
            returns = self.rest & active & ~pivot.within & ~modes.at_rest & (modes.direction * a < -least)
            of_contacts, of_joints = contacts.wrong(modes.held, found, xp), beyond[0] | beyond[1] | departs | returns
            violates = xp.concatenate([of_contacts, of_joints & active], axis=-1)
            first = xp.cumsum(violates, axis=-1) == 1
            violates_now = xp.where(pivot.steps < BLOCK_STEPS * count, violates, violates & first)
            is_known = xp.all(xp.isfinite(a), axis=-1)
            done = pivot.done | (is_known & ~xp.any(violates, axis=-1))
            changes = violates_now & ~done[..., None]
            flips, changes = changes[..., :E], changes[..., E:]
            new = xp.where(departs, xp.sign(a), xp.where(beyond[0], 1.0, xp.where(beyond[1], -1.0, 0.0)))
            following = pivot._replace(
                held=pivot.held ^ flips,
                within=xp.where(changes, returns, pivot.within),
                departs=xp.where(changes, departs, pivot.departs),
                direction=xp.where(changes, new, pivot.direction),
                steps=pivot.steps + 1,
                done=done,
                by_contacts=xp.any(of_contacts, axis=-1),
            )
            return following if xp is np and done.all() else with_modes(following)

        def with_modes(pivot: _Pivot) -> _Pivot:
            return pivot._replace(modes=self._modes(pivot, xp))

        def goes_on(pivot: _Pivot) -> Any:
            return ~xp.all(pivot.done) & (pivot.steps < most)

        def pivots(start: _Pivot) -> _Pivot:
            if xp is not np:
                return jax.lax.while_loop(goes_on, step, start)
            while goes_on(start):
                start = step(start)
            return start

        def attempt(state: tuple[_Pivot, Any]) -> tuple[_Pivot, Any]:
            """Return the state after a search by pivots, from `_guess` in the masked members, and a mask of unsolved members."""
            pivot, guesses = state
            improved = lambda: xp.where(is_given, direction, self._guess(respond, direction, xp))  # noqa: E731
            if xp is not np:
                first = jax.lax.cond(xp.any(guesses), improved, lambda: direction) if F > 1 else direction
            else:
                first = xp.where(guesses[..., None], improved(), direction) if guesses.any() else direction
            keep = pivot.done[..., None]
            start = pivot._replace(
                held=xp.where(keep, pivot.held, contacts.held),
                within=xp.where(keep, pivot.within, self.rest & (first == 0)),
                departs=xp.where(keep, pivot.departs, departs),
                direction=xp.where(keep, pivot.direction, first),
                steps=xp.asarray(0),
            )
            pivot = pivots(with_modes(start))
            fails = ~pivot.done & (guesses | (F == 1))
            pivot = pivot._replace(failed=pivot.failed | fails, done=pivot.done | fails)
            return pivot, ~pivot.done

        # After an event of one joint, most other joints keep their modes: the search by pivots begins with these modes.
        at_once = xp.sum(self.rest & ~self.rested, axis=-1) > 1
        none = FrictionModes(self.rest, direction, self.rest, self.rest, contacts.held)  # replaced at once
        no = is_settled & False
        pivot = _Pivot(none, contacts.held, self.rest & (direction == 0), departs, direction, xp.asarray(0), is_settled, no, no)
        if xp is np:
            pivot, fails = attempt((pivot, at_once))
            if fails.any():
                pivot, _ = attempt((pivot, fails))
        else:
            pivot = pivot._replace(steps=xp.asarray(-1))  # not begun yet
            goes = lambda state: (state[0].steps < 0) | xp.any(state[1])  # noqa: E731
            pivot, _ = jax.lax.while_loop(goes, attempt, (with_modes(pivot), at_once))
        return Decision(pivot.modes, pivot.failed, pivot.by_contacts)

    def _guess(
        self, respond: Callable[[FrictionModes], Response], direction: Float[Any, "*m F"], xp: ModuleType
    ) -> Float[Any, "*m F"]:
        """Return the direction in which each joint at rest is at its limit, 0 within it, by a fixed-point iteration of limits."""
        F, none, mobile = self.rest.shape[-1], self.rest & False, xp.diagonal(self.W, axis1=-2, axis2=-1) > 0
        held, active = self.contacts.held, self.contacts.active(self.contacts.held)
        rest = self.rest & active
        acts, units = rest & mobile, np.eye(F)
        rows = range(F) if xp is not np else np.flatnonzero(acts.reshape(-1, F).any(axis=0)).tolist()

        def improve(share: Any) -> Any:
            """Return the next iterate of the friction forces, as shares of their limits, from the last one."""
            direction = xp.where(self.rest, share, self.sliding) * active
            found = respond(FrictionModes(none, direction, rest, none, held))
            a, limit = found.accelerations / self.size, self.size * found.forwards
            force = share * limit

            def sweep(_: Any, state: tuple[Any, Any]) -> tuple[Any, Any]:
                force, a = state
                for i in rows:
                    new = xp.minimum(xp.maximum(force[..., i] + a[..., i], -limit[..., i]), limit[..., i])
                    change = xp.where(acts[..., i], new - force[..., i], 0.0)[..., None]
                    force, a = force + change * units[i], a - self.W[..., :, i] * change
                return force, a

            state = force, a
            if xp is np:
                for k in range(SWEEPS):
                    before, state = state[0], sweep(k, state)
                    if (abs(state[0] - before) <= SHARE_TOL * limit).all():
                        break
            else:
                state = jax.lax.fori_loop(0, SWEEPS, sweep, state)
            force = state[0]
            new = force / xp.where(limit > 0, limit, 1.0)
            return xp.where(xp.isfinite(new), new, 0.0)

        def at_limit(share: Any) -> Any:
            return xp.where(xp.abs(share) > 1 - AT_REST.closed, xp.sign(share), 0.0)

        share = xp.where(self.rest, direction, 0.0)
        if xp is np:
            for k in range(LIMIT_ITERATIONS):
                before, share = share, improve(share)
                # Pivots settle the rest once the iteration has found the joints at their limits, twice the same.
                if k and np.array_equal(at_limit(share), at_limit(before)):
                    break
        else:
            share = jax.lax.fori_loop(0, LIMIT_ITERATIONS, lambda _, x: improve(x), share)
        return at_limit(share)

    def _modes(self, pivot: _Pivot, xp: ModuleType) -> FrictionModes:
        """Return the modes that follow from the other fields of a pivot.

        Of the joints at rest whose forces are within their limits, those with independent rows are locked.
        """
        active = self.contacts.active(pivot.held)
        rest = self.rest & active
        remainder, locked = self._eliminate(rest & pivot.within, xp)
        moves = xp.diagonal(remainder, axis1=-2, axis2=-1) > AT_REST.carried
        at_rest = rest & ~locked & ~moves & ~pivot.departs
        driven = at_rest & (xp.diagonal(self.W, axis1=-2, axis2=-1) == 0)
        direction = xp.where(self.rest, xp.where(pivot.within, 0.0, pivot.direction), self.sliding) * active
        return FrictionModes(locked, direction, at_rest, driven, pivot.held)
