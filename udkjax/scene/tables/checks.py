"""Checks of scenes from files and from Python; they find all mistakes, not only the first."""

import dataclasses
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, get_args, get_origin

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool

from udkjax.annotations import TomlTable
from udkjax.arrays import is_traced
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.couplings import Coupling, Screw
from udkjax.scene.elements.fields import FieldMetadata, Requirement, StaticValue
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.held import Held
from udkjax.scene.elements.joints import Cam, Prismatic, Revolute, Slot
from udkjax.scene.elements.profiles import AbstractProfile, LawProfile, profile_class
from udkjax.scene.elements.rolling import Wheel
from udkjax.scene.tables.schema import CLASSES_BY_TYPE, CLASSES_WITHOUT_TYPE, is_in_format, keys, table_of
from udkjax.wording import LONGEST_QUOTE, abbreviate, quote, suggestion, unknown_key

LARGEST_INTEGER = 2**1023  # larger ones are beyond the range of floats
ListSizes = dict[str, tuple[int, str]]  # by named dimension: its length, and the name of the list that has it
KnownNames = Mapping[str, Mapping[str, type | None]]  # the classes of elements, by kind (body, revolute) and by name


class Mistakes(ValueError):
    """An error that lists mistakes, `problems`, and the file that contains them, `source` (empty if there is no file)."""

    subject = ""  # noun for the message: "2 mistakes in the scene"

    def __init__(self, problems: Sequence[str], source: str = ""):
        self.problems, self.source = list(problems), source
        head = f"{source}: " if source else ""
        count = f"{len(self.problems)} mistakes in the {self.subject}:\n  "
        super().__init__(head + (self.problems[0] if len(self.problems) == 1 else count + "\n  ".join(self.problems)))

    def __reduce__(self):
        return type(self), (self.problems, self.source)


class SceneError(Mistakes):
    """An error for a mechanism or a scene file that contains mistakes.

    Attributes:
        problems: a message for each mistake, which begins with the path of the entry if it concerns one.
        source: the name of the mechanism or of the file; empty if there is none.
        is_placement: True if each number may be given, but the elements of a drawing cannot be placed with all of them.
    """

    subject = "scene"
    is_placement = False


class PlacementError(SceneError):
    """An error for numbers with which the elements of a drawing cannot be placed."""

    is_placement = True


class SceneEntry(NamedTuple):
    """One element to check: its section and index, its name, its class (None if unknown) and its table."""

    section: str
    index: int
    name: object
    cls: type | None
    table: TomlTable
    problem: str = ""  # why the class is unknown
    element: object = None  # the element, if it exists already

    @property
    def where(self) -> str:
        """The path of the entry, as in error messages."""
        entry = f"{self.section}[{self.index}]"
        return f"{self.section} {abbreviate(self.name)} ({entry})" if isinstance(self.name, str) and self.name else entry


def problems_of(entries: Sequence[SceneEntry], gravity: object) -> list[str]:
    """Return every mistake of a scene, in the order of its entries."""
    problems = gravity_mistakes(gravity)
    bodies = [entry for entry in entries if entry.section == "body"]
    if not bodies:
        problems.append("body: a mechanism needs at least one body")
    known: dict[str, dict[str, type | None]] = {
        "body": {GROUND: None, **{e.name: e.cls for e in bodies if isinstance(e.name, str)}},
        "rubbing": {e.name: e.cls for e in entries if e.section == "joint" and isinstance(e.name, str)},
    }
    owner: dict[tuple[str, str], SceneEntry] = {}
    for entry in entries:
        space = "joint" if entry.section == "driver" else entry.section
        if mistake := name_mistake(entry.name):
            problems.append(f"{entry.section}[{entry.index}].name: {mistake}")
        elif entry.section == "body" and entry.name == GROUND:
            problems.append(f'{entry.where}.name: "{GROUND}" is the fixed frame; choose another name')
        elif (first := owner.setdefault((space, str(entry.name)), entry)) is not entry:
            problems.append(f"{entry.where}.name: taken by {first.section}[{first.index}]; names must be unique")
        if entry.cls is None:
            problems.append(entry.problem)
            problems.extend(_check_references(f"{entry.where}.bodies", "body", entry.table.get("bodies"), known))
        else:
            problems.extend(check_table(entry.where, entry.cls, entry.table, known))
    return [*problems, *_repeated_friction(entries)]


