"""Equations of vector loops: positions in closed form, velocities and accelerations as small linear systems."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from udkjax.scene.elements.bodies import GROUND
from udkjax.study.worked.iterations import NewtonStep, PositionRates, newton_steps
from udkjax.study.worked.loops import LoopVector, VectorLoop, wrapped
from udkjax.study.worked.terms import (
    AppliedFunction,
    EquationLine,
    EquationTerm,
    NamedQuantity,
    NumberStyle,
    PlainFactor,
    ProductOfTerms,
    RatioOfTerms,
    SquaredTerm,
    SumOfTerms,
    of_angle,
    total,
)

AXES = ("x", "y")
NAMES = ("cos", "sin")


NO_TERMS = SumOfTerms(())


class LinearEquations(NamedTuple):
    """A linear system A x = b.

    Attributes:
        matrix: the lines of its coefficients, by rows.
        right: the lines of its right sides.
        unknowns: the symbols, with the values that solve it.
        lines: the solution.
    """

    matrix: list[list[EquationLine]]
    right: list[EquationLine]
    unknowns: list[NamedQuantity]
    lines: list[EquationLine]

    @property
    def coefficients(self) -> list[EquationLine]:
        """The lines of the coefficients without those that are zero by structure."""
        return [line for row in self.matrix for line in row if line.right != NO_TERMS]


class PositionSymbols:
    """The symbols of a position: lengths, angles and their derivatives, with their values."""

    def __init__(self, rates: PositionRates, pins_of_slides: dict[str, str]):
        self.rates, self.pins = rates, pins_of_slides

    def angle(self, body: str, order: int = 0) -> NamedQuantity:
        """Return the angle of a body, its angular velocity or its angular acceleration."""
        letter, unit = (("θ", "rad"), ("ω", "rad/s"), ("α", "rad/s2"))[order]
        return NamedQuantity(letter, body, self.rates.angles[body][order], unit)

    def length(self, vector: LoopVector, order: int = 0) -> NamedQuantity:
        """Return the length of a vector; for one along a line also its derivatives."""
        if not vector.slide:
            return NamedQuantity("r", vector.start + vector.end, vector.size, "m")
        return NamedQuantity(
            "s", self.pins[vector.slide], self.rates.slides[vector.slide][order], ("m", "m/s", "m/s2")[order], order
        )

    def direction(self, vector: LoopVector) -> EquationTerm:
        """Return the angle of a vector: that of its body, plus a constant one."""
        if vector.body == GROUND:
            return NamedQuantity("φ", vector.start + vector.end, vector.turn, "rad")
        angle = self.angle(vector.body)
        return total((1.0, angle), (1.0, self.turn(vector))) if vector.turn else angle

    @staticmethod
    def turn(vector: LoopVector) -> NamedQuantity:
        """Return the constant angle between a vector and its body."""
        return NamedQuantity("δ", vector.start + vector.end, vector.turn, "rad")


def component(symbols: PositionSymbols, vector: LoopVector, axis: int) -> EquationTerm:
    """Return the component of a vector along x or y."""
    return ProductOfTerms((symbols.length(vector), of_angle(NAMES[axis], symbols.direction(vector))))


def closure(symbols: PositionSymbols, loop: VectorLoop) -> list[EquationLine]:
    """Return the two components of the closure of a loop."""
    return [EquationLine(total(*((x.sign, component(symbols, x, axis)) for x in loop.vectors))) for axis in (0, 1)]


class BranchPosition(NamedTuple):
    """The solution of a loop for its unknowns on one branch."""

    words: str
    is_actual: bool
    lines: list[EquationLine]


def known_part(symbols: PositionSymbols, loop: VectorLoop) -> tuple[list[EquationLine], list[NamedQuantity]]:
    """Return the lines of K, the sum of all vectors that do not depend on the unknowns, and its two components."""
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


def _symbol(letter: str, index: str, right: EquationTerm, unit: str) -> tuple[NamedQuantity, EquationLine]:
    found = NamedQuantity(letter, index, right.value, unit)
    return found, EquationLine(right, found)


def _less_turn(letter: str, vector: LoopVector, direction: NamedQuantity, lines: list[EquationLine]) -> NamedQuantity:
    """Return the angle of a vector's body, from the angle of the vector; appends its line if they differ."""
    if not vector.turn:
        return direction
    angle, line = _symbol(letter, vector.body, total((1.0, direction), (-1.0, PositionSymbols.turn(vector))), "rad")
    lines.append(line)
    return angle


