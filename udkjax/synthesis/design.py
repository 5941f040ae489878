"""Design by gradient: mechanisms of which a point, a link or an output moves as wanted."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from udkjax.positions.drive import Drive
from udkjax.positions.free_numbers import FreeNumbers
from udkjax.requirements import require_count, require_number
from udkjax.scene.arguments import checked
from udkjax.scene.checks import SceneError
from udkjax.scene.drawing import Drawing
from udkjax.scene.mechanism import Mechanism
from udkjax.synthesis.design_problem import DesignProblem
from udkjax.synthesis.designs import Designs
from udkjax.synthesis.goals import Goal
from udkjax.synthesis.limits import LengthLimits, Range, box_of, read_bounds
from udkjax.synthesis.motion_goals import MotionTerm
from udkjax.synthesis.polish import polish
from udkjax.synthesis.search import SearchState, begin, improve, raise_walls
from udkjax.synthesis.selection import POLISHING, select
from udkjax.synthesis.starts import find_starts

SAMPLES = 8  # random mechanisms for each start: the best of them are taken
# Steps of a search, and the share of the trials that goes on afterwards: most have shown by then where they lead.
STAGES = ((15, 0.4), (30, 0.4), (100, 0.3))
FEWEST = 16  # trials that go on, at least; as many are polished in the end


class DesignSearch:
    """A design that is compiled once and searched as often as wanted, such as from several seeds.

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
            raise ValueError(f"transmission must be an angle below a right one (rad), not {transmission:g}")
        numbers = FreeNumbers(mechanism, _all_pins(mechanism) if free is None else free)
        driver = only_driver(mechanism) if driver is None else driver
        goal, terms = _split(goal)
        goal.check(mechanism)
        goal.check_line(mechanism)
        limits = LengthLimits(numbers, lengths or {}, areas)
        boxes = {f"pin.{pin}": box_of(np.asarray(area, float)) for pin, area in (areas or {}).items()}
        boxes = {name: box for name, box in boxes.items() if name in numbers.names}
        found = read_bounds(numbers, {**boxes, **(bounds or {})}, _places(mechanism, goal), mechanism.name)
        self.problem = DesignProblem(
            mechanism, goal, numbers, driver, found, limits, float(np.sin(transmission)), rotation, terms
        )

    def __call__(self, starts: int = 300, seed: int = 0, results: int = 5, threads: int | None = None) -> Designs:
        """Search from so many random mechanisms; return the best that differ.

        Args:
            starts: number of mechanisms to start from.
            seed: of the random mechanisms; the same seed gives the same result.
            results: most designs to return.
            threads: number of threads; by default that of the cores.
        """
        for name, value in (("starts", starts), ("results", results)):
            require_count(name, value)
        require_count("seed", seed, 0)
        problem = self.problem
        trials = find_starts(problem, starts, SAMPLES * starts, np.random.default_rng(seed), threads)
        if not len(trials.x):
            what = "makes a whole turn" if problem.rotation else "has all positions of the goal"
            reason = f"no random mechanism within the bounds {what}: change the bounds or the structure"
            return Designs((), np.zeros(0), starts, reason)
        state = search(problem, improve(problem, begin(problem, trials, threads), STAGES[0][0], threads), threads)
        found = select(problem, state, results, threads)
        return Designs(tuple(found.found), found.losses, starts, found.reason)


def search(problem: DesignProblem, state: SearchState, threads: int | None) -> SearchState:
    """Go on with the best trials, stage by stage."""
    shares = [share for _, share in STAGES]
    for share, (steps, _) in zip(shares, STAGES[1:], strict=False):
        count = max(FEWEST, int(share * len(state.merit)))
        merit = np.where(state.found.is_there, state.merit, np.inf)
        state = state.take(np.argsort(merit, kind="stable")[:count])
        raise_walls(problem, state)
        state = improve(problem, state, steps, threads)
    merit = np.where(state.found.is_there, state.merit, np.inf)
    return polish(problem, state.take(np.argsort(merit, kind="stable")[:FEWEST]), POLISHING, threads)


