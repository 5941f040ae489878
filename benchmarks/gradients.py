"""Cost of gradients of the final angle, relative to the run alone: udkjax, dual numbers in C++, a script."""

import statistics
from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks import native
from benchmarks.common import Compiled, in_turn, ratio
from benchmarks.scripts import MASS, WEIGHT, solve

START, END, TOLERANCE = -45.0, 10.0, 1e-8  # degrees, s
COUNTS = (1, 2, 4, 8)  # numbers of parameters
PARAMETERS = {**{f"body.link{i}.mass": 1.0 for i in (1, 2, 3)}, "body.coupler.mass": 2.0} | {
    **{f"body.link{i}.inertia": 0.1 for i in (1, 2, 3)},
    "gravity": 9.81,
}
AGREE = 1e-4  # relative
REGULARIZATION = 1e-10  # regularization of the script: with a larger one the gradients are not those of the linkage
ROUNDS = 7


def ours(adjoint: Any = None) -> Callable:
    """Return the final angle for values of the first parameters."""
    mechanism = udk.library.parallelogram(np.deg2rad(START))
    ts, start = np.array([0.0, END]), udk.State(mechanism.q0, mechanism.v0)

    def angle(values):
        names = list(PARAMETERS)[: len(values)]
        numbers = {n: jnp.stack([0.0 * x, -x]) if n == "gravity" else x for n, x in zip(names, values, strict=True)}
        changed = mechanism.with_parameters(numbers)
        return udk.simulate(changed, ts, start, TOLERANCE, TOLERANCE, adjoint=adjoint, throw=False).q[-1, 0, 2]

    return angle


def script(adjoint: Any = None) -> Callable:
    """Do the same by a user's script."""
    placed = udk.library.parallelogram(np.deg2rad(START))
    y0 = jnp.concatenate([placed.q0.ravel(), jnp.zeros(12)])
    run = solve(jnp.array([0.0, END]), REGULARIZATION, adjoint)

    def angle(values):
        mass, weight = MASS, WEIGHT
        places = ([0, 1], [3, 4], [6, 7], [9, 10], [2], [5], [8])
        for place, value in zip(places, values, strict=False):
            mass = mass.at[jnp.array(place)].set(value)
        if len(values) > len(places):
            weight = weight.at[1::3].set(-values[-1])
        return run(y0, TOLERANCE, mass, weight)[-1, 2]

    return angle


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the cost of a gradient relative to the run alone, by number of parameters, and check the gradients against C++."""
    counts, rounds, at_least = ((1,), 1, 0.0) if smoke else (COUNTS, ROUNDS, 0.02)
    figures, gradients = [], {}
    makers = {"udkjax": ours} if smoke else {"udkjax": ours, "script": script}
    print(f"{'final angle, 10 s':16} {'mode':8} {'parameters':>10} {'ms':>9} {'times the run':>14}")
    for count in counts:
        values = tuple(jnp.asarray(x) for x in list(PARAMETERS.values())[:count])
        timers: dict[Any, Callable[[], float]] = {}
        for name, make in makers.items():
            modes = {"run": make(), "forward": jax.jacfwd(make(diffrax.ForwardMode()))}
            if not smoke:
                modes["reverse"] = jax.grad(make())
            for mode, function in modes.items():
                jitted = Compiled(function, values)
                gradients[name, mode, count] = np.ravel(jitted.result)
                timers[name, mode] = partial(jitted.cpu_seconds, values, at_least=at_least)
        if native.program() is not None:
            times = {"tolerance": TOLERANCE, "start": START, "t1": END, "outputs": 2, "seconds": at_least}
            dual = partial(native.run, mode="gradient", parameters=count, **times)
            gradients["C++", "forward", count] = np.array(dual()["gradient"])
            timers["C++", "run"] = lambda times=times: native.run(**times)["seconds"]
            timers["C++", "forward"] = lambda dual=dual: dual()["seconds"]
        for (name, mode), seconds in (times := in_turn(timers, rounds)).items():
            row = {"name": name, "mode": mode, "parameters": count, "seconds": statistics.median(seconds)}
            row["times_run"] = ratio(seconds, times[name, "run"])
            figures.append(row)
            print(f"{name:16} {mode:8} {count:10d} {row['seconds'] * 1e3:9.3f} {row['times_run']:14.2f}")
    for (name, mode, count), found in gradients.items():
        known = gradients["udkjax", "forward", count]
        if mode != "run":
            np.testing.assert_allclose(found, known, rtol=AGREE, err_msg=f"{name}, {mode}")
    return figures
