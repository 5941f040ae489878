"""Loads of joints with friction that redundant rows share, by elimination.

Elimination leaves out the redundant rows d and finds multipliers of the others, x_e with x = -lambda. All multipliers with the
same effect J^T x on the bodies, J = Psi_q, are x = x_e + N z, zero x_e of the rows d included: the columns of N span the null
space of J^T. One column belongs to each redundant row, which depends on the others, J_d = c^T J_e:

    N = (1, -c),        J_e C J_e^T c = J_e C J_d^T        (C = M^(-1)).

The loads are those of least norm, with weights w of the rows: N^T W^(-2) x = 0, and hence

    z = K x_e,        K = -(N^T W^(-2) N)^(-1) N^T W^(-2).

With the slopes S of friction by all multipliers, its loads are S (x_e + N z), and a step of Newton's method solves

    A x_e + B z = b,        A = J_e C (J_e^T + S_e),        B = J_e C S N,

where A has the blocks of J C J^T (skew_elimination.py). With Q = A^(-1) B and x' = A^(-1) b,

    x_e = x' - Q z,        (1 + K Q) z = K x'.

These matrices have one row and column for each redundant row.

Derivatives include those of N: at c, J_e C J^T N = 0, and each correction of N by this residual, with the same factors, makes
derivatives of the next order exact.
"""

from collections.abc import Callable

import numpy as np

from udkjax.equations.elimination.block_elimination import BlockElimination
from udkjax.equations.elimination.skew_elimination import SkewElimination
from udkjax.equations.terms.scene_layout import BODIES, BODY_CONSTANTS, BODY_COORDINATES, RIGHT, SHARED, SOLVES, ConstraintGroup
from udkjax.equations.terms.scene_terms import ProgramParts, SceneTerms, compliance, dot
from udkjax.expressions import Graph, Scalar
from udkjax.expressions.loops.loop_program import ADD, KernelLoop, KernelWriter, Reset
from udkjax.expressions.scalars.selection import greater, where

SquareMatrix = list[list[Scalar]]


