"""User-defined systems, and the diffrax engine, compared with plain scripts for diffrax; chains of rods in space."""

import tempfile
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks.common import Compiled, cpu_seconds, in_turn, ratio
from benchmarks.scripts import solve
from benchmarks.startup import waited

GRAVITY, LENGTH, MASS = 9.81, 1.0, 2.0
START = (jnp.array([0.6, 0.0, -0.8]), jnp.array([0.0, 2.0, 0.0]))  # of the spatial pendulum
END, OUTPUTS, TOLERANCE = 10.0, 101, 1e-8
LINKAGES, LINKAGE_END, LINKAGE_OUTPUTS, COARSE = 64, 5.0, 51, 1e-5
MEMBERS, ROUNDS = 1024, 7
# Tolerances (m) within which candidates must agree. The script for linkages regularizes its matrix by 1e-4: hence its errors.
AGREE, LINKAGES_AGREE = 1e-5, 1e-2
CHAINS, CHAIN_END, CHAIN_OUTPUTS, ROD = (3, 6, 12, 24), 1.0, 11, 0.5  # numbers of rods; s; m
FIRST = """
from benchmarks.systems import chain_times, spatial_chain
import udkjax as udk
system, start, _ = spatial_chain({rods})
udk.simulate(system, chain_times(), start)
"""
IMPORTS = "import jax, diffrax, udkjax, benchmarks.systems; udkjax.simulate, udkjax.State"


def by_udkjax(length: Any) -> jax.Array:
    """Return the positions of a spatial pendulum of this length (m); the position of `START` is scaled with the length."""
    system = udk.ConstrainedSystem(
        lambda q: MASS * jnp.eye(3),
        constraint=lambda t, q: q @ q - length**2,
        potential=lambda t, q: MASS * GRAVITY * q[2],
    )
    start = udk.State(START[0] * length, START[1])
    ts = np.linspace(0.0, END, OUTPUTS)
    return udk.simulate(system, ts, start, rtol=TOLERANCE, atol=TOLERANCE, throw=False).q


def by_script(length: Any) -> jax.Array:
    """Return the same by a user's script: the stabilized Udwadia-Kalaba equation, derivatives by JAX, steps by diffrax."""

    def psi(q):
        return jnp.stack([q @ q - length**2])

    def rates(t, y, args):
        q, v = y
        free, A = jnp.array([0.0, 0.0, -GRAVITY]), jax.jacfwd(psi)(q)
        drift = jax.jvp(lambda q: jax.jvp(psi, (q,), (v,))[1], (q,), (v,))[1]
        missing = -drift - 20 * (A @ v) - 100 * psi(q) - A @ free
        return v, free + A.T @ jnp.linalg.solve(A @ A.T, missing)

    ts = jnp.linspace(0.0, END, OUTPUTS)
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(rates),
        diffrax.Dopri8(),
        t0=ts[0],
        t1=ts[-1],
        dt0=None,
        y0=(START[0] * length, START[1]),
        saveat=diffrax.SaveAt(ts=ts),
        stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
        max_steps=10_000,
        throw=False,
    )
    assert found.ys is not None
    return found.ys[0]


def linkages_by_engine(angles: Any) -> jax.Array:
    """Return the coordinates of many copies of the paper's linkage by the diffrax engine."""
    ts = np.linspace(0.0, LINKAGE_END, LINKAGE_OUTPUTS)

    def run(angle):
        linkage = udk.library.parallelogram(angle)
        return udk.simulate(linkage, ts, rtol=COARSE, atol=COARSE, engine="diffrax", throw=False).q.reshape(len(ts), -1)

    return jax.vmap(run)(angles)


def linkages_by_script(angles: Any) -> jax.Array:
    """Return the same by the script of the other benchmarks."""
    run = solve(jnp.linspace(0.0, LINKAGE_END, LINKAGE_OUTPUTS))

    def start(angle):
        return jnp.concatenate([udk.library.parallelogram(angle).q0.ravel(), jnp.zeros(12)])

    return jax.vmap(lambda angle: run(start(angle), COARSE))(angles)


