"""The deviation of designs from their goals, in words."""

from types import SimpleNamespace

import numpy as np

import udkjax as udk
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.synthesis.fit import deviation_of

MM = Units({"length": "mm", "angle": "deg"})


def said(goal, residuals):
    design = SimpleNamespace(mechanism=udk.library.four_bar(), residuals=np.array(residuals))
    found = deviation_of(design, goal)  # pyright: ignore[reportArgumentType]
    return found.words(MM), found.is_fit


def test_deviations_are_told_in_the_units_of_the_drawing():
    path = udk.PathGoal("B", [[0, 0], [0.03, 0.04], [0.03, 0.16]])
    assert said(path, [[0, 0], [0.003, 0.004], [0, 0]]) == ("at most 5 mm off on a path of 170 mm", True)
    assert said(path, [[0, 0], [0.044, 0], [0, 0]]) == ("at most 44 mm off on a path of 170 mm", False)
    pose = udk.PoseGoal("coupler", [[0, 0, 0], [0.1, 0, 1.0]], arm=0.1)
    turned = 2 * 0.1 * np.sin(np.deg2rad(2) / 2)
    assert said(pose, [[0, 0, 0], [0.001, 0, turned]]) == ("at most 1 mm off on a path of 100 mm, and 2 deg", True)
    output = udk.FunctionGoal("body.rocker.angle", [0.0, 1.0], np.deg2rad([0, 30]))
    assert said(output, np.deg2rad([[0.0], [-4.0]])) == ("at most 4 deg off over 30 deg", False)
