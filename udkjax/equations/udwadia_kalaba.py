"""The Udwadia-Kalaba equation (de Falco, Pennestri, Vita 2005, section 3).

With D = Psi_q M^(-1/2), a_F = M^(-1) F and b = gamma - 2 alpha Psi_dot - beta^2 Psi - Psi_q a_F,

    a = a_F + M^(-1/2) D^+ b,        lambda = -(D^+)^T D^+ b        (M a + Psi_q^T lambda = F).

It is written twice. The plain form is the equation as it stands, on arrays, for any pseudoinverse; every derivative is taken of
it. The fast form is one straight-line program for elimination, with the plain form's derivatives; where `Auto` may branch, those
of singular values.
"""

import dataclasses
from functools import partial, reduce
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from udkjax.equations.code import Code, code, scalars
from udkjax.equations.motion import Motion, Vector
from udkjax.pinv import SVD, Auto, Elimination, Plus, Pseudoinverse, SparseElimination
from udkjax.scene.fields import number
from udkjax.scene.mechanism import Mechanism

# Far above rounding and drift, far below the singular values of a mechanism in ordinary positions: with the states returned to
# the constraint manifold, 1e-2 to 1e-5 cross the same singular configurations.
RANK_TOL = 1e-4
ORDINARY = 100.0  # the ratio of masses up to which that holds: see `rank_tolerance`


class Baumgarte(eqx.Module):
    """Feed the violation back: Psi_ddot + 2 alpha Psi_dot + beta^2 Psi = 0, alpha and beta in 1/s.

    Gains of 2 to 5 hold what redundancy and rounding excite; the hundreds of the literature only make the problem stiff.
    """

    alpha: Float[Array, ""]
    beta: Float[Array, ""]

    def __init__(self, alpha: ArrayLike = 5.0, beta: ArrayLike = 5.0):
        self.alpha, self.beta = number(alpha), number(beta)


