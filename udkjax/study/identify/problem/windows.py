"""Windows of long records: parts whose derivatives fit into memory together."""

import jax
import numpy as np
from jaxtyping import Int

from udkjax.study.identify.problem.prediction import Runs
from udkjax.study.identify.records.records import pad_times

# Size (bytes) of the states and channels with their derivatives that are computed together, and of those of a window.
BLOCK_BYTES, WINDOW_BYTES = 2**28, 2**27
LEAST_WINDOW = 100  # least number of times of a window, as each window takes a run


def cut_into_windows(
    runs: Runs, index: Int[np.ndarray, "R 3"], length: int
) -> tuple[Runs, Int[np.ndarray, "records"], Int[np.ndarray, "R"], Int[np.ndarray, "R"]]:
    """Cut the runs of records (one each) into windows of at most `length` times.

    A window has the first time of its record, too, where the motion begins. Returned are the runs of all windows, the first
    window of each record, and the window and time of each row of `index`.
    """
    record, time, _ = index.T
    count, times = runs.ts.shape
    windows = -(-(times - 1) // length)
    if windows == 1:
        return runs, np.arange(count), record, time
    length = -(-(times - 1) // windows)
    later = [pad_times(ts[1:], windows * length).reshape(windows, length) for ts in runs.ts]
    ts = np.concatenate([np.column_stack([np.full(windows, ts[0]), own]) for ts, own in zip(runs.ts, later, strict=True)])
    of_window = jax.tree.map(lambda leaf: np.repeat(leaf, windows, axis=0), runs._replace(ts=np.zeros(count)))
    window, place = np.divmod(np.maximum(time - 1, 0), length)
    return of_window._replace(ts=ts), windows * np.arange(count), record * windows + window, np.where(time == 0, 0, place + 1)


def times_until(ts: np.ndarray, horizon: float) -> np.ndarray:
    """Return the times of a record up to `horizon` after its beginning, padded to the same length."""
    last = max(1, int(np.searchsorted(ts - ts[0], horizon, side="right")) - 1)
    return pad_times(ts[: last + 1], len(ts))
