"""Reliability and speed of `udk.identify`: numbers of known mechanisms from wrong guesses, with and without noise."""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

import udkjax as udk
from benchmarks.measurements import EXACT, Measurement, driven_excavator, excavator, four_bar, linkage, slider_crank, sprung_chain

CASES: dict[str, Callable[..., Measurement]] = {
    "linkage": linkage,
    "four-bar": four_bar,
    "slider-crank": slider_crank,
    "excavator, valves shut": excavator,
    "excavator, driven": driven_excavator,
    "linkage, crossing": lambda end=10.0: linkage(60.0, 0.1, end),
}
LONG = 20.0  # s
SIZES = (3, 5, 10, 20)
REACHED = 1e-8  # relative error of the worst parameter
WIDE, NEAR = 0.5, 0.1  # relative errors of first guesses; the smaller ones are for comparisons within one minimum
NOISE = 0.01  # relative to the root mean square of a channel about its mean
SIGMAS = 2.0
FAILURES = (udk.IdentificationError, udk.AssemblyError, udk.SimulationError)


class Count(NamedTuple):
    """Numbers of fits of each kind."""

    starts: int
    long: int
    noisy: int
    timed: int
    sizes: tuple[int, ...]
    end: float | None = None  # s, instead of the duration of each case
    cases: int | None = None


FULL, SMOKE = Count(64, 16, 200, 5, SIZES), Count(1, 0, 2, 1, (3,), 1.0, 1)


class Fit(NamedTuple):
    """One fit: values and standard errors (P,), relative errors of the values, and its cost."""

    values: np.ndarray
    errors: np.ndarray
    wrong: np.ndarray
    seconds: float
    cpu: float
    evaluations: int = 0
    said: str = ""  # the reason if it failed, or its defect


def exact(m: Measurement) -> np.ndarray:
    """Return the exact measurements (T, C)."""
    values, code = m.predictor()(m.unknowns.guess, EXACT)
    assert int(code) == 0, "the true mechanism does not move to the end"
    return np.asarray(values)


def record(m: Measurement, values: np.ndarray) -> udk.Record:
    """Return a record as read from a file."""
    return udk.Record(m.ts, dict(zip(m.channels, values.T, strict=True)))


def identified(m: Measurement, data: udk.Record, x0: np.ndarray) -> Fit:
    """Fit with default settings a scene that has the values `x0` in place of the true ones."""
    scene = m.with_values(x0)
    truth, begun, cpu = m.unknowns.guess, time.perf_counter(), time.process_time()
    try:
        found = udk.identify(scene, data, parameters=list(m.parameters), progress=False)
    except FAILURES as failure:
        nothing = np.full(len(truth), np.nan)
        return Fit(nothing, nothing, nothing + np.inf, time.perf_counter() - begun, time.process_time() - cpu, said=str(failure))
    took = time.perf_counter() - begun, time.process_time() - cpu
    errors = np.array([found.standard_errors[name] for name in found.names])
    return Fit(
        found.values, errors, np.abs(found.values / truth - 1), *took, found.evaluations, "" if found.success else found.message
    )


def by_differences(m: Measurement, predicted: Callable, data: np.ndarray, x0: np.ndarray, tol: float, tight: bool) -> Fit:
    """Fit by `scipy.optimize.least_squares` over the jitted run, in logarithms; `tight`: to the last digit."""
    from scipy.optimize import least_squares

    spread, truth = data.std(0), m.unknowns.guess

    def residuals(z):
        values, code = predicted(x0 * np.exp(z), tol)
        off = (np.asarray(values) - data) / spread
        return np.where(np.isfinite(off), off, 1e3).ravel() if int(code) == 0 else np.full(data.size, 1e3)

    begun, cpu = time.perf_counter(), time.process_time()
    ends: dict[str, Any] = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "diff_step": 1e-6} if tight else {}
    found = least_squares(residuals, np.zeros(len(truth)), x_scale="jac", **ends)
    took = time.perf_counter() - begun, time.process_time() - cpu
    x = x0 * np.exp(found.x)
    return Fit(x, np.full(len(truth), np.nan), np.abs(x / truth - 1), *took, found.nfev)


def summary(case: str, protocol: str, m: Measurement, fits: list[Fit], **more: Any) -> dict[str, Any]:
    """Return one row of the table, with the errors of every parameter."""
    wrong = np.array([fit.wrong for fit in fits])
    worst = wrong.max(1)
    row = {
        "name": case,
        "protocol": protocol,
        "parameters": len(m.unknowns.names),
        "seconds_of_motion": m.end,
        "fits": len(fits),
        "reached": float((worst <= REACHED).mean()),
        "error": float(np.median(worst)),
        "worst": float(worst.max()),
        "seconds": statistics.median(fit.seconds for fit in fits),
        "cpu": statistics.median(fit.cpu for fit in fits),
        "slowest": max(fit.seconds for fit in fits),
        "evaluations": statistics.median(fit.evaluations for fit in fits),
        "errors": {name: float(np.median(column)) for name, column in zip(m.unknowns.names, wrong.T, strict=True)},
        "failures": [fit.said for fit in fits if fit.said],
        **more,
    }
    covered = f"{row['covered']:8.3f}" if "covered" in row else " " * 8
    print(
        f"{case:24} {protocol:22} {row['parameters']:3d} {m.end:5.1f} {row['fits']:5d} {row['reached']:8.3f} {row['error']:9.1e} "
        f"{row['worst']:9.1e} {covered} {row['seconds']:9.3f} {row['cpu']:9.3f} {row['evaluations']:8.0f}",
        flush=True,
    )
    return row


