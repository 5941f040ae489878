"""All four-bars that meet a goal exactly: nine places of a point, or five poses of a link."""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from udkjax.scene.arguments import checked
from udkjax.scene.checks import SceneError
from udkjax.scene.drawing import Drawing
from udkjax.scene.mechanism import Mechanism
from udkjax.study.design.design import only_driver
from udkjax.study.design.goals import PathGoal, PoseGoal
from udkjax.study.drive import Drive
from udkjax.study.synthesis.balls import ComplexBall
from udkjax.study.synthesis.boxes import FourBarBoxes, cognate_joints, radius_of
from udkjax.study.synthesis.complete_designs import CompleteDesigns
from udkjax.study.synthesis.drawn_four_bar import read_four_bar
from udkjax.study.synthesis.five_poses import DYADS, find_real_dyads
from udkjax.study.synthesis.four_bars import DEFECTS, KINDS, FourBars, classify, stack_four_bars
from udkjax.study.synthesis.motion_check import check_motions
from udkjax.study.synthesis.nine_points import find_real_classes
from udkjax.study.synthesis.refusals import require_five_poses, require_nine_points


class _Solutions(NamedTuple):
    """Four-bars with what was proven of each: radius (m), class and cognate; and of all together."""

    bars: FourBars
    radius: np.ndarray
    numbers: np.ndarray
    cognates: np.ndarray
    classes: int
    unproven: int
    paths: dict[str, int]


@checked
def design_all(drawing: Drawing | Mechanism, goal: PathGoal | PoseGoal, driver: Drive = None) -> CompleteDesigns:
    """Find all four-bars whose coupler point goes through nine places, or whose coupler goes through five poses.

    Nine places have 1,442 classes of solutions in complex numbers, of which a homotopy follows each; five poses have four dyads,
    the eigenvectors of a matrix. Each real one is proven: Krawczyk's theorem, with all roundings bounded, says that within
    `radius` of its pins there is exactly one four-bar that meets the goal as its numbers stand. That no others exist is not
    proven; `paths` tells what became of all solutions. Positions are then assigned to circuits and branches, mechanisms moved.

    Args:
        drawing: a four-bar: a crank and a rocker of two pins each, and a coupler with a third pin. Its own pins do not matter.
        goal: a `PathGoal` of nine targets for the coupler's pin, or a `PoseGoal` of five for the coupler by that pin (`pin`);
            without values of the driver. Angles count from the first pose.
        driver: the motor, or another driver or coordinate that is the angle of a link at the ground; by default the only driver.

    Returns:
        `CompleteDesigns`, those without defects first.

    Raises:
        SceneError: the drawing is no four-bar, or its driver no crank.
        ValueError: the goal has other numbers of positions, or positions for which solutions are not isolated.
    """
    mechanism = drawing.mechanism() if isinstance(drawing, Drawing) else drawing
    if goal.values is not None:
        raise ValueError("values of the driver are given: with them no four-bar meets so many positions; leave them out")
    point = goal.point if isinstance(goal, PathGoal) else goal.pin
    if point is None:
        raise ValueError("pin: name the pin of the coupler that goes through the places")
    drawn = read_four_bar(mechanism, point, only_driver(mechanism) if driver is None else driver)
    if isinstance(goal, PoseGoal) and goal.body != drawn.coupler:
        raise SceneError([f"goal: the body is not the coupler, {drawn.coupler}"], mechanism.name)
    solutions = _through_points(goal.targets) if isinstance(goal, PathGoal) else _through_poses(goal.targets)
    bars, both = solutions.bars, np.tile(np.arange(len(solutions.radius)), 2)
    bars = stack_four_bars([bars, bars.swapped()])
    found = classify(bars)
    confirmed = check_motions(bars, found)
    least = np.min(np.abs(bars.transmission), axis=1)
    doubtful = (found.defect == 0) & ~confirmed.all(axis=1)
    best = np.lexsort((-least, ~found.turns, doubtful, found.defect))
    places = drawn.places(bars, np.arange(len(bars.O)), np.zeros(len(bars.O), int))
    return CompleteDesigns(
        {name: place[best] for name, place in places.items()},
        drawn.values(bars, found.values)[best],
        tuple(KINDS[k] for k in found.kind[best]),
        found.turns[best],
        tuple(DEFECTS[k] for k in found.defect[best]),
        found.circuits[best],
        found.branches[best],
        found.order[best],
        least[best],
        confirmed[best],
        solutions.radius[both][best],
        solutions.numbers[both][best],
        solutions.cognates[both][best],
        solutions.classes,
        solutions.unproven,
        solutions.paths,
        mechanism,
        drawn.coupler,
        drawn.driver,
    )


class CompleteSearch(NamedTuple):
    """A call of `design_all` that has not been made yet, such as one from a file."""

    mechanism: Mechanism
    goal: PathGoal | PoseGoal
    driver: Drive

    def __call__(self) -> CompleteDesigns:
        """Make it."""
        return design_all(self.mechanism, self.goal, self.driver)


def _through_points(targets: np.ndarray) -> _Solutions:
    require_nine_points(targets)
    found = find_real_classes(targets)
    J, u, R = len(targets), found.boxes.middle.astype(float), found.boxes.middle.shape[1]
    P = targets[:, 0] + 1j * targets[:, 1]
    x, r, y, s = found.scale * (u[0:8:2] + 1j * u[1:8:2])
    turns = np.concatenate([np.ones((1, R)), 1.0 + u[8 : 7 + J] + 1j * u[7 + J :]]).T
    bars = FourBars(P[0] + x - r, P[0] + y - s, P + turns * x[:, None], P + turns * y[:, None], P)
    cognates = bars.cognates()
    joints = cognate_joints(found.boxes)
    radii = [radius_of(joint, bar, P[0], found.scale) for joint, bar in zip(joints, cognates, strict=True)]
    counts = {k: v for k, v in found.paths._asdict().items() if v or k in ("tracked", "regular")}
    numbers = np.tile(np.arange(R), 3)
    return _Solutions(
        stack_four_bars(list(cognates)), np.concatenate(radii), numbers, np.repeat(np.arange(3), R), R, found.unproven, counts
    )


def _through_poses(targets: np.ndarray) -> _Solutions:
    require_five_poses(targets)
    found = find_real_dyads(targets)
    u, P = found.scale * found.boxes.middle.astype(float), targets[:, 0] + 1j * targets[:, 1]
    pairs = np.array(list(combinations(range(u.shape[1]), 2)), int).reshape(-1, 2)
    joint, crank = u[0] + 1j * u[1], u[2] + 1j * u[3]
    pivots, joints = P[0] + joint - crank, P + found.turns * joint[:, None]
    one, two = pairs.T
    bars = FourBars(pivots[one], pivots[two], joints[one], joints[two], P)
    joint, crank = (ComplexBall(found.boxes.balls.part(k), found.boxes.balls.part(k + 1)) for k in (0, 2))
    pivot = joint - crank
    boxes = FourBarBoxes(pivot.part(one), pivot.part(two), joint.part(one), joint.part(two))
    radii = radius_of(boxes, bars, P[0], found.scale)
    counts = {"dyads": DYADS, "infinite": found.infinite}
    numbers = np.arange(len(pairs))
    return _Solutions(bars, radii, numbers, np.zeros(len(pairs), int), u.shape[1], found.unproven, counts)
