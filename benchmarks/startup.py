"""How long one waits for the first result: import, --help, the first trajectory without and with a warm compilation cache."""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.common import machine, report

TIMES = 5
FIRST = """
import numpy as np
import udkjax as udk
udk.simulate(udk.library.parallelogram(), np.linspace(0.0, 20.0, 401))
"""
PROGRAMS = {
    "python": "pass",
    "import jax": "import jax",
    "import udkjax": "import udkjax",
    "import udkjax and simulate": "from udkjax import simulate",  # the package imports what is used
    "udkjax --help": "import sys; sys.argv = ['udkjax', '--help']; from udkjax.cli import main; main()",
    "first trajectory, no cache": FIRST,
    "first trajectory, cached": FIRST,
}


def waited(code: str, cache: Path, bytecode: Path) -> dict[str, float]:
    """Wall and CPU time (s) of a Python process that keeps compiled programs in `cache` and modules' bytecode in `bytecode`.

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


def main(smoke: bool = False, out: Path | None = None) -> list[dict[str, Any]]:
    """Print the time from the start of Python to its end, medians."""
    about, figures = machine(), []
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
    report(about, figures, out)
    return figures