def _repeated_friction(entries: Sequence[SceneEntry]) -> Iterator[str]:
    """Iterate over mistakes of joints with several elements of friction.

    Only one of these may have a coefficient, and friction with the set-valued law must be the only friction of its joint.
    """
    by_joint: dict[object, list[SceneEntry]] = {}
    for entry in entries:
        if entry.cls is None or not issubclass(entry.cls, Friction):
            continue
        joint, table = abbreviate(entry.table.get("joint")), entry.table
        for other in by_joint.setdefault(joint, []):
            if "coefficient" in table and "coefficient" in other.table:
                yield f"{entry.where}.joint: {joint} has a coefficient of friction already, by {other.where}"
            elif "set-valued" in (table.get("law"), other.table.get("law")):
                cure = "give the torque and the coefficient to one friction, as the set-valued law needs"
                yield f"{entry.where}.joint: {joint} has friction already, by {other.where}; {cure}"
        by_joint[joint].append(entry)


def name_mistake(name: object) -> str:
    """Return the mistake in a name that messages, tables and commands cannot show, with a cure; "" if they can show it."""
    if not isinstance(name, str) or not name:
        return "missing" if name is None else f"must be a non-empty string, not {abbreviate(name)}"
    shown = "".join(c for c in name if unicodedata.category(c) not in ("Cc", "Cs", "Zl", "Zp")).strip()
    if shown == name:
        return ""
    what = "blanks at its ends" if shown == name.strip() else "line breaks or control characters"
    return (
        f"must not have {what}, as in {name!r}; write {quote(shown)}"
        if shown
        else f"must not be blank, but is {name!r}; choose a name"
    )


def numbers_are_valid(elements: Iterable[eqx.Module]) -> Bool[Array, ""] | bool:
    """Return True if all numbers meet the strict requirements of their fields; concrete numbers lead to a concrete answer."""
    conditions = list(_strict_conditions(elements))
    traced = [x for x in conditions if isinstance(x, Tracer)]
    concrete = all(x for x in conditions if not isinstance(x, Tracer))
    return jnp.all(jnp.stack([jnp.array(concrete), *traced])) if traced else concrete


def _strict_conditions(elements: Iterable[eqx.Module]) -> Iterator[Any]:
    for element in elements:
        required = _strict_requirements(type(element))
        for name, value in vars(element).items():
            if value is None or isinstance(value, str | tuple):
                continue
            if name in required and isinstance(value, Tracer | jax.Array | np.ndarray):
                array = value if isinstance(value, Tracer) else np.asarray(value)
                yield from (x.holds(array).all() for x in required[name])
            elif not isinstance(value, Tracer | jax.Array) and isinstance(value, eqx.Module):
                yield from _strict_conditions([value])


@cache
def _strict_requirements(cls: type) -> dict[str, list[Requirement]]:
    """Return the strict requirements on the fields of a class, by field; fields without any are left out."""
    strict = {x.name: [r for r in x.metadata.get("require", ()) if r.strict] for x in dataclasses.fields(cls)}
    return {name: required for name, required in strict.items() if required}


def gravity_mistakes(gravity: object) -> list[str]:
    """Return the mistakes in the acceleration of gravity."""
    return list(_check_number("gravity", ["2"], gravity, {}, {}))


def _short(key: Any) -> str:
    """Return a key of a table, abbreviated if long."""
    return abbreviate(key) if isinstance(key, str) and len(key) > LONGEST_QUOTE else f"{key}"


def check_table(
    where: str, cls: type, table: TomlTable, known: KnownNames, written: TomlTable = MappingProxyType({})
) -> Iterator[str]:
    """Iterate over the mistakes in a table that describes an element of class `cls`.

    Args:
        where: The path of the table.
        cls: The class.
        table: The table, with numbers in SI units.
        known: The elements to which it may refer.
        written: The table as it was written, in other units, for messages; empty if these are the same.
    """
    expected, sizes = keys(cls), ListSizes()
    for name in table:
        if name not in expected:
            yield f"{where}.{_short(name)}: {unknown_key(name, expected)}"
    for name, key in expected.items():
        if name in table:
            path, value = f"{where}.{name}", table[name]
            if key.sampled_class and isinstance(value, key.sampled_class | dict):
                yield from _check_held(path, key.annotation.dim_str.split(), value)
            else:
                yield from _check_value(path, key.annotation, value, key.metadata, sizes, written.get(name))
            yield from _check_references(f"{where}.{name}", key.metadata.get("names"), table[name], known)
        elif key.required:
            yield f"{where}.{name}: missing"
    if "bodies" in expected:
        yield from _check_bodies(where, cls, table)
    if issubclass(cls, Friction):
        joint = table.get("joint")
        joint_class = known.get("rubbing", {}).get(joint) if isinstance(joint, str) else None
        yield from (f"{where}.{mistake}" for mistake in cls.mistakes(table, joint_class))
    if issubclass(cls, Cam | Screw | Coupling | Wheel | LawProfile):
        yield from (f"{where}.{mistake}" for mistake in cls.mistakes(table))


