"""Progress reports of sweeps."""

from importlib import import_module

import numpy as np
import pytest

from udkjax.integrate import Result
from udkjax.progress import report_progress
from udkjax.study.sweep.plan import Chunk
from udkjax.study.sweep.sweep import SweepProgress, Watch, duration

CHUNKS = [Chunk(k, 0, np.arange(4 * k, 4 * k + 4), 2.0 if k == 3 else 1.0) for k in range(5)]


def result(*codes):
    return {"result": np.array([*codes, *[0] * (4 - len(codes))])}


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set by the test."""

    class Clock:
        now = 100.0

        def monotonic(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(import_module("udkjax.study.sweep.sweep"), "time", clock)
    return clock


def test_a_sweep_is_followed(clock):
    seen: list[SweepProgress] = []
    watch = Watch(20, 4, seen.append, [0, 0, Result.drift, 0])
    assert seen[-1] == SweepProgress("sweep", 4, 20, 0.0, "failed: 1 drift", failures={"drift": 1})
    clock.now += 8  # of which most went into a compilation
    watch(CHUNKS[2], {**result(Result.step_limit), "steps": np.array([3, 9, 7, 1])}, 7.5)
    state = seen[-1]
    assert (state.done, state.seconds, state.rate, state.left) == (8, 8.0, 0.5, None)
    assert (state.failures, state.slowest, state.slowest_chunk) == ({"drift": 1, "step_limit": 1}, (9, 9), (2, 7.5))
    watch.expect([CHUNKS[1], *CHUNKS[3:]])
    clock.now += 2
    watch(CHUNKS[1], {**result(Result.drift), "steps": np.array([3, 9, 7, 1])}, 2.0)
    state = seen[-1]
    assert (state.done, state.seconds, state.rate, state.left) == (12, 10.0, 0.8, 6.0)
    assert (state.failures, state.slowest, state.slowest_chunk) == ({"drift": 2, "step_limit": 1}, (9, 9), (2, 7.5))
    clock.now += 4
    watch(CHUNKS[4], {**result(), "steps": np.array([3, 9, 7, 10])})
    assert seen[-1].left == 6.0 and seen[-1].slowest == (19, 10) and seen[-1].slowest_chunk == (2, 7.5)
    assert str(seen[-1]) == (
        "16 of 20 members (80 %); 0.857 per second; 6 s left; failed: 2 drift, 1 step limit; slowest chunk 2: 7.5 s; "
        "slowest member 19: 10 steps"
    )
    clock.now += 1
    watch(CHUNKS[3], result())
    assert str(seen[-1]).startswith("20 of 20 members (100 %); 1.07 per second; 15 s; failed")


def test_it_is_reported_as_everything_else_is(capsys):
    for option, says in ((False, False), (True, True)):
        with report_progress(option, 20, "sweep") as report:
            watch = Watch(20, 0, report.show)
            for chunk in CHUNKS:
                watch(chunk, result(Result.drift))
        out, err = capsys.readouterr()
        assert out == "" and ("sweep: 100%" in err and "failed: 5 drift" in err) == says


def test_a_duration_in_words():
    assert [duration(x) for x in (0.4, 119, 121, 7000, 7300, 90000)] == [
        "0 s",
        "119 s",
        "2 min",
        "117 min",
        "2 h 2 min",
        "25 h 0 min",
    ]
