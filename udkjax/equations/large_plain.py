"""The plain form of large scenes: the equation as it stands, on arrays of blocks, for any way to D^+."""

from typing import TYPE_CHECKING, Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from udkjax.equations.layout import Selection
from udkjax.equations.motion import NEAR, Tangential, Vector
from udkjax.pinv.block_methods import BlockElimination, DenseParts, factorized
from udkjax.pinv.blocks import flat

if TYPE_CHECKING:
    from udkjax.equations.large import LargeEquations


def plain_accelerations(equations: "LargeEquations", t: Any, q: Vector, v: Vector) -> Vector:
    """a = a_F + M^(-1/2) D^+ b."""
    free, root = equations.free(t, q, v), flat(equations.numbers["root"])

    def solve(plus: Any, rows: Selection) -> Vector:
        b = equations.arrays(rows, ["b"], t, q, v, free)[0]
        return flat(free) + root * (plus @ flat(b))

    return by_method(equations, solve, t, q, v)


def plain_project(equations: "LargeEquations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """Two Newton steps in position and one in velocity."""
    root = flat(equations.numbers["root"])

    def step(name: str, q: Vector) -> Vector:
        def solve(plus: Any, rows: Selection) -> Vector:
            return -root * (plus @ flat(equations.arrays(rows, [name], t, q, v)[0]))

        return by_method(equations, solve, t, q, v)

    q = q + step("psi", q)
    q = q + step("psi", q)
    return q, v + step("psi_dot", q)


def plain_correction(equations: "LargeEquations", t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """One Newton step in position and one in velocity, with one D^+: of a projected state it changes the tangents alone."""
    root = flat(equations.numbers["root"])

    def step(plus: Any, rows: Selection) -> tuple[Vector, Vector]:
        psi = equations.arrays(rows, ["psi"], t, q, v)[0]
        closed = q - root * (plus @ flat(psi))
        rate = equations.arrays(rows, ["psi_dot"], t, closed, v)[0]
        return closed, v - root * (plus @ flat(rate))

    return by_method(equations, step, t, q, v)


def plain_tangential(equations: "LargeEquations", t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector) -> Tangential:
    """(I - M^(-1/2) D^+ D M^(1/2)) of two vectors."""
    if not len(equations.layout.kept.rows):
        return Tangential(dq, dv)
    root = flat(equations.numbers["root"])

    def left(plus: Any, rows: Selection) -> Tangential:
        by_levels = isinstance(plus.method, BlockElimination)
        first, second = (x - root * (plus @ plus.method.matvec(plus.matrix, x / root)) for x in (dq, dv))
        far = factorized(rows.pattern, plus.matrix, NEAR**2)[1] if by_levels else jnp.array(True)
        return Tangential(first, second, jnp.where(far, jnp.inf, 0.0))

    return by_method(equations, left, t, q, v)


def by_method(equations: "LargeEquations", use: Any, t: Any, q: Vector, v: Vector) -> Any:
    """Call `use` with D^+ by the equations' method, and the rows that it is of."""
    layout = equations.layout
    if not len(layout.kept.rows):
        return use(_Unconstrained(), layout.kept)
    if not equations.by_levels:
        if equations.loop is not None:
            equations.loop.holds(False)  # it may ask LAPACK
        D = equations.arrays(layout.all, ["D"], t, q, v)[0]
        return use(DenseParts(layout.all.pattern, equations.method).plus(D), layout.all)
    plus = equations.elimination.plus(equations.arrays(layout.kept, ["D"], t, q, v)[0])
    if not equations.branches:
        return use(plus, layout.kept)
    return branch(plus.rank > 0, lambda: use(plus, layout.kept), lambda: by_method(equations.dense_form, use, t, q, v))


class _Unconstrained:
    """D^+ of no rows at all."""

    def __matmul__(self, b: Any) -> float:
        return 0.0


def branch(safe: Bool[Array, ""], fast: Any, fallback: Any) -> Any:
    """One of two results; under vmap, `fallback` is taken for all as soon as one is in need of it."""
    where = lambda a, b: jnp.where(safe, a, b)  # noqa: E731
    return jax.lax.cond(eqxi.unvmap_all(safe), fast, lambda: jax.tree.map(where, fast(), fallback()))
