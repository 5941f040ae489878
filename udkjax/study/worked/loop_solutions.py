"""The solution of a vector loop, or of several: closure, positions, velocities and accelerations."""

from typing import NamedTuple

from udkjax.study.worked.closed_forms import BranchPosition, solve
from udkjax.study.worked.iterations import NewtonStep, newton_steps
from udkjax.study.worked.linear_equations import LinearEquations, acceleration_system, velocity_system
from udkjax.study.worked.loops import VectorLoop
from udkjax.study.worked.symbols import PositionSymbols, component
from udkjax.study.worked.terms import (
    EquationLine,
    NamedQuantity,
    NumberStyle,
    total,
)


def closure(symbols: PositionSymbols, loop: VectorLoop) -> list[EquationLine]:
    """Return the two components of the closure of a loop."""
    return [EquationLine(total(*((x.sign, component(symbols, x, axis)) for x in loop.vectors))) for axis in (0, 1)]


class LoopSolution(NamedTuple):
    """The solution of one loop, or of loops that are solved together.

    Attributes:
        loops: the loops, with their vectors.
        closures: the two components of the closure of each.
        shared: lines of the positions that all branches share.
        branches: the positions of the unknowns; empty if they follow by iteration alone.
        steps: steps of Newton's method from an estimate, where there is no closed form.
        found: the unknowns in this position.
        velocity, acceleration: the linear systems of the first and second derivatives of the unknowns.
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
        """Return the table of the steps of Newton's method, whose first row has the heads; an empty list without steps."""
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
    steps = [] if branches else newton_steps(loops, symbols.motion)
    return LoopSolution(loops, closures, shared, branches, steps, found, *systems)
