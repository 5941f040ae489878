"""Checks of axes, and their conversion to the dimensions of a sweep; all mistakes are reported together."""

import difflib
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeAlias, cast

import jax
import numpy as np

from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.integrate.simulate import simulate
from udkjax.pinv import Auto
from udkjax.positions.assembling.assembly import State
from udkjax.requirements import describe
from udkjax.scene.arguments import argument_problems
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.number_fields import split_index
from udkjax.scene.numbers.units import NUMBERS
from udkjax.scene.tables.checks import Mistakes, SceneError
from udkjax.study.quantities import StudyModel
from udkjax.study.sweep.axes import (
    NONE_LABELS,
    Axis,
    AxisChoice,
    AxisColumn,
    AxisValues,
    Dimension,
    SweepDesign,
    Values,
    Zipped,
    labels_of,
    scale_to_range,
)
from udkjax.wording import abbreviate, quote, suggestion

Settings: TypeAlias = Mapping[str, Any]  # further arguments of `simulate`
MEMBER_DIMENSION = "member"  # the dimension of a design
NUMBERS_OF = {"stabilization": ("alpha", "beta"), "method": ("rank_tol", "branch_tol")}  # numbers of settings that may be axes
_SETTING_OF_NUMBER = {name: setting for setting, names in NUMBERS_OF.items() for name in names}
# Settings that are checked together: constant steps need `dt0`, and solvers that do not estimate errors need constant steps.
STEP_SETTINGS = ("solver", "stepsize_controller", "dt0")
# Dimensions and variables of the dataset, whose names a dimension of the sweep cannot have.
RESERVED_NAMES = ("time", "body", "coordinate", "result", "steps", "end_time")
# Arguments of `sel`, `isel` and `interp` of xarray: `data.sel(method="SVD")` would not select anything, without an error.
XARRAY_ARGUMENTS = ("method", "tolerance", "drop", "indexers", "missing_dims", "coords", "assume_sorted", "kwargs", "self")
RENAMED_DIMENSIONS = {"method": "pseudoinverse"}  # dimensions of settings whose names xarray has taken


class SweepError(Mistakes):
    """The arguments of a sweep are invalid. `problems` lists every mistake.

    Attributes:
        problems: every mistake, each with its place.
        source: the name of the file, if any.
    """

    subject = "sweep"


@contextmanager
def refuse_untraceable(subject: str) -> Iterator[None]:
    """Return a context in which errors of tracing a user's function become a `SweepError` with the cure.

    `subject` names the function.
    """
    try:
        yield
    except (
        jax.errors.TracerArrayConversionError,
        jax.errors.TracerIntegerConversionError,
        jax.errors.ConcretizationTypeError,
        jax.errors.NonConcreteBooleanIndexError,
    ):
        cure = "write it in jax.numpy, without numpy, float() or `if` on computed values: members are computed in a batch"
        raise SweepError([f"{subject}: {cure}"]) from None


