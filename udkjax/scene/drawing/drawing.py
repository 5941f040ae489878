"""A drawing: a mechanism defined as on paper, by pins in world coordinates and links through them."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import NumberLike, Numbers, TomlTable
from udkjax.arrays import by_numpy, is_traced, make_module, number
from udkjax.printing import PrintedTable, has_numbers
from udkjax.scene.drawing.drawing_reader import (
    DRAWING_SECTIONS,
    ELEMENT_SECTIONS,
    MECHANISM_SECTIONS,
    DrawingElements,
    placement_of,
    read_drawing,
)
from udkjax.scene.drawing.drawn_forces import Load, Motor, PinDamper, PinSpring
from udkjax.scene.drawing.drawn_friction import PinFriction
from udkjax.scene.drawing.drawn_joints import CamPair, GearPair, PinInSlot, ScrewPair, Slide
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.drawing.link import Link, around
from udkjax.scene.drawing.mistakes import joint_names, where
from udkjax.scene.drawing.pin_forms import AbstractPin, Pin, norm, pin_entries, places_of
from udkjax.scene.elements.bodies import GROUND, Body
from udkjax.scene.elements.drivers import Driver
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.elements.joints import Joint, Revolute
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.description import drawing_table
from udkjax.scene.numbers.named_numbers import Formula, with_expressions, without_expressions
from udkjax.scene.numbers.number_fields import ElementGroups
from udkjax.scene.numbers.sources import AbstractDrawing, Drawn, Follows, is_number
from udkjax.scene.tables.checks import PlacementError, SceneEntry, SceneError
from udkjax.scene.tables.element_setup import name_elements
from udkjax.scene.tables.schema import table_of
from udkjax.wording import abbreviate, quote, suggestion


class Drawing(AbstractDrawing):
    """Pins, links through them, and other elements by name; `mechanism()` returns the `Mechanism`.

    A pin shared by k links, including the ground, becomes k - 1 revolutes named after the pin: `B`, and `B-2` for a third link.
    Links become bodies of the same name. A body's frame has its origin at the centre of mass, and its x axis points from the
    first pin towards the second. As in a mechanism, all numbers are leaves, and have names, such as `pin.A`.

    Args:
        pins: World coordinates of each pin (m); or a pin by lengths and angles: `udk.polar`, `udk.circles`, `udk.on_line`, or a
            table with the keys of a file.
        links: The links: `Link`s, or tables of their keys.
        ground: The pins that are fixed.
        slides: Links that slide along a line without turning on it. Like all elements below, they are given as a mapping from
            names, or as a list. Each element is a table with the keys of a file, such as `{"link": "slider", "direction": 0}`,
            or an instance of a class of `udkjax.scene.drawing`.
        slots: Pins that are guided by a line.
        gears: Pairs of links that mesh.
        cams: Pins that stay on the profile of a link.
        motors: Prescribed motions of a link relative to another link, or torques between them.
        springs: Springs between pins, or torsion springs at pins.
        dampers: Dampers between pins, or rotational dampers at pins.
        loads: Constant forces and torques on links.
        bodies: More bodies, as in a `Mechanism`.
        joints: More joints, as in a `Mechanism`. They may name links; points are then in the frame of the link.
        drivers: More drivers, as in a `Mechanism`.
        forces: More force elements, as in a `Mechanism`.
        velocities: Initial velocities of pins (m/s); other pins are at rest. The first two pins of a link determine its motion.
        gravity: The acceleration of gravity, by default 9.81 m/s^2 along -y.
        name: The name of the mechanism.
        units: Units of plain numbers, such as `{"length": "mm"}`; by default SI units and radians. A number may be a string with
            its unit, such as "60 rpm".
        friction: Friction at pins, in slides and in slots, given like the slides.
        screws: Screws that turn at a pin and move a slide, given like the slides.
        numbers: Named numbers, which other numbers may be expressions of: with {"r": 40}, a length may be "2*r". They are plain
            numbers in the drawing's units, strings with a unit, or expressions of each other.

    Raises:
        SceneError: The drawing is wrong; the error lists all mistakes. Traced numbers are not checked.
    """

    name: str = eqx.field(static=True)
    gravity: Float[Array, "2"]  # m/s^2
    ground: tuple[str, ...] = eqx.field(static=True)
    units: tuple[tuple[str, str], ...] = eqx.field(static=True)  # the units in which it was written
    formulas: tuple[Formula, ...] = eqx.field(static=True)  # numbers that expressions give
    massless: tuple[str, ...] = eqx.field(static=True)  # links for which no mass is given
    _names: tuple[tuple[str, ...], ...] = eqx.field(static=True)  # names of the elements of each section
    _elements: tuple[tuple[Any, ...] | None, ...]

    def __init__(
        self,
        pins: Mapping[str, AbstractPin | TomlTable | Numbers],
        links: Mapping[str, Link | TomlTable],
        ground: Sequence[str] = (),
        slides: "Mapping[str, Slide | TomlTable] | Sequence[Slide | TomlTable] | None" = None,
        slots: "Mapping[str, PinInSlot | TomlTable] | Sequence[PinInSlot | TomlTable] | None" = None,
        gears: "Mapping[str, GearPair | TomlTable] | Sequence[GearPair | TomlTable] | None" = None,
        cams: "Mapping[str, CamPair | TomlTable] | Sequence[CamPair | TomlTable] | None" = None,
        motors: "Mapping[str, Motor | TomlTable] | Sequence[Motor | TomlTable] | None" = None,
        springs: "Mapping[str, PinSpring | TomlTable] | Sequence[PinSpring | TomlTable] | None" = None,
        dampers: "Mapping[str, PinDamper | TomlTable] | Sequence[PinDamper | TomlTable] | None" = None,
        loads: "Mapping[str, Load | TomlTable] | Sequence[Load | TomlTable] | None" = None,
        bodies: Mapping[str, Body] | None = None,
        joints: Mapping[str, Joint] | None = None,
        drivers: Mapping[str, Driver] | None = None,
        forces: Mapping[str, ForceElement] | Sequence[ForceElement] | None = None,
        velocities: Mapping[str, Numbers] | None = None,
        gravity: Numbers | None = None,
        name: str = "",
        units: Mapping[str, str] | None = None,
        friction: "Mapping[str, PinFriction | TomlTable] | Sequence[PinFriction | TomlTable] | None" = None,
        screws: "Mapping[str, ScrewPair | TomlTable] | Sequence[ScrewPair | TomlTable] | None" = None,
        numbers: Mapping[str, NumberLike | str] | None = None,
    ):
        given = {"link": links, "slide": slides, "slot": slots, "gear": gears, "screw": screws, "cam": cams}
        given |= {"motor": motors, "spring": springs, "damper": dampers, "load": loads, "friction": friction}
        given |= {"body": bodies, "joint": joints, "driver": drivers, "force": forces}
        unknown = [
            f"velocities.{pin}: no pin named {quote(pin)}{suggestion(pin, pins)}" for pin in velocities or {} if pin not in pins
        ]
        entries = [
            *pin_entries(pins, velocities or {}),
            *(e for section, group in given.items() for e in _entries(section, group)),
        ]
        checked = read_drawing(entries, ground, gravity, Units(units), numbers=numbers or {})
        if unknown or checked.problems:
            raise SceneError([*unknown, *checked.problems], name)
        self.name, self.gravity, self.ground = name, number(checked.gravity), tuple(ground)
        self.units = tuple((units or {}).items())
        self.formulas, self.massless = checked.formulas, _without_mass(checked.groups)
        self._names, self._elements = _in_order(without_expressions(checked.groups, checked.formulas))

    @classmethod
    def of_elements(cls, checked: DrawingElements, ground: Sequence[str], name: str, units: Mapping[str, str]) -> "Drawing":
        """Return the drawing of elements that were read without mistakes."""
        names, elements = _in_order(without_expressions(checked.groups, checked.formulas))
        head: dict[str, Any] = {"name": name, "gravity": number(checked.gravity), "ground": tuple(ground)}
        head |= {"units": tuple(units.items()), "formulas": checked.formulas, "massless": _without_mass(checked.groups)}
        return make_module(cls, **head, _names=names, _elements=elements)

    @property
    def groups(self) -> dict[str, dict[str, Any]]:
        """All elements by section (number, pin, link, motor, ...) and name, with all of their numbers."""
        own = self.own_groups
        if not self.formulas:
            return own
        units, named = Units(dict(self.units)), [x for x in own["number"].values() if x.value is not None]
        if not all(is_number(x.value) for x in named):  # as in `eqx.tree_at`
            return own
        given = {formula.owner for formula in self.formulas if formula.section == "number"}
        measured = {name: units.measured(x) for name, x in own["number"].items() if name not in given}
        return with_expressions(own, self.formulas, measured, units.size_of)

    @property
    def own_groups(self) -> dict[str, dict[str, Any]]:
        """All elements by section and name, without the values of expressions: None for a number, zero for an entry of one."""
        sections = zip((*DRAWING_SECTIONS, *MECHANISM_SECTIONS), self._names, self._elements, strict=True)
        return {section: dict(zip(names, elements or (), strict=True)) for section, names, elements in sections}

    @property
    def pins(self) -> dict[str, Float[Array, "2"]]:
        """The world coordinates of the pins by name (m)."""
        pins = self.groups["pin"]
        computed = [name for name, pin in pins.items() if not isinstance(pin, Pin)]
        if not computed:
            places: Mapping[str, Any] = {}
        elif all(map(is_number, jax.tree.leaves(pins))):
            places = places_of(pins)
        else:  # as in `eqx.tree_at`
            text = "the place of pin {} is no leaf of the drawing: it follows from lengths and angles"
            places = {name: Follows(text.format(quote(name))) for name in computed}
        return {name: _stored(places[name]) if name in computed else pin.position for name, pin in pins.items()}

    def by_coordinates(self) -> "Drawing":
        """Return the same drawing with all pins given by coordinates; the drawing itself if they already are."""
        places, pins = self.pins, self.groups["pin"]
        if all(isinstance(pin, Pin) for pin in pins.values()):
            return self
        drawn = self.own_groups | {"pin": {name: Pin(places[name], pin.velocity) for name, pin in pins.items()}}
        formulas = tuple(formula for formula in self.formulas if formula.section != "pin")
        return make_module(Drawing, **vars(self) | {"_elements": _in_order(drawn)[1], "formulas": formulas})

    @property
    def links(self) -> dict[str, Link]:
        """The links by name."""
        return self.groups["link"]

    def lengths(self) -> dict[str, dict[tuple[str, str], Float[Array, ""]]]:
        """Return the lengths (m) of each link and of the ground, by name and by the two pins between which they are measured."""
        places = places_of(self.groups["pin"])
        sides = {name: link.sides for name, link in self.links.items()} | {GROUND: around(self.ground, closed=True)}
        return {n: {(a, b): number(norm(places[b] - places[a])) for a, b in pairs} for n, pairs in sides.items() if pairs}

    def length_texts(self) -> dict[str, str]:
        """Return the lengths of each link and of the ground as text, in the unit of the drawing; empty if traced or batched."""
        if not has_numbers(self) or np.ndim(self.gravity) > 1:  # a batch has no single text
            return {}
        units = Units(dict(self.units))
        return {
            name: ", ".join(f"{a}-{b} {units.text(float(x), 'm')}" for (a, b), x in lengths.items())
            for name, lengths in self.lengths().items()
        }

    def dimensions(self) -> dict[tuple[str, str], str]:
        """Return the lengths of all links and of the ground as text, by pairs of pins, in the unit of the drawing."""
        units = Units(dict(self.units))
        return {pair: units.text(float(x), "m") for lengths in self.lengths().values() for pair, x in lengths.items()}

    def touching_pins(self) -> list[str]:
        """Return the names of pins whose places have no derivatives, because circles only touch, or lengths just reach a line.

        The numbers of the drawing must be concrete.
        """
        places = places_of(self.groups["pin"])
        return [name for name, pin in self.groups["pin"].items() if pin.touches(places)]

    def locate_pin(self, name: str) -> tuple[str, Array] | None:
        """Return the last link at a pin, or "ground" if no link has the pin, and the pin's position in that frame (m).

        None for an unknown pin.
        """
        placement = placement_of(self.groups, self.ground)
        if name not in placement.places:
            return None
        body = (GROUND, *placement.members(name))[-1]  # a pin that only others refer to is a point of the ground
        return body, number(placement.local(body, placement.places[name]))

    @property
    def polygons(self) -> list[str]:
        """The names of the links whose shape is a polygon: plates and outlines."""
        return [name for name, link in self.links.items() if link.kind in ("plate", "outline")]

    def shapes(self) -> dict[str, Array]:
        """Return the pins or the outline (n, 2) of each link, in the frame of the link (m), by name."""
        placement, shapes = placement_of(self.groups, self.ground), {}
        for name, link in placement.links.items():
            positions = [placement.places[pin] for pin in link.pins] if link.outline is None else list(by_numpy(link.outline))
            shapes[name] = number([placement.local(name, position) for position in positions])
        return shapes

    def holes(self) -> dict[str, Array]:
        """Return the corners of the holes (holes, corners, 2) of links that have any, in the frame of the link (m), by name."""
        placement, found = placement_of(self.groups, self.ground), {}
        for name, link in placement.links.items():
            if link.holes is not None:
                corners = [[placement.local(name, corner) for corner in hole] for hole in by_numpy(link.holes)]
                found[name] = number(corners)
        return found

    def free_pins(self) -> dict[str, tuple[str, Array]]:
        """Return the link and the position in its frame (m) of each pin that belongs to a single link, by the pin's name."""
        placement, free = placement_of(self.groups, self.ground), {}
        for pin, position in placement.places.items():
            members = placement.members(pin)
            if len(members) == 1 and members[0] in placement.links:
                free[pin] = members[0], number(placement.local(members[0], position))
        return free

    def _table(self) -> PrintedTable:
        return drawing_table(self.name, self.groups, self.ground, self.length_texts())

    _shapes = _table  # the table marks traced numbers

    def mechanism(self) -> Mechanism:
        """Return the mechanism of the drawing; its numbers follow from those of the drawing, which may be traced."""
        return Mechanism.of_drawing(Drawn(self), self.name)

    def elements(self) -> ElementGroups:
        """Return the elements of the mechanism, by section (body, joint, driver, force) and name, without checks."""
        groups = self.groups
        placement = placement_of(groups, self.ground)
        bodies = {name: drawn.body for name, drawn in placement.drawn.items()} | groups["body"]
        joints: dict[str, Joint] = {}
        for name, (pin, *pair) in joint_names(placement, list(groups["pin"])).items():
            joints[name] = Revolute(tuple(pair), placement.points(pair, [placement.places[pin]] * 2))
        parts = {name: element.parts(placement) for s in ELEMENT_SECTIONS if s != "motor" for name, element in groups[s].items()}
        motors = {name: motor.parts(placement) for name, motor in groups["motor"].items()}
        joints |= {name: part.joint for name, part in parts.items() if part.joint is not None}
        drivers = {name: part.driver for name, part in motors.items() if part.driver is not None}
        forces = {name: part.force for name, part in (*parts.items(), *motors.items()) if part.force is not None}
        joints, drivers, forces = joints | groups["joint"], drivers | groups["driver"], forces | groups["force"]
        return {"body": bodies, "joint": joints, "driver": drivers, "force": forces}

    def explain(self, problem: str) -> str:
        """Return the message about a mistake; if this is in the body of a link, add that its numbers follow from the link."""
        name = next((name for name in self.links if problem.startswith(f"body {abbreviate(name)} ")), None)
        return (
            problem if name is None else f"{problem}; it follows from the mass or density, pins and width of link {quote(name)}"
        )

    def with_groups(self, groups: Mapping[str, Mapping[str, Any]], gravity: Array) -> "Drawing":
        """Return the drawing with other numbers in its elements, and other gravity; raise a `SceneError` if any is not valid."""
        named = [(name, x.value) for name, x in groups["number"].items() if x.value is not None]
        wrong = [f"number.{name}: must be a number, not {abbreviate(x)}" for name, x in named if not is_number(x)]
        known = [(name, x) for name, x in named if is_number(x) and not is_traced(x)]
        wrong += [f"number.{name}: must be finite, not {np.asarray(x)}" for name, x in known if not np.all(np.isfinite(x))]
        if wrong:
            raise SceneError(wrong, self.name)
        plain = make_module(Drawing, **vars(self) | {"_elements": _in_order(groups)[1]}).groups if self.formulas else groups
        drawn = [
            entry for section, group in plain.items() if section not in ("pin", "number") for entry in _entries(section, group)
        ]
        units = Units(dict(self.units))
        checked = read_drawing([*pin_entries(plain["pin"], {}), *drawn], self.ground, gravity, Units(), units)
        if checked.problems:
            raise (PlacementError if checked.are_misplaced else SceneError)(checked.problems, self.name)
        own = without_expressions(checked.groups | {"number": plain["number"]}, self.formulas)
        changed = {"gravity": gravity, "massless": _without_mass(checked.groups), "_elements": _in_order(own)[1]}
        return make_module(Drawing, **vars(self) | changed)


