"""Terms of the equations of a worked solution: each has a value, and is written by symbols or with its numbers put in."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import NamedTuple

import numpy as np

from udkjax.scene.drawing.drawn_quantities import Units

PLAIN_UNITS = ("", "1")
LONGEST_LINE = 48  # characters with numbers; longer lines are divided
_DERIVATIVE_DOTS = {1: "\u02d9", 2: "\u00a8"}  # dots of the first and the second derivative
_FUNCTIONS = {"cos": np.cos, "sin": np.sin, "sqrt": np.sqrt, "acos": np.arccos, "atan2": np.arctan2}
_ANGLES_OF = ("acos", "atan2")
_SHOWN_ANGLES = {"acos": "arccos", "atan2": "atan2"}


class NumberStyle(NamedTuple):
    """The units of printed numbers, those of the drawing with angles in degrees, and their significant digits."""

    units: Units
    digits: int = 6

    def size(self, unit: str) -> float:
        """Return the size of the shown unit in the SI unit `unit`, which may be a product such as "m2", or "rad" for an angle."""
        length = self.units.size("m")
        sizes = {"rad": np.pi / 180, "m2": length**2, "m3": length**3, "m/s2": length, "N m": 1.0, "rad/s": 1.0}
        return sizes.get(unit, length if unit in ("m", "m/s") else 1.0)

    def unit(self, unit: str) -> str:
        """Return the name of the unit in which a quantity with the SI unit `unit` is shown."""
        length = self.units.shown("m")
        names = {
            "rad": "°",
            "m": length,
            "m2": f"{length}²",
            "m/s": f"{length}/s",
            "m/s2": f"{length}/s²",
            "rad/s2": "rad/s²",
            "arm": "m",
        }
        return names.get(unit, unit)

    def number(self, value: float, unit: str) -> str:
        """Return the digits of a value in the shown unit; `value` is in the SI unit `unit`."""
        text = f"{float(value) / self.size(unit):.{self.digits}g}"
        return "0" if float(text) == 0.0 else text


class EquationTerm(ABC):
    """A part of an equation."""

    @property
    @abstractmethod
    def value(self) -> float:
        """The value in SI units."""

    @abstractmethod
    def text(self, style: NumberStyle, numbers: bool = True) -> str:
        """Return the term as an expression, with numbers or with names."""

    @abstractmethod
    def mathml(self, style: NumberStyle, numbers: bool) -> str:
        """Return the term as MathML, with numbers or with symbols."""


@dataclass(frozen=True)
class NamedQuantity(EquationTerm):
    """A quantity: a letter with an index, its value and its SI unit; `order` counts the dots of a derivative in time."""

    letter: str
    index: str
    known: float
    unit: str
    order: int = 0
    open: bool = False  # an unknown whose number is not put in

    @property
    def value(self):
        return self.known

    @property
    def name(self) -> str:
        """The symbol in plain text, such as r_AB."""
        return f"{'d' * self.order}{self.letter}" + (f"_{self.index}" if self.index else "")

    def text(self, style, numbers=True):
        if not numbers or self.open:
            return self.name
        written = style.number(self.known, self.unit)
        return f"({written})" if written.startswith("-") else written

    def mathml(self, style, numbers):
        if numbers and not self.open:
            return _number(style.number(self.known, self.unit), "°" if self.unit == "rad" else "")
        letter = f"<mi>{escape(self.letter)}</mi>"
        if self.order:
            letter = f'<mover accent="true">{letter}<mo>{_DERIVATIVE_DOTS[self.order]}</mo></mover>'
        return f"<msub>{letter}<mtext>{escape(self.index)}</mtext></msub>" if self.index else letter


@dataclass(frozen=True)
class PlainFactor(EquationTerm):
    """A plain number that is part of a formula, such as the 2 of 2 a b."""

    known: float

    @property
    def value(self):
        return self.known

    def text(self, style, numbers=True):
        return f"{self.known:g}"

    def mathml(self, style, numbers):
        return _number(f"{self.known:g}", "")


@dataclass(frozen=True)
class SumOfTerms(EquationTerm):
    """A sum of terms with signs."""

    parts: tuple[tuple[float, EquationTerm], ...]

    @property
    def value(self):
        return float(sum(sign * term.value for sign, term in self.parts))

    @property
    def scale(self) -> float:
        """The largest absolute value of a term; 0 without terms."""
        return max((abs(term.value) for _, term in self.parts), default=0.0)

    def text(self, style, numbers=True):
        if not self.parts:
            return "0"
        return _signed([(sign, _grouped_text(term, style, numbers)) for sign, term in self.parts], "-", "+", " ")

    def mathml(self, style, numbers):
        if not self.parts:
            return "<mn>0</mn>"
        inner = [(sign, _grouped(term, style, numbers)) for sign, term in self.parts]
        return f"<mrow>{_signed(inner, '<mo>−</mo>', '<mo>+</mo>', '')}</mrow>"


@dataclass(frozen=True)
class ProductOfTerms(EquationTerm):
    """A product of factors."""

    factors: tuple[EquationTerm, ...]

    @property
    def value(self):
        return float(np.prod([term.value for term in self.factors]))

    def text(self, style, numbers=True):
        return "*".join(_factor_text(term, style, numbers) for term in self.factors)

    def mathml(self, style, numbers):
        sign = "<mo>·</mo>" if numbers else "<mo>&#8290;</mo>"
        return f"<mrow>{sign.join(_factor(term, style, numbers) for term in self.factors)}</mrow>"


@dataclass(frozen=True)
class RatioOfTerms(EquationTerm):
    """A fraction."""

    above: EquationTerm
    below: EquationTerm

    @property
    def value(self):
        return self.above.value / self.below.value

    def text(self, style, numbers=True):
        return f"({self.above.text(style, numbers)})/({self.below.text(style, numbers)})"

    def mathml(self, style, numbers):
        return f"<mfrac>{self.above.mathml(style, numbers)}{self.below.mathml(style, numbers)}</mfrac>"


@dataclass(frozen=True)
class SquaredTerm(EquationTerm):
    """A squared term."""

    inner: EquationTerm

    @property
    def value(self):
        return self.inner.value**2

    def text(self, style, numbers=True):
        return f"({self.inner.text(style, numbers)})**2"

    def mathml(self, style, numbers):
        return f"<msup>{_factor(self.inner, style, numbers)}<mn>2</mn></msup>"


@dataclass(frozen=True)
class AppliedFunction(EquationTerm):
    """A function of terms: cos, sin, sqrt, acos or atan2."""

    name: str
    given: tuple[EquationTerm, ...] = field(default=())

    @property
    def value(self):
        return float(_FUNCTIONS[self.name](*(term.value for term in self.given)))

    def text(self, style, numbers=True):
        return f"{self.name}({', '.join(term.text(style, numbers) for term in self.given)})"

    def mathml(self, style, numbers):
        inner = [term.mathml(style, numbers) for term in self.given]
        if self.name == "sqrt":
            return f"<msqrt>{inner[0]}</msqrt>"
        if self.name in ("cos", "sin") and isinstance(self.given[0], NamedQuantity):
            return f"<mrow><mi>{self.name}</mi><mo>&#8289;</mo>{_factor(self.given[0], style, numbers)}</mrow>"
        name = _SHOWN_ANGLES.get(self.name, self.name)
        return f"<mrow><mi>{name}</mi><mo>(</mo>{'<mo>,</mo>'.join(inner)}<mo>)</mo></mrow>"


def _number(digits: str, unit: str) -> str:
    mantissa, _, power = digits.partition("e")
    sign = "<mo>−</mo>" if mantissa.startswith("-") else ""
    raised = f"<mo>·</mo><msup><mn>10</mn><mn>{int(power)}</mn></msup>".replace("-", "−") if power else ""
    return f"<mrow>{sign}<mn>{mantissa.lstrip('-')}{unit}</mn>{raised}</mrow>"


def _signed(parts: Sequence[tuple[float, str]], minus: str, plus: str, space: str) -> str:
    first, *others = parts
    begin = (minus if first[0] < 0 else "") + first[1]
    return begin + "".join(f"{space}{minus if sign < 0 else plus}{space}{term}" for sign, term in others)


def _is_negative(term: EquationTerm, numbers: bool) -> bool:
    return numbers and isinstance(term, NamedQuantity) and not term.open and term.known < 0.0


def _grouped(term: EquationTerm, style: NumberStyle, numbers: bool) -> str:
    inner = term.mathml(style, numbers)
    return _in_brackets(inner) if isinstance(term, SumOfTerms) or _is_negative(term, numbers) else inner


def _factor(term: EquationTerm, style: NumberStyle, numbers: bool) -> str:
    inner = term.mathml(style, numbers)
    return _in_brackets(inner) if _is_compound(term) or _is_negative(term, numbers) else inner


def _is_compound(term: EquationTerm) -> bool:
    return isinstance(term, SumOfTerms) and (len(term.parts) > 1 or any(sign < 0 for sign, _ in term.parts))


def _in_brackets(inner: str) -> str:
    return f"<mrow><mo>(</mo>{inner}<mo>)</mo></mrow>"


def _grouped_text(term: EquationTerm, style: NumberStyle, numbers: bool) -> str:
    inner = term.text(style, numbers)
    return f"({inner})" if isinstance(term, SumOfTerms) else inner


def _factor_text(term: EquationTerm, style: NumberStyle, numbers: bool) -> str:
    inner = term.text(style, numbers)
    return f"({inner})" if _is_compound(term) else inner


def of_angle(name: str, angle: EquationTerm) -> EquationTerm:
    """Return the cosine or sine of an angle."""
    return AppliedFunction(name, (angle,))


def total(*parts: tuple[float, EquationTerm]) -> SumOfTerms:
    """Return a sum of terms with signs."""
    return SumOfTerms(tuple(parts))


class EquationLine(NamedTuple):
    """An equation: `left` equals `right`; without a left side, `right` is zero.

    Attributes:
        right: the right side.
        left: the symbol on the left side; None if the equation is right = 0.
        words: an explanation, or "".
    """

    right: EquationTerm
    left: NamedQuantity | None = None
    words: str = ""

    @property
    def residual(self) -> float:
        """The difference of the two sides, relative to the largest of these or of the terms of a sum."""
        left = 0.0 if self.left is None else self.left.value
        difference = abs(left - self.right.value)
        scale = max(abs(left), self.right.scale if isinstance(self.right, SumOfTerms) else abs(self.right.value))
        return difference / scale if scale else difference

    def text(self, style: NumberStyle, numbers: bool = True) -> str:
        """Return the equation as text, with numbers or with names."""
        right = self.right.text(style, numbers)
        if self.left is None:
            return f"{right} = 0"
        unit = "" if self.left.unit in PLAIN_UNITS else f" {style.unit(self.left.unit)}"
        result = f" = {style.number(self.left.value, self.left.unit)}{unit}" if numbers else ""
        if self.right is self.left:  # a value alone
            return f"{self.left.name}{result}"
        return f"{self.left.name} = {right}{result}"

    def _pieces(self, style: NumberStyle, numbers: bool, before: str = "") -> list[str]:
        """Return the right side in MathML, with numbers or symbols, a piece for each term of a sum; `before` begins the first."""
        if not isinstance(self.right, SumOfTerms):
            return [f"{before}{self.right.mathml(style, numbers)}"]
        pieces = []
        for k, (sign, term) in enumerate(self.right.parts):
            mark = "<mo>−</mo>" if sign < 0 else "<mo>+</mo>" if k else ""
            pieces.append(f"{before if k == 0 else ''}{mark}{_grouped(term, style, numbers)}")
        return pieces

    def mathml(self, style: NumberStyle) -> str:
        """Return the equation as MathML: by symbols, with numbers put in, and its value with its unit."""
        if self.left is None:
            return "".join(_wrapped([*self._pieces(style, numbers), "<mo>=</mo><mn>0</mn>"]) for numbers in (False, True))
        steps = [self.right.mathml(style, False), self.right.mathml(style, True)]
        unit = style.unit(self.left.unit)
        shown = _number(style.number(self.left.value, self.left.unit), unit if unit == "°" else "")
        shown += f'<mspace width="0.25em"></mspace><mtext>{escape(unit)}</mtext>' if unit not in (*PLAIN_UNITS, "°") else ""
        steps = steps[:1] if steps[0] == steps[1] else steps
        if steps[-1] == shown:
            steps = steps[:-1]
        left = self.left.mathml(style, False)
        if self.right is self.left:  # a value alone
            return _math(f"{left}<mo>=</mo>{shown}")
        if len(steps) == 2 and len(self.text(style)) > LONGEST_LINE:  # by symbols, and below it with numbers
            with_numbers = [*self._pieces(style, True, "<mo>=</mo>"), f"<mo>=</mo>{shown}"]
            return _wrapped(self._pieces(style, False, f"{left}<mo>=</mo>")) + _wrapped(with_numbers)
        return _math("<mo>=</mo>".join([left, *steps, shown]))


def _wrapped(pieces: Sequence[str]) -> str:
    """Return an equation in HTML from pieces of a formula, between which a line may break."""
    inner = " ".join(f'<math displaystyle="true"><mrow>{piece}</mrow></math>' for piece in pieces)
    return f'<div class="equation">{inner}</div>'


def _math(inner: str) -> str:
    return f'<div class="equation"><math displaystyle="true"><mrow>{inner}</mrow></math></div>'
