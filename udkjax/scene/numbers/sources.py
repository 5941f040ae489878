"""Sources of a mechanism: the independent numbers, which are the leaves of its tree, and the elements that follow from them.

The elements of most mechanisms are independent (`Elements`). Gears and racks have a constant that follows from the initial guess
(`ElementsWithConstants`), and all elements of a drawn mechanism follow from its drawing (`Drawn`). Numbers that follow are never
leaves: whatever JAX does to a mechanism as a tree, they are computed from the leaves where they are needed.
"""

import dataclasses
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.annotations import TreeDef
from udkjax.arrays import QuickMethods, is_traced, make_module
from udkjax.printing import PrintsTable
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.programs.undefined import defined
from udkjax.scene.elements.bodies import Body
from udkjax.scene.elements.drivers import Driver
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.elements.joints import Joint
from udkjax.scene.numbers.direct_numbers import DirectNumbers
from udkjax.scene.numbers.named_numbers import Formula
from udkjax.scene.numbers.number_fields import SECTIONS, ElementGroups, parameters_in, replace_numbers
from udkjax.scene.tables.checks import SceneError
from udkjax.scene.tables.element_setup import complete, with_constants
from udkjax.scene.tables.schema import keys

Leaves = Sequence[Any]


class Elements(QuickMethods):
    """The elements of a mechanism, in the user's order, and gravity: independent numbers."""

    gravity: Float[Array, "2"]  # m/s^2
    # JAX sorts the keys of a dict: tuples keep the user's order. None stands for no elements.
    bodies: tuple[Body, ...] | None
    joints: tuple[Joint, ...] | None
    drivers: tuple[Driver, ...] | None
    forces: tuple[ForceElement, ...] | None

    @classmethod
    def of(cls, gravity: Any, sections: Sequence[Sequence[Any]], **more: Any) -> "Elements":
        """Return an instance from sequences of bodies, joints, drivers and forces; `more` are fields of a subclass."""
        bodies, joints, drivers, forces = (tuple(elements) or None for elements in sections)
        return make_module(cls, gravity=gravity, bodies=bodies, joints=joints, drivers=drivers, forces=forces, **more)

    @property
    def elements(self) -> "Elements":
        """The elements with all numbers that the equations need, including those that follow from others."""
        return self

    def groups(self, names: Sequence[Sequence[str]]) -> ElementGroups:
        """Return the elements by section and name, from the names of bodies, joints, drivers and forces."""
        sections = zip(SECTIONS, names, (self.bodies, self.joints, self.drivers, self.forces), strict=True)
        return {section: dict(zip(keys, elements or (), strict=True)) for section, keys, elements in sections}


class ElementsWithConstants(Elements):
    """Elements with constraints whose constants follow from the initial guess of the bodies, such as those of gears."""

    names: tuple[tuple[str, ...], ...] = eqx.field(static=True)  # of bodies, joints, drivers and forces

    @property
    def elements(self) -> Elements:
        return elements_of(self)

    def derived(self) -> tuple[Elements, "Derivation"]:
        """Return the elements with their constants, and the origin of each of their numbers."""
        bodies = dict(zip(self.names[0], self.bodies or (), strict=True))
        constraints = ([with_constants(x, bodies) for x in group or ()] for group in (self.joints, self.drivers))
        elements = Elements.of(self.gravity, (self.bodies or (), *constraints, self.forces or ()))
        return elements, Derivation(self, elements, dict(zip(SECTIONS, self.names, strict=True)))

    @property
    def cure(self) -> str:
        return "it follows from the initial guess of the bodies"


