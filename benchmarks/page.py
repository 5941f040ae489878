"""The page of results: figures and one table, self-contained."""

from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.table import VERDICT, Figures, Rows
from udkjax.show.report import embedded, report_style

WIDTH = 9.2  # inches
MOTIONS = {-45.0: "released at −45°", 60.0: "released at +60°: singular configurations"}
STYLES = {"udkjax": {"color": "black", "lw": 2.2}, "C++": {"color": "#c03030", "lw": 1.8}}


def write(figures: Figures, judged: Rows, about: dict[str, Any], missing: Iterable[str], target: Path) -> None:
    """Write the page from the results of the benchmarks, by name."""
    missing = list(missing)
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>How fast udkjax is</title><style>{report_style()}</style></head><body>",
        "<h1>How fast udkjax is</h1>",
        f'<p class="lead">{escape("; ".join(f"{key} {value}" for key, value in about.items()))}</p>',
        f"<p>Not measured here: {escape(', '.join(missing))}.</p>" if missing else "",
        "<h2>What is promised, and what was measured</h2>",
        _table(judged),
        "<h2>Time and error</h2>",
        *_pictures(figures),
        "</body></html>",
    ]
    target.write_text("\n".join(parts) + "\n", encoding="utf-8")
    print(f"written to {target}")


def _table(judged: Rows) -> str:
    lines = [
        f"<tr><th>{escape(row['claim'])}</th><td>{row['target']}</td>"
        f"<td>{'–' if row['figure'] is None else format(row['figure'], '.4g')}</td><td>{VERDICT[row['holds']]}</td></tr>"
        for row in judged
    ]
    head = '<tr><th>claim</th><th class="number">target</th><th class="number">figure</th><th class="number">holds</th></tr>'
    return f'<div class="wide"><table><thead>{head}</thead><tbody>{"".join(lines)}</tbody></table></div>'


def _pictures(figures: Figures) -> Iterable[str]:
    single = [row for name in ("trajectory", "peers") for row in figures.get(name, []) if "error" in row and "seconds" in row]
    if single:
        yield embedded(
            lambda: work(single),
            "Time against error on logarithmic axes, one line for each program.",
            "<b>One trajectory.</b> The paper’s linkage for 20 s, 401 outputs: CPU time against the largest error of any "
            "coordinate at any output, against the exact solution. Points along a line are tolerances or steps.",
        )
    if many := [row for row in figures.get("batch", []) if "error" in row]:
        others = [row for row in figures.get("peers", []) if "trajectories_per_second" in row]
        many += [row | {"per_second": row["trajectories_per_second"], "outputs": "201 outputs"} for row in others]
        yield embedded(
            lambda: batch(many),
            "Trajectories per second against error, one line for each program.",
            "<b>Many trajectories.</b> Ten seconds each, released within ±5° of the start, on one core: how many per second of "
            "CPU time, against the largest error of any member. Solid: the end only; dashed: 201 outputs.",
        )
    if costs := [row for row in figures.get("gradients", []) if row["mode"] != "run"]:
        yield embedded(
            lambda: gradients(costs),
            "Cost of gradients against the number of parameters.",
            "<b>Gradients</b> of the final angle: their time in times a run without. Solid: forward; dashed: reverse.",
        )
    if sizes := [row for row in figures.get("scaling", []) if row.get("us") and row.get("bodies")]:
        yield embedded(
            lambda: scaling(sizes),
            "Time of a right-hand side against the number of bodies.",
            "<b>Size.</b> One right-hand side against the number of bodies; dotted: in proportion to it.",
        )


