"""Interrupted sweeps continue where they stopped, with results identical to the last bit."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray

import udkjax as udk
from udkjax.study.sweep.store import StoreError

CHUNKS, PIECE = 10, 64


def sweep(inertia: Any = None, **choices: Any) -> Any:
    """640 pendulums in ten chunks, as small as chunks can be."""
    axes = {
        "body.rod.inertia": udk.Axis(np.linspace(0.05, 0.5, 80), of=inertia),
        "tol": udk.Axis(10.0 ** np.arange(-9, -1), of=("rtol", "atol")),
    }
    settings = {"method": udk.Elimination(), "stabilization": None, "progress": False, **choices}
    return udk.sweep(udk.library.compound_pendulum(), axes, [0.0, 1.0], ("final", "violation"), memory=1, **settings)


@pytest.fixture(scope="module")
def whole() -> Any:
    """The result of the uninterrupted sweep."""
    return sweep()


def chunks(folder: Path) -> dict[str, int]:
    """The finished chunks, and when each was written."""
    return {file.name: file.stat().st_mtime_ns for file in (folder / "chunks").glob("*.npz")}


@pytest.mark.slow
@pytest.mark.parametrize("when", ["between two chunks", "before a chunk has its name"])
def test_a_killed_sweep_goes_on(tmp_path, whole, when):
    if when == "between two chunks":
        arrange = f"progress = lambda status: status.done < {3 * PIECE} or kill()"
    else:
        arrange = (
            "os.replace, progress = lambda a, b: str(b).endswith('npz') and next(count) == 3 and kill() or replace(a, b), False"
        )
    code = f"""
import importlib.util, itertools, os, signal, sys
spec = importlib.util.spec_from_file_location("test_resume", {str(Path(__file__))!r})
module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module)
kill, count, replace = lambda: os.kill(os.getpid(), signal.SIGKILL), itertools.count(), os.replace
{arrange}
module.sweep(out=sys.argv[1], progress=progress)
"""
    ran = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert ran.returncode == -signal.SIGKILL
    before, seen = chunks(tmp_path), []
    assert len(before) == 3
    data = sweep(out=tmp_path, progress=seen.append)
    assert seen[0].done == 3 * PIECE and len(seen) == 1 + CHUNKS - 3
    after = chunks(tmp_path)
    assert len(after) == CHUNKS and before.items() <= after.items()  # none was written twice
    assert sorted(file.name for file in (tmp_path / "chunks").iterdir()) == sorted(after)  # and nothing else is there
    xarray.testing.assert_identical(data, whole)


def test_a_sweep_that_is_done_computes_nothing_and_another_is_refused(tmp_path, whole):
    sweep(out=tmp_path)
    before, seen = chunks(tmp_path), []
    xarray.testing.assert_identical(sweep(out=tmp_path, progress=seen.append), whole)
    assert [status.done for status in seen] == [CHUNKS * PIECE] and chunks(tmp_path) == before
    with pytest.raises(StoreError, match=r"settings\.drift_tol: was missing, is now 0\.001"):
        sweep(out=tmp_path, drift_tol=1e-3)


def test_a_full_disk_loses_nothing_that_is_finished(tmp_path, monkeypatch, whole):
    fsync, calls = os.fsync, iter(range(100))

    def full(file: int) -> None:
        if next(calls) >= 8:  # a file and its folder, four times
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(file)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(StoreError, match=r"No space left on device; the 3 finished chunks in .* stay valid"):
            sweep(out=tmp_path)
    before = chunks(tmp_path)
    assert len(before) == 3
    xarray.testing.assert_identical(sweep(out=tmp_path), whole)
    assert before.items() <= chunks(tmp_path).items()


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_nothing_but_time(tmp_path, whole):
    """Worker processes and a scheduler as on a cluster; one is killed in the middle of a chunk, another between two chunks."""
    distributed = pytest.importorskip("distributed", reason="dask is not installed: pip install '.[dask]'")
    flag, here = str(tmp_path / "killed"), os.getpid()

    def inertia(mechanism, value):
        if os.getpid() != here and not os.path.exists(flag):
            open(flag, "w").close()
            os.kill(os.getpid(), signal.SIGKILL)
        return mechanism.with_parameters({"body.rod.inertia": value})

    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        alive = client.run(os.getpid)
        assert len(alive) == 2 and os.getpid() not in alive.values()

        def kill(status):
            if status.done == 2 * PIECE:
                os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)

        data = sweep(inertia=inertia, out=tmp_path / "sweep", client=client, progress=kill)
        assert os.path.exists(flag) and not set(alive.values()) <= set(client.run(os.getpid).values())
        assert len(chunks(tmp_path / "sweep")) == CHUNKS
        xarray.testing.assert_equal(data, whole)
