"""All four-bars that meet a goal exactly: nine points of a path, or five poses of a link."""

from collections.abc import Mapping
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from udkjax.positions.following.drive import Drive, only_driver
from udkjax.positions.following.free_numbers import FreeNumbers
from udkjax.requirements import require_number
from udkjax.scene.arguments import checked
from udkjax.scene.drawing import Drawing
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.complete.balls import ComplexBall
from udkjax.synthesis.complete.complete_designs import CompleteDesigns, OtherSolution
from udkjax.synthesis.complete.drawn_four_bar import DrawnFourBar, read_four_bar
from udkjax.synthesis.complete.five_poses import DYAD_COUNT, find_real_dyads
from udkjax.synthesis.complete.four_bars import (
    DEFECTS,
    GRASHOF_KINDS,
    FourBarBoxes,
    FourBars,
    classify,
    cognate_joints,
    radius_of,
    stack_four_bars,
)
from udkjax.synthesis.complete.motion_check import check_motions
from udkjax.synthesis.complete.nine_points import find_real_classes
from udkjax.synthesis.goals import PathGoal, PoseGoal
from udkjax.synthesis.ranges.limits import LengthLimits, Range, read_bounds


class _Solutions(NamedTuple):
    """The solutions for a goal.

    Attributes:
        bars: M proven four-bars.
        radius: the radius of the certificate of each (m).
        numbers: the number of the class of each.
        cognates: the index of each within its class.
        classes: the number of classes; for poses, the number of dyads.
        others: the kind of each unusable solution and its joints by letter, relative to the first place of the goal, as x + i y
            and x - i y.
        paths: counts of all solutions by outcome.
    """

    bars: FourBars
    radius: np.ndarray
    numbers: np.ndarray
    cognates: np.ndarray
    classes: int
    others: list[tuple[str, dict[str, np.ndarray]]]
    paths: dict[str, int]


@checked
def design_all(
    drawing: Drawing | Mechanism,
    goal: PathGoal | PoseGoal,
    driver: Drive = None,
    bounds: Mapping[str, Any] | None = None,
    lengths: Mapping[tuple[str, str], Range] | None = None,
    areas: Mapping[str, Any] | None = None,
    transmission: float = 0.0,
    rotation: bool = False,
) -> CompleteDesigns:
    """Return all four-bars that move a pin of the coupler through nine points, or the coupler through five poses.

    Nine points have 1,442 classes of complex solutions, all tracked by a homotopy; five poses have four dyads, computed as
    eigenvectors of a matrix. Each real solution is proven: by Krawczyk's theorem, with all rounding errors bounded, exactly one
    four-bar that meets the goal exactly lies within `radius` of its pins. There is no proof that further solutions do not
    exist; `paths` counts the outcomes of all tracked solutions. Positions are then assigned to circuits and branches, and the
    motions are verified.

    Args:
        drawing: a four-bar: a crank and a rocker with two pins each, and a coupler with a third pin; the positions of the pins
            do not matter.
        goal: a `PathGoal` with nine targets for the coupler's pin, or a `PoseGoal` with five for the coupler and its third
            pin (`pin`); without values of the driver. Angles count from the first pose.
        driver: a driver or coordinate that is the angle of a link on the ground; by default the only driver.
        bounds: (low, high) by the names of pins, such as `pin.O` (m), in the first position. Designs outside are left out.
        lengths: (least, most) distances (m) by pairs of pins.
        areas: circles and polygons by pin, as for `design`, in the first position.
        transmission: the least distance (rad) of the transmission angle from 0 and pi in all positions.
        rotation: whether the driver has to make a whole turn.

    Returns:
        A `CompleteDesigns`, in which designs without defects come first.

    Raises:
        SceneError: the drawing is not a four-bar, the driver does not turn a crank, or a limit is invalid.
        ValueError: the goal has the wrong number of positions, or its solutions are not isolated.
    """
    mechanism = drawing.mechanism() if isinstance(drawing, Drawing) else drawing
    given = mechanism.drawing
    if isinstance(given, Drawing) and given.by_coordinates() is not given:
        mechanism = given.by_coordinates().mechanism()  # the pins found are places
    if goal.values is not None:
        raise ValueError("the goal has values of the driver: no four-bar meets them in all positions; leave them out")
    point = goal.point if isinstance(goal, PathGoal) else goal.pin
    if point is None:
        raise ValueError("pin: name the pin of the coupler that passes through the points")
    drawn = read_four_bar(mechanism, point, only_driver(mechanism) if driver is None else driver)
    if isinstance(goal, PoseGoal) and goal.body != drawn.coupler:
        raise SceneError([f"goal: the body is not the coupler, {drawn.coupler}"], mechanism.name)
    keeps = _Limits(mechanism, drawn, bounds or {}, lengths or {}, areas or {}, transmission, rotation)
    solutions = _through_points(goal.targets) if isinstance(goal, PathGoal) else _through_poses(goal.targets)
    bars, both = solutions.bars, np.tile(np.arange(len(solutions.radius)), 2)
    bars = stack_four_bars([bars, bars.swapped()])
    classification = classify(bars)
    confirmed = check_motions(bars, classification)
    least = np.min(np.abs(bars.transmission), axis=1)
    doubtful = (classification.defect == 0) & ~confirmed.all(axis=1)
    places = drawn.places(bars, np.arange(len(bars.O)), np.zeros(len(bars.O), int))
    best = np.lexsort((-least, ~classification.turns, doubtful, classification.defect))
    best = best[keeps(places, least, classification.turns)[best]]
    return CompleteDesigns(
        {name: place[best] for name, place in places.items()},
        drawn.values(bars, classification.values)[best],
        tuple(GRASHOF_KINDS[k] for k in classification.kind[best]),
        classification.turns[best],
        tuple(DEFECTS[k] for k in classification.defect[best]),
        classification.circuits[best],
        classification.branches[best],
        classification.order[best],
        least[best],
        confirmed[best],
        solutions.radius[both][best],
        solutions.numbers[both][best],
        solutions.cognates[both][best],
        solutions.classes,
        tuple(OtherSolution(kind, drawn.coordinates(joints, goal.targets[0])) for kind, joints in solutions.others),
        len(least) - len(best),
        solutions.paths,
        mechanism,
        drawn.coupler,
        drawn.driver,
    )


