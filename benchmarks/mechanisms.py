"""An engineer's tasks: positions over a turn, torques, equilibrium; compared with scripts by SciPy, and pylinkage."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import fsolve, minimize_scalar

import udkjax as udk
from benchmarks.common import cpu_seconds, in_turn
from udkjax.positions.following.drive import drive
from udkjax.positions.following.march import march

CRANK, COUPLER, ROCKER, GROUND = 0.5, 1.2, 0.8, 1.0
START, TURN = math.pi / 3, 2 * math.pi
INPUT, JOINT = "body.crank.angle", "joint.D.points[0][0]"
POINTS = [f"joint.{name}.points" for name in "ABCD"]  # sixteen numbers: the points of each pin on both of its links
MEMBERS, VALUES, ROUNDS = 2000, 360, 5
TOLERANCE = 1e-12  # m and rad: tolerance within which all candidates must agree


def linkage() -> udk.Mechanism:
    """Return the crank-rocker that all candidates solve."""
    return udk.library.four_bar(START, lengths=(CRANK, COUPLER, ROCKER), ground=GROUND)


def rocker(angle: np.ndarray, ground: Any = GROUND) -> np.ndarray:
    """Return the angle of the rocker in closed form."""
    x, y = ground - CRANK * np.cos(angle), -CRANK * np.sin(angle)
    square = x**2 + y**2
    return np.arctan2(-y, -x) - np.arccos((square + ROCKER**2 - COUPLER**2) / (2 * np.sqrt(square) * ROCKER))


def by_fsolve(values: np.ndarray) -> np.ndarray:
    """Solve the loop of two angles by SciPy from value to value."""

    def loop(x: np.ndarray, s: float) -> list[float]:
        return [
            CRANK * math.cos(s) + COUPLER * math.cos(x[0]) - GROUND - ROCKER * math.cos(x[1]),
            CRANK * math.sin(s) + COUPLER * math.sin(x[0]) - ROCKER * math.sin(x[1]),
        ]

    q = linkage().q0
    x, found = np.array([float(q[1, 2]), float(q[2, 2])]), []
    for s in values:
        x = fsolve(loop, x, (s,), xtol=1e-12)
        found.append(x[1])
    return np.array(found)


def by_pylinkage(values: np.ndarray) -> float | None:
    """Return the CPU time (s) of a closed position of the same linkage by pylinkage's compiled solver; None if not installed.

    It runs in a process of its own, by the Python that `PYLINKAGE` names, by default this one.
    """
    numbers = (CRANK, COUPLER, ROCKER, GROUND, values[0], len(values))
    command = [os.environ.get("PYLINKAGE", sys.executable), str(Path(__file__).with_name("pylinkage_positions.py"))]
    done = subprocess.run([*command, *map(str, numbers)], capture_output=True, text=True, check=False)
    if done.returncode:
        return None
    found = json.loads(done.stdout)
    step = TURN / len(values)
    exact = GROUND + ROCKER * np.cos(rocker(values[0] + step * np.arange(1, len(values) + 1)))
    apart = np.max(np.abs(np.array(found["pin"])[:, 0] - exact))
    assert apart < 1e-9, f"pylinkage solves another linkage: {apart:.1e} m"
    return found["seconds"]


def timed(run: Callable[[], Any], least: float = 0.05) -> Callable[[], float]:
    """Return a function that measures a call once it is compiled (CPU s); JAX is waited for."""
    jax.block_until_ready(run())
    return lambda: cpu_seconds(lambda: jax.block_until_ready(run()), least)


def positions(smoke: bool) -> list[dict[str, Any]]:
    """Measure closed positions per second and core: of a batch of four-bars with other grounds, and of one."""
    members, rounds = (16, 1) if smoke else (MEMBERS, ROUNDS)
    mech, values = linkage(), START + np.linspace(0.0, TURN, VALUES)
    grounds = jnp.linspace(0.95, 1.05, members)

    def solved(g: Any) -> Any:
        changed = mech.with_parameters({JOINT: g})
        driven, q = drive(changed, INPUT), jnp.ravel(udk.assemble(changed).q)
        return march(driven.mechanism, driven.analysis, driven.unit, driven.value(q), q, values)

    batch = jax.jit(jax.vmap(solved))
    found = batch(grounds)
    assert np.all(np.asarray(found.trusted) == VALUES)
    exact = rocker(values, np.asarray(grounds)[:, None])
    assert np.max(np.abs(np.sin((np.asarray(found.q)[:, :, 8] - exact) / 2))) < TOLERANCE

    def public(g: Any) -> Any:
        return udk.kinematics(mech.with_parameters({JOINT: g}), INPUT, values)

    whole = jax.jit(jax.vmap(public))
    assert np.all(np.asarray(whole(grounds).status) == 0)
    moved = jax.jit(jax.vmap(lambda g: jax.jvp(lambda g: public(g).q, (g,), (1.0,))))
    np.asarray(moved(grounds)[1])
    lone, along = (udk.PositionBatch(mech, INPUT, names, derivatives=d) for names, d in (([JOINT], False), (POINTS, True)))
    given = {JOINT: np.asarray(grounds)}
    few = min(members, 50)  # 26 MB of derivatives: allocating fresh memory takes longer than filling it
    pins = {name: np.repeat(np.asarray(mech.parameters()[name])[None], few, 0) for name in POINTS}
    assert np.max(np.abs(np.sin((lone(given, values).q[:, :, 2, 2] - exact) / 2))) < TOLERANCE
    candidates = {
        "udkjax: PositionBatch": (lambda: lone(given, values, threads=1), members * VALUES),
        "udkjax: PositionBatch, derivatives with respect to all pins": (lambda: along(pins, values, threads=1), few * VALUES),
        "udkjax: q, q', q'' in a batch": (lambda: batch(grounds), members * VALUES),
        "udkjax: kinematics() in a batch": (lambda: whole(grounds), members * VALUES),
        "udkjax: and a derivative by a length": (lambda: moved(grounds), members * VALUES),
        "udkjax: kinematics() of one": (lambda: udk.kinematics(mech, INPUT, values), VALUES),
        "NumPy, closed form": (lambda: rocker(np.tile(values, members)), members * VALUES),
        "SciPy's fsolve": (lambda: by_fsolve(values), VALUES),
    }
    times = in_turn({name: timed(run) for name, (run, _) in candidates.items()}, rounds)
    rates = {name: float(np.median([candidates[name][1] / s for s in seconds])) for name, seconds in times.items()}
    other = by_pylinkage(values)
    if other is not None:
        rates["pylinkage, one"] = 1 / other
    for name, rate in rates.items():
        print(f"{name:40} {rate:14,.0f} closed positions per second and core")
    return [{"name": name, "per_second": rate} for name, rate in rates.items()]


def rest(smoke: bool) -> list[dict[str, Any]]:
    """Measure the equilibrium of the four-bar under gravity, and its frequency: warm, and a minimization over one coordinate."""
    mech = linkage()

    def height(s: float) -> float:
        angle = float(rocker(np.array([s]))[0])
        end = np.array([CRANK * math.cos(s), CRANK * math.sin(s)])
        pin = np.array([GROUND + ROCKER * math.cos(angle), ROCKER * math.sin(angle)])
        return CRANK * end[1] / 2 + COUPLER * (end[1] + pin[1]) / 2 + ROCKER * pin[1] / 2

    def script() -> float:
        return minimize_scalar(height, bounds=(near - 0.05, near + 0.07), method="bounded", options={"xatol": 1e-12}).x

    def ours() -> Any:
        return udk.equilibrium(mech, stable=True).q

    near = float(ours()[0, 2])
    turned = (near - script()) / 2
    assert abs(math.sin(turned)) < 1e-6  # a minimum of a function is known to the root of rounding
    state = udk.equilibrium(mech, stable=True).state
    runs = {
        "udkjax: equilibrium": ours,
        "SciPy: minimum of one coordinate": script,
        "udkjax: modes": lambda: udk.modes(mech, state).omega2,
    }
    times = in_turn({name: timed(run) for name, run in runs.items()}, 1 if smoke else ROUNDS)
    rows = [{"name": name, "ms": 1e3 * float(np.median(seconds))} for name, seconds in times.items()]
    for row in rows:
        print(f"{row['name']:40} {row['ms']:14.3f} ms")
    return rows


def torque(smoke: bool) -> list[dict[str, Any]]:
    """Measure the torque of a slider-crank at 1,000 instants, warm, and Lagrange's equation of one coordinate by differences."""
    count = 20 if smoke else 1000
    mech, ts = udk.library.slider_crank(0.3, 4.0), np.linspace(0.0, 1.5, count)

    def pose(s: np.ndarray) -> np.ndarray:
        tilt = -np.arcsin(0.5 * np.sin(s) / 1.5)
        x, y = 0.5 * np.cos(s), 0.5 * np.sin(s)
        rows = (x / 2, y / 2, s, x + 0.75 * np.cos(tilt), y + 0.75 * np.sin(tilt), tilt, x + 1.5 * np.cos(tilt))
        return np.stack(rows)

    masses = np.array([1.0, 1.0, 0.25 / 12, 1.5, 1.5, 1.5 * 2.25 / 12, 2.0])

    def script() -> np.ndarray:
        s, h = 0.3 + 4.0 * ts, 1e-4
        before, here, after = pose(s - h), pose(s), pose(s + h)
        first, second = (after - before) / (2 * h), (after - 2 * here + before) / h**2
        return masses @ (first * second) * 16.0 + 9.81 * (first[1] + 1.5 * first[4])

    def ours() -> Any:
        return udk.inverse_dynamics(mech, ts).efforts["motor"]

    assert np.max(np.abs(np.asarray(ours()) - script())) < 1e-4
    runs = {"udkjax: inverse_dynamics": ours, "NumPy: one coordinate, differences": script}
    times = in_turn({name: timed(run) for name, run in runs.items()}, 1 if smoke else ROUNDS)
    rows = [{"name": name, "ms": 1e3 * float(np.median(seconds)), "instants": count} for name, seconds in times.items()]
    for row in rows:
        print(f"{row['name']:40} {row['ms']:14.3f} ms")
    return rows


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the times of positions, torques and equilibrium; all candidates must agree."""
    return [*positions(smoke), *torque(smoke), *rest(smoke)]
