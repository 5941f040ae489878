"""Python in a process of its own, where nothing is imported and nothing is set."""

import subprocess
import sys


def python(code: str, **environment: object) -> str:
    """Run code with few variables of the environment, and those given; return what it prints."""
    clean = {"PATH": "/usr/bin:/bin", "JAX_PLATFORMS": "cpu", **{name: str(value) for name, value in environment.items()}}
    done = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr[-2000:]
    return done.stdout.strip()
