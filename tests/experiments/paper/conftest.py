"""The dataset of a study whose runs are made up."""

import numpy as np
import pytest

import udkjax as udk

pytest.importorskip("experiments.paper", reason="not in a source tree")

from experiments.paper.cases import Case, Scope, plan
from experiments.paper.drift_law import growth_rate, swing_of
from experiments.paper.record import dataset

SCOPE = Scope(
    "made up",
    tolerances=(1e-8, 1e-6),
    stiff_end=2.0,
    starts=2,
    others=("VODE", "Dopri8"),
    work_tolerances=(1e-6, 1e-8),
    gains_for=("SVD",),
)
INSTANTS = 81
LOST = {1e-8: 10.0, 1e-6: 13.0}  # s


@pytest.fixture(scope="session")
def study_data():
    """The dataset of a study whose runs are made up: without stabilization the drift grows by its law until `LOST`."""
    mech = udk.library.parallelogram()
    state = udk.assemble(mech)
    rate = growth_rate(swing_of(mech, state.q))
    cases = plan(SCOPE)
    cases += [
        Case("work", method, solver, tol, alpha=3.0, beta=3.0)
        for method, solver, tol in (("SVD", "Adams", 1e-6), ("SVD", "Adams", 1e-8))
    ]
    rows = [made_up(case, number, rate) for number, case in enumerate(cases)]
    settings = {"scope": "made up", "max_steps": 1000, "start": -45.0, "seed": 3, "solver": "Adams"}
    return dataset(mech, state, cases, rows, settings, {"seconds": 61.5, "seconds_compiling": 40.25})


def made_up(case: Case, number: int, rate: float) -> dict:
    """One run. All its numbers differ from those of the other runs."""
    ts = np.linspace(0.0, case.end, INSTANTS)
    drifts = case.alpha < 2 and case.group in ("paper", "other integrators", "rank held", "start", "law")
    sigma = 1e-15 * np.exp((rate - case.alpha) * ts) if drifts else np.full(INSTANTS, 1e-15)
    lost = drifts and case.alpha == 0
    error = np.where(ts > LOST[case.tol], 1.0, case.tol) if lost else np.full(INSTANTS, case.tol * (1 + number / 1000))
    fails = case.method == "Varga" and case.group == "paper" and case.alpha == 0 and case.tol == 1e-8
    alive = ts <= (7.3 if fails else case.end)
    history = lambda values: np.where(alive, values, np.nan)  # noqa: E731
    return {
        "time": ts,
        "angle": history(-np.pi / 4 * np.cos(3 * ts)),
        "angle_error": history(error),
        "position_error": history(error / 2),
        "psi2": history((1.1 + number / 100) * sigma**2),
        "psi_dot2": history(sigma**2),
        "energy": history(error / 3),
        "sigma_1": history(3.0 + 0 * ts),
        "sigma_11": history(0.7 + 0 * ts),
        "sigma_12": history(sigma),
        "rank": history(np.where(sigma > (case.rank_tol or 1e-4), 12.0, 11.0)),
        "rank_tol": case.rank_tol or 3e-4,
        "end": 7.3 if fails else case.end,
        "result": "step_limit" if fails else "successful",
        "cpu": 0.0101 * (number + 1),
        "repeats": 3,
        "steps": 1300 + number,
        "accepted": 1200 + number,
        "rejected": 100,
        "right_hand_sides": 15000 + number,
        "projections": 0,
    }
