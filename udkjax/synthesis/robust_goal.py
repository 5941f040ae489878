"""The goal that a measure stays within its limit in most of the pieces that are made, with exact derivatives.

A piece is a mechanism as made, whose numbers deviate from the design. Mean and variance of a measure are those of the quadratic
function through its values at a few pieces (second_order.py). Both are functions of these values alone, so that their derivatives
follow from the derivatives of the measure at each piece, which the compiled program of the measure computes.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.positions.following.free_numbers import FreeNumbers
from udkjax.requirements import require_number
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.number_fields import split_index
from udkjax.scene.reshaping import length_of, with_length
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.goals import Goal
from udkjax.synthesis.motion_goals import MotionPoint, MotionTerm, ToleranceGoal
from udkjax.synthesis.motion_terms import CompiledTerm
from udkjax.synthesis.ranges.deviations import PinClearance, ToleranceLike, read_tolerance
from udkjax.synthesis.ranges.second_order import quadratic
from udkjax.wording import quote


class RobustGoal(MotionTerm):
    """The mean of a measure over tolerances, plus `sigmas` standard deviations, stays below its limit `most`.

    With `least`, the mean minus `sigmas` standard deviations stays above it. Mean and variance are those of the quadratic
    function through values of the measure; `tolerances` finds the yield of a design by samples.

    Args:
        goal: a motion goal with its limit; or the design's own goal with `values`, whose measure is the distance from the target
            (m, rad), as the root of the mean plus `sigmas` standard deviations of its square.
        tolerances: as for `tolerances`: `length(crank)`, the place of a hole in a link or the ground, `joint.C.points[0]`, or
            other numbers; neither pins of the drawing nor clearances. Grades are those of the drawn lengths.
        sigmas: number of standard deviations.
        most: the limit of the distance from the targets; a motion goal has its own.
        weight: the weight of this limit, as for motion goals; a motion goal has its own.
    """

    goal: MotionTerm | Goal
    tolerances: Mapping[str, ToleranceLike] = eqx.field(static=True)
    sigmas: float = eqx.field(static=True)

    def __init__(
        self,
        goal: MotionTerm | Goal,
        tolerances: Mapping[str, ToleranceLike],
        sigmas: float = 3.0,
        *,
        most: float | None = None,
        weight: float = 0.1,
    ):
        require_number("sigmas", sigmas, "not negative")
        self.goal, self.tolerances, self.sigmas = goal, dict(tolerances), float(sigmas)
        if isinstance(goal, Goal):
            if goal.values is None:
                raise ValueError("goal: give values, those of the driver at which the targets are to be met")
            self.most, self.least, self.speed, self.weight, self.samples = most, None, 1.0, weight, len(goal.values)
            return
        if most is not None:
            raise ValueError(f"most: the goal has its own limits, {type(goal).__name__}(..., most={most:g})")
        if goal.most is not None and goal.least is not None:
            raise ValueError("goal: give most or least, not both")
        if isinstance(goal, ToleranceGoal | RobustGoal):
            raise ValueError(f"a {type(goal).__name__} has tolerances of its own: measure another quantity of the motion")
        self.most, self.least, self.speed = goal.most, goal.least, goal.speed
        self.weight, self.samples = goal.weight, goal.samples

    @property
    def positional(self) -> Goal | None:
        """The design's own goal, if its distance from the targets is measured."""
        return self.goal if isinstance(self.goal, Goal) else None

    def check(self, mechanism, driven, free):
        if isinstance(self.goal, MotionTerm):
            self.goal.check(mechanism, driven, free)
        if driven.analysis.redundant_rows != ():
            problem = "goal: joints are redundant, so that pieces with deviations do not fit: leave redundant joints out"
            raise SceneError([problem], mechanism.name)

    def loads(self, at):
        return self.goal.loads(at) if isinstance(self.goal, MotionTerm) else super().loads(at)

    def measure(self, at: MotionPoint) -> Array:
        """Return the measure of one piece; for a positional goal, the square of the distance from its target."""
        if isinstance(self.goal, MotionTerm):
            return self.goal.measure(at)
        residual = self.goal.residual(self.goal.measure(at.mechanism, at.q), at.target, at.extras, jnp)
        return sum((jnp.asarray(x) ** 2 for x in residual), jnp.zeros(()))


