"""Work against error: which pseudoinverse, stabilization, integrator and formulation to trust, for which accuracy, at which cost.

The question of de Falco, Pennestri and Vita (2005), asked of twenty mechanisms: swinging, turning, through singular positions,
with redundant rows, driven, damped, stiff, with friction, a millionth and a million times as large, in space. Each runs from
several starts; every run is compared with a motion that two independent ways agree on (atlas_reference.py). One choice is varied
at a time, next to the package's own choices for all others (atlas_runs.py).

A run is *silently wrong* if it ends as successful at a tolerance of 1e-6 or less, but its largest error exceeds both 0.01
(relative to the mechanism's length, or in rad) and a hundred times that of the default at the same tolerance from the same start.

Claim: no run is silently wrong; those that are lost end with a reason. With projection and rank thresholds from 1e-6 to 1e-3
hardly a run is refused: with one of 1e-10 rounding errors count as rank near singular positions, and with 0.01 directions are
left out that the motion needs. In overconstrained chains in space rows depend on others in closed positions only: there a
threshold below 1e-4 counts the violations within a step as rank, which takes up to thirty times as many steps. The error of a
run with projection is that of its integrator: pseudoinverses differ in time alone. LU fails wherever rows are redundant. Gains
of 2 to 30 per second do as well as projection away from singular positions, also where the two differ by a factor of up to
four, and gains of hundreds are paid for in steps. The default takes at most twice the work of the best setting found, in the
median over mechanisms and errors.
"""

import itertools
import json
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
import xarray
from matplotlib.figure import Figure

from experiments.common import HERE, described, panels, tracked
from experiments.parts import atlas_page, atlas_tables
from experiments.parts.atlas_peers import peers
from experiments.parts.atlas_problems import PROBLEMS, STARTS
from experiments.parts.atlas_reference import reference
from experiments.parts.atlas_runs import MAX_STEPS, TOLERANCES, parts, run
from experiments.parts.atlas_tables import frame, geometric, silent
from udkjax.scene import Mechanism, dumps
from udkjax.show.style import COLOURS, MARKERS
from udkjax.threads import THREADS_VARIABLE, thread_count

SMALL = ("hanging", "crossing", "scissors")  # of the small version
SPATIAL, LEAST_IN_SPACE = ("Bennett", "Bricard"), 0.5e-4  # chains that move by their dimensions, and their least safe threshold
SMALL_TOLERANCES = TOLERANCES[1::4]
SAFE_THRESHOLDS = 0.5e-6, 2e-3  # of the rank: below, rounding counts; above, directions are left out that the motion needs
FEW = 0.01  # of the runs
SLOW_PARTS = ("multistep", "partitioning", "formulations", "Braun and Goldfarb", "constant steps")  # not of the small version
KEPT = HERE / "data" / ".atlas"  # finished chunks of an interrupted study
CODES = ("problem", "part", "method", "stabilization", "solver", "formulation")
NUMBERS = ("gain", "beta", "threshold")
FIRST = (*SPATIAL, "squares", "four-bar", "hanging", "stiff", "crossing", "turning", "small", "large")  # they take longest
MEASURED = {
    "error": ("1", "largest error of a position, relative to the mechanism's length, or of an angle (rad); NaN: the run failed"),
    "closure": ("m, rad", "largest violation of a constraint"),
    "energy": ("J", "largest change of the total energy; of mechanisms that conserve it alone"),
    "seconds": ("s", "computing time of a run, in a batch on one core; the lesser of two, where it was taken twice"),
    "slower": ("s", "the greater of the two computing times; NaN where it was taken once"),
    "right_hand_sides": ("1", "evaluations of the accelerations; -1: not counted"),
}


def study(smoke: bool, keep: int = 1) -> xarray.Dataset:
    """Run everything; `keep=0` forgets what an interrupted study has left."""
    chosen = {name: PROBLEMS[name] for name in (SMALL if smoke else PROBLEMS)}
    starts = 2 if smoke else STARTS
    if not keep:
        shutil.rmtree(KEPT, ignore_errors=True)
    columns: dict[str, list[np.ndarray]] = {}
    names: dict[str, list[str]] = {name: [] for name in CODES}
    apart = np.full((len(chosen), starts), np.nan)
    results: dict[str, Results] = {}
    others: list[dict[str, Any]] = []
    for one in tracked(each(list(chosen), smoke), "atlas", len(chosen) + 1):
        if isinstance(one, Results):
            results[one.problem] = one
        else:
            others = one
    for row, (name, problem) in enumerate(chosen.items()):
        apart[row, : len(results[name].apart)] = results[name].apart
        for kind, found in results[name].parts.items():
            for cells, data in found:
                add(columns, names, data, cells, problem=name, part=kind)
                if not problem.conserves:
                    columns["energy"][-1][:] = np.nan
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    data = xarray.Dataset({name: ("run", packed(values)) for name, values in joined.items() if name not in CODES})
    for name in CODES:  # numbers of names, as the CF conventions say flags
        data[name] = ("run", joined[name].astype(np.int8), {"flag_meanings": json.dumps(names[name])})
    for name, (units, long_name) in MEASURED.items():
        data[name].attrs = {"units": units, "long_name": long_name}
    data["apart"] = (("problem_name", "start_number"), apart, {"long_name": "distance between the two references", "units": "1"})
    data = data.assign_coords(problem_name=list(chosen))
    titles = {name: problem.title for name, problem in chosen.items()}
    data = data.assign_attrs(peers=json.dumps(others), license="CC0-1.0", titles=json.dumps(titles))
    if not smoke:
        shutil.rmtree(KEPT, ignore_errors=True)
    models = [problem.mechanism for problem in chosen.values()]
    scenes = "\n\n".join(dumps(model) for model in models if isinstance(model, Mechanism))
    return described(data, scenes, {"max_steps": MAX_STEPS, "starts": starts})