@checked
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
    starts: int = 300,
    seed: int = 0,
    results: int = 5,
) -> Designs:
    """Find mechanisms of the structure of a drawing that meet a goal, by least squares from many starts at once.

    Random mechanisms within the bounds are turned once; the best of them, moved and scaled to the goal as a whole where that is
    free, are improved by Levenberg and Marquardt's method, all side by side in machine code, with exact derivatives by all free
    numbers. Branches are kept, positions come in their order, limits hold. Every design has been moved by `kinematics`.

    Args:
        drawing: the structure: a drawing, or a mechanism with one degree of freedom once its drivers hold. Its pins say nothing
            but how links are joined, where they are free.
        goal: a `PathGoal`, `PoseGoal` or `FunctionGoal`; or a list of it and of goals about the motion: `TorqueGoal`, `LoadGoal`,
            `EnergyGoal`, `FrequencyGoal`, `ToleranceGoal` and `MotionGoal`.
        free: names of the numbers that are free, such as `pin.A` or `pin.C[0]`; by default all pins.
        bounds: (low, high) by the names of free numbers; each end one number, or of the number's shape (m).
        lengths: (least, most) distances (m) by two pins.
        areas: area that a pin stays in, by its name: a circle (x, y, radius) or the corners (k, 2) of a convex
            polygon (m).
        transmission: the least angle (rad) between the transmission and none: of a four-bar, by how much the transmission angle
            stays away from 0 and pi; over the whole turn if there is one.
        rotation: whether the driver has to make a whole turn; by default where it is an angle.
        driver: a driver or coordinate, as for `kinematics`; by default the only driver.
        starts: number of mechanisms to start from.
        seed: of these; the same seed gives the same result.
        results: most designs to return.

    Returns:
        `Designs`, the best first; none where nothing was found within the limits.

    Raises:
        SceneError: names, bounds or lengths are wrong, positions do not follow from the driver, or machine code has no
            instruction for something in the mechanism.
        ValueError: another argument cannot be used.
    """
    found = DesignSearch(drawing, goal, free, bounds, lengths, areas, transmission, rotation, driver)
    return found(starts, seed, results)


def _split(goals: Goal | Sequence[Goal | MotionTerm]) -> tuple[Goal, list[MotionTerm]]:
    """Return the one goal that says where the motion goes, and those that measure the motion."""
    found = [goals] if isinstance(goals, Goal) else list(goals)
    firsts, terms = [g for g in found if isinstance(g, Goal)], [g for g in found if isinstance(g, MotionTerm)]
    if len(firsts) != 1 or len(terms) != len(found) - 1:
        raise ValueError("goal must be a PathGoal, PoseGoal or FunctionGoal; in a list, one of them and any motion goals")
    return firsts[0], terms


def _all_pins(mechanism: Mechanism) -> list[str]:
    if mechanism.drawing is None:
        raise SceneError(["free: name the numbers that are free; only of a drawing all pins are by default"], mechanism.name)
    return [f"pin.{name}" for name in mechanism.drawing.groups["pin"]]


def only_driver(mechanism: Mechanism) -> str:
    """Return the name of the only driver; raise `SceneError` where there is none, or more."""
    names = mechanism.driver_names
    if len(names) != 1:
        choices = f"there are {', '.join(names)}" if names else "there is none in the scene"
        raise SceneError([f"driver: name the driver or a coordinate, such as body.crank.angle: {choices}"], mechanism.name)
    return names[0]


def _places(mechanism: Mechanism, goal: Goal) -> np.ndarray:
    """Return the places that say where, and of what size, the mechanism may be."""
    if goal.has_place:
        fixed = [] if mechanism.drawing is None else [np.asarray(p.position) for p in mechanism.drawing.groups["pin"].values()]  # pyright: ignore
        size = np.ptp(goal.targets[:, :2], axis=0).max()
        return goal.targets[:, :2] if size > 0 or not fixed else np.vstack([goal.targets[:, :2], *fixed])
    return np.asarray(mechanism.q0)[:, :2]
