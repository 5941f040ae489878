"""Stiff mechanisms by default arguments: dampers of every strength, in batches and derivatives, a bushing, a bumper."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import udkjax as udk
from benchmarks.common import Compiled, in_turn, ratio

DAMPINGS = tuple(10.0**k for k in range(-1, 10))  # N m s/rad
MIDDLE = 1e5  # of the derivatives and first calls
END, OUTPUTS, TOLERANCE = 5.0, 51, 1e-6
START, LENGTHS, GROUND, GRAVITY = np.pi / 3, (1.0, 2.5, 2.0), 2.5, 9.81  # of the four-bar; its links are uniform, 1 kg/m
MEMBERS, ROUNDS = 64, 7
BUSHING, BUMPER = 1e9, 1e7  # N/m, N m/rad


def with_damper(damping: Any) -> udk.Mechanism:
    """Return a four-bar with a damper at its crank."""
    linkage = udk.library.four_bar(START, lengths=LENGTHS, ground=GROUND, gravity=GRAVITY)
    damper = udk.TorsionSpring(["ground", linkage.body_names[0]], 0.0, damping=damping)
    return udk.Mechanism(linkage.bodies, linkage.joints, forces={"damper": damper}, gravity=linkage.gravity)


def with_bushing(stiffness: float) -> udk.Mechanism:
    """Return the paper's linkage with a spring in place of its middle pin on the coupler."""
    linkage = udk.library.parallelogram(-np.pi / 4)
    joints = dict(linkage.joints)
    name = [name for name, joint in joints.items() if "ground" not in joint.bodies][1]
    pin = joints.pop(name)
    spring = udk.Spring(pin.bodies, pin.points, stiffness, 0.0)  # pyright: ignore[reportAttributeAccessIssue]
    return udk.Mechanism(linkage.bodies, joints, forces={"bushing": spring}, gravity=linkage.gravity)


class Bumper(udk.ForceElement):
    """An elastic stop: the potential stiffness (limit - angle)^2 / 2 beyond a limit of a body's angle."""

    stiffness: Any
    limit: Any

    def potential(self, t, body):
        return self.stiffness * jnp.maximum(self.limit - body.angle, 0.0) ** 2 / 2


def _places(angle: Any) -> Any:
    """Return the centres and angles of crank, coupler and rocker in closed form."""
    a, b, c = LENGTHS
    pin = a * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    away = jnp.array([GROUND, 0.0]) - pin
    distance = jnp.linalg.norm(away)
    turn = jnp.arccos((b**2 + distance**2 - c**2) / (2 * b * distance))
    coupler = jnp.arctan2(away[1], away[0]) + turn
    apex = pin + b * jnp.stack([jnp.cos(coupler), jnp.sin(coupler)])
    rocker = jnp.arctan2(apex[1], apex[0] - GROUND)
    centres = pin / 2, (pin + apex) / 2, (apex + jnp.array([GROUND, 0.0])) / 2
    return jnp.stack(centres), jnp.stack([angle, coupler, rocker])


@cache
def reference(damping: float) -> np.ndarray:
    """Return the crank's angle by SciPy's Radau: one equation in the angle, from the kinetic and potential energy."""
    mass = np.array(LENGTHS)
    inertia = mass * np.array(LENGTHS) ** 2 / 12

    def inertia_of(angle):  # twice the kinetic energy at unit rate
        centres, angles = jax.jvp(_places, (angle,), (jnp.ones(()),))[1]
        return jnp.sum(mass * jnp.sum(centres**2, 1)) + jnp.sum(inertia * angles**2)

    def potential(angle):
        return GRAVITY * jnp.sum(mass * _places(angle)[0][:, 1])

    @jax.jit
    def slope(y):
        angle, rate = y
        whole, change = jax.value_and_grad(inertia_of)(angle)
        return jnp.stack([rate, (-jax.grad(potential)(angle) - change * rate**2 / 2 - damping * rate) / whole])

    jacobian = jax.jit(jax.jacfwd(slope))
    found = solve_ivp(
        lambda t, y: np.asarray(slope(y)),
        (0.0, END),
        (START, 0.0),
        "Radau",
        np.linspace(0.0, END, OUTPUTS),
        jac=lambda t, y: np.asarray(jacobian(y)),
        rtol=1e-11,
        atol=1e-13,
    )
    assert found.success, found.message
    return found.y[0]


