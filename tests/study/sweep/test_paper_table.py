"""The paper's table as one sweep, in examples/paper_table.py."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import udkjax as udk

FILE = Path(__file__).parents[3] / "examples" / "paper_table.py"


@pytest.mark.slow
def test_it_has_all_runs_and_each_is_what_it_is_alone(tmp_path):
    spec: Any = importlib.util.spec_from_file_location("paper_table", FILE)
    example: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    data = example.table(0.5, tmp_path, progress=False)
    assert {dim: data.sizes[dim] for dim in ("pseudoinverse", "tol", "stabilization", "time")} == {
        "pseudoinverse": 5,
        "tol": 3,
        "stabilization": 2,
        "time": 401,
    }
    assert (data.result == 0).all() and (data["rank"] == 11).all()
    assert (data.angle_error.max(("pseudoinverse", "stabilization")) < 10 * data.tol).all()
    mech, ts = udk.library.parallelogram(), np.linspace(0.0, 0.5, 401)
    for gains, method, tol in ((0, 4, 1e-6), (1, 0, 1e-8)):
        alone = udk.simulate(
            mech,
            ts,
            rtol=tol,
            atol=tol,
            method=example.METHODS[method].absolute(tol),
            stabilization=udk.Baumgarte(1000.0 * gains, 100.0 * gains),
            solver=udk.Adams(),
            dt0=0.66e-2,
            drift_tol=np.inf,
        )
        one = data.isel(pseudoinverse=method, stabilization=gains).sel(tol=tol)
        for count in ("accepted", "rejected", "right_hand_sides"):
            assert int(one[count]) == int(alone.stats[count])
