"""Pins in Python: tables with the keys of a file, in the units of the drawing."""

from collections.abc import Sequence
from typing import Any, Literal

from jaxtyping import Array

from udkjax.annotations import Numbers


def polar(
    start: str, length: Numbers | str, angle: Numbers | str | None = None, line: Sequence[str] = (), along: Numbers | None = None
) -> dict[str, Any]:
    """Return a pin at a length and an angle from another one, for `Drawing(pins={"A": udk.polar("O", 40, 60), ...})`.

    Args:
        start: The other pin.
        length: The distance, in the drawing's unit of length, or a string with its unit.
        angle: The angle, anticlockwise, in the drawing's unit of angle, or a string with its unit.
        line: Two pins: the angle is counted from the direction from the first to the second; by default from the x axis.
        along: Instead of an angle: a vector in whose direction the pin lies.

    Returns:
        The pin as a table with the keys of a file.
    """
    return _table(**{"from": start}, length=length, angle=angle, line=list(line) or None, along=along)


def circles(centres: Sequence[str], lengths: Sequence[Numbers | str] | Array, side: Literal["left", "right"]) -> dict[str, Any]:
    """Return a pin at given lengths from two others, for `Drawing(pins={"B": udk.circles("AC", (120, 80), "left"), ...})`.

    Args:
        centres: The two other pins.
        lengths: The distances from them, in the drawing's unit of length, or strings with their unit.
        side: The side of the new pin, seen along the direction from the first of the two pins to the second: "left" or "right".

    Returns:
        The pin as a table with the keys of a file.
    """
    return _table(**{"from": list(centres)}, length=lengths, side=side)


def on_rail(
    start: str, length: Numbers | str, on: str, along: Numbers, side: Literal["ahead", "behind"] = "ahead"
) -> dict[str, Any]:
    """Return a pin at a length from another one, on a line, for `Drawing(pins={"P": udk.on_rail("A", 200, "O", (1, 0)), ...})`.

    Args:
        start: The other pin, such as that of a crank.
        length: The distance from it, in the drawing's unit of length, or a string with its unit.
        on: A pin of the line.
        along: The direction of the line, a vector.
        side: The choice between the two points: "ahead" of the other pin along the line, or "behind".

    Returns:
        The pin as a table with the keys of a file.
    """
    return _table(**{"from": start}, length=length, on=on, along=along, side=side)


def on_line(
    start: str,
    end: str,
    share: Numbers | None = None,
    length: Numbers | str | None = None,
    off: Numbers | str | None = None,
) -> dict[str, Any]:
    """Return a pin on, or beside, the line through two others, for `Drawing(pins={"M": udk.on_line("A", "B", 0.5), ...})`.

    Args:
        start: The pin from which the share or the length is counted.
        end: The other pin of the line.
        share: A fraction of the distance of the two pins.
        length: Instead of a share: the distance from the first pin, in the drawing's unit of length, or a string with its unit.
        off: The distance of the new pin from the line, to its left.

    Returns:
        The pin as a table with the keys of a file.
    """
    return _table(**{"from": start}, to=end, share=share, length=length, off=off)


def stacked(pin: str) -> dict[str, Any]:
    """Return a pin at the place of another one, for `Drawing(pins={"A": (0, 1), "B": udk.stacked("A"), ...})`.

    The links at one of them are not joined to those at the other, as in linkages whose links lie in several layers.

    Args:
        pin: The other pin.

    Returns:
        The pin as a table with the keys of a file.
    """
    return _table(stacked=pin)


def _table(**given: Any) -> dict[str, Any]:
    return {key: value for key, value in given.items() if value is not None}
