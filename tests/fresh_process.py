"""Python in a process of its own, where nothing is imported and nothing is set."""

import os
import subprocess
import sys
from pathlib import Path

from udkjax.native.code.processor import LANES_VARIABLE


def python(code: str, **environment: object) -> str:
    """Run code with few variables of the environment, and those given; return what it prints.

    Machine code has as many lanes as in this process, so that both compute the same bits.
    """
    lanes = {name: value for name, value in os.environ.items() if name == LANES_VARIABLE}
    clean = {"PATH": "/usr/bin:/bin", "JAX_PLATFORMS": "cpu", **lanes, **{name: str(x) for name, x in environment.items()}}
    done = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr[-2000:]
    return done.stdout.strip()


def peak_memory() -> int:
    """Return the largest memory of this process (bytes). On Linux `ru_maxrss` is at least that of the parent process."""
    status = Path("/proc/self/status")
    if status.exists():
        lines = status.read_text(encoding="utf-8").splitlines()
        return 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
