"""Reading of runs that `udkjax simulate` or `Solution.to_xarray` has written, to show them."""

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from udkjax.equations.states.scene_changes import SceneChanges
from udkjax.extras import OptionalImport
from udkjax.integrate.solution import Result
from udkjax.scene.files import loads
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.mjcf import MjcfWarning
from udkjax.scene.tables.checks import SceneError

with OptionalImport():
    import xarray


class RunFile(NamedTuple):
    """A run from a file, with the mechanism that the file contains as text."""

    mechanism: Mechanism
    ts: np.ndarray
    q: np.ndarray
    v: np.ndarray
    result: Result | None  # None if it is not in the file
    cause: str  # reason for an early end
    others: dict[str, np.ndarray]  # further numbers over time, by "name (unit)", shown as measures
    scene_changes: SceneChanges | None = None  # the constraints that hold; None if the run had no events that change any


def read_run(path: Path) -> RunFile:
    """Return the run in a NetCDF file, with its mechanism.

    Raises:
        ValueError: the file does not contain a run, or does not contain the text of its scene.
        OSError: the file cannot be read.
    """
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        missing = [name for name in ("q", "v", "time") if name not in data.variables]
        if missing or "scene" not in data.attrs:
            raise ValueError(
                f"{path} has no {' and no '.join(missing or ['text of a scene'])}: it is not a run of `udkjax simulate`"
            )
        try:
            with warnings.catch_warnings(action="ignore", category=MjcfWarning):  # the user was warned when the run was simulated
                mechanism = loads(data.attrs["scene"])
        except SceneError as error:  # classes defined by users are not in the format
            raise ValueError(f"{path}: its scene cannot be read, use `udkjax.animate` in Python: {error}") from error
        if data["q"].dims != ("time", "body", "coordinate"):
            raise ValueError(f"{path}: q has dimensions {data['q'].dims}, not time, body and coordinate of a single run")
        if list(data["body"].values) != list(mechanism.bodies):
            raise ValueError(f"{path}: its bodies are not those of its scene")
        others = {_label(data[name]): np.asarray(data[name], float) for name in data.data_vars if data[name].dims == ("time",)}
        ts, q, v = (np.asarray(data[name], float) for name in ("time", "q", "v"))
        result = Result.__members__.get(str(data.attrs.get("result", "")))
        changes = SceneChanges.read(data, had_events="setting_max_events" in data.attrs)
        return RunFile(mechanism, ts, q, v, result, str(data.attrs.get("cause", "")), others, changes)


def _label(variable: "xarray.DataArray") -> str:
    units = variable.attrs.get("units", "")
    return f"{variable.name} ({units})" if units not in ("", "1") else str(variable.name)
