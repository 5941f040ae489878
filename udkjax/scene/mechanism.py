"""A mechanism: the pytree of everything that exists in a scene, checked, with named access to every number."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from types import MappingProxyType
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Scalar
from udkjax.printing import PrintedTable, PrintsTable
from udkjax.scene.bodies import Body
from udkjax.scene.changes_by_hand import changed_by_hand, count_marks, mark_changes, marks_by_name
from udkjax.scene.checks import SceneError
from udkjax.scene.description import mechanism_table
from udkjax.scene.drivers import Driver
from udkjax.scene.fields import Numbers, is_traced, make_module, number
from udkjax.scene.forces import ForceElement, Friction
from udkjax.scene.given_elements import attached_bodies, check_elements, complete, completion_mistakes, name_elements
from udkjax.scene.held import Held, row_at, row_size, sampled_fields, with_row
from udkjax.scene.identity_cache import cached_by_identity
from udkjax.scene.joints import Constraint, Joint
from udkjax.scene.number_fields import (
    groups_of,
    parameters_in,
    parameters_of,
    replace_numbers,
    require_values,
    split_index,
)

Element = TypeVar("Element", bound=eqx.Module)
Module = TypeVar("Module", bound=eqx.Module)


class Origin:
    """The concrete mechanism that one with traced numbers was made from. It is hashable, and equal where its numbers are."""

    def __init__(self, mechanism: "Mechanism"):
        self.mechanism = mechanism
        leaves, structure = jax.tree.flatten(mechanism)
        self._key = structure, tuple(np.asarray(leaf).tobytes() for leaf in leaves)
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Origin) and self._key == other._key)


class AbstractDrawing(PrintsTable):
    """Source that a mechanism was made from, whose own numbers decide on those of the bodies: pins, widths, densities."""

    @property
    @abstractmethod
    def groups(self) -> Mapping[str, Mapping[str, eqx.Module]]:
        """The elements that hold the drawing's numbers, by section and name."""

    @abstractmethod
    def with_groups(self, groups: Mapping[str, Mapping[str, Any]], gravity: Array) -> "AbstractDrawing":
        """Return the drawing with other numbers in its elements; raise `SceneError` where they make no mechanism."""

    @abstractmethod
    def locate_pin(self, name: str) -> tuple[str, Array] | None:
        """Return a body, or the ground, and the point in its frame (m) where a pin is; None where there is no such pin."""

    @abstractmethod
    def shapes(self) -> dict[str, Array]:
        """Return the points (n, 2) through which bodies are drawn, by name, in their own frames (m)."""

    @property
    @abstractmethod
    def polygons(self) -> list[str]:
        """The bodies whose shape is the polygon of these points, as corners in their order."""

    @abstractmethod
    def free_pins(self) -> dict[str, tuple[str, Array]]:
        """Return the pins that belong to one body alone: the body of each, and its place in the body's frame (m)."""

    @abstractmethod
    def mechanism(self) -> "Mechanism":
        """Return the mechanism that is drawn."""


