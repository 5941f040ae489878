"""Symbols of a position, and components of vectors that are written in these symbols."""

from udkjax.scene.elements.bodies import GROUND
from udkjax.study.worked.iterations import PositionMotion
from udkjax.study.worked.loops import LoopVector
from udkjax.study.worked.terms import (
    EquationLine,
    EquationTerm,
    NamedQuantity,
    ProductOfTerms,
    of_angle,
    total,
)

AXES = ("x", "y")
COMPONENT_FUNCTIONS = ("cos", "sin")


class PositionSymbols:
    """The symbols of a position: lengths, angles and their derivatives, with their values."""

    def __init__(self, motion: PositionMotion, pins_of_slides: dict[str, str]):
        self.motion, self.pins = motion, pins_of_slides

    def angle(self, body: str, order: int = 0) -> NamedQuantity:
        """Return the angle of a body (`order` 0), its angular velocity (1) or its angular acceleration (2)."""
        letter, unit = (("θ", "rad"), ("ω", "rad/s"), ("α", "rad/s2"))[order]
        return NamedQuantity(letter, body, self.motion.angles[body][order], unit)

    def length(self, vector: LoopVector, order: int = 0) -> NamedQuantity:
        """Return the length of a vector, or its derivative of an `order`, which may be 1 or 2 for a vector along a line."""
        if not vector.slide:
            return NamedQuantity("r", vector.start + vector.end, vector.size, "m")
        return NamedQuantity(
            "s", self.pins[vector.slide], self.motion.slides[vector.slide][order], ("m", "m/s", "m/s2")[order], order
        )

    def direction(self, vector: LoopVector) -> EquationTerm:
        """Return the angle of a vector: the angle of its body plus a constant angle."""
        if vector.body == GROUND:
            return NamedQuantity("φ", vector.start + vector.end, vector.turn, "rad")
        angle = self.angle(vector.body)
        return total((1.0, angle), (1.0, self.turn(vector))) if vector.turn else angle

    @staticmethod
    def turn(vector: LoopVector) -> NamedQuantity:
        """Return the constant angle between a vector and its body."""
        return NamedQuantity("δ", vector.start + vector.end, vector.turn, "rad")


def component(symbols: PositionSymbols, vector: LoopVector, axis: int) -> EquationTerm:
    """Return the component of a vector along x (`axis` 0) or y (1)."""
    return ProductOfTerms((symbols.length(vector), of_angle(COMPONENT_FUNCTIONS[axis], symbols.direction(vector))))


def defined(letter: str, index: str, right: EquationTerm, unit: str) -> tuple[NamedQuantity, EquationLine]:
    """Return a symbol with the value of the term `right`, and the line that defines the symbol by this term."""
    found = NamedQuantity(letter, index, right.value, unit)
    return found, EquationLine(right, found)
