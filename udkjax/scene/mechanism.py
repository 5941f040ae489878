"""A mechanism: the pytree of everything that exists in a scene, checked, with named access to every number."""

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.scene.bodies import GROUND, Body, Frame
from udkjax.scene.checks import Entry, SceneError, not_numbers, problems_of, quoted, shown, suggestion
from udkjax.scene.drivers import Driver
from udkjax.scene.fields import Numbers, number
from udkjax.scene.forces import ForceElement, Friction
from udkjax.scene.joints import Constraint, Joint
from udkjax.scene.schema import numbers_in, table_of, type_name

Element = TypeVar("Element", bound=eqx.Module)
_FIXED = Frame(0.0, 0.0, 0.0, 1.0, 0.0)


class Mechanism(eqx.Module):
    """Bodies, joints, drivers and force elements, each under its name, and gravity.

    A pytree whose leaves are all of its numbers; names, topology and types are static. Names, orders and rows are the user's:
    `constraints` are the joints in their order, then the drivers. `forces` may be a list: an element without a name is called
    TYPE1, TYPE2, ... by its place among those of its type. Numbers that a joint leaves to the initial guess are filled in here.

    Raises `SceneError`, which lists every mistake. Numbers that are traced are not looked at; their shapes are.
    """

    name: str = eqx.field(static=True)
    gravity: Float[Array, "2"]  # m/s^2
    body_names: tuple[str, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    driver_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)
    left_out: tuple[int, ...] | None = eqx.field(static=True)  # rows of Psi known to be redundant; None: not yet looked for
    # JAX sorts the keys of a dict: tuples keep the user's order.
    _bodies: tuple[Body, ...]
    _joints: tuple[Joint, ...]
    _drivers: tuple[Driver, ...]
    _forces: tuple[ForceElement, ...]

    def __init__(
        self,
        bodies: Mapping[str, Body],
        joints: Mapping[str, Joint] | None = None,
        drivers: Mapping[str, Driver] | None = None,
        forces: Mapping[str, ForceElement] | Sequence[ForceElement] | None = None,
        gravity: Numbers = (0.0, -9.81),
        name: str = "",
        left_out: tuple[int, ...] | None = None,
    ):
        forces = forces or {}
        given = {
            "body": list(bodies.items()),
            "joint": list((joints or {}).items()),
            "driver": list((drivers or {}).items()),
            "force": list(forces.items() if isinstance(forces, Mapping) else zip(numbered(forces), forces, strict=True)),
        }
        kinds = {"body": Body, "joint": Joint, "driver": Driver, "force": ForceElement}
        problems, entries, found = [], [], {}
        for section, items in given.items():
            found[section] = []
            for index, (key, element) in enumerate(items):
                if not isinstance(element, kinds[section]):
                    entries.append(entry := Entry(section, index, key, None, {}))
                    problems.append(f"{entry.where}: must be of class {kinds[section].__name__}, is a {type(element).__name__}")
                    continue
                element = jax.tree.map(_as_number, element)
                entries.append(entry := Entry(section, index, key, type(element), table_of(element)))
                problems.extend(f"{entry.where}{problem}" for problem in not_numbers(element))
                if section == "force" and not _acts(type(element)):
                    problems.append(f"{entry.where}: {type(element).__name__} must have a method `potential` or `loads`")
                found[section].append((key, element))
        problems.extend(problems_of(entries, gravity))
        if problems:
            raise SceneError(problems, name)
        self.name, self.gravity, self.left_out = name, number(gravity), left_out
        self.body_names, self._bodies = _columns(found["body"])
        self.joint_names, self._joints = _columns([(key, self._resolved(c)) for key, c in found["joint"]])
        self.driver_names, self._drivers = _columns([(key, self._resolved(c)) for key, c in found["driver"]])
        self.force_names, self._forces = _columns(found["force"])

    @property
    def bodies(self) -> Mapping[str, Body]:
        """The bodies by name."""
        return _named(self.body_names, self._bodies)

    @property
    def joints(self) -> Mapping[str, Joint]:
        """The joints by name."""
        return _named(self.joint_names, self._joints)

    @property
    def drivers(self) -> Mapping[str, Driver]:
        """The drivers by name."""
        return _named(self.driver_names, self._drivers)

    @property
    def forces(self) -> Mapping[str, ForceElement]:
        """The force elements by name."""
        return _named(self.force_names, self._forces)

    @property
    def constraints(self) -> Mapping[str, Constraint]:
        """Joints, then drivers, by name: the order of the rows of Psi."""
        return _named(self.joint_names + self.driver_names, self._joints + self._drivers)

    def frames_of(self, element: Constraint | ForceElement) -> tuple[str, ...]:
        """Return the names of the bodies whose frames an element gets, in that order."""
        if isinstance(element, Friction):
            return self.joints[element.joint].attached
        return element.attached if isinstance(element, Constraint) else element.bodies

    @property
    def q0(self) -> Float[Array, "bodies 3"]:
        """The initial guess of the coordinates: x, y (m) and angle (rad) of each body."""
        return jnp.stack([jnp.append(body.position, body.angle) for body in self._bodies])

    @property
    def v0(self) -> Float[Array, "bodies 3"]:
        """The initial guess of the velocities (m/s, rad/s)."""
        return jnp.stack([jnp.append(body.velocity, body.angular_velocity) for body in self._bodies])

    def parameters(self) -> dict[str, Array]:
        """Return every number of the scene under its name, such as `body.link1.mass`; absent ones (a damping) are left out."""
        return {name: known.value for name, known in self._parameters().items() if known.value is not None}

    def with_parameters(self, values: Mapping[str, Numbers]) -> "Mechanism":
        """Return the mechanism with some of its numbers replaced; pure, and values may be traced.

        `values` maps names as in `parameters`, or those of one entry (`joint.A.points[1][0]`), to values of exactly the same
        shape. A number that was absent is then there. Numbers that a joint once took from the initial guess stay as they are,
        but the constants of gears and racks follow the initial guess. Raises `SceneError`.
        """
        known, problems = self._parameters(), []
        groups = {section: dict(getattr(self, plural)) for section, plural in _SECTIONS.items()}
        gravity = self.gravity
        # Whole arrays before their entries, whatever the order of the keys: jit sorts them.
        for given in sorted(values, key=lambda name: name.count("[") if name not in known else 0):
            name, index = _split(given, known)
            if name not in known:
                problems.append(f"no parameter {quoted(given)}{suggestion(name, known)}")
                continue
            section, owner, path, _, shape = known[name]
            old, new = (_at(groups[section][owner], path) if path else gravity), _number(values[given])
            if new is None:
                problems.append(f"{given}: must be a number or an array, is {shown(values[given])}")
            elif index and old is None:
                problems.append(f"{given}: {name} is absent; set it as a whole")
            elif shape is not None and (len(index) > len(shape) or any(i >= n for i, n in zip(index, shape, strict=False))):
                problems.append(f"{given}: {name} has the shape {shape}")
            elif shape is not None and new.shape != shape[len(index) :]:
                problems.append(f"{given}: must have the shape {shape[len(index) :]}, has {new.shape}")
            else:
                new = old.at[index].set(new) if index else new
                if path:
                    groups[section][owner] = _set(groups[section][owner], path, new)
                else:
                    gravity = new
        if problems:
            raise SceneError(problems, self.name)
        return Mechanism(groups["body"], groups["joint"], groups["driver"], groups["force"], gravity, self.name, self.left_out)

    def _parameters(self) -> dict[str, "_Parameter"]:
        found = {"gravity": _Parameter("", "", (), self.gravity, self.gravity.shape)}
        for section, plural in _SECTIONS.items():
            for owner, element in getattr(self, plural).items():
                for path, value, shape in numbers_in(element):
                    found[".".join((section, owner, *path))] = _Parameter(section, owner, path, value, shape)
        return found

    def _resolved(self, constraint):
        if type(constraint).resolved is Constraint.resolved:  # most joints: spares the sines and cosines of every body
            return constraint
        bodies = self.bodies
        return constraint.resolved(*(_FIXED if name == GROUND else bodies[name].frame() for name in constraint.attached))


