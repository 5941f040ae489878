"""Run studies: compute, write the data with everything needed to repeat them, and draw the figure from the file alone.

A study is one module. Its docstring gives the claim and its reasons. It has

    study(smoke) -> xarray.Dataset     compute; a small version if `smoke`; `described` adds the attributes
    holds(data) -> {part: bool}        the claim in parts, each compared with the data, also of a small run
    headline(data) -> str              the claim in figures, in one line; the README quotes it
    figure(data) -> Figure             drawn from the data alone
    page(data), html(data) -> str      pages of its own, NAME.md and NAME.html, if the study has them
    table(data) -> str                 udkjax/study/NAME.json, which the package reads, if the study has it
"""

import inspect
import json
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import xarray
from matplotlib.figure import Figure
from PIL import Image

from udkjax.integrate.solution import versions
from udkjax.scene import Mechanism, dumps

HERE = Path(__file__).parent
PACKAGE_DATA = HERE.parent / "udkjax" / "study"
NAMES = tuple(sorted(file.stem for file in HERE.glob("*.py") if file.stem not in ("__init__", "__main__", "common")))
DPI = 110
COLOURS = 128  # colours of a figure: enough for lines and a colour map, and a third of the size

Item = TypeVar("Item")


def run(name: str, smoke: bool = False, out: Path | None = None, **choices: Any) -> xarray.Dataset:
    """Compute a study with its choices, write its data, draw its figure from the file; return the written paths."""
    module: Any = import_module(f"experiments.{name}")
    if smoke and out is None:
        out = Path(tempfile.mkdtemp(prefix="experiments-"))
    start = time.perf_counter()
    data = module.study(smoke, **choices)
    data.attrs |= {
        "title": name,
        "claim": inspect.cleandoc(module.__doc__),
        "smoke": int(smoke),
        "seconds": round(time.perf_counter() - start, 1),
        **{f"version_{package}": version for package, version in (versions() | {"xarray": xarray.__version__}).items()},
    }
    file = data_file(name, out)
    file.parent.mkdir(parents=True, exist_ok=True)
    packed = {variable: {"zlib": True} for variable in data.data_vars if data[variable].ndim}
    data.to_netcdf(file, engine="h5netcdf", encoding=packed)
    redraw(name, out)
    return load(name, out)


def redraw(name: str, out: Path | None = None) -> None:
    """Draw a study's figure from its data file, and print its headline."""
    module: Any = import_module(f"experiments.{name}")
    data, file = load(name, out), (HERE / "figures" if out is None else out) / f"{name}.png"
    file.parent.mkdir(parents=True, exist_ok=True)
    module.figure(data).savefig(file, dpi=DPI)
    Image.open(file).convert("RGB").quantize(COLOURS).save(file, optimize=True)
    for function, suffix, folder in (("page", "md", HERE), ("html", "html", HERE), ("table", "json", PACKAGE_DATA)):
        if hasattr(module, function):
            text = getattr(module, function)(data)
            ((folder if out is None else out) / f"{name}.{suffix}").write_text(text, encoding="utf-8")
    failed = [part for part, true in module.holds(data).items() if not true]
    print(f"{name} ({data.attrs['seconds']} s): {module.headline(data)}")
    print(f"  {data_file(name, out)}, {file}", *(f"\n  DOES NOT HOLD: {part}" for part in failed))


def load(name: str, out: Path | None = None) -> xarray.Dataset:
    """Return the data of a study, by default the committed ones."""
    with xarray.open_dataset(data_file(name, out), engine="h5netcdf") as data:
        return data.load()


def data_file(name: str, out: Path | None = None) -> Path:
    """Return the path of the data of a study."""
    return (HERE / "data" if out is None else out) / f"{name}.nc"


def described(data: xarray.Dataset, scene: Mechanism | str, settings: Mapping[str, Any], seed: int | None = None):
    """Return the data with their origin: the scene's text, all settings (as JSON), the seed."""
    text = scene if isinstance(scene, str) else dumps(scene)
    numbers = {key: np.asarray(value).tolist() if not isinstance(value, str) else value for key, value in settings.items()}
    return data.assign_attrs(scene=text, settings=json.dumps(numbers), seed="none" if seed is None else seed)


def tracked(items: Iterable[Item], what: str, total: int | None = None) -> Iterator[Item]:
    """Iterate over the parts of a study; say on stderr the current one, of their number or `total`, and the time so far."""
    start, end = time.perf_counter(), "\r" if sys.stderr.isatty() else "\n"
    if total is None:
        items = list(items)
        total = len(items)
    for number, item in enumerate(items, 1):
        print(f"{what}: {number} of {total}, {time.perf_counter() - start:.0f} s   ", end=end, file=sys.stderr, flush=True)
        yield item


def panels(rows: int, columns: int, width: float, height: float, **choices: Any) -> tuple[Figure, Any]:
    """Return a new figure (inches), and its axes as an array (rows, columns)."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **choices)
    for one in axes.ravel():
        one.grid(color="0.92", lw=0.6)
        one.set_axisbelow(True)
    return figure, axes
