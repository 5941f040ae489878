"""A mechanism: the checked pytree of everything that exists in a scene, with named access to every number."""

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

from udkjax.annotations import NumberLike, Numbers
from udkjax.arrays import is_traced, make_module, number
from udkjax.printing import PrintedTable, PrintsTable
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.bodies import Body
from udkjax.scene.checks import SceneError
from udkjax.scene.description import mechanism_table
from udkjax.scene.direct_changes import count_marks, directly_changed, mark_changes, marks_by_name
from udkjax.scene.drivers import Driver
from udkjax.scene.element_setup import attached_bodies, check_elements, complete, completion_mistakes, name_elements
from udkjax.scene.forces import ForceElement, Friction
from udkjax.scene.held import Held, row_at, row_size, sampled_fields, with_row
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
    """The concrete mechanism from which one with traced numbers was made. It is hashable, and compares by value."""

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
    """The source of a mechanism, whose numbers (pins, widths, densities) determine those of the bodies."""

    @property
    @abstractmethod
    def groups(self) -> Mapping[str, Mapping[str, eqx.Module]]:
        """The elements that hold the drawing's numbers, by section and name."""

    @abstractmethod
    def with_groups(self, groups: Mapping[str, Mapping[str, Any]], gravity: Array) -> "AbstractDrawing":
        """Return the drawing with other numbers in its elements; raise a `SceneError` if they are not valid."""

    @abstractmethod
    def locate_pin(self, name: str) -> tuple[str, Array] | None:
        """Return a body (or the ground) at a pin and the pin's position in the body's frame (m); None for an unknown pin."""

    @abstractmethod
    def shapes(self) -> dict[str, Array]:
        """Return the points (n, 2) through which each body is drawn, in the frame of the body (m), by name."""

    @property
    @abstractmethod
    def polygons(self) -> list[str]:
        """The bodies that are polygons with these points, in order, as corners."""

    @abstractmethod
    def free_pins(self) -> dict[str, tuple[str, Array]]:
        """Return the pins that belong to a single body: the body, and the position in its frame (m)."""

    @abstractmethod
    def mechanism(self) -> "Mechanism":
        """Return the mechanism of the drawing."""


