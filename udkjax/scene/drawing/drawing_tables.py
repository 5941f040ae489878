"""Convert drawings to the tables of a TOML file, format 2, and back, with bitwise identical numbers."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from udkjax.scene.drawing.drawing import Drawing
from udkjax.scene.drawing.drawing_reader import DRAWING_SECTIONS, MECHANISM_SECTIONS, read_drawing, units_of_element
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.drawing.pin_forms import pin_entries
from udkjax.scene.mechanism_tables import check_classes, check_known, head_mistakes, key_lines, read_section, type_key
from udkjax.scene.numbers.named_numbers import NamedNumber
from udkjax.scene.tables.checks import SceneEntry, SceneError
from udkjax.scene.tables.schema import table_of
from udkjax.wording import abbreviate, suggestion

# Sections of tables in double brackets.
LISTS = tuple(section for section in DRAWING_SECTIONS if section not in ("pin", "number"))


def drawing_of_tables(scene: Mapping[str, Any], source: str) -> Drawing:
    """Return the drawing described by the tables of a file; raise a `SceneError` that names the file."""
    head = ("format", "name", "units", "gravity", "ground", "numbers", "pins", "velocities")
    problems = list(head_mistakes(scene, (*head, *LISTS, *MECHANISM_SECTIONS)))
    entries = list(_read_pins(scene, problems))
    for section in (*LISTS, *MECHANISM_SECTIONS):
        is_counted = section in LISTS and section != "link"
        entries.extend(
            read_section(section, scene.get(section, []), problems, (DRAWING_SECTIONS | MECHANISM_SECTIONS)[section], is_counted)
        )
    ground, gravity, units = scene.get("ground", []), scene.get("gravity"), scene.get("units", {})
    elements = read_drawing(entries, ground, gravity, Units(units), numbers=scene.get("numbers", {}))
    problems.extend(elements.problems)
    if problems:
        raise SceneError(problems, source)
    return Drawing.of_elements(elements, ground, scene.get("name", ""), units)


def _read_pins(scene: Mapping[str, Any], problems: list[str]) -> Iterator[SceneEntry]:
    tables = {key: scene.get(key, {}) for key in ("pins", "velocities")}
    for key, table in tables.items():
        if not isinstance(table, dict):
            problems.append(f"{key}: must be a table, such as [{key}] with A = [0, 1] below, not {abbreviate(table)}")
            return
    pins, velocities = tables.values()
    problems += [f"velocities.{name}: no pin of this name{suggestion(name, pins)}" for name in velocities if name not in pins]
    yield from pin_entries(pins, velocities)


def drawing_text(drawing: Drawing) -> str:
    """Return a drawing as the text of a TOML file, in the units in which it was drawn; raise a `SceneError` if that fails."""
    check_known(drawing, drawing.name)
    drawing.with_groups(drawing.own_groups, drawing.gravity)  # numbers changed as leaves of a tree have not been checked
    units, groups = Units(dict(drawing.units)), drawing.groups
    problems = [
        problem
        for section in MECHANISM_SECTIONS
        for name, element in groups[section].items()
        for problem in check_classes(f'{section} "{name}"', type(element), table_of(element))
    ]
    problems += [
        problem
        for name, motor in groups["motor"].items()
        if motor.motion is not None
        for problem in check_classes(f'motor "{name}".motion', type(motor.motion), {})
    ]
    if problems:
        raise SceneError(problems, drawing.name)
    head: dict[str, Any] = {"format": 2, **({"name": drawing.name} if drawing.name else {})}
    if drawing.units:
        head["units"] = dict(drawing.units)
    head["gravity"] = [units.write(x, "m/s2") for x in np.asarray(drawing.gravity).tolist()]
    lines = key_lines(head | ({"ground": list(drawing.ground)} if drawing.ground else {}))
    texts = _Texts(drawing)
    named = {name: texts.put("number", name, _written(x))["value"] for name, x in groups["number"].items()}
    lines += ["", "[numbers]", *key_lines(named)] if named else []
    tables = {name: texts.put("pin", name, _without_empty(units.write_table(pin))) for name, pin in groups["pin"].items()}
    velocities = {name: table.pop("velocity") for name, table in tables.items() if "velocity" in table}
    pins = {name: table.get("position", table) for name, table in tables.items()}
    for title, written in (("pins", pins), ("velocities", velocities)):
        lines += ["", f"[{title}]", *key_lines(written)] if written else []
    for section in (*LISTS, *MECHANISM_SECTIONS):
        for name, element in groups[section].items():
            table = units.write_table(element, *units_of_element(type(element), table_of(element)))
            table = texts.put(section, name, table)
            kind = type_key(type(element)) if section in MECHANISM_SECTIONS else {}
            lines += ["", f"[[{section}]]", *key_lines({"name": name, **kind, **_without_empty(table)})]
    return "\n".join(lines) + "\n"


def _written(named: NamedNumber) -> dict[str, object]:
    """Return a named number as a table with its value, a string if it has a unit."""
    value = float(np.asarray(named.value))
    return {"value": f"{value!r} {named.unit}" if named.unit else value}


class _Texts:
    """The texts of the expressions of a drawing, to be written instead of their values."""

    def __init__(self, drawing: Drawing):
        self.formulas = drawing.formulas

    def put(self, section: str, owner: str, table: dict[str, Any]) -> dict[str, Any]:
        """Replace the values of expressions in the table of an element by their texts, and return the table."""
        for formula in self.formulas:
            if (formula.section, formula.owner) == (section, owner):
                self._put(table, (*(field.removesuffix("_") for field in formula.path), *formula.at), formula.text)
        return table

    @staticmethod
    def _put(holder: Any, path: tuple[str | int, ...], text: str) -> None:
        for key in path[:-1]:
            holder = holder[key]
        holder[path[-1]] = text


def _without_empty(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table without the keys whose values (), "" and False stand for names and choices that are not given."""
    return {key: value for key, value in table.items() if value not in ((), "") and value is not False}