class Mechanism(PrintsTable):
    """Bodies, joints, drivers and force elements, each under its name, and gravity.

    Data alone: `udkjax.analyse` finds what follows from it, such as redundant rows. A pytree whose leaves
    are all of its numbers; names, topology and types are static. Names, orders and rows are the user's: `constraints` are the
    joints in their order, then the drivers. `forces` may be a list: an element without a name is called TYPE1, TYPE2, ... by its
    place among those of its type. Numbers that a joint leaves to the initial guess are filled in here.

    Raises `SceneError`, which lists every mistake. Numbers that are traced are not looked at; their shapes are.

    Args:
        bodies: a `Body` by name.
        joints: a joint by name.
        drivers: a `Driver` by name.
        forces: a force element by name, or a list of them.
        gravity: in m/s^2.
        name: of the mechanism, for titles and files.
        origin: for internal use: the known mechanism that traced numbers stand for.
        drawing: the `Drawing` that it is made from, if any.
        changed: for internal use: one for each entry of a number that does not follow from the drawing any more, zero for others.
    """

    name: str = eqx.field(static=True)
    gravity: Float[Array, "2"]  # m/s^2
    body_names: tuple[str, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    driver_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)
    origin: Origin | None = eqx.field(static=True)  # of traced numbers: the concrete ones that they stand for
    # JAX sorts the keys of a dict: tuples keep the user's order.
    _bodies: tuple[Body, ...]
    _joints: tuple[Joint, ...]
    _drivers: tuple[Driver, ...]
    _forces: tuple[ForceElement, ...]
    drawing: AbstractDrawing | None = None  # the drawing that it was made from
    # Of a drawn one: one for each entry of a number of the elements that was changed by hand, zero where it follows from the
    # drawing. A number itself, so that what was changed and what was not are of one structure: one program serves both.
    changed: Float[Array, "K"] | None = None

    def __init__(
        self,
        bodies: Mapping[str, Body],
        joints: Mapping[str, Joint] | None = None,
        drivers: Mapping[str, Driver] | None = None,
        forces: Mapping[str, ForceElement] | Sequence[ForceElement] | None = None,
        gravity: Numbers = (0.0, -9.81),
        name: str = "",
        origin: Origin | None = None,
        drawing: AbstractDrawing | None = None,
        changed: Float[Array, "K"] | None = None,
    ):
        forces = forces or {}
        given = {
            "body": list(bodies.items()),
            "joint": list((joints or {}).items()),
            "driver": list((drivers or {}).items()),
            "force": list(forces.items() if isinstance(forces, Mapping) else zip(name_elements(forces), forces, strict=True)),
        }
        found = check_elements(given, gravity, name)
        self.name, self.gravity = name, number(gravity)
        self.body_names, self._bodies = _unzip(found["body"])
        known = dict(found["body"])
        completed = {section: [(key, complete(c, known)) for key, c in found[section]] for section in ("joint", "driver")}
        if mistakes := completion_mistakes(found, completed):
            raise SceneError(mistakes, name)
        self.joint_names, self._joints = _unzip(completed["joint"])
        self.driver_names, self._drivers = _unzip(completed["driver"])
        self.force_names, self._forces = _unzip(found["force"])
        self.origin = None if self.is_concrete else origin
        self.drawing, self.changed = drawing, changed
        if drawing is not None and changed is None:
            self.changed = number(np.zeros(count_marks(self)))

    @property
    def bodies(self) -> Mapping[str, Body]:
        """The bodies by name."""
        return _by_name(self.body_names, self._bodies)

    @property
    def joints(self) -> Mapping[str, Any]:
        """The joints by name, each with the attributes of its own class."""
        return _by_name(self.joint_names, self._joints)

    @property
    def drivers(self) -> Mapping[str, Driver]:
        """The drivers by name."""
        return _by_name(self.driver_names, self._drivers)

    @property
    def forces(self) -> Mapping[str, Any]:
        """The force elements by name, each with the attributes of its own class."""
        return _by_name(self.force_names, self._forces)

    @property
    def constraints(self) -> Mapping[str, Constraint]:
        """Joints, then drivers, by name: the order of the rows of Psi."""
        return _by_name(self.joint_names + self.driver_names, self._joints + self._drivers)

    def frames_of(self, element: Constraint | ForceElement) -> tuple[str, ...]:
        """Return the names of the bodies whose frames an element gets, in that order."""
        return attached_bodies(element, self.joints if isinstance(element, Friction) else {})

    @property
    def q0(self) -> Float[Array, "bodies 3"]:
        """The initial guess of the coordinates: x, y (m) and angle (rad) of each body."""
        return _coordinates([body.position for body in self._bodies], [body.angle for body in self._bodies])

    @property
    def v0(self) -> Float[Array, "bodies 3"]:
        """The initial guess of the velocities (m/s, rad/s)."""
        return _coordinates([body.velocity for body in self._bodies], [body.angular_velocity for body in self._bodies])

    @property
    def breakpoints(self) -> Float[Array, "k"] | None:
        """The times (s) where the motion is not smooth, as the elements name them, in any order; None where none does."""
        named = [number(e.breakpoints).reshape(-1) for e in (*self.constraints.values(), *self._forces) if len(e.breakpoints)]
        held = [x.breakpoints for x in self.samples.values() if isinstance(x, Held)]
        if any(map(len, held)):
            named.append(number(np.unique(np.concatenate(held))))
        if not named:
            return None
        known = not is_traced(named)  # and stays so while something else is traced
        return number(np.concatenate(named)) if known else jnp.concatenate(named)

    @property
    def samples(self) -> dict[tuple[str, int, str], Any]:
        """The numbers that have samples, each a `Held` or a `Spline`, by the place of its element and its field."""
        sections = {"_drivers": self._drivers, "_forces": self._forces}
        places = [(section, *place) for section, elements in sections.items() for place in sampled_fields(elements)]
        return {place: getattr(sections[place[0]][place[1]], place[2]) for place in places}

    def with_samples(self, samples: Mapping[tuple[str, int, str], Any]) -> "Mechanism":
        """Return the mechanism with something else in the places of `samples`; nothing is checked."""
        if not samples:
            return self
        changed = {section: list(getattr(self, section)) for section in ("_drivers", "_forces")}
        for (section, k, name), value in samples.items():
            changed[section][k] = _copy(changed[section][k], {name: value})
        return _copy(self, {section: tuple(elements) for section, elements in changed.items()})

    @property
    def without_samples(self) -> "Mechanism":
        """The mechanism that programs are made of: with one interval, of numbers zero, in place of all that has samples."""
        return self.with_samples({place: with_row(x, np.zeros(row_size(x))) for place, x in self.samples.items()})

    def at(self, t: Scalar) -> "Mechanism":
        """Return the mechanism with one interval, that at time t (s), in place of all that has samples."""
        samples = self.samples
        traced = is_traced((t, samples))
        xp, eager = (jnp, nullcontext()) if traced else (np, jax.ensure_compile_time_eval())
        with eager, np.errstate(all="ignore"):
            return self.with_samples({place: with_row(x, row_at(x, t, xp)) for place, x in samples.items()})

    @property
    def without_origin(self) -> "Mechanism":
        """The same mechanism without its `origin` and its `drawing`: a program compiled for it serves all of them."""
        if self.origin is None and self.drawing is None:
            return self
        return _copy(self, {"origin": None, "drawing": None, "changed": None})

    @property
    def is_concrete(self) -> bool:
        """True if no number is traced."""
        return _is_concrete(self)

    @property
    def numbers(self) -> list[Array]:
        """All numbers of the equations, in the order in which programs take them: leaves without those of the drawing."""
        return jax.tree.leaves((self.gravity, self._bodies, self._joints, self._drivers, self._forces))

    @property
    def elements(self) -> tuple[Any, ...]:
        """All bodies, joints, drivers and force elements."""
        return self._bodies + self._joints + self._drivers + self._forces

    def _table(self) -> PrintedTable:
        return mechanism_table(self, self.frames_of)

    _shapes = _table  # traced numbers are named as such, element by element

    def parameters(self) -> dict[str, Array]:
        """Return every number of the scene under its name, such as `body.link1.mass`; absent ones (a damping) are left out."""
        return {name: p.value for name, p in parameters_of(self).items() if p.value is not None}

    def with_parameters(self, values: Mapping[str, Numbers | Held]) -> "Mechanism":
        """Return the mechanism with some of its numbers replaced; pure, and values may be traced.

        `values` maps names as in `parameters`, or those of one entry (`joint.A.points[1][0]`), to values of exactly the same
        shape: a batch of values belongs inside `vmap`. A number that may have samples may be given as a `Held`. A mechanism with
        traced values remembers the known numbers that it was made from (`origin`), so that their analysis serves it. A number
        that was absent is then there. Numbers that a joint once took from the initial guess stay as they are; the constants of
        gears and racks follow the guess.

        Numbers of a drawing (`pin.A`, `link.crank.width`) change all that follows from them. A number that follows from the
        drawing (`body.crank.mass`) may be changed as well, and keeps its value when the drawing changes. Raises `SceneError`.
        """
        require_values(values, self.name)
        traced = is_traced(dict(values))
        origin = Origin(self) if traced and self.is_concrete else self.origin
        base, own, changed = self, values, None
        if self.drawing is not None:
            base, own, by_hand = self._redraw(self.drawing, values)
        new, gravity = replace_numbers(groups_of(base), base.gravity, own, parameters_of(base), self.name)
        if self.drawing is not None:
            changed = mark_changes(self, new, by_hand)
        elements = new["body"], new["joint"], new["driver"], new["force"]
        return Mechanism(*elements, gravity, self.name, origin, base.drawing, changed)

    @property
    def departs_from_drawing(self) -> bool:
        """True if a number does not follow from the drawing any more, or may not, as numbers are traced."""
        return self.changed is not None and (is_traced(self.changed) or bool(np.any(np.asarray(self.changed))))

    @property
    def changed_names(self) -> list[str]:
        """Names of known numbers of which an entry does not follow from the drawing any more."""
        return [name for name, mark in marks_by_name(self).items() if np.any(np.asarray(mark))]

    def _redraw(self, drawing: AbstractDrawing, values: Mapping[str, Any]) -> tuple[Any, dict[str, Any], list[str]]:
        """Return the mechanism of the drawing with its share of the values, the other values, and the names of those by hand."""
        drawn, known = parameters_in(drawing.groups), parameters_of(self)
        of_drawing = {name: value for name, value in values.items() if split_index(name, known)[0] in (*drawn, "gravity")}
        own = {name: value for name, value in values.items() if name not in of_drawing}
        if not of_drawing:
            return self, own, list(own)
        replace_numbers(groups_of(self), self.gravity, own, known, self.name)  # all mistakes in names before anything else
        drawn["gravity"] = known["gravity"]
        groups, gravity = replace_numbers(drawing.groups, self.gravity, of_drawing, drawn, self.name)
        redrawn = drawing.with_groups(groups, gravity).mechanism()
        return redrawn, changed_by_hand(self, redrawn) | own, list(own)


def _coordinates(vectors: Sequence[Array], numbers: Sequence[Array]) -> Float[Array, "bodies 3"]:
    known = not is_traced((vectors, numbers))  # by NumPy: jnp takes its time for each array
    if known:
        return number(np.column_stack([np.stack([np.asarray(x) for x in vectors]), [np.asarray(x) for x in numbers]]))
    return jnp.column_stack([jnp.stack(vectors), jnp.stack(numbers)])


def _copy(module: Module, changes: dict[str, object]) -> Module:
    """Return a module with other values in some fields, without checking anything."""
    return make_module(type(module), **vars(module) | changes)


def _unzip(items: Sequence[tuple[str, Element]]) -> tuple[tuple[str, ...], tuple[Element, ...]]:
    return tuple(key for key, _ in items), tuple(element for _, element in items)


def _by_name(names: tuple[str, ...], elements: tuple[Element, ...]) -> Mapping[str, Element]:
    return MappingProxyType(dict(zip(names, elements, strict=True)))


@cached_by_identity
def _is_concrete(mechanism: Mechanism) -> bool:
    return not is_traced(mechanism)