class MadePieces:
    """The pieces of a mechanism, by vectors z = (x, u) of free numbers x (P,) and deviations u (K,) of unit variance.

    Args:
        free: the free numbers.
        given: tolerances by name.

    Raises:
        SceneError: lists every mistake.
    """

    def __init__(self, free: FreeNumbers, given: Mapping[str, ToleranceLike]):
        mechanism, problems = free.mechanism, []
        self.names, self._free = free.names, free
        self._lengths = [name for name in given if name.startswith("length(") and name.endswith(")")]
        self._toleranced = FreeNumbers(mechanism, [name for name in given if name not in self._lengths])
        entries: list[tuple[str, str, str, float]] = []
        for name, value in zip(self._toleranced.names, self._toleranced.values, strict=True):
            entries += [(name, f"{name}[{k}]", mechanism.unit_of(name), float(x)) for k, x in enumerate(np.ravel(value))]
        entries += [(name, name, "m", float(length_of(mechanism, name[7:-1]))) for name in self._lengths]
        sources, rows = {}, []
        for name, entry, unit, nominal in entries:
            try:
                if isinstance(given[name], PinClearance):
                    raise ValueError("a clearance has no share in a robust goal: find its effect by udk.tolerances")
                if name.startswith("pin."):
                    cure = "name lengths, such as length(crank), or a hole, such as joint.C.points[0]"
                    raise ValueError(f"a pin changes all of its links, and otherwise in another position: {cure}")
                tolerance = read_tolerance(given[name], unit, nominal, Units.of(mechanism.drawing))
                middle, size = tolerance.middle_and_deviation(unit)
            except (TypeError, ValueError) as problem:
                problems.append(f"tolerances: {quote(name)}: {problem}")
                continue
            source, first = sources.setdefault(tolerance.shared or entry, (len(sources), tolerance))
            if (first.distribution, first.sigmas) != (tolerance.distribution, tolerance.sigmas):
                problems.append(f"tolerances: {quote(name)}: shares {quote(tolerance.shared)} with another distribution")
            rows.append((middle, size, source))
        if not given:
            problems.append('tolerances: none is given: name one, such as {"length(crank)": "0.05 mm"}')
        if problems:
            raise SceneError(problems, mechanism.name)
        self._middle, self._sizes, owners = np.array(rows).T
        self._owners = np.eye(len(sources))[owners.astype(int)]  # a matrix, since programs have no gather
        self.kurtosis = np.array([tolerance.kurtosis for _, tolerance in sources.values()])
        self.count = free.count + len(sources)

    def moved(self, z: Array) -> Mechanism:
        """Return the piece with the free numbers and deviations z = (x, u), which may be traced."""
        return self.piece(self._free.moved(z[: self._free.count]), z[self._free.count :])

    def piece(self, mechanism: Mechanism, u: Any) -> Mechanism:
        """Return the mechanism with its numbers changed by the deviations u."""
        changes, count = self._middle + self._sizes * (self._owners @ jnp.asarray(u)), self._toleranced.count
        known, values = mechanism.parameters(), {}
        for name, change in self._toleranced.split(changes[:count]).items():
            owner, index = split_index(name, known)
            values[name] = known[owner][index] + change
        mechanism = mechanism.with_parameters(values) if values else mechanism
        for name, change in zip(self._lengths, changes[count:], strict=True):
            mechanism = with_length(mechanism, name[7:-1], length_of(mechanism, name[7:-1]) + change)
        return mechanism


