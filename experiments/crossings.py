"""Every public function and command runs on every kind of model and agrees with another way, or is refused by name.

Rows are the functions of the package, also under jit, vmap and derivatives, and the commands of the command line.
Columns are models: plain, drawn, from files, from MJCF, by functions; with friction of both laws, springs, dampers, loads,
drivers, samples, gears, belts, racks, cams, slots, own and kinked forces, and events of each kind. The cells of a model are
computed one after another in one process. A cell runs if its result agrees with another way to the same numbers: another engine,
method or formula, the same model made of its elements or read from its own text, differences, the command's file against the
function. It is refused if an error that udkjax raises says why, in a sentence. Anything else is a fault.

The page crossings.md is the table. A part of it, or all in parts:

    python -m experiments.parts.crossings 5 "friction by load"                    # faults of these rows or models, in 5 minutes
    python -m experiments crossings --set first=0 --set every=3                   # every third model
    python -m experiments crossings --set first=1 --set every=3 --set add=1       # the next, added to the data
"""

import json
import re
import warnings
from collections import Counter
from collections.abc import Iterable

import jax
import numpy as np
import xarray
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from experiments.common import data_file, described, load, panels, tracked
from experiments.parts.crossing_case import Case
from experiments.parts.crossing_models import MODELS
from experiments.parts.crossings import Cell, cell, rows, summary

RESULTS = {"": " ", "runs": "r", "refuses": "n", "fault": "F"}  # and their letters on the page
NAMED = tuple(RESULTS)
SMALL = ("plain, redundant", "own force"), ("accelerations", "energy", "violation", "analyse", "dumps")
LONGEST = 160  # characters of a text


def study(smoke: bool, first: int = 0, every: int = 1, add: bool = False) -> xarray.Dataset:
    """Compute the table.

    Args:
        smoke: Whether to compute a few cells.
        first: The number of the first model.
        every: One of so many models is taken.
        add: Whether to add the cells to the existing data.
    """
    warnings.simplefilter("ignore")
    models, functions = SMALL if smoke else (tuple(MODELS)[first::every], rows())
    found: list[Cell] = []
    for name in tracked(models, "crossings"):
        case = Case(name, MODELS[name])
        found += [cell(row, case) for row in functions]
        jax.clear_caches()  # a process may have only so many programs, and no other model uses these
    data = _dataset(found)
    if add and data_file("crossings").exists():
        data = _merged(load("crossings"), data)
    return described(data, "the models of experiments/parts/crossing_models.py", {"first": first, "every": every})


def _dataset(found: Iterable[Cell]) -> xarray.Dataset:
    found = list(found)
    functions, models = (list(dict.fromkeys(x)) for x in zip(*((c.function, c.model) for c in found), strict=True))
    texts = list(dict.fromkeys(_plain(c.text) for c in found))
    result, text, seconds = (np.zeros((len(functions), len(models)), kind) for kind in (np.int8, np.int16, np.float32))
    for c in found:
        at = functions.index(c.function), models.index(c.model)
        result[at], text[at], seconds[at] = NAMED.index(c.result), texts.index(_plain(c.text)), c.seconds
    dims = "function", "model"
    return xarray.Dataset(
        {
            "result": (dims, result, {"long_name": f"of {json.dumps(NAMED)}"}),
            "text": (dims, text, {"long_name": "index of the compared quantity, or of the reason"}),
            "processor_time": (dims, seconds, {"units": "s"}),
            "texts": ("index", texts),
        },
        {"function": functions, "model": models},
    )


def _plain(text: str) -> str:
    """Return the text without names and numbers, so that there are few."""
    return re.sub(r"(?<![\w.])[-+]?\d[\d.e+-]*", "#", re.sub(r'"[^"]*"', '"..."', text))[:LONGEST]


def _merged(old: xarray.Dataset, new: xarray.Dataset) -> xarray.Dataset:
    """Return the table of two runs; where both have a model, the cells of the later run."""
    cells = {(c.function, c.model): c for data in (old, new) for c in _cells(data)}
    order = {name: k for k, name in enumerate(MODELS)}
    functions = {name: k for k, name in enumerate(rows())}
    kept = [c for c in cells.values() if c.model in order and c.function in functions]
    return _dataset(sorted(kept, key=lambda c: (order[c.model], functions[c.function])))


