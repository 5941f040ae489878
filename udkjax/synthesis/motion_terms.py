"""Compiled motion goals: residuals and exact derivatives for batches of trials."""

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.arrays import FULL_TURN
from udkjax.equations.programs.position_programs import trace_model
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.equations.terms.motion_measures import MotionModel
from udkjax.positions.following.drive import Drive, Driven
from udkjax.positions.following.free_numbers import FreeNumbers, position_model
from udkjax.positions.following.kinematics import kinematics
from udkjax.positions.following.position_batch import compile_positions
from udkjax.programs.deferred import deferred
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.motion_goals import MotionPoint, MotionTerm


class TermResiduals(NamedTuple):
    """Residuals of M trials (M, K), their derivatives dr/dx (M, K, P), and whether all positions exist (M,)."""

    r: np.ndarray
    by_unknowns: np.ndarray
    exists: np.ndarray


class CompiledTerm:
    """A compiled motion goal, which evaluates residuals and derivatives of batches of trials.

    Args:
        goal: the goal.
        mechanism: the mechanism.
        free: the free numbers.
        driver: the driver.
        driven: the mechanism driven by it.
        unit: scales of the coordinates (n,).
        scale: scale of the residuals.
        span: first and last value of the driver, as in the positional goal; None: a whole turn.
        unknown_count: number of unknowns.
        origin: the driver's value from which the goal's values are measured.
        shifted: whether the unknown after the free numbers is added to the origin.
    """

    def __init__(
        self,
        goal: MotionTerm,
        mechanism: Mechanism,
        free: FreeNumbers,
        driver: Drive,
        driven: Driven,
        unit: np.ndarray,
        scale: float,
        span: tuple[float, float] | None,
        unknown_count: int,
        origin: Callable[[Mechanism], Array],
        shifted: bool,
    ):
        goal.check(mechanism, driven, free.names)
        self.goal, self._unit, self._span = goal, unit, span
        self._unit_of_residuals = scale / np.sqrt(goal.samples)
        self._longest = CLOSURE.longest_step * float(driven.unit)
        measured = goal.positional
        self._given = None if measured is None else measured.values
        self._targets = np.zeros((goal.samples, 0)) if measured is None else measured.targets
        self._turning, D = span is None and measured is None, self._targets.shape[1]
        at_zero = (None, False) if self._turning else (origin, shifted)
        base = position_model(free, driver, lambda *_: jnp.zeros(0), *at_zero)
        speed = goal.speed if goal.speed is not None else _speed(mechanism, driven.name)

        def psi(x: Array, s: Array, q: Array) -> Array:
            return base(x, s, q, jnp.zeros(0))["psi"]

        def point(x: Array, s: Array, q: Array, u: Array, w: Array, y: Array, d: Array) -> MotionPoint:
            q, u, w = (a.reshape(-1, 3) for a in (q, u, w))
            numbers = x[: free.count]
            at = lambda changed: psi(jnp.concatenate([changed, x[free.count :]]), s, q.ravel())  # noqa: E731
            moved, extras = free.moved(numbers), x[free.count + shifted :]
            return MotionPoint(moved, q, speed * u, speed**2 * w, u, w, y, free, numbers, at, d, extras)

        def loads(x: Array, s: Array, q: Array, u: Array, w: Array) -> Array:
            return goal.loads(point(x, s, q, u, w, jnp.zeros((0, 0)), jnp.zeros(D)))

        def measures(x: Array, s: Array, q: Array, u: Array, w: Array, y: Array, d: Array) -> Array:
            return goal.measure(point(x, s, q, u, w, y, d)).reshape(1)

        n = mechanism.q0.size
        programs, self._code = compile_positions(
            mechanism,
            trace_model(base, unknown_count, n, D),
            unknown_count,
            n,
            data=D,
            transmission=False,
            rows=np.asarray(driven.analysis.scales.rows),
            motion=MotionModel(psi, loads, measures),
        )
        self._model, self._driver = (psi, loads, measures), driver
        self._drawn = programs.drawn_value
        self._places, self.entries = programs.places[0], programs.measure.outputs[programs.places[0].by_parameters]

    def measures(
        self, x: np.ndarray, threads: int | None = None, s: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return measures (M, K), derivatives with respect to the unknowns (M, K, P), and whether all positions exist (M,).

        `s` are the values of the driver (M, K), by default those of the goal.
        """
        s = self.values(x) if s is None else s
        solved = self._code(x, s, self._unit, self._targets, longest=self._longest, threads=threads)
        finite = np.isfinite(solved.end).all(1)
        out = np.where(finite[:, None, None], solved.out, 0.0)
        return out[..., self._places.value], out[..., self._places.by_parameters], finite

    def __call__(self, x: np.ndarray, threads: int | None = None) -> TermResiduals:
        """Return the residuals of trials x (M, P)."""
        m, by_unknowns, exists = self.measures(x, threads)
        r, slope = self.goal.residual(m, self._unit_of_residuals)
        return TermResiduals(r, slope[..., None] * by_unknowns, exists)

    def residual(self, measures: np.ndarray) -> np.ndarray:
        """Return the residuals (K,) for measures (K,)."""
        return self.goal.residual(measures, self._unit_of_residuals)[0]

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the values of the driver at which trials x (M, P) are measured (M, K)."""
        count = self.goal.samples
        if self._given is not None:
            return np.tile(self._given, (len(x), 1))
        if self._span is not None:
            return np.tile(np.linspace(*self._span, count), (len(x), 1))
        # Values on a grid that does not depend on the drawing, from the first one after the drawn value.
        step, drawn = FULL_TURN / count, np.asarray(self._drawn.by_numpy(list(x.T))[0])
        return step * (np.ceil(drawn / step)[:, None] + np.arange(count))

    def measure_motion(
        self, mechanism: Mechanism, x: np.ndarray, origin: float, s: np.ndarray | None = None
    ) -> np.ndarray | None:
        """Return the measures (K,) along the motion that `kinematics` computes; None if it does not reach all values.

        Args:
            mechanism: the mechanism.
            x: its free numbers, then all further unknowns of the design (P,).
            origin: the driver's value (rad, m) that is added to `s`, but not over a whole turn.
            s: the driver's values, relative to `origin`, or absolute over a whole turn; by default those of the goal.
        """
        s = np.asarray(self.values(x[None])[0] if s is None else s)
        motion = kinematics(mechanism, self._driver, s if self._turning else s + origin)
        if not np.all(motion.reached):
            return None
        q, u, w = (np.asarray(a).reshape(len(s), -1) for a in (motion.q, motion.v, motion.a))
        return np.asarray(self._of_motion(jnp.asarray(x), s, q, u, w, self._targets))

    @cached_property
    def _of_motion(self) -> Callable[..., Array]:
        psi, loads, measures = self._model

        def one(x: Array, s: Array, q: Array, u: Array, w: Array, d: Array) -> Array:
            b, jacobian = loads(x, s, q, u, w), jax.jacfwd(lambda q: psi(x, s, q))(q)
            y = b @ jnp.linalg.pinv(jacobian) if len(b) else jnp.zeros((0, len(jacobian)))
            return measures(x, s, q, u, w, y, d)[0]

        return deferred(jax.vmap(one, (None, 0, 0, 0, 0, 0)))


def _speed(mechanism: Mechanism, driver: str) -> float:
    motion = mechanism.drivers[driver].motion if driver in mechanism.drivers else None
    rate = 0.0 if motion is None else float(jax.jvp(motion, (0.0,), (1.0,))[1])
    if not rate:
        raise SceneError(["goal: give speed, the rate of the driver: its motion is at rest at time 0"], mechanism.name)
    return rate
