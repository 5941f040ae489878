"""Inverse dynamics: driver torques and forces for a prescribed motion, with closed loops and redundant actuation.

A driver's row of Psi is c(q) - motion(t), so the generalized force that it exerts along its coordinate c is f = -lambda. With
the joints' rows J and the drivers' rows C of Psi_q, the equation of motion is

    M a - F = J^T mu + C^T f.

The joints carry any force in the range of J^T; the drivers must supply the rest. With N a basis of the null space of J,
N^T (M a - F) = (C N)^T f: one equation for each degree of freedom. If there are more drivers than degrees of freedom, f is the
solution with the least sum_i w_i f_i^2.

F includes smooth and set-valued friction; where friction depends on joint loads, these are computed with mu of least norm.
Set-valued friction is zero in a joint at rest (`holding_efforts` gives its bounds), and in a joint that starts from rest it
opposes the acceleration of sliding.

Where branches meet, N has another column, along the other branch, in which the joints carry load, too; with one degree of
freedom, N is therefore replaced by the direction v of the motion.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import Annotated, Any, Literal, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from udkjax.annotations import NumberLike
from udkjax.argument_types import NUMBERS_BY_NAME, TIMES, ArgumentRequirement, of_kind, require_history
from udkjax.arrays import is_traced, is_within_jit, library_for, make_module, number, number_called, put_arrays
from udkjax.equations.rows.analysis import analyse
from udkjax.positions.assembling.channels import StateHistory
from udkjax.positions.assembling.coordinates import Coordinate, element_of
from udkjax.positions.following.drive import without_drivers
from udkjax.positions.following.kinematics import Kinematics, motion_in_time
from udkjax.printing import PrintedTable, PrintsTable, fields_table, format_number, units
from udkjax.requirements import ArgumentError, ArgumentTypeError, GivenArguments
from udkjax.scene.arguments import checked
from udkjax.scene.elements.drivers import Motion, Spline
from udkjax.scene.elements.fields import CALLED
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.study.driver_efforts import driver_efforts, elements_of
from udkjax.wording import article, free_name, quote


class InverseDynamics(PrintsTable):
    """Efforts (torques or forces) of drivers along their coordinates for a prescribed motion; NaN where undetermined.

    Efforts are undetermined where the motion is impossible, where its velocities are undetermined, and where branches meet in a
    mechanism with more than one degree of freedom.
    """

    ts: Float[Array, "T"]  # s
    motion: Kinematics | None  # None if the motion was given
    efforts: dict[str, Float[Array, "T"]]  # by driver: torque (N m) along an angle, force (N) along a length
    powers: dict[str, Float[Array, "T"]]  # effort times the coordinate's rate (W)
    residual: Float[Array, "T"]  # largest part of M a - F that neither joints nor drivers exert, relative to M a and the loads
    effort_units: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())  # unit of each driver's effort

    _units = units(ts="s", efforts="N m or N", powers="W")

    def _table(self) -> PrintedTable:
        if np.ndim(self.ts) != 1:
            return fields_table(self, self._units, "inverse dynamics, batched")
        ts, rows = np.asarray(self.ts), []
        for name, effort in self.efforts.items():
            x = np.asarray(effort)
            if not np.isfinite(x).any():
                rows.append((name, "the motion is not possible", "", "", "", ""))
                continue
            k, mean_square = int(np.nanargmax(np.abs(x))), np.nanmean(x**2)
            power = np.asarray(self.powers[name])
            span = " to ".join(format_number(end(power)) for end in (np.nanmin, np.nanmax))
            unit, largest = dict(self.effort_units).get(name, "N m or N"), float(np.nanmax(np.abs(power))) * float(np.ptp(ts))
            energies = (format_number(work[name], "J", largest) for work in (self.works, self.swings))
            peak, mean = format_number(x[k], unit), format_number(math.sqrt(mean_square), unit)
            rows.append((name, f"{peak} at {ts[k]:.6g} s", mean, f"{span} W", *energies))
        unbalanced = float(np.nanmax(np.asarray(self.residual), initial=0.0))
        rows.append(("unbalanced", f"{format_number(unbalanced, scale=1.0)} of the loads", "", "", "", ""))
        heads = "driver", "peak effort", "rms effort", "power", "work", "energy swing"
        return PrintedTable(f"inverse dynamics at {len(ts)} times from {ts[0]:g} to {ts[-1]:g} s", rows, heads)

    @property
    def determined(self) -> Bool[Array, "T"]:
        """Mask of the times at which the efforts are determined."""
        return jnp.all(jnp.isfinite(jnp.stack(list(self.efforts.values()))), 0)

    @property
    def works(self) -> dict[str, Float[Array, ""]]:
        """Work (J) of each driver over all times, by the trapezoidal rule."""
        return {name: jnp.trapezoid(power, self.ts) for name, power in self.powers.items()}

    @property
    def swings(self) -> dict[str, Float[Array, ""]]:
        """Range (J) of each driver's work minus the work of its mean power, by the trapezoidal rule.

        Over whole cycles, this is the energy that a flywheel must store: an inertia of swing / (k w^2) limits the variation of
        the speed w to k w.
        """
        steps, swings = jnp.diff(self.ts), {}
        for name, power in self.powers.items():
            energy = jnp.concatenate([jnp.zeros(1), jnp.cumsum(0.5 * steps * (power[1:] + power[:-1]))])
            swings[name] = jnp.ptp(energy - energy[-1] * (self.ts - self.ts[0]) / (self.ts[-1] - self.ts[0]))
        return swings

    @property
    def power(self) -> Float[Array, "T"]:
        """Power (W) of all drivers together."""
        return sum(self.powers.values(), jnp.zeros_like(self.ts))


class AcceleratedTrajectory(StateHistory, Protocol):
    """A trajectory with accelerations a (T, bodies, 3), such as a `Kinematics`."""

    @property
    def a(self) -> Array: ...


class Effort(ForceElement):
    """A torque (N m) or force (N) along a coordinate of two bodies; its power is the effort times the coordinate's rate.

    Args:
        bodies: the names of the two bodies.
        coordinate: kind of the coordinate: "angle", "x", "y" or "distance".
        law: the torque or force as a function of time (s).
        points: attachment points, each in the frame of its body (m); by default the origins.
        axis: for x and y, the direction of x in body 1's frame (rad); by default that of the frame's x axis.
    """

    coordinate: Literal["angle", "x", "y", "distance"] = eqx.field(static=True)
    law: Motion = eqx.field(metadata=CALLED)
    points: Float[Array, "2 2"] | None = eqx.field(converter=number_called("points", optional=True), default=None)
    axis: Float[Array, ""] | None = eqx.field(converter=number_called("axis", optional=True), default=None)

    def potential(self, t, *frames):
        return -self.law(t) * Coordinate(self.bodies, self.coordinate, self.points, self.axis).value(*frames)

    @property
    def breakpoints(self):
        return self.law.breakpoints


DRIVERS = ArgumentRequirement(
    "names of drivers",
    of_kind(
        "be a list of names",
        lambda x: (
            not isinstance(x, str | np.ndarray | Mapping)
            and isinstance(x, Sequence)
            and all(isinstance(name, str | Coordinate) for name in x)
        ),
    ),
)


def require_accelerated_history(name: str, value: Any, given: GivenArguments) -> None:
    """Require that an argument has times, states and accelerations, as a `Kinematics` has."""
    require_history(name, value, given)
    if not hasattr(value, "a"):
        kind = type(value).__name__
        raise ArgumentTypeError(
            f"{name} must have accelerations a (T, bodies, 3), as a Kinematics; {article(kind)} {kind} has none: "
            "compute them, by udkjax.accelerations at each state of a run, and give an object with ts, q, v and a"
        )
    shapes = [np.shape(x) for x in (value.a, value.q)]
    if shapes[0] != shapes[1]:
        raise ArgumentError(f"{name}.a must have the shape of {name}.q, {shapes[1]}, not {shapes[0]}")


ACCELERATED_HISTORY = ArgumentRequirement("times, states and accelerations of the mechanism", require_accelerated_history)


@checked
def inverse_dynamics(
    mechanism: Mechanism,
    ts: Annotated[Float[ArrayLike, "T"] | Sequence[float], TIMES],
    motion: Annotated[AcceleratedTrajectory, ACCELERATED_HISTORY] | None = None,
    drivers: Annotated[Sequence[str | Coordinate], DRIVERS] | None = None,
    weights: Annotated[Mapping[str, NumberLike], NUMBERS_BY_NAME] | None = None,
) -> InverseDynamics:
    """Compute the efforts of drivers at the times ts (s) for a prescribed motion: M a - F = J^T mu + C^T f.

    The function is pure and batched by `vmap`, with exact derivatives with respect to every number of the mechanism, including
    those of the motion.

    Args:
        mechanism: mechanism whose drivers prescribe the motion unless `motion` does; F are its force elements and gravity.
        ts: times (s).
        motion: a trajectory with q, v and a (T, bodies, 3); by default that of all drivers, by `kinematics`.
        drivers: drivers or coordinates that exert efforts, each a name (`motor`, `body.crank.angle`) or a `Coordinate`; by
            default the scene's drivers. If there are more drivers than degrees of freedom, the efforts have least weighted norm.
        weights: weight w_i > 0 of each driver's squared effort, by name; by default 1.

    Returns:
        An `InverseDynamics`: efforts and powers (T,) by driver, and the unbalanced part of the loads.

    Raises:
        SceneError: there are no drivers, or a name is unknown.
        ValueError: the number of states of `motion` differs from that of `ts`.
    """
    mechanism.require_masses("efforts")
    times: Any = number(ts) if is_traced(ts) else np.array(ts, float)
    computed = None
    if motion is None and not mechanism.drivers and analyse(mechanism).degrees_of_freedom != 0:
        raise SceneError(["motion is None, and the scene has no driver that prescribes a motion"], mechanism.name)
    if motion is None:
        motion = computed = motion_in_time(mechanism, times)
    chosen = list(mechanism.driver_names) if drivers is None else list(drivers)
    if not chosen:
        raise SceneError(["drivers: the scene has none; name coordinates to drive, such as body.crank.angle"], mechanism.name)
    named = {d if isinstance(d, str) else f"{d.coordinate} of {' and '.join(d.bodies)}": d for d in chosen}
    unknown = [name for name in weights or {} if name not in named]
    if unknown:
        raise SceneError([f"weights: {quote(name)} is not among the drivers" for name in unknown], mechanism.name)
    xp = library_for((weights, times))
    w = xp.stack([xp.asarray((weights or {}).get(name, 1.0), float) for name in named])
    values = elements_of(mechanism, *named.values())
    joints, q = without_drivers(mechanism), motion.q
    if len(q) != len(times):
        raise ValueError(f"motion has {len(q)} states, but ts has {len(times)} times: give the times of the motion")
    efforts, rates, residual = driver_efforts(joints, analyse(joints), values, w, times, (q, motion.v, motion.a))
    columns = dict(zip(named, efforts, strict=True))
    powers = {name: x * rate for (name, x), rate in zip(columns.items(), rates, strict=True)}
    parts: dict[str, Any] = {"ts": times, "motion": computed, "efforts": columns, "powers": powers, "residual": residual}
    with jax.ensure_compile_time_eval() if is_within_jit() else nullcontext():  # concrete numbers stay concrete
        parts = _put_concrete(parts) if is_traced(parts) else put_arrays(parts)
    effort_units = tuple((name, value.effort_unit) for name, value in zip(named, values, strict=True))
    return make_module(InverseDynamics, **parts, effort_units=effort_units)


def _put_concrete(parts: Mapping[str, Any]) -> dict[str, Any]:
    return {name: part if is_traced(part) else put_arrays(part) for name, part in parts.items()}


@checked
def feed_forward(mechanism: Mechanism, found: InverseDynamics) -> Mechanism:
    """Return the mechanism with its drivers replaced by force elements that exert these efforts as natural cubic splines.

    Simulated from a state of the prescribed motion, the mechanism follows this motion. Errors of the splines are O(h^4) in the
    time h between knots, and O(h^2) near their ends. Therefore begin the times a dozen knots before the run, and end them a
    dozen knots after it.

    Args:
        mechanism: the mechanism of `found`.
        found: the result of `inverse_dynamics`, determined at all times.

    Returns:
        The mechanism without drivers, with one force element for each effort.

    Raises:
        ValueError: an effort is undetermined at some time.
    """
    mechanism.require_masses("efforts")
    if not is_traced((found.ts, found.determined)) and not np.all(found.determined):
        t = float(found.ts[int(np.argmin(found.determined))])
        raise ValueError(
            f"the efforts of the drivers are not determined at {t:g} s: leave out the times where `found.determined` is False"
        )
    elements = {name: element_of(mechanism, name) for name in found.efforts}
    forces = dict(mechanism.forces)
    for name, effort in found.efforts.items():
        e = elements[name]
        forces[free_name(f"{name} effort", forces)] = Effort(e.bodies, e.coordinate, Spline(found.ts, effort), e.points, e.axis)
    return without_drivers(mechanism, forces)
