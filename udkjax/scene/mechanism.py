"""A mechanism: the checked pytree of everything that exists in a scene, with named access to every number."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar
from weakref import WeakValueDictionary

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import NumberLike, Numbers, NumericArray
from udkjax.arrays import is_traced, is_within_jit, make_module, number, without_derivatives
from udkjax.printing import PrintedTable, PrintsTable
from udkjax.programs.control_flow import ConvertsItself
from udkjax.programs.identity_cache import cached_by_identity, is_concrete
from udkjax.scene.elements.bodies import Body, stack_coordinates
from udkjax.scene.elements.drivers import Driver
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.held import Held, row_at, row_size, sampled_fields, with_row
from udkjax.scene.elements.joints import Constraint, Joint
from udkjax.scene.model import Model
from udkjax.scene.numbers.description import mechanism_table
from udkjax.scene.numbers.direct_numbers import DirectNumbers
from udkjax.scene.numbers.mechanism_fields import fields_of
from udkjax.scene.numbers.named_numbers import formula_mistakes, independent
from udkjax.scene.numbers.number_fields import (
    SECTIONS,
    ElementGroups,
    NumberField,
    parameters_in,
    parameters_of,
    parameters_of_drawing,
    replace_numbers,
    require_values,
    split_index,
)
from udkjax.scene.numbers.origin import Origin
from udkjax.scene.numbers.sources import AbstractDrawing, Drawn, Elements, Source, elements_of, names_of
from udkjax.scene.tables.checks import SceneError, gravity_mistakes, numbers_are_valid
from udkjax.scene.tables.element_setup import (
    Groups,
    attached_bodies,
    check_elements,
    complete,
    completion_mistakes,
    name_elements,
    replaced,
)

Element = TypeVar("Element", bound=eqx.Module)
Module = TypeVar("Module", bound=eqx.Module)


class Mechanism(PrintsTable, Model, ConvertsItself):
    """Bodies, joints, drivers and force elements by name, and gravity.

    A mechanism is only data; `udkjax.analyse` finds its properties, such as redundant rows. All independent numbers are leaves of
    the pytree, and others are computed from them at use; names, topology and types are static. The user's order is kept:
    `constraints` are the joints in their order, then the drivers. `forces` may be a list: unnamed elements are numbered by type,
    TYPE1, TYPE2, ... Numbers that a joint leaves to the initial guess are filled in here.

    Raises a `SceneError` that lists all mistakes. For traced numbers only shapes are checked.

    Args:
        bodies: a `Body` by name.
        joints: a joint by name.
        drivers: a `Driver` by name.
        forces: a force element by name, or a list of them.
        gravity: the acceleration of gravity (m/s^2).
        name: name of the mechanism, for titles and files.
        origin: for internal use: the concrete mechanism from which one with traced numbers was made.
    """

    has_bodies: ClassVar[bool] = True

    name: str = eqx.field(static=True)
    body_names: tuple[str, ...] = eqx.field(static=True)  # pyright: ignore[reportIncompatibleVariableOverride]
    joint_names: tuple[str, ...] = eqx.field(static=True)
    driver_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)
    origin: Origin | None = eqx.field(static=True)  # the mechanism from which one with traced numbers was made
    _source: Source  # the independent numbers

    def __init__(
        self,
        bodies: Mapping[str, Body],
        joints: Mapping[str, Joint] | None = None,
        drivers: Mapping[str, Driver] | None = None,
        forces: Mapping[str, ForceElement] | Sequence[ForceElement] | None = None,
        gravity: Numbers = (0.0, -9.81),
        name: str = "",
        origin: Origin | None = None,
    ):
        forces = forces or {}
        given = {
            "body": list(bodies.items()),
            "joint": list((joints or {}).items()),
            "driver": list((drivers or {}).items()),
            "force": list(forces.items() if isinstance(forces, Mapping) else zip(name_elements(forces), forces, strict=True)),
        }
        checked = check_elements(given, gravity, name)
        known = dict(checked["body"])
        completed = {section: [(key, complete(c, known)) for key, c in checked[section]] for section in ("joint", "driver")}
        if mistakes := completion_mistakes(checked, completed):
            raise SceneError(mistakes, name)
        for field, value in fields_of(checked | completed, number(gravity), name, origin).items():
            setattr(self, field, value)
        _checked(self)

    def with_drivers(self, drivers: Mapping[str, Driver], origin: Origin | None = None) -> "Mechanism":
        """For internal use: return the mechanism with other drivers, from which no number is missing; nothing is checked."""
        sections = {section: list(group.items()) for section, group in (self.groups | {"driver": drivers}).items()}
        found = make_module(type(self), **fields_of(sections, self.gravity, self.name, origin))
        return found if drivers or not _is_checked(self) else _checked(found)

    def without_joints(self, names: Sequence[str]) -> "Mechanism":
        """For internal use: return the mechanism without some joints; nothing is checked."""
        if not names:
            return self
        sections = {section: list(group.items()) for section, group in self.groups.items()}
        sections["joint"] = [(name, joint) for name, joint in sections["joint"] if name not in names]
        return make_module(type(self), **fields_of(sections, self.gravity, self.name, None))

    @classmethod
    def of_drawing(cls, source: Drawn, name: str, origin: Origin | None = None) -> "Mechanism":
        """Return the mechanism of a drawing; raise a `SceneError` that lists all mistakes of its elements."""
        names, held = names_of(source), source.drawing.groups
        found = {section: list(group.items()) for section, group in source.elements.groups(names).items()}
        # Elements that a drawing holds are checked as given, before numbers were taken from the initial guess.
        given = {section: [(key, held[section].get(key, x)) for key, x in items] for section, items in found.items()}
        try:
            check_elements(given, source.gravity, name)
        except SceneError as error:
            raise SceneError([source.drawing.explain(problem) for problem in error.problems], name) from None
        if mistakes := completion_mistakes(given, {section: found[section] for section in ("joint", "driver")}):
            raise SceneError(mistakes, name)
        static = dict(zip((f"{section}_names" for section in SECTIONS), names, strict=True))
        return _checked(make_module(cls, name=name, **static, origin=None if is_concrete(source) else origin, _source=source))

    @property
    def gravity(self) -> Float[Array, "2"]:
        """The acceleration of gravity (m/s^2)."""
        return self._source.gravity

    @property
    def drawing(self) -> AbstractDrawing | None:
        """The `Drawing` from which the mechanism was made: pins and links, whose numbers are its leaves; None without one."""
        return self._source.drawing if isinstance(self._source, Drawn) else None

    @property
    def massless(self) -> tuple[str, ...]:
        """The names of the links of a drawing for which no mass is given, neither in the drawing nor directly."""
        source = self._source
        if not isinstance(source, Drawn) or not source.drawing.massless:
            return ()
        return tuple(name for name in source.drawing.massless if f"body.{name}.mass" not in self.direct)

    @property
    def direct(self) -> Mapping[str, Any]:
        """The numbers of a drawn mechanism that were given directly and no longer follow from its drawing, by name."""
        direct = self._source.direct if isinstance(self._source, Drawn) else None
        return MappingProxyType({} if direct is None else direct.by_name)

    @property
    def groups(self) -> ElementGroups:
        """The elements by section (body, joint, driver, force) and name."""
        return self._source.elements.groups(self._names)

    @property
    def _names(self) -> tuple[tuple[str, ...], ...]:
        return self.body_names, self.joint_names, self.driver_names, self.force_names

    @property
    def _bodies(self) -> tuple[Body, ...]:
        return self._source.elements.bodies or ()

    @property
    def _joints(self) -> tuple[Joint, ...]:
        return self._source.elements.joints or ()

    @property
    def _drivers(self) -> tuple[Driver, ...]:
        return self._source.elements.drivers or ()

    @property
    def _forces(self) -> tuple[ForceElement, ...]:
        return self._source.elements.forces or ()

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
        return stack_coordinates([body.position for body in self._bodies], [body.angle for body in self._bodies])

    @property
    def v0(self) -> Float[Array, "bodies 3"]:
        """The initial guess of the velocities (m/s, rad/s)."""
        return stack_coordinates([body.velocity for body in self._bodies], [body.angular_velocity for body in self._bodies])

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
        """The sampled numbers, each a `Held` or a `Spline`, by place: "_drivers" or "_forces", index of the element, field."""
        sections = {"_drivers": self._drivers, "_forces": self._forces}
        locations = [(section, *location) for section, elements in sections.items() for location in sampled_fields(elements)]
        return {location: getattr(sections[location[0]][location[1]], location[2]) for location in locations}

    def with_samples(self, samples: Mapping[tuple[str, int, str], Any]) -> "Mechanism":
        """Return the mechanism with other sampled numbers, by the keys of `samples`, without checks."""
        if not samples:
            return self
        changed = {section: list(getattr(self, section)) for section in ("_drivers", "_forces")}
        for (section, k, name), value in samples.items():
            changed[section][k] = _copy(changed[section][k], {name: value})
        drivers, forces = (tuple(elements) or None for elements in changed.values())
        return _copy(self, {"_source": _copy(self._source.elements, {"drivers": drivers, "forces": forces})})

    @property
    def without_samples(self) -> "Mechanism":
        """The mechanism from which programs are generated: each sampled number has a single interval, whose numbers are zero."""
        return self.with_samples({location: with_row(x, np.zeros(row_size(x))) for location, x in self.samples.items()})

    def at(self, t: NumberLike) -> "Mechanism":
        """Return the mechanism with only one interval of each sampled number: the one that contains time t (s)."""
        samples = self.samples
        traced = is_traced((t, samples))
        xp, eager = (jnp, nullcontext()) if traced else (np, jax.ensure_compile_time_eval())
        with eager, np.errstate(all="ignore"):
            return self.with_samples({location: with_row(x, row_at(x, t, xp)) for location, x in samples.items()})

    @property
    def without_origin(self) -> "Mechanism":
        """The mechanism of its elements alone, without `origin` and `drawing`; mechanisms with equal elements share programs.

        All numbers of the equations are leaves of it, also those that follow from others.
        """
        return self if type(self._source) is Elements and self.origin is None else _without_origin(self)

    def without_origin_beside(self, names: Sequence[str]) -> "Mechanism":
        """Return the mechanism for programs in which the numbers of these names change: `without_origin`, if that is possible.

        If these numbers determine others, the result keeps the drawing and the initial guess, from which those follow.
        """
        if all(name.startswith("force.") for name in names):  # loads determine nothing else
            drawn = () if self.drawing is None else parameters_of_drawing(self.drawing)
            if not any(split_index(name, parameters_of(self))[0] in drawn for name in names):
                return self.without_origin
        return self if self.origin is None else _copy(self, {"origin": None})

    def know_elements(self, known: "Mechanism") -> None:
        """Store `known` as the result of `without_origin`, so that a program does not compute it again.

        The numbers of `known` must be those of this mechanism.
        """
        elements_of.know(self._source, known._source.elements)
        _without_origin.know(self, known)

    @property
    def is_concrete(self) -> bool:
        """True if no number is traced."""
        return is_concrete(self)

    @property
    def numbers(self) -> list[Array]:
        """All numbers of the equations, in the order of the arguments of programs."""
        return jax.tree.leaves(self._source.elements)

    @property
    def elements(self) -> tuple[Any, ...]:
        """All bodies, joints, drivers and force elements."""
        return self._bodies + self._joints + self._drivers + self._forces

    def _table(self) -> PrintedTable:
        return mechanism_table(self, self.frames_of)

    _shapes = _table  # the table marks traced numbers

    @property
    def coordinate_count(self) -> int:
        return 3 * len(self.body_names)

    @property
    def may_have_kinks(self) -> bool:
        return any(force.may_have_kinks for force in self._forces)

    def state_shape(self, state: object = None) -> tuple[int, ...]:
        return len(self.body_names), 3

    def with_guess(self, q: NumericArray, v: NumericArray) -> "Mechanism":
        values: dict[str, NumericArray] = {}
        for k, body in enumerate(self.body_names):
            values |= {f"body.{body}.position": q[k, :2], f"body.{body}.angle": q[k, 2]}
            values |= {f"body.{body}.velocity": v[k, :2], f"body.{body}.angular_velocity": v[k, 2]}
        return self.with_parameters(values)

    def number_fields(self) -> Mapping[str, NumberField]:
        return parameters_of(self)

    def parameters(self) -> dict[str, Array]:
        """Return all numbers of the scene by name, such as `body.link1.mass`, except absent ones, such as an optional damping.

        Numbers that follow from others, such as the masses of a drawn mechanism, are computed: in a tree of derivatives, as from
        `eqx.filter_grad`, they mean nothing, and `independent_parameters` are the derivatives.
        """
        return super().parameters()

    def independent_parameters(self) -> dict[str, Array]:
        """Return the numbers by name that follow from no others, the leaves of the mechanism: those of a drawing, if it has one.

        Numbers given directly instead of those that follow from the drawing are among them.
        """
        source = self._source
        groups = source.drawing.own_groups if isinstance(source, Drawn) else source.groups(self._names)
        found = {name: p.value for name, p in parameters_in(groups).items() if p.value is not None}
        found = independent(found, source.drawing.formulas) if isinstance(source, Drawn) and source.drawing.formulas else found
        direct = [(f"{key}.values", x.values) if isinstance(x, Held) else (key, x) for key, x in self.direct.items()]
        return {"gravity": self.gravity, **found, **dict(direct)}

    def with_parameters(self, values: Mapping[str, Numbers | Held]) -> "Mechanism":
        """Return the mechanism with new values of some numbers. The function is pure, and values may be traced.

        `values` maps names as in `parameters`, or names of entries (`joint.A.points[1][0]`), to values of exactly the same shape:
        use `vmap` for a batch of values. Absent numbers may be set. A number that may be sampled may be given as a `Held`. A
        mechanism with traced values remembers the concrete one that it was made from (`origin`), whose analysis it uses. Numbers
        that a joint has taken from the initial guess do not change, except the constants of gears and racks.

        Numbers of a drawing (`pin.A`, `link.crank.width`) change everything that follows from them. A number that follows from
        the drawing (`body.crank.mass`) may be given directly: it is a leaf from then on. Raises `SceneError`.
        """
        require_values(values, self.name)
        if is_traced(dict(values)):
            _check_without_derivatives(self, dict(values))
        origin = Origin(self) if is_traced(dict(values)) and self.is_concrete else self.origin
        if isinstance(self._source, Drawn):
            return self._redrawn(self._source, values, origin)
        elements, gravity = replace_numbers(self.groups, self.gravity, values, parameters_of(self), self.name)
        return self.with_elements(elements, gravity, origin)

    def with_elements(self, groups: Groups, gravity: Array | None = None, origin: Origin | None = None) -> "Mechanism":
        """For internal use: return the mechanism of other elements; only those that differ are checked, if this one is valid."""
        gravity = self.gravity if gravity is None else gravity
        valid = self._valid_elements(groups, gravity)
        if valid is None:
            parts = groups["body"], groups["joint"], groups["driver"], groups["force"]
            return Mechanism(*parts, gravity, self.name, origin)
        sections = {section: list(group.items()) for section, group in valid.items()}
        return _checked(make_module(type(self), **fields_of(sections, gravity, self.name, origin)))

    def _valid_elements(self, groups: Groups, gravity: Array) -> Groups | None:
        """Return other elements, with missing numbers filled in, if they are valid because this mechanism is (see `replaced`).

        None if all elements have to be checked.
        """
        if not _is_checked(self) or (gravity is not self.gravity and gravity_mistakes(gravity)):
            return None
        return replaced(self.groups, groups)

    @property
    def departs_from_drawing(self) -> bool:
        """True if a number was given directly and no longer follows from the drawing."""
        return bool(self.direct)

    def _redrawn(self, source: Drawn, values: Mapping[str, Any], origin: Origin | None) -> "Mechanism":
        drawing, known, groups = source.drawing, parameters_of(self), self.groups
        drawn = {**parameters_of_drawing(drawing), "gravity": known["gravity"]}
        of_drawing = {name: value for name, value in values.items() if split_index(name, known)[0] in drawn}
        direct = {name: value for name, value in values.items() if name not in of_drawing}
        elements = groups
        if direct:  # this raises an error if they do not fit
            elements, _ = replace_numbers(groups, self.gravity, direct, known, self.name)
        if of_drawing:
            if mistakes := list(formula_mistakes(of_drawing, drawing.formulas)):
                raise SceneError(mistakes, self.name)
            drawing = drawing.with_groups(*replace_numbers(drawing.own_groups, self.gravity, of_drawing, drawn, self.name))
        changed = Drawn(drawing, DirectNumbers.of(direct, source.direct))
        if of_drawing or self._valid_elements(elements, self.gravity) is None:
            return Mechanism.of_drawing(changed, self.name, origin)
        return _checked(_copy(self, {"_source": changed, "origin": None if is_concrete(changed) else origin}))


# Sources of mechanisms that were checked, by their identities.
_VALID_SOURCES: WeakValueDictionary[int, Source] = WeakValueDictionary()
# Sources of mechanisms that `require_valid_numbers` accepts.
_USABLE_SOURCES: WeakValueDictionary[int, Source] = WeakValueDictionary()


def _checked(mechanism: Mechanism) -> Mechanism:
    """Return a mechanism after noting that all its elements are valid."""
    _VALID_SOURCES[id(mechanism._source)] = mechanism._source
    return mechanism


def _is_checked(mechanism: Mechanism) -> bool:
    return _VALID_SOURCES.get(id(mechanism._source)) is mechanism._source


def require_valid_numbers(mechanism: Mechanism) -> None:
    """Raise a `SceneError` that names concrete numbers without meaning, such as a negative mass.

    Only leaves that an optimizer or `tree_at` changed can be meaningless. This is no method, since binding a method of an
    Equinox module takes longer.
    """
    source = mechanism._source
    if _VALID_SOURCES.get(id(source)) is source or _USABLE_SOURCES.get(id(source)) is source or not is_concrete(mechanism):
        return
    if not numbers_are_valid(mechanism.elements):
        mechanism.with_parameters({})  # raises the error
    _USABLE_SOURCES[id(source)] = source


def _check_without_derivatives(mechanism: Mechanism, values: dict[str, Any]) -> None:
    """Raise the errors that `with_parameters` raises for concrete numbers, if numbers are traced only for derivatives."""
    if is_within_jit():
        return
    known, plain = without_derivatives(values), mechanism
    if not mechanism.is_concrete:
        plain = without_derivatives(mechanism)
        plain = _checked(plain) if _is_checked(mechanism) else plain
    if plain.is_concrete and not is_traced(known):
        plain.with_parameters(known)


def _copy(module: Module, changes: dict[str, object]) -> Module:
    """Return a module with other values in some fields, without checks."""
    return make_module(type(module), **vars(module) | changes)


def _by_name(names: tuple[str, ...], elements: tuple[Element, ...]) -> Mapping[str, Element]:
    return MappingProxyType(dict(zip(names, elements, strict=True)))


@cached_by_identity(within_trace=True)
def _without_origin(mechanism: Mechanism) -> Mechanism:
    found = _copy(mechanism, {"origin": None, "_source": mechanism._source.elements})
    return _checked(found) if _is_checked(mechanism) else found
