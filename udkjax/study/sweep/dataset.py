"""A sweep as a dataset: labelled, with units, and with a result for each member."""

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Int, PyTree

from udkjax.integrate.solution import CAUSES, Result, scene_text, versions
from udkjax.scene.elements.bodies import COORDINATES
from udkjax.study.sweep.axes import AxisColumn, Dimension
from udkjax.study.sweep.dimensions import NUMBERS_OF, RENAMED_DIMENSIONS, SweepError
from udkjax.study.sweep.groups import END, RESULT, STEPS, group_run
from udkjax.study.sweep.measures import Label, guess_label
from udkjax.study.sweep.plan import Group, StoredVariable, SweepPlan
from udkjax.wording import quote, suggestion

if TYPE_CHECKING:
    import xarray

# Values, or dimensions, values and attributes, as accepted by xarray.
Labelled: TypeAlias = "np.ndarray | list[str] | tuple[str | tuple[str, ...], np.ndarray, dict[str, str]]"
FORMAT = "udkjax sweep 1"
LABELS = {
    RESULT: Label((), "1", "result of the run"),
    END: Label((), "s", "time reached by the run"),
    STEPS: Label((), "1", "attempted steps"),
}
NOT_COMPUTED = -1  # the result of an unfinished member


def describe_group(plan: SweepPlan, group: Group) -> dict[str, StoredVariable]:
    """Return the variables that are stored for each member of a group, by name."""
    shape, variables = plan.state_shape_of(group), {}
    labels = {name: label for measure in plan.measures for name, label in measure.labels.items()} | LABELS
    outputs = group_run(plan, group.index).outputs
    slopes = {f"d_{variable}_d_{by}": (variable, by) for variable in outputs for by in plan.derivatives}
    for name, info in outputs.items():
        if name in slopes:
            variable, by = slopes[name]
            label = Label(
                variables[variable].dims,
                _derivative_unit(variables[variable].units, by, plan),
                f"derivative of {variable} by {by}",
            )
        else:
            label = labels.get(name) or guess_label(name, info.shape, len(plan.ts), shape, plan.units.get(name, ""))
        variables[name] = StoredVariable(label.dims, info.shape, np.dtype(info.dtype), label.units, label.long_name)
    return variables


def _derivative_unit(units: str, by: str, plan: SweepPlan) -> str:
    """Return the unit of the derivative of a variable with `units` by the number `by`; "" if it is unknown."""
    below = next((column.units for column in plan.columns if column.name == by), None)
    below = plan.mechanism.unit_of(by) if below is None else below
    return "" if not units or not below or "," in units else f"{units}/({below})"


@lru_cache(maxsize=8)
def variables_of(plan: SweepPlan) -> Mapping[str, StoredVariable]:
    """Return the variables that are stored for each member, including `result`, `end_time` and `steps`.

    If mechanisms have different bodies, the dimension "body" has all of them, and any other dimension has the largest size.
    """
    found: dict[str, StoredVariable] = {}
    for group in plan.groups:
        for name, variable in describe_group(plan, group).items():
            other = found.setdefault(name, variable)
            if len(other.shape) != len(variable.shape):
                raise SweepError([f"measure {name!r} has {other.shape} entries for some members and {variable.shape} for others"])
            longest = map(max, other.shape, variable.shape)
            shape = tuple(len(plan.bodies) if d == "body" else size for d, size in zip(variable.dims, longest, strict=True))
            found[name] = StoredVariable(other.dims, shape, other.dtype, other.units, other.long_name)
    own = found.keys() - LABELS.keys() - {name for measure in plan.measures for name in measure.labels}
    if unknown := [name for name in plan.units if name not in own]:
        raise SweepError([f"units: no measure of your own stores {quote(name)}{suggestion(name, own)}" for name in unknown])
    axes = {d.name for d in plan.dimensions} | {column.name for column in plan.columns} | {"time", "body", "coordinate"}
    if both := [name for name in found if name in axes]:  # the dataset would have one of the two alone
        cure = "choose another name for the one, or for the other, with of=..."
        raise SweepError([f"{quote(name)} is both a variable of a measure and an axis: {cure}" for name in both])
    return found


def bytes_per_member(plan: SweepPlan) -> int:
    """Return the size of the stored variables of one member (bytes)."""
    return sum(int(np.prod(v.shape)) * v.dtype.itemsize for v in variables_of(plan).values())


def assemble(plan: SweepPlan, finished: Iterable[tuple[Int[np.ndarray, "n"], Mapping[str, np.ndarray]]]) -> "xarray.Dataset":
    """Return the xarray Dataset of a plan from pairs of members' indices and their stored variables, in any order.

    Unfinished members have NaN and the result -1.
    """
    import xarray

    variables = variables_of(plan)
    places = _body_places(plan)
    flat = {name: np.full((plan.size, *v.shape), _fill_value(name, v), v.dtype) for name, v in variables.items()}
    for members, data in finished:
        group = plan.groups[plan.group_of(int(members[0]))]
        for name, values in data.items():
            _write_members(flat[name], variables[name], members, values, places.get(group.index))
    dims = tuple(dimension.name for dimension in plan.dimensions)
    found = {
        name: ((*dims, *v.dims), flat[name].reshape(*plan.shape, *v.shape), {"units": v.units, "long_name": v.long_name})
        for name, v in variables.items()
    }
    data = xarray.Dataset(found, coords=_coordinates(plan))
    for setting, dimension in RENAMED_DIMENSIONS.items():
        if data.sizes.keys() >= {dimension} and setting in data.coords:
            data = data.set_xindex(setting)  # allows data.sel({"method": "SVD"})
    data[RESULT].attrs |= {
        "flag_values": np.array([NOT_COMPUTED, *Result], np.int8),
        "flag_meanings": " ".join(["not_computed", *(result.name for result in Result)]),
        "causes": json.dumps({int(result): CAUSES[result] for result in Result}),
    }
    data.attrs = _attributes(plan)
    return data


