"""Rows for rank-revealing methods: D = W Psi_q M^(-1/2), dense, with W the characteristic length over the scale of each row.

They come from the arrays `psi_q` and `root`, which holds M^(-1/2), of a lane.
"""

from collections.abc import Iterator

from udkjax.native.ir import DOUBLE, INT, POINTER, Function, Operand, Value
from udkjax.native.least_norm import LEAST_NORM, least_norm
from udkjax.native.module import Module

_ENTRIES, _FACTORS = "@entries", "@factors"


class RowEntries:
    """The entries of Psi_q, with their tables among the constants of a module."""

    def __init__(self, module: Module):
        rows, columns, places, factors = module.code.psi_q_entries
        self._count = len(rows)
        entries = ", ".join(f"i64 {x}" for entry in zip(rows, columns, places, strict=True) for x in entry)
        numbers = ", ".join(f"double {float(x)}" for x in factors)
        for line in (
            f"{_ENTRIES} = private constant [{3 * self._count} x i64] [{entries}]",
            f"{_FACTORS} = private constant [{self._count} x double] [{numbers}]",
        ):
            if line not in module.loops.globals:
                module.loops.globals.append(line)

    def entries(self, f: Function) -> Iterator[tuple[Value, Value, Value, Value]]:
        """Run the block for each entry of Psi_q: its row, its column, its place in `psi_q`, and the factor of what is there."""
        with f.each(self._count) as e:
            row, column, place = (f.load(Value(f, _ENTRIES, POINTER), e * 3 + j, base=INT) for j in range(3))
            yield row, column, place, f.load(Value(f, _FACTORS, POINTER), e)


class WeightedRows(RowEntries):
    """The rows of a module, one lane at a time."""

    def __init__(self, module: Module):
        super().__init__(module)
        self._module = module
        if all(f.name != LEAST_NORM for f in module.functions):
            module.functions.append(least_norm(module.plan.vector))

    def weight(self, f: Function, row: Value, lane: Operand = 0) -> Value:
        """Return the weight of a row."""
        lane = f.like(lane, INT, 1)
        return self._module.lane_number(f, "length", lane, 0) / self._module.lane_number(f, "rows", lane, row)

    def write(self, f: Function, D: Value, lane: Operand = 0):
        """Write D (m, n), row by row, to an address."""
        number, lane, n = self._module.lane_number, f.like(lane, INT, 1), self._module.n
        with f.each(self._module.m * n) as i:
            f.store(0.0, D, i)
        for row, column, place, factor in self.entries(f):
            weight = self.weight(f, row, lane) * factor
            f.store(number(f, "psi_q", lane, place) * weight * number(f, "root", lane, column), D, row * n + column)

    def solve(
        self, f: Function, D: Value, b: Value, x: Value, shape: tuple[int, int, int], tol: Value | None = None, lane: Operand = 0
    ):
        """Solve for x = D^+ b, of D (rows, columns) and so many right-hand sides; leave the rank of D in `rank`.

        D and b are overwritten. Singular values count beyond `tol` times the largest, by default `fallback_tol`.
        """
        lane = f.like(lane, INT, 1)
        tol = self._module.lane_number(f, "fallback_tol", lane, 0) if tol is None else tol
        rank = f.at(f.given["work"], lane + self._module.places["rank"] * f.width)
        f.call(LEAST_NORM, D, b, x, *(f.const(c, INT) for c in shape), tol, rank)

    def reserve(self, f: Function, *counts: int) -> Iterator[Value]:
        """Reserve room for so many numbers each."""
        return (Value(f, f.reserve(DOUBLE, max(c, 1)), POINTER) for c in counts)
