"""What is said of a sweep before it is run, with programs that are made up."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from udkjax.study.sweep import cost
from udkjax.study.sweep.cost import estimate_cost

GROUPS = [SimpleNamespace(index=k, members=np.arange(1000 * k, 1000 * k + 1000)) for k in range(5)]
PLAN: Any = SimpleNamespace(size=5000, groups=GROUPS)


@pytest.fixture
def tried(monkeypatch):
    """Each program takes 3 s to compile; a piece of 64 lanes takes 2 s, of which half of the lanes wait half of the time."""
    clock, seen = SimpleNamespace(now=0.0), []

    def run(plan, chunk):
        clock.now += 2.0 + 3.0 * (chunk.group not in seen)
        seen.append(chunk.group)
        assert set(chunk.members) <= set(GROUPS[chunk.group].members) and len(set(chunk.members)) == 64
        return {"steps": np.where(np.arange(64) < 32, 50, 100)}

    monkeypatch.setattr(cost, "run", run)
    monkeypatch.setattr(cost, "program", lambda plan, group: SimpleNamespace(piece=64, lanes=64, devices=[None]))
    monkeypatch.setattr(cost, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    monkeypatch.setattr(cost, "concurrent_chunks", lambda: 2)
    monkeypatch.setattr(cost, "bytes_per_member", lambda plan: 100)
    monkeypatch.setattr(cost, "cut_chunks", lambda plan, memory: [None] * 7)
    return seen


def test_a_sample_of_some_groups_says_how_long_all_take(tried):
    found = estimate_cost(PLAN)
    assert sorted(set(tried)) == [0, 2, 4]
    assert (found.members, found.groups, found.tried, found.chunks, found.stored) == (5000, 5, 3, 7, 500_000)
    assert found.compiling == pytest.approx(15.0)
    assert found.computing == pytest.approx(5000 * 2.0 * 0.75 / 64 / 2)
    assert found.memory > 2 * 500_000
