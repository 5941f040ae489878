"""Read the elements of a drawing from tables, and find all mistakes: in units, keys, names, connections and geometry."""

import re
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np

from udkjax.annotations import TomlTable
from udkjax.arrays import by_numpy, is_traced
from udkjax.scene.drawing.drawn_forces import Load, Motor, PinDamper, PinSpring
from udkjax.scene.drawing.drawn_friction import PinFriction
from udkjax.scene.drawing.drawn_joints import CamPair, GearPair, PinInSlot, ScrewPair, Slide
from udkjax.scene.drawing.drawn_quantities import Expression, Units, without_failed
from udkjax.scene.drawing.link import Link, with_concrete_numbers
from udkjax.scene.drawing.mistakes import gap_mistakes, joint_names, layout_mistakes, pin_mistakes, shape_mistakes, where
from udkjax.scene.drawing.pin_forms import AbstractPin, PointArray, lowest_of_stack, places_of
from udkjax.scene.drawing.placement import DrawnElement, PinLayout, Placement
from udkjax.scene.elements.bodies import GROUND, Body, Frame
from udkjax.scene.elements.couplings import Coupling
from udkjax.scene.elements.drivers import Driver
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.elements.joints import Joint, Revolute
from udkjax.scene.numbers.named_numbers import Formula, NamedNumber
from udkjax.scene.tables.checks import SceneEntry, check_table, gravity_mistakes, name_mistake
from udkjax.scene.tables.element_setup import as_leaves
from udkjax.scene.tables.schema import build, keys
from udkjax.wording import abbreviate, quote, suggestion

ELEMENT_SECTIONS: Mapping[str, type[DrawnElement]] = {
    "slide": Slide,
    "slot": PinInSlot,
    "gear": GearPair,
    "screw": ScrewPair,
    "cam": CamPair,
    "motor": Motor,
    "spring": PinSpring,
    "damper": PinDamper,
    "load": Load,
    "friction": PinFriction,
}
DRAWING_SECTIONS = {"number": NamedNumber, "pin": AbstractPin, "link": Link, **ELEMENT_SECTIONS}
ONLY_PLAIN = "must be a plain number, not the expression"
MECHANISM_SECTIONS = {"body": Body, "joint": Joint, "driver": Driver, "force": ForceElement}  # as in a mechanism


class DrawingElements(NamedTuple):
    """The elements of a drawing that could be read, and its mistakes."""

    groups: dict[str, dict[str, Any]]
    gravity: Any
    problems: list[str]
    formulas: tuple[Formula, ...] = ()  # numbers that expressions give, in the order in which they follow from each other
    are_misplaced: bool = False  # whether the only mistakes are that elements cannot be placed with these numbers


