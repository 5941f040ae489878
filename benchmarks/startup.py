"""Time to the first result: import, --help, the first trajectory, and JAX's transformations of one.

Times of whole processes, compiling included: nothing is cached unless the name says so.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TIMES = 5
FIRST = """
import numpy as np
import udkjax as udk
udk.simulate(udk.library.parallelogram(), np.linspace(0.0, 20.0, 401))
"""
# A run of 101 states of a scene, changed by two of its masses.
SCENE = """
import jax, jax.numpy as jnp, numpy as np
import udkjax as udk
mechanism, ts = udk.library.{scene}, np.linspace(0.0, {end}, 101)
names = [name for name in mechanism.parameters() if name.endswith(".mass")][:2]
masses = [float(mechanism.parameters()[name]) for name in names]
def states(*values):
    return udk.simulate(mechanism.with_parameters(dict(zip(names, values))), ts, throw=False).q
def angle(*values):
    return states(*values)[-1, 0, 2]
"""
SCENES = {
    "parallelogram()": 5.0,
    "excavator()": 5.0,
    "planetary_gear()": 5.0,
    "scissor_lift()": 5.0,
    "n_four_bar(5)": 5.0,
    "andrews_squeezer()": 0.03,
    "n_four_bar(40)": 5.0,
}
RUNS = {
    "first": "udk.simulate(mechanism, ts).q",
    "jit": "jax.jit(states)(*masses)",
    "vmap over 256": "jax.jit(jax.vmap(states))(*(jnp.linspace(0.9, 1.1, 256) * x for x in masses))",
    "jacfwd of two": "jax.jit(jax.jacfwd(states, argnums=(0, 1)))(*masses)",
    "grad of two": "jax.jit(jax.grad(angle, argnums=(0, 1)))(*masses)",
}
PROGRAMS = {
    "python": "pass",
    "import jax": "import jax",
    "import udkjax": "import udkjax",
    "import udkjax and simulate": "from udkjax import simulate",  # the package imports modules when they are used
    "udkjax --help": "import sys; sys.argv = ['udkjax', '--help']; from udkjax.cli import main; main()",
    "first trajectory, no cache": FIRST,
    "first trajectory, cached": FIRST,
}


def waited(code: str, cache: Path, bytecode: Path) -> dict[str, float]:
    """Return wall and CPU time (s) of a Python process with compiled programs in `cache` and bytecode in `bytecode`.

    Without bytecode Python would compile the sources of all packages each time, which triples the time of `import jax`. pip
    writes it when it installs; other installers, and settings such as PYTHONDONTWRITEBYTECODE, do not.
    """
    dropped = ("JAX_COMPILATION_CACHE", "PYTHONDONTWRITEBYTECODE")
    environment = {name: text for name, text in os.environ.items() if not name.startswith(dropped)}
    environment |= {"UDKJAX_CACHE": str(cache), "PYTHONPYCACHEPREFIX": str(bytecode)}
    before, start = os.times(), time.perf_counter()
    subprocess.run([sys.executable, "-c", code], env=environment, stdout=subprocess.DEVNULL, check=True)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return {"seconds": time.perf_counter() - start, "cpu_seconds": cpu}


def transformed(bytecode: Path) -> list[dict[str, Any]]:
    """Print the time of each transformation for each scene, the lesser of two."""
    print(f"\n{'s, nothing cached':28} {' '.join(f'{name:>13}' for name in RUNS)}")
    figures = []
    for scene, end in SCENES.items():
        for name, run in RUNS.items():
            code, times = f"{SCENE.format(scene=scene, end=end)}np.asarray(jax.tree.leaves({run})[0])", []
            for _ in range(2):
                with tempfile.TemporaryDirectory() as cold:
                    times.append(waited(code, Path(cold), bytecode)["seconds"])
            figures.append({"name": f"{scene}, {name}", "scene": scene, "run": name, "seconds": min(times)})
        waits = [row["seconds"] for row in figures[-len(RUNS) :]]
        print(f"{scene:28} {' '.join(f'{seconds:13.2f}' for seconds in waits)}", flush=True)
    return figures


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the times from the start of Python to its end, as medians."""
    figures = []
    programs = {name: code for name, code in PROGRAMS.items() if not smoke or code != FIRST}
    print(f"{'start of a process':28} {'s':>7} {'CPU s':>7}")
    with tempfile.TemporaryDirectory() as warm, tempfile.TemporaryDirectory() as bytecode:
        for name, code in programs.items():
            runs = []
            waited(code, Path(warm), Path(bytecode))  # leaves bytecode and compiled programs behind
            for _ in range(1 if smoke else TIMES):
                with tempfile.TemporaryDirectory() as cold:
                    folder = Path(cold if name.endswith("no cache") else warm)
                    runs.append(waited(code, folder, Path(bytecode)))
            row = {"name": name, **{key: statistics.median(run[key] for run in runs) for key in runs[0]}}
            figures.append(row)
            print(f"{name:28} {row['seconds']:7.2f} {row['cpu_seconds']:7.2f}")
        if not smoke:
            figures += transformed(Path(bytecode))
    return figures
