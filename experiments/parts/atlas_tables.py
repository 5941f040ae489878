"""Results of the atlas: costs at equal error, silent failures, recommendations."""

import json
from typing import Any, TypeAlias

import numpy as np
import pandas
import xarray

from experiments.parts.atlas_problems import PROBLEMS

Runs: TypeAlias = Any  # a table or a column of pandas, which its types cannot tell apart
TARGETS = (1e-3, 1e-6, 1e-9)  # errors that somebody may want
LOST = 0.01  # relative to the mechanism's length, or rad
TIGHT = 1.001e-6  # the largest tolerance at which such an error is not what was asked for
TIMES_DEFAULT = 100.0  # an error that exceeds the default's by this factor is not the tolerance's
CELL = ["method", "stabilization", "solver", "formulation"]
DEFAULT = {"method": "Auto", "stabilization": "projection", "solver": "default", "formulation": "Udwadia-Kalaba"}
COMPARED = ("methods", "integrators", "formulations", "multistep", "partitioning", "Braun and Goldfarb", "constant steps")


def frame(data: xarray.Dataset) -> Runs:
    """Return a table of all runs, with names in place of their numbers."""
    found = {}
    for name, variable in data.data_vars.items():
        if variable.dims == ("run",):
            labels = variable.attrs.get("flag_meanings")
            found[name] = np.array(json.loads(labels))[variable.values] if labels else variable.values.astype(float)
    size = data.sizes["run"]
    return pandas.DataFrame({name: np.full(size, np.nan) for name in ("beta", "slower")} | found)


def _default(runs: Runs) -> Runs:
    """Return the runs with the default settings."""
    return runs[(runs.part == "methods") & (runs[CELL] == pandas.Series(DEFAULT)).all(axis=1)]


def silent(runs: Runs) -> Runs:
    """Return which runs with a tolerance of 1e-6 or less ended as successful and are wrong by far more than it explains."""
    default = _default(runs)
    usual = default.set_index(["problem", "tol", "start"]).error
    keys = pandas.MultiIndex.from_frame(runs[["problem", "tol", "start"]])
    explained = TIMES_DEFAULT * usual.reindex(keys).to_numpy()
    asked = (runs.tol <= TIGHT) & (runs.part != "constant steps")
    return (runs.result == 0) & asked & (runs.error > LOST) & ~(runs.error <= explained)


def mean_error(errors: Runs) -> float:
    """Return the geometric mean of errors; NaN if a run failed."""
    return float(np.exp(np.log(errors.clip(lower=1e-17)).mean(skipna=False)))


def geometric(runs: Runs, *by: str) -> Runs:
    """Return error (the geometric mean), seconds and right-hand sides by columns and tolerance, where every start succeeded."""
    groups = runs.assign(error=np.log(runs.error.clip(lower=1e-17))).groupby([*by, "tol"], sort=False)
    found = groups[["error", "seconds", "right_hand_sides"]].mean()
    found["error"] = np.exp(found.error).where(groups.error.count() == groups.size())
    return found.dropna().sort_index(ascending=False)


def price(runs: Runs, target: float, of: str = "right_hand_sides") -> tuple[float, float]:
    """Return the least cost at which runs of a cell have at most an error, and the tolerance; infinite if none has."""
    return _least(geometric(runs).reset_index(), target, of).get((), (np.inf, np.nan))


def _least(curves: Runs, target: float, of: str, *by: str) -> dict[tuple[str, ...], tuple[float, float]]:
    """Return the least cost of each curve that has an error, and its tolerance."""
    enough = curves[curves.error <= target].sort_values(of, kind="stable")
    found: dict[tuple[str, ...], tuple[float, float]] = {}
    for *key, cost, tol in enough[[*by, of, "tol"]].itertuples(index=False, name=None):
        found.setdefault(tuple(key), (float(cost), float(tol)))
    return found


def prices(runs: Runs, target: float, of: str = "right_hand_sides") -> dict[tuple[str, tuple[str, ...]], tuple[float, float]]:
    """Return the `price` of every cell that varies one of the great choices, by mechanism and cell."""
    compared = runs[runs.part.isin(COMPARED)]
    wrong = silent(runs)[compared.index]
    keys = ["problem", *CELL]
    bad = set(compared[wrong][keys].itertuples(index=False, name=None))
    least = _least(geometric(compared, *keys).reset_index(), target, of, *keys)
    cells = compared[keys].drop_duplicates().itertuples(index=False, name=None)
    return {(key[0], key[1:]): least.get(key, (np.inf, np.nan)) for key in cells if key not in bad}


def default_against_best(runs: Runs) -> dict[tuple[str, float], float]:
    """Return the right-hand sides of the default relative to the least of all, by mechanism and error."""
    found = {}
    for target in TARGETS:
        of_cell = prices(runs, target)
        for problem in runs.problem.unique():
            own = of_cell[problem, tuple(DEFAULT.values())][0]
            least = min(cost for (name, _), (cost, _) in of_cell.items() if name == problem and cost > 0)
            if np.isfinite(own) and np.isfinite(least):
                found[problem, target] = own / least
    return found


