"""Work and precision of other programs on the paper's linkage: 20 s from rest at -45 and +60 degrees, each set up for accuracy.

There is one module for each program, imported only to run it: `pip install .[peers]` installs those that have wheels, and missing
ones are named. Each program runs in its own process, on one thread, so that a crash does not affect the others.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from benchmarks.peers.peer import Peer

MODULES = ("scipy_numpy", "numba_lsoda", "pinocchio_scipy", "mujoco_rk4", "mjx_batch", "exudyn_alpha", "drake_discrete")
SMOKE = 0.5  # s of the trajectory
LIMIT = 1200.0  # s of wall time for all runs of one module
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMBA")}


PEERS_OF: dict[str, tuple[Peer, ...]] = {module: import_module(f"{__name__}.{module}").PEERS for module in MODULES}
PEERS = tuple(peer for peers in PEERS_OF.values() for peer in peers)


def missing() -> list[str]:
    """Return the packages that are not installed."""
    return list(dict.fromkeys(peer.package for peer in PEERS if peer.available() is None))


def rows(module: str, smoke: bool = False) -> Iterator[dict]:
    """Run the measurements of a module in this process: {name, version, batch, start, end, knob, error, seconds}.

    `start` is in degrees, `error` the largest of any coordinate at outputs 0.05 s apart (m, rad), `seconds` the CPU time of one
    trajectory until `end` (s). In place of it, a batch has its `trajectories_per_second` of CPU time.
    """
    for peer in PEERS_OF[module][: 1 if smoke else None]:
        if not (version := peer.available()):
            continue
        about = {"name": peer.name, "version": version, "batch": peer.batch}
        for start in peer.starts[: 1 if smoke else None]:
            end = SMOKE if smoke else peer.end
            for row in peer.curve(start, peer.knobs[:1] if smoke else None, end):
                if peer.batch > 1:
                    row["trajectories_per_second"] = 1 / row.pop("seconds")
                yield about | {"start": start, "end": end} | row


def elsewhere(module: str, smoke: bool) -> list[dict]:
    """Run `rows` in a process of its own, on one thread; return the rows until a failure, and a line with the reason."""
    command = [sys.executable, "-m", "benchmarks.peers", module, *(["--smoke"] if smoke else [])]
    place, environment = Path(__file__).parents[2], os.environ | ONE_THREAD
    with TemporaryFile("w+") as printed, TemporaryFile("w+") as errors:
        try:
            subprocess.run(command, cwd=place, env=environment, stdout=printed, stderr=errors, timeout=LIMIT, check=True)
        except subprocess.SubprocessError as failed:
            errors.seek(0)
            print(f"{module}: {failed}\n{errors.read().strip()[-500:]}")
        printed.seek(0)
        return [json.loads(line) for line in printed if line.startswith('{"name"')]


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the error and time of each program, and name the missing ones."""
    figures = []
    print(f"{'peer':32} {'version':9} {'start':>6} {'batch':>6} {'knob':>8} {'error':>9} {'CPU time':>9}")
    for module in MODULES:
        if not any(peer.available() for peer in PEERS_OF[module]):
            continue
        for row in elsewhere(module, smoke):
            figures.append(row)
            cost = f"{row['seconds'] * 1e3:9.2f} ms" if "seconds" in row else f"{row['trajectories_per_second']:9.0f} 1/s"
            place = f"{row['name']:32} {row['version']:9} {row['start']:6.0f} {row['batch']:6d}"
            print(f"{place} {row['knob']:8.1e} {row['error']:9.1e} {cost}")
    if absent := missing():
        print(f"not installed: {', '.join(absent)}")
    return figures