def read_drawing(
    entries: Sequence[SceneEntry],
    ground: object,
    gravity: Any,
    units: Units,
    shown: Units | None = None,
    numbers: object = MappingProxyType({}),
) -> DrawingElements:
    """Read the elements of a drawing and find all mistakes: in units, keys, shapes, names, connections and geometry.

    Args:
        entries: The elements as tables, or as objects.
        ground: The names of the fixed pins.
        gravity: The acceleration of gravity; None: 9.81 m/s^2 along -y.
        units: The units of plain numbers.
        shown: The units of numbers in messages; None: `units`.
        numbers: The named numbers: values, or expressions, by name.

    Returns:
        The elements that could be read, and all mistakes.
    """
    problems = list(units.problems)
    named_numbers = units.read_numbers(numbers, problems)
    if len(problems) > len(units.problems):  # expressions of these numbers have no values
        return DrawingElements({}, gravity, problems)
    formulas = [Formula("number", x.path.split(".")[1], ("value",), (), x.text, "") for x in units.expressions]
    if gravity is None:
        gravity = (0.0, -9.81)
    elif isinstance(gravity, str | list | tuple):
        gravity = units.convert("gravity", gravity, "m/s2", problems)
        problems += [f"{x.path}: {ONLY_PLAIN} {quote(x.text)}" for x in units.expressions[len(formulas) :]]
    problems += [] if gravity is None else gravity_mistakes(gravity)
    named = {s: {str(e.name): e.cls for e in entries if e.section == s} for s in (*DRAWING_SECTIONS, *MECHANISM_SECTIONS)}
    bodies = {GROUND: None, **named["link"], **named["body"]}
    known: dict[str, Any] = {"pin": named["pin"], "link": bodies, "body": bodies, "slide": named["slide"], "slot": named["slot"]}
    fixed_pins: Sequence[str] = ground if isinstance(ground, list | tuple) and all(isinstance(p, str) for p in ground) else ()
    if not named["link"] and not named["body"]:
        problems.append("link: a drawing needs at least one link")
    if fixed_pins != ground:
        problems.append(f"ground: must be a list of pins, not {abbreviate(ground)}")
    problems += [
        f"ground[{k}]: no pin named {quote(p)}{suggestion(p, named['pin'])}"
        for k, p in enumerate(fixed_pins)
        if p not in named["pin"]
    ]
    groups: dict[str, dict[str, Any]] = {section: {} for section in (*DRAWING_SECTIONS, *MECHANISM_SECTIONS)}
    groups["number"], named["number"] = named_numbers, dict.fromkeys(named_numbers)
    for section in groups:
        if section == "body":  # the pins and links, which determine the joints, have been read
            layout = PinLayout(groups["link"], fixed_pins, groups["slide"])
            known["rubbing"] = dict.fromkeys(joint_names(layout, list(groups["pin"])), Revolute)
            known["rubbing"] |= named["joint"]
        for entry in entries:
            if entry.section == section:
                _read_element(entry, known, units, groups[section], problems, formulas)
    if any(len(groups[s]) < len(named[s]) for s in ("pin", "link")) or any(pin not in named["pin"] for pin in fixed_pins):
        return DrawingElements(groups, gravity, problems)
    if misplaced := list(pin_mistakes(groups["pin"], shown or units)):
        return DrawingElements(groups, gravity, [*problems, *misplaced], are_misplaced=not problems)
    layout = PinLayout(groups["link"], fixed_pins, groups["slide"])
    all_read = all(len(groups[section]) == len(named[section]) for section in groups)
    problems += layout_mistakes(layout, groups, fixed_pins, all_read)
    had_mistakes = bool(problems)
    if not is_traced((groups["pin"], groups["link"])):
        drawn = concrete_elements(groups)
        problems += shape_mistakes(drawn["pin"], drawn["link"], {slot.pin for slot in drawn["slot"].values()})
        if not problems and not is_traced([groups[section] for section in ("slide", "slot", "gear", "cam")]):
            with jax.ensure_compile_time_eval():  # concrete even while something else is traced
                problems += gap_mistakes(placement_of(drawn, fixed_pins), drawn)
    return DrawingElements(groups, gravity, problems, tuple(formulas), bool(problems) and not had_mistakes)


def _read_element(
    entry: SceneEntry,
    known: Mapping[str, Any],
    units: Units,
    group: dict[str, Any],
    problems: list[str],
    formulas: list[Formula],
) -> None:
    """Add an element to its group and its expressions to the formulas, or its mistakes to the problems."""
    path = entry.where if entry.section != "pin" else where("pin", entry.index, str(entry.name))
    if mistake := name_mistake(entry.name):
        problems.append(f"{path}.name: {mistake}")
    elif entry.name in group:
        problems.append(f"{path}.name: taken by another {entry.section}; names must be unique")
    if entry.cls is None:
        problems.append(entry.problem)
        return
    failed: list[str] = []
    table, cls, count = entry.table, entry.cls, len(units.expressions)
    written: TomlTable = {}
    if not isinstance(entry.element, cls):
        variant, law = units_of_element(cls, table)
        table = units.convert_table(path, cls, table, failed, variant, law)
        written = _as_written(path, entry.table, table, {x.path for x in units.expressions[count:]})
    mistakes = [*failed, *without_failed(check_table(path, cls, table, known, written), failed)]
    if entry.section == "pin":
        mistakes = [problem.replace(f"{path}.position", path, 1) for problem in mistakes]
    problems += mistakes
    if not mistakes and isinstance(entry.name, str):
        element: Any = entry.element
        built = as_leaves(element) if isinstance(element, cls) else build(cls, table)
        group.setdefault(entry.name, built)
        for expression in units.expressions[count:]:
            formula = _formula(entry, built, expression, path)
            if formula is None:
                problems.append(f"{expression.path}: {ONLY_PLAIN} {quote(expression.text)}")
            else:
                formulas.append(formula)


