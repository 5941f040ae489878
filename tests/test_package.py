"""Folders import only from lower floors, the public names are those of the stub, and importing the package is cheap."""

import os
import re
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

import udkjax
from tests.fresh_process import python
from tests.imports import imports
from udkjax.extras import EXTRAS

ROOT = Path(udkjax.__file__).parent

# every floor may import them
GROUND_FLOOR = {"annotations", "arrays", "devices", "extras", "folders", "lazy_names", "printing", "progress"}
GROUND_FLOOR |= {"argument_types", "requirements", "segments", "text_places", "threads", "wording"}
PROGRAMS = {"expressions", "programs"}
EQUATIONS = PROGRAMS | {"complementarity", "pinv", "scene", "transforms", "equations"}
POSITIONS = EQUATIONS | {"native", "positions"}
STUDY = POSITIONS | {"integrate", "statics", "synthesis", "study"}
BELOW = {
    **{module: set() for module in GROUND_FLOOR},
    "programs": set(),
    "expressions": {"programs"},
    "pinv": PROGRAMS,
    "scene": PROGRAMS,
    "complementarity": PROGRAMS | {"transforms"},
    "transforms": PROGRAMS | {"pinv", "scene"},
    "equations": EQUATIONS,
    "native": EQUATIONS,
    "positions": POSITIONS,
    # Side by side: what positions a mechanism has, and how it moves.
    "statics": POSITIONS,
    "synthesis": POSITIONS,
    "integrate": POSITIONS,
    "study": STUDY,
    "show": STUDY,
    "studio": STUDY | {"show"},
}
ONLY_IN = {
    "diffrax": {"integrate", "cli"},
    "llvmlite": {"native"},
    "matplotlib": {"show"},
    "starlette": {"studio"},
    "tomlkit": {"studio"},
    "tyro": {"cli"},
    "uvicorn": {"studio"},
    "distributed": {"study"},
}


def violations(root: Path) -> list[str]:
    """Return imports of the package below `root` from floors above or beside, or of libraries that belong to another floor."""
    found = []
    for file in sorted(root.rglob("*.py")):
        place = file.relative_to(root)
        floor = place.parts[0].removesuffix(".py")
        if floor == "__init__":
            continue
        known = BELOW.get(floor, set(BELOW) | {"*"} if floor in ("cli", "__main__") else None)
        if known is None:
            found.append(f"{place}: no floor of this name")
            continue
        for module in imports(file, ".".join(["udkjax", *place.parts[:-1]])):
            library, *rest = module.split(".")
            if library != "udkjax":
                allowed = floor in ONLY_IN.get(library, {floor})
            else:
                allowed = "*" in known or (rest and rest[0] in known | GROUND_FLOOR | {floor})
            if not allowed:
                found.append(f"{place}: {module}")
    return found


def test_a_floor_imports_only_from_below():
    assert violations(ROOT) == []


@pytest.mark.parametrize(
    ("place", "line"),
    [
        ("scene/joints.py", "from udkjax.equations import loads"),
        ("scene/joints.py", "from udkjax import equations"),
        ("scene/joints.py", "import udkjax.pinv.svd as svd"),
        ("scene/joints.py", "from ..equations import loads"),
        ("scene/library/pendulums.py", "from ...show import plots"),
        ("scene/library/pendulums.py", "from .. import __init__, study\nfrom ... import study"),
        ("pinv/rule.py", "def late():\n    from udkjax.scene import Body"),
        ("equations/loads.py", "import udkjax"),
        ("equations/loads.py", "import diffrax"),
        ("integrate/simulate.py", "import matplotlib.figure"),
        ("study/sweep.py", "from udkjax.cli import main"),
        ("gadgets/new.py", "import math"),
    ],
)
def test_an_import_from_above_is_caught(tmp_path, place, line):
    file = tmp_path / place
    file.parent.mkdir(parents=True)
    file.write_text(line)
    assert any(place in violation for violation in violations(tmp_path))


@pytest.mark.parametrize(
    ("place", "line"),
    [
        ("scene/joints.py", "from udkjax.scene.bodies import Frame\nfrom .bodies import Frame\nfrom . import bodies"),
        ("scene/library/pendulums.py", "from ..joints import Revolute"),
        ("equations/loads.py", "import jax\nfrom udkjax import scene\nfrom ..pinv import SVD"),
        ("integrate/simulate.py", "import diffrax"),
        ("cli.py", "import udkjax as udk\nimport diffrax"),
        ("__init__.py", "from udkjax.show import plots"),
    ],
)
def test_an_import_from_below_passes(tmp_path, place, line):
    file = tmp_path / place
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(line)
    assert violations(tmp_path) == []


