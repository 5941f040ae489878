"""Dense matrices in the memory of a run, one per lane, and operations on their rows.

The entries of a row are contiguous, each in all lanes, and fill whole registers; the padding of the last register is zero.
Operations on rows are therefore operations on registers, which hold several columns of one member, or one column of W members.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from udkjax.native.language.ir import BOOL, DOUBLE, INT, Function, Operand, Value, llvm_type
from udkjax.native.module.memory import Memory

UNROLLED_REGISTERS = 16  # operations on this many registers are unrolled; operations on longer rows are loops over as many
PARTIAL_SUMS = 4  # independent partial sums of a scalar product, to hide the latency of additions
MEMBER_SUMS = 16  # partial sums of a scalar product of one member, in all lanes: its bits do not depend on the count of lanes


@dataclass(frozen=True)
class DenseMethod(ABC):
    """A pseudoinverse as machine code: its matrices, the factorization of D and the solution of D x = b.

    `relative`: True if the rank tolerance is relative to the method's scale of D, such as the largest singular value.
    """

    relative: bool

    @abstractmethod
    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        """Return the shapes of the matrices that the method stores in addition to D (m, n) and its vectors, by name."""

    @abstractmethod
    def factor(self, d: "DenseMatrices") -> None:
        """Write the factorization of D, which may be overwritten; entry 0 of the row `rank` becomes the rank, if there is one."""

    @abstractmethod
    def solve(self, d: "DenseMatrices") -> None:
        """Write the solution: the row `x` becomes D^+ b; the row `b` is overwritten."""

    def solve_transposed(self, d: "DenseMatrices") -> None:
        """Write the transposed solution: the row `b` becomes (D^+)^T x; methods that lack it raise `NotImplementedError`."""
        raise NotImplementedError(type(self).__name__)


class DenseLayout:
    """The places of the matrices of a method in the memory of a module, where their memory is reserved.

    Args:
        module: The module.
        matrices: The shapes of the matrices other than D, by name.
        shape: The shape of D.
        prefix: Prefix of the names of arrays.
        tol: The name of the lane number that holds the rank tolerance.
        width: Number of lanes that have a matrix; by default all.
    """

    def __init__(
        self,
        module: Memory,
        matrices: dict[str, tuple[int, int]],
        shape: tuple[int, int],
        prefix: str = "dense",
        tol: str = "fallback_tol",
        width: int | None = None,
    ):
        self.module, self.shape, self.prefix, self.tol = module, shape, prefix, tol
        self.width = module.plan.width if width is None else width
        m, n = shape
        shapes = {"D": (m, n), "b": (1, m), "x": (1, n), "index": (1, max(m, n)), **matrices}
        self.shapes, self.registers, vector = shapes, {}, module.plan.vector
        for name, (rows, columns) in shapes.items():
            self.registers[name] = -(-columns * self.width // vector)
            module.places.add(f"{prefix} {name}", -(-rows * self.registers[name] * vector // module.plan.width))
        module.begins.append(self.number_columns)

    def number_columns(self, f: Function):
        """Store 0, 1, 2, ... in the row `index`, the indices of the columns; called once in the code of a run."""
        start = self.module.places[f"{self.prefix} index"] * self.module.plan.width
        with f.each(self.shapes["index"][1]) as j:
            f.store(f.like(j, DOUBLE, self.width), f.given["work"], j * self.width + start, self.width)


class MatrixRow:
    """A row of a matrix: its address and its number of registers; `row[r]` loads or stores register r."""

    def __init__(self, d: "DenseMatrices", address: Value, registers: int):
        self._d, self.address, self.registers = d, address, registers

    def __getitem__(self, r: Operand) -> Value:
        d = self._d
        return d.f.load(self.address, d.f.like(r, INT, 1) * d.vector if isinstance(r, Value) else r * d.vector, d.vector)

    def __setitem__(self, r: Operand, x: Value):
        d = self._d
        d.f.store(x, self.address, d.f.like(r, INT, 1) * d.vector if isinstance(r, Value) else r * d.vector, d.vector)

    def entry(self, j: Operand) -> Value:
        """Return entry j of the row in all lanes."""
        f = self._d.f
        return f.load(self.address, f.like(j, INT, 1) * f.width if isinstance(j, Value) else int(j) * f.width, f.width)

    def put(self, j: Operand, x: Operand):
        """Store x as entry j of the row in all lanes."""
        f = self._d.f
        f.store(x, self.address, f.like(j, INT, 1) * f.width if isinstance(j, Value) else int(j) * f.width, f.width)

    def at(self, places: Value) -> Value:
        """Return for each lane the entry of the row whose index is in `places`."""
        f = self._d.f
        if f.width == 1:
            return f.load(self.address, places)
        entries = Value(f, "poison", DOUBLE, f.width)
        for k in range(f.width):
            x = f.load(self.address, self._place(places, k))
            entries = f.op(f"insertelement {entries.type} {entries.name}, double {x.name}, i64 {k}", DOUBLE, f.width)
        return entries

    def put_at(self, places: Value, x: Value):
        """Store x for each lane as the entry of the row whose index is in `places`."""
        f = self._d.f
        if f.width == 1:
            f.store(x, self.address, places)
            return
        for k in range(f.width):
            f.store(f.lane(x, f.const(k, INT)), self.address, self._place(places, k))

    def _place(self, places: Value, k: int) -> Value:
        f = self._d.f
        return f.lane(places, f.const(k, INT)) * f.width + k

    def clear(self):
        def put_zero(r: Operand):
            self[r] = self._d.register(0.0)

        self._d.over_registers(self.registers, put_zero)


class DenseMatrices:
    """Access to the matrices of a method within the function f, which has the argument `work`.

    `part`: a prefix; names stand for the matrices of these names with the prefix, if there are such matrices.
    """

    def __init__(self, layout: DenseLayout, f: Function, part: str = ""):
        self.layout, self.f, self.module, self._part = layout, f, layout.module, part
        (self.m, self.n), self.vector = layout.shape, self.module.plan.vector
        self.steps = min(self.m, self.n)

    # --- numbers of each lane

    def wide(self, x: float) -> Value:
        """Return the same number in all lanes."""
        return self.f.const(x, DOUBLE, self.f.width)

    def register(self, x: float) -> Value:
        """Return a register filled with a number."""
        return self.f.const(x, DOUBLE, self.vector)

    def spread(self, x: Value) -> Value:
        """Return a number of each lane, repeated to match the registers of rows."""
        return self.module.broadcast(self.f, x)

    def number(self, k: Value) -> Value:
        """Convert an integer to a number in all lanes."""
        return self.f.like(k, DOUBLE, self.f.width)

    def whole(self, x: Value) -> Value:
        """Convert numbers to integers."""
        return self.f.op(f"fptosi {x.type} {x.name} to {llvm_type(INT, x.width)}", INT, x.width)

    def sqrt(self, x: Value) -> Value:
        return self.f.intrinsic("sqrt", x)

    @property
    def tol(self) -> Value:
        """The rank tolerance of each lane."""
        f, place = self.f, self.module.places[self.layout.tol] * self.module.plan.width
        return f.load(f.given["work"], f.given["lane"] + place if "lane" in f.given else place, f.width)

    def threshold(self, method: DenseMethod, square_of_scale: Value) -> Value:
        """Return the square of the threshold below which a length or a singular value counts as zero.

        `square_of_scale`: the square of the method's scale of D, to which a relative tolerance refers.
        """
        tol = self.tol
        return tol * tol * square_of_scale if method.relative else tol * tol

    @property
    def method_number(self) -> Value:
        """The index of the method that each lane uses, of several (`OneOfCode`)."""
        return self.f.load(self.f.given["work"], self.module.places["method"] * self.f.width, self.f.width)

    def part(self, prefix: str) -> "DenseMatrices":
        """Return access in which names stand for the matrices of these names with a prefix, if there are such matrices."""
        return DenseMatrices(self.layout, self.f, prefix)

    def _name(self, name: str) -> str:
        return self._part + name if self._part + name in self.layout.registers else name

    # --- rows

    def copy(self, x: MatrixRow, y: MatrixRow):
        """Copy the row x to the row y."""

        def copy(r: Operand):
            y[r] = x[r]

        self.over_registers(y.registers, copy)

    def columns(self, name: str) -> int:
        """Return the number of columns of a matrix."""
        return self.layout.shapes[self._name(name)][1]

    def row(self, name: str, i: Operand = 0) -> MatrixRow:
        """Return row i of a matrix."""
        name = self._name(name)
        f, registers = self.f, self.layout.registers[name]
        start = self.module.places[f"{self.layout.prefix} {name}"] * self.module.plan.width
        stride = registers * self.vector
        place = f.like(i, INT, 1) * stride + start if isinstance(i, Value) else int(i) * stride + start
        return MatrixRow(self, f.at(f.given["work"], place), registers)

    def gather(self, name: str, places: Value, to: MatrixRow):
        """Copy for each lane the row of a matrix whose index is in `places` to the row `to`."""
        f, registers = self.f, self.layout.registers[self._name(name)]
        if f.width == 1:
            self.copy(self.row(name, places), to)
            return
        sources = [self.row(name, f.lane(places, f.const(k, INT))).address for k in range(f.width)]
        with f.each(registers * self.vector // f.width) as j:
            for k, source in enumerate(sources):
                f.store(f.load(source, j * f.width + k), to.address, j * f.width + k)

    def over_registers(self, registers: int, do: Callable[[Operand], None]):
        """Run `do` for the index of each register of a row: unrolled or, for long rows, in a loop over several at a time."""
        f = self.f
        if registers <= UNROLLED_REGISTERS:
            for r in range(registers):
                do(r)
            return
        rounds = registers // UNROLLED_REGISTERS
        with f.each(rounds) as k:
            first = k * UNROLLED_REGISTERS
            for r in range(UNROLLED_REGISTERS):
                do(first + r)
        for r in range(rounds * UNROLLED_REGISTERS, registers):
            do(r)

    def sum(self, registers: int, term: Callable[[Operand, Value], Value]) -> Value:
        """Return the sum of terms over registers and, with a single lane, over their entries.

        `term(r, total)` returns `total` plus the terms of register r.
        """
        f, count = self.f, PARTIAL_SUMS if self.f.width > 1 else max(1, MEMBER_SUMS // self.vector)
        totals = [self.register(0.0)] * max(1, min(count, registers))  # rows of a free body are empty
        if registers <= UNROLLED_REGISTERS:
            for r in range(registers):
                totals[r % len(totals)] = term(r, totals[r % len(totals)])
        else:
            variables = [f.variable(0.0, width=self.vector) for _ in range(count)]
            rounds = registers // count
            with f.each(rounds) as k:
                for j, variable in enumerate(variables):
                    variable.value = term(k * count + j, variable.value)
            totals = [variable.value for variable in variables]
            for j, r in enumerate(range(rounds * count, registers)):
                totals[j] = term(r, totals[j])
        while len(totals) > 1:
            half = 1 << (len(totals) - 1).bit_length() - 1  # the largest power of two below the length
            totals = [a + b for a, b in zip(totals, totals[half:], strict=False)] + totals[len(totals) - half : half]
        return totals[0] if f.width > 1 else f.total(totals[0])

    def dot(self, a: MatrixRow, b: MatrixRow) -> Value:
        """Return the scalar product of two rows in each lane."""
        return self.sum(a.registers, lambda r, total: self.f.fma(a[r], b[r], total))

    def axpy(self, factor: Value, x: MatrixRow, y: MatrixRow):
        """Add a multiple of the row x to the row y, up to the length of the shorter one."""
        wide = self.spread(factor)

        def add(r: Operand):
            y[r] = self.f.fma(wide, x[r], y[r])

        self.over_registers(min(x.registers, y.registers), add)

    def largest(self, row: MatrixRow, count: int) -> Value:
        """Return the largest of the first `count` entries of a row; zero if all are negative."""
        worst = self.f.variable(0.0)
        with self.f.each(count) as j:
            worst.value = self.f.max(row.entry(j), worst.value)
        return worst.value

    def yes(self) -> Value:
        return self.f.const(True, BOOL, self.f.width)
