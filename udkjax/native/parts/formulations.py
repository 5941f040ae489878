"""Accelerations by formulations other than the Udwadia-Kalaba equation (`udkjax.equations.laws.formulations`), as machine code.

With the unconstrained accelerations a_F, their change x due to the constraints, and A = Psi_q,

    M x + A^T lambda = 0,        A x = b,        a = a_F + x,

all in the scene's own units, in which coordinates, rows and masses are of order one. States are projected by the pseudoinverse.
A mass matrix that is not diagonal, M = L C^(-1) L^T, is diagonal in the coordinates L^T x of equations/systems/system_solver.py:
there the rows are A L^(-T), and the program `spread` leads back.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from udkjax.native.language.ir import INT, POINTER, Function, Operand, Value, Variable
from udkjax.native.module.layout import FORMULATION_SETTINGS, Lane
from udkjax.native.module.module import Module
from udkjax.native.parts.elimination import ByRows, EliminatedAccelerations
from udkjax.native.pseudoinverses.dense import DenseLayout, DenseMatrices, DenseMethod, MatrixRow
from udkjax.native.pseudoinverses.qr import apply_q, pivoted_qr, qr_matrices
from udkjax.native.pseudoinverses.svd import SVDCode
from udkjax.native.pseudoinverses.weighted_rows import RowEntries

TOL_SETTING, MASS_SETTING = FORMULATION_SETTINGS
FORMULATE = "formulate"


@dataclass(frozen=True)
class FormulationCode(ABC):
    """A formulation that has machine code: `prepare` returns the writer of its code in a module."""

    closes: ClassVar[bool] = False  # whether the constraints are satisfied wherever a run evaluates accelerations
    needs_diagonal_mass: ClassVar[bool] = False  # whether it receives M itself, which must be diagonal

    @property
    def settings(self) -> tuple[str, ...]:
        """The names of the settings that a run by this formulation has in addition to those of all runs."""
        return FORMULATION_SETTINGS

    @abstractmethod
    def prepare(self, module: Module) -> "FormulatedAccelerations":
        """Reserve memory for the matrices of the formulation in a module; return the writer of its code there."""


class FormulatedAccelerations(ABC):
    """The writer of the code that computes accelerations by a formulation."""

    @abstractmethod
    def write(self):
        """Write `formulate(work, out)`: compute the accelerations at the state, and store them at `out`."""


class Formulated(ByRows):
    """The accelerations of a module by a formulation; a `solver` solves the linear systems of its projection."""

    def __init__(self, module: Module, solver: EliminatedAccelerations, code: FormulationCode):
        super().__init__(module)
        self._solver, self._code = solver, code
        self.has_cold_functions = solver.has_cold_functions
        self.shared = {*solver.shared, "couplings", "rows", "velocities"}

    @property
    def programs(self) -> list[str]:
        return list(dict.fromkeys([*self._solver.programs, "dense_accelerations"]))

    def reserve(self):
        self._solver.reserve()
        self.formulation = self._code.prepare(self._in)

    def write(self):
        self._solver.write()
        self.formulation.write()

    def accelerate(self, f: Function, to: str):
        self._in.invoke(f, FORMULATE, to)

    def accelerate_end(self, f: Function):
        module = self._in
        module.copy(f, "state v", "saved v")
        module.copy(f, "result v", "state v")
        self.accelerate(f, "result a")
        module.copy(f, "saved v", "state v")

    def check_pivots(self, f: Function, s: Lane, name: str):
        """Do nothing: a formulation has no pivots."""

    def highest_rank(self, s: Lane) -> Value | None:
        return self._solver.highest_rank(s)

    def add_numbers(self, f: Function, total: Variable):
        self.accelerate(f, "result a")
        with f.each(self._in.n) as i:
            total.value = f.fma(self._in.entry(f, "result a", i), 0.0, total.value)

    def accelerate_state(self, f: Function, s: Lane):
        self.accelerate(f, "result a")


class ScaledAccelerations(FormulatedAccelerations):
    """The writer of accelerations by a linear system in the scene's own units."""

    def __init__(self, module: Module, layout: DenseLayout):
        self._in, self._layout, self._entries = module, layout, RowEntries(module)

    def write(self):
        module = self._in
        f, _ = module.function(FORMULATE, [(POINTER, "work"), (POINTER, "out")])
        module.invoke(f, "dense_accelerations")
        x = self.solve(DenseMatrices(self._layout, f))
        couples = module.code.couples
        if couples:
            with f.each(module.n) as i:
                module.put_entry(f, "change", i, self._unit(f, i) * x.entry(i))
            module.invoke(f, "spread", "change")
        with f.each(module.n) as i:
            free = self._array(f, "terms", i)
            a = free + self._array(f, "change", i) if couples else f.fma(self._unit(f, i), x.entry(i), free)
            f.store(a, f.given["out"], i * f.width, f.width)

    @abstractmethod
    def solve(self, d: DenseMatrices) -> MatrixRow:
        """Write code that computes x from the current Psi_q, M^(-1/2) and b; return the row that holds x."""

    def _array(self, f: Function, name: str, i: Operand = 0) -> Value:
        """Return the i-th number of an array in all lanes."""
        return self._in.entry(f, name, i)

    def _unit(self, f: Function, i: Operand) -> Value:
        return 1.0 / self._array(f, "inverse unit", i)

    def mass(self, f: Function, i: Operand) -> Value:
        """Return entry i of the diagonal of M, in the scene's own units."""
        share = self._unit(f, i) / (self._array(f, "root", i) * self._array(f, "length"))
        return share * share / self._array(f, MASS_SETTING)

    def each_entry(self, f: Function) -> Iterator[tuple[Value, Value, Value]]:
        """Run the block for each entry of A: its row, its column and its value."""
        for row, column, place, factor in self._entries.entries(f):
            value = self._array(f, "psi_q", place) * factor * self._unit(f, column)
            yield row, column, value / self._array(f, "rows", row)

    def right(self, f: Function, i: Value) -> Value:
        """Return entry i of b, in the scene's own units."""
        return self._array(f, "terms", i + self._in.n) / self._array(f, "rows", i)


