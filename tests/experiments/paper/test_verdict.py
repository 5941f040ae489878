import numpy as np
import pytest

from experiments.paper.verdict import LOST, classify, lost_at

TS = np.linspace(0.0, 20.0, 401)


def grown(rate: float, seed: float = 1e-12) -> np.ndarray:
    return seed * np.exp(rate * TS)


@pytest.mark.parametrize(
    ("error", "end", "finished", "words"),
    [
        (grown(0.5), 20.0, True, "correct"),
        (grown(1.5), 20.0, True, "correct up to 15.35 s"),  # log(1e10) / 1.5 = 15.351
        (grown(1.5), 15.36, False, "fails at 15.36 s"),  # it ends before the instant at which the loss would be noticed
        (grown(1.5), 18.017, False, "correct up to 15.35 s, fails at 18.02 s"),
        (np.where(TS <= 9.1, grown(0.5), np.nan), 9.13, False, "fails at 9.13 s"),
        (np.where(TS == 12.0, np.nan, grown(0.5)), 20.0, True, "correct up to 11.95 s"),
        (np.where(TS == 12.0, np.inf, grown(0.5)), 20.0, True, "correct up to 11.95 s"),
        (np.where(TS == 5.0, 2 * LOST, 0.0), 20.0, True, "correct up to 4.95 s"),  # being right again by chance does not count
        (np.full_like(TS, LOST), 20.0, True, "correct"),
    ],
)
def test_a_run_is_judged_as_in_the_paper(error, end, finished, words):
    assert classify(TS, error, end, finished).words == words


def test_the_kinds_and_times_of_a_verdict():
    late = classify(TS, grown(1.5), 18.0, False)
    assert (late.kind, late.correct_to, late.failed_at) == ("correct up to", pytest.approx(15.35), 18.0)
    failed = classify(TS, grown(0.5), 9.0, False)
    assert (failed.kind, failed.correct_to, failed.failed_at) == ("fails", 9.0, 9.0)
    right = classify(TS, grown(0.5), 20.0, True)
    assert right.kind == "correct" and np.isnan([right.correct_to, right.failed_at]).all()


def test_a_threshold_ten_times_as_large_is_passed_later_by_the_law():
    times = [lost_at(TS, grown(1.77, 1e-16), 20.0, threshold) for threshold in (1e-3, 1e-2, 1e-1)]
    np.testing.assert_allclose(np.diff(times), np.log(10) / 1.77, atol=0.051)
    assert np.isnan(lost_at(TS, grown(0.1), 20.0))
