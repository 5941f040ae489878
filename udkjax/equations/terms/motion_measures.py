"""Measures of the motion of a driven mechanism, such as torques, as expressions with derivatives by adjoint equations.

With s the value of the driver, differentiating Psi(x, s, q) = 0 gives

    F_1 = Psi_q u + Psi_s = 0,      u = dq/ds,
    F_2 = Psi_q w + D^2 Psi = 0,    w = d^2q/ds^2, D the derivative along (s, q) = (1, u),
    F_3 = Psi_q^T y - b = 0,        b(x, s, q, u, w), such as M a - F, for which y are the joint forces.

The derivatives of a measure g(x, s, q, u, w, y, d) with respect to x and s are those of L = g - z_0 Psi - z_1 F_1 - z_2 F_2 - z_3
F_3, with multipliers that make L stationary in y, w, u and q, in this order: each follows from one linear solve with Psi_q or its
transpose.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.expressions import Graph, Scalar, ScalarProgram, trace
from udkjax.expressions.algebra.differential import Differential, SparseRow
from udkjax.expressions.algebra.elimination import SymbolicFactors

Scalars = Sequence[Scalar] | np.ndarray


class MotionModel(NamedTuple):
    """The functions of a motion, written in JAX.

    Attributes:
        psi: Psi (m,) of x, s and q.
        loads: b (k, n) of x, s, q, u and w; k may be zero.
        measures: g (G,) of x, s, q, u, w, y (k, m) and d.
    """

    psi: Callable[..., jax.Array]
    loads: Callable[..., jax.Array]
    measures: Callable[..., jax.Array]


class MotionMeasures:
    """The measures of a `MotionModel` as scalars of a graph: their `values`, and `slopes()`, their derivatives by s and x.

    Everything is first written in a separate graph, with x, s, q, u, w, y and the multipliers as inputs, and differentiated with
    respect to each; then the expressions of these inputs are substituted.
    """

    def __init__(
        self,
        graph: Graph,
        model: MotionModel,
        factors: SymbolicFactors,
        x: Sequence[Scalar],
        s: Scalar,
        q: Sequence[Scalar],
        d: Sequence[Scalar],
    ):
        self._graph, self._factors, n = graph, factors, len(q)
        self._local_graph, self._known = Graph(), {}
        zero = self._local_graph.constant(0.0)
        X, S, Q = self._let("x", x), self._let("s", [s]), self._let("q", q)
        (psi,) = _read(self._local_graph, model.psi, X, S[0], Q)
        d_psi = Differential(self._local_graph, psi, [*S, *Q])
        u = self._inputs("u", n)
        first = [d_psi.row(r).get(S[0].index, zero) + _along(d_psi.row(r), Q, u, zero) for r in psi]
        self._set(u, self._solved(first, u))
        d_first = Differential(self._local_graph, first, [*S, *Q])
        w = self._inputs("w", n)
        second = [
            d_first.row(f).get(S[0].index, zero) + _along(d_first.row(f), Q, u, zero) + _along(d_psi.row(r), Q, w, zero)
            for f, r in zip(first, psi, strict=True)
        ]
        self._set(w, self._solved(second, w))
        (b,) = _read(self._local_graph, model.loads, X, S[0], Q, u, w)
        y = [self._inputs(f"y{k}", len(psi)) for k in range(len(b))]
        for row, right in zip(y, b, strict=True):
            self._set(row, factors.solve_transposed(self._copy(list(right))))
        y_array = np.array(y, object).reshape(len(b), len(psi))
        (g,) = _read(self._local_graph, model.measures, X, S[0], Q, u, w, y_array, self._let("d", d))
        self.values = self._copy(list(g.flat))
        adjoint_residuals = [
            [_column(d_psi, psi, row, v, zero) - right[k] for k, v in enumerate(Q)] for row, right in zip(y, b, strict=True)
        ]
        self._parts = list(g.flat), list(psi), first, second, adjoint_residuals
        self._variables = (*S, *X), Q, u, w, y

    def slopes(self) -> list[list[Scalar]]:
        """Return the derivatives of each measure with respect to s and x."""
        g, psi, first, second, adjoint_residuals = self._parts
        parameters, Q, u, w, y = self._variables
        z = [self._inputs(f"z{k}", len(psi)) for k in range(3)]
        z3 = [self._inputs(f"z3{k}", len(Q)) for k in range(len(y))]
        constraint_terms = self._local_graph.constant(0.0)
        for rows, multipliers_of_rows in ((psi, z[0]), (first, z[1]), (second, z[2]), *zip(adjoint_residuals, z3, strict=True)):
            for row, multiplier in zip(rows, multipliers_of_rows, strict=True):
                constraint_terms = constraint_terms + row * multiplier
        result, zero = [], self._graph.constant(0.0)
        for measure in g:
            L = measure - constraint_terms
            inputs = [*parameters, *Q, *u, *w, *(v for row in y for v in row)]
            row = Differential(self._local_graph, [L], inputs).row(L)
            for k in (*z[0], *z[1], *z[2], *(v for right in z3 for v in right)):
                self._known[k.index] = zero
            for variables, multipliers in zip(y, z3, strict=True):
                self._set(multipliers, self._factors.solve(self._slope(row, variables)))
            for variables, multipliers in ((w, z[2]), (u, z[1]), (Q, z[0])):
                self._set(multipliers, self._factors.solve_transposed(self._slope(row, variables)))
            result.append(self._slope(row, parameters))
        return result

    def _slope(self, row: SparseRow, variables: Scalars) -> list[Scalar]:
        zero = self._local_graph.constant(0.0)
        return self._copy([row.get(v.index, zero) for v in variables])

    def _inputs(self, name: str, count: int) -> np.ndarray:
        return np.array([self._local_graph.input((name, k), name) for k in range(count)], object)

    def _let(self, name: str, values: Sequence[Scalar]) -> np.ndarray:
        variables = self._inputs(name, len(values))
        self._set(variables, values)
        return variables

    def _set(self, variables: Scalars, values: Sequence[Scalar]):
        self._known |= {v.index: value for v, value in zip(variables, values, strict=True)}

    def _solved(self, rows: Sequence[Scalar], variables: np.ndarray) -> list[Scalar]:
        """Return the values of `variables` at which `rows` vanish; the rows are linear in them, with coefficients Psi_q."""
        self._set(variables, [self._graph.constant(0.0)] * len(variables))
        return [-v for v in self._factors.solve(self._copy(rows))]

    def _copy(self, outputs: Sequence[Scalar]) -> list[Scalar]:
        inputs = [Scalar(self._local_graph, k) for k in self._known]
        return self._graph.copy(ScalarProgram(self._local_graph, inputs, list(outputs)), self._known)


def _read(graph: Graph, function: Callable[..., jax.Array], *arguments: Scalar | np.ndarray) -> list[np.ndarray]:
    arrays = [np.array(a, object) for a in arguments]
    return trace(function, *[jnp.zeros(a.shape) for a in arrays])(graph, *arrays)


def _along(row: SparseRow, variables: Scalars, tangents: Scalars, zero: Scalar) -> Scalar:
    """Return the product of a row of derivatives with the tangents of `variables`."""
    return sum((row[v.index] * t for v, t in zip(variables, tangents, strict=True) if v.index in row), zero)


def _column(d_rows: Differential, rows: Scalars, y: Scalars, variable: Scalar, zero: Scalar) -> Scalar:
    """Return the derivative of y^T rows with respect to one variable."""
    return sum((d_rows.row(r)[variable.index] * k for r, k in zip(rows, y, strict=True) if variable.index in d_rows.row(r)), zero)
