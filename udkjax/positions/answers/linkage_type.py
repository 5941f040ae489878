"""Grashof's types of the four-bars in a mechanism, and its mobility, counted and true."""

from collections.abc import Collection, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.arrays import ROUNDING
from udkjax.equations.rows.analysis import analyse
from udkjax.positions.assembling.coordinates import Coordinate
from udkjax.positions.following.drive import without_drivers
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import plural

LINK_NAMES = ("ground", "input", "coupler", "output")


class FourBarType(NamedTuple):
    """A four-bar loop on the ground.

    Attributes:
        pins: its pins in order, from the input's pin on the ground.
        links: the ground, the input, the coupler and the output.
        lengths: their lengths (m), in this order.
        kind: crank-rocker, rocker-crank, double crank, double rocker, triple rocker or change point.
        grashof: the sum of the shortest and the longest length, minus that of the others (m): below zero, the shortest turns.
    """

    pins: tuple[str, ...]
    links: tuple[str, ...]
    lengths: tuple[float, ...]
    kind: str
    grashof: float

    @property
    def words(self) -> str:
        """Grashof's condition and the type of the four-bar, as a phrase."""
        sign = "=" if self.kind == "change point" else "<" if self.grashof < 0 else ">"
        return f"{self.kind} ({'-'.join(self.pins)}: shortest + longest {sign} sum of the others)"


def four_bars(mechanism: Mechanism, driver: Coordinate | None = None) -> list[FourBarType]:
    """Return the four-bar loops on the ground, each beginning with its input: the link that the driver turns, or else the first.

    Grashof's condition s + l < p + q on the shortest, the longest and the other lengths lets the shortest link turn all the way
    round relative to the others. With the input as the shortest link: crank-rocker; the ground: double crank; the coupler: double
    rocker; the output: rocker-crank. With s + l > p + q no link turns: triple rocker.
    """
    driven = set() if driver is None or driver.coordinate != "angle" else {*driver.bodies}
    pins = pins_with_bodies(mechanism)
    return [_type_of(pins, loop, driven) for loop in _loops(mechanism, pins)]


Loop = list[tuple[str, str]]  # bodies in order from the ground, each with the pin by which it is reached
Pins = dict[str, dict[str, np.ndarray]]  # the bodies at each pin, with its place in the frame of each (m)


def pins_with_bodies(mechanism: Mechanism) -> Pins:
    """Return the pins of revolute joints; joints at the same point of a body are one pin of all of their bodies.

    Args:
        mechanism: the mechanism.

    Returns:
        By the name of the first revolute of a pin, its place in the frame of each body (m), by the names of the bodies.
    """
    found: Pins = {}
    for name, joint in mechanism.joints.items():
        if not isinstance(joint, Revolute):
            continue
        ends = dict(zip(joint.bodies, np.asarray(joint.points), strict=True))
        same = [
            pin
            for pin, at in found.items()
            if any(body in at and np.allclose(at[body], p, rtol=ROUNDING, atol=0.0) for body, p in ends.items())
        ]
        found.setdefault(same[0] if same else name, {}).update(ends)
    return found


def transmission_pins(
    mechanism: Mechanism, driven: Collection[str]
) -> dict[str, list[tuple[str, Float[np.ndarray, "2"], Float[np.ndarray, "2"]]]]:
    """Return the pins of two moving links of two pins each, between which force is transmitted.

    Args:
        mechanism: the mechanism.
        driven: the names of links that are driven, whose pins are left out.

    Returns:
        By the name of the pin, for both of its links: the name, and the places of the pin and of the other pin in its frame (m).
    """
    pins, found = pins_with_bodies(mechanism), {}
    of_body = {body: [pin for pin, at in pins.items() if body in at] for body in mechanism.body_names}
    for pin, at in pins.items():
        if len(at) == 2 and GROUND not in at and not {*at} & {*driven} and all(len(of_body[body]) == 2 for body in at):
            others = {body: next(other for other in of_body[body] if other != pin) for body in at}
            found[pin] = [(body, place, pins[others[body]][body]) for body, place in at.items()]
    return found


def _loops(mechanism: Mechanism, pins: Pins) -> Iterator[Loop]:
    """Yield the closed chains of the ground and three links, connected by four different pins, each in one direction."""

    def onward(body: str) -> Iterator[tuple[str, str]]:
        yield from ((pin, other) for pin, at in pins.items() if body in at for other in at if other != body)

    order = list(mechanism.body_names)
    for o, first in onward(GROUND):
        for a, middle in onward(first):
            for b, last in onward(middle):
                for c, end in onward(last):
                    bodies, loop = {first, middle, last, GROUND}, {o, a, b, c}
                    if end == GROUND and len(bodies) == 4 and len(loop) == 4 and order.index(first) < order.index(last):
                        yield [(GROUND, c), (first, o), (middle, a), (last, b)]


def _type_of(at: Pins, loop: Loop, driven: set[str]) -> FourBarType:
    if loop[3][0] in driven and loop[1][0] not in driven:  # the last link is the input: go round the other way
        (ground, c), (first, o), (middle, a), (last, b) = loop
        loop = [(ground, o), (last, c), (middle, b), (first, a)]
    pins = tuple(pin for _, pin in (*loop[1:], loop[0]))
    ends = [(pins[3], pins[0]), *pairwise(pins)]
    lengths = tuple(float(np.linalg.norm(at[b][body] - at[a][body])) for (body, _), (a, b) in zip(loop, ends, strict=True))
    ordered = sorted(lengths)
    excess = ordered[0] + ordered[3] - ordered[1] - ordered[2]
    shortest = LINK_NAMES[int(np.argmin(lengths))]
    kinds = {"ground": "double crank", "input": "crank-rocker", "coupler": "double rocker", "output": "rocker-crank"}
    kind = "change point" if abs(excess) <= ROUNDING * sum(lengths) else "triple rocker" if excess > 0 else kinds[shortest]
    return FourBarType(pins, tuple(body for body, _ in loop), lengths, kind, excess)


class Mobility(NamedTuple):
    """Degrees of freedom without drivers.

    Attributes:
        counted: Gruebler's count: three for each moving link, minus the number of rows of all joints.
        true: three for each moving link, minus the rank of these rows in a generic position; None if the rank is not known.
        links: the number of links, including the ground.
        joints: the number of joints.
    """

    counted: int
    true: int | None
    links: int
    joints: int

    @property
    def words(self) -> str:
        """Gruebler's count, and the degrees of freedom if they differ, as a phrase."""
        elements = f"{self.links} links and {plural(self.joints, 'joint')}"
        same = f"{self.counted}, by Gruebler's count of {elements}"
        if self.true is None or self.true == self.counted:
            return same
        return f"{self.true}; Gruebler's count of {elements} says {self.counted}"


def mobility(mechanism: Mechanism) -> Mobility:
    """Return the degrees of freedom without drivers, by Gruebler's count and by the rank of the constraints."""
    bare = analyse(without_drivers(mechanism))
    rows, bodies = len(bare.row_names), len(mechanism.bodies)
    return Mobility(3 * bodies - rows, bare.degrees_of_freedom, bodies + 1, len(mechanism.joints))