def run_of(damping: Any) -> udk.Solution:
    """Return a run of the four-bar by default arguments."""
    ts = np.linspace(0.0, END, OUTPUTS)
    return udk.simulate(with_damper(damping), ts, rtol=TOLERANCE, atol=TOLERANCE, throw=False)


def final_rate(damping: Any) -> jax.Array:
    """Return the crank's rate at the end, of which derivatives are taken."""
    return run_of(damping).v[-1, 0, 2]


def measured(runs: dict[str, tuple[Callable, tuple]], rounds: int, at_least: float) -> dict[str, dict[str, Any]]:
    """Return for each function: its first call (s), its times in turn with the others (s), and its result."""
    compiled = {name: (Compiled(function, *arguments), arguments) for name, (function, arguments) in runs.items()}
    timers = {name: partial(one.cpu_seconds, *arguments, at_least=at_least) for name, (one, arguments) in compiled.items()}
    times = in_turn(timers, rounds)
    return {
        name: {"first": one.compile_seconds, "times": times[name], "result": one.result} for name, (one, _) in compiled.items()
    }


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Measure runs of stiff mechanisms, and compare the damped ones with SciPy's Radau."""
    dampings, rounds, at_least = (DAMPINGS[::5], 1, 0.0) if smoke else (DAMPINGS, ROUNDS, 0.02)
    members = jnp.asarray(np.geomspace(DAMPINGS[0], DAMPINGS[-1], 4 if smoke else MEMBERS))
    ts = np.linspace(0.0, 2.0 if smoke else 20.0, OUTPUTS)
    pendulum = udk.library.compound_pendulum()
    stop = Bumper(pendulum.body_names[0], BUMPER, pendulum.q0[0, 2] - 1.0)  # it rebounds 19 times
    bumper = udk.Mechanism(pendulum.bodies, pendulum.joints, forces={"bumper": stop}, gravity=pendulum.gravity)

    def alone(scene: udk.Mechanism) -> Callable:
        return lambda tol: udk.simulate(scene, ts, rtol=tol, atol=tol, throw=False)

    runs: dict[str, tuple[Callable, tuple]] = {
        **{f"damper, {damping:.0e}": (run_of, (damping,)) for damping in dampings},
        f"{len(members)} dampers in vmap": (jax.vmap(run_of), (members,)),
        "run": (final_rate, (MIDDLE,)),
        "forward derivative": (jax.jacfwd(final_rate), (MIDDLE,)),
        "gradient": (jax.grad(final_rate), (MIDDLE,)),
        "64 in vmap, forward derivatives": (jax.vmap(jax.jacfwd(final_rate)), (members,)),
        f"bushing, {BUSHING:.0e}": (alone(with_bushing(BUSHING)), (TOLERANCE,)),
        f"bumper, {BUMPER:.0e}": (alone(bumper), (TOLERANCE,)),
    }
    if smoke:
        runs = {name: one for name, one in runs.items() if "64" not in name and "bu" not in name}
    found, rows = measured(runs, rounds, at_least), []
    print(f"{'default arguments, tolerance 1e-6':36} {'ms':>9} {'first call (s)':>15} {'steps':>9} {'implicit':>9} {'error':>9}")
    for name, of in found.items():
        row: dict[str, Any] = {"name": name, "ms": 1e3 * float(np.median(of["times"])), "first": of["first"]}
        if isinstance(of["result"], udk.Solution):
            result = of["result"]
            row |= {"successful": bool(np.all(np.asarray(result.result) == 0))}
            row |= {key: int(np.max(np.asarray(result.stats[key]))) for key in ("steps", "implicit")}
            if name.startswith("damper"):
                exact = reference(float(name.split(", ")[1]))
                row["error"] = float(np.max(np.abs(np.asarray(result.q)[:, 0, 2] - exact)))
        elif name != "run" and "64" not in name:
            row["times_run"] = ratio(of["times"], found["run"]["times"])
        rows.append(row)
        counts = "".join(f"{row[key]:10}" for key in ("steps", "implicit") if key in row)
        error = f"{row['error']:10.1e}" if "error" in row else ""
        print(f"{name:36} {row['ms']:9.3f} {row['first']:15.2f}{counts}{error}")
    return rows
