"""How one right-hand side grows with the scene: operations, time, memory, and what it takes until the first one is evaluated.

Each is evaluated as a run evaluates it: in a loop that XLA compiles into one function.
"""

import statistics
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from udkjax.equations.rank_policy import REFUSE

import udkjax as udk
from benchmarks.common import Compiled, in_turn, machine, report
from udkjax.equations import prepare
from udkjax.straightline import Loop

SIZES = {"N-four-bar": (1, 2, 5, 10, 20, 40, 100, 200, 1000), "chain": (1, 10, 100, 1000)}
STRAIGHT = (1, 2, 5, 10, 20)  # N-four-bars as straight-line code, whatever the size: more is no fusion
UP_TO = 200  # the exponents are those of N-four-bars of 1 to so many
ROUNDS, AT_LEAST = 9, 0.05  # s
EVALUATIONS = 40_000  # of one four-bar in a call: to hand over the numbers of 20 takes as long as 50 of their right-hand sides


def n_four_bar(n: int) -> udk.Mechanism:
    """A row of n four-bars, in no singular configuration."""
    return udk.library.n_four_bar(n, 1.0)


def chain(n: int) -> udk.Mechanism:
    """A chain of n links."""
    return udk.library.chain(n, 0.4)


def measured(name: str, make: Any, n: int, large: bool | None, evaluations: int) -> tuple[dict[str, Any], Any]:
    """Build, compile and count a loop of evaluations, as in a run: each needs the one before; and what times it."""
    seconds = {}

    def timed(part: str, function: Any) -> Any:
        start = time.process_time()
        result = function()
        seconds[f"{part}_s"] = time.process_time() - start
        return result

    mechanism = timed("build", lambda: make(n))
    equations = timed("prepare", lambda: prepare(mechanism, large=large))
    y = np.asarray(mechanism.q0).ravel(), np.asarray(mechanism.v0).ravel()

    def repeat(e: Any, q: Any, v: Any, rounds: Any) -> Any:
        inside = e.with_policy(REFUSE).within(Loop())
        step = lambda _, y: (y[0] + 1e-12 * y[1], y[1] + 1e-12 * inside.accelerations(0.0, *y))  # noqa: E731
        return jax.lax.fori_loop(0, rounds, step, (q, v))

    lowered = timed("trace", lambda: jax.jit(repeat).lower(equations, *y, evaluations))
    compiled = timed("compile", lowered.compile)
    cost, memory = compiled.cost_analysis(), compiled.memory_analysis()
    bodies = len(mechanism.body_names)
    figures = {"name": name, "n": n, "bodies": bodies, "form": type(equations).__name__, "flops": cost["flops"], **seconds}
    figures["temporary_bytes"], figures["argument_bytes"] = memory.temp_size_in_bytes, memory.argument_size_in_bytes

    program = Compiled(repeat, equations, *y, evaluations)
    return figures, lambda at_least: program.cpu_seconds(equations, *y, evaluations, at_least=at_least) / evaluations


def exponent(rows: list[dict[str, Any]], key: str, form: str | None = None) -> float:
    """The slope of a straight line through the logarithms; of one form of the equations, what was measured of it besides, too."""
    named = [row for row in rows if row["name"].startswith("N-four-bar") and (form or row["name"] == "N-four-bar")]
    chosen = [(row["n"], row[key]) for row in named if form in (None, row["form"]) and row["n"] <= UP_TO and row[key] > 0]
    n, cost = np.log(np.array(chosen, float).reshape(-1, 2)).T
    return float(np.polyfit(n, cost, 1)[0]) if len(chosen) > 1 else float("nan")


def main(smoke: bool = False, out: Path | None = None):
    """Print figures for every size, and with what power of N they grow; with `out` also draw them, beside the figures."""
    about = machine()
    sizes = {"N-four-bar": (1, 2), "chain": (2,)} if smoke else SIZES
    cases = [("N-four-bar", n_four_bar, n, None) for n in sizes["N-four-bar"]]
    cases += [("chain", chain, n, None) for n in sizes["chain"]]
    cases += [("N-four-bar, straight-line code", n_four_bar, n, False) for n in (() if smoke else STRAIGHT)]
    cases += [("N-four-bar, by levels", n_four_bar, n, True) for n in ((1,) if smoke else STRAIGHT)]
    figures, timers = [], {}
    for k, (name, make, n, large) in enumerate(cases):
        row, seconds = measured(name, make, n, large, 2 if smoke else max(100, EVALUATIONS // n))
        figures.append(row)
        timers[k] = lambda seconds=seconds: seconds(0.0 if smoke else AT_LEAST)
    times = in_turn(timers, 1 if smoke else ROUNDS)
    print(
        f"{'one right-hand side':32} {'N':>5} bodies {'us':>9} {'flops':>9} {'kB':>7} {'build':>6} {'trace':>6} {'compile':>8} s"
    )
    for k, row in enumerate(figures):
        row["us"] = statistics.median(times[k]) * 1e6
        until = f"{row['build_s'] + row['prepare_s']:6.2f} {row['trace_s']:6.2f} {row['compile_s']:8.2f}"
        kb = row["temporary_bytes"] / 1e3
        print(f"{row['name']:32} {row['n']:5} {row['bodies']:6} {row['us']:9.2f} {row['flops']:9.0f} {kb:7.0f} {until}")
    exponents = {key: exponent(figures, key) for key in ("flops", "us", "temporary_bytes")}
    print("N-four-bar grows as N^" + ", N^".join(f"{value:.2f} ({key})" for key, value in exponents.items()))
    forms = dict.fromkeys(row["form"] for row in figures)
    print("of one form: " + ", ".join(f"{form} N^{exponent(figures, 'us', form):.2f} (us)" for form in forms))
    figures.append({"name": "exponents, N-four-bar", **exponents})
    report(about, figures, out)
    if out:
        draw(figures, out.with_suffix(".png"))
    return figures


def draw(figures: list[dict[str, Any]], file: Path):
    """Draw time and operations against the number of bodies."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    rows = [row for row in figures if "bodies" in row]
    for axes, (key, label) in zip(figure.subplots(1, 2), {"us": "CPU time (µs)", "flops": "operations"}.items(), strict=True):
        for name in dict.fromkeys(row["name"] for row in rows):
            x, y = zip(*((row["bodies"], row[key]) for row in rows if row["name"] == name), strict=True)
            axes.loglog(x, y, marker="o", ms=3, label=name)
        axes.set(xlabel="bodies", ylabel=f"one right-hand side: {label}")
    axes.legend(frameon=False, fontsize="small")  # pyright: ignore
    figure.savefig(file, dpi=150)
