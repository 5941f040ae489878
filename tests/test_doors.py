"""Doors: the `__init__.pyi` of a folder lists exactly the names that other folders import from it."""

import ast
from functools import cache
from pathlib import Path

import pytest

import udkjax
from tests.fresh_process import python
from tests.quantities import QUANTITIES

ROOT = Path(udkjax.__file__).parent
Name = tuple[str, str]  # the module, and the name in it
# How many names the floors above may import from a floor, and how many if those reached through an imported module count.
MOST_NAMES = {"scene": (85, 98), "equations": (65, 86), "native": (43, 43), "positions": (58, 58), "study": (35, 35)}


@cache
def nodes_of(text: str) -> list[ast.ImportFrom | ast.Attribute]:
    """Return the nodes of a module that import names or use attributes of them."""
    return [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.ImportFrom | ast.Attribute)]


def imported_names(file: Path) -> list[Name]:
    """Return every name that a file imports from the package, anywhere in the file."""
    nodes = [n for n in nodes_of(file.read_text(encoding="utf-8")) if isinstance(n, ast.ImportFrom)]
    return [(n.module or "", name.name) for n in nodes if (n.module or "").split(".")[0] == "udkjax" for name in n.names]


def door(root: Path, floor: str) -> set[Name]:
    """Return the names in the stub of a folder, each in its module, and those in the public stub."""
    names = imported_names(root / floor / "__init__.pyi")
    return {*names, *((f"udkjax.{floor}", name) for _, name in names)}


def floors(root: Path) -> list[str]:
    return sorted(x.parent.name for x in root.glob("*/__init__.pyi"))


def used_names(root: Path) -> dict[str, dict[Name, list[str]]]:
    """Return the names that other folders import from each folder with a door, and the importing files."""
    found: dict[str, dict[Name, list[str]]] = {floor: {} for floor in floors(root)}
    for file in sorted(root.rglob("*.py")):
        place = file.relative_to(root)
        if place.name == "__init__.py" and len(place.parts) == 1:
            continue
        for module, name in imported_names(file):
            parts = module.split(".")
            floor = parts[1] if len(parts) > 1 else name
            if floor in found and floor != place.parts[0]:
                found[floor].setdefault((module, name), []).append(str(place))
    return found


def names_through_modules(root: Path) -> dict[str, set[Name]]:
    """Return the names of each folder that other folders use; names reached through an imported module count one by one."""
    found = {floor: set(names) for floor, names in used_names(root).items()}
    for file in sorted(root.rglob("*.py")):
        nodes = nodes_of(file.read_text(encoding="utf-8"))
        for node in (n for n in nodes if isinstance(n, ast.ImportFrom) and (n.module or "").startswith("udkjax")):
            for name in node.names:
                module = f"{node.module}.{name.name}"
                place = root.joinpath(*module.split(".")[1:])
                floor = module.split(".")[1]
                if floor not in found or floor == file.relative_to(root).parts[0] or module.count(".") < 2:
                    continue
                if place.is_dir() or place.with_suffix(".py").exists():
                    values = [n for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)]
                    taken = {(module, n.attr) for n in values if n.value.id == (name.asname or name.name)}  # pyright: ignore
                    if taken:
                        found[floor] = found[floor] - {(node.module or "", name.name)} | taken
    return found


def violations(root: Path) -> list[str]:
    return [
        f"{places[0]}: {module}.{name}"
        for floor, names in used_names(root).items()
        for (module, name), places in names.items()
        if (module, name) not in door(root, floor)
    ]


def test_floors_import_only_what_stands_in_a_door():
    assert violations(ROOT) == []


def test_an_import_past_the_door_is_caught(tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "__init__.pyi").write_text("from udkjax.scene.elements.bodies import Body as Body")
    (tmp_path / "show").mkdir()
    for line in ("from udkjax.scene.elements.bodies import Body", "from udkjax.scene import Body"):
        (tmp_path / "show" / "plots.py").write_text(line)
        assert violations(tmp_path) == []
    for line in ("from udkjax.scene.elements.bodies import secret", "def late():\n    from udkjax.scene.elements import bodies"):
        (tmp_path / "show" / "plots.py").write_text(line)
        assert violations(tmp_path)


@pytest.mark.parametrize("floor", floors(ROOT))
def test_a_door_lists_nothing_that_nobody_takes(floor):
    used = {name for _, name in used_names(ROOT)[floor]} | {name for _, name in imported_names(ROOT / "__init__.pyi")}
    listed = {name for _, name in imported_names(ROOT / floor / "__init__.pyi")}
    unused = listed - used - OFFERED.get(floor, set())
    assert not unused, f"nobody imports these names of {floor}/__init__.pyi: remove them, or add those for users to OFFERED"


# Names that no floor takes, but users do.
OFFERED = {
    "equations": {"TextbookEquations", "Uniqueness", "prepare", *QUANTITIES},
    "pinv": {"LeastSquaresSolution"},
}


@pytest.mark.parametrize("floor", sorted(MOST_NAMES))
def test_doors_are_narrow(floor):
    imported, reached = MOST_NAMES[floor]
    assert len(used_names(ROOT)[floor]) <= imported
    assert len(names_through_modules(ROOT)[floor]) <= reached


WING = """
import sys
import udkjax as udk
mech = udk.library.slider_crank() if hasattr(udk.library, "slider_crank") else udk.library.parallelogram()
udk.kinematics, udk.design, udk.design_all, udk.equilibrium, udk.modes, udk.travel, udk.PositionBatch, udk.assemble
print(sorted(m for m in sys.modules if m.startswith(("udkjax.integrate", "udkjax.study", "diffrax"))))
"""


def test_positions_statics_and_synthesis_load_nothing_that_integrates():
    assert python(WING) == "[]"


def test_kinematics_loads_no_floor_beside_positions():
    loaded = "[m for m in sys.modules if m.startswith('udkjax.') and m.split('.')[1] in beside and m.count('.') > 1]"
    beside = "beside = ('statics', 'synthesis', 'integrate', 'study')"
    assert python(f"import sys, udkjax; udkjax.kinematics; {beside}; print({loaded})") == "[]"
