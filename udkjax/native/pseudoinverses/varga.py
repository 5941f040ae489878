"""D^+ by two QR factorizations (`udkjax.pinv.Varga`)."""

from dataclasses import dataclass

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
class VargaCode(DenseMethod):
    """Two QR factorizations: D = Q R with column pivoting, then R = L Z^T by reflections from the right; D^+ = Z L^(-1) Q^T.

    The rows of R up to the rank are independent, so the second factorization needs no pivots.
    """

    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        steps = min(m, n)
        return qr_matrices(m, n) | {"z": (steps, n), "tau_z": (1, steps), "inverse": (1, steps)}

    def factor(self, d: DenseMatrices):
        f = d.f
        pivoted_qr(d, lambda scale: d.threshold(self, scale))
        rank = f.variable(d.row("rank").entry(0))
        with f.each(d.steps) as k:
            counts = d.number(k) < rank.value
            end = reflect_row(d, "D", k, counts, "z", "tau_z")
            d.row("inverse").put(k, f.select(counts, 1.0 / f.select(counts, end, 1.0), 0.0))
            with f.each(d.steps, k + 1) as i:
                apply_reflector(d, "z", "tau_z", k, "D", i)

    def solve(self, d: DenseMatrices):
        f, b, x = d.f, d.row("b"), d.row("x")
        apply_q_transposed(d)
        x.clear()
        with f.each(d.steps) as k:  # L y = b: entries of row k after column k multiply zeros
            x.put(k, (b.entry(k) - d.dot(d.row("D", k), x)) * d.row("inverse").entry(k))
        with reversed_each(d, d.steps) as k:
            apply_reflector(d, "z", "tau_z", k, "x")