def _check_value(
    path: str, annotation: Any, value: object, metadata: FieldMetadata, sizes: ListSizes, written: object = None
) -> Iterator[str]:
    """Iterate over the mistakes in one value. `sizes` collects the lengths of the named dimensions.

    `written` is the value as it was written, in another unit; None if this is the same.
    """
    value = value.value if isinstance(value, StaticValue) else value
    if hasattr(annotation, "dim_str"):
        yield from _check_number(path, annotation.dim_str.split(), value, metadata, sizes, written)
    elif get_origin(annotation) is Literal:
        if not isinstance(value, str) or value not in get_args(annotation):
            choices = ", ".join(quote(choice) for choice in get_args(annotation))
            yield f"{path}: must be one of {choices}, not {abbreviate(value)}{suggestion(value, get_args(annotation))}"
    elif annotation in (str, bool):
        if not isinstance(value, annotation):
            yield f"{path}: must be {'a string' if annotation is str else 'true or false'}, not {abbreviate(value)}"
    elif get_origin(annotation) is tuple and (get_args(annotation)[0] is str or get_origin(get_args(annotation)[0]) is Literal):
        if not isinstance(value, list | tuple) or not all(isinstance(item, str) for item in value):
            yield f"{path}: must be a list of names, not {abbreviate(value)}"
        elif choices := get_args(get_args(annotation)[0]):
            for k, item in enumerate(value):
                yield from _check_value(f"{path}[{k}]", Literal[choices], item, {}, sizes)  # pyright: ignore
    elif isinstance(annotation, type) and issubclass(annotation, eqx.Module):
        yield from _check_nested(path, annotation, value, written if isinstance(written, Mapping) else {})


def _check_nested(path: str, annotation: type, value: object, written: TomlTable) -> Iterator[str]:
    """Iterate over the mistakes in a motion law or a profile: a module in Python, a table in a file, `written` as there."""
    if isinstance(value, Held) and annotation is not Held:
        yield f"{path}: a motion that is held jumps at each sample: give a Spline through its values"
    elif isinstance(value, annotation) and isinstance(value, eqx.Module):
        yield from check_table(path, type(value), table_of(value), {})
    elif not isinstance(value, dict):
        yield f"{path}: must be a table, not {abbreviate(value)}"
    elif annotation is AbstractProfile:
        yield from check_table(path, profile_class(value), value, {}, written)
    elif annotation in CLASSES_WITHOUT_TYPE.values():
        yield from check_table(path, annotation, value, {}, written)
    else:
        cls, problem = find_class(path, CLASSES_BY_TYPE["motion"], value)
        if cls is None:
            yield problem
        else:
            yield from check_table(path, cls, {name: v for name, v in value.items() if name != "type"}, {}, written)


def _check_held(path: str, dims: Sequence[str], value: Any) -> Iterator[str]:
    """Iterate over the mistakes in a `Held` whose samples have the shape `dims`."""
    table = table_of(value) if isinstance(value, Held) else value
    problems, expected = list(check_table(path, Held, table, {})), keys(Held)
    for name in ("dt", "t0"):
        if isinstance(time := table.get(name, 0.0 if name == "t0" else 1.0), Tracer):
            problems.append(f"{path}.{name}: must be known when a function is traced")
        else:
            problems.extend(_check_number(f"{path}.{name}", [], time, expected[name].metadata, {}))
    yield from problems
    if not problems and (shape := np.shape(table["values"])[1:]) != tuple(map(int, dims)):  # pyright: ignore[reportArgumentType]
        sample = f"{' x '.join(dims)} numbers" if dims else "a number"
        yield f"{path}.values: each sample must be {sample}, but has the shape {shape}"


def find_class(path: str, choices: Mapping[str, type], table: TomlTable) -> tuple[type | None, str]:
    """Return the class that a table's `type` names and "", or None and the mistake."""
    kind = table.get("type")
    if isinstance(kind, str) and kind in choices:
        return choices[kind], ""
    if kind is None:
        return None, f"{path}.type: missing; choose one of {', '.join(choices)}"
    return (
        None,
        f"{path}.type: unknown type {abbreviate(kind)}{suggestion(kind, choices) or '; choose one of ' + ', '.join(choices)}",
    )


