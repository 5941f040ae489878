"""A design as a least-squares problem, evaluated for batches of trials by machine code."""

from collections.abc import Callable, Sequence
from copy import copy
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.arrays import FULL_TURN
from udkjax.equations.programs.position_programs import trace_model
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.expressions import Graph, ScalarProgram, trace
from udkjax.positions.following.drive import Drive, drive
from udkjax.positions.following.free_numbers import FreeNumbers, position_model
from udkjax.positions.following.position_batch import compile_positions
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.goals import Goal, PathGoal, goal_scale, place_of
from udkjax.synthesis.motion_goals import MotionTerm
from udkjax.synthesis.motion_terms import CompiledTerm
from udkjax.synthesis.ranges.limits import LEAST_TRANSMISSION, Bounds, LengthLimits
from udkjax.synthesis.robust_goal import RobustGoal, RobustTerm
from udkjax.synthesis.trials import TrialResiduals, Trials, Turn
from udkjax.wording import quote

TURN_VALUES = 72  # number of values per turn for the start of searches
FINE_VALUES = 720  # number of values per turn to verify a required turn
MARGIN_WEIGHT = 10.0  # weight of transmission limits relative to length limits: beyond the former the mechanism cannot be closed
CHECK_VALUES = 24  # number of values per turn for the transmission during a search; its minimum is interpolated


