"""No two modules import each other, even inside functions or for types; a folder imports only from lower floors.

The floors, and the libraries that belong to each, are tested in test_package.py.
"""

import ast
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import udkjax
from tests.imports import imports

ROOT = Path(udkjax.__file__).parent


def modules(root: Path) -> dict[str, Path]:
    """Return every module below `root` by its full name; a package is represented by its `__init__`."""
    found = {}
    for file in sorted(root.rglob("*.py")):
        parts = [root.name, *file.relative_to(root).with_suffix("").parts]
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imported(file: Path, name: str, known: dict[str, Path]) -> set[str]:
    """Return the modules that a module imports anywhere: at its top, inside functions, or for types."""
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    found = {full if full in known else full.rpartition(".")[0] for full in imports(file, package)}
    return {module for module in found if module in known and module != name}


def circles(root: Path) -> set[frozenset[str]]:
    """Return the sets of modules that import each other, directly or through others."""
    known = modules(root)
    # The package itself names everything that is public, for type checkers, and loads it when it is asked for.
    names = [name for name in known if name != root.name]
    place = {name: k for k, name in enumerate(names)}
    edges = [(place[n], place[m]) for n in names for m in imported(known[n], n, known) if m in place]
    row, column = np.array(edges, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(row)), (row, column)), shape=(len(names), len(names)))
    _, label = connected_components(graph, connection="strong")
    sets = [frozenset(n for n, k in zip(names, label, strict=True) if k == j) for j in np.unique(label)]
    return {found for found in sets if len(found) > 1}


def test_no_modules_import_each_other():
    assert circles(ROOT) == set()


@pytest.mark.parametrize(
    "line",
    [
        "from package.other import thing",
        "from package import other",
        "import package.other",
        "from . import other",
        "def late():\n    from .other import thing",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from package.other import thing",
    ],
)
def test_a_circle_is_found_wherever_it_hides(tmp_path, line):
    root = tmp_path / "package"
    root.mkdir()
    (root / "__init__.py").write_text("")
    (root / "one.py").write_text(line)
    (root / "other.py").write_text("from package.third import thing")
    (root / "third.py").write_text("")
    assert circles(root) == set()
    (root / "third.py").write_text("import package.one")
    assert circles(root) == {frozenset({"package.one", "package.other", "package.third"})}


def test_each_name_of_a_class_is_used_once():
    places: dict[str, list[str]] = {}
    for module, file in modules(ROOT).items():
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(module)
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


# Tests that replace names of the package depend on its implementation: `calls_of` (calls.py) observes calls, `multiplied`
# (ten_times.py) changes constants, and arguments do the rest. This ceiling may only fall.
MOST_PATCHES = 85
PATCHES = "setattr", "delattr", "setitem", "delitem"


def patches(text: str) -> int:
    """Return how many patches of a test replace names of the project, not those of other libraries."""
    tree, others = ast.parse(text), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            others |= {(x.asname or x.name).split(".")[0] for x in node.names if x.name.split(".")[0] != "udkjax"}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] != "udkjax":
            others |= {x.asname or x.name for x in node.names}
    calls = [
        n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute) and n.func.attr in PATCHES
    ]
    targets = [ast.unparse(n.args[0]) for n in calls if "patch" in ast.unparse(n.func)]  # pyright: ignore
    return sum("udkjax" in x or ("'" not in x and x.split(".")[0].split("[")[0] not in others) for x in targets)


def test_patches_of_the_projects_names_are_found():
    text = """
import os, udkjax as udk
from pathlib import Path
from udkjax.native import primitive
monkeypatch.setattr(os, "replace", None)
monkeypatch.setattr("pathlib.Path.replace", None)
monkeypatch.setattr(Path.home, "x", None)
monkeypatch.setattr(udk, "load", None)
monkeypatch.delattr(primitive.PreparedCall, "__call__")
patched.setattr("udkjax.show.doctor.facts", None)
setattr(primitive, "load", None)
"""
    assert patches(text) == 3


def test_few_tests_replace_names_of_the_project():
    found = {file.name: patches(file.read_text(encoding="utf-8")) for file in Path(__file__).parent.rglob("*.py")}
    assert sum(found.values()) <= MOST_PATCHES, {name: count for name, count in found.items() if count}
