"""The plan in the documentation shows the existing folders and imports."""

import ast
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


# Rooms that import each other: the interface of a folder beside what it is made of.
CIRCLES = (
    "integrate integrate/causes integrate/events integrate/events/instant integrate/events/run",
    "native native/gpu native/host",
    "native/language native/language/elementary",
    "scene scene/drawing scene/mjcf scene/outlines",
    "study study/diagnosis",
    "synthesis synthesis/complete",
)
MOST_MODULES = 16  # of a room, as many as one can keep in mind with what each is for


def test_rooms_have_an_order(house):
    found = [one for one in architecture.circles(house.arrows("room")) if len(one) > 1]
    assert {frozenset(one) for one in found} <= {frozenset(names.split()) for names in CIRCLES}


def test_rooms_are_small():
    root = ROOT / "udkjax"
    count = {
        folder.relative_to(root).as_posix(): sum(file.name != "__init__.py" for file in folder.glob("*.py"))
        for folder in root.rglob("*")
        if folder.is_dir()
    }
    assert {name: n for name, n in count.items() if n > MOST_MODULES} == {}


def test_rooms_say_what_lives_there():
    texts = {folder: folder / "__init__.py" for folder in (ROOT / "udkjax").rglob("*") if any(folder.glob("*.py"))}
    assert [folder for folder, file in texts.items() if not ast.get_docstring(ast.parse(file.read_text(encoding="utf-8")))] == []


# A model answers by its protocol (`scene/model.py`). The places that still ask for its class are the entries to the equations
# and functions whose results differ in kind. These ceilings may only fall.
MOST_ASKING = {"Mechanism": 11, "ConstrainedSystem": 6, "TracedSystem": 1}


def questions(text: str) -> list[str]:
    """Return the names of the classes for which each `isinstance` of a module asks."""
    calls = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    kinds = [call.args[1] for call in calls if call.func.id == "isinstance" and len(call.args) == 2]  # pyright: ignore
    return [getattr(n, "attr", getattr(n, "id", "")) for kind in kinds for n in ast.walk(kind)]


def test_questions_for_the_class_of_a_model_are_found():
    text = "if isinstance(x, Mechanism) and not isinstance(x, udk.ConstrainedSystem | Enum):\n    isinstance('Mechanism', str)"
    assert [name for name in questions(text) if name in MOST_ASKING] == ["Mechanism", "ConstrainedSystem"]


def test_models_are_asked_by_their_protocol():
    root = ROOT / "udkjax"
    files = [file for file in root.rglob("*.py") if file.relative_to(root).parts[0] != "scene"]
    asked = {file.relative_to(root).as_posix(): questions(file.read_text(encoding="utf-8")) for file in files}
    places = {kind: [name for name, kinds in asked.items() for x in kinds if x == kind] for kind in MOST_ASKING}
    assert {kind: names for kind, names in places.items() if len(names) > MOST_ASKING[kind]} == {}
