"""The positions of a driven mechanism as programs of its free numbers, for batches of mechanisms in machine code.

A model defines Psi(x, s, q), with free numbers x and the driver's value s, and measures g(x, s, q, d) of a position, with data d.
At Psi = 0, by one elimination of Psi_q (expressions/algebra/elimination.py),

    q <- q - Psi_q^+ Psi,      dq/ds = -Psi_q^+ Psi_s,      dq/dx = -Psi_q^+ Psi_x,
    dg/dx = g_x - y^T Psi_x,   dg/ds = g_s - y^T Psi_s,     Psi_q^T y = g_q^T.

The `constants`, which depend only on x, are computed once for each mechanism.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.equations.terms.motion_measures import MotionMeasures, MotionModel
from udkjax.expressions import Graph, Scalar, ScalarProgram, cotangents, frontier, trace
from udkjax.expressions.algebra.differential import Differential
from udkjax.expressions.algebra.elimination import SymbolicFactors

PositionModel = Callable[..., dict[str, jax.Array]]
TracedModel = Callable[..., list[np.ndarray]]


class Sizes(NamedTuple):
    """Sizes of the inputs and outputs of a model: parameters x, coordinates q, data d per position, and measures g."""

    parameters: int  # x
    coordinates: int  # q
    data: int  # d, for one position
    measures: int  # g


class Place(NamedTuple):
    """Indices of the outputs that are a measure g, its derivative dg/ds, and the derivatives dg/dx."""

    value: int
    by_value: int
    by_parameters: slice


class PositionPrograms:
    """Programs of a driven mechanism.

    Args:
        model: A model, traced by `trace_model`: `model(x, s, q, d)`, written in JAX, returns "psi" (m,), "q0" (n,) and "s0" (), a
            closed position for the numbers x and its value s, and "measures" (G,).
        parameters: The number of free numbers x.
        coordinates: The number n of coordinates.
        data: The number of data d of a position.
        transmission: Whether the last measure is the transmission of the position: det(B) over the product of the lengths of
            its columns, where B is Psi_q after elimination of its constant entries. For a four-bar it is the sine of the
            transmission angle; it vanishes, and changes its sign, where branches meet.
        positions: Whether the first n measures are q itself.
        derivatives: Whether measures have derivatives.
        rows: The scales of the m rows of Psi, which divide the residuals of redundant rows; by default one.
        chosen: Selected measures of the model; by default all.
        motion: Measures of the motion, appended to those of the position.

    Raises:
        ValueError: The driver's value does not determine the positions.
    """

    def __init__(
        self,
        model: TracedModel,
        parameters: int,
        coordinates: int,
        data: int = 0,
        transmission: bool = True,
        positions: bool = False,
        derivatives: bool = True,
        rows: Sequence[float] | np.ndarray | None = None,
        chosen: slice | None = None,
        motion: MotionModel | None = None,
    ):
        graph = self._graph = Graph()
        self._x = _inputs(graph, "x", "parameter", parameters)
        self._s = graph.input("s", "value")
        self._q = _inputs(graph, "q", "position", coordinates)
        self._d = _inputs(graph, "d", "data", data)
        psi, q0, s0, measures = model(
            graph, np.array(self._x, object), np.array(self._s, object), np.array(self._q, object), np.array(self._d, object)
        )
        self._psi, self._q0, self._s0 = list(psi.flat), list(q0.flat), s0.item()
        self._scales = np.ones(len(self._psi)) if rows is None else np.asarray(rows, float)
        self._differential = Differential(graph, self._psi, [*self._x, self._s, *self._q])
        column = {v.index: k for k, v in enumerate(self._q)}
        entries = [{column[k]: a for k, a in self._differential.row(r).items() if k in column} for r in self._psi]
        self._factors = SymbolicFactors(graph, entries, coordinates)
        self._measures = [*(self._q if positions else []), *measures.ravel()[chosen or slice(None)]]
        self._motion = MotionMeasures(graph, motion, self._factors, self._x, self._s, self._q, self._d) if motion else None
        self._transmission = self._find_transmission() if transmission else None
        count = len(self._measures) + (len(self._motion.values) if self._motion else 0) + transmission
        self.sizes = Sizes(parameters, coordinates, data, count)
        step = 2 + parameters if derivatives else 1
        self.places = [Place(k * step, k * step + 1, slice(k * step + 2, (k + 1) * step)) for k in range(count)]
        self.output_count = count * step
        self._write(derivatives)

    def _write(self, derivatives: bool):
        correction = self._factors.solve(self._psi)
        rate = [-x for x in self._factors.solve(self._column(self._s))]
        closer = [q - dq for q, dq in zip(self._q, correction, strict=True)]
        newton = [*closer, *rate, self._sign(), self._violation()]
        outputs = self._outputs(derivatives)
        constants = frontier(self._graph, [*newton, *outputs], lambda node: node.depends <= {"parameter"})
        self.constant_count = len(constants)
        state = [*constants, self._s, *self._q]
        self.prologue = ScalarProgram(self._graph, self._x, [*constants, *self._q0, self._s0])
        """Computes the constants, q0 and s0 from x."""
        self.drawn_value = ScalarProgram(self._graph, self._x, [self._s0])
        """Computes s0 from x."""
        self.newton = ScalarProgram(self._graph, state, newton)
        """Computes, from the constants, s and q: q after a Newton step, dq/ds, the sign of the branch, and the violation."""
        self.measure = ScalarProgram(self._graph, [*state, *self._d], outputs)
        """Computes the outputs from the constants, s, q and d."""

    def _outputs(self, derivatives: bool) -> list[Scalar]:
        of_motion = self._motion.values if self._motion else []
        values = [*self._measures, *of_motion, *([] if self._transmission is None else [self._transmission[0]])]
        if not derivatives:
            return values
        slopes = self._slopes()
        return [x for value, slope in zip(values, slopes, strict=True) for x in (value, *slope)]

    def _slopes(self) -> list[list[Scalar]]:
        """Return dg/ds and dg/dx of each measure, by linear solves: for each measure or, if these are fewer, for s and each x."""
        graph, parameters = self._graph, [self._s, *self._x]
        differential = Differential(graph, self._measures, [*parameters, *self._q])
        zero = graph.constant(0.0)
        partial = [[differential.row(g).get(v.index, zero) for v in (*parameters, *self._q)] for g in self._measures]
        if self._transmission is not None:
            partial.append(self._transmission[1])
        columns = [self._column(v) for v in parameters]
        if len(partial) > len(parameters):
            changes = [[-x for x in self._factors.solve(column)] for column in columns]
            by_position = [[_dot(row[len(parameters) :], change, zero) for change in changes] for row in partial]
        else:
            adjoints = [self._factors.solve_transposed(row[len(parameters) :]) for row in partial]
            by_position = [[-_dot(y, column, zero) for column in columns] for y in adjoints]
        slopes = [
            [a + b for a, b in zip(row, indirect, strict=False)] for row, indirect in zip(partial, by_position, strict=True)
        ]
        count = len(self._measures)
        return [*slopes[:count], *(self._motion.slopes() if self._motion else []), *slopes[count:]]

    def _column(self, variable: Scalar) -> list[Scalar]:
        """Return the derivatives of Psi with respect to one variable."""
        zero = self._graph.constant(0.0)
        return [self._differential.row(r).get(variable.index, zero) for r in self._psi]

    @property
    def _is_square(self) -> bool:
        return len(self._factors.block) == len(self._factors.open_columns)

    def _violation(self) -> Scalar:
        """Return the sum of squares of Psi, each row divided by its scale; zero without redundant rows."""
        zero = self._graph.constant(0.0)
        if self._is_square:
            return zero
        rows = [r * (1.0 / float(scale)) for r, scale in zip(self._psi, self._scales, strict=True)]
        return _dot(rows, rows, zero)

    def _sign(self) -> Scalar:
        """Return the determinant of B, which changes its sign where branches meet; one if B is not square."""
        R, determinant = self._factors.triangle, self._graph.constant(1.0)
        if not self._is_square:
            return determinant
        for k in range(len(self._factors.open_columns)):
            determinant = determinant * R[k][k]
        return determinant

    def _find_transmission(self) -> tuple[Scalar, list[Scalar]]:
        """Return the transmission tau, and its derivatives with respect to s, x and q.

        With the columns b_j of B, d log tau = tr(B^+ dB) - sum_j b_j db_j / |b_j|^2.
        """
        graph, factors = self._graph, self._factors
        B, R, count = factors.block, factors.triangle, len(factors.open_columns)
        zero, tau = graph.constant(0.0), graph.constant(1.0)
        variables = [self._s, *self._x, *self._q]
        seeds, entries = [], []
        for j in range(count):
            square = _dot([row[j] for row in B], [row[j] for row in B], zero)
            tau = tau * R[j][j] / graph.sqrt(square)
            unit = [graph.constant(float(j == k)) for k in range(count)]
            inverse = factors.block_transposed(unit)
            for row, x in zip(B, inverse, strict=True):
                seeds.append(x - row[j] / square)
                entries.append(row[j])
        slopes = cotangents(graph, entries, seeds, variables) if entries else [zero] * len(variables)
        return tau, [tau * slope for slope in slopes]


def trace_model(model: PositionModel, parameters: int, coordinates: int, data: int = 0) -> TracedModel:
    """Return a traced model, from which any number of `PositionPrograms` can be made; the arguments are explained there."""
    examples = jnp.zeros(parameters), jnp.zeros(()), jnp.zeros(coordinates), jnp.zeros(data)

    def parts(*numbers: jax.Array) -> list[jax.Array]:
        found = model(*numbers)
        return [found[k] for k in ("psi", "q0", "s0", "measures")]

    return trace(parts, *examples)


def _inputs(graph: Graph, name: str, group: str, count: int) -> list[Scalar]:
    return [graph.input((name, k), group) for k in range(count)]


def _dot(a: Sequence[Scalar], b: Sequence[Scalar], zero: Scalar) -> Scalar:
    return sum((x * y for x, y in zip(a, b, strict=True)), zero)
