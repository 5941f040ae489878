"""The derivative of what elimination finds, by the implicit function theorem: no factorization is differentiated.

The accelerations are a = a_F + M^(-1/2) x, where x and y solve, of the rows kept,

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

from collections.abc import Sequence
from typing import TYPE_CHECKING

from udkjax.expressions import Differential, Program, Scalar, frontier
from udkjax.expressions.derivative import Row, accumulate, common_factors, product

if TYPE_CHECKING:
    from udkjax.equations.code import Code


class Derivative:
    """The derivative of the "accelerations" or of the "projection", along the inputs that are `moving`.

    Inputs are the constants, each by itself, t, q and v: `moving` says which of these. What the derivative needs of the state,
    `kept`, is found once; `forward` takes it with the tangents of the moving inputs to those of the results (a, or q and v), and
    `reverse` takes it with the cotangents of the results to those of the moving inputs. All are lists of scalars.
    """

    def __init__(self, code: "Code", name: str, moving: tuple[bool, ...]):
        self.code, self.name, self.moving = code, name, moving
        graph, e = code.graph, code.equations
        self.groups = [*([c] for c in code.constants), [e.t], e.q, e.v]
        self.given = [s for group in self.groups for s in group]
        self.inputs = [s for group, moves in zip(self.groups, moving, strict=True) if moves for s in group]
        results = code.n if name == "accelerations" else 2 * code.n
        tangents = self._tangents(0)
        cotangents = [graph.input(k, "cotangent") for k in range(results)]
        self.rules = rules = _Accelerations(self) if name == "accelerations" else _Projection(self)
        forward, reverse = rules.forward(tangents), rules.reverse(cotangents)
        early = frontier(graph, [*forward, *reverse], lambda node: not node.depends & {"tangent", "cotangent"})
        known = {s.index for s in self.given}
        self.kept = [s for s in early if s.index not in known]
        self.forward = Program(graph, [*self.given, *self.kept, *tangents], forward)
        self.reverse = Program(graph, [*self.given, *self.kept, *cotangents], reverse)
        self._evaluations: dict[str, Program] = {}

    def evaluation(self, name: str) -> Program:
        """The program of this name (or "projection", of no other result), which also returns what is `kept`."""
        if name not in self._evaluations:
            self._evaluations[name] = Program(self.code.graph, self.given, [*self._outputs(name), *self.kept])
        return self._evaluations[name]

    def _outputs(self, name: str) -> list[Scalar]:
        return [] if name == "projection" else self.code.outputs[name]

    def _tangents(self, direction: int) -> list[Scalar]:
        return [self.code.graph.input((s.index, direction), "tangent") for s in self.inputs]

    def differential(self, outputs: Sequence[Scalar], inputs: Sequence[Scalar]) -> Differential:
        return Differential(self.code.graph, outputs, inputs, fixed=self.given)


class _Accelerations:
    def __init__(self, derivative: Derivative):
        self.code = code = derivative.code
        e, rows = code.equations, [code.D[i] for i in code.kept]
        self.rows, b = [e.psi_q[i] for i in code.kept], [code.b(i) for i in code.kept]
        entries = [entry for row in rows for entry in row.values()]
        self.differential = d = derivative.differential([*b, *entries, *e.free, *code.root], derivative.inputs)
        x = [r * s for r, s in zip(code.root, code.pulled(code.y), strict=True)]
        self.direct: list[Row] = [dict(d.row(f)) for f in e.free]  # da_F + dM^(-1/2) x
        self.turned: list[Row] = [{} for _ in x]  # M^(-1/2) dD^T y
        self.residual: list[Row] = [dict(d.row(s)) for s in b]  # db - dD x
        for k, root in enumerate(code.root):
            accumulate(self.direct[k], d.row(root), x[k])
        for residual, row, y in zip(self.residual, rows, code.y, strict=True):
            for k, entry in row.items():
                accumulate(residual, d.row(entry), -x[k])
                accumulate(self.turned[k], d.row(entry), y)
        self.turned = [{k: p * root for k, p in row.items()} for row, root in zip(self.turned, code.root, strict=True)]
        self.residual, self.factors = common_factors(self.residual, {s.index for s in derivative.given})

    def forward(self, tangents: Sequence[Scalar]) -> list[Scalar]:
        code, graph = self.code, self.code.graph
        known = self.differential.along({s.index: t for s, t in zip(self.differential.inputs, tangents, strict=True)})
        scaled = {k: t * self.factors.get(k, 1.0) for k, t in known.items()}
        direct, turned = ([product(row, known, graph) for row in rows] for rows in (self.direct, self.turned))
        residual = [product(row, scaled, graph) for row in self.residual]
        dy = code.solved([r - _times(row, turned, graph) for r, row in zip(residual, self.rows, strict=True)])
        return [sum(parts, graph.constant(0.0)) for parts in zip(direct, turned, code.spread(dy), strict=True)]

    def reverse(self, w: Sequence[Scalar]) -> list[Scalar]:
        code, graph = self.code, self.code.graph
        moved = [c * s for c, s in zip(code.compliance, w, strict=True)]
        u = code.solved([_times(row, moved, graph) for row in self.rows])
        scaled: Row = {}
        for row, seed in zip(self.residual, u, strict=True):
            accumulate(scaled, row, seed)
        found = {k: c * self.factors.get(k, 1.0) for k, c in scaled.items()}
        for row, seed in (*zip(self.turned, _less(w, code.pulled(u)), strict=True), *zip(self.direct, w, strict=True)):
            accumulate(found, row, seed)
        return self.differential.back(found)


class _Projection:
    def __init__(self, derivative: Derivative):
        self.code = code = derivative.code
        e, self.inputs = code.equations, derivative.inputs
        state = {s.index for s in (*e.q, *e.v)}
        self.along = [s for s in self.inputs if s.index not in state] + [*e.q, *e.v]  # q and v move, whatever else does
        self.rows = [e.psi_q[i] for i in code.kept]
        self.psi, self.rate = [e.psi[i] for i in code.kept], [e.psi_dot[i] for i in code.kept]
        self.of_psi = derivative.differential(self.psi, self.along)
        self.of_rate = derivative.differential(self.rate, self.along)

    def forward(self, tangents: Sequence[Scalar]) -> list[Scalar]:
        code, e, zero = self.code, self.code.equations, self.code.graph.constant(0.0)
        known = {s.index: t for s, t in zip(self.inputs, tangents, strict=True)}
        for x, d, outputs in ((e.q, self.of_psi, self.psi), (e.v, self.of_rate, self.rate)):
            moved = d.along(known)
            residual = [product(d.row(s), moved, code.graph) for s in outputs]
            before, dy = [known.get(s.index, zero) for s in x], code.solved(residual, dropping=True)
            known |= {s.index: t for s, t in zip(x, _less(before, code.spread(dy)), strict=True)}
        return [known[s.index] for s in (*e.q, *e.v)]

    def reverse(self, w: Sequence[Scalar]) -> list[Scalar]:
        code, e = self.code, self.code.equations
        total: Row = {s.index: c for s, c in zip((*e.q, *e.v), w, strict=True)}
        for x, d, outputs in ((e.v, self.of_rate, self.rate), (e.q, self.of_psi, self.psi)):
            moved = [c * total[s.index] for c, s in zip(code.compliance, x, strict=True)]
            u = code.solved([_times(row, moved, code.graph) for row in self.rows], dropping=True)
            found: Row = {}
            for output, seed in zip(outputs, u, strict=True):
                accumulate(found, d.row(output), -seed)
            for s, cotangent in zip(self.along, d.back(found), strict=True):
                total[s.index] = total[s.index] + cotangent if s.index in total else cotangent
        return [total[s.index] for s in self.inputs]


def _times(row: Row, x: Sequence[Scalar], graph) -> Scalar:
    return sum((entry * x[k] for k, entry in row.items()), graph.constant(0.0))


def _less(a: Sequence[Scalar], b: Sequence[Scalar]) -> list[Scalar]:
    return [x - y for x, y in zip(a, b, strict=True)]