@dataclass(frozen=True)
class AugmentedCode(FormulationCode):
    """The formulation that solves one linear system for x and lambda together (`Augmented`)."""

    method: DenseMethod

    def prepare(self, module: Module) -> FormulatedAccelerations:
        return AugmentedAccelerations(module, self.method)


class AugmentedAccelerations(ScaledAccelerations):
    """Accelerations from [M A^T; A 0] [x; lambda] = [0; b]."""

    def __init__(self, module: Module, method: DenseMethod):
        size, self._method = module.n + module.m, method
        super().__init__(module, DenseLayout(module, method.matrices(size, size), (size, size), "augmented", TOL_SETTING))

    def solve(self, d: DenseMatrices) -> MatrixRow:
        f, n, b = d.f, self._in.n, d.row("b")
        b.clear()
        with f.each(d.m) as i:
            d.row("D", i).clear()
        with f.each(n) as i:
            d.row("D", i).put(i, self.mass(f, i))
        for row, column, value in self.each_entry(f):
            d.row("D", row + n).put(column, value)
            d.row("D", column).put(row + n, value)
        with f.each(self._in.m) as i:
            b.put(i + n, self.right(f, i))
        self._method.factor(d)
        self._method.solve(d)
        return d.row("x")


@dataclass(frozen=True)
class NullSpaceCode(FormulationCode):
    """The formulations by a basis N of the null space: x = x_p + N z, A x_p = b, A N = 0 (`NullSpaceQR`, `NullSpaceSVD`)."""

    by_singular_values: bool

    def prepare(self, module: Module) -> FormulatedAccelerations:
        return (NullSpaceSVDAccelerations if self.by_singular_values else NullSpaceQRAccelerations)(module)


