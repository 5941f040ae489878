"""Sliders of a live page: their parameters, labels, sections and ranges."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.equations.rows.analysis import analyse
from udkjax.integrate.portable import scalar_parameters
from udkjax.scene.drawing import Drawing
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.quantities import conversion_factor

# Names of parameters or of their entries, alone or with the ranges of their sliders; True: all parameters.
Live = bool | Sequence[str] | Mapping[str, tuple[float, float] | None]

SECTION_TITLES = {
    "motor": "Motors",
    "driver": "Drivers",
    "gravity": "Gravity",
    "force": "Forces",
    "load": "Loads",
    "friction": "Friction",
    "spring": "Springs",
    "damper": "Dampers",
    "length": "Lengths and angles",
    "pin": "Pins",
    "joint": "Joints",
    "body": "Bodies",
    "link": "Links",
}  # sections in order; further ones follow
PLACE_FIELDS = ("points", "point", "position", "velocity", "vector", "gravity", "force")  # fields whose two entries are x and y
NOT_NEGATIVE = ("kg", "kg m2", "kg/m3", "N/m", "N s/m", "N m/rad", "N m s/rad")  # units of quantities that are never negative
INITIAL_SECTION = "Initial state"
# Initial values; position and angle of bodies, from which assembly starts, are added to these.
INITIAL_FIELDS = ("velocity", "angular_velocity")
SIZE_FIELDS = ("length", "radius", "width", "thickness", "radii")  # lengths that are never negative; all others are places
LEAST_VALUE = 1e-9  # values below this count as zero, relative to the scene's units
LARGEST_GRAVITY = 20.0  # twice that of the earth (m/s2)


class Slider(NamedTuple):
    """A slider of a page: the name of its parameter, its label, section, unit, value and range (`low`, `high`).

    Value and range are in SI units; the page shows `per_unit` times these numbers in the unit of the drawing, `shown`.
    """

    name: str
    label: str
    section: str
    unit: str
    value: float
    low: float
    high: float
    shown: str
    per_unit: float

    @property
    def data(self) -> JsonObject:
        """The slider as JSON."""
        return self._asdict()


def sliders_of(mechanism: Mechanism, live: Live) -> list[Slider]:
    """Return the sliders of the parameters that `live` names, in the order of their sections; if it is True or False, of all.

    In the latter case, profiles of cams and the `pins_in_line` are left out.

    Raises:
        SceneError: a name is not a parameter.
        ValueError: a range does not contain the value of its parameter.
    """
    wanted = None if isinstance(live, bool) else list(live)
    ranges = live if isinstance(live, Mapping) else {}
    scales = analyse(mechanism).scales
    length, rate = float(scales.length), float(scales.rate) or 1.0
    sliders, bound, links = [], pins_in_line(mechanism), dimensions_of_links(mechanism)
    written = Units(dict(mechanism.drawing.units) if isinstance(mechanism.drawing, Drawing) else None)
    for name, value in scalar_parameters(mechanism, wanted).items():
        if wanted is None and (".profile." in name or _base(name) in bound):  # the drawn outline of a cam does not change
            continue
        limits = ranges.get(name) or ranges.get(_base(name))
        unit = mechanism.unit_of(name)
        low, high = limits or usual_range(name, unit, value, length, rate)
        if not low <= value <= high or not low < high:
            raise ValueError(f"live: the range {low:g} to {high:g} of {name} does not contain its value {value:g}")
        shown = written.shown(unit)
        per_unit = 1.0 / conversion_factor(shown, unit) if shown != unit else 1.0
        label, section = links.get(name) or label_of(name), SECTION_TITLES["length"] if name in links else section_of(name)
        sliders.append(Slider(name, label, section, unit, value, float(low), float(high), shown, per_unit))
    return in_sections(sliders)


def dimensions_of_links(mechanism: Mechanism) -> dict[str, str]:
    """Return labels for the lengths and angles by which a drawing places pins relative to other pins, by parameter.

    A label has the name of the link that connects the two pins, or else the names of the pins, as "A-B"; {} without a drawing.
    """
    drawing, found = mechanism.drawing, {}
    if not isinstance(drawing, Drawing):
        return found

    def of_link(start: str, end: str) -> str:
        for name, link in drawing.links.items():
            if {start, end} <= {*link.pins}:
                return name if len(link.pins) == 2 else f"{name} {start}-{end}"
        return f"{start}-{end}"

    for pin, form in drawing.groups["pin"].items():
        starts = getattr(form, "from_", None)
        if starts is None or getattr(form, "length", None) is None or hasattr(form, "to"):
            continue
        if isinstance(starts, str):
            found |= {f"pin.{pin}.length": of_link(starts, pin), f"pin.{pin}.angle": f"{of_link(starts, pin)} angle"}
        else:
            found |= {f"pin.{pin}.length[{k}]": of_link(start, pin) for k, start in enumerate(starts)}
    return found


def pins_in_line(mechanism: Mechanism) -> set[str]:
    """Return the parameters of pins of bars with more than two pins: moving a single pin would take it out of line.

    Bars are left out whose inner pins are defined on the line through other pins of the bar: they stay on it in any case.
    """
    if not isinstance(mechanism.drawing, Drawing):
        return set()
    pins, bound = mechanism.drawing.groups["pin"], set()
    for link in mechanism.drawing.links.values():
        on_line = all(hasattr(pins[p], "to") and {*pins[p].references} <= {*link.pins} for p in link.pins[1:-1])
        if link.kind == "bar" and len(link.pins) > 2 and not on_line:
            bound |= {*link.pins}
    return {name for name, x in mechanism.number_fields().items() if x.section == "pin" and x.owner in bound}


def in_sections(sliders: Iterable[Slider]) -> list[Slider]:
    """Return sliders in the order of their sections."""
    order = [*dict.fromkeys(SECTION_TITLES.values())]
    return sorted(sliders, key=lambda slider: order.index(slider.section) if slider.section in order else len(order))


def names_in(mechanism: Mechanism, live: Live) -> Live:
    """Return the part of `live` that names parameters of a mechanism; True and False are returned as they are."""
    if isinstance(live, bool):
        return live
    known = mechanism.parameters()
    if isinstance(live, Mapping):
        return {name: ends for name, ends in live.items() if _base(name) in known}
    return [name for name in live if _base(name) in known]


def section_of(name: str) -> str:
    """Return the section of the slider of a parameter."""
    parts = _base(name).split(".")
    section, field = parts[0], parts[-1]
    if field in INITIAL_FIELDS or (section == "body" and field in ("position", "angle")):
        return INITIAL_SECTION
    return SECTION_TITLES.get(section, f"{section.capitalize()}s")


def label_of(name: str) -> str:
    """Return the label of the slider of a parameter: for `joint.A.points[1][0]`, "A point 2 x"."""
    base, indices = _base(name), [int(k) for k in re.findall(r"\[(\d+)\]", name)]
    parts = base.split(".")
    words = parts[1:] if len(parts) > 1 else parts
    text = " ".join(words).replace("_", " ")
    if parts[-1] in ("points", "radii", "times", "values") and indices:
        text = f"{text.removesuffix('s') if parts[-1] == 'points' else text} {indices.pop(0) + 1}"
    in_plane = parts[-1] in PLACE_FIELDS or (parts[0] == "pin" and parts[2:] != ["length"])
    text += "".join(f" {'xy'[k]}" if in_plane and k < 2 else f" {k + 1}" for k in indices)
    text_words = text.split(" ")
    return " ".join(word for k, word in enumerate(text_words) if k == 0 or word != text_words[k - 1])  # not "motor motor speed"


def usual_range(name: str, unit: str, value: float, length: float, rate: float) -> tuple[float, float]:
    """Return the default range of a slider: the mechanism's size around a coordinate, or a few times any other number.

    Args:
        name: name of the parameter, which tells sizes from coordinates.
        unit: SI unit of the parameter.
        value: its value.
        length: characteristic length of the mechanism (m).
        rate: characteristic rate of the mechanism (1/s).
    """
    by_unit = {"m/s": length * rate, "rad/s": rate, "m": length, "rad": 1.0}
    size = abs(value) if abs(value) > LEAST_VALUE * by_unit.get(unit, 0.0) else 0.0
    if unit == "m/s2":
        return -max(LARGEST_GRAVITY, 2 * size), max(LARGEST_GRAVITY, 2 * size)
    if unit in NOT_NEGATIVE or (unit == "m" and re.split(r"[.\[]", name)[-2 if "[" in name else -1] in SIZE_FIELDS):
        return (size / 10, 4 * size) if size else (0.0, length if unit == "m" else 1.0)
    if unit == "m":
        return value - 0.5 * length, value + 0.5 * length
    if unit == "rad":
        return value - np.pi, value + np.pi
    reach = 2 * size or by_unit.get(unit, 1.0)
    return -reach, reach


def _base(name: str) -> str:
    """Return the name of a parameter without indices of an entry, such as "[1][0]"."""
    return re.sub(r"(\[\d+\])+$", "", name)
