"""What a peer is: a name, the package it needs, and how it runs the paper's linkage; and how its error and time are measured."""

import signal
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

import numpy as np

import udkjax as udk
from udkjax.study.exact import exact_coordinates

STARTS = (-45.0, 60.0)  # degrees, at rest; from +60 it crosses singular configurations
SPACING = 0.05  # s between outputs
END = 20.0  # s
CAP = 10.0  # s of CPU time: a curve ends with the first run that took longer
ENOUGH = 3.0  # s of CPU time that a figure's runs take together, unless `ROUNDS` are done before
ROUNDS = 5
TICKS = 0.1  # s that a timing takes at least: some systems count CPU time in steps of 4 ms

# The paper's linkage: links 1, 2, 3 and the coupler; each as x, y (m) of the centre of mass and the angle (rad).
PIVOTS = np.array([0.0, 1.0, 2.0])  # of the links on the ground, m
PINS = np.array([-1.0, 0.0, 1.0])  # of the links on the coupler, from its centre, m
MASS, INERTIA = (1.0, 1.0, 1.0, 2.0), (0.1, 0.1, 0.1, 0.2)  # kg, kg m^2
GRAVITY = 9.81  # m/s^2

Coordinates = np.ndarray  # (outputs, 12)


class Problem(NamedTuple):
    """The linkage released from rest with its links at `angle`, and where it is at the outputs."""

    angle: float  # rad
    ts: np.ndarray  # s
    exact: Coordinates

    @property
    def q0(self) -> np.ndarray:
        """The coordinates at the start (12,), closed exactly."""
        return coordinates(np.full((1, 3), self.angle), np.zeros(1))[0]

    def error(self, q: Coordinates | None) -> float:
        """The largest error of any coordinate at any output (m, rad), nan where a run broke down."""
        error = np.nan if q is None or q.shape != self.exact.shape else float(np.abs(q - self.exact).max())
        return error if np.isfinite(error) else float("nan")


def problem(start: float, end: float = END) -> Problem:
    """The linkage released from rest at `start` (degrees) until `end` (s)."""
    placed = udk.library.parallelogram(np.deg2rad(start))
    ts = SPACING * np.arange(round(end / SPACING) + 1)
    exact = exact_coordinates(placed, ts, placed.q0, placed.v0)
    assert exact is not None
    return Problem(np.deg2rad(start), ts, np.reshape(exact, (len(ts), 12)))


def coordinates(links: np.ndarray, coupler: np.ndarray) -> Coordinates:
    """All coordinates (T, 12) from the links' angles (T, 3) and the coupler's (T,), it being hung on the first link's tip."""
    e = np.stack([np.cos(links), np.sin(links)], axis=-1)
    feet = np.stack([PIVOTS, 0 * PIVOTS], axis=-1)
    along = np.stack([np.cos(coupler), np.sin(coupler)], axis=-1)
    bodies = np.concatenate([feet + e / 2, links[..., None]], axis=-1)
    carried = np.concatenate([e[:, 0] - PINS[0] * along, coupler[:, None]], axis=-1)
    return np.concatenate([bodies.reshape(len(links), 9), carried], axis=-1)


Run = Callable[[float], Coordinates]  # from the knob


class Peer(NamedTuple):
    """A program that simulates the linkage, set up as one who knows it would for accuracy."""

    name: str
    package: str  # as it is called where it is installed from
    knob: str  # what is turned for accuracy
    knobs: tuple[float, ...]  # from coarse to fine
    setup: Callable[[Problem], Run]  # imports the package

    def available(self) -> str | None:
        """The version that is installed, or None."""
        try:
            return version(self.package)
        except PackageNotFoundError:
            return None

    def curve(self, start: float, knobs: tuple[float, ...] | None = None, end: float = END, cap: float = CAP) -> list[dict]:
        """Rows of `knob`, `error` (m, rad) and `seconds`: the median CPU time of one run, the program being warm.

        The curve ends early with a run that took longer than `cap` seconds.
        """
        task = problem(start, end)
        run = self.setup(task)
        rows: list[dict[str, Any]] = []
        knobs = self.knobs if knobs is None else knobs
        timed(run, knobs[0], 10 * cap)  # compiles, loads and allocates
        for knob in knobs:
            q, taken = timed(run, knob, 2 * cap)
            seconds = [taken]
            if q is not None and taken < cap:
                times = max(1, round(TICKS / taken))
                while len(seconds) < ROUNDS and sum(seconds) * times < ENOUGH:
                    seconds.append(timed(run, knob, 2 * cap, times)[1])
            rows.append({"knob": knob, "error": task.error(q), "seconds": statistics.median(seconds)})
            if taken > cap:
                break
        return rows


def timed(run: Run, knob: float, limit: float, times: int = 1) -> tuple[Coordinates | None, float]:
    """What a run returns and its CPU time, the mean of some `times`; None if it broke down, or had to be stopped at `limit` (s)."""
    q, begun = None, time.process_time()
    try:
        with interrupted(limit):
            for _ in range(times):
                q = run(knob)
    except (ArithmeticError, RuntimeError, TimeoutError, ValueError, np.linalg.LinAlgError):
        return None, (time.process_time() - begun) / times
    return q, (time.process_time() - begun) / times


@contextmanager
def interrupted(limit: float) -> Iterator[None]:
    """Raise TimeoutError once this has used `limit` seconds of CPU time: an integrator may never come to an end."""
    if not hasattr(signal, "setitimer"):  # Windows
        yield
        return

    def stop(number, frame):
        raise TimeoutError(f"{limit} s of CPU time")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, limit)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