def _as_written(path: str, given: Any, converted: Any, expressions: Collection[str]) -> Any:
    """Return a value of a table as it was given, but with the numbers that expressions give, in SI units, in place of these.

    Args:
        path: The path of the value.
        given: The value.
        converted: The value in SI units.
        expressions: The paths of the expressions.
    """
    if isinstance(given, Mapping) and isinstance(converted, Mapping):
        return {key: _as_written(f"{path}.{key}", x, converted.get(key), expressions) for key, x in given.items()}
    if isinstance(given, list | tuple) and isinstance(converted, list | tuple) and len(given) == len(converted):
        return [_as_written(f"{path}[{k}]", x, y, expressions) for k, (x, y) in enumerate(zip(given, converted, strict=True))]
    return converted if path in expressions else given


def _formula(entry: SceneEntry, built: Any, expression: Expression, path: str) -> Formula | None:
    """Return the formula of an expression in an element; None if the element does not store the number as it is given."""
    keys_and_places = re.findall(r"\.([^.\[\]]+)|\[(\d+)\]", expression.path.removeprefix(path))
    fields, holder = [], built
    for key in (key for key, _ in keys_and_places if key):
        fields.append(keys(type(holder))[key].field)
        holder = getattr(holder, fields[-1])
    at = tuple(int(place) for _, place in keys_and_places if place)
    if not isinstance(holder, np.ndarray | jax.Array) or holder.ndim != len(at):
        return None
    return Formula(entry.section, str(entry.name), tuple(fields), at, expression.text, expression.unit)


def units_of_element(cls: type, table: TomlTable) -> tuple[str, str]:
    """Return the class name under which the units of an element are listed, and the unit of its motion law."""
    if cls in (PinSpring, PinDamper):
        return ("TorsionSpring" if "pin" in table else "Spring"), ""
    if cls is PinFriction:
        return "Friction", ""
    if cls is Motor:
        return ("SlideMotor", "m") if "slide" in table or table.get("between") else ("Motor", "rad")
    if cls is Coupling:
        return cls.__name__, " per ".join("rad" if table.get(axis) is None else "m" for axis in ("axis", "to_axis"))
    return cls.__name__, "rad" if table.get("coordinate") == "angle" else "m"


def placement_of(groups: Mapping[str, Mapping[str, Any]], ground: Sequence[str]) -> Placement:
    """Return the placement of the elements of a drawing, with NumPy or traced numbers."""
    links = groups["link"]
    places = places_of(groups["pin"])
    speeds = {name: _velocity(groups["pin"], name) for name in groups["pin"]}
    drawn = {name: link.body(places, speeds) for name, link in links.items()}
    frames = {name: Frame.at(by_numpy(body.position), by_numpy(body.angle)) for name, body in groups["body"].items()}
    return Placement(PinLayout(links, ground, groups["slide"]), places, drawn, frames)


def _velocity(pins: Mapping[str, AbstractPin], name: str) -> PointArray:
    """Return the initial velocity of a pin (m/s): its own, or else that of the lowest pin of its stack, or else zero."""
    given = pins[name].velocity
    given = pins[lowest_of_stack(pins, name)].velocity if given is None else given
    return np.zeros(2) if given is None else by_numpy(given)


def concrete_elements(groups: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return elements with NumPy arrays for all concrete numbers, in their order: JAX sorts the keys of a dict."""
    return {section: {name: with_concrete_numbers(x) for name, x in group.items()} for section, group in groups.items()}
