"""The loop that closes a mechanism: damped Gauss-Newton steps, by NumPy or JAX and with a dense or sparse solver.

    q <- q - s W D^+ Psi,        D = Psi_q W,

with W the metric (M^(-1/2) in assembly) and D^+ truncated for small scenes, damped for large, sparse ones. s limits the length of
a step, to stay on the branch of the guess, and is halved until the residual falls: no step makes a state worse. Concrete numbers
are closed by NumPy, without compilation; traced numbers take the same steps in JAX.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from udkjax.annotations import AnyArray, Time
from udkjax.arrays import ArrayLibrary
from udkjax.equations.programs.scales import Scales


class StepAside(NamedTuple):
    """Constants for a step from an initial position, which may be singular, to a position that is not.

    There a row that depends on others does so in all positions.
    """

    # Length of the step in the scene's units. A row that depends on others only at the start of the step has a relative pivot of
    # about its square at the end: much more than the threshold of dependence. The step is also short enough for Newton's method.
    length: float = 0.03
    stays: float = 0.5  # smallest distance from the start, as a fraction of the step: where branches meet, it may lead back
    corrections: int = 6  # Newton steps; four are usual, as convergence is quadratic
    free: float = 1e-6  # smallest tangent part of a direction or a velocity, in the scene's units; less is rounding


class DigitsRule(NamedTuple):
    """Thresholds of the distance from dependent rows, for ten correct digits of the second derivatives q'' of positions.

    With the distance sigma of the rows from dependence, relative to its largest value, and its rate c along the arc, rounding
    errors of q'' are 1e-16 (1 / sigma^2 + c^2 / sigma^3). Near a meeting of branches c is about one. Where links are short beside
    the mechanism, sigma is small over much of the motion, but c is small, too.
    """

    clear: float = 1e-2  # the least sigma if c is one
    least: float = 1e-3  # the least sigma if c is zero
    arc: float = 1e-4  # over which c is a difference, in units of the scene's scales

    def hold(self, sigma: Any, rate: Any) -> Any:
        """Return True where ten digits of q'' are correct at distances `sigma` with rates c: arrays or values in machine code."""
        return (sigma > self.least) & (rate * rate * self.clear**3 < sigma * sigma * sigma)


class ClosingRule(NamedTuple):
    """Criteria of a closed position, and of the steps that approach it.

    Rounding errors of Psi are about 1e-15 in units of the scene's scales; in a scene that cannot be closed, Psi is as large as
    the errors of its lengths. `tol` lies between the two.
    """

    tol: float = 1e-9  # largest Psi, in units of the scene's scales, at which a position counts as closed
    rounding: float = 32.0  # times eps and the largest coordinate: smaller residuals are rounding errors
    # Correction, or residual, in units of the scene's scales, after which a Newton step far from dependent rows is the last: what
    # remains is of the order of its square.
    last: float = 1e-9
    longest_step: float = 0.3  # largest change of a coordinate in one step, in rad or characteristic lengths: keeps the branch
    steps: int = 40  # maximum number of Gauss-Newton steps; five or six are usual: convergence is quadratic
    pace_steps: int = 4  # steps over which the rate of convergence is measured: see `try_to_close`
    velocities: int = 2  # corrections of v: the second removes the rounding errors of the first
    aside: StepAside = StepAside()  # from a position that may be singular
    digits: DigitsRule = DigitsRule()  # of derivatives of closed positions
    halvings: int = 12  # maximum for one step: if 2^-12 of a step does not lower the residual, the position cannot be closed

    def shortening(self, size: Any, xp: ArrayLibrary) -> Any:
        """Return the factor that makes a step of this size as long as `longest_step`; 1 for a shorter one."""
        if xp is np:  # in a tenth of the time
            return self.longest_step / size if size > self.longest_step else 1.0
        too_long = size > self.longest_step
        return xp.where(too_long, self.longest_step / xp.where(too_long, size, 1.0), 1.0)


CLOSURE = ClosingRule()

Assembly = tuple[AnyArray, AnyArray, AnyArray, AnyArray, ArrayLike]  # q, v, Psi, Psi_dot and the rank of D


class Rows(Protocol[AnyArray]):
    """The rows of Psi as functions for closing a mechanism."""

    @property
    def scales(self) -> Scales:
        """The scales of the scene."""
        ...

    def residual(self, t: Time, q: AnyArray) -> AnyArray:
        """Return Psi, each row divided by its scale."""
        ...

    def correction(self, t: Time, q: AnyArray) -> AnyArray:
        """Return the Gauss-Newton step -W D^+ Psi (n,)."""
        ...


class ConcreteRows(Rows[np.ndarray], Protocol):
    """The rows of Psi of a mechanism with concrete numbers."""

    def step_size(self, step: np.ndarray) -> float:
        """Return the largest component of a step (n,), in rad or characteristic lengths."""
        ...


def rounding(scales: Scales, q: AnyArray, xp: ArrayLibrary) -> AnyArray:
    """Return the residual that rounding of the coordinates causes."""
    return CLOSURE.rounding * float(np.finfo(q.dtype).eps) * xp.maximum(1.0, scales.size(q, xp))


def is_closed(scales: Scales, q: AnyArray, v: AnyArray, psi: AnyArray, psi_dot: AnyArray, xp: ArrayLibrary) -> AnyArray:
    """Return True if Psi and Psi_dot are at most `CLOSURE.tol` in units of the scene's scales, or rounding errors."""
    open_by = xp.maximum(CLOSURE.tol, rounding(scales, q, xp))
    rate = xp.maximum(scales.rate, scales.size(v, xp))
    return (scales.violation(psi, xp) <= open_by) & (scales.violation(psi_dot, xp) <= open_by * rate)


