"""The Udwadia-Kalaba equation for scenes of hundreds and thousands of bodies.

The same equation as in programs.py, on arrays over all elements of a kind (alike.py) in place of scalars, so that the
program does not grow with the scene. D is kept in blocks, one for each constraint and body; D D^T is eliminated by the levels of
its elimination tree (pinv/blocks.py). For dense methods, and for singular values, D of each part of a scene that touches no
other is a matrix (rows, coordinates), for what that costs.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from udkjax.equations import large_fast
from udkjax.equations.alike import Fields
from udkjax.equations.analysis import Analysis
from udkjax.equations.code import as_vector, structure
from udkjax.equations.large_code import LargeCode, large_code
from udkjax.equations.large_plain import by_method, plain_accelerations
from udkjax.equations.layout import Layout, Selection, fields_of, layout
from udkjax.equations.motion import STEPS, Closed, MechanismMotion, Tangential, Vector
from udkjax.equations.rank_policy import REVEAL, RankPolicy
from udkjax.equations.scales import Scales
from udkjax.pinv import Auto, Elimination, Plus, Pseudoinverse
from udkjax.pinv.block_methods import BlockElimination, DenseParts
from udkjax.pinv.blocks import by_block, flat
from udkjax.scene.mechanism import Mechanism
from udkjax.straightline import Loop

# The least share of a row's length that closing takes for granted: enough to tell redundant rows from rounding, too little to
# slow down Newton's method where rows are independent.
DAMPING = 1e-10
# Of a row left out, relative to its length: what of a motion that the rows kept allow shows that it is independent of them.
INDEPENDENT = 1e-4
_RESIDUALS = {"rows": "b", "closure": "psi", "rate": "psi_dot"}


class LargeEquations(MechanismMotion):
    """The equations of motion of a large mechanism by one method.

    `Auto` eliminates the rows kept. Where a pivot is too small it takes singular values of all rows, of a dense matrix: one of
    thousands of rows takes minutes for that, and each of its singular configurations does it a few times. `Elimination` turns to
    dense elimination, which drops what depends. Where it is not known which rows are redundant all are eliminated.
    """

    numbers: dict[str, Any]
    given: Array | None  # the numbers of the scene, in order: for machine code, which computes what depends on them itself
    constants: Array | None  # of the code, for its derivatives
    baumgarte: Any
    method: Pseudoinverse
    scales: Scales
    layout: Layout = eqx.field(static=True)
    structure: Any = eqx.field(static=True)
    policy: RankPolicy = REVEAL  # where it drops rows, small pivots are taken for what they are
    dense: bool = eqx.field(static=True, default=False)  # whether the method is applied to D of all rows as a matrix
    loop: Loop | None = eqx.field(static=True, default=None)  # in which its programs run

    def accelerations(self, t: Any, q: Vector, v: Vector) -> Vector:
        """a = a_F + M^(-1/2) D^+ b."""
        return _compiled(large_fast.accelerations if self.by_levels else _plainly, self, t, q, v)

    def multipliers(self, t: Any, q: Vector, v: Vector) -> Float[Array, "m"]:
        """lambda = -(D^+)^T D^+ b of all rows: by elimination where none is left out, else by singular values."""
        return _compiled(LargeEquations._multipliers, self, t, q, v)

    def _multipliers(self, t: Any, q: Vector, v: Vector) -> Float[Array, "m"]:
        if not self.layout.count:
            return jnp.zeros(0)

        def solve(plus: Plus, rows: Selection) -> Vector:
            b = self.arrays(rows, ["b"], t, q, v, self.free(t, q, v))[0]
            return rows.listed(by_block(-(plus.T @ (plus @ flat(b))), rows.height))

        return by_method(self.dense_form if self.by_levels and self.left_out else self, solve, t, q, v)

    def project(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return q and v to Psi = 0 and Psi_dot = 0 by the smallest change in the mass metric."""
        q, v, _ = self.closed(t, q, v, STEPS)
        return q, v

    def closed(self, t: Any, q: Vector, v: Vector, steps: int) -> Closed:
        """By at most so many Newton steps in position, and one in velocity."""
        return Closed(*_compiled(large_fast.project, self, t, q, v, steps))

    def as_projected(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """A state on the manifold, with the derivatives that `project` has where it returns it."""
        return _compiled(large_fast.as_projected, self, t, q, v)

    def tangential(self, t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector) -> Tangential:
        """(I - M^(-1/2) D^+ D M^(1/2)) of two vectors: what projection at q leaves of small changes."""
        return _compiled(large_fast.tangential, self, t, q, v, dq, dv)

    def violation(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Psi and Psi_dot, of all rows: also of those that the method leaves out."""
        return _compiled(_violation, self, t, q, v)

    def is_finite(self, t: Any, q: Vector, v: Vector) -> Bool[Array, ""]:
        """Whether everything that the equation is made of is a number."""
        free = self.free(t, q, v)
        made_of = [*self.arrays(self.layout.all, ["D", "b"], t, q, v, free), free]
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in made_of]))

    def matrices(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Vector, Array, Array]:
        """M, F, Psi_q and gamma - 2 alpha Psi_dot - beta^2 Psi, of all rows, dense."""
        free = self.free(t, q, v)
        D, b = self.arrays(self.layout.all, ["D", "b"], t, q, v, free)
        root, free = flat(self.numbers["root"]), flat(free)
        M, A = 1 / root**2, self.layout.all.dense(D) / root
        return jnp.diag(M), M * free, A, self.layout.all.listed(b) + A @ free

    def jacobian(self, t: Any, q: Vector) -> Float[Array, "m n"]:
        """Psi_q of all rows, dense."""
        D = self.arrays(self.layout.all, ["D"], t, q, q)[0]
        return self.layout.all.dense(D) / flat(self.numbers["root"])

    def weighted(self, t: Any, q: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """D and Psi, their rows weighted, and M^(-1/2) of all rows, dense."""
        D, psi = self.arrays(self.layout.all, ["D", "psi"], t, q, q)
        w = self.scales.weights
        return w[:, None] * self.layout.all.dense(D), w * self.layout.all.listed(psi), flat(self.numbers["root"])

    def energy(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Kinetic and potential energy (J)."""
        x, y, _ = by_block(q, 3)
        vx, vy, omega = by_block(v, 3)
        mass, inertia = self.numbers["mass"]
        g = self.numbers["gravity"]
        kinetic = 0.5 * jnp.sum(mass * (vx * vx + vy * vy) + inertia * omega * omega)
        potential = -jnp.sum(mass * (g[0] * x + g[1] * y))
        fields = self._fields(q, v)
        for group, numbers in zip(self.layout.forces, self.numbers["forces"], strict=True):
            (stored,) = group.run(("potential",), numbers, t, fields)[0]
            potential = potential + jnp.sum(jnp.broadcast_to(jnp.asarray(stored), (len(group.members),)))
        return kinetic, potential

    def linearized(self, name: str, t: Any, q: Any, v: Any) -> tuple[Plus, Array, Vector]:
        """D^+ by the method, dense and of all rows or by blocks of those kept; the residual `name` of these; and M^(-1/2)."""
        root, name = flat(self.numbers["root"]), _RESIDUALS[name]
        free = self.free(t, q, v) if name == "b" else None
        rows = self.layout.kept if self.by_levels else self.layout.all
        D, residual = self.arrays(rows, ["D", name], t, q, v, free)
        if self.by_levels:
            return self.elimination.plus(D), flat(residual), root
        if isinstance(self.method, BlockElimination):
            plus = self.method.plus(D)
            return eqx.tree_at(lambda p: p.factors.rank, plus, self._rank(D, t, q)), flat(residual), root
        return DenseParts(rows.pattern, self.method).plus(D), flat(residual), root

    @property
    def row_names(self) -> list[tuple[str, int]]:
        return self.layout.row_names

    @property
    def left_out(self) -> tuple[int, ...]:
        return self.layout.left_out

    @property
    def constrained(self) -> bool:
        return self.layout.count > 0

    @property
    def stabilized(self) -> bool:
        return self.layout.baumgarte

    @property
    def by_levels(self) -> bool:
        return isinstance(self.method, Auto | Elimination) and not self.dense

    @property
    def branches(self) -> bool:
        return self.policy.action == "reveal" and self.by_levels and self.constrained

    def with_policy(self, policy: RankPolicy) -> "LargeEquations":
        """The same with another decision about small pivots."""
        return dataclasses.replace(self, policy=policy)

    def within(self, loop: Loop) -> "LargeEquations":
        return dataclasses.replace(self, loop=loop)

    @property
    def dense_form(self) -> "LargeEquations":
        """The same on all rows as a matrix: what to turn to where rows are not independent."""
        method = self.method.rank_revealing if isinstance(self.method, Auto) else self.method
        return dataclasses.replace(self, method=method, dense=True)

    # --- pieces

    @property
    def drop(self) -> Any:
        """What a pivot must exceed, relative to its row's diagonal entry of D D^T."""
        return self.method.branch_tol if isinstance(self.method, Auto) else jnp.asarray(self.method.rank_tol) ** 2

    @property
    def code(self) -> LargeCode:
        """The programs of the rows kept, for machine code."""
        tree, shapes = self.structure
        return large_code(tree, shapes, self.left_out, self.stabilized, _elimination(self.method))

    @property
    def elimination(self) -> BlockElimination:
        """D^+ of the rows kept, by levels."""
        return BlockElimination(self.layout.kept.pattern, jnp.sqrt(jnp.asarray(self.drop)), loop=self.loop)

    def _rank(self, D: Float[Array, "r 3 s"], t: Any, q: Vector) -> Array:
        """The rank of all rows: those kept, and those left out that some motion which these allow does not satisfy."""
        every, kept = self.layout.all, self.layout.kept
        if not self.left_out:
            return jnp.asarray(self.layout.count)
        plus = self.elimination.plus(self.arrays(kept, ["D"], t, q, q)[0])
        motion = jnp.asarray(np.random.default_rng(0).standard_normal(3 * self.layout.bodies))
        motion = motion - plus @ plus.method.matvec(plus.matrix, motion)
        missed = every.listed(every.pattern.matvec(D, by_block(motion, 3)))
        length = jnp.sqrt(every.listed(every.pattern.matvec(D * D, jnp.ones((3, self.layout.bodies)))))
        typical = jnp.sqrt(jnp.mean(motion**2))
        missed = jnp.abs(missed[np.array(self.left_out)]) > INDEPENDENT * typical * length[np.array(self.left_out)]
        return len(kept.rows) + jnp.sum(missed)

    def _fields(self, q: Vector, v: Vector, free: Any = None) -> Fields:
        fields = fields_of(q, v)
        return fields if free is None else fields | dict(zip(("fx", "fy", "fangle"), free, strict=True))

    def arrays(self, rows: Selection, names: Sequence[str], t: Any, q: Vector, v: Vector, free: Any = None) -> list[Array]:
        """`names`, of D, b, psi and psi_dot, of some rows in blocks; b takes a_F."""
        return rows.evaluate(names, self.numbers["constraints"], t, self._fields(q, v, free), self.loop)

    def free(self, t: Any, q: Vector, v: Vector) -> Float[Array, "3 bodies"]:
        """a_F = M^-1 F."""
        fall = jnp.broadcast_to(self.numbers["gravity"][:, None], (3, self.layout.bodies))
        if self.layout.loaded is None:
            return fall
        fields, parts = self._fields(q, v), []
        for group, numbers in zip(self.layout.forces, self.numbers["forces"], strict=True):
            (loads,) = group.run(("loads",), numbers, t, fields, self.loop)
            size = len(group.members)
            loads = jnp.stack([jnp.broadcast_to(jnp.asarray(x), (size,)) for x in loads]) if loads else jnp.zeros((0, size))
            parts.append(loads.reshape(-1, 3, size).swapaxes(0, 1).reshape(3, -1))
        return fall + self.numbers["root"] ** 2 * self.layout.loaded(jnp.concatenate(parts, -1))


def prepare_large(
    mechanism: Mechanism, method: Pseudoinverse, baumgarte: Any, analysis: Analysis, evaluated: bool = True
) -> LargeEquations:
    """As `prepare`, with the method's thresholds decided."""
    gains = [] if baumgarte is None else [baumgarte.alpha, baumgarte.beta]
    found = layout(*structure(mechanism), analysis.redundant_rows or (), bool(gains))
    given, constants = as_vector([*jax.tree.leaves(mechanism), *gains]), None
    if evaluated and isinstance(given, Tracer):
        kind = structure(mechanism)
        constants = large_code(*kind, found.left_out, bool(gains), _elimination(method)).constants_of(given)
    return LargeEquations(
        numbers=found.numbers(mechanism, gains) if evaluated else {},
        given=given,
        constants=constants,
        baumgarte=baumgarte,
        method=method,
        scales=analysis.scales,
        layout=found,
        structure=structure(mechanism),
    )


def prepare_closing(mechanism: Mechanism, analysis: Analysis) -> LargeEquations:
    """Prepare a mechanism to be closed: with D^+ of all rows by elimination, which `DAMPING` keeps from dividing by nothing."""
    found = layout(*structure(mechanism), analysis.redundant_rows or (), False)
    method = BlockElimination(found.all.pattern, 0.0, DAMPING)
    return LargeEquations(
        numbers=found.numbers(mechanism, ()),
        given=None,
        constants=None,
        baumgarte=None,
        method=method,
        scales=analysis.scales,
        layout=found,
        structure=structure(mechanism),
    )


def _elimination(method: Pseudoinverse) -> str:
    return "watch" if isinstance(method, Auto) else "drop"


def _violation(equations: LargeEquations, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
    rows = equations.layout.all
    psi, rate = equations.arrays(rows, ["psi", "psi_dot"], t, q, v)
    return rows.listed(psi), rows.listed(rate)


def _compiled(function: Any, equations: LargeEquations, t: Any, q: Vector, v: Vector, *rest: Any) -> Any:
    """As one program, also where it is not part of a larger one: else each of its operations would be compiled by itself."""
    return _called(function, equations, jnp.asarray(t, jnp.result_type(float)), q, v, *rest)


@eqx.filter_jit
def _called(function: Any, *arguments: Any) -> Any:
    return function(*arguments)


def _plainly(equations: LargeEquations, t: Any, q: Vector, v: Vector) -> Vector:
    return plain_accelerations(equations, t, q, v)