def _cells(data: xarray.Dataset) -> list[Cell]:
    texts, result, text, seconds = (data[name].values for name in ("texts", "result", "text", "processor_time"))
    return [
        Cell(str(function), str(model), NAMED[result[i, j]], str(texts[text[i, j]]), float(seconds[i, j]))
        for i, function in enumerate(data.function.values)
        for j, model in enumerate(data.model.values)
        if result[i, j]
    ]


def holds(data: xarray.Dataset) -> dict[str, bool]:
    counts = Counter(c.result for c in _cells(data))
    ran = (data.result == NAMED.index("runs")).any("model")
    return {"no cell is a fault": counts["fault"] == 0, "each row runs on some model": bool(ran.all())}


def headline(data: xarray.Dataset) -> str:
    return summary(_cells(data))


def figure(data: xarray.Dataset) -> Figure:
    """Draw the table: a square for each cell."""
    picture, axes = panels(1, 1, 9, 0.13 * data.sizes["function"] + 2)
    one, colours = axes[0, 0], ["white", "tab:green", "0.75", "tab:red"]
    one.pcolormesh(data.result.values, cmap=ListedColormap(colours), vmin=0, vmax=3, edgecolors="white", linewidth=0.4)
    for axis, names in ((one.xaxis, data.model.values), (one.yaxis, data.function.values)):
        axis.set_ticks(np.arange(len(names)) + 0.5, list(names), fontsize=5)
        axis.set_tick_params(length=0)
    one.tick_params("x", labelrotation=90)
    one.grid(visible=False)
    one.invert_yaxis()
    one.set_xlabel(headline(data), fontsize=7)
    named = zip(("runs, and agrees", "refused by name", "fault"), colours[1:], strict=True)
    one.legend(handles=[Patch(color=colour, label=label) for label, colour in named], fontsize=6, loc="lower left",
               bbox_to_anchor=(0.0, 1.0), ncols=3, frameon=False)  # fmt: skip
    return picture


def page(data: xarray.Dataset) -> str:
    """Return crossings.md: the table, what its cells are compared with, and why others are refused."""
    cells, functions = _cells(data), [str(x) for x in data.function.values]
    by_place, models = {(c.function, c.model): RESULTS[c.result] for c in cells}, [str(x) for x in data.model.values]
    versions = ", ".join(f"{key[8:]} {data.attrs[key]}" for key in sorted(data.attrs) if key.startswith("version_"))
    width = max(map(len, functions))
    lines = [
        "# Public functions and commands by models",
        "",
        f"Written by `python -m experiments crossings` ({float(data.processor_time.sum()):.0f} s of processor time; {versions}).",
        "",
        f"{headline(data)}. `r`: runs, and agrees with another way to the same numbers; `n`: is refused by an error that says "
        "why; `F`: a fault. The models, from left to right:",
        "",
        *(f"{k}. {model}" for k, model in enumerate(models, 1)),
        "",
        "```",
        *(f"{f:{width}}  {''.join(by_place.get((f, m), ' ') for m in models)}" for f in functions),
        "```",
        "",
        "| Function | Runs | Compared with |",
        "|---|---|---|",
    ]
    for f in functions:
        ways = Counter(c.text for c in cells if c.function == f and c.result == "runs")
        lines.append(f"| `{f}` | {sum(ways.values())} | {_cell_text('; '.join(ways))} |")
    lines += ["", "| Refused | Function | Reason |", "|---|---|---|"]
    reasons = Counter((c.function, c.text) for c in cells if c.result == "refuses")
    lines += [f"| {n} | `{f}` | {_cell_text(text)} |" for (f, text), n in sorted(reasons.items())]
    faults = [c for c in cells if c.result == "fault"]
    lines += ["", *(f"- Fault: `{c.function}`, {c.model}: {_cell_text(c.text)}" for c in faults)] if faults else []
    return "\n".join(lines) + "\n"


def _cell_text(text: str) -> str:
    return text[:300].replace("|", "\\|").replace("`", "'").replace("<", "&lt;")
