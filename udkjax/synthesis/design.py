"""Design by gradient: mechanisms with a point, link or output that moves as required."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from udkjax.annotations import Numbers
from udkjax.argument_types import COUNT, NOT_NEGATIVE_COUNT
from udkjax.positions.following.drive import Drive, only_driver
from udkjax.positions.following.free_numbers import FreeNumbers
from udkjax.requirements import concrete_only, require_count, require_number
from udkjax.scene.arguments import checked
from udkjax.scene.drawing import Drawing
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.named_numbers import numbers_in_expressions
from udkjax.scene.numbers.number_fields import split_index
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.design_problem import DesignProblem
from udkjax.synthesis.designs import Designs
from udkjax.synthesis.goals import Goal, PathGoal
from udkjax.synthesis.motion_goals import MotionTerm
from udkjax.synthesis.polish import polish
from udkjax.synthesis.ranges.limits import LengthLimits, Range, box_of, read_bounds
from udkjax.synthesis.search import SearchState, begin, improve, raise_weights
from udkjax.synthesis.selection import POLISH_STEPS, select
from udkjax.synthesis.starts import find_starts

SAMPLES_PER_START = 8  # number of random mechanisms per start; the best one is used
# Steps of each stage, and the fraction of trials that continue afterwards; the others are unlikely to succeed.
STAGES = ((15, 0.4), (30, 0.4), (100, 0.3))
FEWEST_TRIALS = 16  # smallest number of trials that continue; also the number of polished trials


class DesignSearch:
    """A design search that is compiled once and run repeatedly, for example from several seeds.

    Args:
        drawing: see `design`.
        goal: see `design`.
        free: see `design`.
        bounds: see `design`.
        lengths: see `design`.
        areas: see `design`.
        transmission: see `design`.
        rotation: see `design`.
        driver: see `design`.

    Raises:
        SceneError: see `design`.
    """

    @checked
    def __init__(
        self,
        drawing: Drawing | Mechanism,
        goal: Goal | Sequence[Goal | MotionTerm],
        free: Sequence[str] | None = None,
        bounds: Mapping[str, Any] | None = None,
        lengths: Mapping[tuple[str, str], Range] | None = None,
        areas: Mapping[str, Any] | None = None,
        transmission: float = 0.0,
        rotation: bool | None = None,
        driver: Drive = None,
    ):
        mechanism = drawing.mechanism() if isinstance(drawing, Drawing) else drawing
        require_number("transmission", transmission, "not negative")
        if transmission >= np.pi / 2:
            raise ValueError(f"transmission must be an angle below pi / 2 (rad), not {transmission:g}")
        numbers = FreeNumbers(mechanism, _all_pins(mechanism) if free is None else free)
        driver = only_driver(mechanism) if driver is None else driver
        goal, terms = _split(goal)
        goal.check(mechanism)
        goal.check_line(mechanism)
        limits = LengthLimits(numbers, lengths or {}, areas)
        boxes = {f"pin.{pin}": box_of(np.asarray(area, float)) for pin, area in (areas or {}).items()}
        self._given = {**{name: box for name, box in boxes.items() if name in numbers.names}, **(bounds or {})}
        ranges = read_bounds(numbers, self._given, _places(mechanism, goal), mechanism.name)
        self.problem = DesignProblem(
            mechanism, goal, numbers, driver, ranges, limits, float(np.sin(transmission)), rotation, terms
        )

    def with_path(self, targets: Numbers) -> "DesignSearch":
        """Return the same search for another path of the same point. Nothing is compiled again.

        Args:
            targets: positions (J, 2) in m, as those of a `PathGoal`; as many as its `values`, if it has any.

        Returns:
            A search with the same structure, free numbers and limits.

        Raises:
            ValueError: the goal of the search is not a single `PathGoal`, or the targets are invalid.
        """
        problem = self.problem
        if not isinstance(problem.goal, PathGoal) or problem.terms:
            raise ValueError("with_path needs a search whose only goal is a PathGoal")
        goal = replace(problem.goal, targets=targets)
        ranges = read_bounds(problem.free, self._given, _places(problem.mechanism, goal), problem.mechanism.name)
        other = copy(self)
        other.problem = problem.with_path(goal, ranges)
        return other

    def __call__(self, starts: int = 300, seed: int = 0, results: int = 5, threads: int | None = None) -> Designs:
        """Return the best different designs of a search from random mechanisms.

        Args:
            starts: number of mechanisms to start from.
            seed: seed of the random mechanisms; the same seed gives the same result.
            results: largest number of designs to return.
            threads: number of threads; by default the number of cores, or `UDKJAX_THREADS`.
        """
        for name, value in (("starts", starts), ("results", results)):
            require_count(name, value)
        require_count("seed", seed, 0)
        problem = self.problem
        trials = find_starts(problem, starts, SAMPLES_PER_START * starts, np.random.default_rng(int(seed)), threads)
        if not len(trials.x):
            what = "makes a whole turn" if problem.rotation else "has all positions of the goal"
            reason = f"no random mechanism within the bounds {what}: change the bounds or the structure"
            return Designs((), np.zeros(0), starts, reason)
        state = search(problem, improve(problem, begin(problem, trials, threads), STAGES[0][0], threads), threads)
        selection = select(problem, state, results, threads)
        return Designs(tuple(selection.found), selection.losses, starts, selection.reason)


def search(problem: DesignProblem, state: SearchState, threads: int | None) -> SearchState:
    """Return the final state of a search: from stage to stage fewer trials, the best, are improved; the last are polished."""
    shares = [share for _, share in STAGES]
    for share, (steps, _) in zip(shares, STAGES[1:], strict=False):
        count = max(FEWEST_TRIALS, int(share * len(state.merit)))
        merit = np.where(state.found.exists, state.merit, np.inf)
        state = state.take(np.argsort(merit, kind="stable")[:count])
        raise_weights(problem, state)
        state = improve(problem, state, steps, threads)
    merit = np.where(state.found.exists, state.merit, np.inf)
    return polish(problem, state.take(np.argsort(merit, kind="stable")[:FEWEST_TRIALS]), POLISH_STEPS, threads)


@checked
@concrete_only()
def design(
    drawing: Drawing | Mechanism,
    goal: Goal | Sequence[Goal | MotionTerm],
    free: Sequence[str] | None = None,
    bounds: Mapping[str, Any] | None = None,
    lengths: Mapping[tuple[str, str], Range] | None = None,
    areas: Mapping[str, Any] | None = None,
    transmission: float = 0.0,
    rotation: bool | None = None,
    driver: Drive = None,
    starts: Annotated[int, COUNT] = 300,
    seed: Annotated[int, NOT_NEGATIVE_COUNT] = 0,
    results: int = 5,
) -> Designs:
    """Return mechanisms with the structure of a drawing that meet a goal, found by least squares from many starts.

    Random mechanisms within the bounds are turned once. The best, moved and scaled to the goal as a whole if their pins are
    free, are improved by the Levenberg-Marquardt method, in batches of compiled machine code, with exact derivatives with
    respect to all free numbers. Designs stay on one branch, pass positions in order, respect the limits, and are verified by
    `kinematics`.

    Args:
        drawing: the structure: a drawing, or a mechanism with one degree of freedom when its drivers are removed. Free pins
            only define which links they join.
        goal: a `PathGoal`, `PoseGoal`, `FunctionGoal` or `CurveGoal`; or a list of one of these and motion goals: `TorqueGoal`,
            `LoadGoal`, `EnergyGoal`, `FrequencyGoal`, `GapGoal`, `ToleranceGoal`, `RobustGoal` and `MotionGoal`.
        free: names of the free numbers, such as `pin.A` or `pin.C[0]`; by default all pins, with their
            lengths and angles.
        bounds: (low, high) by the names of free numbers; low and high are numbers, or arrays of the free number's shape (m).
        lengths: (least, most) distances (m) by pairs of pins.
        areas: the area of a pin by its name: a circle (x, y, radius) or the corners (k, 2) of a convex polygon (m).
        transmission: the least distance (rad) of the transmission angle of a four-bar from 0 and pi, over the whole turn if the
            driver makes one; for other linkages, of the equivalent angle.
        rotation: whether the driver has to make a whole turn; by default True if it is an angle.
        driver: a driver or coordinate, as for `kinematics`; by default the only driver.
        starts: number of mechanisms to start from.
        seed: seed of the random mechanisms; the same seed gives the same result.
        results: largest number of designs to return.

    Returns:
        A `Designs`, the best first; empty if nothing was found within the limits.

    Raises:
        SceneError: names, bounds or lengths are wrong, positions do not follow from the driver, or machine code cannot evaluate
            an element of the mechanism.
        ValueError: another argument is invalid.
    """
    search = DesignSearch(drawing, goal, free, bounds, lengths, areas, transmission, rotation, driver)
    return search(starts, seed, results)


def _split(goals: Goal | Sequence[Goal | MotionTerm]) -> tuple[Goal, list[MotionTerm]]:
    """Return the positional goal and the motion goals."""
    goals_in_order = [goals] if isinstance(goals, Goal) else list(goals)
    firsts, terms = [g for g in goals_in_order if isinstance(g, Goal)], [g for g in goals_in_order if isinstance(g, MotionTerm)]
    if len(firsts) != 1 or len(terms) != len(goals_in_order) - 1:
        raise ValueError(
            "goal must be a PathGoal, PoseGoal, FunctionGoal or CurveGoal; in a list, one of them and any motion goals"
        )
    return firsts[0], terms


def _all_pins(mechanism: Mechanism) -> list[str]:
    if mechanism.drawing is None:
        raise SceneError(["free: name the free numbers; only a drawing has a default, all pins"], mechanism.name)
    known, named = mechanism.number_fields(), numbers_in_expressions(mechanism.drawing.formulas, "pin")
    fields = {name: known[split_index(name, known)[0]] for name in mechanism.independent_parameters()}
    of_pins = [name for name, x in fields.items() if x.section == "pin" and x.path[-1] not in ("velocity", "along")]
    return [*(name for name, x in fields.items() if x.section == "number" and x.owner in named), *of_pins]


def _places(mechanism: Mechanism, goal: Goal) -> np.ndarray:
    """Return the places (k, 2) that determine the location and size of the region in which free pins are searched."""
    if goal.has_place:
        fixed = [] if mechanism.drawing is None else [np.asarray(p) for p in mechanism.drawing.pins.values()]
        size = np.ptp(goal.targets[:, :2], axis=0).max()
        return goal.targets[:, :2] if size > 0 or not fixed else np.vstack([goal.targets[:, :2], *fixed])
    return np.asarray(mechanism.q0)[:, :2]
