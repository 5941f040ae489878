"""The five classic cases of path synthesis from many seeds, and published errors: `python -m benchmarks.design [SEEDS]`.

Each run is one call with one seed, on one core; its loss is computed from the motion of the found mechanism. The first call,
which compiles, is not counted.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

import udkjax as udk
from udkjax.synthesis.design import DesignSearch

CASES = Path(__file__).parents[1] / "tests" / "data" / "path_synthesis.json"
STARTS, SEEDS = 300, 100
DIGITS = 1e-6  # precision of published errors
LINKAGE = udk.Drawing(
    pins={"O": (0, 0), "A": (3, 4), "B": (12, 9), "P": (6, 12), "C": (10, 0)},
    links={name: {"pins": list(pins), "mass": 1.0} for name, pins in (("crank", "OA"), ("coupler", "ABP"), ("rocker", "CB"))},
    ground=["O", "C"],
    motors={"motor": {"pin": "O", "speed": 1.0}},
)


def search(number: int, case: dict) -> DesignSearch:
    """Return the search of a case, with its side conditions."""
    targets, most, area = np.array(case["targets"]), case["bounds"]["r"][1], case["bounds"]["others"][1]
    choices: dict = {}
    if number in (1, 3):
        choices["values"] = np.deg2rad(case["crank_angles_deg"])
    if number == 2:
        choices = {"values": np.deg2rad(20.0) * np.arange(len(targets)), "start": "free"}
    if number == 3:
        choices["line"] = ("O", "C")
    lengths = {(a, b): (0.0, float(most)) for a, b in ("OA", "AB", "CB", "OC", "AP")}
    free = ["pin.A", "pin.B", "pin.P", "pin.C[0]"] if number == 1 else None
    bounds = None if number == 1 else {"pin.O": (-area, area)}
    return udk.DesignSearch(LINKAGE, udk.PathGoal("P", targets, **choices), free, bounds, lengths)


def main(seeds: int = SEEDS, starts: int = STARTS) -> None:
    """Print best, mean and worst loss of each case, and the time of a run."""
    for number, case in enumerate(json.loads(CASES.read_text())["cases"]):
        find = search(number, case)
        find(starts, 0, 1, threads=1)
        losses, times = [], []
        for seed in range(seeds):
            begin = time.process_time()
            found = find(starts, seed, 1, threads=1)
            times.append(time.process_time() - begin)
            losses.append(found[0].loss if len(found) else np.inf)
        x, published = np.array(losses), min(case["published_errors"].values())
        near = np.mean(x <= x.min() + 1e-6 * max(1.0, x.min()))
        print(f"{case['name']}: best {x.min():.8g}, mean {x.mean():.8g}, worst {x.max():.8g}; within 1e-6 of the best {near:.0%}")
        print(f"    published {published:g}, at least as good to its digits {np.mean(x <= published * (1 + DIGITS)):.0%}")
        print(f"    means of fifty runs of evolutionary methods {case['fifty_runs_mean']}")
        print(f"    {np.median(times):.2f} s a run", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