class _Parameter(NamedTuple):
    section: str
    owner: str
    path: tuple[str, ...]  # of fields; none: gravity
    value: Array | None  # None: absent
    shape: tuple[int, ...] | None  # None: absent, any shape


_SECTIONS = {"body": "bodies", "joint": "joints", "driver": "drivers", "force": "forces"}


def numbered(elements: Sequence[Any], names: Sequence[str | None] = ()) -> list[str]:
    """Name each element that has no name TYPE1, TYPE2, ... by its place among those of its type (classes or their names)."""
    found, counts = [], {}
    for i, element in enumerate(elements):
        kind = element if isinstance(element, str) else type_name(type(element))
        counts[kind] = counts.get(kind, 0) + 1
        found.append((names[i] if names else None) or f"{kind}{counts[kind]}")
    return found


def _acts(cls: type) -> bool:
    return cls.potential is not ForceElement.potential or cls.loads is not ForceElement.loads


def _as_number(leaf):
    """Convert the plain numbers of user-written elements, which would be static."""
    return number(leaf) if isinstance(leaf, int | float | np.ndarray | np.number) and not isinstance(leaf, bool) else leaf


def _number(value: Any) -> Array | None:
    try:
        return None if isinstance(value, bool) else number(value)
    except (TypeError, ValueError):
        return None


def _columns(items: Sequence[tuple[str, Element]]) -> tuple[tuple[str, ...], tuple[Element, ...]]:
    return tuple(key for key, _ in items), tuple(element for _, element in items)


def _named(names: tuple[str, ...], elements: tuple[Element, ...]) -> Mapping[str, Element]:
    return MappingProxyType(dict(zip(names, elements, strict=True)))


def _split(given: str, known: Mapping[str, Any]) -> tuple[str, tuple[int, ...]]:
    """Split `joint.A.points[1][0]` into the parameter and the index of one of its entries."""
    match = None if given in known else re.fullmatch(r"(.*?)((?:\[\d+\])+)", given)
    return (given, ()) if match is None else (match[1], tuple(int(i) for i in re.findall(r"\d+", match[2])))


def _at(element: Any, path: Sequence[str]) -> Any:
    for name in path:
        element = getattr(element, name)
    return element


def _set(element: Element, path: Sequence[str], value: Array) -> Element:
    return eqx.tree_at(lambda e: _at(e, path), element, value, is_leaf=lambda leaf: leaf is None)
