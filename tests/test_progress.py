"""Progress means the same in every function: a line after two seconds, at once, or never, or a user's callable."""

import threading
import time
from itertools import pairwise

import pytest

from udkjax.progress import Progress, report_progress


def work(progress, steps=4, pause=0.0, **choices):
    with report_progress(progress, steps, "count", **choices) as report:
        for k in range(steps):
            report(message=f"number {k}")
            time.sleep(pause)
            report(k + 1, f"number {k}")


def test_a_callable_gets_each_state():
    seen: list[Progress] = []
    work(seen.append)
    assert [state.done for state in seen] == [0, 1, 1, 2, 2, 3, 3, 4]
    assert {(state.what, state.total) for state in seen} == {("count", 4)} and seen[-1].message == "number 3"
    assert all(one.seconds <= two.seconds for one, two in pairwise(seen))


def test_what_a_callable_raises_ends_the_computation():
    def stop(state):
        if state.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work(stop)


def test_false_is_silent_and_true_is_not(capsys):
    work(False)
    assert capsys.readouterr() == ("", "")
    work(True)
    shown = capsys.readouterr()
    assert shown.out == "" and "count: 100%" in shown.err and "number 3" in shown.err


@pytest.mark.parametrize("progress", [None, "auto"])
def test_by_default_there_is_a_line_only_after_the_time_of_patience(capsys, progress):
    work(progress)
    assert capsys.readouterr() == ("", "")
    work(progress, pause=0.05, patience=0.02, interval=0.0)
    assert "100%" in capsys.readouterr().err


def test_the_line_appears_while_the_first_piece_takes_long(capsys):
    with report_progress(None, None, "compile", patience=0.02):
        for _ in range(100):
            time.sleep(0.02)
            if "compile: 00:0" in capsys.readouterr().err:
                return
    pytest.fail("there was no line")


def test_nothing_remains_of_it():
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError), report_progress(None, 1, "fail", patience=60.0):
        raise ZeroDivisionError
    for _ in range(100):
        if threading.active_count() == before:
            return
        time.sleep(0.02)
    pytest.fail("the timer goes on")


def test_what_is_left_and_the_text():
    assert Progress("sweep", 25, 100, 10.0).left == pytest.approx(30.0)
    assert Progress("sweep", 0, 100, 10.0).left is None and Progress("fit", 3, None, 1.0).left is None
    assert str(Progress("sweep", 25, 100, 10.0, "none failed")) == "sweep: 25 % (10 s, about 30 s left) none failed"
    assert str(Progress("fit", 3, None, 1.2, "step 3")) == "fit: (1 s) step 3"


def test_other_values_are_refused():
    with pytest.raises(TypeError, match='progress must be None, "auto", True, False or a function'):
        work("loud")
