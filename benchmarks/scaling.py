"""Growth of one right-hand side with the scene, and the time until the first run.

Measured in whole projected runs by machine code, as the time of a run divided by its number of right-hand sides.
"""

import statistics
import time
from typing import Any

import numpy as np

import udkjax as udk
from benchmarks.common import cpu_seconds, in_turn

SIZES = {"N-four-bar": (1, 2, 5, 10, 20, 40, 100, 200, 1000), "chain": (1, 10, 100, 1000)}
FROM, UP_TO = 10, 1000  # the exponent is fitted from this number of four-bars on: below, the overhead of a call matters
ROUNDS, AT_LEAST = 9, 0.05  # s
TS = np.array([0.0, 0.2])  # s


def n_four_bar(n: int) -> udk.Mechanism:
    """Return a row of n four-bars, away from singular configurations."""
    return udk.library.n_four_bar(n, 1.0)


def chain(n: int) -> udk.Mechanism:
    """Return a chain of n links."""
    return udk.library.chain(n, 0.4)


def measured(name: str, make: Any, n: int) -> tuple[dict[str, Any], Any]:
    """Build a scene, analyse and run it for the first time; return the function that times further runs."""
    seconds = {}

    def timed(part: str, function: Any) -> Any:
        start = time.perf_counter()
        result = function()
        seconds[f"{part}_s"] = time.perf_counter() - start
        return result

    mechanism = timed("build", lambda: make(n))
    timed("analyse", lambda: udk.assemble(mechanism))
    first = timed("first_run", lambda: udk.simulate(mechanism, TS))
    evaluations = int(first.stats["right_hand_sides"])
    row = {"name": name, "n": n, "bodies": len(mechanism.body_names), "right_hand_sides": evaluations, **seconds}

    return row, lambda at_least: cpu_seconds(lambda: udk.simulate(mechanism, TS), at_least) / evaluations


def exponent(rows: list[dict[str, Any]]) -> float:
    """Return the slope of a straight line through the logarithms."""
    chosen = [(row["n"], row["us"]) for row in rows if row["name"] == "N-four-bar" and FROM <= row["n"] <= UP_TO]
    n, cost = np.log(np.array(chosen, float).reshape(-1, 2)).T
    return float(np.polyfit(n, cost, 1)[0]) if len(chosen) > 1 else float("nan")


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print figures for every size, and the power of N with which they grow."""
    sizes = {"N-four-bar": (1, 2), "chain": (2,)} if smoke else SIZES
    cases = [(name, make, n) for name, make in (("N-four-bar", n_four_bar), ("chain", chain)) for n in sizes[name]]
    figures, timers = [], {}
    for k, case in enumerate(cases):
        row, seconds = measured(*case)
        figures.append(row)
        timers[k] = lambda seconds=seconds: seconds(0.0 if smoke else AT_LEAST)
    times = in_turn(timers, 1 if smoke else ROUNDS)
    print(f"{'one right-hand side':20} {'N':>5} bodies {'us':>9} {'build':>7} {'analyse':>8} {'first run':>9} s")
    for k, row in enumerate(figures):
        row["us"] = statistics.median(times[k]) * 1e6
        until = f"{row['build_s']:7.2f} {row['analyse_s']:8.2f} {row['first_run_s']:9.2f}"
        print(f"{row['name']:20} {row['n']:5} {row['bodies']:6} {row['us']:9.2f} {until}")
    power = exponent(figures)
    print(f"N-four-bar grows as N^{power:.2f}, from N = {FROM} to {UP_TO}")
    figures.append({"name": "exponents, N-four-bar", "us": power})
    return figures