class AbstractDrawing(PrintsTable):
    """The source of a drawn mechanism, whose numbers (pins, widths, densities) determine those of the bodies."""

    gravity: eqx.AbstractVar[Array]

    @property
    @abstractmethod
    def pins(self) -> Mapping[str, Any]:
        """The world coordinates of the pins by name (m)."""

    @property
    @abstractmethod
    def groups(self) -> Mapping[str, Mapping[str, eqx.Module]]:
        """The drawing's own elements by section (number, pin, link, motor, ...) and name, with the numbers of expressions."""

    @property
    @abstractmethod
    def own_groups(self) -> Mapping[str, Mapping[str, eqx.Module]]:
        """The elements as the leaves of the drawing hold them: without the numbers that expressions give."""

    units: eqx.AbstractVar[tuple[tuple[str, str], ...]]  # the units in which it was written, by quantity
    formulas: eqx.AbstractVar[tuple[Formula, ...]]
    massless: eqx.AbstractVar[tuple[str, ...]]  # the links for which no mass is given

    @abstractmethod
    def with_groups(self, groups: Mapping[str, Mapping[str, Any]], gravity: Array) -> "AbstractDrawing":
        """Return the drawing with other numbers in its elements; raise a `SceneError` if they are not valid."""

    @abstractmethod
    def elements(self) -> ElementGroups:
        """Return the elements of the mechanism, by section (body, joint, driver, force) and name, without checks."""

    @abstractmethod
    def explain(self, problem: str) -> str:
        """Return a mistake in an element of the mechanism, with the part of the drawing that it follows from."""

    @abstractmethod
    def locate_pin(self, name: str) -> tuple[str, Array] | None:
        """Return a body (or the ground) at a pin and the pin's position in the body's frame (m); None for an unknown pin."""

    @abstractmethod
    def length_texts(self) -> Mapping[str, str]:
        """Return the lengths of each body and of the ground as text, by name; empty if numbers are traced."""

    @abstractmethod
    def dimensions(self) -> Mapping[tuple[str, str], str]:
        """Return the lengths of all links and of the ground as text, by pairs of pins, in the unit of the drawing."""

    @abstractmethod
    def touching_pins(self) -> list[str]:
        """Return the names of pins whose places have no derivatives, such as those where circles only touch.

        The numbers of the drawing must be concrete.
        """

    @abstractmethod
    def shapes(self) -> dict[str, Array]:
        """Return the points (n, 2) through which each body is drawn, in the frame of the body (m), by name."""

    @abstractmethod
    def holes(self) -> dict[str, Array]:
        """Return the corners of the holes (holes, n, 2) of bodies that have any, in the frame of the body (m), by name."""

    @property
    @abstractmethod
    def polygons(self) -> list[str]:
        """The names of the bodies that are polygons, whose `shapes` are the corners in order."""

    @abstractmethod
    def free_pins(self) -> dict[str, tuple[str, Array]]:
        """Return the body and the position in its frame (m) of each pin that belongs to a single body, by the pin's name."""


class Drawn(QuickMethods):
    """A drawing, and the numbers that were given directly instead of those that follow from it."""

    drawing: AbstractDrawing
    direct: DirectNumbers | None = None

    @property
    def elements(self) -> Elements:
        """The elements with all numbers that the equations need."""
        return elements_of(self)

    @property
    def gravity(self) -> Array:
        """The acceleration of gravity (m/s^2)."""
        return self.drawing.gravity

    def derived(self) -> tuple[Elements, "Derivation"]:
        """Return the elements that follow from the drawing, and the origin of each of their numbers."""
        groups = dict(_drawn_elements(self.drawing))
        if self.direct is not None:
            groups, _ = replace_numbers(groups, self.gravity, self.direct.by_name, parameters_in(groups), "")
        for section in ("joint", "driver"):
            groups[section] = {name: with_constants(x, groups["body"]) for name, x in groups[section].items()}
        elements = Elements.of(self.gravity, [list(groups[section].values()) for section in SECTIONS])
        return elements, Derivation(self, elements, {section: tuple(groups[section]) for section in SECTIONS})

    @property
    def cure(self) -> str:
        return "it follows from the drawing: change its numbers, such as mechanism.drawing.pins, or use with_parameters"


Source = Elements | Drawn