def lay_out(mechanism: StudyModel, axes: Mapping[str, AxisValues], design: SweepDesign | None = None) -> tuple[Dimension, ...]:
    """Return the dimensions of a sweep over `axes`; ranges of axes are sampled by the design, along the dimension "member".

    Raises:
        SweepError: lists every mistake.
    """
    problems: list[str] = []
    ranges = [name for name, given in axes.items() if design is not None and not isinstance(given, Zipped) and _is_range(given)]
    unit = dict(zip(ranges, design.unit(len(ranges)).T, strict=True)) if design is not None and ranges else {}
    if design is not None and not ranges:
        problems.append("design: no axis is a range (low, high) or a distribution for it to fill")
    dimensions: list[Dimension] = []
    if unit and design is not None:
        columns = [_column(mechanism, name, axes[name], unit[name], problems) for name in ranges]
        dimensions.append(Dimension(MEMBER_DIMENSION, design.n, tuple(column for column in columns if column is not None)))
    for name, given in axes.items():
        if name in unit:
            continue
        inner = given.axes if isinstance(given, Zipped) else {name: given}
        if not (isinstance(inner, Mapping) and inner and all(isinstance(key, str) for key in inner)):
            problems.append(f"axis {quote(name)}: axes of Zipped must map names to axes, {describe(inner)}")
            continue
        columns = [_column(mechanism, key, axis, None, problems) for key, axis in inner.items()]
        columns = tuple(column for column in columns if column is not None)
        sizes = {column.name: len(column.values) for column in columns}
        if len(set(sizes.values())) > 1:
            problems.append(f"{name}: zipped axes must have equally many values, but have {sizes}")
        if name in RESERVED_NAMES or (name == MEMBER_DIMENSION and unit):
            problems.append(
                f"axis {quote(name)}: the dataset has a dimension or variable of this name; choose another, with of=..."
            )
        dimension = RENAMED_DIMENSIONS.get(name, name) if [column.of for column in columns] == [(name,)] else name
        if dimension in XARRAY_ARGUMENTS:
            problems.append(
                f"axis {quote(name)}: data.sel({name}=...) of xarray has another meaning; choose another name, with of=..."
            )
        if dimension != name and dimension in axes:
            problems.append(f"axis {quote(dimension)}: the dimension of {quote(name)} has this name; choose another, with of=...")
        if columns:
            dimensions.append(Dimension(dimension, len(columns[0].values), columns))
    problems += _clashes(dimensions)
    if not axes:
        problems.append("axes: a sweep needs at least one")
    if problems:
        raise SweepError(problems)
    replaced = {target for d in dimensions for column in d.columns if not callable(column.of) for target in column.of}
    return tuple(replace(d, columns=tuple(_relabelled(column, replaced) for column in d.columns)) for d in dimensions)


def _relabelled(column: AxisColumn, replaced: set[str]) -> AxisColumn:
    """Return an axis whose labels do not show the numbers that other axes replace."""
    numbers = replaced & set(NUMBERS_OF.get(column.setting, ())) if column.is_choice else set()
    return replace(column, labels=labels_of(column.setting, column.choices, numbers)) if numbers else column


def _is_range(given: "Axis | Values") -> bool:
    """Return True if a design can sample this axis: if its values are numbers or a distribution, not choices."""
    values = given.values if isinstance(given, Axis) else given
    return hasattr(values, "ppf") or _numbers(values) is not None


def _column(
    mechanism: StudyModel, name: str, given: AxisValues, unit: np.ndarray | None, problems: list[str]
) -> AxisColumn | None:
    """Return the values of an axis; if they are invalid, add the mistake to `problems` and return None."""
    assert not isinstance(given, Zipped), "zipped axes are passed one by one"
    axis = given if isinstance(given, Axis) else Axis(given)
    of = (name,) if axis.of is None else axis.of
    before = len(problems)
    if not callable(of):
        problems += _unknown_targets(mechanism, name, of)
    values = axis.values if unit is None else scale_to_range(axis.values, unit)
    if values is None:
        problems.append(f"axis {quote(name)}: with a design, values must be a range (low, high) or a frozen distribution")
    elif hasattr(values, "ppf"):
        problems.append(f"axis {quote(name)}: a distribution needs a design to draw from it, such as design=Sobol(1024)")
    elif not isinstance(values, Sized) or len(values) == 0:
        problems.append(f"axis {quote(name)}: needs at least one value, not {abbreviate(values)}")
    if len(problems) > before or values is None:
        return None
    if not callable(of) and any(target in NONE_LABELS for target in of):
        return _choices(name, of, values, problems)
    numbers = _numbers(values)
    may_be_nan = not callable(of) and all(target in _SETTING_OF_NUMBER for target in of)  # for members that do not use it
    if numbers is None or not np.all(np.isfinite(numbers) | (may_be_nan & np.isnan(numbers))):
        problems.append(f"axis {quote(name)}: must be finite numbers, one entry per value, not {abbreviate(values)}")
        return None
    if not callable(of):
        problems += _misfits(mechanism, name, of, numbers)
    units = axis.units if axis.units is not None else "" if callable(of) else mechanism.unit_of(of[0])
    return AxisColumn(name, numbers, of, units)


