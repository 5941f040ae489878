"""Settings of a whole MJCF model: compiler, disabled options, and defaults."""

import math

from udkjax.scene.mjcf.orientations import SpaceFrame, frame_of
from udkjax.scene.mjcf.vocabulary import ACTUATORS
from udkjax.scene.mjcf.xml_tree import AttributeReader, XmlElement
from udkjax.wording import abbreviate, quote, suggestion

MAIN_CLASS = "main"  # the default class
_COMMON_TO_ACTUATORS = ("gear", "ctrlrange", "ctrllimited", "forcerange", "forcelimited")
_STANDARD_FLAGS = "constraint equality limit contact spring damper gravity actuation frictionloss".split()


class ModelSettings:
    """The settings of a model, and its elements' attributes with the defaults of their classes."""

    def __init__(self, root: XmlElement, problems: list[str]):
        self.problems = problems
        self._defaults: dict[str, dict[str, dict[str, str]]] = {MAIN_CLASS: {}}
        compilers, options, flags = (merge_parts(root, path) for path in (("compiler",), ("option",), ("option", "flag")))
        read = AttributeReader(compilers, compilers.attributes, problems)
        self.radians = math.pi / 180 if read.choice("angle", ("degree", "radian"), "degree") == "degree" else 1.0
        self.sequence = read.text("eulerseq", "xyz")
        if len(self.sequence) != 3 or not set(self.sequence.lower()) <= set("xyz"):
            read.refuse(f"eulerseq={abbreviate(self.sequence)} must be three of x, y, z, X, Y, Z")
            self.sequence = "xyz"
        self.autolimits = read.choice("autolimits", ("true", "false"), "true") == "true"
        self.mass_from_geoms = read.choice("inertiafromgeom", ("true", "false", "auto"), "auto")
        self.total_mass = read.number("settotalmass", -1.0)  # kg; masses are not scaled if it is not positive
        self.mass_groups = read.numbers("inertiagrouprange", (0, 5))
        read = AttributeReader(flags, flags.attributes, problems)
        off = {name for name in _STANDARD_FLAGS if read.choice(name, ("enable", "disable"), "enable") == "disable"}
        self.disabled = off | ({"equality", "limit", "contact", "frictionloss"} if "constraint" in off else set())
        self.gravity = AttributeReader(options, options.attributes, problems).numbers("gravity", (0.0, 0.0, -9.81))
        if "gravity" in self.disabled:
            self.gravity = 0 * self.gravity
        pending = [(child, MAIN_CLASS) for child in root.children if child.tag == "default"]
        while pending:
            element, parent = pending.pop()
            at_top = element in root.children
            name = element.attributes.get("class", MAIN_CLASS if at_top else "")
            if not name or (at_top and name != MAIN_CLASS):
                problems.append(
                    f"{element.where}: class={quote(name)}: the default class at the top is main; rename the classes below it"
                )
            class_defaults = self._defaults.setdefault(
                name, {tag: dict(values) for tag, values in self._defaults[parent].items()}
            )
            for child in element.children:
                if child.tag == "default":
                    pending.append((child, name))
                else:
                    class_defaults.setdefault(child.tag, {}).update(child.attributes)

    def read(self, element: XmlElement, childclass: str = MAIN_CLASS, section: str = "") -> AttributeReader:
        """Return the attributes of an element with the defaults of its class, or of the class of the body that holds it.

        `section` is the tag of the defaults, if it differs from the tag of the element.
        """
        name = element.attributes.get("class", childclass)
        if name not in self._defaults:
            self.problems.append(
                f"{element.where}: no default has the class {abbreviate(name)}{suggestion(name, self._defaults)}"
            )
        defaults = self._defaults.get(name, {})
        values: dict[str, str] = {}
        if element.tag in ACTUATORS:
            for tag in ACTUATORS:
                values |= {key: value for key, value in defaults.get(tag, {}).items() if key in _COMMON_TO_ACTUATORS}
        values |= defaults.get(section or element.tag, {})
        return AttributeReader(element, values | dict(element.attributes), self.problems)

    def frame(self, read: AttributeReader) -> SpaceFrame:
        """Return the frame of an element in its parent's frame."""
        return frame_of(read, self.radians, self.sequence)

    def is_limited(self, read: AttributeReader, limited: str, range_name: str) -> bool:
        """Return True if a range is active: the attribute `limited` says so, or it is absent, and the range is given."""
        word = read.choice(limited, ("true", "false", "auto"), "auto")
        return word == "true" or (word == "auto" and self.autolimits and range_name in read)


def merge_parts(root: XmlElement, path: tuple[str, ...]) -> XmlElement:
    """Return one element with the attributes and children of all elements at a path below the root.

    Later attributes override earlier ones.
    """
    elements = [root]
    for tag in path:
        elements = [child for element in elements for child in element.children if child.tag == tag]
    attributes = {name: value for element in elements for name, value in element.attributes.items()}
    merged = XmlElement(path[-1], attributes, elements[0].line if elements else root.line)
    merged.children = [child for element in elements for child in element.children]
    return merged
