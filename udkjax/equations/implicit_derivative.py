"""Derivatives of accelerations and projections by the implicit function theorem: no factorization is differentiated.

The accelerations are a = a_F + M^(-1/2) x, where x and y solve, for the independent rows,

    x = D^T y,        D x = b.

Along a change of the inputs db, dD, da_F and dM^(-1/2) are sparse combinations of it, and with e = dD^T y

    dx = e + D^T dy,        D D^T dy = db - dD x - D e,        da = da_F + dM^(-1/2) x + M^(-1/2) dx

by the factors at hand. Transposed, with a cotangent w of a,

    D D^T u = D M^(-1/2) w

makes u the cotangent of db - dD x and M^(-1/2) w - D^T u that of e: one solve again. M^(-1/2) D^T is M^(-1) Psi_q^T, which takes
fewer products.

A projection is differentiated at the state that it returns, where all residuals vanish, and with them whatever they multiply:

    dq <- dq - M^(-1) Psi_q^T dy,      D D^T dy = dPsi,       then the same for v by Psi_dot, along the new dq.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property, lru_cache

from udkjax.equations.scene_programs import EliminationPrograms
from udkjax.expressions import Differential, Graph, Scalar, ScalarProgram, frontier
from udkjax.expressions.differential import Row, accumulate, common_factors, product


class ImplicitDerivative(ABC):
    """The derivative of one of the results of elimination with respect to its active inputs.

    The inputs are the constants, each by itself, t, q and v: `active` says which of them are differentiated. `stored` is what the
    derivative needs of the state, computed by `evaluation`. `forward` takes the inputs, `stored` and the tangents of the active
    inputs to the tangents of the results; `reverse` takes them and the cotangents of the results to those of the active inputs.
    All are lists of scalars.
    """

    def __init__(self, programs: EliminationPrograms, active: tuple[bool, ...]):
        self.programs = programs
        graph, e = programs.graph, programs.equations
        groups = [*([c] for c in programs.constants), [e.t], e.q, e.v]
        self.given = [s for group in groups for s in group]
        self.inputs = [s for group, is_active in zip(groups, active, strict=True) if is_active for s in group]
        tangents = [graph.input((s.index, 0), "tangent") for s in self.inputs]
        cotangents = [graph.input(k, "cotangent") for k in range(self.result_count)]
        self._prepare()
        forward, reverse = self._forward(tangents), self._reverse(cotangents)
        early = frontier(graph, [*forward, *reverse], lambda node: not node.depends & {"tangent", "cotangent"})
        known = {s.index for s in self.given}
        self.stored = [s for s in early if s.index not in known]
        self.forward = ScalarProgram(graph, [*self.given, *self.stored, *tangents], forward)
        self.reverse = ScalarProgram(graph, [*self.given, *self.stored, *cotangents], reverse)

    @property
    @abstractmethod
    def result_count(self) -> int:
        """The number of scalars that are differentiated."""

    @cached_property
    @abstractmethod
    def evaluation(self) -> ScalarProgram:
        """The results that are not stored already, and `stored`."""

    @abstractmethod
    def _prepare(self) -> None:
        """Differentiate the expressions that both modes need."""

    @abstractmethod
    def _forward(self, tangents: Sequence[Scalar]) -> list[Scalar]: ...

    @abstractmethod
    def _reverse(self, cotangents: Sequence[Scalar]) -> list[Scalar]: ...

    def _differential(self, outputs: Sequence[Scalar], inputs: Sequence[Scalar]) -> Differential:
        return Differential(self.programs.graph, outputs, inputs, fixed=self.given)


class AccelerationDerivative(ImplicitDerivative):
    """The derivative of a."""

    @property
    def result_count(self) -> int:
        return self.programs.coordinate_count

    @cached_property
    def evaluation(self) -> ScalarProgram:
        """a, safe and `stored`."""
        return ScalarProgram(self.programs.graph, self.given, [*self.programs.accelerations.outputs, *self.stored])

    def _prepare(self):
        programs = self.programs
        e, independent = programs.equations, programs.independent_rows
        rows, b = [programs.D[i] for i in independent], [programs.b(i) for i in independent]
        self.rows = [e.psi_q[i] for i in independent]
        entries = [entry for row in rows for entry in row.values()]
        self.differential = d = self._differential([*b, *entries, *e.free, *programs.root], self.inputs)
        x = [r * s for r, s in zip(programs.root, programs.jt(programs.y), strict=True)]
        self.free_part: list[Row] = [dict(d.row(f)) for f in e.free]  # da_F + dM^(-1/2) x
        self.row_space_part: list[Row] = [{} for _ in x]  # M^(-1/2) dD^T y
        self.residual: list[Row] = [dict(d.row(s)) for s in b]  # db - dD x
        for k, root in enumerate(programs.root):
            accumulate(self.free_part[k], d.row(root), x[k])
        for residual, row, y in zip(self.residual, rows, programs.y, strict=True):
            for k, entry in row.items():
                accumulate(residual, d.row(entry), -x[k])
                accumulate(self.row_space_part[k], d.row(entry), y)
        self.row_space_part = [
            {k: p * root for k, p in row.items()} for row, root in zip(self.row_space_part, programs.root, strict=True)
        ]
        self.residual, self.factors = common_factors(self.residual, {s.index for s in self.given})

    def _forward(self, tangents: Sequence[Scalar]) -> list[Scalar]:
        programs, graph = self.programs, self.programs.graph
        known = self.differential.forward({s.index: t for s, t in zip(self.differential.inputs, tangents, strict=True)})
        scaled = {k: t * self.factors.get(k, 1.0) for k, t in known.items()}
        direct, turned = ([product(row, known, graph) for row in rows] for rows in (self.free_part, self.row_space_part))
        residual = [product(row, scaled, graph) for row in self.residual]
        dy = programs.solve_gram([r - _times(row, turned, graph) for r, row in zip(residual, self.rows, strict=True)])
        return [sum(parts, graph.constant(0.0)) for parts in zip(direct, turned, programs.minv_jt(dy), strict=True)]

    def _reverse(self, cotangents: Sequence[Scalar]) -> list[Scalar]:
        programs, graph, w = self.programs, self.programs.graph, cotangents
        minv_w = [c * s for c, s in zip(programs.compliance, w, strict=True)]
        u = programs.solve_gram([_times(row, minv_w, graph) for row in self.rows])
        scaled: Row = {}
        for row, seed in zip(self.residual, u, strict=True):
            accumulate(scaled, row, seed)
        found = {k: c * self.factors.get(k, 1.0) for k, c in scaled.items()}
        seeds = _differences(w, programs.jt(u))
        for row, seed in (*zip(self.row_space_part, seeds, strict=True), *zip(self.free_part, w, strict=True)):
            accumulate(found, row, seed)
        return self.differential.reverse(found)


class ProjectionDerivative(ImplicitDerivative):
    """The derivative of q and v as a projection returns them."""

    @property
    def result_count(self) -> int:
        return 2 * self.programs.coordinate_count

    @cached_property
    def evaluation(self) -> ScalarProgram:
        """`stored`: q and v are given."""
        return ScalarProgram(self.programs.graph, self.given, self.stored)

    def _prepare(self):
        e, independent = self.programs.equations, self.programs.independent_rows
        state = {s.index for s in (*e.q, *e.v)}
        self.variables = [s for s in self.inputs if s.index not in state] + [*e.q, *e.v]  # q and v change, whatever else does
        self.rows = [e.psi_q[i] for i in independent]
        self.psi, self.psi_dot = [e.psi[i] for i in independent], [e.psi_dot[i] for i in independent]
        self.d_psi = self._differential(self.psi, self.variables)
        self.d_psi_dot = self._differential(self.psi_dot, self.variables)

    def _forward(self, tangents: Sequence[Scalar]) -> list[Scalar]:
        programs, e, zero = self.programs, self.programs.equations, self.programs.graph.constant(0.0)
        known = {s.index: t for s, t in zip(self.inputs, tangents, strict=True)}
        for x, d, outputs in ((e.q, self.d_psi, self.psi), (e.v, self.d_psi_dot, self.psi_dot)):
            tangents_of_rows = d.forward(known)
            residual = [product(d.row(s), tangents_of_rows, programs.graph) for s in outputs]
            before, dy = [known.get(s.index, zero) for s in x], programs.solve_gram(residual, dropping=True)
            known |= {s.index: t for s, t in zip(x, _differences(before, programs.minv_jt(dy)), strict=True)}
        return [known[s.index] for s in (*e.q, *e.v)]

    def _reverse(self, cotangents: Sequence[Scalar]) -> list[Scalar]:
        programs, e = self.programs, self.programs.equations
        total: Row = {s.index: c for s, c in zip((*e.q, *e.v), cotangents, strict=True)}
        for x, d, outputs in ((e.v, self.d_psi_dot, self.psi_dot), (e.q, self.d_psi, self.psi)):
            minv_w = [c * total[s.index] for c, s in zip(programs.compliance, x, strict=True)]
            u = programs.solve_gram([_times(row, minv_w, programs.graph) for row in self.rows], dropping=True)
            found: Row = {}
            for output, seed in zip(outputs, u, strict=True):
                accumulate(found, d.row(output), -seed)
            for s, cotangent in zip(self.variables, d.reverse(found), strict=True):
                total[s.index] = total[s.index] + cotangent if s.index in total else cotangent
        return [total[s.index] for s in self.inputs]


def _times(row: Row, x: Sequence[Scalar], graph: Graph) -> Scalar:
    return sum((entry * x[k] for k, entry in row.items()), graph.constant(0.0))


def _differences(a: Sequence[Scalar], b: Sequence[Scalar]) -> list[Scalar]:
    return [x - y for x, y in zip(a, b, strict=True)]


@lru_cache(maxsize=64)
def acceleration_derivative(programs: EliminationPrograms, active: tuple[bool, ...]) -> AccelerationDerivative:
    """Return the derivative of the accelerations with respect to those of constants, t, q and v that are `active`."""
    return AccelerationDerivative(programs, active)


@lru_cache(maxsize=64)
def projection_derivative(programs: EliminationPrograms, active: tuple[bool, ...]) -> ProjectionDerivative:
    """Return the derivative of the projection with respect to those of constants, t, q and v that are `active`."""
    return ProjectionDerivative(programs, active)