def _two_angles(
    symbols: PositionSymbols, unknown: Sequence[LoopVector], shared: list[EquationLine], kx: NamedQuantity, ky: NamedQuantity
) -> tuple[list[EquationLine], list[BranchPosition]]:
    """K + a e(phi1) + b e(phi2) = 0: the law of cosines gives phi1 from the direction of K, on both sides of it."""
    first, second = unknown
    a, b = symbols.length(first), symbols.length(second)
    k, k_line = _symbol("K", "", AppliedFunction("sqrt", (total((1.0, SquaredTerm(kx)), (1.0, SquaredTerm(ky))),)), "m")
    beta, beta_line = _symbol("β", "", AppliedFunction("atan2", (ky, kx)), "rad")
    above = total((1.0, SquaredTerm(b)), (-1.0, SquaredTerm(a)), (-1.0, SquaredTerm(k)))
    cosine = RatioOfTerms(above, ProductOfTerms((PlainFactor(2.0 * first.sign), a, k)))
    gamma, gamma_line = _symbol("γ", "", AppliedFunction("acos", (cosine,)), "rad")
    found = []
    for sign in (1.0, -1.0):
        lines: list[EquationLine] = []
        phi, line = _angle_symbol(first, total((1.0, beta), (sign, gamma)))
        lines.append(line)
        one = _less_turn("θ", first, phi, lines)
        parts = []
        for axis, known in enumerate((kx, ky)):
            sum_ = total((1.0, known), (first.sign, ProductOfTerms((a, of_angle(NAMES[axis], phi)))))
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
    return _symbol(letter, index, right, "rad")


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
    """K + c e(phi) + s e(psi) = 0 with a known psi: a quadratic equation of s."""
    c, psi = symbols.length(other), symbols.direction(sliding)
    inner = total((1.0, ProductOfTerms((kx, of_angle("cos", psi)))), (1.0, ProductOfTerms((ky, of_angle("sin", psi)))))
    p, p_line = _symbol("p", "", inner, "m")
    root_of = total((1.0, SquaredTerm(p)), (-1.0, SquaredTerm(kx)), (-1.0, SquaredTerm(ky)), (1.0, SquaredTerm(c)))
    root, root_line = _symbol("w", "", AppliedFunction("sqrt", (root_of,)), "m")
    index, found = symbols.pins[sliding.slide], []
    for sign in (1.0, -1.0):
        s, line = _symbol("s", index, total((-sliding.sign, p), (sign, root)), "m")
        lines, parts = [line], []
        for axis, known in enumerate((kx, ky)):
            sum_ = total((1.0, known), (sliding.sign, ProductOfTerms((s, of_angle(NAMES[axis], psi)))))
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
    """K + (s e(turn) + h e(turn + 90 degrees)) e(theta) = 0: s by Pythagoras, then the direction of K."""
    squares = [(1.0, SquaredTerm(kx)), (1.0, SquaredTerm(ky))]
    if across is not None:
        squares.append((-1.0, SquaredTerm(symbols.length(across))))
    under: EquationTerm = total(*squares)
    w, w_line = _symbol("w", "", AppliedFunction("sqrt", (under,)), "m")
    index, found = symbols.pins[sliding.slide], []
    for sign in (1.0, -1.0):
        s, line = _symbol("s", index, total((sign, w)), "m")
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
    """K + s1 e1 + s2 e2 = 0, linear in both lengths: the product with the normal of one line gives the other."""
    lines = []
    for one, other in (unknown, unknown[::-1]):
        psi, chi = symbols.direction(one), symbols.direction(other)
        above = total(
            (one.sign, ProductOfTerms((ky, of_angle("cos", chi)))), (-one.sign, ProductOfTerms((kx, of_angle("sin", chi))))
        )
        below = of_angle("sin", total((1.0, chi), (-1.0, psi)))
        lines.append(_symbol("s", symbols.pins[one.slide], RatioOfTerms(above, below), "m")[1])
    return shared, [BranchPosition("", True, lines)]


# --- velocities and accelerations


def velocity_system(symbols: PositionSymbols, loops: Sequence[VectorLoop]) -> LinearEquations:
    """Return the linear system of the first derivatives of the unknowns of loops."""
    return _linear(symbols, loops, 1, lambda vector, axis: _velocity(symbols, vector, axis, loops))


def acceleration_system(symbols: PositionSymbols, loops: Sequence[VectorLoop]) -> LinearEquations:
    """Return the linear system of the second derivatives of the unknowns of loops; its matrix is that of the velocities."""
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
    """Return the coefficient of the rate of an angle: the loop's vectors on the body, turned by a right angle."""
    parts = []
    for x in loop.vectors:
        if x.body == body:
            turned = ProductOfTerms((symbols.length(x), of_angle(NAMES[1 - axis], symbols.direction(x))))
            parts.append((-x.sign if axis == 0 else x.sign, turned))
    return total(*parts)