@cached_by_identity(within_trace=True)  # many mechanisms of one drawing differ in numbers that are given directly
def _drawn_elements(drawing: AbstractDrawing) -> ElementGroups:
    """Return the elements that follow from a drawing, including the numbers that constraints take from the initial guess."""
    groups = drawing.elements()
    completed = {s: {name: complete(x, groups["body"]) for name, x in groups[s].items()} for s in ("joint", "driver")}
    return groups | completed


class Derivation:
    """The origin of each number of elements: the index of a leaf of the source, or None for a number that is computed."""

    def __init__(self, source: Source, elements: Elements, names: Mapping[str, tuple[str, ...]]):
        """Find the places by the identity of the leaves."""
        place = {id(x): k for k, x in enumerate(jax.tree.leaves(source))}
        leaves, self.tree = jax.tree.flatten(elements)
        self.places, self.names = tuple(place.get(id(x)) for x in leaves), names

    @property
    def labels(self) -> list[str]:
        """The names of the numbers, such as `body.crank.mass`."""
        found, _ = jax.tree_util.tree_flatten_with_path(jax.tree.unflatten(self.tree, range(self.tree.num_leaves)))
        return [self._label(jax.tree_util.keystr(path, simple=True, separator=".")) for path, _ in found]

    def _label(self, path: str) -> str:
        section = next((section for section, plural in SECTIONS.items() if path.startswith(f"{plural}.")), None)
        if section is None:
            return path
        _, index, field = path.split(".", 2)
        return f"{section}.{self.names[section][int(index)]}.{field}"

    def with_leaves(self, leaves: Sequence[Any], found: Sequence[Any]) -> Elements:
        """Return the elements with the leaves of the source themselves, and with `found` for the numbers that are computed."""
        return jax.tree.unflatten(self.tree, [x if k is None else leaves[k] for k, x in zip(self.places, found, strict=True)])


class Follows:
    """A stand-in for a number that would be computed from leaves that are not numbers, as in `eqx.tree_at`.

    It cannot be used: an attempt raises a `SceneError` with its text.
    """

    def __init__(self, text: str):
        self.text = text

    def __repr__(self) -> str:
        return "follows"


def _refuse(number: Follows) -> Any:
    raise SceneError([number.text])


jax.tree_util.register_pytree_node(Follows, _refuse, lambda text, _: Follows(text))

MOST_STRUCTURES = 256
_derivations: "OrderedDict[TreeDef, Derivation]" = OrderedDict()  # of the structures met so far
_NUMBER_TYPES = (jax.Array, np.ndarray, np.generic, float)


def is_number(leaf: object) -> bool:
    """Return True if a leaf is a number, not an object that a function on trees has put in its place."""
    return isinstance(leaf, _NUMBER_TYPES)


_derived = defined(deferred(lambda source: source.derived(), keeps_concrete=True))


@cached_by_identity(within_trace=True)
def elements_of(source: Any) -> Elements:
    """Return the elements that follow from a source, computed once for concrete numbers, and once in each trace.

    Numbers that are leaves of the source are the same objects in the elements. If leaves are not numbers, as in `eqx.tree_at`,
    all other numbers are stand-ins that refuse to be used.
    """
    leaves, tree = jax.tree.flatten(source)
    if not all(isinstance(x, jax.ShapeDtypeStruct) or is_number(x) for x in leaves):
        return _with_stand_ins(source, leaves, tree)
    axes = _batch_axes(source, leaves)
    if len({id(x) for x in leaves}) < len(leaves):  # one array is several leaves: `Derivation` needs to tell them apart
        source = jax.tree.unflatten(tree, _distinct(leaves))
    try:
        if any(isinstance(x, jax.ShapeDtypeStruct) for x in leaves) or any(axes):
            return _transformed(leaves, tree, axes)
        if is_traced(leaves):
            elements, derivation = _derived(source)
        else:
            with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):  # concrete even while something else is traced
                elements, derivation = source.derived()
    except (AssertionError, AttributeError, TypeError) as error:
        raise SceneError(["a part of its numbers is missing: combine its parts before its elements are used"]) from error
    _remember(tree, derivation)
    return derivation.with_leaves(leaves, jax.tree.leaves(elements))


