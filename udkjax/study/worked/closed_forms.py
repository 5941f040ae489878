"""Positions of a vector loop in closed form, on each branch."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from udkjax.study.worked.loops import LoopVector, VectorLoop, wrapped
from udkjax.study.worked.symbols import AXES, COMPONENT_FUNCTIONS, PositionSymbols, component, defined
from udkjax.study.worked.terms import (
    AppliedFunction,
    EquationLine,
    EquationTerm,
    NamedQuantity,
    PlainFactor,
    ProductOfTerms,
    RatioOfTerms,
    SquaredTerm,
    of_angle,
    total,
)


class BranchPosition(NamedTuple):
    """The solution of a loop for its unknowns on one branch.

    Attributes:
        words: name of the branch, such as "open"; "" if there is only one.
        is_actual: True if the drawing's position is on this branch.
        lines: the equations of the unknowns.
    """

    words: str
    is_actual: bool
    lines: list[EquationLine]


def known_part(symbols: PositionSymbols, loop: VectorLoop) -> tuple[list[EquationLine], list[NamedQuantity]]:
    """Return the lines of K, the sum of all vectors that do not depend on the unknowns, and the components of K."""
    known = [x for x in loop.vectors if not _is_unknown(x, loop)]
    lines = []
    for axis in (0, 1):
        right = total(*((x.sign, component(symbols, x, axis)) for x in known))
        lines.append(EquationLine(right, NamedQuantity("K", AXES[axis], right.value, "m")))
    return lines, [line.left for line in lines if line.left is not None]


def _is_unknown(vector: LoopVector, loop: VectorLoop) -> bool:
    return vector.body in loop.angles or vector.slide in loop.slides


def solve(symbols: PositionSymbols, loop: VectorLoop) -> tuple[list[EquationLine], list[BranchPosition]]:
    """Return the lines that all solutions of a loop share, and its solutions; no solutions if there is no closed form."""
    unknown = [x for x in loop.vectors if _is_unknown(x, loop)]
    shared, (kx, ky) = known_part(symbols, loop)
    if len(loop.angles) == 2 and len(unknown) == 2 and {x.body for x in unknown} == {*loop.angles}:
        return _two_angles(symbols, unknown, shared, kx, ky)
    if len(loop.angles) == len(loop.slides) == 1 and len(unknown) == 2:
        sliding = next(x for x in unknown if x.slide in loop.slides)
        other = next(x for x in unknown if x is not sliding)
        if sliding.body not in loop.angles:
            return _angle_and_length(symbols, other, sliding, shared, kx, ky)
    if len(loop.angles) == len(loop.slides) == 1 and all(x.body in loop.angles for x in unknown):
        sliding = next((x for x in unknown if x.slide in loop.slides), None)
        others = [x for x in unknown if x is not sliding]
        across = others[0] if others else None
        if sliding is not None and len(others) <= 1 and (across is None or _is_across(across, sliding)):
            return _line_of_unknown(symbols, sliding, across, shared, kx, ky)
    if len(loop.slides) == 2 and not loop.angles and len(unknown) == 2:
        return _two_lengths(symbols, unknown, shared, kx, ky)
    return [], []


def _is_across(vector: LoopVector, line: LoopVector) -> bool:
    return abs(abs(wrapped(vector.turn - line.turn)) - np.pi / 2) < 1e-9


def _less_turn(letter: str, vector: LoopVector, direction: NamedQuantity, lines: list[EquationLine]) -> NamedQuantity:
    """Return the angle of a vector's body: `direction`, the vector's angle, minus the constant angle between them.

    Its line is appended to `lines`, unless the two angles are equal.
    """
    if not vector.turn:
        return direction
    angle, line = defined(letter, vector.body, total((1.0, direction), (-1.0, PositionSymbols.turn(vector))), "rad")
    lines.append(line)
    return angle


def _two_angles(
    symbols: PositionSymbols, unknown: Sequence[LoopVector], shared: list[EquationLine], kx: NamedQuantity, ky: NamedQuantity
) -> tuple[list[EquationLine], list[BranchPosition]]:
    """Return the shared lines and the two branches of K + a e(phi1) + b e(phi2) = 0, with unit vectors e.

    The law of cosines gives phi1 from the direction of K, on both sides of it.
    """
    first, second = unknown
    a, b = symbols.length(first), symbols.length(second)
    k, k_line = defined("K", "", AppliedFunction("sqrt", (total((1.0, SquaredTerm(kx)), (1.0, SquaredTerm(ky))),)), "m")
    beta, beta_line = defined("β", "", AppliedFunction("atan2", (ky, kx)), "rad")
    above = total((1.0, SquaredTerm(b)), (-1.0, SquaredTerm(a)), (-1.0, SquaredTerm(k)))
    cosine = RatioOfTerms(above, ProductOfTerms((PlainFactor(2.0 * first.sign), a, k)))
    gamma, gamma_line = defined("γ", "", AppliedFunction("acos", (cosine,)), "rad")
    found = []
    for sign in (1.0, -1.0):
        lines: list[EquationLine] = []
        phi, line = _angle_symbol(first, total((1.0, beta), (sign, gamma)))
        lines.append(line)
        one = _less_turn("θ", first, phi, lines)
        parts = []
        for axis, known in enumerate((kx, ky)):
            sum_ = total((1.0, known), (first.sign, ProductOfTerms((a, of_angle(COMPONENT_FUNCTIONS[axis], phi)))))
            parts.append(total((-second.sign, sum_)))
        psi, line = _angle_symbol(second, AppliedFunction("atan2", (parts[1], parts[0])))
        lines.append(line)
        two = _less_turn("θ", second, psi, lines)
        actual = _same_angle(one.value, symbols.angle(first.body).value) and _same_angle(
            two.value, symbols.angle(second.body).value
        )
        found.append(BranchPosition("", actual, lines))
    return [*shared, k_line, beta_line, gamma_line], _named(found, ("open", "crossed"))


def _angle_symbol(vector: LoopVector, right: EquationTerm) -> tuple[NamedQuantity, EquationLine]:
    letter, index = ("φ", vector.start + vector.end) if vector.turn else ("θ", vector.body)
    return defined(letter, index, right, "rad")


def _same_angle(one: float, other: float) -> bool:
    return abs(wrapped(one - other)) < 1e-6


def _named(found: list[BranchPosition], names: tuple[str, str]) -> list[BranchPosition]:
    return [x._replace(words=name) for x, name in zip(found, names, strict=True)]


def _angle_and_length(
    symbols: PositionSymbols,
    other: LoopVector,
    sliding: LoopVector,
    shared: list[EquationLine],
    kx: NamedQuantity,
    ky: NamedQuantity,
) -> tuple[list[EquationLine], list[BranchPosition]]:
    """Return the shared lines and the two branches of K + c e(phi) + s e(psi) = 0, with known psi: a quadratic equation of s."""
    c, psi = symbols.length(other), symbols.direction(sliding)
    inner = total((1.0, ProductOfTerms((kx, of_angle("cos", psi)))), (1.0, ProductOfTerms((ky, of_angle("sin", psi)))))
    p, p_line = defined("p", "", inner, "m")
    root_of = total((1.0, SquaredTerm(p)), (-1.0, SquaredTerm(kx)), (-1.0, SquaredTerm(ky)), (1.0, SquaredTerm(c)))
    root, root_line = defined("w", "", AppliedFunction("sqrt", (root_of,)), "m")
    index, found = symbols.pins[sliding.slide], []
    for sign in (1.0, -1.0):
        s, line = defined("s", index, total((-sliding.sign, p), (sign, root)), "m")
        lines, parts = [line], []
        for axis, known in enumerate((kx, ky)):
            sum_ = total((1.0, known), (sliding.sign, ProductOfTerms((s, of_angle(COMPONENT_FUNCTIONS[axis], psi)))))
            parts.append(total((-other.sign, sum_)))
        phi, line = _angle_symbol(other, AppliedFunction("atan2", (parts[1], parts[0])))
        lines.append(line)
        angle = _less_turn("θ", other, phi, lines)
        actual = _same_angle(angle.value, symbols.angle(other.body).value) and _close(s, symbols.length(sliding), c)
        found.append(BranchPosition("", actual, lines))
    return [*shared, p_line, root_line], _named(found, ("plus sign", "minus sign"))


def _close(one: NamedQuantity, other: NamedQuantity, scale: NamedQuantity) -> bool:
    return abs(one.value - other.value) < 1e-6 * abs(scale.value)


def _line_of_unknown(
    symbols: PositionSymbols,
    sliding: LoopVector,
    across: LoopVector | None,
    shared: list[EquationLine],
    kx: NamedQuantity,
    ky: NamedQuantity,
) -> tuple[list[EquationLine], list[BranchPosition]]:
    """Return the shared lines and the two branches of K + (s e(turn) + h e(turn + 90 degrees)) e(theta) = 0.

    The product of unit vectors e adds their angles. Pythagoras gives s, and then the direction of K gives theta.
    """
    squares = [(1.0, SquaredTerm(kx)), (1.0, SquaredTerm(ky))]
    if across is not None:
        squares.append((-1.0, SquaredTerm(symbols.length(across))))
    under: EquationTerm = total(*squares)
    w, w_line = defined("w", "", AppliedFunction("sqrt", (under,)), "m")
    index, found = symbols.pins[sliding.slide], []
    for sign in (1.0, -1.0):
        s, line = defined("s", index, total((sign, w)), "m")
        lines = [line]
        minus = [total((-sliding.sign, known)) for known in (kx, ky)]
        way = AppliedFunction("atan2", (minus[1], minus[0]))
        parts: list[tuple[float, EquationTerm]] = [(1.0, way)]
        if across is not None:
            side = np.sign(wrapped(across.turn - sliding.turn)) * across.sign * sliding.sign
            parts.append((-1.0, AppliedFunction("atan2", (total((side, symbols.length(across))), s))))
        elif sign < 0:
            parts.append((1.0, NamedQuantity("π", "", np.pi, "rad")))
        phi, line = _angle_symbol(sliding, total(*parts))
        lines.append(line)
        angle = _less_turn("θ", sliding, phi, lines)
        actual = _same_angle(angle.value, symbols.angle(sliding.body).value) and _close(s, symbols.length(sliding), w)
        found.append(BranchPosition("", actual, lines))
    return [*shared, w_line], _named(found, ("plus sign", "minus sign"))


def _two_lengths(
    symbols: PositionSymbols, unknown: Sequence[LoopVector], shared: list[EquationLine], kx: NamedQuantity, ky: NamedQuantity
) -> tuple[list[EquationLine], list[BranchPosition]]:
    """Return the shared lines and the only branch of K + s1 e1 + s2 e2 = 0, linear in both lengths.

    The product with the normal of one line gives the length along the other.
    """
    lines = []
    for one, other in (unknown, unknown[::-1]):
        psi, chi = symbols.direction(one), symbols.direction(other)
        above = total(
            (one.sign, ProductOfTerms((ky, of_angle("cos", chi)))), (-one.sign, ProductOfTerms((kx, of_angle("sin", chi))))
        )
        below = of_angle("sin", total((1.0, chi), (-1.0, psi)))
        lines.append(defined("s", symbols.pins[one.slide], RatioOfTerms(above, below), "m")[1])
    return shared, [BranchPosition("", True, lines)]