def _of_slide(symbols: PositionSymbols, loop: VectorLoop, slide: str, axis: int) -> SumOfTerms:
    return total(*((x.sign, of_angle(NAMES[axis], symbols.direction(x))) for x in loop.vectors if x.slide == slide))


def _velocity(
    symbols: PositionSymbols, vector: LoopVector, axis: int, loops: Sequence[VectorLoop]
) -> list[tuple[float, EquationTerm]]:
    """Return the known parts of the velocity of a vector's end: r omega across it, and its change of length along it."""
    sign, way = vector.sign, symbols.direction(vector)
    across = (-sign if axis == 0 else sign, of_angle(NAMES[1 - axis], way))
    found = []
    if vector.body != GROUND and not _has(loops, vector.body, "angles"):
        found.append((across[0], ProductOfTerms((symbols.length(vector), symbols.angle(vector.body, 1), across[1]))))
    if vector.slide and not _has(loops, vector.slide, "slides"):
        found.append((sign, ProductOfTerms((symbols.length(vector, 1), of_angle(NAMES[axis], way)))))
    return found


def _acceleration(
    symbols: PositionSymbols, vector: LoopVector, axis: int, loops: Sequence[VectorLoop]
) -> list[tuple[float, EquationTerm]]:
    """Return the known parts: tangential, along the line, Coriolis (2 times rate times omega), and towards the centre."""
    sign, way, size = vector.sign, symbols.direction(vector), symbols.length(vector)
    along, across = of_angle(NAMES[axis], way), of_angle(NAMES[1 - axis], way)
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
    det, line = _symbol("D", "", below, product[a.unit, d.unit])
    above = [
        total((1.0, ProductOfTerms((e, d))), (-1.0, ProductOfTerms((b, f)))),
        total((1.0, ProductOfTerms((a, f))), (-1.0, ProductOfTerms((e, c)))),
    ]
    return [line, *(EquationLine(RatioOfTerms(x, det), unknown) for x, unknown in zip(above, unknowns, strict=True))]


def _put_in(matrix: list[list[EquationLine]], right: list[EquationLine], unknowns: list[NamedQuantity]) -> list[EquationLine]:
    """Return the lines of the solution of linear equations, and each equation with this solution in it."""
    rows = [
        total(*((1.0, ProductOfTerms((_left(a), x))) for a, x in zip(row, unknowns, strict=True) if a.right != NO_TERMS))
        for row in matrix
    ]
    return [*(EquationLine(x, x) for x in unknowns), *(EquationLine(row, _left(b)) for row, b in zip(rows, right, strict=True))]


def _left(line: EquationLine) -> NamedQuantity:
    assert line.left is not None
    return line.left


# --- the solution of a loop


class LoopSolution(NamedTuple):
    """The solution of one loop, or of loops that are solved together.

    Attributes:
        loops: their vectors.
        closures: the two components of the closure of each.
        shared: lines of the positions that all branches share.
        branches: the positions of the unknowns; empty if they follow by iteration alone.
        steps: steps of Newton's method from an estimate, where there is no closed form.
        found: the unknowns in this position.
        velocity, acceleration: the linear systems of their derivatives.
    """

    loops: list[VectorLoop]
    closures: list[EquationLine]
    shared: list[EquationLine]
    branches: list[BranchPosition]
    steps: list[NewtonStep]
    found: list[NamedQuantity]
    velocity: LinearEquations
    acceleration: LinearEquations

    def step_rows(self, style: NumberStyle) -> list[list[str]]:
        """Return the table of the steps of Newton's method, with its heads; empty if there are none."""
        heads = [f"{x.name} ({style.unit(x.unit)})" for x in self.found]
        rows = [
            [str(k), *(style.number(value, x.unit) for value, x in zip(step.unknowns, self.found, strict=True)),
             f"{step.residual / style.size('m'):.2g}"]
            for k, step in enumerate(self.steps)
        ]  # fmt: skip
        return [["step", *heads, f"residual ({style.unit('m')})"], *rows] if rows else []


def solution_of(symbols: PositionSymbols, loops: list[VectorLoop]) -> LoopSolution:
    """Return the solution of a loop, or of several that are solved together."""
    closures = [line for loop in loops for line in closure(symbols, loop)]
    shared, branches = solve(symbols, loops[0]) if len(loops) == 1 else ([], [])
    lines_of = {x.slide: x for loop in loops for x in loop.vectors if x.slide}
    found = [symbols.angle(body) for loop in loops for body in loop.angles]
    found += [symbols.length(lines_of[slide]) for loop in loops for slide in loop.slides]
    systems = velocity_system(symbols, loops), acceleration_system(symbols, loops)
    steps = [] if branches else newton_steps(loops, symbols.rates)
    return LoopSolution(loops, closures, shared, branches, steps, found, *systems)