class Results(NamedTuple):
    """The runs of a mechanism: by part, the cells of each sweep and its data; `apart`: see `Reference`."""

    problem: str
    apart: np.ndarray
    parts: dict[str, list[tuple[list[dict[str, Any]], xarray.Dataset]]]


def each(names: list[str], smoke: bool) -> Iterator[Results | list[dict[str, Any]]]:
    """Run the mechanisms and the other programs, in processes of one thread, one for each core; yield results in any order.

    A core then computes one sweep at a time, from the first to the last, also where functions are traced and compiled.
    """
    if smoke:
        yield from (runs_of(name, smoke) for name in names)
        yield peers(smoke)
        return
    waiting = sorted(names, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))
    with ProcessPoolExecutor(thread_count(), get_context("spawn"), initializer=alone) as pool:
        tasks = [pool.submit(runs_of, name, smoke) for name in waiting]
        for done in as_completed([*tasks, pool.submit(peers, smoke)]):
            yield done.result()


def alone() -> None:
    """Have a process compute on one core."""
    os.environ[THREADS_VARIABLE] = "1"


def runs_of(name: str, smoke: bool) -> Results:
    """Run all parts of a mechanism."""
    problem, found = PROBLEMS[name], {}
    expected = reference(problem, 2 if smoke else STARTS)
    for kind, part in parts(problem).items():
        if smoke:
            if kind in SLOW_PARTS:
                continue
            few = tuple(
                tol for tol in part.tolerances if tol in SMALL_TOLERANCES
            )  # of which the default runs all, to compare with
            part = part._replace(cells=part.cells[:: 6 if kind == "thresholds" else 1], tolerances=few)
        found[kind] = run(problem, expected, part, None if smoke else KEPT / name / kind)
    return Results(name, expected.apart, found)


def add(
    columns: dict[str, list[np.ndarray]],
    names: dict[str, list[str]],
    data: xarray.Dataset,
    cells: list[dict[str, Any]],
    **labels: str,
) -> None:
    """Append the runs of a sweep to the columns, one value for each run."""
    data = data.transpose("cell", "tol", "start", ...) if "start" in data.dims else data.expand_dims("start", 2)
    shape = tuple(data.sizes[dim] for dim in ("cell", "tol", "start"))

    def put(name: str, values: Any, along: int) -> None:
        wide = np.broadcast_to(np.expand_dims(values, tuple(k for k in range(3) if k != along)), shape)
        columns.setdefault(name, []).append(wide.ravel().copy())

    def code(name: str, label: str) -> int:
        if label not in names[name]:
            names[name].append(label)
        return names[name].index(label)

    for name in CODES:
        put(name, [code(name, labels.get(name) or one[name]) for one in cells], 0)
    for name in NUMBERS:
        put(name, [one[name] for one in cells], 0)
    put("tol", data.rtol.values, 1)
    put("start", np.arange(shape[2]), 2)
    repeated = data.slower.values.reshape(shape) if "slower" in data else np.full(shape, np.nan)
    columns.setdefault("slower", []).append(repeated.ravel())
    good = data.result.values == 0
    for name, of in {"error": "wrong", "closure": "closure", "energy": "energy"}.items():
        values = data[of].values.reshape(shape)
        columns.setdefault(name, []).append(np.where(good, values, np.nan).ravel())
    for name, of in {"seconds": "seconds", "right_hand_sides": "n_right_hand_sides", "result": "result"}.items():
        columns.setdefault(name, []).append(data[of].values.reshape(shape).ravel())


