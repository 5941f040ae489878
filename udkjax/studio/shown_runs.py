"""The run that the studio shows of a drawing: how long it lasts, and its curves of forces and energies."""

import math
from typing import Any

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.equations import analyse, efforts
from udkjax.integrate import Solution, simulate
from udkjax.positions.assembly import close
from udkjax.positions.channels import StateHistory
from udkjax.positions.drive import constant_speed, with_halted_drivers
from udkjax.scene import Driver, Mechanism, SceneError
from udkjax.show.player.measure_curves import measures_of
from udkjax.statics.reaction_peaks import RestingPositions, pin_reactions, unique_pin_forces

TURNS = 2  # of the slowest motor that a run shows
SWINGS = 12  # characteristic times that a run without a motor shows
STILL = 1.0  # s: of a run in which no load and no motor moves anything
INSTANTS = 401  # of a run: two hundred of each of two turns
DIGITS = 2  # of a duration
TOLERANCE = 1e-8  # of a run, relative


def duration_of(mechanism: Mechanism) -> float:
    """Return the time of a run to show (s): turns of the slowest motor, or a slide's way across the mechanism, or else swings."""
    scales, ways = analyse(mechanism), []
    for name, driver in mechanism.drivers.items():
        if (speed := constant_speed(mechanism, name)) != 0:
            ways.append((TURNS * 2 * math.pi if driver.coordinate == "angle" else float(scales.length)) / abs(speed))
    swing = float(scales.time)
    exact = max(ways) if ways else SWINGS * swing if math.isfinite(swing) else STILL
    return float(f"{exact:.{DIGITS}g}")


def shown_run(mechanism: Mechanism) -> Solution:
    """Return the run that is shown; one that fails is as long as it came."""
    ts = np.linspace(0.0, duration_of(mechanism), INSTANTS)
    return simulate(mechanism, ts, rtol=TOLERANCE, atol=TOLERANCE, throw=False)


def recorded_motion(mechanism: Mechanism) -> JsonObject:
    """Return the run as plain numbers: `q` and `v` of all bodies at `times`, and why it ended, where it did so too early."""
    run = shown_run(mechanism)
    q, v = np.asarray(run.q), np.asarray(run.v)
    alive = np.isfinite(q).all((1, 2)) & np.isfinite(v).all((1, 2))
    count = int(np.argmin(alive)) if not alive.all() else len(q)
    kept = {"times": np.asarray(run.ts)[:count], "q": q[:count].ravel(), "v": v[:count].ravel()}
    return {name: values.tolist() for name, values in kept.items()} | {"cause": run.cause if count < len(q) else ""}


def force_curves(mechanism: Mechanism) -> JsonObject:
    """Return curves of the run that need forces: efforts and powers of motors, forces at pins; and energies and violation."""
    run = shown_run(mechanism)
    ts, found = np.asarray(run.ts), _efforts(mechanism, run)
    powers = [
        _curve(f"{n}: power", "W", np.asarray(x) * _rate(mechanism.drivers[n], ts)) for n, x in efforts(mechanism, run).items()
    ]
    measures = [_curve(m.name, m.unit, m.values) for m in measures_of(mechanism, run, ("energy", "violation"), "")]
    return {"times": ts.tolist(), "curves": [*found, *powers, *_pin_forces(mechanism, run), *measures], "cause": run.cause}


def holding_curves(mechanism: Mechanism) -> JsonObject:
    """Return curves of what holds a mechanism still in each position of its run: efforts of motors and forces at pins.

    Raises:
        SceneError: motors do not hold all of it.
    """
    if mobility_of(mechanism) > 0:
        raise SceneError(["motors do not hold all of it still: what they leave free, loads would move"])
    run = shown_run(mechanism)
    held = with_halted_drivers(mechanism, 0.0)
    rest = RestingPositions(run.ts, run.q, np.zeros_like(np.asarray(run.v)))
    curves = [*_efforts(held, rest), *_pin_forces(held, rest)]
    return {"times": np.asarray(run.ts).tolist(), "curves": curves, "cause": run.cause}


def mobility_of(mechanism: Mechanism) -> int:
    """Return the number of degrees of freedom that the motors leave."""
    return 3 * len(mechanism.bodies) - int(close(mechanism, 0.0).rank)


def _efforts(mechanism: Mechanism, run: StateHistory) -> list[JsonObject]:
    drivers = mechanism.drivers
    return [_curve(f"{name}: effort", drivers[name].effort_unit, effort) for name, effort in efforts(mechanism, run).items()]


def _pin_forces(mechanism: Mechanism, run: StateHistory) -> list[JsonObject]:
    """Return curves of the forces at pins; of redundant constraints they are the share of least norm, and marked."""
    known = unique_pin_forces(mechanism, run)
    return [
        _curve(f"{pin}: force on {body}", "N", np.hypot(*np.asarray(load)[:, :2].T), known[pin][body])
        for pin, bodies in pin_reactions(mechanism, run).items()
        for body, load in bodies.items()
    ]


def _rate(driver: Driver, ts: np.ndarray) -> np.ndarray:
    """Return the rate of a driver's coordinate (rad/s, m/s)."""
    import jax

    return np.asarray(jax.vmap(jax.grad(lambda t: driver.motion(t)))(ts))


def _curve(name: str, unit: str, values: Any, unique: bool = True) -> JsonObject:
    """Return a curve; a value that is not a number is null."""
    numbers = [x if math.isfinite(x) else None for x in np.asarray(values, float).tolist()]
    return {"name": name, "unit": unit, "values": numbers, "unique": unique}
