"""Peers: name, package, run of the paper's linkage; and the measurement of their errors and times."""

import signal
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

import numpy as np

import udkjax as udk
from udkjax.study.accuracy import exact_coordinates

STARTS = (-45.0, 60.0)  # degrees, at rest; from +60 it crosses singular configurations
SPACING = 0.05  # s between outputs
END = 20.0  # s
CAP = 4.0  # s of CPU time: a curve ends with the first run that took longer
ENOUGH = 1.0  # s of CPU time after which a figure needs no further run, as after `ROUNDS`
ROUNDS = 5
COMPILE = 60.0  # s of CPU time for the first run
SPREAD = 15.0  # degrees to both sides of the start, in a batch
TICKS = 0.1  # s that a timing takes at least: some systems count CPU time in steps of 4 ms

# The paper's linkage: links 1, 2, 3 and the coupler; each as x, y (m) of the centre of mass and the angle (rad).
PIVOTS = np.array([0.0, 1.0, 2.0])  # m: points of the links on the ground
PINS = np.array([-1.0, 0.0, 1.0])  # m: points of the links on the coupler, from its centre
MASS, INERTIA = (1.0, 1.0, 1.0, 2.0), (0.1, 0.1, 0.1, 0.2)  # kg, kg m^2
GRAVITY = 9.81  # m/s^2

Coordinates = np.ndarray  # (outputs, 12)


class Problem(NamedTuple):
    """The linkage released from rest with its links at `angle`, and its positions at the outputs."""

    angle: float  # rad
    ts: np.ndarray  # s
    exact: Coordinates

    @property
    def q0(self) -> np.ndarray:
        """Return the coordinates at the start (12,), closed exactly."""
        return coordinates(np.full((1, 3), self.angle), np.zeros(1))[0]

    def error(self, q: Coordinates | None) -> float:
        """Return the largest error of any coordinate at any output (m, rad), nan if a run failed."""
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
    """Return all coordinates (T, 12) from the links' angles (T, 3) and the coupler's (T,), attached to the first link's tip."""
    e = np.stack([np.cos(links), np.sin(links)], axis=-1)
    feet = np.stack([PIVOTS, 0 * PIVOTS], axis=-1)
    along = np.stack([np.cos(coupler), np.sin(coupler)], axis=-1)
    bodies = np.concatenate([feet + e / 2, links[..., None]], axis=-1)
    carried = np.concatenate([e[:, 0] - PINS[0] * along, coupler[:, None]], axis=-1)
    return np.concatenate([bodies.reshape(len(links), 9), carried], axis=-1)


class Batch(NamedTuple):
    """The linkage released from several angles."""

    problems: list[Problem]

    def error(self, q: Any) -> float:
        """Return the largest error of any; `q` (batch, outputs, 12)."""
        return float("nan") if q is None else float(np.max([task.error(each) for task, each in zip(self.problems, q)]))


Run = Callable[[float], Coordinates]  # from the knob


class Peer(NamedTuple):
    """A program that simulates the linkage, set up for accuracy by its own best practice."""

    name: str
    package: str  # as it is called where it is installed from
    knob: str  # the setting that controls accuracy
    knobs: tuple[float, ...]  # from coarse to fine
    setup: Callable[..., Run]  # from the Problem, or from the Batch; imports the package
    batch: int = 1  # simultaneous trajectories, from starts within `SPREAD`
    end: float = END  # s
    starts: tuple[float, ...] = STARTS

    def available(self) -> str | None:
        """Return the installed version; None without the package."""
        try:
            return version(self.package)
        except PackageNotFoundError:
            return None

    def curve(
        self, start: float, knobs: tuple[float, ...] | None = None, end: float | None = None, cap: float = CAP
    ) -> list[dict]:
        """Return rows of `knob`, `error` (m, rad) and `seconds`: the median CPU time of one warm trajectory.

        The curve ends early with a run that took longer than `cap` seconds.
        """
        knobs, end = knobs or self.knobs, end or self.end
        if self.batch == 1:
            task = problem(start, end)
        else:
            task = Batch([problem(start + offset, end) for offset in np.linspace(-SPREAD, SPREAD, self.batch)])
        run = self.setup(task)
        rows: list[dict[str, Any]] = []
        timed(run, knobs[0], COMPILE)  # compiles, loads and allocates
        for knob in knobs:
            q, taken = timed(run, knob, 2 * cap)
            seconds = [taken]
            while q is not None and len(seconds) < ROUNDS and len(seconds) * max(seconds[-1], TICKS) < ENOUGH:
                seconds.append(timed(run, knob, 2 * cap, TICKS)[1])
            typical = statistics.median(seconds[1:] or seconds)  # the first one is too short to be timed well
            rows.append({"knob": knob, "error": task.error(q), "seconds": typical / self.batch})
            if taken > cap:
                break
        return rows


def timed(run: Run, knob: float, limit: float, at_least: float = 0.0) -> tuple[Coordinates | None, float]:
    """Return a run's result and CPU time, the mean of repetitions for `at_least` (s). None: failed, or past `limit`."""
    begun, runs, q = time.process_time(), 0, None
    try:
        with interrupted(limit):
            while runs == 0 or time.process_time() - begun < at_least:
                q = run(knob)
                runs += 1
    except (ArithmeticError, RuntimeError, SystemError, TimeoutError, ValueError, np.linalg.LinAlgError):
        return None, (time.process_time() - begun) / (runs + 1)
    return q, (time.process_time() - begun) / runs


@contextmanager
def interrupted(limit: float) -> Iterator[None]:
    """Raise TimeoutError after `limit` seconds of CPU time: an integrator may never end."""
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
