"""The run that the studio shows of a drawing: how long it lasts, and its curves of forces and energies."""

import math
from typing import Any

import numpy as np

from udkjax.equations import analyse, efforts, unique_reactions
from udkjax.integrate import Solution, simulate
from udkjax.scene import Driver, Mechanism, Polynomial
from udkjax.show.player.measure_curves import measures_of
from udkjax.study.reaction_peaks import pin_reactions

Json = dict[str, Any]
TURNS = 2  # of the slowest motor that a run shows
SWINGS = 12  # characteristic times that a run without a motor shows
INSTANTS = 401
DIGITS = 2  # of a duration
TOLERANCE = 1e-8  # of a run, relative


def duration_of(mechanism: Mechanism) -> float:
    """Return how long a run should be shown (s): turns of the slowest motor, or else swings."""
    rates = [
        abs(float(np.asarray(driver.motion.coefficients)[1]))
        for driver in mechanism.drivers.values()
        if driver.coordinate == "angle" and isinstance(driver.motion, Polynomial) and len(driver.motion.coefficients) == 2
    ]
    rates = [rate for rate in rates if rate > 0]
    exact = TURNS * 2 * math.pi / min(rates) if rates else SWINGS * float(analyse(mechanism).time)
    return float(f"{exact:.{DIGITS}g}")


def shown_run(mechanism: Mechanism) -> Solution:
    """Return the run that is shown; one that fails is as long as it came."""
    ts = np.linspace(0.0, duration_of(mechanism), INSTANTS)
    return simulate(mechanism, ts, rtol=TOLERANCE, atol=TOLERANCE, throw=False)


def recorded_motion(mechanism: Mechanism) -> Json:
    """Return the run as plain numbers: `q` and `v` of all bodies at `times`, and why it ended, where it did so too early."""
    run = shown_run(mechanism)
    q, v = np.asarray(run.q), np.asarray(run.v)
    alive = np.isfinite(q).all((1, 2)) & np.isfinite(v).all((1, 2))
    count = int(np.argmin(alive)) if not alive.all() else len(q)
    kept = {"times": np.asarray(run.ts)[:count], "q": q[:count].ravel(), "v": v[:count].ravel()}
    return {name: values.tolist() for name, values in kept.items()} | {"cause": run.cause if count < len(q) else ""}


def force_curves(mechanism: Mechanism) -> Json:
    """Return curves of the run that need forces: efforts of motors, forces at pins, energies, violation of the constraints.

    A value that is not a number is null. Of redundant constraints the forces are the share of least norm, and marked.
    """
    run = shown_run(mechanism)
    curves = []
    for name, effort in efforts(mechanism, run).items():
        driver = mechanism.drivers[name]
        curves.append(_curve(f"{name}: effort", "N m" if driver.coordinate == "angle" else "N", effort))
        curves.append(_curve(f"{name}: power", "W", np.asarray(effort) * _rate(driver, np.asarray(run.ts))))
    unique = unique_reactions(mechanism, run, about="joint")
    for pin, bodies in pin_reactions(mechanism, run).items():
        for body, load in bodies.items():
            if body == "ground":
                continue
            load = np.asarray(load)
            parts = [x[body] for name, x in unique.items() if body in x and (name == pin or name.startswith(f"{pin}-"))]
            known = all(bool(np.asarray(x)[np.isfinite(load[:, 0]), :2].all()) for x in parts)
            curves.append(_curve(f"{pin}: force on {body}", "N", np.hypot(load[:, 0], load[:, 1]), known))
    curves += [_curve(m.name, m.unit, m.values) for m in measures_of(mechanism, run, ("energy", "violation"), "")]
    return {"times": np.asarray(run.ts).tolist(), "curves": curves, "cause": run.cause}


def _rate(driver: Driver, ts: np.ndarray) -> np.ndarray:
    """Return the rate of a driver's coordinate (rad/s, m/s)."""
    import jax

    return np.asarray(jax.vmap(jax.grad(lambda t: driver.motion(t)))(ts))


def _curve(name: str, unit: str, values: Any, unique: bool = True) -> Json:
    numbers = [x if math.isfinite(x) else None for x in np.asarray(values, float).tolist()]
    return {"name": name, "unit": unit, "values": numbers, "unique": unique}
