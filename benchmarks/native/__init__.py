"""The equivalent C++ program (linkage.cpp), compiled by the system's compiler and kept in the user's cache."""

import hashlib
import json
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

SOURCE = Path(__file__).with_name("linkage.cpp")
FLAGS = ("-std=c++17", "-O3", "-march=native", "-Wno-psabi")
STATE = 24  # 12 coordinates, 12 velocities
PARAMETERS = (  # in the order of the gradient
    *("link1.mass", "link2.mass", "link3.mass", "coupler.mass"),
    *("link1.inertia", "link2.inertia", "link3.inertia", "gravity"),
)


@cache
def program() -> Path | None:
    """Return the compiled program; None, and say so, where no compiler is found ($CXX, else g++)."""
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None:
        print("C++: skipped: no g++")
        return None
    about = subprocess.run([compiler, "-march=native", "-Q", "--help=target", "--version"], capture_output=True, check=False)
    key = hashlib.sha256(SOURCE.read_bytes() + about.stdout + " ".join((compiler, *FLAGS)).encode()).hexdigest()[:16]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "udkjax-benchmarks"
    target = folder / f"linkage-{key}"
    if not target.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as there:
            built = Path(there) / "linkage"
            subprocess.run([compiler, *FLAGS, str(SOURCE), "-o", str(built)], check=True)
            built.replace(target)  # at once: another process may be building it too
    return target


def run(states: bool = False, starts: Any = None, **settings: Any) -> dict[str, Any]:
    """Run it; return what it prints, `seconds` the median CPU time of a run, with `states` (starts, outputs, 24) if asked for.

    Settings are those in the head of linkage.cpp; `starts` are the angles of a batch, in rad.
    """
    found = program()
    if found is None:
        raise FileNotFoundError("no C++ compiler")
    with tempfile.TemporaryDirectory() as there:
        if starts is not None:
            np.asarray(starts, float).tofile(Path(there) / "starts")
            settings["starts"] = Path(there) / "starts"
        if states:
            settings["dump"] = Path(there) / "states"
        words = [f"{name}={value!r}" if isinstance(value, float) else f"{name}={value}" for name, value in settings.items()]
        figures = json.loads(subprocess.run([str(found), *words], capture_output=True, check=True, text=True).stdout)
        if states:
            figures["states"] = np.fromfile(settings["dump"]).reshape(-1, int(settings.get("outputs", 401)), STATE)
    return figures


def version() -> str | None:
    """Name the compiler."""
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    return compiler and subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True).stdout.splitlines()[0]
