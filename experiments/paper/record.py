"""The study as one dataset: what a page about it can be drawn from, and nothing else is needed."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from udkjax.integrate.solution import versions
from udkjax.positions.assembling.assembly import State
from udkjax.scene import Mechanism, dumps
from udkjax.study.members import machine

from .cases import FIRST_STEP, GAINS, METHODS, RANK_HELD, SMALL_GAINS, Case
from .comparison import REMARKS, published_row, remark
from .drift_law import drift, growth_rate, swing_of
from .published import CITATION, TABLES
from .verdict import LOST, LOST_EARLY, LOST_LATE, Verdict, classify, lost_at

SECOND = -50.0  # degrees: the start that fits the paper's tables second best
FORMAT = "udkjax report 1"
# Growth is compared with the law between these sizes of sigma_12, above rounding and where it is still small.
FITTED = 1e-12, 1e-4
GROWN = 30.0  # growth needed to read a rate from it

HISTORIES = {
    "time": ("s", "instants at which the run was looked at"),
    "angle": ("rad", "angle of link1"),
    "angle_error": ("rad", "largest error of an angle, against the exact solution"),
    "position_error": ("m", "largest error of a coordinate of a centre of mass, against the exact solution"),
    "psi2": ("m2", "sum of the squared constraint violations"),
    "psi_dot2": ("m2/s2", "sum of the squared rates of the constraint violations"),
    "energy": ("J", "total energy minus that at the start"),
    "sigma_1": ("kg-1/2", "largest singular value of D"),
    "sigma_11": ("kg-1/2", "eleventh singular value of D"),
    "sigma_12": ("kg-1/2", "twelfth and least singular value of D: zero on the constraint manifold"),
    "rank": ("1", "rank of D by the method's own rule"),
}
NUMBERS = {
    "rank_tol": ("kg-1/2", "at or below it counts as zero"),
    "end": ("s", "time that was reached"),
    "cpu": ("s", "wall time of the run on one core after compilation, median of its repeats"),
    "repeats": ("1", "how often it was timed"),
    "steps": ("1", "steps tried"),
    "accepted": ("1", "steps accepted: the paper's NSTEPS"),
    "rejected": ("1", "steps rejected"),
    "right_hand_sides": ("1", "evaluations of the accelerations: the paper's NFUNC; -1: not known"),
    "projections": ("1", "returns to the constraint manifold"),
}


def save(data: Any, path: Path) -> None:
    """Write the dataset to a NetCDF file."""
    histories = [name for name in data.data_vars if data[name].ndim == 2]
    data.to_netcdf(path, engine="h5netcdf", encoding={name: {"zlib": True, "complevel": 4} for name in histories})


def read(path: Path) -> Any:
    """Read a dataset that `save` wrote; a file of anything else raises ValueError."""
    import xarray

    data = xarray.load_dataset(path, engine="h5netcdf")
    if data.attrs.get("format") != FORMAT:
        raise ValueError(f"this is not the data of a report: its format is {data.attrs.get('format')!r}, not {FORMAT!r}")
    return data


def dataset(
    mech: Mechanism,
    state: State,
    cases: list[Case],
    rows: list[dict[str, Any]],
    settings: dict[str, Any],
    times: dict[str, float],
) -> Any:
    """Return an xarray Dataset over `run` (and `instant`): the cases, their histories, verdicts and counts.

    All else on the page is in the attributes: the paper's own tables, settings, versions, machine, scene.
    """
    import xarray

    data = xarray.Dataset(attrs={"title": "The paper's study, done again", "format": FORMAT, "citation": CITATION})
    for name in ("group", "method", "solver"):
        data[name] = ("run", np.array([getattr(case, name) for case in cases], dtype=object))
    for name, unit in (("tol", "1"), ("alpha", "1/s"), ("beta", "1/s"), ("start", "1")):
        data[name] = ("run", np.array([getattr(case, name) for case in cases]), {"units": unit})
    data["t_end"] = ("run", np.array([case.end for case in cases]), {"units": "s", "long_name": "time that was asked for"})
    data["projected"] = ("run", np.array([case.projected for case in cases], dtype=np.int8))
    data["tied"] = ("run", np.array([case.rank_tol is not None for case in cases], dtype=np.int8))
    data["result"] = ("run", np.array([row["result"] for row in rows], dtype=object))
    for name, (unit, text) in NUMBERS.items():
        data[name] = ("run", np.array([row[name] for row in rows]), {"units": unit, "long_name": text})
    for name, (unit, text) in HISTORIES.items():
        values = np.array([row[name] for row in rows]).astype(np.float64 if name in ("time", "angle") else np.float32)
        data[name] = (("run", "instant"), values, {"units": unit, "long_name": text})
    for name, (values, unit, text) in _judged(cases, rows).items():
        data[name] = ("run", values, {"units": unit, "long_name": text})
    _add_law(data, mech, state)
    data.attrs |= {
        **{f"setting_{name}": value for name, value in settings.items()},
        **{f"setting_{name}": value for name, value in _thresholds().items()},
        **{f"version_{name}": value for name, value in versions().items()},
        **times,
        "machine": machine(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "scene": dumps(mech),
        "remarks": json.dumps(REMARKS),
        "published": json.dumps([{**table._asdict(), "rows": [row._asdict() for row in table.rows]} for table in TABLES]),
    }
    return data


def _thresholds() -> dict[str, Any]:
    return {
        "lost": LOST,
        "lost_early": LOST_EARLY,
        "lost_late": LOST_LATE,
        "first_step": FIRST_STEP,
        "alpha": GAINS[0],
        "beta": GAINS[1],
        "rank_held": RANK_HELD,
        "small_gains": list(SMALL_GAINS),
        "fitted": list(FITTED),
        "methods": json.dumps(METHODS),
    }


def _judged(cases: list[Case], rows: list[dict[str, Any]]) -> dict[str, tuple[np.ndarray, str, str]]:
    """Return verdicts, and the numbers of runs in tables."""
    verdicts = [classify(row["time"], row["angle_error"], row["end"], row["result"] == "successful") for row in rows]
    when = {
        name: np.array([lost_at(row["time"], row["angle_error"], row["end"], size) for row in rows])
        for name, size in (("early", LOST_EARLY), ("late", LOST_LATE))
    }
    last = [np.flatnonzero(np.isfinite(row["psi2"]))[-1] for row in rows]
    return {
        "kind": (np.array([v.kind for v in verdicts], dtype=object), "1", "verdict"),
        "verdict": (np.array([v.words for v in verdicts], dtype=object), "1", "verdict, in words"),
        "correct_to": (np.array([v.correct_to for v in verdicts]), "s", "last instant at which the angles were right"),
        "failed_at": (np.array([v.failed_at for v in verdicts]), "s", "when the solver gave up"),
        "lost_early": (when["early"], "s", f"first instant with an error above {LOST_EARLY:g} rad"),
        "lost_late": (when["late"], "s", f"first instant with an error above {LOST_LATE:g} rad"),
        "psi2_end": (np.array([row["psi2"][k] for row, k in zip(rows, last)]), "m2", "sum of squared violations at the end"),
        "psi2_max": (np.array([np.nanmax(row["psi2"]) for row in rows]), "m2", "sum of squared violations, its largest"),
        "error_end": (np.array([row["angle_error"][k] for row, k in zip(rows, last)]), "rad", "error of an angle at the end"),
        "error_max": (np.array([np.nanmax(row["angle_error"]) for row in rows]), "rad", "error of an angle, its largest"),
        "remark": (np.array([_remark(case, v) for case, v in zip(cases, verdicts)], dtype=object), "1", "letter of the remark"),
        "growth": (np.array([_growth(row) for row in rows]), "1/s", "rate at which sigma_12 grew; NaN where it did not"),
    }


def _remark(case: Case, verdict: Verdict) -> str:
    found = published_row(case.method, case.tol, case.alpha) if case.group == "paper" else None
    if found is None:
        return ""
    return remark(found[1], found[0], verdict.kind, verdict.correct_to)


def _growth(row: dict[str, Any]) -> float:
    """The slope of log(sigma_12) over time, from where it last leaves the rounding errors to where it is no longer small."""
    low, high = FITTED
    sigma, ts = np.nan_to_num(row["sigma_12"], nan=0.0), row["time"]
    late = np.flatnonzero((sigma > high) | (row["rank"] > 11))  # of rank 12, where another law holds
    stop = late[0] if len(late) else len(sigma)
    early = np.flatnonzero(sigma[:stop] < low)
    window = slice(early[-1] + 1 if len(early) else 0, stop)
    grown = len(ts[window]) > 2 and ts[window][-1] - ts[window][0] > 2.0 and sigma[window][-1] > GROWN * low
    return float(np.polyfit(ts[window], np.log(sigma[window]), 1)[0]) if grown else float("nan")


def _add_law(data: Any, mech: Mechanism, state: State) -> None:
    """The law of the drift for this start: its growth over time without stabilization, and its rates by gain."""
    swing = swing_of(mech, state.q)
    ts = np.linspace(0.0, float(data["t_end"].max()), 401)
    data["law_time"] = ("law_instant", ts, {"units": "s"})
    data["law_drift"] = ("law_instant", drift(swing, ts), {"units": "1", "long_name": "drift by its law, from 1 at the start"})
    gains = [0.0, 1.0, *SMALL_GAINS, 10.0]
    data["law_gain"] = ("gain", gains, {"units": "1/s", "long_name": "alpha = beta"})
    rates = [growth_rate(swing, gain, gain) for gain in gains]
    data["law_rate"] = ("gain", rates, {"units": "1/s", "long_name": "rate of growth by the law"})
    second = swing._replace(amplitude=np.radians(90 + SECOND))
    data.attrs |= {"law_rate_paper_gains": growth_rate(swing, *GAINS), "law_period": swing.period}
    data.attrs |= {"law_rate_second": growth_rate(second), "start_second": SECOND}