def _choices(name: str, of: tuple[str, ...], values: Values, problems: list[str]) -> AxisColumn | None:
    if len(of) != 1:
        problems.append(f"axis {quote(name)}: choices cannot be tied, but it sets {', '.join(map(quote, of))}; zip them instead")
        return None
    if of == ("state",) and isinstance(values, State):
        choices: tuple[AxisChoice, ...] = _states(values)
    else:
        choices = tuple(cast("Iterable[AxisChoice]", values))
    if of == ("state",) and not all(isinstance(choice, State) for choice in choices):
        problems.append(f"axis {quote(name)}: must be States, as `assemble` returns them")
    if of == ("mechanism",) and len({type(choice) for choice in choices} & {Mechanism, ConstrainedSystem}) != 1:
        problems.append(f"axis {quote(name)}: must be Mechanisms, or all of them ConstrainedSystems")
    return AxisColumn(name, choices, of, "", labels_of(of[0], choices))


def _states(stacked: State) -> tuple[State, ...]:
    return tuple(State(q, v) for q, v in zip(np.asarray(stacked.q), np.asarray(stacked.v), strict=True))


def _numbers(values: Values) -> np.ndarray | None:
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):
        return None
    return array.astype(float) if array.dtype.kind in "iuf" and array.ndim else None


def _unknown_targets(mechanism: StudyModel, name: str, of: Sequence[str]) -> Iterator[str]:
    parameters = mechanism.number_fields()
    for target in of:
        if target not in NUMBERS and target not in NONE_LABELS and split_index(target, parameters)[0] not in parameters:
            near = suggestion(target, (*parameters, *NUMBERS, *NONE_LABELS)) or _suggest_ending(target, parameters)
            yield f"axis {quote(name)}: {quote(target)} is neither a parameter of the mechanism nor a setting{near}"


def _suggest_ending(target: str, parameters: Iterable[str]) -> str:
    """Return a suggestion of a parameter whose last part is similar, such as `body.a.mass` for `mass`; "" if there is none."""
    last = {full.rpartition(".")[2]: full for full in parameters}
    close = difflib.get_close_matches(target, last, n=1)
    return f"; did you mean {quote(last[close[0]])}?" if close else ""


def _misfits(mechanism: StudyModel, name: str, of: Sequence[str], numbers: np.ndarray) -> Iterator[str]:
    """Iterate over mistakes of values that violate the shape or a requirement of a parameter or setting.

    Whether the numbers of several axes fit together in a drawing is seen by each member.
    """
    parameters = [target for target in of if target not in NUMBERS]
    if parameters:
        for value in (numbers.min(axis=0), numbers.max(axis=0)):
            try:
                mechanism.with_parameters(dict.fromkeys(parameters, value))
            except SceneError as error:
                if error.is_placement:
                    continue
                yield from (f"axis {quote(name)}: {problem}" for problem in error.problems)
                return
    for target in of:
        if target in NUMBERS and numbers.ndim != 1:
            yield f"axis {quote(name)}: {target} is a number, so its values are a list of numbers, not of shape {numbers.shape}"
        elif target in NUMBERS and np.any(numbers < 0):
            yield f"axis {quote(name)}: {target} must not be negative, but is {np.nanmin(numbers):g}"


def _clashes(dimensions: Sequence[Dimension]) -> Iterator[str]:
    owner: dict[str, str] = {}
    names: dict[str, None] = {}
    for dimension in dimensions:
        for column in dimension.columns:
            if column.name in names or (column.name != dimension.name and column.name in {d.name for d in dimensions}):
                yield f"axis {quote(column.name)} is given twice"
            names[column.name] = None
            for target in () if callable(column.of) else column.of:
                if target in owner:
                    yield f"axes {quote(owner[target])} and {quote(column.name)} both set {quote(target)}"
                owner[target] = column.name