def test_the_public_names_are_there():
    everything = {}
    exec("from udkjax import *", everything)
    assert set(udkjax.__all__) <= set(everything)
    assert {*udkjax.__all__, "__version__"} == set(dir(udkjax))
    for package in (udkjax.library, import_module("udkjax.scene"), import_module("udkjax.scene.drawing")):
        assert sorted(package.__all__) == dir(package)
    assert callable(udkjax.simulate) and callable(udkjax.assemble) and udkjax.library.__name__ == "udkjax.scene.library"
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        udkjax.simulat  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


def test_importing_the_package_imports_nothing_else():
    assert python("import sys, udkjax; print({'jax', 'numpy', 'equinox', 'diffrax'} & set(sys.modules))") == "set()"


DEFAULT = """
import sys
import udkjax as udk
udk.simulate(udk.library.double_pendulum(), [0.0, 0.1])
others = {"diffrax", "optimistix", "lineax", "scipy", "xarray", "pandas", "matplotlib", "tyro", "tomllib", "xml.sax"}
own = {f"udkjax.{name}" for name in ("integrate.events", "scene.drawing", "scene.files", "scene.mjcf", "study")}
print(({"jax"} | others | own) & set(sys.modules))
"""


def test_a_run_by_default_imports_no_other_solvers_nor_scenes():
    assert python(DEFAULT, UDKJAX_CACHE=os.environ["UDKJAX_CACHE"]) == "{'jax'}"


def test_asking_for_identify_loads_no_optimizer():
    loaded = "print({'optimistix', 'optax', 'lineax', 'scipy.optimize', 'scipy.stats', 'pandas', 'xarray'} & set(sys.modules))"
    assert python(f"import sys, udkjax; udkjax.identify; {loaded}") == "set()"


OPTIONAL = sorted(EXTRAS)
CORE = f"""
import sys
for name in {OPTIONAL}:
    sys.modules[name] = None  # as if it were not installed
import diffrax, numpy as np
import udkjax as udk
mech = udk.loads(udk.dumps(udk.library.parallelogram()))
for solver in (None, diffrax.Tsit5()):
    sol = udk.simulate(mech, np.linspace(0.0, 0.5, 6), solver=solver)
    assert abs(udk.violation(mech, sol)).max() < 1e-12
assert "</html>" in udk.animate(mech, sol).html()
missing = []
png, cli = "udk.animate(mech, sol).save('a.png')", "from udkjax.cli import main; main(['--help'])"
for use in ("sol.to_xarray(mech)", png, "import udkjax.show.plots", cli):
    try:
        exec(use)
    except ImportError as error:
        missing.append(str(error))
    except SystemExit as end:
        missing.append(end.code)
print(missing)
"""


def test_the_core_needs_no_extra_and_a_missing_one_is_named():
    shown = python(CORE, UDKJAX_CACHE=os.environ["UDKJAX_CACHE"])
    cures = [
        f"{package} is not installed: pip install 'udkjax[{extra}]'"
        for package, extra in (("xarray", "io"), ("PIL", "plot"), ("matplotlib", "plot"))
    ]
    assert shown == str([*cures, 2])


def test_every_optional_package_has_its_extra():
    project = tomllib.loads((ROOT.parent / "pyproject.toml").read_text())["project"]
    core = {re.split(r"[\[>=<]", line)[0] for line in project["dependencies"]}
    assert core.isdisjoint(EXTRAS)
    extras = {name: " ".join(lines) for name, lines in project["optional-dependencies"].items()}
    comes_with = {"PIL": "pillow", "imageio_ffmpeg": "imageio-ffmpeg", "distributed": "dask"}
    comes_with |= {"h5py": "h5netcdf", "pandas": "xarray"}
    for package, extra in EXTRAS.items():
        assert comes_with.get(package, package) in extras[extra]


def test_no_warning_is_given_by_importing_and_running():
    code = "import udkjax as udk; udk.simulate(udk.library.double_pendulum(), [0.0, 0.1]); print('quiet')"
    assert python(code, UDKJAX_CACHE=os.environ["UDKJAX_CACHE"], PYTHONWARNINGS="error") == "quiet"
