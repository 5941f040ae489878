"""The page of the atlas: one file with its data, its plots drawn by the reader's choice of mechanism and axes."""

import json
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import xarray

from experiments.parts.atlas_tables import CELL, COMPARED, frame, geometric, mean_error, recommendations, silent

AXES = {"gains": "gain", "two gains": "ratio", "thresholds": "threshold"}  # of the parts that vary a number


def html(data: xarray.Dataset) -> str:
    """Return the page: curves of time against error, gains, thresholds and silent failures, by mechanism."""
    runs, titles = frame(data), json.loads(data.titles)
    wrong = silent(runs)
    curves, lines, failures = [], [], []
    compared = runs[runs.part.isin(COMPARED)].groupby(["problem", "part", *CELL], sort=False)
    for (problem, part, method, stabilization, solver, formulation), some in compared:
        curve = geometric(some)
        label = {
            "methods": f"{method}, {stabilization}",
            "integrators": solver,
            "multistep": solver,
            "constant steps": solver,
            "Braun and Goldfarb": stabilization,
        }.get(part, formulation)
        points = [[_short(x) for x in row] for row in curve.reset_index().to_numpy()]
        curves.append({"problem": problem, "part": part, "label": label, "points": points, "wrong": int(wrong[some.index].sum())})
    for part, axis in AXES.items():
        chosen = runs[runs.part.isin([part, f"{part}, Greville"])]
        chosen = chosen.assign(ratio=(chosen.beta / chosen.gain).round(2), alpha=chosen.gain if part == "two gains" else 0.0)
        for (problem, method, stabilization, alpha, tol), some in chosen.groupby(
            ["problem", "method", "stabilization", "alpha", "tol"], sort=False
        ):
            by = some.groupby(axis)
            points = [
                [_short(x), _short(mean_error(s.error)), _short(s.right_hand_sides.mean()), int((s.result != 0).sum())]
                for x, s in by
            ]
            label = {"thresholds": f"{method}, {stabilization}", "two gains": f"alpha = {alpha:g} 1/s"}.get(part, method)
            lines.append({"problem": problem, "part": part, "label": label, "tol": _short(tol), "points": points})
    for (problem, stabilization), some in runs.groupby(["problem", "stabilization"], sort=False):
        failures.append([problem, stabilization, len(some), int(wrong[some.index].sum()), int((some.result != 0).sum())])
    content = {
        "titles": titles,
        "curves": curves,
        "lines": lines,
        "failures": failures,
        "peers": [_shortened(row) for row in json.loads(data.peers)],
        "recommendations": [_shortened(row) for row in recommendations(runs)],
    }
    versions = ", ".join(f"{key[8:]} {data.attrs[key]}" for key in sorted(data.attrs) if key.startswith("version_"))
    template = Template(Path(__file__).with_suffix(".html").read_text(encoding="utf-8"))
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    return template.substitute(data=text, runs=f"{len(runs):,}", seconds=f"{data.attrs['seconds']:.0f}", versions=versions)


def _short(value: float) -> float | None:
    """Return three digits of a number; None for what JSON does not know."""
    return float(f"{value:.3g}") if np.isfinite(value) else None


def _shortened(row: dict[str, Any]) -> dict[str, Any]:
    return {name: _short(value) if isinstance(value, float) else value for name, value in row.items()}
