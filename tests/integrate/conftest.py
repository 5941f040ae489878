import numpy as np
import pytest


@pytest.fixture(scope="session")
def table():
    """Rows of reference values by time, as times and one array a column."""

    def columns(reference, times=None):
        rows = {float(t): row for t, row in reference.items() if times is None or float(t) in times}
        ts = np.array(sorted(rows))
        return ts, {key: np.array([np.asarray(rows[t][key], float) for t in ts]) for key in rows[ts[0]]}

    return columns