class DesignProblem:
    """A goal for a mechanism: its unknowns, and programs that evaluate trials.

    The unknowns x are the free numbers, the start of the driver's values if it is free, and further unknowns of the goal. Lengths
    and the transmission are limited: the transmission at all positions, or over the whole turn if a turn is required.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        goal: Goal,
        free: FreeNumbers,
        driver: Drive,
        bounds: Bounds,
        lengths: LengthLimits,
        transmission: float,
        rotation: bool | None,
        terms: Sequence[MotionTerm] = (),
    ):
        self.mechanism, self.free, self.driver, self.lengths = mechanism, free, driver, lengths
        self.driven, self.least = drive(mechanism, driver), max(transmission, LEAST_TRANSMISSION)
        self.rotation = self.driven.is_angle if rotation is None else rotation
        if self.rotation and not self.driven.is_angle:
            raise SceneError(["rotation: the driver is not an angle and cannot turn; leave rotation out"], mechanism.name)
        if goal.is_combined and not self.rotation:
            raise SceneError(
                ["goal: a CurveGoal needs a driver that turns: leave rotation out, or give a PathGoal"], mechanism.name
            )
        self.shifted = goal.start == "free" and goal.values is not None
        self.unknown_count = free.count + self.shifted + goal.extras
        self.coordinate_count = 3 * len(mechanism.body_names)
        self.local = goal.values is None  # the driver's values are unknowns
        self._aim(goal, bounds)
        self.terms = self._compile_terms(terms)
        self._compile()
        self._require_effects()

    def _aim(self, goal: Goal, bounds: Bounds):
        """Set the goal with its targets, and the ranges and scales of unknowns that depend on the goal."""
        self.goal, self.data, self.scale = goal, goal.targets, goal_scale(goal, self.mechanism)
        length = self.scale if goal.has_place else float(self.driven.analysis.scales.length)
        self._unit = np.tile([length, length, 1.0], self.coordinate_count // 3)
        wide = np.full(int(self.shifted), np.inf)
        low, high = (np.full(goal.extras, end) for end in goal.bounds_of_extras)
        self.low, self.high = np.concatenate([bounds.low, -wide, low]), np.concatenate([bounds.high, wide, high])
        self.first, self.last = bounds.first, bounds.last
        self.reach = float(np.max(bounds.last - bounds.first, initial=self.scale)) / 4
        self.sizes = np.maximum((bounds.last - bounds.first) / 4, 1e-12)  # scales of the free numbers

    def with_path(self, goal: PathGoal, bounds: Bounds) -> "DesignProblem":
        """Return the same problem for another path of the same point, with the programs of this one."""
        programs = self._residual_code, self._margin, self._points  # compiled here, so that all copies share them
        assert all(programs)
        other = copy(self)
        other._aim(goal, bounds)
        return other

    def _compile_terms(self, terms: Sequence[MotionTerm]) -> list[CompiledTerm]:
        goal, span = self.goal, None
        if any(term.positional not in (None, goal) for term in terms):
            problem = "goal: a RobustGoal measures targets that are not those of the design; give it the goal of the design"
            raise SceneError([problem], self.mechanism.name)
        if any(term.positional is None for term in terms) and not self.rotation:
            if goal.values is None:
                problem = (
                    "goal: a motion is measured over a whole turn or over values: give the first goal values, or set rotation"
                )
                raise SceneError([problem], self.mechanism.name)
            span = float(goal.values[0]), float(goal.values[-1])
        where = {"unit": self._unit, "scale": self.scale, "span": span, "unknown_count": self.unknown_count}
        where |= {"origin": goal.origin, "shifted": self.shifted}
        base = self.mechanism, self.free, self.driver, self.driven
        return [
            RobustTerm(term, *base, **where) if isinstance(term, RobustGoal) else CompiledTerm(term, *base, **where)
            for term in terms
        ]

    def _compile(self):
        goal, count = self.goal, self.free.count
        extras = slice(count + self.shifted, None)

        def measures(mechanism, x, q, data):
            measured = goal.measure(mechanism, q)
            return jnp.concatenate([jnp.stack(goal.residual(measured, data, x[extras], jnp)), measured])

        D, rows = self.data.shape[1], np.asarray(self.driven.analysis.scales.rows)
        model = position_model(self.free, self.driver, measures, goal.origin, self.shifted)
        traced = trace_model(model, self.unknown_count, self.coordinate_count, D)
        G = len(goal.residual(np.zeros(self.data.shape), self.data, np.zeros((1, goal.extras)), np))

        def made(chosen, derivatives):
            choices = {"data": D, "derivatives": derivatives, "rows": rows, "chosen": chosen}
            return compile_positions(self.mechanism, traced, self.unknown_count, self.coordinate_count, **choices)

        self._made, self._residual_count = made, G
        self._fit, self._fit_code = made(slice(G), True)
        self._turn, self._turn_code = made(slice(G, None), False)

    @cached_property
    def _residual_code(self):
        return self._made(slice(self._residual_count), False)[1]

    @cached_property
    def _margin(self):
        """The programs of the transmission and its derivatives, and their machine code."""
        return self._made(slice(0, 0), True)

    def _require_effects(self):
        """Raise `SceneError` if a free number, such as a mass, does not affect any measure."""
        rows = [self._fit.measure.outputs[position.by_parameters] for position in self._fit.places[:-1]]
        rows += [term.entries for term in self.terms]
        idle = [name for k, name in enumerate(self.free.entries()) if all(row[k].is_zero for row in rows)]
        if idle:
            listed = ", ".join(map(quote, idle))
            raise SceneError([f"free: no measure of the goal depends on {listed}: leave it out"], self.mechanism.name)

    @property
    def _pins(self) -> list[str]:
        return [] if self.mechanism.drawing is None else list(self.mechanism.drawing.groups["pin"])  # pyright: ignore

    @cached_property
    def _points(self) -> ScalarProgram:
        """The program of the measures and the places of all pins; without a drawing, of the measures, q and the free numbers."""
        names = self._pins

        def points(x: Array, q: Array) -> Array:
            mechanism, bodies = self.free.moved(x[: self.free.count]), q.reshape(-1, 3)
            measured = self.goal.measure(mechanism, bodies)
            if not names:
                return jnp.concatenate([measured, q, x[: self.free.count]])
            return jnp.concatenate([measured, *(jnp.stack(place_of(mechanism, f"pin.{name}", None, bodies)) for name in names)])

        graph = Graph()
        x, q = (
            np.array([graph.input((n, k), n) for k in range(c)], object)
            for n, c in (("x", self.unknown_count), ("q", self.coordinate_count))
        )
        traced = trace(points, jnp.zeros(self.unknown_count), jnp.zeros(self.coordinate_count))(graph, x, q)[0]
        return ScalarProgram(graph, [*x, *q], list(traced.flat))

    # --- single mechanisms

    def drawn(self, mechanism: Mechanism) -> float:
        """Return the value of the driver in the drawn position."""
        return float(drive(mechanism, self.driver).value(mechanism.q0))

    @property
    def has_outlines(self) -> bool:
        """True if a link has an outline or centre in world coordinates, which does not move with its pins."""
        drawing = self.mechanism.drawing
        links = {} if drawing is None else drawing.groups["link"]
        return any(link.outline is not None or link.centre is not None for link in links.values())  # pyright: ignore

    def signature(self, x: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the points of links in a position q (n,) of a trial x (P,), which are equal for trials of the same mechanism.

        Without a drawing, these are the coordinates and the scaled free numbers.
        """
        points = self._at(x, q[None])[0, self._measured :]
        if not self._pins:  # free numbers, in the unit of lengths
            points[len(points) - self.free.count :] *= self.scale / self.sizes
        return points

    def residuals(self, x: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the residuals (J, G) of positions (J, n) of a motion."""
        measured, extras = self._at(x, q)[:, : self._measured], x[self.free.count + self.shifted :]
        each = self.goal.residual(measured, self.data, np.broadcast_to(extras, (len(q), len(extras))), np)
        return self.goal.report(np.stack(each, 1))

    @property
    def _measured(self) -> int:
        return len(self._turn.places) - 1

    def _at(self, x: np.ndarray, q: np.ndarray) -> np.ndarray:
        inputs = [np.full(len(q), v) for v in x] + list(q.T)
        return np.stack(self._points.by_numpy(inputs), 1)

    def turns(self, x: np.ndarray) -> bool:
        """Return True if the driver of a trial makes a whole turn, tested in fine steps."""
        return self.driven.is_angle and bool(self.turn(x[None], FINE_VALUES).reached.all())

    def transmission_at(self, x: np.ndarray, s: np.ndarray, q: np.ndarray) -> float:
        """Return the least transmission over the positions of a trial."""
        solved = self._turn_code(x[None], s[None], self._unit, None, q[None])
        return float(np.min(np.abs(solved.out[0, :, -1])))

    # --- values of the driver

    def values_at(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the driver's values (M, J) of trials x: `values`, unless the goal computes them from its own unknowns."""
        return self.goal.values_at(x[:, self.free.count + self.shifted :], values)

    def value_drawn(self, x: np.ndarray) -> np.ndarray:
        """Return the driver's values (M,) in the drawn positions of trials."""
        return np.asarray(self._fit.drawn_value.by_numpy(list(x.T))[0])

    def turn(self, x: np.ndarray, values: int = TURN_VALUES, threads: int | None = None) -> Turn:
        """Return a turn of the driver of trials x (M, P) from the drawn position, at `values` + 1 values."""
        s = self.value_drawn(x)[:, None] + self.period * np.linspace(0.0, 1.0, values + 1)
        solved = self._turn_code(x, s, self._unit, longest=self.longest, threads=threads)
        return Turn(s, solved.out[..., :-1], solved.q, solved.out[..., -1], np.isfinite(solved.end))

    @property
    def is_closed(self) -> bool:
        """True if the last target equals the first."""
        return len(self.data) > 1 and bool(np.all(self.data[0] == self.data[-1]))

    @property
    def period(self) -> float:
        """The range of driver values in a search: a turn, or the scale of lengths."""
        return FULL_TURN if self.driven.is_angle else self.scale

    @property
    def longest(self) -> float:
        """The longest step of the driver's value (rad, m) when machine code follows positions."""
        return CLOSURE.longest_step * float(self.driven.unit)

    def march(self, x: np.ndarray, s: np.ndarray, threads: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions (M, J, n) at values (M, J), in order from the drawn position, and whether all exist (M,)."""
        solved = self._turn_code(x, s, self._unit, longest=self.longest, threads=threads)
        return solved.q, np.isfinite(solved.end).all(1)

    # --- the whole mechanism moved

    @property
    def can_move(self) -> str:
        """Allowed motions of the whole mechanism to its targets: "anything", "no turn" or "nothing"."""
        drawing = self.mechanism.drawing
        names = [] if drawing is None else [f"pin.{name}" for name in drawing.groups["pin"]]  # pyright: ignore
        if not self.goal.has_place or not names or not set(names) <= {*self.free.names}:
            return "nothing"
        counted_from_world = self.goal.values is not None and not self.shifted and not self.goal.line
        return "no turn" if counted_from_world or not self.driven.is_angle else "anything"

    def moved(self, x: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return trials with each pin p moved to a p + b, as complex numbers, clipped to the bounds."""
        x = x.copy()
        if self.can_move != "nothing":
            for name, start in zip(self.free.names, self.free.starts, strict=False):
                if name.startswith("pin."):
                    p = a * (x[:, start] + 1j * x[:, start + 1]) + b
                    x[:, start], x[:, start + 1] = p.real, p.imag
        return np.clip(x, self.low, self.high)

    def turned_by(self, a: np.ndarray) -> np.ndarray:
        """Return the changes of the driver's values if the mechanism is multiplied by `a`: nonzero for angles to the ground."""
        of_ground = self.driven.is_angle and "ground" in self.driven.mechanism.drivers[self.driven.name].bodies
        return np.angle(a) if of_ground and not self.goal.line and self.can_move == "anything" else np.zeros(len(a))

    # --- residuals

    def evaluate(
        self,
        trials: Trials,
        margin: np.ndarray,
        threads: int | None = None,
        worth: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    ) -> TrialResiduals:
        """Return the residuals and limits of trials. Closing of positions starts from the positions stored in the trials.

        The rows of limits are those of lengths, then margin - tau^2 with the transmission tau. The square is used because it
        varies linearly with the lengths where branches meet.

        Args:
            trials: the trials.
            margin: the least squared transmission of each trial (M,).
            threads: number of threads; None: the default.
            worth: returns a mask of the trials whose turns are computed, from losses (M,) and limits of lengths; the others are
                marked as not existing.
        """
        x, (members, J) = trials.x, trials.s.shape
        solved = self._fit_code(x, trials.s, self._unit, self.data, trials.q, threads=threads)
        G = len(self._fit.places) - 1
        table = solved.out.reshape(members, J, G + 1, 2 + self.unknown_count)
        r, by_value, by_unknowns, rest = self.goal.combine(table[:, :, :G, 0], table[:, :, :G, 1], table[:, :, :G, 2:])
        limits, slopes = self.lengths(x)
        exists, tau = np.isfinite(solved.end).all(1), table[:, :, G, 0]
        if self.rotation:
            which = exists if worth is None else exists & worth(np.einsum("mjg,mjg->m", r, r) + rest, limits)
            turns, more, more_slopes = np.zeros(members, bool), np.zeros((members, 1)), np.zeros((members, 1, self.unknown_count))
            more[which], more_slopes[which], turns[which] = self._turn_limit(x[which], margin[which], threads)
            limits, slopes = np.concatenate([limits, more], 1), np.concatenate([slopes, more_slopes], 1)
            exists &= turns
        else:
            unit = MARGIN_WEIGHT * self.scale
            limits = np.concatenate([limits, unit * (margin[:, None] - tau**2)], 1)
            by_x = table[:, :, G, 2:]  # derivatives at constant driver values: other residuals determine unknown ones
            slopes = np.concatenate([slopes, -2.0 * unit * tau[..., None] * by_x], 1)
        terms, by_terms = self._terms_of(x, exists, threads)
        found = (r, by_value, by_unknowns, terms, by_terms, tau, limits, slopes, rest)
        for numbers in found:  # a link without length has positions, but no direction
            exists &= np.isfinite(numbers).reshape(members, -1).all(1)
        return TrialResiduals(solved.q, *found, exists)

    def _terms_of(self, x: np.ndarray, exists: np.ndarray, threads: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals of motion goals and their derivatives; `exists` becomes False for trials without a motion."""
        count = sum(term.goal.samples for term in self.terms)
        r, by_unknowns, start = np.zeros((len(x), count)), np.zeros((len(x), count, self.unknown_count)), 0
        for term in self.terms:
            which, columns = np.flatnonzero(exists), slice(start, start + term.goal.samples)
            r[which, columns], by_unknowns[which, columns], exists[which] = term(x[which], threads)
            start = columns.stop
        return r, by_unknowns

    def residuals_at(self, trials: Trials, threads: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals (M, J, G), limits of lengths, and whether all positions exist (M,), without derivatives."""
        solved = self._residual_code(trials.x, trials.s, self._unit, self.data, trials.q, threads=threads)
        return solved.out[..., :-1], self.lengths(trials.x)[0], np.isfinite(solved.end).all(1)

    def _turn_limit(self, x: np.ndarray, margin: np.ndarray, threads: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the limit row of the least transmission of a turn, its derivative, and a mask of the trials that turn fully.

        The minimum of tau^2 is that of a parabola through three values of the turn, then corrected by one Newton step.
        """
        turn = self.turn(x, CHECK_VALUES, threads)
        turns, all_of_them = turn.reached.all(1), np.arange(len(x))
        square = np.where(turns[:, None], turn.transmission**2, 1.0)[:, :-1]
        worst, step = square.argmin(1), self.period / CHECK_VALUES
        before, lowest, after = (square[all_of_them, (worst + k) % CHECK_VALUES] for k in (-1, 0, 1))
        bend = np.maximum(before - 2.0 * lowest + after, np.finfo(float).tiny)
        (programs, code), centre = self._margin, turn.s[all_of_them, worst]
        s = centre + step * np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
        guess, columns = np.where(turns[:, None], turn.q[all_of_them, worst], 0.0)[:, None], programs.places[-1]
        for last in (False, True):
            solved = code(x, s[:, None], self._unit, None, guess, threads=threads)
            value, slope = solved.out[:, 0, columns.value], solved.out[:, 0, columns.by_value]
            if not last:
                moved = s - np.where(np.isfinite(slope), 2.0 * value * slope, 0.0) * step**2 / bend
                s, guess = np.clip(moved, centre - step, centre + step), np.where(np.isfinite(solved.q), solved.q, guess)
        turns &= np.isfinite(solved.end[:, 0])
        unit, by_x = MARGIN_WEIGHT * self.scale, solved.out[:, 0, columns.by_parameters]
        limit, slopes = unit * (margin - value**2)[:, None], -2.0 * unit * (value[:, None] * by_x)[:, None]
        return np.where(turns[:, None], limit, 0.0), np.where(turns[:, None, None], slopes, 0.0), turns