class _Limits:
    """Limits of complete designs: bounds and areas of pins, distances between them, transmission and rotation."""

    def __init__(
        self,
        mechanism: Mechanism,
        drawn: DrawnFourBar,
        bounds: Mapping[str, Any],
        lengths: Mapping[tuple[str, str], Range],
        areas: Mapping[str, Any],
        transmission: float,
        rotation: bool,
    ):
        require_number("transmission", transmission, "not negative")
        self.numbers = FreeNumbers(mechanism, [f"pin.{name}" for name in drawn.pins.values()])
        self.lengths = LengthLimits(self.numbers, lengths, areas)
        self.bounds = read_bounds(self.numbers, bounds, np.asarray(mechanism.q0)[:, :2], mechanism.name)
        self.least, self.rotation = np.sin(transmission), rotation

    def __call__(self, places: Mapping[str, np.ndarray], transmission: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """Return a mask (M,) of the four-bars within the limits, from their pins (M, 2) by name."""
        if not len(turns):
            return turns
        x = self.numbers.join(places)
        inside = np.all((x >= self.bounds.low) & (x <= self.bounds.high), axis=1) & np.all(self.lengths(x)[0] <= 0.0, axis=1)
        return inside & (transmission >= self.least) & (turns | (not self.rotation))


class CompleteSearch(NamedTuple):
    """A search by `design_all` with its arguments, such as those of a file; a call runs it."""

    mechanism: Mechanism
    goal: PathGoal | PoseGoal
    driver: Drive
    limits: Mapping[str, Any]

    def __call__(self) -> CompleteDesigns:
        """Return the designs for the goal, within the limits."""
        return design_all(self.mechanism, self.goal, self.driver, **self.limits)


def _through_points(targets: np.ndarray) -> _Solutions:
    classes = find_real_classes(targets)
    J, u, R = len(targets), classes.boxes.middle.astype(float), classes.boxes.middle.shape[1]
    P = targets[:, 0] + 1j * targets[:, 1]
    x, r, y, s = classes.scale * (u[0:8:2] + 1j * u[1:8:2])
    turns = np.concatenate([np.ones((1, R)), 1.0 + u[8 : 7 + J] + 1j * u[7 + J :]]).T
    bars = FourBars(P[0] + x - r, P[0] + y - s, P + turns * x[:, None], P + turns * y[:, None], P)
    cognates = bars.cognates()
    joints = cognate_joints(classes.boxes)
    radii = [radius_of(joint, bar, P[0], classes.scale) for joint, bar in zip(joints, cognates, strict=True)]
    counts = {k: v for k, v in classes.paths._asdict().items() if v or k in ("tracked", "regular")}
    numbers, z = np.tile(np.arange(R), 3), classes.scale * classes.ends.joints.reshape(4, 2, -1)
    joints = {"O": z[0] - z[1], "C": z[2] - z[3], "A": z[0], "B": z[2]}
    return _Solutions(
        stack_four_bars(list(cognates)),
        np.concatenate(radii),
        numbers,
        np.repeat(np.arange(3), R),
        R,
        [(kind, {name: place[:, k] for name, place in joints.items()}) for k, kind in enumerate(classes.ends.kinds)],
        counts,
    )


def _through_poses(targets: np.ndarray) -> _Solutions:
    dyads = find_real_dyads(targets)
    u, P = dyads.scale * dyads.boxes.middle.astype(float), targets[:, 0] + 1j * targets[:, 1]
    pairs = np.array(list(combinations(range(u.shape[1]), 2)), int).reshape(-1, 2)
    joint, crank = u[0] + 1j * u[1], u[2] + 1j * u[3]
    pivots, joints = P[0] + joint - crank, P + dyads.turns * joint[:, None]
    first, second = pairs.T
    bars = FourBars(pivots[first], pivots[second], joints[first], joints[second], P)
    joint, crank = (ComplexBall(dyads.boxes.balls.part(k), dyads.boxes.balls.part(k + 1)) for k in (0, 2))
    pivot = joint - crank
    boxes = FourBarBoxes(pivot.part(first), pivot.part(second), joint.part(first), joint.part(second))
    radii = radius_of(boxes, bars, P[0], dyads.scale)
    counts = {"dyads": DYAD_COUNT, "infinite": dyads.infinite}
    numbers, unproven = np.arange(len(pairs)), dyads.scale * dyads.unproven.T
    others = [("unproven", {"A": _isotropic(*v[:2]), "O": _isotropic(*(v[:2] - v[2:]))}) for v in unproven]
    return _Solutions(bars, radii, numbers, np.zeros(len(pairs), int), u.shape[1], others, counts)


def _isotropic(x: float, y: float) -> np.ndarray:
    return np.array([x + 1j * y, x - 1j * y])
