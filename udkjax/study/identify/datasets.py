"""xarray Datasets as tables of measurements."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from udkjax.scene.checks import quoted, shown, suggestion
from udkjax.study.identify.tables import RECORD, TIME, Column, Table

# What `Solution.to_xarray` writes, as channels of bodies.
_STATES = {"q": {"x": "x", "y": "y", "angle": "angle"}, "v": {"x": "vx", "y": "vy", "angle": "omega"}}


def of_dataset(data: Any, bodies: Sequence[str], source: str, problems: list[str], name: str = "") -> Iterator[Table]:
    """An xarray Dataset, with one table for each of its records."""
    if RECORD not in data.dims:
        yield _of_dataset(data, bodies, source, problems, name)
        return
    for k in range(data.sizes[RECORD]):
        label = str(data[RECORD].values[k]) if RECORD in data.coords else str(k)
        one = data.isel({RECORD: k}).drop_vars(RECORD, errors="ignore")
        found: list[str] = []
        yield _of_dataset(one, bodies, source, found, label)._replace(gaps=True)
        problems += [problem for problem in found if problem not in problems]


def _of_dataset(data: Any, bodies: Sequence[str], source: str, problems: list[str], name: str) -> Table:
    time = next((t for t in TIME if t in data.variables and data[t].ndim == 1), None)
    if time is None:
        problems.append(f"{source}: there is no coordinate {quoted(TIME[0])}")
        return Table(source, {}, [], name)
    dims, count = data[time].dims, data[time].size
    columns = {time: Column(data[time].values, data[time].attrs.get("units"))}
    for key, variable in data.data_vars.items():
        if key in _STATES and set(variable.dims) == {*dims, "body", "coordinate"}:
            columns |= _states(str(key), variable.transpose(*dims, "body", "coordinate"), bodies, source, problems)
        elif variable.dims in ((), dims):
            columns[str(key)] = Column(np.broadcast_to(variable.values, count), variable.attrs.get("units"))
        else:
            problems.append(f"{source}, {quoted(str(key))}: must be along {quoted(time)}, is along {shown(list(variable.dims))}")
    return Table(source, columns, [f"entry {k}" for k in range(count)], name)


def _states(key: str, values: Any, bodies: Sequence[str], source: str, problems: list[str]) -> dict[str, Column]:
    """Coordinates or velocities of bodies."""
    found = {}
    for i, body in enumerate(map(str, values["body"].values)):
        if body not in bodies:
            problems.append(f"{source}, {quoted(key)}: no body named {quoted(body)}{suggestion(body, bodies)}")
            continue
        for k, coordinate in enumerate(map(str, values["coordinate"].values)):
            found[f"body.{body}.{_STATES[key].get(coordinate, coordinate)}"] = Column(values.values[:, i, k], None)
    return found