class NullSpaceAccelerations(ScaledAccelerations):
    """Accelerations by pivoted QR of columns that span the rows of A; the remaining columns of Q are N.

    The columns of N are made orthonormal in the metric of M, n_k, and x = x_p - sum_k n_k (n_k^T M x_p).
    """

    def __init__(self, module: Module, columns: int):
        n = module.n
        extra = {"basis": (n, n), "weighted": (n, n), "mass": (1, n)}
        super().__init__(module, DenseLayout(module, qr_matrices(n, columns) | extra, (n, columns), "null space", TOL_SETTING))

    @abstractmethod
    def solve_rows(self, d: DenseMatrices):
        """Write the QR factorization of columns that span the rows of A, and the particular solution x_p in the row `b`."""

    def solve(self, d: DenseMatrices) -> MatrixRow:
        self.solve_rows(d)
        f, x, mass = d.f, d.row("b"), d.row("mass")
        mass.clear()
        with f.each(d.m) as i:
            mass.put(i, self.mass(f, i))
        free = d.wide(float(d.m)) - d.row("rank").entry(0)
        count = f.variable(d.whole(free if f.width == 1 else f.reduce("fmax", free)), INT, 1)
        with f.each(count.value) as k:
            vector, weighted = d.row("basis", k), d.row("weighted", k)
            place = d.row("rank").entry(0) + d.number(k)
            is_used = place < float(d.m)
            vector.clear()
            vector.put_at(d.whole(f.select(is_used, place, 0.0)), f.select(is_used, d.wide(1.0), 0.0))
            apply_q(d, "basis", k)
            with f.each(k) as j:
                d.axpy(-d.dot(d.row("weighted", j), vector), d.row("basis", j), vector)

            def weigh(r: Operand):
                weighted[r] = mass[r] * vector[r]

            d.over_registers(vector.registers, weigh)
            square = d.dot(weighted, vector)
            counts = is_used & (square > 0.0)
            scale = d.spread(f.select(counts, 1.0 / d.sqrt(f.select(counts, square, 1.0)), 0.0))

            def normalize(r: Operand):
                vector[r] = vector[r] * scale
                weighted[r] = weighted[r] * scale

            d.over_registers(vector.registers, normalize)
            d.axpy(-d.dot(weighted, x), vector, x)
        return x


class NullSpaceQRAccelerations(NullSpaceAccelerations):
    """Accelerations from A^T = Q R with pivoting: x_p = Q_1 R_1^(-T) b."""

    def __init__(self, module: Module):
        super().__init__(module, module.m)

    def solve_rows(self, d: DenseMatrices):
        f, x, tol = d.f, d.row("b"), d.tol
        with f.each(d.m) as i:
            d.row("D", i).clear()
        for row, column, value in self.each_entry(f):
            d.row("D", column).put(row, value)
        pivoted_qr(d, lambda scale: tol * tol * scale)
        right = d.row("product")  # one entry for each row of A
        right.clear()
        with f.each(d.n) as i:
            right.put(i, self.right(f, i))
        x.clear()
        with f.each(d.steps) as k:
            counts = d.number(k) < d.row("rank").entry(0)
            place = d.whole(d.row("order").entry(k))
            remainder = f.variable(right.at(place))
            with f.each(k) as i:
                remainder.value = remainder.value - d.row("D", i).at(place) * x.entry(i)
            end = d.row("diagonal").entry(k)
            x.put(k, f.select(counts, remainder.value / f.select(counts, end, 1.0), 0.0))
        apply_q(d)


class NullSpaceSVDAccelerations(NullSpaceAccelerations):
    """Accelerations from singular values: x_p = A^+ b; right singular vectors of nonzero singular values span the rows of A."""

    def __init__(self, module: Module):
        m, n = module.m, module.n
        super().__init__(module, min(m, n))
        self._method = SVDCode(relative=True)
        self._rows = DenseLayout(module, self._method.matrices(m, n), (m, n), "null space rows", TOL_SETTING)

    def solve_rows(self, d: DenseMatrices):
        f, svd = d.f, DenseMatrices(self._rows, d.f)
        svd.row("b").clear()
        with f.each(svd.m) as i:
            svd.row("D", i).clear()
            svd.row("b").put(i, self.right(f, i))
        for row, column, value in self.each_entry(f):
            svd.row("D", row).put(column, value)
        self._method.factor(svd)
        self._method.solve(svd)
        # The columns of D become the right singular vectors, which span the rows of A. The other columns of Q in their QR
        # factorization then span the null space.
        with f.each(d.m) as i:
            row = d.row("D", i)
            row.clear()
            with f.each(svd.steps) as j:
                row.put(j, svd.row("D", j).entry(i) * d.sqrt(svd.row("lengths").entry(j)))
        pivoted_qr(d, lambda _: d.wide(0.25))  # lengths are one, or zero beyond the rank
        d.row("b").clear()
        with f.each(d.m) as i:
            d.row("b").put(i, svd.row("x").entry(i))
