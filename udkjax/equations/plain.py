"""The plain form: the equation as it stands, on arrays, for any pseudoinverse. It differentiates to any order."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from udkjax.equations.code import stacked
from udkjax.equations.motion import Tangential, Vector
from udkjax.pinv import SVD, Auto, Elimination, Plus, Pseudoinverse, SparseElimination

if TYPE_CHECKING:
    from udkjax.equations.programs import Equations


def plain_accelerations(equations: "Equations", t: Any, q: Vector, v: Vector) -> Vector:
    """a = a_F + M^(-1/2) D^+ b, on arrays."""

    def solve(plus: Plus, name: str) -> Vector:
        _, b, free, root = equations.arrays(name, t, q, v)
        return free + root * (plus @ b)

    return _by_method(equations, solve, "rows", t, q, v)


def plain_project(equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """Two Newton steps in position and one in velocity: rounds of one loop, so that the method is compiled once."""

    def step(state: tuple[Vector, Vector], in_position: Array) -> tuple[tuple[Vector, Vector], None]:
        q, v = state

        def change(plus: Plus, name: str) -> Vector:
            _, psi, root = equations.arrays(name, t, q, v)
            psi_dot = stacked(equations.run("psi_dot" + name.removeprefix("closure"), t, q, v))
            return -root * (plus @ jnp.where(in_position, psi, psi_dot))

        found = _by_method(equations, change, "closure", t, q, v)
        return (jnp.where(in_position, q + found, q), jnp.where(in_position, v, v + found)), None

    return jax.lax.scan(step, (q, v), jnp.array([True, True, False]))[0]


def plain_correction(equations: "Equations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """One Newton step in position and one in velocity, with one D^+: of a projected state it changes the tangents alone."""

    def step(plus: Plus, name: str) -> tuple[Vector, Vector]:
        _, psi, root = equations.arrays(name, t, q, v)
        closed = q - root * (plus @ psi)
        rate = stacked(equations.run("psi_dot" + name.removeprefix("closure"), t, closed, v))
        return closed, v - root * (plus @ rate)

    return _by_method(equations, step, "closure", t, q, v)


def plain_tangential(equations: "Equations", t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector) -> Tangential:
    """(I - M^(-1/2) D^+ D M^(1/2)) of two vectors."""
    if not equations.code.kept:
        return Tangential(dq, dv)

    def left(plus: Plus, name: str) -> Tangential:
        root = equations.arrays(name, t, q, v)[-1]
        return Tangential(*(x - root * (plus @ plus.method.matvec(plus.matrix, x / root)) for x in (dq, dv)))

    return _by_method(equations, left, "closure", t, q, v)


def _by_method(equations: "Equations", use: Any, name: str, t: Any, q: Vector, v: Vector) -> Any:
    """Call `use` with D^+ by the equations' method, and the name of the program whose rows it is for."""
    programs, method = equations.code, equations.method
    if equations.loop is not None:
        equations.loop.holds(False)  # it may ask LAPACK
    if not programs.kept:
        return use(_Unconstrained(), name)

    def dense(method: Pseudoinverse) -> Any:
        return use(method.plus(programs.pattern.dense(equations.arrays(name, t, q, v)[0])), name)

    if not isinstance(method, Auto | Elimination):
        return dense(method)
    if equations.branches:
        return dense(equations.by(SVD).method)
    tol: Any = jnp.sqrt(jnp.asarray(method.branch_tol)) if isinstance(method, Auto) else method.rank_tol
    return use(SparseElimination(programs.kept_pattern, tol).plus(equations.arrays(name + "_kept", t, q, v)[0]), name + "_kept")


class _Unconstrained:
    """D^+ of no rows at all."""

    def __matmul__(self, b: Any) -> float:
        return 0.0
