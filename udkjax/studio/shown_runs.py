"""The run of a drawing that the studio shows: its duration, and its curves of forces and energies."""

import math
from typing import Any

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.equations.rows.analysis import analyse
from udkjax.equations.states.quantities import efforts
from udkjax.integrate import Result, Solution, simulate
from udkjax.integrate.causes.find import cause_of_standstill
from udkjax.positions.assembling.assembly import close
from udkjax.positions.assembling.channels import StateHistory
from udkjax.positions.following.drive import constant_speed, with_halted_drivers
from udkjax.scene.elements.drivers import Driver
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.show.player.marks.measure_curves import measures_of
from udkjax.statics.reaction_peaks import RestingPositions, pin_reactions, unique_pin_forces

MOTOR_TURNS = 2  # turns of the slowest motor in a run
FREE_SWINGS = 12  # duration of a run without motors, in characteristic times
STILL_SECONDS = 1.0  # s: duration of a run in which nothing moves
INSTANTS = 401  # output times of a run: two hundred per turn
DIGITS = 2  # significant digits of a duration
TOLERANCE = 1e-8  # rtol and atol of a run
FIRST_STEPS = 2_000  # of the first attempt at a run; two turns of a linkage take some hundred


def duration_of(mechanism: Mechanism) -> float:
    """Return the duration (s) of the run of a drawing, rounded to two digits.

    With motors, the slowest one turns twice, or moves across the mechanism; without, the run lasts some characteristic times.
    """
    scales, durations = analyse(mechanism), []
    for name, driver in mechanism.drivers.items():
        if (speed := constant_speed(mechanism, name)) != 0:
            durations.append((MOTOR_TURNS * 2 * math.pi if driver.coordinate == "angle" else float(scales.length)) / abs(speed))
    swing = float(scales.time)
    exact = max(durations) if durations else FREE_SWINGS * swing if math.isfinite(swing) else STILL_SECONDS
    return float(f"{exact:.{DIGITS}g}")


def shown_run(mechanism: Mechanism) -> Solution:
    """Return the run that is shown; a failed run has NaN from its failure on.

    Where a motor asks for more than the linkage can reach, a run would take its largest number of steps in vain. For this reason
    a run is first tried with few steps, and repeated with more if it reached this limit without being stopped by motors.
    """
    ts = np.linspace(0.0, duration_of(mechanism), INSTANTS)
    run = simulate(mechanism, ts, rtol=TOLERANCE, atol=TOLERANCE, max_steps=FIRST_STEPS, throw=False)
    if run.result != Result.step_limit or _is_stopped(mechanism, run):
        return run
    return simulate(mechanism, ts, rtol=TOLERANCE, atol=TOLERANCE, throw=False)


def _is_stopped(mechanism: Mechanism, run: Solution) -> bool:
    """Return True if motors stopped a run that reached its limit of steps."""
    ts, q, v = (np.asarray(x) for x in (run.ts, run.q, run.v))
    last = int(np.flatnonzero(np.isfinite(q).all((1, 2)))[-1])
    return bool(cause_of_standstill(mechanism, float(ts[-1]), (float(ts[last]), q[last], v[last]), float(run.time)))


def recorded_motion(mechanism: Mechanism) -> JsonObject:
    """Return the run as plain numbers: `q` and `v` of all bodies at `times`, until it ended.

    `cause` is the reason for an early end; "" for a complete run.
    """
    run = shown_run(mechanism)
    q, v = np.asarray(run.q), np.asarray(run.v)
    alive = np.isfinite(q).all((1, 2)) & np.isfinite(v).all((1, 2))
    count = int(np.argmin(alive)) if not alive.all() else len(q)
    arrays = {"times": np.asarray(run.ts)[:count], "q": q[:count].ravel(), "v": v[:count].ravel()}
    return {name: values.tolist() for name, values in arrays.items()} | {"cause": run.cause if count < len(q) else ""}


def force_curves(mechanism: Mechanism) -> JsonObject:
    """Return curves of the run: driving torques, forces and powers of motors, forces at pins, energies, constraint violation."""
    run = shown_run(mechanism)
    ts, effort_curves = np.asarray(run.ts), _efforts(mechanism, run, "driving")
    powers = [
        _curve(f"{n}: power", "W", np.asarray(x) * _rate(mechanism.drivers[n], ts)) for n, x in efforts(mechanism, run).items()
    ]
    measures = [_curve(m.name, m.unit, m.values) for m in measures_of(mechanism, run, ("energy", "violation"), "")]
    return {
        "times": ts.tolist(),
        "curves": [*effort_curves, *powers, *_pin_forces(mechanism, run), *measures],
        "cause": run.cause,
    }


def holding_curves(mechanism: Mechanism) -> JsonObject:
    """Return curves of the efforts of motors, and of forces at pins, that hold a mechanism at rest in each position of its run.

    Raises:
        SceneError: motors do not hold the whole mechanism.
    """
    if mobility_of(mechanism) > 0:
        cure = "put a motor on what still moves (Motor, M), or ask for the Equilibrium"
        raise SceneError([f"motors do not hold the whole mechanism at rest: {cure}"])
    run = shown_run(mechanism)
    halted = with_halted_drivers(mechanism, 0.0)
    positions = RestingPositions(run.ts, run.q, np.zeros_like(np.asarray(run.v)))
    curves = [*_efforts(halted, positions, "holding"), *_pin_forces(halted, positions)]
    return {"times": np.asarray(run.ts).tolist(), "curves": curves, "cause": run.cause}


def mobility_of(mechanism: Mechanism) -> int:
    """Return the number of degrees of freedom that no motor drives."""
    return 3 * len(mechanism.bodies) - int(close(mechanism, 0.0).rank)


def effort_name(name: str, driver: Driver, kind: str) -> str:
    """Return the name of the curve of a driver's "driving" or "holding" torque or force."""
    return f"{name}: {kind} {'torque' if driver.effort_unit == 'N m' else 'force'}"


def _efforts(mechanism: Mechanism, run: StateHistory, kind: str) -> list[JsonObject]:
    drivers = mechanism.drivers
    return [
        _curve(effort_name(name, drivers[name], kind), drivers[name].effort_unit, values)
        for name, values in efforts(mechanism, run).items()
    ]


def _pin_forces(mechanism: Mechanism, run: StateHistory) -> list[JsonObject]:
    """Return curves of the forces at pins; forces that are not unique, of which the minimum-norm values are shown, are marked."""
    unique = unique_pin_forces(mechanism, run)
    curves = []
    for pin, bodies in pin_reactions(mechanism, run).items():
        for body, load in bodies.items():
            x, y = np.asarray(load)[:, :2].T
            for part, values in (("force", np.hypot(x, y)), ("force x", x), ("force y", y)):
                curves.append(_curve(f"{pin}: {part} on {body}", "N", values, unique[pin][body]))
    return curves


def _rate(driver: Driver, ts: np.ndarray) -> np.ndarray:
    import jax

    return np.asarray(jax.vmap(jax.grad(lambda t: driver.motion(t)))(ts))


def _curve(name: str, unit: str, values: Any, unique: bool = True) -> JsonObject:
    """Return a curve as JSON, with null for NaN; `unique` is False for forces that redundant constraints share."""
    numbers = [x if math.isfinite(x) else None for x in np.asarray(values, float).tolist()]
    return {"name": name, "unit": unit, "values": numbers, "unique": unique}
