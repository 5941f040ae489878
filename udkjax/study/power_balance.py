"""Balance of power along a motion: a check of accelerations, multipliers and velocities together.

With M a + Psi_q^T lambda = F and Psi_q v = -Psi_t the energies T and V change by

    d(T + V)/dt = sum of v . Q_e over loads + sum of dV_e/dt at fixed q over potentials + lambda . Psi_t,

the power of dampers, forces, torques and friction, of potentials that depend on time, and of drivers. Joints do no work. The left
side is the derivative of the energies along (v, a); the right side is computed from forces only.
"""

from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.argument_types import HISTORY
from udkjax.equations import constraints, loads
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.states.quantities import equations_of
from udkjax.equations.states.scene_changes import scene_along
from udkjax.pinv import SVD, Pseudoinverse
from udkjax.positions.assembling.channels import StateHistory
from udkjax.printing import PrintedTable, format_number, prints_table, units
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import at_each
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import Frame
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism


@prints_table
class PowerBalance(NamedTuple):
    """Powers (W) at each output time; `residual` is their imbalance.

    Attributes:
        drivers: power of each driver over time (W).
    """

    drivers: dict[str, Float[Array, "T"]]
    forces: dict[str, Float[Array, "T"]]  # power of dampers, loads, and potentials that depend on time
    joints: dict[str, Float[Array, "T"]]  # power on both bodies together: zero up to rounding and the velocity violation
    kinetic: Float[Array, "T"]  # dT/dt
    potential: Float[Array, "T"]  # dV/dt
    scale: Float[Array, ""]  # the mechanism's scale of powers, m L^2 / T^3

    _units = units(drivers="W", forces="W", joints="W", kinetic="W", potential="W", scale="W")

    def _table(self) -> PrintedTable:
        parts = {
            **{f"driver {name}": power for name, power in self.drivers.items()},
            **{f"force {name}": power for name, power in self.forces.items()},
            "rate of kinetic energy": self.kinetic,
            "rate of potential energy": self.potential,
            "supplied": self.supplied,
            "residual": self.residual,
        }
        size = max(float(np.nanmax(np.abs(power), initial=0.0)) for power in parts.values())
        rows = [(name, *(format_number(end(x), "W", size) for end in (np.nanmin, np.nanmax))) for name, x in parts.items()]
        rows.append(("residual / largest power", format_number(self.relative, scale=1.0), ""))
        return PrintedTable("power balance", rows, ("power", "minimum", "maximum"))

    @property
    def supplied(self) -> Float[Array, "T"]:
        """The power of drivers and force elements together."""
        return sum([*self.drivers.values(), *self.forces.values()], jnp.zeros_like(self.kinetic))

    @property
    def residual(self) -> Float[Array, "T"]:
        """d(T + V)/dt minus the supplied power."""
        return self.kinetic + self.potential - self.supplied

    @property
    def relative(self) -> Float[Array, ""]:
        """The largest residual, relative to its largest term or, if this is larger, the mechanism's scale of powers."""
        parts = [self.kinetic, self.potential, *self.drivers.values(), *self.forces.values(), self.scale]
        size = jnp.max(jnp.stack([jnp.max(jnp.abs(part)) for part in parts]))
        return jnp.max(jnp.abs(self.residual)) / jnp.where(size > 0, size, 1.0)


@checked
def power_balance(
    mechanism: Mechanism,
    solution: Annotated[StateHistory, HISTORY],
    method: Pseudoinverse | None = None,
    stabilization: Baumgarte | None = None,
) -> PowerBalance:
    """Return the power of each driver, force element and joint along a motion, and the rates of the energies.

    Args:
        mechanism: the mechanism.
        solution: ts (T,), q and v (T, bodies, 3).
        method: pseudoinverse; by default `SVD`.
        stabilization: the run's `Baumgarte`, to include its terms.

    Returns:
        The `PowerBalance` (W). Joints that events add, and contacts that may rest, are among its joints.
    """
    mechanism.require_masses("powers")
    flat = (len(solution.ts), -1)
    q, v = (jnp.asarray(x).reshape(flat) for x in (solution.q, solution.v))
    scene, method = scene_along(mechanism, solution), SVD() if method is None else method
    given = jnp.asarray(scene.ts), q, v, method, scene.gains(stabilization)
    by_row, by_force, by_joint, kinetic, potential = _powers(*scene[:3], *given)
    analysis, owners = scene.analysis, [name for name, _ in scene.analysis.row_names]
    names = {name: (name,) for name in mechanism.constraints} if scene.names is None else scene.names

    def total(values: Array, name: str) -> Array:
        return values[:, [k for k, owner in enumerate(owners) if owner in names[name]]].sum(1)

    return PowerBalance(
        drivers={name: total(by_row, name) for name in mechanism.driver_names},
        forces={name: by_force[:, k] for k, name in enumerate(scene.mechanism.force_names)},
        joints={name: total(by_joint, name) for name in names if name not in mechanism.driver_names},
        kinetic=kinetic,
        potential=potential,
        scale=analysis.mass * analysis.length**2 * analysis.scales.rate**3,
    )


@deferred
def _powers(mechanism, analysis, knowledge, ts, q, v, method, baumgarte):
    equations = equations_of(mechanism, method, baumgarte, analysis=analysis)

    def one(equations, t, q, v, known):
        equations = equations.known(known)
        mechanism = equations.mechanism
        a, multipliers = equations.motion(t, q, v)
        psi_t = jax.jvp(lambda t: constraints.psi(mechanism, t, q), (t,), (jnp.ones_like(t),))[1]
        kinetic = jax.jvp(lambda v: loads.kinetic_energy(mechanism, v), (v,), (a,))[1]
        potential = jax.jvp(lambda t, q: loads.potential_energy(mechanism, t, q, v), (t, q), (jnp.ones_like(t), v))[1]
        by_joint = -multipliers * (constraints.psi_q(mechanism, t, q) @ v)
        drags = equations.rubbing_powers(t, q, v, multipliers)
        return multipliers * psi_t, _force_powers(mechanism, t, q, v, drags), by_joint, kinetic, potential

    return at_each(one, equations, ts, q, v, knowledge.states(mechanism))


def _force_powers(mechanism: Mechanism, t: Array, q: Array, v: Array, drags: dict[str, Array]) -> Float[Array, "forces"]:
    """Return the power of each force element: the power of its loads, and of the explicit time dependence of its potential.

    `drags` are the powers of friction that depends on the loads of joints, by joint.
    """

    def power(element: ForceElement, *frames: Frame) -> Array:
        stated = element.loads(t, *frames)
        total = jnp.zeros(())
        for load, frame in zip(stated or (), frames, strict=bool(stated)):
            total = total + load[0] * frame.vx + load[1] * frame.vy + load[2] * frame.omega
        if element.potential(t, *frames) is None:
            return total
        return total + jax.grad(lambda t: jnp.asarray(element.potential(t, *frames), t.dtype))(t)

    by_element = jnp.zeros(len(mechanism.forces))
    for kind, powers in loads.evaluate_forces(power, mechanism, q, v):
        by_element = by_element.at[kind.members].set(powers)
    for k, force in enumerate(mechanism.forces.values()):
        if isinstance(force, Friction) and force.rubs:
            by_element = by_element.at[k].add(drags[force.joint])
    return by_element
