"""User-defined systems, and the diffrax engine, compared with plain scripts for diffrax."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks.common import Compiled, in_turn, ratio
from benchmarks.scripts import solve

GRAVITY, LENGTH, MASS = 9.81, 1.0, 2.0
START = (jnp.array([0.6, 0.0, -0.8]), jnp.array([0.0, 2.0, 0.0]))  # of the spatial pendulum
END, OUTPUTS, TOLERANCE = 10.0, 101, 1e-8
LINKAGES, LINKAGE_END, LINKAGE_OUTPUTS, COARSE = 64, 5.0, 51, 1e-5
MEMBERS, ROUNDS = 1024, 7
# Tolerances (m) within which candidates must agree. The script for linkages regularizes its matrix by 1e-4: hence its errors.
AGREE, LINKAGES_AGREE = 1e-5, 1e-2


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
    return rows
