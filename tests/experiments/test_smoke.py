"""Every study, run on a small scale, supports its claim. So do the committed data, and the README quotes them."""

from importlib import import_module
from pathlib import Path

import pytest

pytest.importorskip("experiments", reason="not in a source tree")

from experiments.common import HERE, NAMES, described, load, run, tracked

# Studies whose small runs compile for long; what they found is held against their claims by `test_committed`, the orders of
# integrators are tested in tests/integrate.
SLOW: set[str] = {
    "long_runs",
    "wire_law",
    "convergence",
    "singular_crossing",
    "inconsistent_starts",
    "precision",
    "gains",
    "threshold_map",
    "tune_gains",
    "nine_points",
    "spread",
    "atlas",
    "curves",
    "made",
    "posteriors",
    "properties",  # a slice of it: tests/properties
}
LARGER = {"atlas.nc": 2_000_000}  # bytes of a hundred thousand runs
README = (HERE / "README.md").read_text(encoding="utf-8")


def marks(name):
    return [pytest.mark.slow] if name in SLOW else []


@pytest.mark.parametrize("name", [pytest.param(name, marks=marks(name)) for name in NAMES])
def test_in_small(name, tmp_path, capsys):
    data = run(name, smoke=True, out=tmp_path)
    module = import_module(f"experiments.{name}")
    parts = module.holds(data)
    assert parts and all(parts.values()), parts
    assert data.attrs["smoke"] == 1 and data.attrs["settings"] and data.attrs["scene"] and "seed" in data.attrs
    assert (tmp_path / f"{name}.png").stat().st_size > 5_000
    assert module.headline(data) in capsys.readouterr().out


@pytest.mark.parametrize("name", NAMES)
def test_committed(name):
    module, data = import_module(f"experiments.{name}"), load(name)
    parts = module.holds(data)
    assert parts and all(parts.values()), parts
    assert data.attrs["smoke"] == 0
    assert module.headline(data) in README
    for file in (f"{name}.py", f"data/{name}.nc", f"figures/{name}.png"):
        assert f"({file})" in README and (HERE / file).exists()


def test_data_and_figures_are_small_and_belong_to_a_study():
    for folder, suffix, limit in (("data", ".nc", 200_000), ("figures", ".png", 150_000)):
        files = [Path(file) for file in (HERE / folder).iterdir() if not file.name.startswith(".")]
        assert {file.stem for file in files} == set(NAMES) and {file.suffix for file in files} == {suffix}
        assert all(file.stat().st_size < LARGER.get(file.name, limit) for file in files)


def test_progress_is_shown(capsys):
    assert list(tracked("ab", "letters")) == ["a", "b"]
    assert "letters: 2 of 2" in capsys.readouterr().err


def test_settings_and_scene_are_kept():
    import json

    import numpy as np
    import xarray

    import udkjax as udk

    mech = udk.library.simple_pendulum()
    data = described(xarray.Dataset(), mech, {"rtol": np.array([1e-9]), "solver": "Dopri8"}, seed=3)
    assert json.loads(data.attrs["settings"]) == {"rtol": [1e-9], "solver": "Dopri8"}
    assert udk.dumps(udk.loads(data.attrs["scene"])) == udk.dumps(mech) and data.attrs["seed"] == 3
