"""Velocities and accelerations of vector loops, as small linear systems."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from udkjax.scene.elements.bodies import GROUND
from udkjax.study.worked.loops import LoopVector, VectorLoop
from udkjax.study.worked.symbols import COMPONENT_FUNCTIONS, PositionSymbols, defined
from udkjax.study.worked.terms import (
    EquationLine,
    EquationTerm,
    NamedQuantity,
    PlainFactor,
    ProductOfTerms,
    RatioOfTerms,
    SquaredTerm,
    SumOfTerms,
    of_angle,
    total,
)

NO_TERMS = SumOfTerms(())


class LinearEquations(NamedTuple):
    """A linear system A x = b.

    Attributes:
        matrix: the lines that define the coefficients in A, by rows.
        right: the lines that define the entries of b.
        unknowns: the symbols of x, with the values that solve the system.
        lines: the lines of the solution.
    """

    matrix: list[list[EquationLine]]
    right: list[EquationLine]
    unknowns: list[NamedQuantity]
    lines: list[EquationLine]

    @property
    def coefficients(self) -> list[EquationLine]:
        """The lines of the coefficients without those that are zero by structure."""
        return [line for row in self.matrix for line in row if line.right != NO_TERMS]


def velocity_system(symbols: PositionSymbols, loops: Sequence[VectorLoop]) -> LinearEquations:
    """Return the linear system whose unknowns are the first derivatives of the unknowns of loops."""
    return _linear(symbols, loops, 1, lambda vector, axis: _velocity(symbols, vector, axis, loops))


def acceleration_system(symbols: PositionSymbols, loops: Sequence[VectorLoop]) -> LinearEquations:
    """Return the linear system whose unknowns are the second derivatives of the unknowns of loops.

    Its matrix is that of the velocities.
    """
    return _linear(symbols, loops, 2, lambda vector, axis: _acceleration(symbols, vector, axis, loops))


KnownParts = Callable[[LoopVector, int], list[tuple[float, EquationTerm]]]


def _linear(symbols: PositionSymbols, loops: Sequence[VectorLoop], order: int, known: KnownParts) -> LinearEquations:
    bodies = [body for loop in loops for body in loop.angles]
    slides = [slide for loop in loops for slide in loop.slides]
    unknowns = [symbols.angle(body, order) for body in bodies]
    lines_of = {x.slide: x for loop in loops for x in loop.vectors if x.slide}
    unknowns += [symbols.length(lines_of[slide], order) for slide in slides]
    matrix, right, row = [], [], 0
    for loop in loops:
        for axis in (0, 1):
            row += 1
            terms = [_of_angle(symbols, loop, body, axis) for body in bodies]
            terms += [_of_slide(symbols, loop, slide, axis) for slide in slides]
            units = ["m"] * len(bodies) + ["1"] * len(slides)
            matrix.append(
                [
                    EquationLine(term, NamedQuantity("a", f"{row}{column + 1}", term.value, unit))
                    for column, (term, unit) in enumerate(zip(terms, units, strict=True))
                ]
            )
            term = total(*((-sign, part) for x in loop.vectors for sign, part in known(x, axis)))
            letter, unit = (("b", "m/s"), ("c", "m/s2"))[order - 1]
            right.append(EquationLine(term, NamedQuantity(letter, f"{row}", term.value, unit)))
    solve_system = _cramer if len(unknowns) == 2 else _put_in
    return LinearEquations(matrix, right, unknowns, solve_system(matrix, right, unknowns))


def _of_angle(symbols: PositionSymbols, loop: VectorLoop, body: str, axis: int) -> SumOfTerms:
    """Return the coefficient of the rate of a body's angle: the sum of the loop's vectors on the body after a quarter turn."""
    parts = []
    for x in loop.vectors:
        if x.body == body:
            turned = ProductOfTerms((symbols.length(x), of_angle(COMPONENT_FUNCTIONS[1 - axis], symbols.direction(x))))
            parts.append((-x.sign if axis == 0 else x.sign, turned))
    return total(*parts)


def _of_slide(symbols: PositionSymbols, loop: VectorLoop, slide: str, axis: int) -> SumOfTerms:
    return total(*((x.sign, of_angle(COMPONENT_FUNCTIONS[axis], symbols.direction(x))) for x in loop.vectors if x.slide == slide))


def _velocity(
    symbols: PositionSymbols, vector: LoopVector, axis: int, loops: Sequence[VectorLoop]
) -> list[tuple[float, EquationTerm]]:
    """Return the known parts of a vector's rate along an axis: r omega across the vector, and its change of length along it."""
    sign, way = vector.sign, symbols.direction(vector)
    across = (-sign if axis == 0 else sign, of_angle(COMPONENT_FUNCTIONS[1 - axis], way))
    found = []
    if vector.body != GROUND and not _has(loops, vector.body, "angles"):
        found.append((across[0], ProductOfTerms((symbols.length(vector), symbols.angle(vector.body, 1), across[1]))))
    if vector.slide and not _has(loops, vector.slide, "slides"):
        found.append((sign, ProductOfTerms((symbols.length(vector, 1), of_angle(COMPONENT_FUNCTIONS[axis], way)))))
    return found


