"""Draws from a posterior in processes that are killed, and whose folders another process continues."""

import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import udkjax as udk


def draw_few(folder: str | None, **more: Any) -> Any:
    """Return draws of a small density, stored in a folder."""
    rod, ts = udk.library.compound_pendulum(angle=1.2), np.linspace(0.0, 3.0, 40)
    spring = udk.TorsionSpring(("ground", "rod"), stiffness=3.0, damping=0.2)
    mech = udk.Mechanism(rod.bodies, rod.joints, forces={"spring": spring})
    measured = np.asarray(udk.simulate(mech, ts).q)[:, 0, 2] + 0.02 * np.cos(97.0 * ts)
    record = udk.Record(ts, {"body.rod.angle": measured}, 0.02)
    problem = udk.inference(mech, record, ["body.rod.inertia", "force.spring.damping"])
    return udk.sample(problem, chains=4, draws=75, warmup=50, out=folder, **({"progress": False} | more))


def killed(when: str, folder: str) -> int:
    """Draw in a new process that kills itself "between chunks" or "in a write"; return its exit code."""
    arrange = "progress = lambda status: status.done < 75 or kill()"
    if when == "in a write":
        arrange = "os.replace, progress = lambda a, b: replace(a, b) if '000003-' not in str(b) else kill(), False"
    code = f"""
import os, signal, sys
from experiments.parts.interrupted_draws import draw_few
kill, replace = lambda: os.kill(os.getpid(), signal.SIGKILL), os.replace
{arrange}
draw_few(sys.argv[1], progress=progress)
"""
    return subprocess.run([sys.executable, "-c", code, folder], check=False).returncode


def continues(when: str) -> bool:
    """Return whether a killed process's folder is continued to the same bits."""
    with tempfile.TemporaryDirectory() as folder:
        assert killed(when, folder) == -signal.SIGKILL
        assert len(list((Path(folder) / "chunks").glob("*.npz"))) < 6
        return draw_few(folder).x.tobytes() == draw_few(None).x.tobytes()
