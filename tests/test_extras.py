"""A missing package is named with the extra that installs it, and all that a call needs at once, before it works."""

import tomllib
from pathlib import Path

import pytest

import udkjax as udk
from udkjax import extras
from udkjax.cli import main
from udkjax.extras import EXTRAS


def without(monkeypatch, *missing):
    present = extras.find_spec
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name in missing else present(name))


def missing_extra(monkeypatch, call, *missing):
    """Return what a call says where these packages are missing."""
    without(monkeypatch, *missing)
    with pytest.raises(extras.MissingExtraError) as caught:
        call()
    return str(caught.value)


@pytest.mark.parametrize(
    "suffix, missing, message",
    [
        (".mp4", ("PIL", "imageio_ffmpeg"), "PIL and imageio_ffmpeg are not installed: pip install 'udkjax[video]'"),
        (".mp4", ("imageio_ffmpeg",), "imageio_ffmpeg is not installed: pip install 'udkjax[video]'"),
        (".gif", ("PIL", "imageio_ffmpeg"), "PIL is not installed: pip install 'udkjax[plot]'"),
        (".dxf", ("PIL", "ezdxf"), "ezdxf is not installed: pip install 'udkjax[dxf]'"),
    ],
)
def test_all_that_a_file_needs_is_named_at_once(monkeypatch, tmp_path, suffix, missing, message):
    mech = udk.library.compound_pendulum()
    motion = udk.animate(mech, udk.simulate(mech, [0.0, 0.1]))
    assert missing_extra(monkeypatch, lambda: motion.save(tmp_path / f"a{suffix}"), *missing) == message
    assert not list(tmp_path.iterdir())


def test_all_that_a_study_needs_is_named_at_once(monkeypatch):
    mech = udk.library.compound_pendulum()
    axes, need = {"rtol": [1e-6]}, ("xarray", "dask", "distributed")
    words = "xarray, dask and distributed are not installed: pip install 'udkjax[dask]'"
    assert missing_extra(monkeypatch, lambda: udk.sweep(mech, axes, [0.0, 0.1], engine="dask"), *need) == words


@pytest.mark.parametrize(
    "command, missing, extra",
    [
        (["animate", "five_bar.toml", "--out", "a.mp4"], ("PIL", "imageio_ffmpeg"), "video"),
        (["animate", "run.nc", "--out", "a.gif"], ("PIL", "h5netcdf"), "io,plot"),
        (["animate", "run.nc", "--out", "a.mp4"], ("PIL", "h5netcdf", "imageio_ffmpeg"), "io,video"),
        (["simulate", "parallelogram", "--t1", "1", "--out", "a.nc"], ("xarray", "matplotlib"), "io,plot"),
        (["statics", "parallelogram", "--out", "a.nc"], ("h5netcdf",), "io"),
        (["studio"], ("tyro", "uvicorn"), "studio"),
        (["--help"], ("tyro", "uvicorn"), "cli"),
    ],
)
def test_commands_name_all_that_they_need_before_they_work(monkeypatch, capsys, command, missing, extra):
    without(monkeypatch, *missing)
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 2 and f"pip install 'udkjax[{extra}]'" in capsys.readouterr().err


def test_extras_that_bring_others_are_those_of_the_project():
    optional = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]["optional-dependencies"]

    def brought(extra):
        named = {name for line in optional[extra] if line.startswith("udkjax[") for name in line[7:-1].split(",")}
        return named.union(*map(brought, named))

    assert {x: set(extras.IMPLIED_EXTRAS.get(x, ())) for x in EXTRAS.values()} == {x: brought(x) for x in EXTRAS.values()}
