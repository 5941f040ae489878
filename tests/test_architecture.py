"""The plan in the documentation shows the existing folders and imports."""

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs"))
architecture = importlib.import_module("architecture")


@pytest.fixture(scope="module")
def house():
    return architecture.House(ROOT)


def test_the_picture_shows_the_folders_and_the_imports(house):
    shown = architecture.structure(architecture.PICTURE.read_text(encoding="utf-8"))
    assert shown == architecture.structure(architecture.draw(house)), "run: python docs/architecture.py --write"


def without_shares(table: str) -> list[list[str]]:
    """Rows without the share of lines, which changes with every commit."""
    rows = [line.strip("| ").split(" | ") for line in table.splitlines()]
    return sorted([row[:2] + row[3:] for row in rows])


def test_the_table_shows_the_floors_and_the_imports(house):
    page = architecture.PAGE.read_text(encoding="utf-8")
    (table,) = architecture.BLOCK.findall(page)
    assert without_shares(table) == without_shares(house.table()), "run: python docs/architecture.py --write"


def write(root: Path, **texts: str) -> Any:
    for name, text in texts.items():
        file = root / "udkjax" / f"{name.replace('__', '/')}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return architecture.House(root)


def test_floors_follow_from_imports(tmp_path):
    found = write(
        tmp_path,
        scene__bodies="",
        equations__loads="from udkjax.scene.bodies import Body\nfrom udkjax.scene import bodies",
        native__run__steps="def late():\n    from ...equations import loads\n    from udkjax.scene.bodies import Body",
    )
    assert found.floors == {"scene": 0, "equations": 1, "native": 2}
    assert found.needed == [("equations", "scene"), ("native", "equations")]
    assert found.taken("scene") == {("udkjax.scene.bodies", "Body"), ("udkjax.scene.bodies", "")}
    assert set(found.sizes("room")) == {"scene", "equations", "native/run"}


def test_of_a_circle_the_arrow_of_fewest_imports_points_up(tmp_path):
    found = write(
        tmp_path, scene__bodies="from udkjax.equations import loads", equations__loads="from udkjax.scene.bodies import A, B"
    )
    assert architecture.up(found.arrows("folder")) == [("scene", "equations")]
    assert found.floors == {"scene": 0, "equations": 1}
