"""Was a run right, and until when? The paper's three verdicts, by an exact solution instead of by eye."""

from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike

# rad. The paper compared diagrams. Its links swing through pi/2; 1e-2 rad of them is the width of a line in a diagram. A run that
# is being lost passes through a decade of error in 2.3 / 1.77 = 1.3 s, so little depends on the choice: `LOST_EARLY` and
# `LOST_LATE` say how much.
LOST = 1e-2
LOST_EARLY, LOST_LATE = 1e-3, 1e-1


class Verdict(NamedTuple):
    """`kind` is "correct", "correct up to" or "fails"; times in s, or NaN."""

    kind: str
    correct_to: float  # the last output time at which the angles were right
    failed_at: float  # when the solver gave up

    @property
    def words(self) -> str:
        """Return the words of the paper."""
        if self.kind == "correct":
            return "correct"
        if self.kind == "fails":
            return f"fails at {self.failed_at:.2f} s"
        return f"correct up to {self.correct_to:.2f} s" + (f", fails at {self.failed_at:.2f} s" if self.failed_at > 0 else "")


def classify(ts: ArrayLike, error: ArrayLike, end: float, finished: bool, threshold: float = LOST) -> Verdict:
    """Judge a run by its error (rad) at the times `ts` (s); it stopped at `end`, where it `finished` or gave up.

    A run is lost at the first output time at which the error exceeds `threshold` or is not a number. One that gives up before it
    is lost "fails"; one that is lost before, or without, giving up was "correct up to" the output time before.
    """
    lost = lost_at(ts, error, end, threshold)
    failed = np.nan if finished else float(end)
    if np.isnan(lost):
        return Verdict("correct" if finished else "fails", np.nan if finished else float(end), failed)
    before = np.asarray(ts)[np.asarray(ts) < lost]
    return Verdict("correct up to", float(before[-1]) if len(before) else float(lost), failed)


def lost_at(ts: ArrayLike, error: ArrayLike, end: float, threshold: float = LOST) -> float:
    """Return the first of the times `ts` up to `end` at which the error exceeds `threshold` or is not a number; else NaN."""
    ts, error = np.asarray(ts, float), np.asarray(error, float)
    wrong = ~(error <= threshold) & (ts <= end)
    return float(ts[np.argmax(wrong)]) if wrong.any() else float("nan")