def _acceleration(
    symbols: PositionSymbols, vector: LoopVector, axis: int, loops: Sequence[VectorLoop]
) -> list[tuple[float, EquationTerm]]:
    """Return the known parts of a vector's second derivative along an axis, each with a sign.

    These are the tangential part, the part along the line, the Coriolis part (2 times rate times omega), and the centripetal
    part.
    """
    sign, way, size = vector.sign, symbols.direction(vector), symbols.length(vector)
    along, across = of_angle(COMPONENT_FUNCTIONS[axis], way), of_angle(COMPONENT_FUNCTIONS[1 - axis], way)
    turned = -sign if axis == 0 else sign
    found: list[tuple[float, EquationTerm]] = []
    if vector.body != GROUND:
        omega = symbols.angle(vector.body, 1)
        if not _has(loops, vector.body, "angles") and symbols.angle(vector.body, 2).value != 0.0:
            found.append((turned, ProductOfTerms((size, symbols.angle(vector.body, 2), across))))
        if vector.slide:
            found.append((turned, ProductOfTerms((PlainFactor(2.0), symbols.length(vector, 1), omega, across))))
        found.append((-sign, ProductOfTerms((size, SquaredTerm(omega), along))))
    if vector.slide and not _has(loops, vector.slide, "slides"):
        found.append((sign, ProductOfTerms((symbols.length(vector, 2), along))))
    return found


def _has(loops: Sequence[VectorLoop], name: str, kind: str) -> bool:
    return any(name in getattr(loop, kind) for loop in loops)


def _cramer(matrix: list[list[EquationLine]], right: list[EquationLine], unknowns: list[NamedQuantity]) -> list[EquationLine]:
    """Return the solution of two equations by Cramer's rule."""
    ((a, b), (c, d)), (e, f) = ([[_left(line) for line in row] for row in matrix], [_left(line) for line in right])
    product = {("m", "m"): "m2", ("m", "1"): "m", ("1", "m"): "m", ("1", "1"): "1"}
    below = total((1.0, ProductOfTerms((a, d))), (-1.0, ProductOfTerms((b, c))))
    det, line = defined("D", "", below, product[a.unit, d.unit])
    above = [
        total((1.0, ProductOfTerms((e, d))), (-1.0, ProductOfTerms((b, f)))),
        total((1.0, ProductOfTerms((a, f))), (-1.0, ProductOfTerms((e, c)))),
    ]
    return [line, *(EquationLine(RatioOfTerms(x, det), unknown) for x, unknown in zip(above, unknowns, strict=True))]


def _put_in(matrix: list[list[EquationLine]], right: list[EquationLine], unknowns: list[NamedQuantity]) -> list[EquationLine]:
    """Return the lines of the solution of linear equations, and each equation with the solution put in."""
    rows = [
        total(*((1.0, ProductOfTerms((_left(a), x))) for a, x in zip(row, unknowns, strict=True) if a.right != NO_TERMS))
        for row in matrix
    ]
    return [*(EquationLine(x, x) for x in unknowns), *(EquationLine(row, _left(b)) for row, b in zip(rows, right, strict=True))]


def _left(line: EquationLine) -> NamedQuantity:
    assert line.left is not None
    return line.left
