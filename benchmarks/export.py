"""Scenes out of Python: C and FMUs beside the engine, control steps in batches, a learning curve, and a receding horizon.

The C is compiled with `cc -O2 -march=native`, which fuses products as the engine does where the processor can. FMPy runs the FMUs
if it is there: `sh install.sh --fmi`. The control figures run the code of the page `docs/how-to/learn.md`.
"""

import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
STRICT = "-O2 -std=c99 -march=native -Wall -Wextra -pedantic -Werror"
ALLOCATES = {"malloc", "calloc", "realloc", "free"}
SHORT = {"andrews_squeezer": 0.03}  # s: its motion is as fast
POINTS = 401
CALLS = 20  # of a batch of control steps


def scenes(smoke: bool) -> Iterator[tuple[str, Any, float]]:
    """Yield the scenes of the library and the example drawings, with the end of their runs (s)."""
    import udkjax as udk

    for name in ["compound_pendulum"] if smoke else sorted(udk.library.__all__):
        given = [3] if name == "n_four_bar" else []
        yield name, getattr(udk.library, name)(*given), 0.5 if smoke else SHORT.get(name, 20.0)
    for file in [] if smoke else sorted((ROOT / "examples" / "drawings").glob("*.toml")):
        yield file.stem, udk.load(str(file)), 20.0


def in_c(name: str, mechanism: Any, end: float) -> dict[str, Any]:
    """Return the size of a scene's C, and its difference from the run after one output and at the end."""
    import udkjax as udk

    ts = np.linspace(0.0, end, POINTS)
    with tempfile.TemporaryDirectory() as place:
        code = udk.export_c(mechanism, place, ["run", "accelerations"], ts)
        subprocess.run(f"cc {STRICT} *.c -o run -lm", shell=True, cwd=place, check=True)
        lines = subprocess.run(["./run"], cwd=place, check=True, capture_output=True, text=True).stdout.splitlines()[1:]
        undefined = subprocess.run(["nm", "-u", "run"], cwd=place, check=True, capture_output=True, text=True).stdout.split()
    run = udk.simulate(mechanism, ts)
    wanted = np.hstack([np.asarray(x).reshape(POINTS, -1) for x in (run.q, run.v)])
    apart = np.abs(np.array([[float(x) for x in line.split(",")][1:] for line in lines]) - wanted).max(1)
    allocates = bool(ALLOCATES & {x.partition("@")[0] for x in undefined})
    size = {"flops": code.flops, "bytes": code.memory["accelerations"], "bytes_of_run": code.memory["run"]}
    return {"name": f"C, {name}", **size, "step_difference": apart[1], "end_difference": apart[-1], "allocates": allocates}


def as_fmu(name: str, mechanism: Any, end: float) -> dict[str, Any]:
    """Return the complaints of FMPy, the difference of co-simulation from a chain of steps, and the error of model exchange."""
    import fmpy  # pyright: ignore[reportMissingImports]
    from fmpy.validation import validate_fmu  # pyright: ignore[reportMissingImports]

    import udkjax as udk

    end = min(end, 2.0)
    dt = end / 40
    with tempfile.TemporaryDirectory() as place:
        file = f"{place}/scene.fmu"
        made = udk.export_fmu(mechanism, file, t1=end, dt=dt, options=["-O1", "-march=native"])
        complaints, names = len(validate_fmu(file)), made.outputs[: 6 * len(mechanism.bodies)]
        given = {"stop_time": end, "output": names, "record_events": False}
        steps = fmpy.simulate_fmu(file, fmi_type="CoSimulation", output_interval=dt, stop_time=end, output=names)
        rates = fmpy.simulate_fmu(file, fmi_type="ModelExchange", output_interval=dt / 4, relative_tolerance=1e-10, **given)
    state, analysis, wanted = udk.assemble(mechanism), udk.analyse(mechanism), []
    for k, t in enumerate(steps["time"]):
        wanted.append(np.ravel([state.q, state.v]))
        state = udk.step(mechanism, state, None, steps["time"][min(k + 1, 40)] - t or dt, t, analysis=analysis)
    tables = [np.array([[row[x] for x in names] for row in table]) for table in (steps, rates[::4])]
    apart = [float(np.abs(table - wanted).max()) for table in tables]
    return {"name": f"FMU, {name}", "complaints": complaints, "co_simulation_difference": apart[0], "exchange_error": apart[1]}


def control(smoke: bool) -> list[dict[str, Any]]:
    """Run the code of the page, and time its parts by the seconds of all cores together (CPU)."""
    import jax

    text = (ROOT / "docs" / "how-to" / "learn.md").read_text(encoding="utf-8")
    blocks = [part.partition("```")[0] for part in text.split("```python\n")[1:]]
    names: dict[str, Any] = {}
    seconds = []
    for block in blocks:
        begun = time.process_time(), time.perf_counter()
        exec(compile(block.replace("key(0), 200)", "key(0), 2)") if smoke else block, "learn.md", "exec"), names)
        seconds.append((time.process_time() - begun[0], time.perf_counter() - begun[1]))
    states, begun = names["states"], time.process_time()
    for _ in range(CALLS):
        _, states, _ = jax.block_until_ready(names["step"](states, names["actions"]))
    rate = CALLS * len(names["actions"]) / (time.process_time() - begun)
    q = np.asarray(states.q)
    gap = float(np.abs(1.0 + np.cos(q[:, 0, 2]) - q[:, 3, 0]).max())
    goals, spent = names["goal"](names["DT"] * (1 + np.arange(names["AHEAD"]))), []
    for _ in range(CALLS):
        begun = time.process_time()
        jax.block_until_ready(names["plan"](names["torques"], names["state"], goals))
        spent.append(1e3 * (time.process_time() - begun))
    curve = [round(x, 2) for x in names["history"][::20]]
    miss = float(np.abs(names["path"][:, 0] - names["wanted"]).max())
    return [
        {"name": "control steps, batch of 4,096", "per_core_second": rate, "on_two_cores": 2 * rate, "gap_m": gap},
        {"name": "learning", "curve": curve, "cpu_seconds": seconds[1][0], "seconds": seconds[1][1]},
        {"name": "receding horizon", "ms": float(np.median(spent)), "largest_error_rad": miss},
    ]


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Measure and print everything."""
    rows = []

    def add(row: dict[str, Any]) -> None:
        rows.append(row)
        print("; ".join(f"{k} {x:.3g}" if isinstance(x, float) else f"{k} {x}" for k, x in row.items()), flush=True)

    if shutil.which("cc"):
        for scene in scenes(smoke):
            add(in_c(*scene))
            if find_spec("fmpy"):
                add(as_fmu(*scene))
    for row in control(smoke):
        add(row)
    return rows
