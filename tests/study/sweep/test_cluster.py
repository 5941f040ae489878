"""Sweeps on the workers of a cluster, some of which are lost."""

import os
import signal
import sys
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from udkjax.extras import MissingExtraError
from udkjax.study.sweep import executors as cluster
from udkjax.study.sweep.executors import ClusterError, dask_engine
from udkjax.study.sweep.plan import Chunk

dask_config = pytest.importorskip("dask.config", reason="dask is not installed: pip install '.[dask]'")
distributed = pytest.importorskip("distributed", reason="dask is not installed: pip install '.[dask]'")

CHUNKS = [Chunk(k, 0, np.arange(3 * k, 3 * k + 3), 1.0) for k in range(40)]
PLAN: Any = SimpleNamespace(factor=2.0)


@pytest.fixture(scope="module")
def client():
    """Workers that are threads of this process."""
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


def compute(monkeypatch, run):
    monkeypatch.setattr(cluster, "run", lambda plan, chunk: (chunk, run(plan, chunk), 1.0))


def squares(plan, chunk):
    return {"result": np.zeros(3, int), "square": plan.factor * chunk.members**2.0}


def test_every_chunk_is_computed_once_and_few_are_under_way(client, monkeypatch):
    lock, computed, most = threading.Lock(), [], 0
    handed = 0

    def run(plan, chunk):
        nonlocal most
        with lock:
            computed.append(chunk.index)
            most = max(most, len(computed) - handed)
        return squares(plan, chunk)

    compute(monkeypatch, run)
    found = {}
    for chunk, data, seconds in dask_engine(client)(PLAN, CHUNKS):
        handed += 1
        found[chunk.index] = data["square"]
        assert seconds == 1.0
    assert sorted(computed) == list(range(40)) and most <= cluster.LEAST_TASKS + 1
    for chunk in CHUNKS:
        np.testing.assert_array_equal(found[chunk.index], 2.0 * chunk.members**2.0)


def test_what_raises_once_is_tried_again_and_what_always_does_is_told(client, monkeypatch):
    tried = []

    def run(plan, chunk):
        tried.append(chunk.index)
        if chunk.index == 3 and tried.count(3) < failures:
            raise OSError("no space left")
        return squares(plan, chunk)

    compute(monkeypatch, run)
    failures = cluster.CHUNK_RETRIES + 1
    assert len(list(dask_engine(client)(PLAN, CHUNKS[:5]))) == 5
    assert tried.count(3) == failures and tried.count(2) == 1
    failures, tried = 10**6, []
    with pytest.raises(OSError, match="no space left"):
        list(dask_engine(client)(PLAN, CHUNKS))


def test_a_sweep_that_is_given_up_leaves_nothing_on_the_cluster(client, monkeypatch):
    gate, first = threading.Event(), threading.Lock()

    def run(plan, chunk):
        if plan.factor == 3.0 and not first.acquire(blocking=False):  # not what an earlier test has left
            gate.wait(10)
        return squares(plan, chunk)

    compute(monkeypatch, run)
    mine: Any = SimpleNamespace(factor=3.0)
    results = dask_engine(client)(mine, CHUNKS)
    next(results)
    results.close()
    gate.set()
    deadline = time.monotonic() + 5
    while client.cluster.scheduler.tasks and time.monotonic() < deadline:
        time.sleep(0.02)
    assert client.cluster.scheduler.tasks == {}


def test_workers_with_other_versions_are_refused(client, monkeypatch):
    compute(monkeypatch, squares)
    engine = dask_engine(client)
    mine, main = cluster._deciding_versions(), threading.current_thread()
    other = mine | {"jax": "0.1"}
    monkeypatch.setattr(cluster, "_deciding_versions", lambda: mine if threading.current_thread() is main else other)
    with pytest.raises(ClusterError, match=rf"jax 0\.1 instead of {mine['jax']}$"):
        list(engine(PLAN, CHUNKS))


@pytest.mark.slow
def test_a_chunk_that_kills_its_workers_is_named():
    """In separate processes, with a scheduler that tolerates fewer deaths."""

    class Deadly:
        @property
        def groups(self):
            os.kill(os.getpid(), signal.SIGKILL)

    deadly: Any = Deadly()
    with (
        dask_config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as local,
        distributed.Client(local) as client,
        pytest.raises(ClusterError, match=r"several workers died while computing chunk 0 \(3 members\)"),
    ):
        list(dask_engine(client)(deadly, CHUNKS[:1]))


def test_without_dask_or_a_client_the_cure_is_told(monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(distributed, "default_client", lambda: (_ for _ in ()).throw(ValueError))
        with pytest.raises(ClusterError, match=r"client=distributed\.Client"):
            dask_engine()
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'udkjax\[dask\]'"):
        dask_engine()
