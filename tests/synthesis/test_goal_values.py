"""Values of the wrong shape, and numbers beyond the range of floats, at every place of a goal."""

import shutil
import tomllib
from pathlib import Path

import pytest

import udkjax as udk
from tests.wrong_values import WRONG, places, toml_text, with_value
from udkjax.synthesis.goal_file import read_design

EXAMPLES = Path(__file__).parents[2] / "examples" / "goals"


@pytest.mark.parametrize("name", ["ellipse", "walking_foot", "nine_points"])
@pytest.mark.parametrize("kind", WRONG)
def test_no_wrong_value_of_a_goal_ends_in_an_error_of_python(tmp_path, name, kind):
    goal = tomllib.loads((EXAMPLES / f"{name}.toml").read_text())
    for drawing in EXAMPLES.glob("*.toml"):
        shutil.copy(drawing, tmp_path)
    refused = 0
    for path in [*(path for path in places(goal) if path != ("mechanism",) and not isinstance(path[-1], int)), ("goal", "kind")]:
        (tmp_path / "goal.toml").write_text(toml_text(with_value(goal, path, WRONG[kind])))
        try:
            read_design(tmp_path / "goal.toml")
        except udk.SceneError:
            refused += 1
    assert refused > 0


@pytest.mark.parametrize("value", ["[[1, 2], [3]]", "true", "[1, 2]"])
def test_a_transmission_that_is_no_angle_is_refused(tmp_path, value):
    for drawing in EXAMPLES.glob("*.toml"):
        shutil.copy(drawing, tmp_path)
    text = (EXAMPLES / "ellipse.toml").read_text()
    (tmp_path / "goal.toml").write_text(f"transmission = {value}\n{text}")
    with pytest.raises(udk.SceneError, match="transmission: must be an angle, not "):
        read_design(tmp_path / "goal.toml")
