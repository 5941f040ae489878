"""Python in a process of its own, where nothing is imported and nothing is set."""

import subprocess
import sys
from pathlib import Path


def python(code: str, **environment: object) -> str:
    """Run code with few variables of the environment, and those given; return what it prints."""
    clean = {"PATH": "/usr/bin:/bin", "JAX_PLATFORMS": "cpu", **{name: str(value) for name, value in environment.items()}}
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