def names_of(source: Drawn) -> tuple[tuple[str, ...], ...]:
    """Return the names of the bodies, joints, drivers and forces of a drawn mechanism."""
    elements_of(source)
    derivation = _derivations.get(jax.tree.structure(source)) or source.derived()[1]
    return tuple(derivation.names[section] for section in SECTIONS)


def _distinct(leaves: Leaves) -> list[Any]:
    """Return leaves that are all different objects: a leaf that is the same object as an earlier one is replaced by a copy."""
    found: dict[int, Any] = {}
    for x in leaves:
        if id(x) in found:
            x = jnp.copy(x) if isinstance(x, Tracer) else jax.device_put(np.array(x))
        found[id(x)] = x
    return list(found.values())


def _remember(tree: TreeDef, derivation: Derivation) -> None:
    _derivations[tree] = derivation
    while len(_derivations) > MOST_STRUCTURES:
        _derivations.popitem(last=False)


def _transformed(leaves: Leaves, tree: TreeDef, axes: Sequence[int]) -> Elements:
    """Return the elements of a source in a batch, whose leaves have `axes` leading batch axes, or of one that has only shapes."""
    found: list[Derivation] = []

    def numbers(*leaves: Any) -> list[Any]:
        elements, derivation = jax.tree.unflatten(tree, leaves).derived()
        found.append(derivation)
        return jax.tree.leaves(elements)

    function: Callable[..., list[Any]] = numbers
    for depth in range(1, max(axes) + 1):
        function = jax.vmap(function, [0 if count >= depth else None for count in axes])
    is_concrete = all(isinstance(x, _NUMBER_TYPES) for x in leaves)
    results = jax.jit(function)(*leaves) if is_concrete else jax.eval_shape(function, *leaves)
    return found[0].with_leaves(leaves, results)


def _batch_axes(source: Any, leaves: Leaves) -> list[int]:
    """Return the number of batch axes of each leaf: leading axes along which numbers of several mechanisms are stacked."""
    of_all = max(np.ndim(source.gravity) - 1, 0)
    if isinstance(source, Drawn):
        modules: list[Any] = [element for group in source.drawing.own_groups.values() for element in group.values()]
    else:
        modules = [x for group in (source.bodies, source.joints, source.drivers, source.forces) for x in group or ()]
    dims: dict[int, int] = {}
    for module in modules:  # the list grows in this loop
        for name, count in _dimensions(type(module)).items():
            value = getattr(module, name)
            if isinstance(value, eqx.Module):
                modules.append(value)
            elif value is not None and count is not None:
                dims[id(value)] = np.ndim(value) - count
    return [max(dims.get(id(x), of_all), 0) for x in leaves]


@cache
def _dimensions(cls: type) -> dict[str, int | None]:
    """Return the number of dimensions of each dynamic field of a class, None if its annotation does not determine it."""
    texts = {f.name: getattr(f.type, "dim_str", "...") for f in dataclasses.fields(cls) if not f.metadata.get("static")}
    annotated = {name: getattr(key.annotation, "dim_str", "...") for name, key in keys(cls).items() if name in texts}
    return {name: None if "..." in text else len(text.split()) for name, text in (texts | annotated).items()}


def _with_stand_ins(source: Any, leaves: Leaves, tree: TreeDef) -> Elements:
    derivation = _derivations.get(tree)
    if derivation is None:
        raise SceneError(["its leaves are not numbers, from which its elements would follow"])
    stand_ins = [Follows(f"{label} is not a leaf of the mechanism: {source.cure}") for label in derivation.labels]
    return derivation.with_leaves(leaves, stand_ins)