class LoadSharing:
    """Loops for the shares of redundant rows in the loads of joints, in arrays added to the layout.

    Without such rows the methods yield no loops. `null` is N, column by column, its redundant rows first. `null_inverse` is
    (N^T W^(-2) N)^(-1); `border` is the matrix that maps N^T W^(-2) x' to z. The arrays `moved_...` are the same as functions of
    the state, for derivatives. Arguments `null` are "null" or "moved_null"; `solve` are numbers of linear systems.
    """

    FIXED = "null", "null_inverse", "border"  # arrays that are held fixed in derivatives

    def __init__(self, terms: SceneTerms, symmetric: BlockElimination, skew: SkewElimination):
        self.terms, self._symmetric, self._skew, layout = terms, symmetric, skew, terms.layout
        k, n = len(layout.shared), layout.coordinate_count
        self._count, self._width = k, layout.row_numbers
        # The linear systems of c, and of Q.
        self._null_systems = range(SOLVES + 1, SOLVES + 1 + k)
        self._border_systems = range(SOLVES + 1 + k, SOLVES + 1 + 2 * k)
        if not k:
            return
        for system in (*self._null_systems, *self._border_systems):
            layout.add_solve(system)
        layout.sizes |= {"fall": n, "null_jt": k * n, "border_gram": k * k, "border": k * k}
        for prefix in ("null", "moved_null"):
            layout.sizes |= {prefix: k * self._width, f"{prefix}_gram": k * k, f"{prefix}_inverse": k * k}
        for solve in range(SOLVES):
            layout.sizes |= {f"loads{solve}": self._width, f"sums{solve}": k}
            layout.sizes |= {f"border_sums{solve}": k, f"border_shares{solve}": k}
        self._places = [layout.place_of_row(row) for row in layout.shared]

    # --- at one state

    def find_null_space(self) -> ProgramParts:
        """Yield loops that compute N, which spans the null space of J^T, with the factors of J C J^T."""
        if not self._count:
            return
        terms, eliminated = self.terms, self.terms.layout.eliminated
        others = [group for group in terms.layout.constraints if any(group is x for x, _, _ in self._places)]
        yield from terms.element_terms(("psi_q",), groups=[group for group in others if group not in eliminated])
        for j, (group, i, row) in enumerate(self._places):
            yield Reset("fall", 0, terms.layout.coordinate_count)

            def fall(w: KernelWriter, group: ConstraintGroup = group, row: int = row):
                _add_falls(w, group, group.entries(w, row))

            yield KernelLoop(terms.kernel(("fall of row", group, row), fall), group.table[i : i + 1])
            system = self._null_systems[j]
            yield from terms.rates("fall", system)
            yield from self._symmetric.substitute(system)
            yield Reset("null", j * self._width, self._count)
            yield Reset("null", j * self._width + j, 1, 1.0)
            yield from self._add_combination(j, "null", replaces=True)
        yield from self._invert("null")

    def find_border(self) -> ProgramParts:
        """Yield loops that compute Q with the factors of A, and `border`."""
        if not self._count:
            return
        terms, k = self.terms, self._count
        for j, system in enumerate(self._border_systems):
            yield Reset("fall", 0, terms.layout.coordinate_count)
            for group in terms.layout.rubbing:

                def fall(w: KernelWriter, group: ConstraintGroup = group, j: int = j):
                    slopes = [group.slopes(w, row) for row in group.loaded_rows]
                    null = self._read_null(w, group, j)
                    _add_falls(w, group, [dot(w.graph, null, [s[c] for s in slopes]) for c in range(group.coordinates)])

                yield KernelLoop(terms.kernel(("fall of slopes", group, j), fall), group.table)
            yield from terms.rates("fall", system)
            yield from self._skew.substitute(system)
        yield Reset("border_gram", 0, k * k)

        def add_products(w: KernelWriter):
            weighted = [w.read("null", 0, j * self._width + k) * self._inverse_square(w, k) for j in range(k)]
            for i in range(k):
                for j in range(k):
                    w.write(weighted[i] * w.read(f"Q{j}", 0), "border_gram", None, i * k + j, ADD)

        yield self._over_eliminated("border products", add_products, **self._solutions)

        def close(w: KernelWriter):
            inverse, gram = (_read_square(w, x, k) for x in ("null_inverse", "border_gram"))
            one = [[w.graph.constant(float(i == j)) for j in range(k)] for i in range(k)]
            changes = _product(w.graph, inverse, gram)
            matrix = [[a - b for a, b in zip(*rows, strict=True)] for rows in zip(one, changes, strict=True)]
            solved = _inverse(w.graph, matrix, lambda pivot: _count_negative(w, pivot))
            _write_square(w, "border", [[-s for s in row] for row in _product(w.graph, solved, inverse)])

        yield terms.single_iteration(("border", k), close)

    def correct(self, solve: int) -> ProgramParts:
        """Yield loops that replace x' of a linear system, its solution with the factors of A, by x_e."""
        if not self._count:
            return
        k, names = self._count, {"x": f"x{solve}", "shares": f"border_shares{solve}"}
        yield from self._sum(f"border_sums{solve}", solve, "null")
        yield self.terms.single_iteration(
            ("border shares", k), lambda w: self._write_shares(w, "border"), sums=f"border_sums{solve}", shares=names["shares"]
        )

        def subtract(w: KernelWriter):
            terms = [w.read(f"Q{j}", 0) * w.read("shares", None, j) for j in range(k)]
            w.write(-sum(terms, w.graph.constant(0.0)), "x", 0, 0, ADD)

        loop = self._over_eliminated("subtract border", subtract, **names, **self._solutions)
        yield loop._replace(fixed=tuple(self._solutions))

    def share(self, solve: int, null: str = "null") -> ProgramParts:
        """Yield loops that compute `loads`, the x of all rows with the shares of redundant rows, from x_e of a linear system."""
        if not self._count:
            return
        k, names = self._count, {"sums": f"sums{solve}", "loads": f"loads{solve}", "x": f"x{solve}", "null": null}
        yield from self._sum(names["sums"], solve, null)

        def write_shares(w: KernelWriter):
            self._write_shares(w, "inverse", -1.0)

        yield self.terms.single_iteration(
            ("shares", k), write_shares, sums=names["sums"], shares=names["loads"], inverse=f"{null}_inverse"
        )

        def add_shares(w: KernelWriter):
            shares = [w.read("null", 0, j * self._width + k) * w.read("loads", None, j) for j in range(k)]
            w.write(sum(shares, w.read("x", 0)), "loads", 0, k)

        yield self._over_eliminated("add shares", add_shares, **names)

    # --- as functions of the state

    def copy_null_space(self, solve: int) -> ProgramParts:
        """Yield loops that copy N to `moved_null`, for derivatives, and compute the `loads` of a linear system from the copy."""
        if not self._count:
            return

        def copy(w: KernelWriter):
            for j in range(self._count):
                w.write(w.read("null", 0, j * self._width), "moved_null", 0, j * self._width)

        yield self._over_rows("copy null", copy, range(self._width))
        yield Reset("null_jt", 0, self.terms.layout.sizes["null_jt"])
        yield from self._invert("moved_null")
        yield from self.share(solve, "moved_null")

    def move_null_space(self, corrections: int) -> ProgramParts:
        """Yield loops that compute N as a function of the state; derivatives are right up to the order `corrections`."""
        if not self._count:
            return
        terms, n = self.terms, self.terms.layout.coordinate_count
        yield Reset("moved_null", 0, terms.layout.sizes["moved_null"])
        for _ in range(corrections):
            for j, (shared, i, row) in enumerate(self._places):
                yield Reset("null_jt", j * n, n)

                def add_row(w: KernelWriter, group: ConstraintGroup = shared, row: int = row, j: int = j):
                    for c, s in enumerate(_state_entries(group, row)):
                        if not s.is_zero:
                            w.write(s, "null_jt", BODIES + 3 * (c // 3) + BODY_COORDINATES, j * n + c % 3, ADD)

                loop = terms.over_group(("row of null", row, j), shared, add_row)
                yield loop._replace(table=shared.table[i : i + 1])  # of this constraint alone
                for group in terms.layout.eliminated:

                    def add_rows(w: KernelWriter, group: ConstraintGroup = group, j: int = j):
                        null = [w.read("moved_null", RIGHT, j * self._width + self._count + i) for i in range(len(group.rows))]
                        entries = [_state_entries(group, row) for row in group.rows]
                        for c in range(group.coordinates):
                            total = dot(w.graph, [row[c] for row in entries], null)
                            if not total.is_zero:
                                w.write(total, "null_jt", BODIES + 3 * (c // 3) + BODY_COORDINATES, j * n + c % 3, ADD)

                    yield terms.over_group(("rows of null", j), group, add_rows)
                system = self._null_systems[j]
                for group in terms.layout.eliminated:

                    def write_residual(w: KernelWriter, group: ConstraintGroup = group, j: int = j):
                        rates = [
                            w.read("null_jt", BODIES + 3 * (c // 3) + BODY_COORDINATES, j * n + c % 3)
                            * compliance(w, c % 3, BODIES + 3 * (c // 3) + BODY_CONSTANTS)
                            for c in range(group.coordinates)
                        ]
                        for i, row in enumerate(group.rows):
                            w.write(dot(w.graph, _state_entries(group, row), rates), "right", RIGHT, i)

                    yield terms.over_group(("residual of null", j), group, write_residual, right=f"right{system}")
                yield from self._symmetric.substitute(system)
                yield from self._add_combination(j, "moved_null")
        yield from self._invert("moved_null")

    # --- parts

    def _add_combination(self, j: int, null: str, replaces: bool = False) -> ProgramParts:
        """Yield loops that add -c to the eliminated rows of column j of N, or, with `replaces`, set these rows to -c."""
        for group in self.terms.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for i in range(len(group.rows)):
                    place = j * self._width + self._count + i
                    w.write(-w.read("c", RIGHT, i), "null", RIGHT, place, *(() if replaces else (ADD,)))

            kernel = self.terms.kernel(("combination", len(group.rows), j, self._count, self._width, replaces), write)
            yield KernelLoop(kernel, group.table, {"c": f"x{self._null_systems[j]}", "null": null})

    def _invert(self, null: str) -> ProgramParts:
        """Yield loops that compute N^T W^(-2) N and its inverse."""
        k, gram = self._count, f"{null}_gram"
        yield Reset(gram, 0, k * k)

        def add_products(w: KernelWriter):
            entries = [w.read("null", 0, j * self._width) for j in range(k)]
            weighted = [x * self._inverse_square(w, 0) for x in entries]
            for i in range(k):
                for j in range(k):
                    w.write(entries[i] * weighted[j], "gram", None, i * k + j, ADD)

        loop = self._over_rows("null products", add_products, range(self._width), null=null, gram=gram)
        yield loop._replace(fixed=("constants",))

        def invert(w: KernelWriter):
            _write_square(w, "inverse", _inverse(w.graph, _read_square(w, "gram", k)))

        yield self.terms.single_iteration(("inverse of null products", k), invert, gram=gram, inverse=f"{null}_inverse")

    def _sum(self, sums: str, solve: int, null: str) -> ProgramParts:
        """Yield loops that compute the array `sums`, N^T W^(-2) x of a linear system."""
        k = self._count
        yield Reset(sums, 0, k)

        def add(w: KernelWriter):
            x = w.read("x", 0) * self._inverse_square(w, k)
            for j in range(k):
                w.write(w.read("null", 0, j * self._width + k) * x, "sums", None, j, ADD)

        loop = self._over_eliminated("sums", add, sums=sums, x=f"x{solve}", null=null)
        yield loop._replace(fixed=("constants",))

    def _write_shares(self, w: KernelWriter, matrix: str, sign: float = 1.0) -> None:
        """Write code that sets `shares` to `sign` times the product of a square matrix and `sums`."""
        k = self._count
        sums = [w.read("sums", None, j) for j in range(k)]
        for i, row in enumerate(_read_square(w, matrix, k)):
            w.write(dot(w.graph, row, sums) * sign, "shares", None, i)

    def _read_null(self, w: KernelWriter, group: ConstraintGroup, j: int) -> list[Scalar]:
        """Return the entries of column j of N for the rows of an element that determine its loads."""
        start, shared = j * self._width, group.column(SHARED)
        eliminated = [w.read("null", RIGHT, start + self._count + i) for i in range(len(group.rows))]
        return eliminated + [w.read("null", shared, start + i) for i in range(len(group.shared_rows))]

    def _inverse_square(self, w: KernelWriter, start: int) -> Scalar:
        """Return w^(-2) of the row at which a loop over rows is; zero for rows that are left out, which have weight zero.

        `start` is the index of the first row of the loop.
        """
        layout = self.terms.layout
        weight, one = w.read("constants", 0, layout.first_weight + start), w.graph.constant(1.0)
        square = one / (weight * weight)
        if not layout.leaves_out_marked:
            return square
        zero = w.graph.constant(0.0)
        return where(greater(weight, zero), square, zero)

    @property
    def _solutions(self) -> dict[str, str]:
        """The names of the columns of Q in a program, by their names in kernels."""
        return {f"Q{j}": f"x{system}" for j, system in enumerate(self._border_systems)}

    def _over_eliminated(self, key: str, write: Callable[[KernelWriter], None], **names: str) -> KernelLoop:
        return self._over_rows(key, write, range(self._width - self._count), **names)

    def _over_rows(self, key: str, write: Callable[[KernelWriter], None], rows: range, **names: str) -> KernelLoop:
        layout = self.terms.layout
        kernel = self.terms.kernel((key, self._count, self._width, layout.first_weight, layout.leaves_out_marked), write)
        return KernelLoop(kernel, np.array(rows)[:, None], names)


def _add_falls(w: KernelWriter, group: ConstraintGroup, loads: list[Scalar]) -> None:
    """Write code that adds the accelerations of the bodies of an element under loads on its coordinates to `fall`."""
    for c, load in enumerate(loads):
        if not load.is_zero:
            x = load * compliance(w, c % 3, BODIES + 3 * (c // 3) + BODY_CONSTANTS)
            w.write(x, "fall", BODIES + 3 * (c // 3) + BODY_COORDINATES, c % 3, ADD)


def _state_entries(group: ConstraintGroup, row: int) -> list[Scalar]:
    """Return the entries of a row of Psi_q as functions of the state."""
    n = group.coordinates
    return group.programs.outputs["psi_q"][row * n : (row + 1) * n]


def _read_square(w: KernelWriter, array: str, k: int) -> SquareMatrix:
    return [[w.read(array, None, i * k + j) for j in range(k)] for i in range(k)]


def _write_square(w: KernelWriter, array: str, matrix: SquareMatrix) -> None:
    for i, row in enumerate(matrix):
        for j, s in enumerate(row):
            w.write(s, array, None, i * len(row) + j)


def _product(graph: Graph, a: SquareMatrix, b: SquareMatrix) -> SquareMatrix:
    return [[dot(graph, row, [other[j] for other in b]) for j in range(len(b))] for row in a]


def _count_negative(w: KernelWriter, pivot: Scalar) -> None:
    zero, one = w.graph.constant(0.0), w.graph.constant(1.0)
    w.write(where(greater(zero, pivot), one, zero), "negative", None, 0, ADD)


def _inverse(graph: Graph, matrix: SquareMatrix, look: Callable[[Scalar], None] = lambda _: None) -> SquareMatrix:
    """Return the inverse of a matrix of scalars by elimination without pivoting; `look` is called with each pivot."""
    k = len(matrix)
    rows = [[*row, *(graph.constant(float(i == j)) for j in range(k))] for i, row in enumerate(matrix)]
    for p in range(k):
        look(rows[p][p])
        pivot = graph.constant(1.0) / rows[p][p]
        rows[p] = [s * pivot for s in rows[p]]
        for i in range(k):
            if i != p:
                factor = rows[i][p]
                rows[i] = [s - factor * x for s, x in zip(rows[i], rows[p], strict=True)]
    return [row[k:] for row in rows]
