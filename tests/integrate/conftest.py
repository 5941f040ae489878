import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="session")
def data():
    """A file of reference values, by its name."""
    return lambda name: json.loads((DATA / f"{name}.json").read_text())


@pytest.fixture(scope="session")
def table():
    """Rows of reference values by time, as times and one array a column."""

    def columns(reference, times=None):
        rows = {float(t): row for t, row in reference.items() if times is None or float(t) in times}
        ts = np.array(sorted(rows))
        return ts, {key: np.array([np.asarray(rows[t][key], float) for t in ts]) for key in rows[ts[0]]}

    return columns


@pytest.fixture(scope="session")
def placed():
    """q and v (4, 3) of the paper's linkage with its links at `theta` (rad), turning at `rate` (rad/s)."""

    def pose(theta, rate):
        def q(s):
            e = jnp.stack([jnp.cos(s), jnp.sin(s)])
            links = [jnp.append(jnp.array([x, 0.0]) + e / 2, s) for x in (0.0, 1.0, 2.0)]
            return jnp.stack([*links, jnp.append(jnp.array([1.0, 0.0]) + e, 0.0 * s)])

        return jax.jvp(q, (jnp.asarray(theta, float),), (jnp.asarray(rate, float),))

    return pose