def _without_mass(groups: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    return tuple(name for name, link in groups["link"].items() if link.density is link.mass is None)


def _in_order(groups: Mapping[str, Mapping[str, Any]]) -> tuple[tuple[tuple[str, ...], ...], tuple[tuple[Any, ...] | None, ...]]:
    """Return the names and the elements of each section as tuples, since JAX would sort the keys of a dict.

    Instead of an empty tuple of elements, there is None.
    """
    sections = [groups[section] for section in (*DRAWING_SECTIONS, *MECHANISM_SECTIONS)]
    return tuple(map(tuple, sections)), tuple(tuple(group.values()) or None for group in sections)


def _stored(x: Any) -> Any:
    return number(x) if isinstance(x, np.ndarray) else x


def _entries(section: str, group: Mapping[str, Any] | Sequence[Any] | None) -> list[SceneEntry]:
    """Return the entries of a section, given as a mapping from names or as a list; elements of a list are named slide1, ..."""
    cls = (DRAWING_SECTIONS | MECHANISM_SECTIONS)[section]
    if isinstance(group, Mapping):
        items = list(group.items())
    elif section == "force":
        items = list(zip(name_elements(group or []), group or [], strict=True))
    else:
        items = [(f"{section}{k + 1}", item) for k, item in enumerate(group or [])]
    entries = []
    for k, (name, item) in enumerate(items):
        if isinstance(item, cls):
            entries.append(SceneEntry(section, k, name, type(item), table_of(item), element=item))
        elif isinstance(item, Mapping) and section in DRAWING_SECTIONS:
            entries.append(SceneEntry(section, k, name, cls, item))
        else:
            kinds = "a table or of class" if section in DRAWING_SECTIONS else "of class"
            problem = f"{where(section, k, name)}: must be {kinds} {cls.__name__}, not a {type(item).__name__}"
            if section == "driver" and isinstance(item, Mapping):
                problem += "; tables of motors belong to `motors`"
            entries.append(SceneEntry(section, k, name, None, {}, problem))
    return entries
