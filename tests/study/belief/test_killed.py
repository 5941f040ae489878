"""Processes that are killed while they draw: their folders are continued to the same bits."""

import signal

import pytest
from numpy.testing import assert_array_equal

pytest.importorskip("arviz")
interrupted = pytest.importorskip("experiments.parts.interrupted_draws", reason="not in a source tree")


@pytest.mark.slow
def test_a_killed_process_continues_to_the_same_bits(tmp_path):
    whole = interrupted.draw_few(None)
    for when, count in (("between chunks", 4), ("in a write", 3)):
        folder = tmp_path / when
        assert interrupted.killed(when, str(folder)) == -signal.SIGKILL
        finished = {file.name: file.read_bytes() for file in (folder / "chunks").glob("*.npz")}
        assert len(finished) == count
        again = interrupted.draw_few(str(folder))
        for name in ("x", "log_density", "acceptance", "steps"):
            assert_array_equal(getattr(again, name), getattr(whole, name))
        after = {file.name: file.read_bytes() for file in (folder / "chunks").iterdir()}
        assert finished.items() <= after.items() and len(after) == 6  # the start, two chunks of warm-up, and three of draws
