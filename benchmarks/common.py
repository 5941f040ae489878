"""How everything here is measured: compiled once, warmed up, blocked, the candidates in turn, medians."""

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from udkjax.study.machine import processor


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


def alternate(candidates: dict[str, Compiled], arguments: tuple, rounds: int) -> dict[str, list[float]]:
    """Time each candidate once a round: what slows the machine down for a while slows all of them."""
    for candidate in candidates.values():
        candidate(*arguments)
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(rounds):
        for name, candidate in candidates.items():
            times[name].append(candidate.seconds(*arguments))
    return times


def ratio(slow: list[float], fast: list[float]) -> float:
    """The median of the ratios within a round."""
    return statistics.median(s / f for s, f in zip(slow, fast, strict=True))


def machine() -> dict[str, Any]:
    """Describe what the figures belong to."""
    load = os.getloadavg() if hasattr(os, "getloadavg") else None
    packages = {name: version(name) for name in ("jax", "jaxlib", "equinox", "diffrax", "numpy")}
    return {
        "cpu": processor(),
        "cores": os.cpu_count(),
        "load": load and [round(x, 2) for x in load],
        "python": platform.python_version(),
        "device": str(jax.devices()[0]),
        **packages,
    }


def report(about: dict[str, Any], figures: Any, out: Path | None):
    """Print the machine; write everything if asked to."""
    print("; ".join(f"{k} {v}" for k, v in about.items()))
    if out:
        out.write_text(json.dumps({"machine": about, "figures": figures}, indent=1) + "\n")
        print(f"written to {out}")