class RobustTerm(CompiledTerm):
    """A robust goal of a design: the program of its plain measure, evaluated at pieces of each trial. See `CompiledTerm`."""

    goal: RobustGoal

    def __init__(
        self, goal: RobustGoal, mechanism: Mechanism, free: FreeNumbers, *where: Any, unknown_count: int, **further: Any
    ):
        self._pieces, self._numbers = MadePieces(free, goal.tolerances), free.count
        K = len(self._pieces.kurtosis)
        super().__init__(goal, mechanism, self._pieces, *where, unknown_count=unknown_count + K, **further)  # pyright: ignore
        self._points = []
        model = quadratic(self._note, K)
        first, second = np.triu_indices(K, 1)
        own, pairs = np.einsum("gii->ig", model.curvature), model.curvature[:, first, second].T
        # The mean, and the parts of the standard deviation, as linear functions of the values at the points.
        self._mean = model.mean
        factors = np.concatenate([np.ones(K), np.sqrt((self._pieces.kurtosis - 1.0) / 4.0), np.ones(len(pairs))])
        self._parts = factors[:, None] * np.concatenate([model.slope.T, own, pairs])

    def _note(self, u: Float[np.ndarray, "E K"]) -> np.ndarray:
        """Store the E points at which `quadratic` evaluates its function; return the unit matrix as values.

        The quadratic function of these values has the weights of the values at all points.
        """
        self._points = u
        return np.eye(len(u))

    def _at_points(self, x: np.ndarray) -> np.ndarray:
        """Return the unknowns of all pieces of M trials, with their deviations after the free numbers: E rows for each trial."""
        M, E, P = len(x), len(self._points), self._numbers
        parts = np.repeat(x[:, None, :P], E, 1), np.tile(self._points, (M, 1, 1)), np.repeat(x[:, None, P:], E, 1)
        found = np.concatenate(parts, 2)
        return found.reshape(M * E, found.shape[2])

    def measures(self, x, threads=None, s=None):
        z, (M, E, P) = self._at_points(x), (len(x), len(self._points), self._numbers)
        # All pieces of a trial at the values of its nominal one, the first.
        s = np.repeat(self.values(z[::E]), E, 0) if s is None else s
        m, by_z, exists = super().measures(z, threads, s)
        by_x = np.delete(by_z, np.s_[P : P + len(self._pieces.kurtosis)], 2)
        found, slopes = self._combine(m.reshape(M, E, *m.shape[1:]), by_x.reshape(M, E, *by_x.shape[1:]))
        return found, slopes, exists.reshape(M, E).all(1)

    def _combine(self, m: np.ndarray, by_x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the robust measures (M, K) and their derivatives (M, K, P) from those of all pieces (M, E, ...)."""
        mean, parts = np.einsum("e,mek->mk", self._mean, m), np.einsum("ae,mek->mak", self._parts, m)
        deviation = np.sqrt((parts**2).sum(1))
        of_parts = np.einsum("mak,ae->mek", parts, self._parts) / np.where(deviation == 0.0, 1.0, deviation)[:, None]
        sigmas = self.goal.sigmas if self.goal.least is None else -self.goal.sigmas
        found = mean + sigmas * deviation
        slopes = np.einsum("mek,mekp->mkp", self._mean[None, :, None] + sigmas * of_parts, by_x)
        if self.goal.positional is None:
            return found, slopes
        root = np.sqrt(np.maximum(found, 0.0))
        return root, slopes / np.where(root == 0.0, 1.0, 2.0 * root)[..., None]

    def measure_motion(self, mechanism, x, origin, s=None):
        z, s = self._at_points(x[None]), self.values(self._at_points(x[None])[:1])[0]
        pieces = [self._pieces.piece(mechanism, u) for u in self._points]
        found = [super(RobustTerm, self).measure_motion(p, row, origin, s) for p, row in zip(pieces, z, strict=True)]
        if any(m is None for m in found):
            return None
        m = np.array(found)[None]
        return self._combine(m, np.zeros((*m.shape, 0)))[0][0]