def _fill_value(name: str, variable: StoredVariable) -> float | int | bool:
    if name == RESULT:
        return NOT_COMPUTED
    return np.nan if variable.dtype.kind in "fc" else False if variable.dtype.kind == "b" else -1


def _write_members(
    into: np.ndarray, variable: StoredVariable, members: np.ndarray, values: np.ndarray, places: Sequence[int] | None
) -> None:
    """Write the values of members into an array of all members.

    `places` are the indices of a group's bodies among all bodies; None if the group has all of them.
    """
    if "body" in variable.dims and places is not None:
        axis = variable.dims.index("body")
        for k, index in enumerate(places):
            into[(members, *[slice(None)] * axis, index)] = np.take(values, k, axis=axis + 1)
    else:
        into[(members, *(slice(n) for n in values.shape[1:]))] = values


def _body_places(plan: SweepPlan) -> dict[int, list[int]]:
    """Return the indices of each group's bodies among all bodies, for groups that do not have all bodies."""
    everyone = list(plan.bodies)
    names_by_group = {group.index: list(plan.mechanism_of(group).body_names) for group in plan.groups}
    return {index: [everyone.index(name) for name in names] for index, names in names_by_group.items() if names != everyone}


def _coordinates(plan: SweepPlan) -> dict[str, Labelled]:
    """Return the values of axes along their dimensions; and times, bodies and coordinates if variables have these dimensions."""
    coordinates: dict[str, Labelled] = {}
    for dimension in plan.dimensions:
        for column in dimension.columns:
            coordinates |= _coordinate(dimension, column)
    used = {dim for variable in variables_of(plan).values() for dim in variable.dims}
    if "time" in used:
        scaled = any(not callable(column.of) and "t1" in column.of for column in plan.columns)
        fractions = (plan.ts - plan.ts[0]) / (plan.ts[-1] - plan.ts[0])
        normalized = "time", fractions, {"units": "1", "long_name": "fraction of the span from the start to t1"}
        coordinates["time"] = normalized if scaled else ("time", plan.ts, {"units": "s"})
    if "body" in used:
        coordinates["body"] = list(plan.bodies)
    if "coordinate" in used:
        coordinates["coordinate"] = list(COORDINATES) if plan.bodies else _coordinate_labels(plan)
    return coordinates


def _coordinate_labels(plan: SweepPlan) -> list[str]:
    """Return labels of the coordinates of user-defined systems."""
    return [f"q[{k}]" for k in range(max(plan.state_shape_of(group)[0] for group in plan.groups))]


def _coordinate(dimension: Dimension, column: AxisColumn) -> dict[str, Labelled]:
    attributes = {"units": column.units} if column.units else {}
    if not callable(column.of) and column.of != (column.name,):
        attributes["of"] = ", ".join(column.of)
    values = column.coordinate
    if values.ndim == 1:
        names = {dimension.name, column.name} if dimension.name == RENAMED_DIMENSIONS.get(column.name) else {column.name}
        return dict.fromkeys(names, (dimension.name, values, attributes))
    dims = (dimension.name, *(f"{column.name}_{k}" for k in range(1, values.ndim)))
    return {dimension.name: np.arange(dimension.size), f"{column.name}_value": (dims, values, attributes)}


def _attributes(plan: SweepPlan) -> dict[str, str | int | float]:
    settings = {
        name: value if isinstance(value, str | int | float) else _shown(plan, name, value)
        for name, value in plan.settings.items()
    }
    return {
        "title": plan.mechanism.name,
        "format": FORMAT,
        **{f"setting_{name}": value for name, value in settings.items()},
        **({"design": type(plan.design).__name__, "seed": plan.design.seed} if plan.design else {}),
        **{f"version_{name}": value for name, value in versions().items()},
        "start_time": float(plan.ts[0]),
        "parameters": json.dumps({k: np.asarray(v).tolist() for k, v in plan.mechanism.parameters().items()}),
        **({"scene": scene_text(plan.mechanism)} if plan.mechanism.has_bodies else {}),
    }


class _AxisName:
    """The name of an axis, printed where a setting has a number that the axis replaces."""

    def __init__(self, name: str):
        self.name = name

    def __repr__(self) -> str:
        return f"axis {self.name}"


def _shown(plan: SweepPlan, setting: str, value: PyTree) -> str:
    """Return a setting as text, with the names of axes in place of the numbers that they replace."""
    if value is None:
        return "none"
    for column in plan.columns:
        for name in () if callable(column.of) else set(column.of) & set(NUMBERS_OF.get(setting, ())):
            value = eqx.tree_at(lambda x, name=name: getattr(x, name), value, _AxisName(column.name), is_leaf=lambda x: x is None)
    return " ".join(str(value).split())
