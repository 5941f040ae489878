"""Rules of all measurements: compiled once, warmed up, blocked, candidates in turn, medians; at equal error."""

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks import native
from udkjax.study.members import processor


class Compiled:
    """A jitted function that refuses to compile a second time."""

    def __init__(self, function: Callable, *examples: Any):
        traces = 0

        def counted(*arguments):
            nonlocal traces
            traces += 1
            return function(*arguments)

        start = time.perf_counter()
        self._call = jax.jit(counted)
        self._traces = lambda: traces
        self.result = jax.block_until_ready(self._call(*examples))
        self.compile_seconds = time.perf_counter() - start

    def __call__(self, *arguments: Any) -> Any:
        result = jax.block_until_ready(self._call(*arguments))
        assert self._traces() == 1, "compiled a second time: the measurement is worthless"
        return result

    def seconds(self, *arguments: Any) -> float:
        start = time.perf_counter()
        self(*arguments)
        return time.perf_counter() - start

    def cpu_seconds(self, *arguments: Any, at_least: float = 0.02) -> float:
        """Return the CPU time (s) of a run, measured by the function `cpu_seconds`."""
        return cpu_seconds(lambda: self(*arguments), at_least)


def cpu_seconds(call: Callable[[], Any], at_least: float = 0.02) -> float:
    """Return the CPU time (s) of a call, over all threads: the median of repetitions that take `at_least` seconds together.

    The median reduces the effect of other programs, and of first calls with caches filled by another candidate.
    """
    times: list[float] = []
    while not times or sum(times) < at_least:
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return statistics.median(times)


def alternate(candidates: dict[str, Compiled], arguments: tuple, rounds: int) -> dict[str, list[float]]:
    """Time each candidate once a round: a temporary slowdown of the machine then affects all of them."""
    for candidate in candidates.values():
        candidate(*arguments)
    return in_turn({name: lambda c=candidate: c.seconds(*arguments) for name, candidate in candidates.items()}, rounds)


def in_turn(timers: dict[Any, Callable[[], float]], rounds: int) -> dict[Any, list[float]]:
    """Do the same with functions that return their own time."""
    times: dict[Any, list[float]] = {name: [] for name in timers}
    for _ in range(rounds):
        for name, timer in timers.items():
            times[name].append(timer())
    return times


def ratio(slow: list[float], fast: list[float]) -> float:
    """Return the median of the ratios within a round."""
    return statistics.median(s / f for s, f in zip(slow, fast, strict=True))


class Work:
    """Cost of reaching an error: piecewise linear through (error, cost) in logarithms."""

    def __init__(self, points: Iterable[tuple[float, float]]):
        self.error, self.cost = np.log(np.array(sorted(points))).reshape(-1, 2).T

    def at(self, error: float) -> float:
        """Return the cost at this error, interpolated between measured points; nan outside."""
        if not len(self.error):
            return float("nan")
        return float(np.exp(np.interp(np.log(error), self.error, self.cost, left=np.nan, right=np.nan)))


def frontier(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the points (error, cost) that no other beats in both accuracy and cost, sorted by error."""
    left: list[tuple[float, float]] = []
    for error, cost in sorted(p for p in points if np.isfinite(p).all() and p[0] > 0):
        if not left or cost < left[-1][1]:
            left.append((error, cost))
    return left


def at_equal_error(times: dict[Any, list[float]], errors: dict[Any, float], target: float) -> dict[str, list[float]]:
    """Return the cost of each candidate at the error `target`, in each round; nan if none of its settings reaches it.

    Keys of `times` and `errors` are pairs (candidate, setting).
    """
    names = dict.fromkeys(name for name, _ in times)
    rounds = range(min(len(seconds) for seconds in times.values()))

    def curve(name: str, turn: int) -> Work:
        return Work(frontier((errors[key], seconds[turn]) for key, seconds in times.items() if key[0] == name))

    return {name: [curve(name, turn).at(target) for turn in rounds] for name in names}


def machine() -> dict[str, Any]:
    """Describe the machine of the figures."""
    load = os.getloadavg() if hasattr(os, "getloadavg") else None
    packages = {name: version(name) for name in ("jax", "jaxlib", "equinox", "diffrax", "numpy")}
    return {
        "cpu": processor(),
        "cores": os.cpu_count(),
        "load": load and [round(x, 2) for x in load],
        "python": platform.python_version(),
        "device": str(jax.devices()[0]),
        "C++": native.version(),
        **packages,
    }


def write(about: dict[str, Any], figures: Any, file: Path) -> None:
    """Write figures with the machine and versions."""
    file.write_text(json.dumps(_finite({"machine": about, "figures": figures}), indent=1, allow_nan=False) + "\n")
    print(f"written to {file}")


def _finite(tree: Any) -> Any:
    """Replace nan, which JSON does not have, by null."""
    if isinstance(tree, dict):
        return {key: _finite(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [_finite(value) for value in tree]
    return None if isinstance(tree, float) and not np.isfinite(tree) else tree