def check_settings(mechanism: StudyModel, dimensions: Sequence[Dimension], settings: Settings) -> list[str]:
    """Return the mistakes in axes of settings: invalid values, settings given twice, and numbers that no member uses."""
    columns = [column for dimension in dimensions for column in dimension.columns]
    targets = {target: column for column in columns if not callable(column.of) for target in column.of}
    problems = [f"{name} is both a setting and an axis: leave one of them out" for name in settings if name in targets]

    for combination in _combinations(dimensions, settings):
        wrong = argument_problems(simulate, {"mechanism": mechanism, **combination})
        columns_of = ((text, targets.get(text.partition(" ")[0].rstrip(":"))) for text in wrong)
        problems += [text if column is None else f"axis {quote(column.name)}: {text}" for text, column in columns_of]

    for target, column in targets.items():
        if target in STEP_SETTINGS and column.is_choice:
            continue
        for value in column.values if column.is_choice else np.unique(column.numbers) if target in NUMBERS else ():
            wrong = argument_problems(simulate, {"mechanism": mechanism, target: value})
            problems += [f"axis {quote(column.name)}: {text}" for text in wrong]

    for wanted in [target for target in targets if target in _SETTING_OF_NUMBER]:
        setting, column = _SETTING_OF_NUMBER[wanted], targets[wanted]
        choices = targets[setting].choices if setting in targets else (settings.get(setting),)
        is_used = np.array([uses_number(setting, choice, wanted) for choice in choices])
        if not is_used.any():
            owner = "stabilization=Baumgarte()" if setting == "stabilization" else "method=Auto()"
            problems.append(f"axis {quote(column.name)}: {wanted} belongs to {owner}, which no member has")
            continue
        is_zipped = any({wanted, setting} <= {t for c in d.columns if not callable(c.of) for t in c.of} for d in dimensions)
        if np.any(np.isnan(column.numbers) & (is_used if is_zipped else True)):
            cure = "NaN is for members without it" if is_zipped else "Zipped with the choices, it may be NaN for those without it"
            problems.append(f"axis {quote(column.name)}: {wanted} must be finite numbers; {cure}")
    return list(dict.fromkeys(problems))


def _combinations(dimensions: Sequence[Dimension], settings: Settings) -> Iterator[dict[str, Any]]:
    """Iterate over the combinations of those settings that are checked together."""
    fixed = {name: settings[name] for name in STEP_SETTINGS if name in settings}

    def choices(dimension: Dimension) -> list[dict[str, Any]]:
        columns = [(name, c) for c in dimension.columns if not callable(c.of) for name in c.of if name in STEP_SETTINGS]
        count = dimension.size if any(column.is_choice for _, column in columns) else 1  # all numbers fit alike
        return [{name: column.values[k] for name, column in columns} for k in range(count)]

    for parts in itertools.product(*map(choices, dimensions)):
        yield fixed | {name: value for part in parts for name, value in part.items()}


def uses_number(setting: str, choice: AxisChoice, name: str) -> bool:
    """Return True if a choice of a setting has the number `name`.

    For example, `Baumgarte` has the gains `alpha` and `beta`, and `Auto`, the default method, has a `branch_tol`.
    """
    return hasattr(Auto() if setting == "method" and choice is None else choice, name)


def check_tangents(mechanism: StudyModel, dimensions: Sequence[Dimension], names: Sequence[str]) -> list[str]:
    """Return the mistakes in the names of the numbers with respect to which derivatives are wanted."""
    columns = {column.name: column for dimension in dimensions for column in dimension.columns}
    parameters, problems = mechanism.number_fields(), []
    for name in names:
        if name in columns:
            if columns[name].is_choice or columns[name].numbers.ndim > 1:
                problems.append(f"derivatives: the values of axis {quote(name)} are not single numbers")
            continue
        owner, index = split_index(name, parameters)
        if owner not in parameters:
            near = suggestion(name, (*parameters, *columns))
            problems.append(f"derivatives: {quote(name)} is neither a parameter of the mechanism nor an axis{near}")
        elif parameters[owner].value is None or np.ndim(jax.eval_shape(lambda v, i=index: v[i], parameters[owner].value)):
            problems.append(f"derivatives: {quote(name)} is not a single number; name an entry, such as {quote(name + '[0]')}")
    return problems
