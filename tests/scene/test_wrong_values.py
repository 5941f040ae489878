"""Values of the wrong shape, and numbers beyond the range of floats, at every place of scenes and drawings."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

import udkjax as udk
from tests.scene.drawing.test_drawing_files import EVERYTHING
from tests.wrong_values import WRONG, places, toml_text, with_value

CAM = """format = 2
ground = ["O"]
units = {length = "mm", angle = "deg"}
slide = [{link = "follower", direction = [0, 1]}]
motor = [{pin = "O", speed = "2 rev/s"}]
[numbers]
base = 40
[pins]
O = [0, 0]
P = [0, 40]
[[link]]
name = "cam"
pins = ["O"]
mass = 1
width = 60
[[link]]
name = "follower"
pins = ["P"]
mass = 0.5
outline = [[-10, 30], [10, 30], [10, 90], [-10, 90]]
holes = [[[-5, 60], [5, 60], [0, 70]]]
[[cam]]
pins = ["O", "P"]
profile = {base = "base", law = ["cycloidal", "harmonic"], angle = [180, 180], lift = [20, -20]}
"""
EXAMPLES = Path(__file__).parents[2] / "examples"
SCENES = {name: (EXAMPLES / f"{name}.toml").read_text() for name in ("driven_pendulum", "planetary_gear", "slider_crank")}
SCENES |= {"drawing": EVERYTHING, "cam": CAM}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_value_at_any_place_is_refused_with_its_path(name, kind):
    scene = tomllib.loads(SCENES[name])
    assert toml_text(scene) and udk.loads(toml_text(scene)) == udk.loads(SCENES[name])
    for path in places(scene):
        with pytest.raises(udk.SceneError) as error:
            udk.loads(toml_text(with_value(scene, path, WRONG[kind])))
        named = [key for key in path if isinstance(key, str)]
        assert any(key in str(error.value) for key in named[-2:]), (path, str(error.value))


def drawn(old: str, new: str) -> list[str]:
    assert old in CAM
    with pytest.raises(udk.SceneError) as error:
        udk.loads(CAM.replace(old, new))
    return error.value.problems


@pytest.mark.parametrize(
    ("angles", "total"),
    [("[180, 181]", "361 deg (6.3"), ('["180 deg", "3.5 rad"]', "380.5352"), ("[180, 180.0001]", "360.0001 deg")],
)
def test_angles_of_a_law_are_one_mistake_with_their_sum(angles, total):
    (problem,) = drawn("[180, 180]", angles)
    assert problem.startswith(f'cam "cam1" (cam[0]).profile.angle: the angles must add up to a whole turn, not {total}')


def test_lifts_of_a_law_are_one_mistake_with_their_sum():
    (problem,) = drawn("[20, -20]", "[20, -19]")
    assert problem == 'cam "cam1" (cam[0]).profile.lift: the lifts must add up to zero, not 0.001 m'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("width = 60", "width = -3", "width: must be >= 0, not -3"),
        ("width = 60", 'width = "-3 cm"', 'width: must be >= 0, not "-3 cm"'),
        ('base = "base"', "base = -40", "profile.base: must be > 0, not -40"),
        ("base = 40", "base = -40", "profile.base: must be > 0, not -0.04"),  # an expression has no other number
        ("[180, 180]", "[-180, 540]", "profile.angle[0]: must be > 0, not -180"),
        ("[180, 180]", "[[180], [180, 1]]", "profile.angle: must be a list of numbers, not [[180], [180, 1]]"),
        ("[10, 30], [10, 90]", "[10, 30, 1], [10, 90, 1]", "outline: must be a list of lists of 2 numbers, not [["),
    ],
)
def test_numbers_are_shown_as_they_were_written(old, new, message):
    assert any(message in problem for problem in drawn(old, new))


@pytest.mark.parametrize("hole", ["[[0, 60]]", "[[0, 60], [1, 60]]", "[[0, 60], [1, 61], [2, 62]]"])
def test_a_hole_without_area_is_refused(hole):
    (problem,) = drawn("[[[-5, 60], [5, 60], [0, 70]]]", f"[{hole}]")
    assert problem.endswith("holes[0]: the corners lie on one line, and enclose no area")


@pytest.mark.parametrize("direction", [[np.inf, 1.0], [0.0, -np.inf], [np.nan, 1.0]])
def test_a_direction_that_is_not_finite_is_refused_in_python(direction):
    joint = udk.Slot(["ground", "a"], [[0, 0], [0, 0]], direction)
    with pytest.raises(udk.SceneError, match="axis: must be finite"):
        udk.Mechanism({"a": udk.Body(1.0, 1.0)}, {"slot": joint})
