"""A sweep of 100,000 ten-second runs of the paper's linkage: throughput, memory, and the cost of a kill in the middle."""

import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from benchmarks.batch import MEMBERS, angles, states
from benchmarks.common import Compiled
from udkjax.threads import thread_count

LINKS = ("link1", "link2", "link3")
END = 10.0  # s
MEMORY = 40  # bytes for each member of the sweep: small, to get many chunks, one of which is hit by the kill
KILLED = 0.5  # fraction of the members


class Size(NamedTuple):
    """Number of values on each axis."""

    masses: int
    lengths: int
    angles: int
    tolerances: int


FULL, SMOKE = Size(20, 10, 25, 20), Size(2, 2, 2, 16)


def arguments(size: Size, end: float) -> dict[str, Any]:
    """Return the axes: mass and length of the links, tied; their angle of release, hanging; and tolerance."""
    return {
        "axes": {
            "mass": udk.Axis(np.geomspace(0.5, 2.0, size.masses), of=[f"body.{link}.mass" for link in LINKS], units="kg"),
            "length": udk.Axis(np.geomspace(0.5, 2.0, size.lengths), of=_length, units="m"),
            "start": udk.Axis(np.deg2rad(np.linspace(-80.0, -20.0, size.angles)), of=_angle, units="rad"),
            "tol": udk.Axis(tolerances(size), of=("rtol", "atol")),
        },
        "ts": [0.0, end],
        "measure": ("final", "violation"),
    }


def tolerances(size: Size) -> np.ndarray:
    """Return the tolerances of the members."""
    return np.geomspace(1e-10, 1e-4, size.tolerances)


def _length(mechanism: Any, length: Any) -> Any:
    return udk.with_length(mechanism, LINKS, length)


def _angle(mechanism: Any, angle: Any) -> Any:
    return udk.with_angle(mechanism, LINKS, angle)


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Sweep once, and once more with a kill in the middle; print the cost of both and of the same work by `jax.vmap` alone."""
    size, end = (SMOKE, 0.2) if smoke else (FULL, END)
    count = int(np.prod(size))
    before = single_program(size, end, smoke)
    with tempfile.TemporaryDirectory() as folder:
        whole = _process(size, end, f"{folder}/whole")
        broken = _process(size, end, f"{folder}/killed", killed=True)
        assert broken == {}, "it was not killed"
        kept = sorted(Path(folder, "killed", "chunks").glob("*.npz"))
        stamps = [file.stat().st_mtime_ns for file in kept]
        resumed = _process(size, end, f"{folder}/killed")
        assert [file.stat().st_mtime_ns for file in kept] == stamps, "a finished chunk was written again"
        identical = Path(folder, "whole.digest").read_text() == Path(folder, "killed.digest").read_text()
    assert identical, "the resumed sweep is not the same"
    after = single_program(size, end, smoke)
    alone = {key: (before[key] + after[key]) / 2 for key in before}
    row = {
        "name": "sweep",
        "members": count,
        "per_second": whole["members"] / whole["cpu"],
        "alone_per_second": alone["per_second"],
        "throughput": whole["members"] / whole["cpu"] / alone["per_second"],
        "throughput_of_steps": whole["steps"] / whole["cpu"] / alone["steps_per_second"],
        "wall_s": whole["wall"],
        "cores": thread_count(),
        "gib": max(whole["bytes"], resumed["bytes"]) / 2**30,
        "kept_when_killed": len(kept),
        "resumed_members": resumed["members"],
        "identical": int(identical),
    }
    rate, share = row["per_second"], row["throughput"]
    print(f"{count} members of {end:g} s: {rate:.0f} per second and core, {row['wall_s']:.1f} s in all on {thread_count()} cores")
    print(f"by vmap alone {alone['per_second']:.0f}: {share:.2f} of that, {row['throughput_of_steps']:.2f} by steps")
    print(f"{row['gib']:.2f} GiB at most")
    print(f"killed with {len(kept)} chunks finished; resumed with {resumed['members']} members left; the same, bit by bit")
    return [row]


def single_program(size: Size, end: float, smoke: bool) -> dict[str, float]:
    """Return runs and steps per second of CPU time by `jax.vmap` alone, as in `batch`, at the sweep's tolerances."""
    mechanism, ts, members = udk.library.parallelogram(), np.array([0.0, end]), 16 if smoke else MEMBERS
    y0 = states(angles(-45.0, members))

    def one(y0, tol):
        sol = udk.simulate(mechanism, ts, udk.State(y0[:12].reshape(4, 3), y0[12:].reshape(4, 3)), tol, tol, throw=False)
        return sol.q[-1], sol.stats["steps"]

    run = Compiled(jax.vmap(one, in_axes=(0, None)), y0, jnp.asarray(1e-6))
    seconds = steps = 0.0
    for tol in tolerances(size):
        seconds += run.cpu_seconds(y0, jnp.asarray(float(tol)))
        steps += float(run(y0, jnp.asarray(float(tol)))[1].sum())
    return {"per_second": members * size.tolerances / seconds, "steps_per_second": steps / seconds}


def _process(size: Size, end: float, folder: str, killed: bool = False) -> dict[str, float]:
    """Run the sweep in a process of its own; return its cost, or None if it was killed as intended."""
    words = [sys.executable, "-m", "benchmarks.sweep", json.dumps({"size": size, "end": end, "folder": folder, "killed": killed})]
    ran = subprocess.run(words, capture_output=True, text=True, check=False)
    if killed and ran.returncode == -signal.SIGKILL:
        return {}
    if ran.returncode:
        raise RuntimeError(ran.stderr)
    return json.loads(ran.stdout.splitlines()[-1])


def _sweep(size: Size, end: float, folder: str, killed: bool) -> dict[str, float]:
    """Measure, in this process, the sweep after its program is compiled and its members are sorted."""
    import hashlib
    import os
    import resource

    begun, seen = time.perf_counter(), []

    def progress(status: Any) -> None:
        seen.append((status.done, time.process_time()))
        if killed and status.done >= KILLED * status.total:
            os.kill(os.getpid(), signal.SIGKILL)

    memory = MEMORY * int(np.prod(size))
    data = udk.sweep(udk.library.parallelogram(), **arguments(size, end), out=folder, memory=memory, progress=progress)
    names = sorted(map(str, data.data_vars))
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(data[name].values).tobytes() for name in names))
    Path(f"{folder}.digest").write_text(digest.hexdigest())
    assert int((data.result != 0).sum()) == 0, "members failed"
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "members": seen[-1][0] - seen[0][0],
        "cpu": seen[-1][1] - seen[0][1],
        "steps": float(data.steps.sum()),
        "wall": time.perf_counter() - begun,
        "bytes": most if sys.platform == "darwin" else most * 1024,
    }


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    print(json.dumps(_sweep(Size(*given["size"]), given["end"], given["folder"], given["killed"])))
