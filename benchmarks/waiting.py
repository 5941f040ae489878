"""Waiting times of single requests: eager transformations, events, kinematics, statics and modes, and commands.

Each runs in a fresh process, first with nothing cached, then with the files of that run; and the second call within a process.
The time of the call is separated from the imports of Python, JAX and the package, once per process.
"""

import statistics
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import cpu_seconds
from benchmarks.startup import SCENE, waited

TIMES = 3
WARM_CALLS = 200  # the first ones use code that was compiled quickly
LINKAGE, CRANK_ROCKER = (SCENE.format(scene=f"{name}()", end=5.0) for name in ("parallelogram", "four_bar"))
EVENT = """
import jax, numpy as np
import udkjax as udk
body = udk.Body(1.0, 0.1, [1.0, 0.0])
pin = udk.Revolute(["ground", "rod"], [[0.0, 0.0], [-1.0, 0.0]])
mechanism, ts = udk.Mechanism({"rod": body}, {"pin": pin}), np.linspace(0.0, 2.0, 21)
lowest = udk.Event(lambda t, frames: frames["rod"].angle + np.pi / 2, udk.Stop())
def time(inertia):
    changed = mechanism.with_parameters({"body.rod.inertia": inertia})
    return udk.simulate(changed, ts, events=lowest, max_events=1).events.time[0]
"""
COMMAND = "import sys; sys.argv = ['udkjax', *{words!r}.split()]; from udkjax.cli import main; main()"
FOUR_BAR = "examples/four_bar.toml"
IMPORT = "import the package and what a run takes"
CASES = {
    IMPORT: LINKAGE + "udk.simulate",
    "eager grad": LINKAGE + "print(jax.grad(angle, argnums=(0, 1))(*masses))",
    "eager vmap over 8": LINKAGE + "print(jax.vmap(states)(*(jnp.linspace(0.9, 1.1, 8) * x for x in masses)).shape)",
    "hessian of a four-bar": CRANK_ROCKER + "print(jax.hessian(angle)(*masses))",
    "first event": EVENT + "print(time(0.1))",
    "gradient of an event's time": EVENT + "print(jax.grad(time)(0.1))",
    "travel": "import udkjax as udk; print(udk.travel(udk.library.four_bar(), 'body.crank.angle'))",
    "udkjax kinematics": COMMAND.format(words=f"kinematics {FOUR_BAR} --driver body.crank.angle"),
    "udkjax statics": COMMAND.format(words=f"statics {FOUR_BAR}"),
    "udkjax modes": COMMAND.format(words=f"modes {FOUR_BAR}"),
    "udkjax animate": COMMAND.format(words=f"animate {FOUR_BAR} --out {{folder}}/page.html --t1 5"),
}
QUICK = (IMPORT, "travel")  # imported even if nothing is measured


def waits(name: str, code: str, bytecode: Path) -> dict[str, Any]:
    """Return the median wall and CPU times of a process (s), with nothing cached and again."""
    runs: dict[str, list[dict[str, float]]] = {"cold": [], "again": []}
    for _ in range(TIMES):
        with tempfile.TemporaryDirectory() as cache:
            for found in runs.values():
                found.append(waited(code.replace("{folder}", cache), Path(cache), bytecode))
    row: dict[str, Any] = {"name": name}
    for kind, found in runs.items():
        prefix = "" if kind == "cold" else "again_"
        row |= {prefix + key: statistics.median(run[key] for run in found) for key in found[0]}
    return row


def call_times(smoke: bool) -> list[dict[str, Any]]:
    """Return the median times of warm calls with concrete numbers (ms of CPU)."""
    import udkjax as udk

    mechanism, ts = udk.library.parallelogram(), np.linspace(0.0, 5.0, 101)
    state, figures = udk.assemble(mechanism), []
    calls = {
        "simulate of known numbers": lambda: udk.simulate(mechanism, ts),
        "step": lambda: udk.step(mechanism, state, {}, 0.01),
    }
    for name, call in calls.items():
        for _ in range(1 if smoke else WARM_CALLS):
            call()
        figures.append({"name": name, "milliseconds": 1e3 * cpu_seconds(call, 0.0 if smoke else 0.2)})
    return figures


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the time of each case."""
    figures = call_times(smoke)
    for row in figures:
        print(f"{row['name']:28} {row['milliseconds']:8.3f} ms of CPU")
    print(f"{'a process':40} {'s':>7} {'CPU s':>7} {'again, s':>9} {'CPU s':>7} {'without imports: s':>19} {'CPU s':>7}")
    imports: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as bytecode:
        waited("import udkjax, diffrax, tyro", Path(bytecode), Path(bytecode))
        for name, code in CASES.items():
            if smoke and name not in QUICK:
                continue
            row = waits(name, code, Path(bytecode))
            imports = imports or row
            row |= {f"call_{key}": row[key] - imports[key] for key in ("seconds", "cpu_seconds")}
            figures.append(row)
            widths = {"seconds": 7, "cpu_seconds": 7, "again_seconds": 9, "again_cpu_seconds": 7, "call_seconds": 19}
            widths["call_cpu_seconds"] = 7
            print(f"{name:40} {' '.join(f'{row[key]:{width}.2f}' for key, width in widths.items())}", flush=True)
    return figures