def gains(runs: Runs) -> dict[str, float]:
    """Return how gains compare: the error of safe ones relative to projection's, and what large ones cost in right-hand sides."""
    several = runs.part.isin(["gains", "two gains"]) & (runs.method == "Auto")
    chosen = runs[several & runs.problem.isin(["hanging", "four-bar", "scissors"])]
    key = ["problem", "tol", "start"]
    default = _default(runs).set_index(key)
    beside = default.reindex(pandas.MultiIndex.from_frame(chosen[key]))
    error = chosen.error.to_numpy() / np.maximum(beside.error.to_numpy(), 1e-12)
    work = chosen.right_hand_sides.to_numpy() / beside.right_hand_sides.to_numpy()
    equal, safe, large = chosen.part == "gains", (chosen.gain > 2) & (chosen.gain < 30), chosen.gain > 200
    found = {"ordinary": error[equal & safe], "dear": work[equal & large], "unequal": error[~equal & safe]}
    return {name: float(np.nanmedian(values)) for name, values in found.items() if len(values)}


def words(cell: tuple[str, ...]) -> str:
    """Return the choices of a cell that are not the default's."""
    return ", ".join(value for value, usual in zip(cell, DEFAULT.values(), strict=True) if value != usual) or "the defaults"


def recommendations(runs: Runs) -> list[dict[str, Any]]:
    """Return for each mechanism and error: the default's tolerance and cost, and the setting with the least time."""
    found = []
    for target in TARGETS:
        work, time = prices(runs, target), prices(runs, target, "seconds")
        for problem in runs.problem.unique():
            rows = {cell: cost for (name, cell), cost in time.items() if name == problem}
            best = min(rows, key=lambda cell: rows[cell][0])
            default = tuple(DEFAULT.values())
            found.append(
                {
                    "problem": problem,
                    "error": target,
                    "tol": rows[default][1],
                    "seconds": rows[default][0],
                    "right_hand_sides": work[problem, default][0],
                    "best": words(best),
                    "best_tol": rows[best][1],
                    "best_seconds": rows[best][0],
                }
            )
    return found


def markdown(data: xarray.Dataset) -> str:
    """Return the recommendations and the failures as a page."""
    runs, titles = frame(data), json.loads(data.titles)
    wrong = silent(runs)
    heads = (
        "Mechanism",
        "Error",
        "Tolerance of the default",
        "Time (ms)",
        "Right-hand sides",
        "Least time by",
        "Tolerance",
        "Time (ms)",
    )
    lines = [
        "# Atlas: work against error",
        "",
        f"Written by `python -m experiments atlas` ({data.attrs['seconds']:.0f} s, {len(runs):,} runs). [The plots](atlas.html), "
        "[the data](data/atlas.nc) (CC0), [the claims](atlas.py).",
        "",
        "The tolerance (`rtol`, and `atol` relative to the mechanism's length) at which the default has an error, its time in a "
        f"batch on one core, and the setting that takes the least time. {_times(runs)} Counts of right-hand sides have no "
        "such uncertainty.",
        "",
        _row(heads),
        "|---" * len(heads) + "|",
    ]
    for row in recommendations(runs):
        own, best = (_number(row[name] * 1e3, ".2f") for name in ("seconds", "best_seconds"))
        tolerances = [_number(row[name], ".0e") for name in ("tol", "best_tol")]
        work = _number(row["right_hand_sides"], ".0f")
        name = row["best"] if best else ""
        lines.append(_row((titles[row["problem"]], f"{row['error']:.0e}", tolerances[0], own, work, name, tolerances[1], best)))
    kinds = runs.stabilization.unique()
    said = "Runs that ended as successful and are wrong / those that ended with a reason / all, by stabilization:"
    lines += ["", said, "", _row(("Mechanism", *kinds)), "|---" * (1 + len(kinds)) + "|"]
    for name, title in titles.items():
        lines.append(_row((title, *(_failures(runs, wrong, name, kind) for kind in kinds))))
    return "\n".join(lines) + "\n"


def _failures(runs: Runs, wrong: Any, problem: str, stabilization: str) -> str:
    some = runs[(runs.problem == problem) & (runs.stabilization == stabilization)]
    if some.empty:
        return ""
    return f"{int(wrong[some.index].sum())} / {int((some.result != 0).sum()):,} / {len(some):,}"


def _times(runs: Runs) -> str:
    if not np.isfinite(found := uncertainty(runs)):
        return "Times were measured once, beside other programs."
    return f"Times of pseudoinverses and integrators are the lesser of two; the greater is longer by {found:.0%} in the median."


def uncertainty(runs: Runs) -> float:
    """Return by how much a time that was taken twice exceeds the lesser one, relative to it, in the median; NaN if none was."""
    return float((runs.slower / runs.seconds).median()) - 1


def needed(runs: Runs, target: float) -> dict[str, float]:
    """Return, by mechanism, the largest tolerance at which the default has at most an error."""
    curves = geometric(_default(runs), "problem").reset_index()
    return curves[curves.error <= target].groupby("problem", sort=False).tol.max().to_dict()


def table(data: xarray.Dataset) -> str:
    """Return as JSON, for each mechanism, the tolerances that the default needs for errors that somebody may want."""
    runs, titles = frame(data), json.loads(data.titles)
    of_error = {f"{target:.0e}": needed(runs, target) for target in TARGETS}
    rows = [
        {
            "name": str(PROBLEMS[name].mechanism.name),
            "title": titles[name],
            "tolerances": {error: float(f"{tols[name]:.0e}") for error, tols in of_error.items() if name in tols},
        }
        for name in runs.problem.unique()
    ]
    return json.dumps(rows, indent=1) + "\n"


def _row(cells: tuple[Any, ...]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _number(value: float, form: str) -> str:
    return format(value, form) if np.isfinite(value) else ""
