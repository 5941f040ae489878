"""The linear systems of a user-defined system as scalars: M = L diag(p) L^T, and elimination of A M^(-1) A^T, both unrolled.

With A the rows (Psi_q; phi_v), B = A L^(-T) and C = diag(1 / p), a change of coordinates w is M^(-1) A^T x = L^(-T) C B^T x, and

    B C B^T x = right,        M a = F + A^T x,        A a = c.

If M is diagonal, L is the identity, and nothing of it is computed. D = B C^(1/2) has the singular values of A M^(-1/2). Rows of
Psi are eliminated before those of phi, so that a prefix of the factors serves corrections of positions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from udkjax.expressions import Graph, Scalar
from udkjax.expressions.algebra.differential import SparseRow
from udkjax.expressions.algebra.sparse_ldl import SparseLDL, factorize
from udkjax.expressions.scalars.selection import absolute, both, greater, maximum, where
from udkjax.pinv.elimination_order import minimum_degree

# A pivot of M that is not larger than this times its diagonal entry is rounding: M is singular.
LEAST_MASS_PIVOT = 64 * np.finfo(float).eps


@dataclass(frozen=True)
class MassFactors:
    """The factors of M = L diag(p) L^T: L, the reciprocals of the pivots p, and B = A L^(-T) for rows A."""

    mass: SparseLDL
    B: list[SparseRow]

    @property
    def couplings(self) -> list[Scalar]:
        """The entries of L below its diagonal, by columns; empty if M is diagonal."""
        return [s for column in self.mass.below for s in column.values()]

    @property
    def compliance(self) -> Sequence[Scalar]:
        return self.mass.inverse

    def rates(self, u: Sequence[Scalar]) -> list[Scalar]:
        """Return B u, the rates of the rows A for the velocities L^(-T) u."""
        return [sum((s * u[k] for k, s in row.items()), u[0].graph.constant(0.0)) for row in self.B]

    def combine(self, x: Sequence[Scalar]) -> list[Scalar]:
        """Return C B^T x, the change of u by multipliers x, where C has the reciprocals 1 / p on its diagonal."""
        graph = self.compliance[0].graph
        total = [graph.constant(0.0)] * len(self.compliance)
        for row, s in zip(self.B, x, strict=True):
            for k, entry in row.items():
                total[k] = total[k] + entry * s
        return [c * s for c, s in zip(self.compliance, total, strict=True)]


@dataclass(frozen=True)
class SystemFactors:
    """The factors with which the linear systems at one state are solved."""

    rows: MassFactors
    gram: SparseLDL
    nearness: Scalar
    """The largest ratio of a diagonal entry of B C B^T to its pivot."""
    trusted: Scalar
    """True if all pivots exceed `safe_tol` times their diagonal entries."""

    def respond(self, load: Sequence[Scalar], c: Sequence[Scalar], count: int | None = None) -> tuple[list[Scalar], list[Scalar]]:
        """Return a and x of M a = load + A^T x, A a = c, with the first `count` rows of the order of elimination."""
        u = [s * inverse for s, inverse in zip(self.rows.mass.forward(load), self.rows.compliance, strict=True)]
        right = [s - rate for s, rate in zip(c, self.rows.rates(u), strict=True)]
        x = self.gram.solve(right, count)
        u = [s + change for s, change in zip(u, self.rows.combine(x), strict=True)]
        return self.rows.mass.backward(u), x

    def correct(self, residual: Sequence[Scalar], count: int | None = None) -> list[Scalar]:
        """Return the least change w in the metric of M for which A w is the residual."""
        return self.rows.mass.backward(self.rows.combine(self.gram.solve(residual, count)))

    def tangent_part(
        self, change: Sequence[Scalar], count: int | None = None, drift: Sequence[Scalar] | None = None
    ) -> list[Scalar]:
        """Return the vector w nearest to `change`, in the metric of M, for which A w = -drift; the default of drift is zero."""
        rates = self.rows.rates(self.rows.mass.transposed(change))
        if drift is not None:
            rates = [rate + s for rate, s in zip(rates, drift, strict=True)]
        return [s - w for s, w in zip(change, self.correct(rates, count), strict=True)]

    @property
    def numbers(self) -> list[Scalar]:
        """All scalars of the factors that solutions use, in a fixed order."""
        parts = [self.rows.couplings, self.rows.compliance, [s for row in self.rows.B for s in row.values()]]
        return [s for part in (*parts, [s for c in self.gram.below for s in c.values()], self.gram.inverse) for s in part]

    def with_numbers(self, stored: Sequence[Scalar]) -> "SystemFactors":
        """Return factors of the same structure, with the scalars `stored` in place of `numbers`."""
        values = iter(stored)
        below = [{i: next(values) for i in column} for column in self.rows.mass.below]
        mass = self.rows.mass._replace(below=below, inverse=[next(values) for _ in self.rows.compliance])
        B = [{k: next(values) for k in row} for row in self.rows.B]
        below = [{i: next(values) for i in column} for column in self.gram.below]
        gram = self.gram._replace(below=below, inverse=[next(values) for _ in self.gram.inverse])
        return replace(self, rows=MassFactors(mass, B), gram=gram)


def factorize_mass(graph: Graph, mass: Sequence[SparseRow], A: Sequence[SparseRow]) -> MassFactors:
    """Return the factors of M, and B. A mass matrix that is not positive definite makes the factors NaN."""

    def invert(_: int, pivot: Scalar, diagonal: Scalar) -> Scalar:
        nan = graph.constant(np.nan)
        if pivot.constant is not None:
            return graph.constant(1 / pivot.constant) if pivot.constant > 0 else nan
        return where(greater(pivot, diagonal * LEAST_MASS_PIVOT), 1.0 / pivot, nan)

    factors = factorize(graph, mass, range(len(mass)), invert)
    zero = graph.constant(0.0)
    solved = [factors.forward([row.get(k, zero) for k in range(len(mass))]) for row in A]
    # An entry of A that the elimination of M cancels keeps its place, in which programs write that of A.
    entries = [{k: s for k, s in enumerate(row) if not s.is_zero or k in given} for row, given in zip(solved, A, strict=True)]
    return MassFactors(factors, entries)


def mass_operations(mass: Sequence[SparseRow]) -> int:
    """Return the number of products and sums of variable numbers in the elimination of M, without writing them."""
    n = len(mass)
    present, varies = np.zeros((n, n), bool), np.zeros((n, n), bool)
    for i, row in enumerate(mass):
        for k, s in row.items():
            present[i, k] = present[k, i] = True
            varies[i, k] = varies[k, i] = s.constant is None
    products = 0
    for k in range(n):
        rest = slice(k + 1, n)
        pairs = np.outer(present[rest, k], present[rest, k])
        changes = pairs & (varies[k, k] | varies[rest, k, None] | varies[rest, k])
        products += int(np.count_nonzero(np.tril(changes)))
        present[rest, rest] |= pairs
        varies[rest, rest] |= changes
    return 2 * products


@dataclass(frozen=True)
class PivotRule:
    """The treatment of small pivots: see `RankPolicy`."""

    drops: bool
    drop_tol: Scalar
    safe_tol: Scalar
    marks: Sequence[Scalar] | None  # one for each independent row; None: all rows are eliminated


def factorize_rows(graph: Graph, rows: MassFactors, split: int, rule: PivotRule) -> SystemFactors:
    """Return the factors of B C B^T, in which the rows before `split` come first; both parts are in an order of least fill."""
    columns = [set(row) for row in rows.B]
    order = [*minimum_degree(columns[:split]), *(split + k for k in minimum_degree(columns[split:]))]
    gram: list[SparseRow] = []
    for i, row in enumerate(rows.B):
        scaled = {k: s * rows.compliance[k] for k, s in row.items()}
        products = {j: [s * scaled[k] for k, s in rows.B[j].items() if k in scaled] for j in range(i + 1)}
        gram.append({j: sum(terms, graph.constant(0.0)) for j, terms in products.items() if terms})
    one, zero, true = graph.constant(1.0), graph.constant(0.0), graph.constant(True, bool)
    nearness: list[Scalar] = []
    trusted: list[Scalar] = []

    def invert(r: int, pivot: Scalar, diagonal: Scalar) -> Scalar:
        inverse = reciprocal = one / pivot
        if rule.drops:
            inverse = where(greater(pivot, diagonal * rule.drop_tol), reciprocal, zero)
        near, is_trusted = absolute(diagonal * reciprocal), greater(pivot, diagonal * rule.safe_tol)
        if rule.marks is not None:
            is_independent = greater(rule.marks[r], zero)
            inverse, near = where(is_independent, inverse, zero), where(is_independent, near, zero)
            is_trusted = where(is_independent, is_trusted, true)
        nearness.append(near)
        trusted.append(is_trusted)
        return inverse

    factors = factorize(graph, gram, order, invert)
    return SystemFactors(rows, factors, _joined(maximum, nearness, zero), _joined(both, trusted, true))


def _joined(join: Callable[[Scalar, Scalar], Scalar], parts: Sequence[Scalar], none: Scalar) -> Scalar:
    """Join scalars by a balanced tree, to keep chains of dependent operations short."""
    parts = list(parts)
    while len(parts) > 1:
        parts = [*map(join, parts[::2], parts[1::2]), *parts[len(parts) // 2 * 2 :]]
    return parts[0] if parts else none