def packed(values: np.ndarray) -> np.ndarray:
    """Return numbers in as many digits as are read: three for measured ones."""
    if not np.issubdtype(values.dtype, np.floating):
        return values.astype(np.int32 if np.abs(values).max(initial=0) > 127 else np.int8)
    bits = (values.astype(np.float32).view(np.uint32) + 0x1000) & np.uint32(0xFFFFE000)
    return bits.view(np.float32)


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """Return whether each part of the claim holds."""
    runs = frame(data)
    wrong = silent(runs)
    projected = runs.stabilization == "projection"
    safe = projected & runs.threshold.between(*SAFE_THRESHOLDS)
    safe &= ~(runs.problem.isin(SPATIAL) & (runs.threshold < LEAST_IN_SPACE))
    methods = runs[(runs.part == "methods") & projected]
    spread = methods.groupby(["problem", "tol", "start"]).error.agg(lambda e: e.max() / max(e.min(), 1e-11))
    lu = runs[runs.formulation == "augmented, LU"].groupby("problem").error.count()
    redundant = [name for name in data.problem_name.values if PROBLEMS[str(name)].redundant and not PROBLEMS[str(name)].crosses]
    gains = atlas_tables.gains(runs)
    ratio = atlas_tables.default_against_best(runs)
    return {
        "both ways to every reference agree": float(data.apart.max()) < 1e-10,
        "no run is silently wrong": not bool(wrong.any()),
        "with projection and thresholds from 1e-6 to 1e-3 hardly a run is refused": float((runs.result[safe] != 0).mean()) < FEW,
        "with projection all methods have the error of the integrator": float(spread.quantile(0.95)) < 30,
        "LU fails wherever rows are redundant": all(lu.get(name, 0) == 0 for name in redundant),
        "gains of 2 to 30 do as well as projection away from singular positions": gains["ordinary"] < 10,
        "gains of hundreds are paid for in steps": gains["dear"] > 2,
        "so do unequal ones, with ratios of 1/4 to 4": gains.get("unequal", 0.0) < 10,
        "the default is within twice the work of the best": float(np.median(list(ratio.values()))) <= 2.0,
    }


def headline(data: xarray.Dataset) -> str:
    """Return the numbers of runs and of silent failures, and the default's place, as text."""
    runs = frame(data)
    wrong = silent(runs)
    by = {name: int(wrong[runs.stabilization == name].sum()) for name in ("projection", "gains of 5", "gains", "none")}
    ratio = list(atlas_tables.default_against_best(runs).values())
    counts = ", ".join(f"{name} {n}" for name, n in by.items())
    place = f"median {np.median(ratio):.2f}, most {max(ratio):.1f}"
    return (
        f"{len(runs)} runs of {data.sizes['problem_name']} mechanisms; references agree to {float(data.apart.max()):.0e}; "
        f"silently wrong: {counts}; work of the default relative to the best setting: {place}"
    )


def figure(data: xarray.Dataset) -> Figure:
    """Draw time against error on the paper's linkage, the cost of projection and gains, and where runs fail silently."""
    runs = frame(data)
    drawn, axes = panels(1, 3, 13.0, 4.6)
    chosen = runs[(runs.part == "methods") & (runs.problem == "hanging") & (runs.stabilization == "projection")]
    for number, method in enumerate(chosen.method.unique()):
        curve = geometric(chosen[chosen.method == method])
        axes[0, 0].loglog(curve.error, curve.seconds * 1e3, f"{MARKERS[number]}-", ms=4, color=COLOURS[number], label=method)
    axes[0, 0].set(xlabel="error", ylabel="ms a run", title="the paper's linkage, projection")
    axes[0, 0].legend(fontsize=7)
    gains = runs[(runs.part == "gains") & (runs.method == "Auto")]
    middle = min(gains.tol.unique(), key=lambda tol: abs(np.log10(tol) + 6))
    gains = gains[gains.tol == middle]
    for number, (name, some) in enumerate(itertools.islice(gains.groupby("problem", sort=False), 6)):
        by = some.groupby("gain")
        axes[0, 1].loglog(by.right_hand_sides.mean(), f"{MARKERS[number]}-", ms=3, color=COLOURS[number], label=name)
    axes[0, 1].set(xlabel="Baumgarte's gains (1/s)", ylabel="right-hand sides", title=f"what gains cost, tolerance {middle:.0e}")
    axes[0, 1].legend(fontsize=7)
    wrong = silent(runs).groupby([runs.problem, runs.stabilization]).sum().unstack(fill_value=0)
    axes[0, 2].imshow(np.log10(1 + wrong.values), cmap="Oranges", aspect="auto")
    for (row, column), value in np.ndenumerate(wrong.values):
        axes[0, 2].text(column, row, str(value) if value else "", ha="center", va="center", fontsize=7)
    axes[0, 2].set_xticks(range(wrong.shape[1]), wrong.columns, fontsize=7)
    axes[0, 2].set_yticks(range(wrong.shape[0]), wrong.index, fontsize=7)
    axes[0, 2].set_title("runs that are silently wrong")
    axes[0, 2].grid(False)
    return drawn


def page(data: xarray.Dataset) -> str:
    """Return atlas.md: recommendations, and where settings fail."""
    return atlas_tables.markdown(data)


def html(data: xarray.Dataset) -> str:
    """Return atlas.html: the plots, by mechanism and choice, in one file."""
    return atlas_page.html(data)


def table(data: xarray.Dataset) -> str:
    """Return atlas.json, which the package reads: tolerances for accuracies."""
    return atlas_tables.table(data)