class Equations(Motion):
    """The equations of motion of one mechanism by one method: what an integrator needs, ready to be evaluated.

    Coordinates and velocities are flat vectors (3 bodies,): x, y, angle of each body in turn.
    """

    constants: list[Array]  # the subexpressions of parameters alone that the programs use, computed once
    method: Pseudoinverse
    code: Code = eqx.field(static=True)
    branch: bool = eqx.field(
        static=True, default=True
    )  # whether `Auto` turns to singular values itself, or says NaN where it should

    def accelerations(self, t: Any, q: Vector, v: Vector, watch: bool = False) -> Vector:
        """a = a_F + M^(-1/2) D^+ b. With `watch`, `Auto` also looks at the rows left out."""
        if not self.code.elimination:
            return plain_accelerations(self, t, q, v)
        return _accelerations(
            "accelerations_watched" if watch and isinstance(self.method, Auto) else "accelerations", self, t, q, v
        )

    def multipliers(self, t: Any, q: Vector, v: Vector) -> Float[Array, "m"]:
        """lambda = -(D^+)^T D^+ b of all rows."""
        equations = self.exact() if self.code.elimination else self
        if not self.code.pattern.shape[0]:
            return jnp.zeros(0)
        plus, b, _ = equations.linearized("rows", t, q, v)
        return -(plus.T @ (plus @ b))

    def project(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return q and v to Psi = 0 and Psi_dot = 0 by the smallest change in the mass metric."""
        return _project(self, t, q, v)

    def violation(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Psi and Psi_dot, of all rows: also of those that the method leaves out."""
        return _stack(self.run("psi", t, q, v)), _stack(self.run("psi_dot", t, q, v))

    def is_finite(self, t: Any, q: Vector, v: Vector) -> Bool[Array, ""]:
        """Whether everything that the equation is made of is a number."""
        return jnp.all(jnp.isfinite(_stack(self.run("rows", t, q, v))))

    def matrices(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Vector, Array, Array]:
        """M, F, Psi_q and gamma - 2 alpha Psi_dot - beta^2 Psi, of all rows."""
        values, b, free, root = self.arrays("rows", t, q, v)
        M, A = 1 / root**2, self.code.pattern.dense(values) / root
        return jnp.diag(M), M * free, A, b + A @ free

    def jacobian(self, t: Any, q: Vector) -> Float[Array, "m n"]:
        """Psi_q of all rows."""
        values, _, root = self.arrays("closure", t, q, q)
        return self.code.pattern.dense(values) / root

    @property
    def left_out(self) -> tuple[int, ...]:
        return self.code.left_out

    @property
    def constrained(self) -> bool:
        return bool(self.code.pattern.shape[0])

    @property
    def branches(self) -> bool:
        return self.branch and self.code.elimination == "check"

    def run(self, name: str, t: Any, q: Any, v: Any) -> list[Any]:
        """Evaluate one of the programs."""
        return self.code.program(name)([*self.constants, t, *scalars([q, v])])

    def arrays(self, name: str, t: Any, q: Any, v: Any) -> list[Array]:
        """What a program returns, as arrays: the values of D, the right-hand side, and vectors over the coordinates."""
        outputs = self.run(name, t, q, v)
        n, kept = len(q), self.code.kept_pattern if name.endswith("_kept") else self.code.pattern
        bounds = [0, kept.slots, kept.slots + kept.shape[0]]
        bounds += list(range(bounds[-1] + n, len(outputs) + 1, n))
        return [_stack(outputs[i:j]) for i, j in pairwise(bounds)]

    def linearized(self, name: str, t: Any, q: Any, v: Any) -> tuple[Plus, Array, Vector]:
        """D^+ of all rows by a dense method, the right-hand side of the program `name`, and M^(-1/2)."""
        values, residual, *vectors = self.arrays(name, t, q, v)
        return self.method.plus(self.code.pattern.dense(values)), residual, vectors[-1]

    @property
    def quick(self) -> "Equations":
        """The same without a branch: what `Auto` cannot solve by elimination is not a number."""
        return dataclasses.replace(self, branch=False)

    def exact(self) -> "Equations":
        """The same by singular values of all rows: what `Auto` turns to."""
        return eqx.tree_at(lambda e: e.method, self, SVD(self.method.rank_tol, self.method.relative))


def prepare(mechanism: Mechanism, method: Pseudoinverse | None = None, baumgarte: Baumgarte | None = None) -> Equations:
    """Prepare a mechanism for a method (default `Auto`). Its numbers may be traced; its structure decides what is compiled.

    A method without a `rank_tol` gets `rank_tolerance`. Without knowledge of which rows are redundant (a mechanism that was built
    from traced numbers) `Auto` takes singular values throughout, and `Elimination` drops what it finds dependent on the way.
    """
    chosen: Any = Auto() if method is None else method
    tol = rank_tolerance(mechanism) if chosen.rank_tol is None else chosen.rank_tol
    chosen = eqx.tree_at(lambda m: m.rank_tol, chosen, tol, is_leaf=lambda x: x is None)
    left_out, elimination, drop = mechanism.left_out or (), None, number(0.0)
    if isinstance(chosen, Elimination):
        if not chosen.relative:
            raise ValueError("Elimination compares each row with what remains of it: here its rank_tol must be relative")
        elimination, drop = "drop", tol**2
    elif isinstance(chosen, Auto) and mechanism.left_out is None:
        chosen = chosen.exact
    elif isinstance(chosen, Auto):
        elimination, drop = "check", chosen.branch_tol
    programs = code(mechanism, left_out if elimination else (), baumgarte is not None, elimination)
    gains = [] if baumgarte is None else [baumgarte.alpha, baumgarte.beta]
    numbers = [*scalars(jax.tree.leaves(mechanism)), *gains, drop]
    constants = [jnp.asarray(c) for c in programs.prologue(numbers)]
    return Equations(constants, chosen, programs)


def rank_tolerance(mechanism: Mechanism) -> Float[Array, ""]:
    """Return `RANK_TOL`, less where masses are far apart.

    Where a light body carries a heavy one the singular values of D = Psi_q M^(-1/2) are as far apart as the roots of the masses,
    in any position: a ratio of 1e8 brings a constraint between them down to 1e-4 of the largest.
    """
    masses = [body.mass for body in mechanism.bodies.values()]
    known = not any(isinstance(mass, Tracer) for mass in masses)
    xp: Any = np if known else jnp  # while something else is traced, jnp would trace what is known, too
    masses = [xp.asarray(mass) for mass in masses]
    ratio = reduce(xp.minimum, masses) / reduce(xp.maximum, masses)
    return jax.lax.stop_gradient(number(RANK_TOL * xp.minimum(1.0, xp.sqrt(ORDINARY * ratio))))


# --- plain


def plain_accelerations(equations: Equations, t: Any, q: Vector, v: Vector) -> Vector:
    """a = a_F + M^(-1/2) D^+ b, on arrays."""

    def solve(plus: Plus, name: str) -> Vector:
        _, b, free, root = equations.arrays(name, t, q, v)
        return free + root * (plus @ b)

    return _by_method(equations, solve, "rows", t, q, v)


def plain_project(equations: Equations, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """Two Newton steps in position and one in velocity."""

    def step(plus: Plus, name: str) -> Vector:
        _, residual, root = equations.arrays(name, t, q, v)
        return -root * (plus @ residual)

    q = q + _by_method(equations, step, "closure", t, q, v)
    q = q + _by_method(equations, step, "closure", t, q, v)
    return q, v + _by_method(equations, step, "rate", t, q, v)


def _plain_correction(equations: Equations, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """One Newton step in position and one in velocity, with one D^+: of a projected state it changes the tangents alone."""

    def step(plus: Plus, name: str) -> tuple[Vector, Vector]:
        _, psi, root = equations.arrays(name, t, q, v)
        closed = q - root * (plus @ psi)
        rate = _stack(equations.run("psi_dot" + name.removeprefix("closure"), t, closed, v))
        return closed, v - root * (plus @ rate)

    return _by_method(equations, step, "closure", t, q, v)


def _by_method(equations: Equations, use: Any, name: str, t: Any, q: Vector, v: Vector) -> Any:
    """Call `use` with D^+ by the equations' method, and the name of the program whose rows it is for."""
    programs, method = equations.code, equations.method
    if not programs.kept:
        return use(_Unconstrained(), name)

    def dense(method: Pseudoinverse) -> Any:
        return use(method.plus(programs.pattern.dense(equations.arrays(name, t, q, v)[0])), name)

    if not isinstance(method, Auto | Elimination):
        return dense(method)
    if equations.branches:
        return dense(equations.exact().method)
    tol: Any = jnp.sqrt(jnp.asarray(method.branch_tol)) if isinstance(method, Auto) else method.rank_tol
    return use(SparseElimination(programs.kept_pattern, tol).plus(equations.arrays(name + "_kept", t, q, v)[0]), name + "_kept")


class _Unconstrained:
    """D^+ of no rows at all."""

    def __matmul__(self, b: Any) -> float:
        return 0.0


def _stack(values: list[Any]) -> Array:
    values = [jnp.asarray(x, jnp.result_type(float)) for x in values]
    return jnp.stack(values) if values else jnp.zeros(0)


# --- fast


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _accelerations(program: str, equations: Equations, t: Any, q: Vector, v: Vector) -> Vector:
    *a, safe = equations.run(program, t, q, v)
    return _checked(equations, safe, _stack(a), plain_accelerations, t, q, v)


@jax.custom_jvp
def _project(equations: Equations, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    return _fast_project(equations, t, q, v) if equations.code.elimination else plain_project(equations, t, q, v)


@_project.defjvp
def _(primals, tangents):
    """Where the residuals vanish the tangents of one Newton step are those of the projection."""
    equations, t, q, v = primals
    q, v = _project(equations, t, q, v)
    return (q, v), jax.jvp(_plain_correction, (equations, t, q, v), tangents)[1]


def _fast_project(equations: Equations, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """As the plain form, but with the factors of the first position kept: they differ by the residual, and so does the result."""
    *factors, safe = equations.run("factor", t, q, v)
    step = equations.code.program("step")

    def without(x: Vector, name: str, q: Vector) -> Vector:
        residual = equations.run(name, t, q, x)
        return x - _stack(step([*equations.constants, *factors, *residual]))

    q1 = without(q, "psi_kept", q)
    q2 = without(q1, "psi_kept", q1)
    return _checked(equations, safe, (q2, without(v, "psi_dot_kept", q2)), plain_project, t, q, v)


_accelerations.defjvp(lambda program, primals, tangents: jax.jvp(plain_accelerations, primals, tangents))


def _checked(equations: Equations, safe: Bool[Array, ""], fast: Any, plain: Any, *state: Any) -> Any:
    """Take what elimination gave where its pivots are safe, or where it drops the others itself; else turn to singular values."""
    if not equations.branches or safe is True:
        return fast
    return jax.lax.cond(safe, lambda: fast, lambda: plain(equations.exact(), *state))
