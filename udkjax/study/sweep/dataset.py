"""A sweep as one dataset: labelled, with units, and with a result for each member."""

import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Int

from udkjax.integrate.solution import CAUSES, Result, scene_text, versions
from udkjax.scene.bodies import COORDINATES
from udkjax.study.sweep.axes import Column, Dimension
from udkjax.study.sweep.chunk import program, variables_of
from udkjax.study.sweep.cost import lane_steps
from udkjax.study.sweep.member import RESULT, STEPS
from udkjax.study.sweep.plan import Plan, Variable

FORMAT = "udkjax sweep 1"
NOT_COMPUTED = -1  # the result of a member that is not among what is finished


def assemble(plan: Plan, finished: Iterable[tuple[Int[np.ndarray, "n"], Mapping[str, np.ndarray]]]) -> Any:
    """Return the xarray Dataset of a plan, from (members, what was kept of them) in any order.

    What is not among them is not a number, and has the result -1. `lane_efficiency`, where members are
    computed side by side, is the part of the steps that there was room for which they took: who is done waits for the slowest.
    """
    import xarray

    variables = variables_of(plan)
    places = _places(plan)
    flat = {name: np.full((plan.size, *v.shape), _nothing(name, v), v.dtype) for name, v in variables.items()}
    taken = room = 0
    for members, data in finished:
        group = plan.groups[plan.group_of(int(members[0]))]
        for name, values in data.items():
            _put(flat[name], variables[name], members, values, places.get(group.index))
        if (lanes := program(plan, group).lanes) is not None:
            some = lane_steps(data[STEPS], lanes)
            taken, room = taken + some[0], room + some[1]
    dims = tuple(dimension.name for dimension in plan.dimensions)
    found = {
        name: ((*dims, *v.dims), flat[name].reshape(*plan.shape, *v.shape), {"units": v.units, "long_name": v.long_name})
        for name, v in variables.items()
    }
    data = xarray.Dataset(found, coords=_coordinates(plan))
    data[RESULT].attrs |= {
        "flag_values": np.array([NOT_COMPUTED, *Result], np.int8),
        "flag_meanings": " ".join(["not_computed", *(result.name for result in Result)]),
        "causes": json.dumps({int(result): CAUSES[result] for result in Result}),
    }
    data.attrs = _attributes(plan) | ({"lane_efficiency": taken / room} if room else {})
    return data


def _nothing(name: str, variable: Variable) -> Any:
    if name == RESULT:
        return NOT_COMPUTED
    return np.nan if variable.dtype.kind in "fc" else False if variable.dtype.kind == "b" else -1


def _put(into: np.ndarray, variable: Variable, members: np.ndarray, values: np.ndarray, places: Any) -> None:
    """Write the values of members; those of bodies in their places among all bodies."""
    if "body" in variable.dims and places is not None:
        axis = variable.dims.index("body")
        for k, place in enumerate(places):
            into[(members, *[slice(None)] * axis, place)] = np.take(values, k, axis=axis + 1)
    else:
        into[(members, *(slice(n) for n in values.shape[1:]))] = values


def _places(plan: Plan) -> dict[int, list[int]]:
    """For each group, the places of its bodies among all bodies, where it has not all of them."""
    everyone = list(plan.bodies)
    own = {group.index: list(plan.choice(group, "mechanism").body_names) for group in plan.groups}
    return {index: [everyone.index(name) for name in names] for index, names in own.items() if names != everyone}


def _coordinates(plan: Plan) -> dict[str, Any]:
    """Values of the axes, each along its dimension; times, bodies and coordinates where something lies along them."""
    found: dict[str, Any] = {}
    for dimension in plan.dimensions:
        for column in dimension.columns:
            found |= _coordinate(dimension, column)
    along = {dim for variable in variables_of(plan).values() for dim in variable.dims}
    if "time" in along:
        scaled = any(not callable(column.of) and "t1" in column.of for column in plan.columns)
        fractions = (plan.ts - plan.ts[0]) / (plan.ts[-1] - plan.ts[0])
        part = "time", fractions, {"units": "1", "long_name": "part of the span from the start to t1"}
        found["time"] = part if scaled else ("time", plan.ts, {"units": "s"})
    if "body" in along:
        found["body"] = list(plan.bodies)
    if "coordinate" in along:
        found["coordinate"] = list(COORDINATES)
    return found


def _coordinate(dimension: Dimension, column: Column) -> dict[str, Any]:
    attributes = {"units": column.units} if column.units else {}
    if not callable(column.of) and column.of != (column.name,):
        attributes["of"] = ", ".join(column.of)
    values = column.coordinate
    if values.ndim == 1:
        return {column.name: (dimension.name, values, attributes)}
    dims = (dimension.name, *(f"{column.name}_{k}" for k in range(1, values.ndim)))
    return {dimension.name: np.arange(dimension.size), f"{column.name}_value": (dims, values, attributes)}


def _attributes(plan: Plan) -> dict[str, Any]:
    settings = {name: value if isinstance(value, str | int | float) else _shown(value) for name, value in plan.settings.items()}
    return {
        "title": plan.mechanism.name,
        "format": FORMAT,
        **{f"setting_{name}": value for name, value in settings.items()},
        **({"design": type(plan.design).__name__, "seed": plan.design.seed} if plan.design else {}),
        **{f"version_{name}": value for name, value in versions().items()},
        "start_time": float(plan.ts[0]),
        "parameters": json.dumps({k: np.asarray(v).tolist() for k, v in plan.mechanism.parameters().items()}),
        "scene": scene_text(plan.mechanism),
    }


def _shown(value: Any) -> str:
    return "none" if value is None else " ".join(str(value).split())