class Mechanism(PrintsTable):
    """Bodies, joints, drivers and force elements by name, and gravity.

    It is only data; `udkjax.analyse` finds its properties, such as redundant rows. All numbers are leaves of the pytree; names,
    topology and types are static. The user's order is kept: `constraints` are the joints in their order, then the drivers.
    `forces` may be a list: unnamed elements are numbered by type, TYPE1, TYPE2, ... Numbers that a joint leaves to the initial
    guess are filled in here.

    Raises a `SceneError` that lists all mistakes. For traced numbers only shapes are checked.

    Args:
        bodies: a `Body` by name.
        joints: a joint by name.
        drivers: a `Driver` by name.
        forces: a force element by name, or a list of them.
        gravity: in m/s^2.
        name: of the mechanism, for titles and files.
        origin: for internal use: the concrete mechanism from which one with traced numbers was made.
        drawing: the `Drawing` from which it is made, if any.
        changed: for internal use: 1 for each entry of a number that no longer follows from the drawing, 0 for other entries.
    """

    name: str = eqx.field(static=True)
    gravity: Float[Array, "2"]  # m/s^2
    body_names: tuple[str, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    driver_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)
    origin: Origin | None = eqx.field(static=True)  # the mechanism from which one with traced numbers was made
    # JAX sorts the keys of a dict: tuples keep the user's order.
    _bodies: tuple[Body, ...]
    _joints: tuple[Joint, ...]
    _drivers: tuple[Driver, ...]
    _forces: tuple[ForceElement, ...]
    drawing: AbstractDrawing | None = None
    # In a drawn mechanism: 1 for each entry of a number that was changed directly, 0 if it follows from the drawing. These
    # marks are numbers, so that mechanisms with and without changes have the same structure and share programs.
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
        checked = check_elements(given, gravity, name)
        self.name, self.gravity = name, number(gravity)
        self.body_names, self._bodies = _unzip(checked["body"])
        known = dict(checked["body"])
        completed = {section: [(key, complete(c, known)) for key, c in checked[section]] for section in ("joint", "driver")}
        if mistakes := completion_mistakes(checked, completed):
            raise SceneError(mistakes, name)
        self.joint_names, self._joints = _unzip(completed["joint"])
        self.driver_names, self._drivers = _unzip(completed["driver"])
        self.force_names, self._forces = _unzip(checked["force"])
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
        """The joints by name, each with the attributes of its class."""
        return _by_name(self.joint_names, self._joints)

    @property
    def drivers(self) -> Mapping[str, Driver]:
        """The drivers by name."""
        return _by_name(self.driver_names, self._drivers)

    @property
    def forces(self) -> Mapping[str, Any]:
        """The force elements by name, each with the attributes of its class."""
        return _by_name(self.force_names, self._forces)

    @property
    def constraints(self) -> Mapping[str, Constraint]:
        """Joints, then drivers, by name: the order of the rows of Psi."""
        return _by_name(self.joint_names + self.driver_names, self._joints + self._drivers)

    def frames_of(self, element: Constraint | ForceElement) -> tuple[str, ...]:
        """Return the names of the bodies whose frames an element needs, in order."""
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
        """The times (s) where the motion is not smooth, collected from the elements, unsorted; None if the motion is smooth."""
        named = [number(e.breakpoints).reshape(-1) for e in (*self.constraints.values(), *self._forces) if len(e.breakpoints)]
        sample_times = [x.breakpoints for x in self.samples.values() if isinstance(x, Held)]
        if any(map(len, sample_times)):
            named.append(number(np.unique(np.concatenate(sample_times))))
        if not named:
            return None
        concrete = not is_traced(named)  # the times stay concrete even while something else is traced
        return number(np.concatenate(named)) if concrete else jnp.concatenate(named)

    @property
    def samples(self) -> dict[tuple[str, int, str], Any]:
        """The sampled numbers, each a `Held` or a `Spline`, by section, index and field."""
        sections = {"_drivers": self._drivers, "_forces": self._forces}
        locations = [(section, *location) for section, elements in sections.items() for location in sampled_fields(elements)]
        return {location: getattr(sections[location[0]][location[1]], location[2]) for location in locations}

    def with_samples(self, samples: Mapping[tuple[str, int, str], Any]) -> "Mechanism":
        """Return the mechanism with other values of `samples`, without checks."""
        if not samples:
            return self
        changed = {section: list(getattr(self, section)) for section in ("_drivers", "_forces")}
        for (section, k, name), value in samples.items():
            changed[section][k] = _copy(changed[section][k], {name: value})
        return _copy(self, {section: tuple(elements) for section, elements in changed.items()})

    @property
    def without_samples(self) -> "Mechanism":
        """The mechanism from which programs are made: its samples are a single interval of zeros."""
        return self.with_samples({location: with_row(x, np.zeros(row_size(x))) for location, x in self.samples.items()})

    def at(self, t: NumberLike) -> "Mechanism":
        """Return the mechanism with the samples of a single interval, the one at time t (s)."""
        samples = self.samples
        traced = is_traced((t, samples))
        xp, eager = (jnp, nullcontext()) if traced else (np, jax.ensure_compile_time_eval())
        with eager, np.errstate(all="ignore"):
            return self.with_samples({location: with_row(x, row_at(x, t, xp)) for location, x in samples.items()})

    @property
    def without_origin(self) -> "Mechanism":
        """The mechanism without `origin` and `drawing`: one program serves all mechanisms that agree apart from these."""
        if self.origin is None and self.drawing is None:
            return self
        return _copy(self, {"origin": None, "drawing": None, "changed": None})

    @property
    def is_concrete(self) -> bool:
        """True if no number is traced."""
        return _is_concrete(self)

    @property
    def numbers(self) -> list[Array]:
        """All numbers of the equations, in the order of the arguments of programs: the leaves without those of the drawing."""
        return jax.tree.leaves((self.gravity, self._bodies, self._joints, self._drivers, self._forces))

    @property
    def elements(self) -> tuple[Any, ...]:
        """All bodies, joints, drivers and force elements."""
        return self._bodies + self._joints + self._drivers + self._forces

    def _table(self) -> PrintedTable:
        return mechanism_table(self, self.frames_of)

    _shapes = _table  # the table marks traced numbers

    def parameters(self) -> dict[str, Array]:
        """Return all numbers of the scene by name, such as `body.link1.mass`, except absent ones, such as an optional damping."""
        return {name: p.value for name, p in parameters_of(self).items() if p.value is not None}

    def with_parameters(self, values: Mapping[str, Numbers | Held]) -> "Mechanism":
        """Return the mechanism with new values of some numbers. The function is pure, and values may be traced.

        `values` maps names as in `parameters`, or names of entries (`joint.A.points[1][0]`), to values of exactly the same shape:
        use `vmap` for a batch of values. Absent numbers may be set. A number that may be sampled may be given as a `Held`. A
        mechanism with traced values remembers the concrete one that it was made from (`origin`), whose analysis it uses. Numbers
        that a joint has taken from the initial guess do not change, except the constants of gears and racks.

        Numbers of a drawing (`pin.A`, `link.crank.width`) change everything that follows from them. A number that follows from
        the drawing (`body.crank.mass`) may be changed as well, and keeps its value when the drawing changes. Raises `SceneError`.
        """
        require_values(values, self.name)
        traced = is_traced(dict(values))
        origin = Origin(self) if traced and self.is_concrete else self.origin
        base, new_values, changed = self, values, None
        if self.drawing is not None:
            base, new_values, direct = self._redraw(self.drawing, values)
        new, gravity = replace_numbers(groups_of(base), base.gravity, new_values, parameters_of(base), self.name)
        if self.drawing is not None:
            changed = mark_changes(self, new, direct)
        elements = new["body"], new["joint"], new["driver"], new["force"]
        return Mechanism(*elements, gravity, self.name, origin, base.drawing, changed)

    @property
    def departs_from_drawing(self) -> bool:
        """True if a number no longer follows from the drawing, or if the marks are traced."""
        return self.changed is not None and (is_traced(self.changed) or bool(np.any(np.asarray(self.changed))))

    @property
    def changed_names(self) -> list[str]:
        """Names of the concrete numbers with an entry that no longer follows from the drawing."""
        return [name for name, mark in marks_by_name(self).items() if np.any(np.asarray(mark))]

    def _redraw(self, drawing: AbstractDrawing, values: Mapping[str, Any]) -> tuple[Any, dict[str, Any], list[str]]:
        """Return the redrawn mechanism, its directly changed numbers, and the names of those that are changed now."""
        drawn, known = parameters_in(drawing.groups), parameters_of(self)
        of_drawing = {name: value for name, value in values.items() if split_index(name, known)[0] in (*drawn, "gravity")}
        new_values = {name: value for name, value in values.items() if name not in of_drawing}
        if not of_drawing:
            return self, new_values, list(new_values)
        replace_numbers(groups_of(self), self.gravity, new_values, known, self.name)  # raises an error if names are wrong
        drawn["gravity"] = known["gravity"]
        groups, gravity = replace_numbers(drawing.groups, self.gravity, of_drawing, drawn, self.name)
        redrawn = drawing.with_groups(groups, gravity).mechanism()
        return redrawn, directly_changed(self, redrawn) | new_values, list(new_values)


def _coordinates(vectors: Sequence[Array], numbers: Sequence[Array]) -> Float[Array, "bodies 3"]:
    concrete = not is_traced((vectors, numbers))  # NumPy is faster for many small arrays
    if concrete:
        return number(np.column_stack([np.stack([np.asarray(x) for x in vectors]), [np.asarray(x) for x in numbers]]))
    return jnp.column_stack([jnp.stack(vectors), jnp.stack(numbers)])


def _copy(module: Module, changes: dict[str, object]) -> Module:
    """Return a module with other values in some fields, without checks."""
    return make_module(type(module), **vars(module) | changes)


def _unzip(items: Sequence[tuple[str, Element]]) -> tuple[tuple[str, ...], tuple[Element, ...]]:
    return tuple(key for key, _ in items), tuple(element for _, element in items)


def _by_name(names: tuple[str, ...], elements: tuple[Element, ...]) -> Mapping[str, Element]:
    return MappingProxyType(dict(zip(names, elements, strict=True)))


@cached_by_identity
def _is_concrete(mechanism: Mechanism) -> bool:
    return not is_traced(mechanism)