def limited_step(rows: Rows[jax.Array], t: Time, q: jax.Array) -> jax.Array:
    """Return a Gauss-Newton step, shortened so that no coordinate changes by more than `CLOSURE.longest_step`."""
    step = rows.correction(t, q)
    longest = rows.scales.size(step)
    return step * CLOSURE.shortening(longest, jnp)


def _fixed(x: Any) -> Any:
    """Return an array without derivatives; anything else, such as a function of a user-defined system, as it is."""
    return jax.lax.stop_gradient(x) if eqx.is_array(x) else x


def damped_step(rows: Rows[jax.Array], t: Time, q: jax.Array, goes_on: bool = False) -> tuple[jax.Array, jax.Array]:
    """Return q after one Gauss-Newton step, halved until the residual falls, and True if it fell.

    If the residual is a rounding error, or no step lowers it, q is returned unchanged; with `goes_on`, q after the whole step.
    """
    fixed, current = jax.tree.map(_fixed, (rows, q))
    size = jnp.linalg.norm(fixed.residual(t, current))
    is_open = size > rounding(rows.scales, current, jnp)
    step = limited_step(rows, t, q)
    fixed_step = jax.lax.stop_gradient(step)

    def is_worse(trial: tuple[jax.Array, Any]) -> jax.Array:
        scale, k = trial
        residual = fixed.residual(t, current + scale * fixed_step)
        return is_open & (k < CLOSURE.halvings) & ~(jnp.linalg.norm(residual) < size)

    halve = lambda trial: (0.5 * trial[0], trial[1] + 1)  # noqa: E731
    scale, k = jax.lax.while_loop(is_worse, halve, (jnp.ones(()), 0))
    improves = (k < CLOSURE.halvings) & is_open
    if goes_on:
        return q + jnp.where(improves, scale, 1.0) * step, improves
    return jnp.where(improves, q + scale * step, q), improves


def close_position(rows: Rows[Any], t: Time, q: AnyArray, xp: ArrayLibrary = jnp) -> AnyArray:
    """Return q after Gauss-Newton steps, until the residual is a rounding error, no step lowers it, or there are too many."""
    if xp is np:
        *_, (closed, _) = _positions_by_numpy(cast(ConcreteRows, rows), t, q)
        return closed

    def goes_on(state: tuple[Any, jax.Array, int]) -> jax.Array:
        _, improves, k = state
        return improves & (k < CLOSURE.steps)

    def body(state: tuple[Any, jax.Array, int]) -> tuple[Any, jax.Array, int]:
        q, _, k = state
        return *damped_step(rows, t, q), k + 1

    return jax.lax.while_loop(goes_on, body, (q, jnp.asarray(True), 0))[0]


def _positions_by_numpy(rows: ConcreteRows, t: Time, q: Any) -> Iterator[tuple[Any, float]]:
    """Yield the first position, and the position after each step of `close_position` by NumPy, with the norms of residuals."""
    size = _norm(rows.residual(t, q))
    yield q, size
    for _ in range(CLOSURE.steps):
        if not size > rounding(rows.scales, q, np):
            return
        step = rows.correction(t, q)
        longest = rows.step_size(step)
        if longest > CLOSURE.longest_step:
            step = step * (CLOSURE.longest_step / longest)
        for _ in range(CLOSURE.halvings):
            moved = q + step
            left = _norm(rows.residual(t, moved))
            if left < size:
                break
            step = 0.5 * step
        else:
            return
        q, size = moved, left
        yield q, size


def _norm(x: np.ndarray) -> float:
    return math.sqrt(x @ x)


def try_to_close(rows: ConcreteRows, t: Time, q: np.ndarray) -> np.ndarray:
    """Return q after steps of `close_position` by NumPy, which stop early if there seems to be no closed position.

    They stop when the remaining steps would not suffice at the current rate. A successful closure converges fastest in its last
    steps. If the position does not exist, the residual keeps falling, but ever more slowly.
    """
    sizes = list[float]()
    for position, size in _positions_by_numpy(rows, t, q):
        q = position
        sizes.append(size)
        if len(sizes) > CLOSURE.pace_steps:
            fall = (sizes[-1 - CLOSURE.pace_steps] - sizes[-1]) / CLOSURE.pace_steps
            if not sizes[-1] <= fall * (CLOSURE.steps + 1 - len(sizes)):
                break
    return q


def driver_time_step(scales: Scales) -> float:
    """Return the time (s) between positions of the random motion of `PositionRows.sample`; zero if nothing moves by itself.

    In this time drivers move about as far as the other coordinates.
    """
    return CLOSURE.longest_step / float(scales.rate) if scales.rate > 0.0 else 0.0
