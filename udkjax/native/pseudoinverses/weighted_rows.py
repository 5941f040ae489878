"""Rows for dense methods: D = W Psi_q M^(-1/2), with W the characteristic length over the scale of each row.

D is computed from the arrays `psi_q` and `root`, which holds M^(-1/2). If M is not diagonal, these belong to other coordinates
(equations/systems/system_solver.py), to and from which the programs `gather` and `spread` lead. The rows of nonholonomic
constraints, which come last, do not restrict positions.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Operand, Value
from udkjax.native.module.module import Module
from udkjax.native.pseudoinverses.dense import DenseLayout, DenseMatrices, DenseMethod, MatrixRow

_ENTRIES, _FACTORS, _CHOSEN = "@entries", "@factors", "@chosen"


class RowEntries:
    """The entries of Psi_q, or of some of its rows, that are not always zero; tables of them are constants of the module.

    `chosen`: the indices of the rows in Psi, in ascending order; None: all rows. All instances in a module must choose the same
    rows.
    """

    def __init__(self, module: Module, chosen: Sequence[int] | None = None):
        self._module = module
        rows, columns, places, factors = module.code.psi_q_entries
        if chosen is not None:
            is_chosen = np.isin(rows, chosen)
            rows, columns, places, factors = (x[is_chosen] for x in (np.searchsorted(chosen, rows), columns, places, factors))
        self._count = len(rows)
        self._chosen = range(module.m) if chosen is None else chosen
        entries = ", ".join(f"i64 {x}" for entry in zip(rows, columns, places, strict=True) for x in entry)
        numbers = ", ".join(f"double {float(x)}" for x in factors)
        for line in (
            f"{_ENTRIES} = private constant [{3 * self._count} x i64] [{entries}]",
            f"{_FACTORS} = private constant [{self._count} x double] [{numbers}]",
            f"{_CHOSEN} = private constant [{len(self._chosen)} x i64] [{', '.join(f'i64 {x}' for x in self._chosen)}]",
        ):
            if line not in module.loops.globals:
                module.loops.globals.append(line)

    def entries(self, f: Function, count: int | None = None) -> Iterator[tuple[Value, Value, Value, Value]]:
        """Run the block for each entry with its row among the chosen rows, its column, its index in `psi_q`, and its factor."""
        with f.each(self._count if count is None else count) as e:
            row, column, place = (f.load(Value(f, _ENTRIES, POINTER), e * 3 + j, base=INT) for j in range(3))
            yield row, column, place, f.load(Value(f, _FACTORS, POINTER), e)

    def row_of_psi(self, f: Function, row: Value) -> Value:
        """Return the index in Psi of a row, from its index among the chosen rows."""
        return row if len(self._chosen) == self._module.m else f.load(Value(f, _CHOSEN, POINTER), row, base=INT)


class WeightedRows(RowEntries):
    """The matrix D of a module, with its factorization and its systems by a dense method, in all lanes or lane by lane.

    If `by_lane`, functions that use this object have one lane; their argument `lane` is its index. `prefix` and `tol` are
    arguments of the `DenseLayout` of the matrices.
    """

    def __init__(
        self,
        module: Module,
        method: DenseMethod,
        by_lane: bool = False,
        chosen: Sequence[int] | None = None,
        prefix: str = "dense",
        tol: str = "fallback_tol",
    ):
        super().__init__(module, chosen)
        self._method, self._prefix = method, prefix
        is_position = module.code.psi_q_entries[0] < module.code.position_rows
        self.splits, self._position_entries = module.code.position_rows < module.m, int(np.sum(is_position))
        shape, width = (len(self._chosen), module.n), 1 if by_lane else module.plan.width
        self._layout = DenseLayout(module, method.matrices(*shape), shape, prefix, tol, width)
        self._arguments = [(POINTER, "work"), *([(INT, "lane")] if by_lane else [])]
        module.weigh_rows()

    def write(self):
        """Write the functions `factor_<prefix>_rows` and `solve_<prefix>_rows`."""
        for name in ("factor", "solve"):
            f = self._module.new_function(f"{name}_{self._prefix}_rows", self._arguments, self._layout.width)
            getattr(self._method, name)(self.matrices(f))

    def matrices(self, f: Function) -> DenseMatrices:
        """Return access to the matrices within a function."""
        return DenseMatrices(self._layout, f)

    def array(self, f: Function, name: str, i: Operand) -> Value:
        """Return the i-th number of an array, in all lanes of the function."""
        place = f.like(i, INT, 1) * self._module.plan.width + self._module.start(name, "work")
        return f.load(f.given["work"], place + f.given["lane"] if "lane" in f.given else place, f.width)

    def put(self, f: Function, name: str, i: Operand, x: Value):
        """Store x as the i-th number of an array, in all lanes of the function."""
        place = f.like(i, INT, 1) * self._module.plan.width + self._module.start(name, "work")
        f.store(x, f.given["work"], place + f.given["lane"] if "lane" in f.given else place, f.width)

    def weighted_entries(self, f: Function, count: int | None = None) -> Iterator[tuple[Value, Value, Value]]:
        """Run the block for each entry of W Psi_q: its row, its column and its value."""
        for row, column, place, factor in self.entries(f, count):
            yield row, column, self.array(f, "psi_q", place) * factor * self.array(f, "weights", self.row_of_psi(f, row))

    def factor(self, f: Function, of_positions: bool = False, columns: str | None = None):
        """Compute D from the current entries of Psi_q, and factorize it.

        Args:
            f: The function to which the code is added.
            of_positions: True: rows that do not restrict positions are zero.
            columns: The array of factors by which the columns of D are multiplied; None: all are one.
        """
        d = self.matrices(f)
        with f.each(d.m) as i:
            d.row("D", i).clear()
        for row, column, value in self.weighted_entries(f, self._position_entries if of_positions and self.splits else None):
            entry = value * self.array(f, "root", column)
            d.row("D", row).put(column, entry if columns is None else entry * self.array(f, columns, column))
        self._call(f, "factor")

    def solve(self, f: Function, right: str, start: int = 0) -> MatrixRow:
        """Return the row that holds D^+ W b; b is in the array `right` from index `start` on."""
        d = self.matrices(f)
        b = d.row("b")
        b.clear()  # padding of the last register may have been multiplied by NaN
        with f.each(d.m) as i:
            row = self.row_of_psi(f, i)
            b.put(i, self.array(f, right, row + start) * self.array(f, "weights", row))
        return self.solve_right(f)

    def solve_right(self, f: Function) -> MatrixRow:
        """Return the row that holds D^+ b, with b in the row `b`."""
        self._call(f, "solve")
        return self.matrices(f).row("x")

    def solve_transposed(self, f: Function) -> MatrixRow:
        """Return the row that holds (D^+)^T x, with x in the row `x`; the method must solve transposed systems."""
        d = self.matrices(f)
        self._method.solve_transposed(d)
        return d.row("b")

    def solve_rates(self, f: Function, change: str, of_positions: bool = False) -> MatrixRow:
        """Return the row that holds D^+ W Psi_q dq, with dq in the array `change`.

        `of_positions`: True if dq is a change of positions, which is not restricted by rows that restrict velocities alone.
        """
        d = self.matrices(f)
        b = d.row("b")
        b.clear()
        for row, column, value in self.weighted_entries(f):
            b.put(row, f.fma(value, self.array(f, change, column), b.entry(row)))
        for k, row in enumerate(self._chosen if of_positions else ()):
            if int(row) in self._module.code.rolling_rows:
                b.put(f.const(k, INT, 1), f.const(0.0, DOUBLE, f.width))
        return self.solve_right(f)

    def correct(self, f: Function, x: MatrixRow, start: str, to: str, sign: float = -1.0):
        """Store `start` + M^(-1/2) x, or the difference if `sign` is negative, in the array `to`, or at the pointer `out`."""
        module = self._module
        place, couples = 0 if to == "out" else module.start(to, "work"), module.code.couples
        if couples:
            with f.each(module.n) as i:
                self.put(f, "change", i, self.array(f, "root", i) * x.entry(i))
            module.invoke(f, "spread", "change")
        with f.each(module.n) as i:
            change = self.array(f, "change", i) if couples else self.array(f, "root", i) * x.entry(i)
            old = self.array(f, start, i)
            pointer = f.given["out" if to == "out" else "work"]
            f.store(old + change if sign > 0 else old - change, pointer, i * f.width + place, f.width)

    def _call(self, f: Function, name: str):
        f.call(f"{name}_{self._prefix}_rows", *(f.given[argument] for _, argument in self._arguments))
