"""Path tracking of solutions of polynomial systems over their parameters: many paths in lanes, each with its own steps.

H(z, p) = 0 has the solutions z(s) for p = p0 + s (p1 - p0). Each is predicted by the cubic through its last two points and
their rates, and corrected by Newton's method; a step is accepted if Newton's method converges as fast as near a solution. s goes
from 0 to 1 on a curve in the complex plane, s = t + i c t (1 - t), so that another c bypasses the parameters at which solutions
meet on another side.
"""

from typing import NamedTuple

import numpy as np

from udkjax.expressions import ScalarProgram
from udkjax.native.closing.batch_program import BatchProgram

FIRST_STEP = 0.02  # first step of t, predicted along the tangent; shortened if too long
SHORTEST_STEP = 1e-10  # shortest step of t: a path that needs shorter ones ends
LEAST_SIZE = 1e-2  # least scale of an unknown
INFINITE_SIZE = 1e12  # a larger unknown is at infinity; generic solutions reach 1e8
END_TOL = 1e-12  # bound on the last Newton step, relative to the unknowns: rounding errors if F' is well conditioned
END_CORRECTIONS = 12  # Newton steps at the end: many more than regular solutions need
STEP_GROWTH = 2.0  # largest growth of a step
# Near the end of a path to infinity an unknown varies as a power of 1 - t, an integer or a fraction such as 1/3; on a path to a
# finite point it does not. If the power is between these two, at 1 - t below NEAR_END, the path goes to infinity.
LEAST_POWER, MOST_POWER = 0.1, 3.0
NEAR_END = 0.05
ACCEPTED, INFINITE, SINGULAR, LOST = 0, 1, 2, 3  # codes of the ends of paths


class Precision(NamedTuple):
    """The precision of path tracking; the smaller its bounds, the less likely is a jump from one path to another.

    Attributes:
        aim: the prediction error to which the length of steps is adapted, relative to the unknowns.
        first: the largest first correction of an accepted step, relative to the unknowns.
        second: the largest second correction.
    """

    aim: float = 1e-3
    first: float = 1e-2
    second: float = 1e-5


class TrackedPaths(NamedTuple):
    """Ends of paths.

    Attributes:
        z: unknowns (N, M).
        status: status of each path (M,): ACCEPTED at a regular solution; INFINITE if an unknown goes to infinity or 0; SINGULAR
            near a point where Newton's method does not converge fully; LOST if it stopped before the end.
        t: last t of each path (M,), up to 1.
        steps: number of steps of each path (M,).
    """

    z: np.ndarray
    status: np.ndarray
    t: np.ndarray
    steps: np.ndarray


class _Points(NamedTuple):
    """Points of active paths.

    Attributes:
        z: the unknowns (N, M).
        rate: dz/dt.
        t: the parameter (M,).
        z_before: the unknowns one step before.
        rate_before: dz/dt one step before.
        last: the length of the last step in t; zero before the first one.
        step: the length of the next step.
        taken: the number of steps so far.
        path: the index of the path.
    """

    z: np.ndarray
    rate: np.ndarray
    t: np.ndarray
    z_before: np.ndarray
    rate_before: np.ndarray
    last: np.ndarray
    step: np.ndarray
    taken: np.ndarray
    path: np.ndarray

    def take(self, which: np.ndarray) -> "_Points":
        return _Points(*(a[..., which] for a in self))


