"""Command line summaries of a sweep, before and after it has run."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from udkjax.integrate import Result
from udkjax.show.summary import table
from udkjax.show.sweep_figures import RESULT_VARIABLE, scalars
from udkjax.study.sweep.chunks import SweepCost
from udkjax.study.sweep.dataset import bytes_per_member, variables_of
from udkjax.study.sweep.plan import SweepPlan
from udkjax.study.sweep.sweep import duration
from udkjax.wording import plural

if TYPE_CHECKING:
    import xarray


def estimate_summary(plan: SweepPlan, cost: SweepCost) -> str:
    """Return the estimated work of a sweep (members, programs, memory, time) as a table of text."""
    shape = " x ".join(f"{dimension.size} {dimension.name}" for dimension in plan.dimensions)
    tried = "" if cost.tried == cost.groups else f", of which {cost.tried} were tried"
    computing, compiling = duration(cost.computing), duration(cost.compiling)
    lines = {
        "members": f"{cost.members}: {shape}",
        "saved per member": f"{bytes_per_member(plan)} bytes: {', '.join(variables_of(plan))}",
        "programs": plural(cost.groups, "program") + tried,
        "chunks": f"{cost.chunks}",
        "dataset": size(cost.stored),
        "memory": f"at most {size(cost.memory)}" if cost.memory else "unknown on this system",
        "time": f"about {computing} on the devices of this process, plus {compiling} to compile",
    }
    return table(f"{plan.mechanism.name or 'mechanism'}: a sweep", lines)


def sweep_results(data: "xarray.Dataset") -> dict[str, Any]:
    """Return the results of a sweep as plain data: `members` (their number), `results` and `ranges`.

    `results` has the number of members by the name of their result, `ranges` the units and the least, largest and median value
    of each number saved per member.
    """
    codes, counts = np.unique(data[RESULT_VARIABLE].values, return_counts=True)
    known = {int(result): result.name for result in Result}
    ranges = {}
    for name in scalars(data):
        values = data[name].values[np.isfinite(data[name].values)]
        if values.size:
            numbers = {"least": values.min(), "largest": values.max(), "median": np.median(values)}
            ranges[name] = {"units": data[name].attrs.get("units", ""), **numbers}
    ended = {known.get(int(code), "not_computed"): int(count) for code, count in zip(codes, counts, strict=True)}
    return {"members": int(data[RESULT_VARIABLE].size), "results": ended, "ranges": ranges}


def sweep_summary(data: "xarray.Dataset", seconds: float) -> str:
    """Return the results of a sweep's members, and the range of each number saved per member, as a table of text.

    `seconds` is the wall time of the sweep.
    """
    results = sweep_results(data)
    ended = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in results["results"].items())
    lines = {"members": f"{results['members']}: {ended}"}
    for name, values in results["ranges"].items():
        unit = "" if values["units"] in ("", "1") else f" {values['units']}"
        smallest, largest, median = (f"{values[key]:.4g}" for key in ("least", "largest", "median"))
        lines[name.replace("_", " ")] = f"{smallest} to {largest}{unit}, median {median}"
    lines["time"] = duration(seconds)
    return table(f"{data.attrs.get('title') or 'mechanism'}: a sweep", lines)


def size(count: float) -> str:
    """Return a number of bytes as text, in a readable unit."""
    units = ("bytes", "KiB", "MiB", "GiB", "TiB")
    power = min(int(math.log2(max(count, 1)) / 10), len(units) - 1)
    return f"{count / 1024**power:.3g} {units[power]}"
