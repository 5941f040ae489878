"""The programs of one structure: what has to be computed for a method and a stabilization, and nothing else."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from udkjax.equations.derivative import Derivative
from udkjax.equations.scalar_equations import ScalarEquations, scalar_equations
from udkjax.expressions import Program, Scalar, frontier
from udkjax.pinv.sparse import Factors, Row, absolute, all_of, at_least, factorize, multipliers, pattern, transpose_times
from udkjax.scene.mechanism import Mechanism

# Bodies, constraints and force elements. Straight-line code evaluates faster, up to several times this size; but it takes the
# longer to trace and compile, the larger the scene (see the scaling benchmark).
LARGE = 40
# What a row left out may disagree by, relative to its terms, and still count as satisfied: far above rounding, and above what
# states carry that are closed to the tolerances of an integration.
CONSISTENT = 1e-6


class Code:
    """Named programs over one graph. Each takes the constants, t, q and, where it needs them, v.

    On all rows of Psi (D as the values of `pattern`): `rows` (D, b, a_F, M^(-1/2)), `closure` (D, Psi, M^(-1/2)), `psi`,
    `psi_dot`; `pieces`; `energy`; and for elimination, on those not left out: `accelerations` (a, whether all pivots are
    safe), `nearer` (q and v after a Newton step to Psi = 0 and to Psi_dot = 0, whether safe), `closer` (the same of q alone),
    `output` (the same of v alone, and Psi of all rows), `arrival` (the same of v alone, and the accelerations with it),
    `tangential` (of changes of q and v what projection leaves; their `Factors.distance`), `finish` (`arrival` and
    `tangential`, with its pivots; whether safe).
    Each factorizes D D^T itself: to hand the factors on takes longer, and longer still to compile.
    """

    def __init__(self, equations: ScalarEquations, left_out: tuple[int, ...], baumgarte: bool, elimination: str | None):
        self.equations, self.elimination = equations, elimination
        graph = self.graph = equations.graph
        self.gains = [graph.input(name, "parameter") for name in ("alpha", "beta")] if baumgarte else []
        self.drop = graph.input("drop", "parameter")
        self.least = graph.input("least", "parameter")
        self.n = len(equations.q)
        self.root = [graph.constant(1.0) / graph.sqrt(m) for m in equations.mass]
        self.kept = [i for i in range(len(equations.psi)) if i not in left_out]
        self.left_out = left_out
        self.D: list[Row] = [{k: entry * self.root[k] for k, entry in row.items()} for row in equations.psi_q]
        self.pattern, values = pattern(self.D, self.n)

        self.outputs: dict[str, list[Scalar]] = {
            "rows": [*values, *(self.b(i) for i in range(len(self.D))), *equations.free, *self.root],
            "closure": [*values, *equations.psi, *self.root],
            "psi": equations.psi,
            "psi_dot": equations.psi_dot,
            "pieces": equations.pieces,
            "energy": [equations.kinetic_energy, equations.potential_energy],
        }
        if elimination:
            self._eliminate()
        self._programs: dict[str, Program] = {}
        self._derivatives: dict[tuple[str, tuple[bool, ...]], Derivative] = {}
        # One that checks has constants in common with the one that watches: derivatives by that are taken along them.
        self.watching = Code(equations, left_out, baumgarte, "watch") if elimination == "check" else self
        wanted = [s for code in dict.fromkeys((self, self.watching)) for outputs in code.outputs.values() for s in outputs]
        self._take_constants(frontier(graph, wanted, lambda node: node.depends <= {"parameter"}))
        self.watching._take_constants(self.constants)

    def _take_constants(self, constants: list[Scalar]):
        self.constants = constants
        self.prologue = Program(self.graph, [*self.equations.inputs, *self.gains, self.drop, self.least], constants)

    # What machine code asks of this as of `LargeCode`.

    @property
    def m(self) -> int:
        """How many rows there are."""
        return len(self.equations.psi)

    @property
    def made_of(self) -> int:
        """How many numbers `rows` returns."""
        return len(self.outputs["rows"])

    @property
    def drop_place(self) -> int | None:
        """Which of the constants is `drop`, if any is."""
        return next((k for k, s in enumerate(self.constants) if s.index == self.drop.index), None)

    def _eliminate(self):
        """The equation for rows that are independent: a = a_F + M^(-1) Psi_q^T y with D D^T y = b."""
        graph, e = self.graph, self.equations
        self.compliance = [r * r for r in self.root]
        rows = [self.D[i] for i in self.kept]
        self._dropping = factorize(rows, graph, self.drop)
        self._gram = factorize(rows, graph) if self.elimination == "check" else self._dropping
        self.y = self.solved([self.b(i) for i in self.kept])
        self.a = [f + s for f, s in zip(e.free, self.spread(self.y), strict=True)]
        safe = self._safe(self._gram)  # looked at when all else is done: nothing waits for it
        self.outputs["accelerations"] = [*self.a, safe]
        watched = all_of([safe, *(self._satisfied(i, self.a) for i in self.left_out)], graph)
        self.outputs["accelerations_watched"] = [*self.a, watched]
        psi, psi_dot = ([residual[i] for i in self.kept] for residual in (e.psi, e.psi_dot))
        closer, with_doubt = self._without(e.q, psi), self._safe(self._dropping)
        self.outputs["nearer"] = [*closer, *self._without(e.v, psi_dot), with_doubt]
        self.outputs["closer"] = [*closer, with_doubt]
        self.outputs["output"] = [*self._without(e.v, psi_dot), *e.psi]
        v = self._without(e.v, psi_dot, dropping=False)
        moved = dict(zip((x.index for x in e.v), v, strict=True))
        n, loads = self.n, graph.replaced([*e.free, *(self.b(i) for i in self.kept)], moved)
        a = [f + s for f, s in zip(loads[:n], self.spread(self.solved(loads[n:])), strict=True)]
        self.outputs["arrival"] = [*v, *a, safe]
        self.changes = [graph.input(f"d{k}", "change") for k in range(2 * self.n)]
        self.outputs["tangential"] = [*self._tangential(True), self._dropping.distance(graph)]
        self.outputs["finish"] = [*v, *a, *self._tangential(False), self._gram.distance(graph), safe]

    def _safe(self, factors: Factors) -> Scalar:
        """Whether no pivot is too small to be trusted; a method that drops such rows does not ask."""
        return all_of(factors.above(self.least) if self.elimination in ("check", "watch") else [], self.graph)

    def solved(self, b: Sequence[Scalar], dropping: bool = False) -> list[Scalar]:
        """y with D D^T y = b, of the rows kept; zero where a row was dropped, if `dropping` is asked for or the method drops."""
        return multipliers(self._dropping if dropping else self._gram, b) if b else []

    def pulled(self, y: Sequence[Scalar]) -> list[Scalar]:
        """Psi_q^T y, of the rows kept."""
        return transpose_times([self.equations.psi_q[i] for i in self.kept], y, self.n, self.graph.constant(0.0))

    def spread(self, y: Sequence[Scalar]) -> list[Scalar]:
        """M^(-1) Psi_q^T y, of the rows kept."""
        return [c * s for c, s in zip(self.compliance, self.pulled(y), strict=True)]

    def _tangential(self, dropping: bool) -> list[Scalar]:
        rows, zero = [self.equations.psi_q[i] for i in self.kept], self.graph.constant(0.0)
        found = []
        for change in (self.changes[: self.n], self.changes[self.n :]):
            residual = [sum((entry * change[k] for k, entry in row.items()), zero) for row in rows]
            found += self._without(change, residual, dropping)
        return found

    def _without(self, x: Sequence[Scalar], residual: Sequence[Scalar], dropping: bool = True) -> list[Scalar]:
        """x without what makes a residual of the rows kept: x - M^(-1) Psi_q^T (D D^T)^(-1) residual."""
        return [c - s for c, s in zip(x, self.spread(self.solved(residual, dropping)), strict=True)]

    def b(self, i: int) -> Scalar:
        """gamma - 2 alpha Psi_dot - beta^2 Psi - Psi_q a_F of one row."""
        e = self.equations
        b = e.gamma[i] - sum((entry * e.free[k] for k, entry in e.psi_q[i].items()), self.graph.constant(0.0))
        if self.gains:
            alpha, beta = self.gains
            b = b - alpha * 2.0 * e.psi_dot[i] - beta * beta * e.psi[i]
        return b

    def _satisfied(self, i: int, a: list[Scalar]) -> Scalar:
        """Whether the accelerations satisfy a row that was left out: if they do, they are those of all rows."""
        zero = self.graph.constant(0.0)
        terms = [entry * (a[k] - self.equations.free[k]) for k, entry in self.equations.psi_q[i].items()]
        b = self.b(i)
        size = sum((absolute(term) for term in terms), absolute(b))
        return at_least(size * CONSISTENT, absolute(sum(terms, zero) - b))

    def program(self, name: str) -> Program:
        if name not in self._programs:
            e = self.equations
            state = [e.t, *e.q, *e.v, *(self.changes if name in ("tangential", "finish") else [])]
            self._programs[name] = Program(self.graph, [*self.constants, *state], self.outputs[name])
        return self._programs[name]

    def derivative(self, name: str, moving: tuple[bool, ...]) -> Derivative:
        """The derivative of "accelerations" or "projection" along some of constants, t, q and v: those that are `moving`."""
        if (name, moving) not in self._derivatives:
            self._derivatives[name, moving] = Derivative(self, name, moving)
        return self._derivatives[name, moving]


@lru_cache(maxsize=64)
def _code(tree: Any, shapes: tuple, left_out: tuple[int, ...], baumgarte: bool, elimination: str | None) -> Code:
    return Code(scalar_equations(tree, shapes), left_out, baumgarte, elimination)


def is_large(mechanism: Mechanism) -> bool:
    """Whether a scene has more than `LARGE` elements."""
    return len(mechanism.body_names) + len(mechanism.constraints) + len(mechanism.force_names) > LARGE


def code(mechanism: Mechanism, left_out: tuple[int, ...], baumgarte: bool, elimination: str | None) -> Code:
    """Return the code for a mechanism's structure; `elimination` is None, or what it does with small pivots.

    "drop": it leaves out rows whose pivots are below `drop`; "check": it says where there are any below `least`; "watch": it does
    both. (Derivatives of steps that are taken with care are those of the rows that are left.)
    """
    return _code(*structure(mechanism), left_out, baumgarte, elimination)


def structure(mechanism: Mechanism) -> tuple[Any, tuple]:
    """Return what the code depends on: the tree of the mechanism and the shapes of its numbers, not their values."""
    leaves, tree = jax.tree.flatten(mechanism.bare)
    return tree, tuple((np.shape(leaf), np.dtype(getattr(leaf, "dtype", float))) for leaf in leaves)


def as_vector(leaves: Sequence[Any]) -> Any:
    """All numbers of some arrays, in order: by NumPy where they are known."""
    known = not any(isinstance(x, Tracer) for x in leaves)
    parts = [np.ravel(np.asarray(x, float)) if known else jax.numpy.ravel(jax.numpy.asarray(x, float)) for x in leaves]
    return np.concatenate(parts) if known else jax.numpy.concatenate(parts)


def scalars(leaves: Sequence[Any]) -> list[Any]:
    """All numbers of some arrays, in the order in which the graph counts them."""
    return [x for leaf in leaves for x in _numbers(leaf)]


def _numbers(leaf: Any) -> list[Any]:
    if not np.shape(leaf):
        return [leaf[()] if isinstance(leaf, np.ndarray) else leaf]
    if not isinstance(leaf, Tracer):
        return [leaf[place] for place in np.ndindex(*np.shape(leaf))]
    flat = leaf.reshape(-1)
    return [jax.lax.index_in_dim(flat, k, keepdims=False) for k in range(flat.size)]  # a third of what flat[k] takes to trace