def spatial_chain(rods: int) -> tuple[udk.ConstrainedSystem, udk.State, udk.Mechanism]:
    """Return rods that hang from each other by balls, with unit quaternions, their state at rest, and the same in the plane."""
    half, inertia = jnp.array([0.0, 0.0, ROD / 2]), jnp.array([0.02, 0.02, 0.001])

    def turned(p, x):
        return x + 2 * jnp.cross(p[1:], jnp.cross(p[1:], x) + p[0] * x)

    def kinetic(q, dq):
        w, x, y, z = q[3:]
        omega = 2 * jnp.array([[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]]) @ dq[3:]
        return (dq[:3] @ dq[:3] + omega @ (inertia * omega) + 0.02 * (2 * q[3:] @ dq[3:]) ** 2) / 2

    def rows(t, q):
        q = q.reshape(rods, 7)
        tops, ends = (jax.vmap(lambda one, s=s: one[:3] + turned(one[3:], s * half))(q) for s in (1.0, -1.0))
        pins = tops - jnp.concatenate([jnp.zeros((1, 3)), ends[:-1]])
        return jnp.concatenate([pins.ravel(), jnp.sum(q[:, 3:] ** 2, axis=1) - 1.0])

    system = udk.ConstrainedSystem.of_energy(
        lambda q, dq: jnp.sum(jax.vmap(kinetic)(q.reshape(rods, 7), dq.reshape(rods, 7))),
        potential=lambda t, q: GRAVITY * jnp.sum(q.reshape(rods, 7)[:, 2]),
        constraint=rows,
    )
    angles, end, q, bodies, pins = 0.6 + 0.1 * np.arange(rods), np.zeros(3), np.zeros((rods, 7)), {}, {}
    for k, angle in enumerate(angles):
        along = ROD * np.array([np.sin(angle), 0.0, np.cos(angle)])
        q[k] = [*(end - along / 2), np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]
        end = end - along
        bodies[f"rod{k}"] = udk.Body(1.0, float(inertia[0]), q[k, [0, 2]], -angle)
        above = [f"rod{k - 1}", [0.0, -ROD / 2]] if k else ["ground", [0.0, 0.0]]
        pins[f"pin{k}"] = udk.Revolute([above[0], f"rod{k}"], [above[1], [0.0, ROD / 2]])
    planar = udk.Mechanism(bodies, pins, gravity=[0.0, -GRAVITY])
    return system, udk.State(q.ravel(), np.zeros(7 * rods)), planar


def chain_times() -> np.ndarray:
    """Return the output times of the runs of chains (s)."""
    return np.linspace(0.0, CHAIN_END, CHAIN_OUTPUTS)


def chains(counts: tuple[int, ...], at_least: float) -> list[dict[str, Any]]:
    """Print how long the first run of a chain takes, in a process with nothing cached, and a run after it."""
    print(f"\n{'chains in space, CPU time':36} {'first (s)':>10} {'again (ms)':>11} {'apart (m)':>10}")
    found, ts = [], chain_times()
    with tempfile.TemporaryDirectory() as bytecode:
        waited(FIRST.format(rods=min(counts)), Path(bytecode) / "first", Path(bytecode))  # leaves bytecode behind
        imports = waited(IMPORTS, Path(bytecode) / "imports", Path(bytecode))["cpu_seconds"]
        for rods in counts:
            with tempfile.TemporaryDirectory() as cold:
                first = waited(FIRST.format(rods=rods), Path(cold), Path(bytecode))["cpu_seconds"] - imports
            system, start, planar = spatial_chain(rods)
            run = udk.simulate(system, ts, start)
            places = np.asarray(run.q).reshape(len(ts), rods, 7)[:, :, [0, 2]]
            apart = float(np.max(np.abs(places - np.asarray(udk.simulate(planar, ts).q)[..., :2])))
            assert run.settings["engine"] == "native" and apart < AGREE * rods, (rods, run.settings["engine"], apart)
            again = 1e3 * cpu_seconds(lambda: udk.simulate(system, ts, start), at_least)  # noqa: B023
            found.append({"name": f"chain of {rods} rods", "first": first, "ms": again, "apart": apart})
            print(f"{found[-1]['name']:36} {first:10.2f} {again:11.2f} {apart:10.1e}")
    return found


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print times and first calls of udkjax and of the scripts, and the ratios of the times."""
    members, linkages, rounds, at_least = (8, 2, 1, 0.0) if smoke else (MEMBERS, LINKAGES, ROUNDS, 0.02)
    lengths = jnp.linspace(0.5, 1.5, members)
    angles = jnp.linspace(-0.9, -0.6, linkages)
    cases = {
        "spatial pendulum": (by_udkjax, by_script, LENGTH),
        "its gradient": (jax.grad(lambda x: by_udkjax(x)[-1, 0]), jax.grad(lambda x: by_script(x)[-1, 0]), LENGTH),
        f"{members} in vmap": (jax.vmap(by_udkjax), jax.vmap(by_script), lengths),
        f'{linkages} linkages, engine="diffrax"': (linkages_by_engine, linkages_by_script, angles),
    }
    rows = []
    print(f"{'':36} {'ms':>9} {'script, ms':>11} {'ratio':>8} {'first call (s)':>15} {'script (s)':>11}")
    for name, (own, script, argument) in cases.items():
        one, other = Compiled(own, argument), Compiled(script, argument)
        apart = float(np.max(np.abs(np.asarray(one.result) - np.asarray(other.result))))
        assert apart < (LINKAGES_AGREE if "linkages" in name else AGREE), (name, apart)
        times = in_turn(
            {
                "udkjax": lambda one=one, argument=argument: one.cpu_seconds(argument, at_least=at_least),
                "script": lambda other=other, argument=argument: other.cpu_seconds(argument, at_least=at_least),
            },
            rounds,
        )
        row = {
            "name": name,
            "ms": 1e3 * float(np.median(times["udkjax"])),
            "script_ms": 1e3 * float(np.median(times["script"])),
            "times_ours": ratio(times["script"], times["udkjax"]),
            "first": one.compile_seconds,
            "script_first": other.compile_seconds,
            "apart": apart,
        }
        rows.append(row)
        print(
            f"{name:36} {row['ms']:9.3f} {row['script_ms']:11.2f} {row['times_ours']:8.2f} {row['first']:15.2f} "
            f"{row['script_first']:11.2f}"
        )
    return rows + chains(CHAINS[:1] if smoke else CHAINS, at_least)