def recovery(case: str, m: Measurement, count: int, protocol: str = "without noise") -> dict[str, Any]:
    """Fit from wrong first guesses, all within 50 % of the true values."""
    data = record(m, exact(m))
    return summary(case, protocol, m, [identified(m, data, x0) for x0 in m.starts(count, WIDE)])


def coverage(case: str, m: Measurement, count: int) -> dict[str, Any]:
    """Fit with noise of unknown size: the share of true values within two standard errors. Correct is 0.95."""
    random, values = np.random.default_rng(0), exact(m)
    noise = NOISE * values.std(0)
    measured = [record(m, values + noise * random.standard_normal(values.shape)) for _ in range(count)]
    fits = [identified(m, data, x0) for data, x0 in zip(measured, m.starts(count, NEAR), strict=True)]
    off = np.array([(fit.values - m.unknowns.guess) / np.where(np.isfinite(fit.errors), fit.errors, np.nan) for fit in fits])
    within = np.abs(off) <= SIGMAS  # except where there is no standard error
    each = {
        name: {"covered": float(one.mean()), "bias": float(np.nanmean(z)), "spread": float(np.nanstd(z))}
        for name, one, z in zip(m.unknowns.names, within.T, off.T, strict=True)
    }
    return summary(case, "1 % noise", m, fits, covered=float(within.mean()), of_parameters=each)


WAYS = {"udkjax": {}, "least_squares": {"tol": 1e-8, "tight": False}, "least_squares, tight": {"tol": EXACT, "tight": True}}


def timing(case: str, words: dict[str, Any], ways: Iterable[str], spread: float, count: int) -> list[dict[str, Any]]:
    """Time a fit that compiles and then warm ones, by each method, in separate processes without a cache of compiled programs."""
    found: list[dict[str, Any]] = []
    m = made(case, words)
    for way in ways:
        task = {"case": case, "words": words, "way": way, "starts": m.starts(count, spread).tolist(), "values": exact(m).tolist()}
        command = [sys.executable, "-m", "benchmarks.identification"]
        environment = {**os.environ, "UDKJAX_CACHE": "0"}
        ran = subprocess.run(command, input=json.dumps(task), env=environment, capture_output=True, text=True, check=False)
        if ran.returncode:
            raise RuntimeError(ran.stderr)
        fits = [Fit(*fit)._replace(wrong=np.array(fit[2])) for fit in json.loads(ran.stdout.splitlines()[-1])]
        found += [summary(way, f"{case}, compiling", m, fits[:1]), summary(way, f"{case}, warm", m, fits[1:])]
        for row, ours in zip(found[-2:], found[:2], strict=True):
            row["times_ours"] = row["seconds"] / ours["seconds"]
    return found


def _timed(case: str, words: dict[str, Any], way: str, starts: Any, values: Any) -> list[Fit]:
    """Time both fits in this process: the first guess is used twice, the second time warm."""
    m, values, starts = made(case, words), np.array(values), np.array(starts)
    starts = starts[[0, *range(len(starts))]]
    if way == "udkjax":
        return [identified(m, record(m, values), x0) for x0 in starts]
    predicted = m.predictor()
    return [by_differences(m, predicted, values, x0, **WAYS[way]) for x0 in starts]


def made(case: str, words: dict[str, Any]) -> Measurement:
    """Return the measurement of a name."""
    return sprung_chain(**words) if case == "sprung chain" else CASES[case](**words)


def rows(count: Count) -> Iterable[dict[str, Any]]:
    """Run every protocol."""
    shorter = {} if count.end is None else {"end": count.end}
    cases = list(CASES)[: count.cases]
    for case in cases:
        yield recovery(case, made(case, shorter), count.starts)
    for case in cases if count.long else []:
        yield recovery(case, made(case, {"end": LONG}), count.long, "without noise, long")
    for case in cases:
        yield coverage(case, made(case, shorter), count.noisy)
    yield from timing("four-bar", shorter, WAYS, NEAR, count.timed)
    for size in count.sizes:
        yield from timing("sprung chain", {"count": size, **shorter}, ["udkjax"], WIDE, count.timed)


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print a table: by case and protocol the number of fits that reach the true values, their errors and times."""
    print(
        f"{'case':24} {'protocol':22} {'P':>3} {'s':>5} {'fits':>5} {'<= 1e-8':>8} {'median':>9} {'worst':>9} {'within 2':>8} "
        f"{'seconds':>9} {'cpu':>9} {'runs':>8}"
    )
    return list(rows(SMOKE if smoke else FULL))


if __name__ == "__main__":
    ended = _timed(**json.load(sys.stdin))
    print(json.dumps([fit._replace(**{k: getattr(fit, k).tolist() for k in ("values", "errors", "wrong")}) for fit in ended]))