def _panels(rows: Rows, height: float) -> tuple[Figure, Any, list[str]]:
    """Return a figure with one panel for each motion, and the data of each, in the order of the rows."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(1, len(MOTIONS), sharex=True, sharey=True), list(dict.fromkeys(row["name"] for row in rows))


def work(rows: Rows) -> Figure:
    """Draw CPU time against error, one panel a motion."""
    figure, panels, names = _panels(rows, 4.6)
    for axes, (start, title) in zip(panels, MOTIONS.items(), strict=True):
        for place, name in enumerate(names):
            _line(axes, [row for row in rows if row["name"] == name and row["start"] == start], "seconds", 1e3, place)
        axes.set(xlabel="error (m, rad)", xlim=(1.0, 3e-12))
        axes.set_title(title, fontsize="medium")
    panels[0].set_ylabel("CPU time (ms)")
    _legend(figure, panels)
    return figure


def batch(rows: Rows) -> Figure:
    """Draw trajectories per second against error, one panel a motion."""
    figure, panels, names = _panels(rows, 4.2)
    for axes, (start, title) in zip(panels, MOTIONS.items(), strict=True):
        for place, name in enumerate(names):
            for kind, dashes in (("end only", "-"), ("201 outputs", "--")):
                chosen = [row for row in rows if (row["name"], row["start"], row["outputs"]) == (name, start, kind)]
                _line(axes, chosen, "per_second", 1.0, place, linestyle=dashes, label=f"{name}, {kind}")
        axes.set(xlabel="error (m, rad)", xlim=(1.0, 1e-11))
        axes.set_title(title, fontsize="medium")
    panels[0].set_ylabel("trajectories per second of CPU time")
    _legend(figure, panels)
    return figure


def gradients(rows: Rows) -> Figure:
    """Draw the cost of gradients against the number of parameters."""
    figure = Figure(figsize=(WIDTH * 0.6, 3.6), layout="constrained")
    axes = figure.subplots()
    for place, name in enumerate(dict.fromkeys(row["name"] for row in rows)):
        for mode, dashes in (("forward", "-"), ("reverse", "--")):
            if chosen := [row for row in rows if (row["name"], row["mode"]) == (name, mode)]:
                numbers = [row["parameters"] for row in chosen], [row["times_run"] for row in chosen]
                axes.plot(*numbers, marker="o", ms=3, linestyle=dashes, label=f"{name}, {mode}", **_style(name, place))
    axes.set(xlabel="parameters", ylabel="times a run", yscale="log")
    axes.legend(frameon=False, fontsize="small")
    return figure


def scaling(rows: Rows) -> Figure:
    """Draw the time of a right-hand side against the number of bodies."""
    figure = Figure(figsize=(WIDTH * 0.6, 3.6), layout="constrained")
    axes = figure.subplots()
    for place, name in enumerate(dict.fromkeys(row["name"] for row in rows)):
        chosen = sorted((row["bodies"], row["us"]) for row in rows if row["name"] == name)
        axes.loglog(*zip(*chosen, strict=True), marker="o", ms=3, label=name, **_style(name, place))
        (least, cost), (most, _) = chosen[0], chosen[-1]
        axes.loglog([least, most], [cost, cost * most / least], ":", color="0.6")
    axes.set(xlabel="bodies", ylabel="one right-hand side (µs)")
    axes.legend(frameon=False, fontsize="small")
    return figure


def _legend(figure: Figure, panels: Iterable[Axes]) -> None:
    lines = {label: line for axes in panels for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(list(lines.values()), list(lines), loc="outside lower center", ncols=4, frameon=False, fontsize="small")


def _line(axes: Axes, rows: Rows, key: str, scale: float, place: int, **options: Any) -> None:
    points = sorted(
        (row["error"], row[key] * scale) for row in rows if row["error"] and row["error"] == row["error"] and row[key]
    )
    if points:
        options = {"label": rows[0]["name"]} | options
        axes.loglog(*zip(*points, strict=True), marker="o", ms=3, **_style(rows[0]["name"], place), **options)


def _style(name: str, place: int) -> dict[str, Any]:
    return STYLES.get(name, {"color": f"C{place % 10}", "lw": 1.2})
