"""Peaks and mean squares of reactions over a run, and their envelopes over load cases.

A peak between two outputs is that of the parabola through the largest of |F| and its neighbours,

    |F|_max = y_1 - (y_2 - y_0)^2 / (8 (y_2 - 2 y_1 + y_0)),

which is accurate to third order in the output step, and whose derivative is that of the motion at the instant of the peak. Peaks
and envelopes are pure functions: they can be differentiated through `simulate`, and batched by `jax.vmap`.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udkjax.argument_types import HISTORY
from udkjax.equations.states.reactions import reactions, unique_reactions
from udkjax.positions.assembling.channels import StateHistory, has_point
from udkjax.printing import prints_table, units
from udkjax.programs.deferred import deferred
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Cam, Revolute
from udkjax.scene.mechanism import Mechanism

UNITS = units(force="N", rms_force="N", torque="N m", rms_torque="N m", force_time="s", torque_time="s")


@prints_table
class Peak(NamedTuple):
    """Largest force and torque of one joint on one body over a run, their times, and the root mean squares."""

    force: Float[Array, ""]  # |(fx, fy)| (N)
    force_time: Float[Array, ""]  # s
    torque: Float[Array, ""]  # |torque| (N m)
    torque_time: Float[Array, ""]  # s
    rms_force: Float[Array, ""]  # N
    rms_torque: Float[Array, ""]  # N m

    _units = UNITS


@prints_table
class Envelope(NamedTuple):
    """Largest peaks of one joint on one body over load cases, and the case in which each occurs."""

    force: Float[Array, ""]  # N
    force_case: Int[Array, ""]
    force_time: Float[Array, ""]  # s
    torque: Float[Array, ""]  # N m
    torque_case: Int[Array, ""]
    torque_time: Float[Array, ""]  # s

    _units = UNITS


Peaks = dict[str, dict[str, Peak]]  # by joint or driver, and body


class RestingPositions(NamedTuple):
    """Positions of rest in the form of a motion: times (T,), q and zero velocities v (T, bodies, 3)."""

    ts: Any
    q: Any
    v: Any


@checked
def reaction_peaks(mechanism: Mechanism, solution: Annotated[StateHistory, HISTORY], **choices: Any) -> Peaks:
    """Return the peaks and root mean squares of all reactions over a run.

    Args:
        mechanism: the mechanism.
        solution: ts (T,), q and v (T, bodies, 3), T at least 3.
        **choices: those of `reactions`: frame, about, compliances, method, stabilization. `about` is the point of the torque,
            here "joint" by default.

    Returns:
        A `Peak` for each joint and body, `reaction_peaks(mech, sol)["A"]["link1"].force`; NaN for a run that failed.

    Raises:
        ValueError: fewer than three output times.
    """
    mechanism.require_masses("reactions")
    ts = jnp.asarray(solution.ts)
    if len(ts) < 3:
        raise ValueError(f"a peak needs at least 3 output times, not {len(ts)}")
    loads_of_joint = reactions(mechanism, solution, **{"about": "joint", **choices})
    peaks = iter(_peaks(ts, [load for loads in loads_of_joint.values() for load in loads.values()]))
    return {name: {body: next(peaks) for body in loads} for name, loads in loads_of_joint.items()}


@checked
def pin_reactions(
    mechanism: Mechanism, solution: Annotated[StateHistory, HISTORY], **choices: Any
) -> dict[str, dict[str, Float[Array, "T 3"]]]:
    """Return the load at each pin on each of its bodies, in ground axes: `pin_reactions(mech, sol)["B"]["coupler"]`.

    Where k bodies share a pin, k - 1 joints, such as B, B-2, connect them: their loads on one body are added up.

    Args:
        mechanism: the mechanism.
        solution: ts (T,), q and v (T, bodies, 3).
        **choices: those of `reactions`: method, stabilization, compliances.

    Returns:
        Force x, force y (N), and the torque (N m) about the pin (T, 3), by pin and body. Joints without a point have no pin.
    """
    mechanism.require_masses("reactions")
    by_pin: dict[str, dict[str, Array]] = {}
    loads = reactions(mechanism, solution, **{"about": "joint", **choices})
    for name, joint in mechanism.joints.items():
        if has_point(joint):
            of_pin = by_pin.setdefault(_pin_of(mechanism, name), {})
            for body, load in loads[name].items():
                of_pin[body] = of_pin[body] + load if body in of_pin else load
    return by_pin


def unique_pin_forces(mechanism: Mechanism, solution: StateHistory) -> dict[str, dict[str, bool]]:
    """Return True, by pin and body, if equilibrium alone determines the force at all times that are reached, else False.

    See `unique_reactions`.
    """
    by_pin: dict[str, dict[str, bool]] = {}
    unique, is_reached = unique_reactions(mechanism, solution), np.isfinite(np.asarray(solution.q)).all((1, 2))
    for name, joint in mechanism.joints.items():
        if has_point(joint):
            of_pin = by_pin.setdefault(_pin_of(mechanism, name), {})
            for body, is_unique in unique[name].items():
                of_pin[body] = of_pin.get(body, True) and bool(np.asarray(is_unique)[is_reached, :2].all())
    return by_pin


def cam_forces(mechanism: Mechanism, solution: StateHistory) -> dict[str, Float[np.ndarray, "T"]]:
    """Return the force (N) with which each cam presses on its follower, along the normal of the profile.

    A `Cam` can also pull. Where the force is negative, the cam pulls, and a real follower without a groove would leave the
    profile.
    """
    forces, q = {}, np.asarray(solution.q)
    cams = {name: joint for name, joint in mechanism.joints.items() if isinstance(joint, Cam)}
    loads = reactions(mechanism, solution) if cams else {}

    def place(body: str, point: Array) -> np.ndarray:
        x, y, angle = (0.0, 0.0, 0.0) if body == GROUND else q[:, mechanism.body_names.index(body)].T
        position = np.exp(1j * angle) * complex(*point) + x + 1j * y
        return np.broadcast_to(position, len(q))

    for name, cam in cams.items():
        centre, follower = (place(body, point) for body, point in zip(cam.bodies, np.asarray(cam.points), strict=True))
        body_on, sign = (cam.bodies[1], 1.0) if cam.bodies[1] != GROUND else (cam.bodies[0], -1.0)
        fx, fy = np.asarray(loads[name][body_on])[:, :2].T
        outwards = ((fx + 1j * fy) * np.conj(follower - centre)).real
        forces[name] = sign * np.copysign(np.hypot(fx, fy), outwards)
    return forces


def _pin_of(mechanism: Mechanism, joint: str) -> str:
    """Return the name of the pin of a joint: that of the first joint there, without the number that drawings append to others."""
    base, _, number = joint.rpartition("-")
    pair = [mechanism.joints.get(name) for name in (base, joint)]
    return base if number.isdigit() and all(isinstance(joint_of_pair, Revolute) for joint_of_pair in pair) else joint


@checked
def envelope(cases: Peaks | Sequence[Peaks]) -> dict[str, dict[str, Envelope]]:
    """Return the largest peaks over load cases, ignoring cases that failed.

    Args:
        cases: the peaks of each case as a sequence, or of a batch, as `jax.vmap(reaction_peaks)` returns them, with the cases as
            the first axis.

    Returns:
        An `Envelope` for each joint and body: the largest force (N) and torque (N m), with their cases and times (s).
    """
    batch: Peaks = cases if isinstance(cases, Mapping) else jax.tree.map(lambda *xs: jnp.stack(xs), *cases)
    return {name: {body: _envelope(peak) for body, peak in loads.items()} for name, loads in batch.items()}


@deferred
def _peaks(ts: Array, loads: Sequence[Float[Array, "T 3"]]) -> list[Peak]:
    if not loads:
        return []
    found = jax.vmap(_peak, in_axes=(None, 0))(ts, jnp.stack(loads))
    return [jax.tree.map(lambda x, k=k: x[k], found) for k in range(len(loads))]


def _peak(ts: Array, load: Float[Array, "T 3"]) -> Peak:
    square = load[:, 0] ** 2 + load[:, 1] ** 2
    force = jnp.where(square == 0.0, 0.0, jnp.sqrt(jnp.where(square == 0.0, 1.0, square)))  # with a finite derivative at zero
    torque = jnp.abs(load[:, 2])
    return Peak(*_largest(ts, force), *_largest(ts, torque), *(_root_mean_square(ts, x) for x in (square, load[:, 2] ** 2)))


def _largest(ts: Array, y: Float[Array, "T"]) -> tuple[Array, Array]:
    """Return the peak and its time, by the parabola through the largest sample and its neighbours; at an end, the sample."""
    top = jnp.argmax(y)
    middle = jnp.clip(top, 1, len(y) - 2)
    before, centre, after = y[middle - 1], y[middle], y[middle + 1]
    left, right = ts[middle] - ts[middle - 1], ts[middle + 1] - ts[middle]
    # y = centre + slope s + bend s^2, with s from the middle
    bend = ((after - centre) / right - (centre - before) / left) / (left + right)
    slope = (centre - before) / left + bend * left
    inside = (top == middle) & (bend < 0)
    shift = jnp.where(inside, -slope / (2 * jnp.where(inside, bend, -1.0)), 0.0)
    return jnp.where(inside, centre + slope * shift / 2, y[top]), jnp.where(inside, ts[middle] + shift, ts[top])


def _root_mean_square(ts: Array, square: Float[Array, "T"]) -> Array:
    """Return the root of the mean over time, by the trapezoidal rule."""
    mean = jnp.sum((square[1:] + square[:-1]) * jnp.diff(ts)) / (2 * (ts[-1] - ts[0]))
    return jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1.0)), 0.0 * mean)


def _envelope(peak: Peak) -> Envelope:
    def top(values: Array, times: Array) -> tuple[Array, Array, Array]:
        if np.ndim(values) != 1:
            shape = np.shape(values)
            raise ValueError(
                f"cases must be the first and only axis of each peak, as jax.vmap(reaction_peaks) returns them: {shape}"
            )
        case = jnp.argmax(jnp.where(jnp.isnan(values), -jnp.inf, values))
        return values[case], case, times[case]

    return Envelope(*top(peak.force, peak.force_time), *top(peak.torque, peak.torque_time))