class PathTracker:
    """A tracker of the solutions of a system along a line of its parameters; a call tracks M paths at once.

    Args:
        program: maps real and imaginary parts of z (N) and s, and of p0 and p1 - p0, to those of the Newton step and of dz/ds.
        unknown_count: the number N of unknowns.
    """

    def __init__(self, program: ScalarProgram, unknown_count: int):
        self.unknown_count = unknown_count
        self._program = BatchProgram(program, len(program.inputs) - 2 * unknown_count - 2)

    def __call__(
        self,
        z: np.ndarray,
        start: np.ndarray,
        end: np.ndarray,
        precision: Precision | None = None,
        bend: float = 0.0,
        most: int = 3000,
    ) -> TrackedPaths:
        """Return the ends of the paths from the solutions z (N, M) at the parameters `start` to solutions at `end`.

        Args:
            z: solutions.
            start: parameters p0, complex.
            end: parameters p1.
            precision: precision of the tracking.
            bend: the bend c of the curve of s.
            most: largest number of steps of a path.
        """
        precision = precision or Precision()
        moved = end - start
        shared = np.concatenate([np.real(start), np.imag(start), np.real(moved), np.imag(moved)])
        count = z.shape[1]
        out, status = np.array(z, complex), np.full(count, LOST)
        reached, taken = np.zeros(count), np.zeros(count, int)
        step, rate = self._evaluate(z, np.zeros(count), bend, shared)
        zeros = np.zeros(count)
        points = _Points(
            z + step, rate, zeros, z, rate, zeros, np.full(count, FIRST_STEP), np.zeros(count, int), np.arange(count)
        )
        while len(points.path):
            points = self._advance(points, bend, shared, precision)
            size = np.max(np.abs(points.z), axis=0)
            is_over = (points.t >= 1.0) | (points.step < SHORTEST_STEP) | ~(size < INFINITE_SIZE) | (points.taken >= most)
            if is_over.any():
                gone = points.take(is_over)
                out[:, gone.path], reached[gone.path], taken[gone.path] = gone.z, gone.t, gone.taken
                status[gone.path] = _ends(gone)
                points = points.take(~is_over)
        arrived = np.flatnonzero(reached >= 1.0)
        if len(arrived):
            out[:, arrived], converged = self.polish(out[:, arrived], end)
            status[arrived] = np.where(converged, ACCEPTED, status[arrived])
        return TrackedPaths(out, status, reached, taken)

    def polish(self, z: np.ndarray, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the solutions (N, M) near z at some parameters, by Newton's method, and a mask of those that have converged."""
        shared = np.concatenate([np.real(parameters), np.imag(parameters), np.zeros(2 * len(parameters))])
        zeros, best = np.zeros(z.shape[1]), np.full(z.shape[1], np.inf)
        for _ in range(END_CORRECTIONS):
            step, _ = self._evaluate(z, zeros, 0.0, shared)
            size = _relative(step, z)
            better = size < best
            if not better.any():
                break
            z, best = np.where(better, z + step, z), np.where(better, size, best)
        return z, best < END_TOL

    def _evaluate(self, z: np.ndarray, t: np.ndarray, bend: float, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the Newton step and dz/dt (N, M) at points z and t; `shared` has the parameters of all paths."""
        n = self.unknown_count
        outputs = self._program(np.concatenate([np.real(z), np.imag(z), t[None], (bend * t * (1.0 - t))[None]]), shared)
        step, rate = (outputs[k : k + n] + 1j * outputs[k + n : k + 2 * n] for k in (0, 2 * n))
        return step, rate * (1.0 + 1j * bend * (1.0 - 2.0 * t))

    def _advance(self, p: _Points, bend: float, shared: np.ndarray, precision: Precision) -> _Points:
        """Return the points after a step of each path; where it is not accepted, the old point with a shorter next step."""
        step = np.minimum(p.step, 1.0 - p.t)
        t = np.where(p.step >= 1.0 - p.t, 1.0, p.t + step)
        guess = _predict(p, step)
        first, _ = self._evaluate(guess, t, bend, shared)
        z = guess + first
        second, rate = self._evaluate(z, t, bend, shared)
        e1, e2 = _relative(first, z), _relative(second, z)
        with np.errstate(invalid="ignore", divide="ignore"):
            good = (e1 < precision.first) & (e2 < precision.second)
            factor = np.where(good, np.clip((precision.aim / np.maximum(e1, 1e-300)) ** 0.25, 0.3, STEP_GROWTH), 0.5)
        following = step * factor
        keep = ~good
        new = _Points(z + second, rate, t, p.z, p.rate, step, following, p.taken + 1, p.path)
        old = p._replace(step=following, taken=p.taken + 1)
        return _Points(*(np.where(keep, a, b) for a, b in zip(old, new, strict=True)))


def _ends(p: _Points) -> np.ndarray:
    """Return the statuses of ended paths, by the power of 1 - t of their fastest unknown."""
    remaining = 1.0 - p.t
    with np.errstate(invalid="ignore", divide="ignore"):
        power = np.max(np.abs(p.rate) / np.abs(p.z), axis=0) * remaining
    is_near_end = remaining < NEAR_END
    escapes = is_near_end & (power > LEAST_POWER) & (power < MOST_POWER)
    status = np.where(escapes, INFINITE, np.where(is_near_end & (power <= LEAST_POWER), SINGULAR, LOST))
    return np.where(np.max(np.abs(p.z), axis=0) < INFINITE_SIZE, status, INFINITE)


def _predict(p: _Points, step: np.ndarray) -> np.ndarray:
    """Return the prediction a step ahead: by the cubic through the last two points; for the first step, along the tangent."""
    has_two = p.last > 0
    last_step = np.where(has_two, p.last, 1.0)
    u = 1.0 + step / last_step
    u2, u3 = u * u, u * u * u
    cubic = (2 * u3 - 3 * u2 + 1) * p.z_before + (u3 - 2 * u2 + u) * last_step * p.rate_before
    cubic += (3 * u2 - 2 * u3) * p.z + (u3 - u2) * last_step * p.rate
    return np.where(has_two, cubic, p.z + step * p.rate)


def _relative(step: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the largest step of an unknown, relative to the unknown (M,); infinite for NaN."""
    size = np.max(np.abs(step) / np.maximum(np.abs(z), LEAST_SIZE), axis=0)
    return np.where(np.isfinite(size), size, np.inf)
