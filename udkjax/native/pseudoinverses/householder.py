"""D^+ by Householder's QR: a basic solution minus its projection on the null space (`udkjax.pinv.Householder`)."""

from dataclasses import dataclass

from udkjax.native.language.ir import INT, Operand, Value
from udkjax.native.pseudoinverses.dense import DenseMatrices, DenseMethod
from udkjax.native.pseudoinverses.qr import (
    apply_q_transposed,
    apply_reflector,
    pivoted_qr,
    qr_matrices,
    reflect_row,
    reversed_each,
)


@dataclass(frozen=True)
class HouseholderCode(DenseMethod):
    """Householder's method: D = Q R = Q T G, with T the pivot columns of R and G = T^(-1) R.

    The null space of D is spanned by one vector for each column f without a pivot, a free column: e_f - sum_i G_if e_(pivot i).

    The basic solution, from a system with T, is zero in free columns; reflections of the basis of the null space then remove the
    component of this solution in the null space.
    """

    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        steps = min(m, n)
        return qr_matrices(m, n) | {
            "triangle": (steps, steps),
            "inverse": (1, steps),
            "y": (1, steps),
            "null": (n, n),
            "z": (n, n),
            "tau_z": (1, n),
            "free": (1, 1),
        }

    def factor(self, d: DenseMatrices):
        f = d.f
        pivoted_qr(d, lambda scale: d.threshold(self, scale))
        rank = f.variable(d.row("rank").entry(0))
        with reversed_each(d, d.steps) as i:  # D becomes G
            counts = d.number(i) < rank.value
            row, triangle = d.row("D", i), d.row("triangle", i)
            triangle.clear()
            inverse = f.select(counts, 1.0 / f.select(counts, d.row("diagonal").entry(i), 1.0), 0.0)
            d.row("inverse").put(i, inverse)
            with f.each(d.steps, i + 1) as j:
                entry = row.at(d.whole(d.row("order").entry(j)))
                inside = d.number(j) < rank.value
                triangle.put(j, f.select(inside, entry, 0.0))
            with f.each(d.steps, i + 1) as j:
                d.axpy(-triangle.entry(j), d.row("D", j), row)
            wide = d.spread(inverse)

            def scale(r: Operand):
                row[r] = row[r] * wide

            d.over_registers(row.registers, scale)
        self._reflect_null_space(d, d.wide(float(d.n)) - rank.value)

    def _reflect_null_space(self, d: DenseMatrices, free: Value):
        """Write reflections that map the basis of the null space, one vector for each free column, to the first coordinates.

        `free`: the number of free columns.
        """
        f = d.f
        d.row("free").put(0, free)
        column = f.variable(-1.0)
        with f.each(self._count(d)) as k:
            is_used = d.number(k) < d.row("free").entry(0)
            next_free = f.variable(0.0)
            with reversed_each(d, d.n) as j:
                number = d.number(j)
                next_free.where((d.row("unused").entry(j) > 0.5) & (number > column.value), number)
            column.value = next_free.value
            place, vector = d.whole(column.value), d.row("null", k)
            vector.clear()
            with f.each(d.steps) as i:
                vector.put_at(d.whole(d.row("order").entry(i)), -d.row("D", i).at(place))
            vector.put_at(place, f.select(is_used, d.wide(1.0), 0.0))
            with f.each(k) as j:
                apply_reflector(d, "z", "tau_z", j, "null", k)
            reflect_row(d, "null", k, is_used, "z", "tau_z")

    def _count(self, d: DenseMatrices) -> Value:
        """Return the maximum over lanes of the number of free columns."""
        free = d.row("free").entry(0)
        return d.whole(free if d.f.width == 1 else d.f.reduce("fmax", free))

    def solve(self, d: DenseMatrices):
        f, b, x, y = d.f, d.row("b"), d.row("x"), d.row("y")
        apply_q_transposed(d)
        x.clear()
        y.clear()
        with reversed_each(d, d.steps) as i:
            y.put(i, (b.entry(i) - d.dot(d.row("triangle", i), y)) * d.row("inverse").entry(i))
        with f.each(d.steps) as i:
            x.put_at(d.whole(d.row("order").entry(i)), y.entry(i))
        count = f.variable(self._count(d), INT, 1)
        with f.each(count.value) as k:
            apply_reflector(d, "z", "tau_z", k, "x")
        free = d.row("free").entry(0)
        with f.each(count.value) as k:
            is_used = d.number(k) < free
            x.put(k, f.select(is_used, 0.0, x.entry(k)))
        with reversed_each(d, count.value) as k:
            apply_reflector(d, "z", "tau_z", k, "x")
