"""Set-valued friction in given modes: the direction of sliding is an input, so that the loads are smooth."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.annotations import NumberLike, Time, Vector
from udkjax.arrays import make_module
from udkjax.complementarity.stick_or_slip import AT_REST, SIDES
from udkjax.equations.friction import rubbing
from udkjax.equations.laws import udwadia_kalaba as uk
from udkjax.equations.rows import determinacy
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.terms import constraints
from udkjax.equations.terms.switches import switched_friction
from udkjax.pinv import SVD
from udkjax.programs.deferred import deferred
from udkjax.scene.elements.fields import given_number
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.mechanism import Mechanism


class DirectedFriction(Friction):
    """Set-valued friction of a joint that slides in a given direction, or sticks.

    The first of its `sides` is the direction of sliding, 1 or -1 (0: no friction). The second is one if the joint is at rest
    without a constraint that locks it, so that the static coefficient applies; two if it waits for its drivers; else zero.
    """

    sides: Float[Array, "2"] = eqx.field(converter=given_number, default=(0.0, 0.0))

    @property
    def may_have_kinks(self):
        return False

    @property
    def sticks(self):
        return False

    def _torque_at(self, speed):
        assert self.torque is not None
        return self.torque * self.sides[0]

    def _coefficient_at(self, speed):
        assert self.coefficient is not None
        static = self.coefficient if self.static_coefficient is None else self.static_coefficient
        total = self.sides[0] * jnp.where(self.sides[1] > 0.5, static, self.coefficient)
        return total if self.viscous is None else total + self.viscous * speed

    @staticmethod
    def put_in(mechanism: Mechanism, every: bool = False) -> "DirectedMechanism":
        """Return a mechanism with directed friction in place of set-valued friction.

        Args:
            mechanism: The scene.
            every: Whether smooth friction becomes directed, too.

        Returns:
            The mechanism, and the joints whose friction was replaced, in the order of the forces.
        """
        mechanism = mechanism.without_origin
        forces, joints = list(mechanism._forces), []
        for k, force in enumerate(forces):
            if isinstance(force, Friction) and (force.sticks or every):
                cls = switched_friction(DirectedFriction) if hasattr(force, "active") else DirectedFriction
                forces[k] = make_module(cls, **vars(force), sides=jnp.zeros(SIDES))
                joints.append((force.joint, k))
        return DirectedMechanism(
            eqx.tree_at(lambda m: m._forces, mechanism, tuple(forces)) if joints else mechanism, tuple(joints)
        )


class DirectedMechanism(NamedTuple):
    """A mechanism whose set-valued friction is directed (`DirectedFriction`), and its F joints with such friction."""

    mechanism: Any
    joints: tuple[tuple[str, int], ...]  # the names of the joints, and the indices of their friction among the forces

    def with_sides(self, sides: Float[Array, "F 2"]) -> Mechanism:
        """Return the mechanism in which the directed friction of joint j has the `DirectedFriction.sides` sides[j]."""
        if not self.joints:
            return self.mechanism
        return eqx.tree_at(lambda m: [m._forces[k].sides for _, k in self.joints], self.mechanism, list(sides))

    def sliding_speeds(self, q: Vector, v: Vector) -> Float[Array, "F"]:
        """Return the speeds at which the joints slide (rad/s or m/s), in the order of `joints`."""
        frames, found = rubbing.frames(self.mechanism, q, v), []
        for name, k in self.joints:
            joint = self.mechanism.joints[name]
            found.append(self.mechanism._forces[k].sliding_speed(joint, *(frames[body] for body in joint.frame_names)))
        return jnp.stack(found) if found else jnp.zeros(0)

    def friction(
        self, sides: Float[Array, "F 2"], multipliers: Callable[[Vector], Float[Array, "m"]], t: Time, q: Vector, v: Vector
    ) -> Float[Array, "n"]:
        """Return the loads (n,) of friction that depends on the loads of joints, in given modes: see `rubbing.settled_loads`."""
        return rubbing.settled_loads(multipliers, self.with_sides(sides), t, q, v)

    def units(self, length: NumberLike) -> Float[Array, "F"]:
        """Return the units of displacements of the joints: one radian, or a length."""
        turns = np.array([isinstance(self.mechanism.joints[name], Revolute) for name, _ in self.joints], bool)
        return jnp.where(turns, 1.0, length)

    @deferred
    def held_by_drivers(
        self, analysis: Analysis, ts: Float[Array, "T"], q: Float[Array, "T n"], v: Float[Array, "T n"]
    ) -> Bool[Array, "T F"]:
        """Return a mask of the joints that drivers hold at rest: constraints determine their sliding, at rate zero.

        A driver that comes to rest smoothly takes the speed of a joint to zero and leaves it there: no sign changes. The joint is
        then at rest though it neither reaches a limit of friction nor needs a constraint.

        Args:
            analysis: The mechanism's `Analysis`.
            ts: Times (s).
            q: Positions (m, rad).
            v: Velocities (m/s, rad/s).

        Returns:
            The mask of the joints at each time: the speed and the acceleration of their sliding are zero.
        """
        scales = analysis.scales
        units, unit = analysis.coordinate_units, self.units(scales.length)

        def at(t: Array, q: Array, v: Array) -> Array:
            J = determinacy.scaled_jacobian(self.mechanism, t, q, analysis)
            plus = uk.pseudoinverse(SVD(determinacy.STATIC_RANK_TOL), J)
            rows = jax.jacfwd(self.sliding_speeds, 1)(q, v) * units / unit[:, None]
            free = rows - (plus.T @ rows.T).T @ J
            is_determined = jnp.sum(free**2, axis=1) <= AT_REST.blocked * jnp.sum(rows**2, axis=1)
            a = units * (plus @ (constraints.gamma(self.mechanism, t, q, v) / analysis.row_units))
            speed, rate = jax.jvp(self.sliding_speeds, (q, v), (v, a))
            slow = AT_REST.closed * scales.rate * unit
            return is_determined & (jnp.abs(speed) <= slow) & (jnp.abs(rate) <= slow * scales.rate)

        return jax.vmap(at)(ts, q, v)
