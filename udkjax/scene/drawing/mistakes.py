"""Mistakes in a drawing as a whole: names used twice, unconnected pins and links, degenerate shapes."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from udkjax.arrays import is_traced
from udkjax.scene.drawing.drawn_joints import CamPair, GearPair, PinInSlot
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.drawing.link import Link, twice_area, with_concrete_numbers
from udkjax.scene.drawing.pin_forms import (
    AbstractPin,
    PointArray,
    in_order,
    lowest_of_stack,
    places_of,
    reference_mistakes,
)
from udkjax.scene.drawing.placement import DrawnElement, PinLayout, Placement
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.outlines.contours import contains
from udkjax.segments import distances_from_segments
from udkjax.wording import quote

DrawnGroups = Mapping[str, Mapping[str, Any]]  # elements by section and name

# Tolerance relative to the largest distance between two pins. Closer points count as coincident, smaller areas as zero.
SAME_PLACE_TOL = 1e-9
# A pin that is farther from the other pins than this many times their largest distance is probably in another unit, such as
# millimetres in a file in metres (1,000). Smaller factors, such as 10 (cm and mm), are not recognized.
FAR_POINT_RATIO = 100.0
# Tolerance relative to the largest distance between two pins. Smaller gaps are usual in drawings to scale; assembly closes them.
DRAWN_GAP = 0.01
NUMBERS_OF_BLOCK = 2**20  # of distances that are held at once, 24 MiB with their differences


def where(section: str, index: int, name: str) -> str:
    """Return the path of an entry of a drawing for error messages."""
    return f"pins.{name}" if section == "pin" else f"{section} {quote(name)} ({section}[{index}])"


def joint_names(layout: PinLayout, pins: Sequence[str]) -> dict[str, tuple[str, str, str]]:
    """Return the pin and the two links of each revolute, by the name of the revolute: a pin of k links has k - 1 revolutes."""
    joints = {}
    for pin in pins:
        first, *others = layout.members(pin) or ("",)
        for k, other in enumerate(others):
            joints[pin if k == 0 else f"{pin}-{k + 1}"] = (pin, first, other)
    return joints


def layout_mistakes(layout: PinLayout, groups: DrawnGroups, ground: Sequence[str], all_read: bool) -> Iterator[str]:
    """Iterate over the mistakes in the connections of pins, links and other elements; all names are known.

    Unconnected links are reported only if `all_read`, because an element that could not be read may connect them.
    """
    elements = {s: g for s, g in groups.items() if g and isinstance(next(iter(g.values())), DrawnElement)}
    yield from _taken_names(layout, groups)
    anchors = {pin for group in elements.values() for element in group.values() for pin in element.anchors}
    anchors |= {slot.pin for slot in elements.get("slot", {}).values()}
    used = {pin for link in layout.links.values() for pin in link.pins}
    for k, pin in enumerate(ground):
        if pin not in used | anchors:
            yield f"ground[{k}]: no link reaches pin {quote(pin)}"
    referred = {other for pin in groups["pin"].values() for other in pin.references}
    for pin in groups["pin"]:
        if pin not in used and pin not in ground and pin not in referred:
            yield f"pins.{pin}: no link uses it"
    attached = _attached(layout, groups)
    for k, (name, link) in enumerate(layout.links.items()):
        path = where("link", k, name)
        yield from (f"{path}{problem}" for problem in _link_mistakes(link))
        if all_read and name not in attached:
            yield f"{path}.pins: the link is not connected to the ground or to another link"
    for section, group in elements.items():
        for k, (name, element) in enumerate(group.items()):
            yield from (f"{where(section, k, name)}.{problem}" for problem in element.mistakes(layout))


def _taken_names(layout: PinLayout, groups: DrawnGroups) -> Iterator[str]:
    """Iterate over messages about names that two elements of the mechanism would share."""
    motors = groups["motor"]
    spaces = (
        ("link", "body"),
        ("slide", "slot", "gear", "screw", "cam", "motor", "joint", "driver"),
        ("motor", "spring", "damper", "load", "friction", "force"),
    )
    for space in spaces:
        owner = (
            {name: f'pin "{pin}"' for name, (pin, *_) in joint_names(layout, list(groups["pin"])).items()}
            if "slide" in space
            else {}
        )
        for section in space:
            for k, name in enumerate(groups[section]):
                if section == "motor" and (motors[name].torque is None) == ("force" in space):
                    continue
                if name in owner:
                    yield f"{where(section, k, name)}.name: taken by {owner[name]}; names must be unique"
                elif "link" in space and name == GROUND:
                    yield f'{where(section, k, name)}.name: "{GROUND}" is the fixed frame; choose another name'
                owner.setdefault(name, f"{section}[{k}]")


def _attached(layout: PinLayout, groups: DrawnGroups) -> set[str]:
    """Return the names of the links that share a pin with another link or the ground, or belong to another element."""
    attached = {name for pin in groups["pin"] if len(m := layout.members(pin)) > 1 for name in m}
    for section in [section for section in groups if section not in ("pin", "link", "body")]:
        for element in groups[section].values():
            pins = (getattr(element, "pin", None), *getattr(element, "pins", ()), *getattr(element, "between", ()))
            named = (getattr(element, name, None) for name in ("link", "on", "body"))
            attached |= {*named, *getattr(element, "links", ()), *getattr(element, "bodies", ())}
            attached |= {name for pin in pins if pin for name in layout.members(pin)}
    return {name for name in attached if name}


def _link_mistakes(link: Link) -> Iterator[str]:
    """Iterate over the mistakes in a link by itself, apart from its numbers."""
    if not link.pins:
        yield ".pins: a link needs at least one pin"
        return
    if len(set(link.pins)) < len(link.pins):
        yield ".pins: names a pin twice"
    if link.density is not None and link.mass is not None:
        yield ": give a density, with a thickness, or a mass, not both"
    elif link.density is link.mass is None and link.thickness is not None:
        yield ": give a density, with a thickness, or a mass"
    elif link.density is link.mass is None and link.inertia is not None:
        yield ".inertia: needs a mass: give one, or a density, with a thickness"
    elif link.density is not None and link.thickness is None:
        yield ".thickness: missing; a mass by density needs it"
    elif link.kind == "disc" and link.width is None and (link.density is not None or link.inertia is None):
        cure = "or an outline" if link.density is not None else "an outline, or its inertia"
        yield f".width: a link of one pin is a disc: give its diameter, the width, {cure}"
    elif link.kind == "bar" and link.width is None and link.density is not None:
        yield ".width: missing; the mass of a bar by density needs it"


def pin_mistakes(pins: Mapping[str, AbstractPin], units: Units) -> Iterator[str]:
    """Iterate over the mistakes in the forms of pins, and in their references and lengths; distances are shown in `units`."""
    wrong_forms = [f"{where('pin', 0, name)}{problem}" for name, pin in pins.items() for problem in pin.mistakes()]
    yield from wrong_forms or reference_mistakes(pins)
    if wrong_forms or len(order := in_order(pins)) < len(pins) or is_traced(pins):
        return
    places: dict[str, PointArray] = {}
    for name in order:
        pin = with_concrete_numbers(pins[name])
        with np.errstate(all="ignore"):
            reason = pin.misplacement(places, lambda x: units.text(x, "m"))
        if reason:
            yield f"{where('pin', 0, name)}: {reason}"
            return  # pins that refer to this one have no place
        with np.errstate(all="ignore"):
            places[name] = pin.place(places)
        if not np.all(np.isfinite(places[name])):
            same = next((p for p in combinations(pin.references, 2) if np.array_equal(places[p[0]], places[p[1]])), None)
            overflows = "its place is no finite number: lengths are too large or too small; give them in their unit"
            at_one_place = same and f"{quote(same[0])} and {quote(same[1])} are at the same place: they have no direction"
            yield f"{where('pin', 0, name)}: {at_one_place or overflows}"
            return


def shape_mistakes(pins: Mapping[str, AbstractPin], links: Mapping[str, Link], guided: Collection[str] = ()) -> Iterator[str]:
    """Iterate over messages about implausible pins and shapes; all numbers are concrete and finite.

    Pins that are stacked, or `guided` by slots, may be at the places of other pins.
    """
    places = places_of(pins)
    names, points = list(places), _as_points(list(places.values()))
    index = {name: k for k, name in enumerate(names)}
    lowest = np.array([index[lowest_of_stack(pins, name)] for name in names], int)
    free, size = np.array([name not in guided for name in names], bool), extent(points)
    for first, distances in _distances(points):
        for i, row in enumerate(distances, first):
            at = np.flatnonzero(free[:i] & free[i] & (lowest[:i] != lowest[i]) & (row[:i] <= SAME_PLACE_TOL * size)).tolist()
            if at:
                pin = quote(names[at[0]])
                layers = f"or write {{stacked = {pin}}} if its links lie in another layer"
                yield f"pins.{names[i]}: is at the same place as pin {pin}: give all links there one pin, move it, {layers}"
    yield from _far_pins(names, points)
    for k, (name, link) in enumerate(links.items()):
        yield from (f"{where('link', k, name)}{problem}" for problem in _shape_mistakes(places, link))


def _as_points(points: Sequence[PointArray] | np.ndarray) -> np.ndarray:
    return np.array(points, float).reshape(-1, 2)


def _distances(points: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Iterate over blocks of rows of the matrix of distances, each after the index of its first row, to save memory."""
    rows = max(1, NUMBERS_OF_BLOCK // max(len(points), 1))
    for first in range(0, len(points), rows):
        yield first, np.linalg.norm(points[first : first + rows, None] - points[None], axis=-1)


def extent(points: Sequence[PointArray] | np.ndarray) -> float:
    """Return the largest distance between two points (m)."""
    return max((float(np.max(x, initial=0.0)) for _, x in _distances(_as_points(points))), default=0.0)


def _far_pins(names: Sequence[str], points: np.ndarray) -> Iterator[str]:
    if len(names) < 3:
        return
    nearest, size = np.zeros(len(names)), extent(points)
    for first, distances in _distances(points):
        np.fill_diagonal(distances[:, first:], np.inf)
        nearest[first : first + len(distances)] = np.min(distances, axis=1)
    # Such a pin is nearly as far from all others as the drawing is large, since size <= distance + (size of the others).
    for k in np.flatnonzero(nearest > 0.5 * size).tolist():
        of_others = extent(np.delete(points, k, axis=0))
        if nearest[k] > FAR_POINT_RATIO * of_others > 0:
            yield (
                f"pins.{names[k]}: is {nearest[k]:.3g} m away from the other pins, which are within {of_others:.3g} m of each "
                "other: is its unit right?"
            )


def _shape_mistakes(places: Mapping[str, PointArray], link: Link) -> Iterator[str]:
    if not link.pins or len(set(link.pins)) < len(link.pins):
        return  # reported already
    if link.inertia is not None and link.centre is not None and link.mass is not None and link.outline is None:
        return  # such a link needs no shape
    points = [places[pin] for pin in link.pins]
    if link.holes is not None and link.outline is None:
        yield ".holes: a link without an outline has no holes"
    if link.kind == "bar" and len(points) > 2:
        start, axis = points[0], points[-1] - points[0]
        for pin, point in list(zip(link.pins, points, strict=True))[1:-1]:
            distance = abs(axis[0] * (point - start)[1] - axis[1] * (point - start)[0]) / max(np.linalg.norm(axis), 1e-300)
            half_width = 0.5 * float(np.asarray(link.width))
            if distance > max(half_width, DRAWN_GAP * np.linalg.norm(axis)):
                yield (
                    f".pins: {quote(pin)} is {distance:.3g} m off the bar from {quote(link.pins[0])} to {quote(link.pins[-1])}: "
                    "leave out the width for a plate, give an outline, or put the ends of the bar first and last"
                )
    elif link.kind in ("plate", "outline"):
        key, corners = ("pins", np.array(points)) if link.kind == "plate" else ("outline", np.asarray(link.outline))
        if _crosses_itself(corners):
            yield f".{key}: the polygon crosses itself: give its corners in their order around it"
        elif abs(twice_area(corners)) <= SAME_PLACE_TOL * extent(list(corners)) ** 2:
            cure = "; a bar has a width" if key == "pins" else ""
            yield f".{key}: the corners lie on one line, and enclose no area{cure}"
        elif key == "outline" and not any(_reaches(corners, point) for point in points):
            yield f".outline: crosses none of the pins {', '.join(map(quote, link.pins))}"
        for k, hole in enumerate([] if link.holes is None else np.asarray(link.holes)):
            if abs(twice_area(hole)) <= SAME_PLACE_TOL * extent(list(corners)) ** 2:
                yield f".holes[{k}]: the corners lie on one line, and enclose no area"
            elif not _reaches(corners, hole[0]):
                yield f".holes[{k}]: lies outside of the outline"


def _crosses_itself(corners: np.ndarray) -> bool:
    (ax, ay), (bx, by) = corners.T[:, :, None], np.roll(corners, -1, axis=0).T[:, :, None]

    def side(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.sign((bx - ax) * (y.T - ay) - (by - ay) * (x.T - ax))

    parted = side(ax, ay) * side(bx, by) < 0  # the ends of side k are on both sides of the line of side i
    return bool((parted & parted.T).any())


def _reaches(corners: np.ndarray, point: PointArray) -> bool:
    """Return True if a point is inside a polygon, or outside by no more than the gaps of a drawing to scale."""
    outside_by = distances_from_segments(np.asarray(point)[None], corners, np.roll(corners, -1, axis=0)).min()
    return bool(outside_by <= DRAWN_GAP * extent(list(corners))) or contains(corners, np.asarray(point))


def gap_mistakes(placement: Placement, groups: DrawnGroups) -> Iterator[str]:
    """Iterate over messages about slots, gears and cams that do not fit as drawn; all numbers are concrete."""
    size = extent(list(placement.places.values()))
    for k, (name, slot) in enumerate(groups["slot"].items()):
        distance = _off_line(placement, slot) if slot.along else 0.0
        if distance > DRAWN_GAP * size:
            line = " and ".join(map(quote, slot.along))
            yield f"{where('slot', k, name)}.pin: {quote(slot.pin)} is {distance:.3g} m off the line through {line}, its slot"
    for k, (name, gear) in enumerate(groups["gear"].items()):
        assert isinstance(gear, GearPair)
        misfit = gear.misfit(placement)
        if misfit is not None and abs(misfit[0] - misfit[1]) > DRAWN_GAP * misfit[0]:
            yield (
                f"{where('gear', k, name)}.radii: wheels of these radii are {misfit[1]:.4g} m apart, and their centres "
                f"{misfit[0]:.4g} m: give teeth, or move a pin"
            )
    for k, (name, cam) in enumerate(groups["cam"].items()):
        assert isinstance(cam, CamPair)
        if problem := cam.unreachable(placement):
            yield f"{where('cam', k, name)}.profile.{problem}"


def _off_line(placement: Placement, slot: PinInSlot) -> float:
    start, end = (placement.places[pin] for pin in slot.along)
    direction, arm = end - start, placement.places[slot.pin] - start
    return float(abs(direction[0] * arm[1] - direction[1] * arm[0]) / np.linalg.norm(direction))