def _check_number(
    path: str, dims: Sequence[str], value: Any, metadata: FieldMetadata, sizes: ListSizes, written: object = None
) -> Iterator[str]:
    """Iterate over the mistakes in a number: its type, its shape and, if concrete, its value."""
    traced = is_traced(value)
    array = jnp.asarray(value) if traced else _as_array(value)
    is_fixed, shown = all(dim.isdigit() for dim in dims), value if written is None else written
    if array is not None and dims[-1:] == ["..."]:
        dims = [*dims[:-1], *map(str, array.shape[len(dims) - 1 :])]
    if (
        array is None
        or array.ndim != len(dims)
        or not (array.shape == tuple(map(int, dims)) if is_fixed else _has_sizes(array, dims))
    ):
        expected = f"{' x '.join(dims)} numbers" if is_fixed else "numbers"
        if not is_fixed and dims[-1].isdigit():
            expected = f"{'lists of ' * (len(dims) - 1)}{dims[-1]} numbers"
        yield f"{path}: must be {f'a list of {expected}' if dims else 'a number'}, not {abbreviate(shown)}"
        return
    for dim, size in zip(dims, array.shape, strict=True):
        if not dim.isdigit() and (known := sizes.setdefault(dim, (size, path.rpartition(".")[2])))[0] != size:
            yield f"{path}: must have {known[0]} entries, like {known[1]}, not {abbreviate(shown)}"
            return
    if array.ndim and len(array) < metadata.get("at_least", 0):
        yield f"{path}: needs at least {metadata.get('at_least')} entries, not {abbreviate(value)}"
    if not isinstance(array, np.ndarray):
        return
    wrong = ~np.isfinite(array)
    yield from _check_entries(path, array, wrong, "must be finite", written)
    if array.size and not wrong.any():
        for requirement in metadata.get("require", ()):
            if requirement.shown_sum is None:
                yield from _check_entries(path, array, ~requirement.holds(array), requirement.text, written)
            elif not np.all(requirement.holds(array)):
                yield f"{path}: {requirement.text}, not {requirement.shown_sum(float(array.sum()))}"


def _has_sizes(array: Any, dims: Sequence[str]) -> bool:
    """Return True if an array has the sizes of all dimensions that are numbers, as the second of "n 2"."""
    return all(int(dim) == size for dim, size in zip(dims, array.shape, strict=True) if dim.isdigit())


def _check_entries(path: str, array: np.ndarray, wrong: np.ndarray, text: str, written: object) -> Iterator[str]:
    for index in map(tuple, np.argwhere(wrong) if np.any(wrong) else ()):
        shown = abbreviate(_written_entry(written, index, float(array[index])))
        yield f"{path}{''.join(f'[{i}]' for i in index)}: {text}, not {shown}"


def _written_entry(written: object, index: Sequence[int], number: float) -> object:
    """Return an entry as it was written, a number or a text; `number` if it was not."""
    for k in index:
        written = written[k] if isinstance(written, list | tuple) else None
    return written if isinstance(written, int | float | str) and not isinstance(written, bool) else number


def _as_array(value: object) -> np.ndarray | None:
    """Return a number or nested lists of numbers as an array; None for anything else, including booleans and strings."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        return array if array.dtype.kind in "iuf" else None
    if isinstance(value, list | tuple):
        items = [_as_array(item) for item in value]
        ragged = any(item is None for item in items) or len({item.shape for item in items if item is not None}) > 1
        return None if ragged else np.array(items, dtype=float)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return np.array(float(value) if isinstance(value, float) or abs(value) <= LARGEST_INTEGER else np.inf)
    return None


def _check_references(path: str, kind: str | None, value: object, known: KnownNames) -> Iterator[str]:
    """Iterate over the mistakes in a field that holds names of elements of a kind, such as "body"; None: no names."""
    if kind is None or kind not in known:  # the field holds no name, or belongs to a nested module
        return
    named = known[kind]
    single = isinstance(value, str)
    for i, name in enumerate([value] if single else value if isinstance(value, list | tuple) else []):
        entry_path = path if single else f"{path}[{i}]"
        if not isinstance(name, str):
            continue
        if name not in named:
            noun = {"rubbing": "joint"}.get(kind, kind)
            yield f"{entry_path}: no {noun} named {quote(name)}{suggestion(name, named)}"
        elif kind == "rubbing" and not issubclass(named[name] or Revolute, Revolute | Prismatic | Slot):
            yield f"{entry_path}: {quote(name)} must be a revolute joint, a prismatic joint or a slot"
        elif single and name == GROUND and path.endswith(".body"):
            yield f'{entry_path}: "{GROUND}" does not move; name a body'


def _check_bodies(where: str, cls: type, table: TomlTable) -> Iterator[str]:
    """Iterate over the mistakes in the bodies of an element: their number must fit the type, and all must differ."""
    bodies = table.get("bodies")
    if not isinstance(bodies, list | tuple):
        return
    if is_in_format(cls) and len(bodies) != (n := getattr(cls, "n_bodies", 2)):
        yield f"{where}.bodies: must name {n} {'body' if n == 1 else 'bodies'}, not {abbreviate(bodies)}"
    named = table.get("carrier", GROUND)
    carrier = [named] if isinstance(named, str) and named != GROUND else []
    attached = [name for name in (*bodies, *carrier) if isinstance(name, str)]
    repeated = {name: None for name in attached if attached.count(name) > 1}
    yield from (
        f"{where}.{'carrier' if name in carrier else 'bodies'}: {quote(name)} is connected to itself" for name in repeated
    )
