"""D^+ of rows that come in blocks (blocks.py): by elimination level by level, or by a dense method part by part."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from udkjax.pinv.blocks import BlockPattern, by_block, flat
from udkjax.pinv.places import take
from udkjax.pinv.rule import Pseudoinverse, number
from udkjax.straightline import Loop


class Blockwise(Pseudoinverse):
    """A method on rows in blocks: the operator is `columns`, as in blocks.py; b and x are flat.

    b has the rows of all blocks one after another, padding included, and x is (width count).
    """

    pattern: Any = eqx.field(static=True, default=None)

    def admit(self, D: Any) -> Any:
        return jnp.asarray(D)

    def shape(self, D: Any) -> tuple[int, int]:
        return self.pattern.rows * self.pattern.blocks, self.pattern.width * self.pattern.count

    def matvec(self, D, x):
        return flat(self.pattern.matvec(D, by_block(x, self.pattern.width)))

    def rmatvec(self, D, y):
        return flat(self.pattern.rmatvec(D, by_block(y, self.pattern.rows)))


class BlockFactors(NamedTuple):
    """D, and the factors of D D^T."""

    D: Float[Array, "r c s"]
    factors: Any
    rank: Int[Array, ""]


class Leveled(NamedTuple):
    """Factors by levels, and not by code written out."""

    factors: Any


class BlockElimination(Blockwise):
    """Elimination of independent rows that come in blocks: operator, b and x as in `Blockwise`.

    A pivot is safe if it exceeds `rank_tol`^2 times its row's diagonal entry of D D^T: what remains of the row is longer than
    `rank_tol` of it. Rows that are not independent have no place here: the rank is then counted as zero. `damping` d makes the
    diagonal of D D^T 1 + d times as large.
    """

    damping: Float[Array, ""] | None = None
    loop: Loop | None = eqx.field(static=True, default=None)  # in which it is used

    def __init__(
        self,
        pattern: BlockPattern,
        rank_tol: ArrayLike = 1e-8,
        damping: ArrayLike | None = None,
        loop: Loop | None = None,
    ):
        self.rank_tol, self.relative, self.damping = number(rank_tol), True, number(damping)
        self.pattern, self.loop = pattern, loop

    def factor(self, D: Float[Array, "r c s"]) -> BlockFactors:
        factors, safe = factorized(self.pattern, D, jnp.asarray(self.rank_tol) ** 2, self.damping, self.loop)
        return BlockFactors(D, factors, jnp.where(safe, self.pattern.sizes.sum(), 0))

    def apply(self, factors: BlockFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return self.rmatvec(factors.D, self._square(factors, b))

    def apply_transpose(self, factors: BlockFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return self._square(factors, self.matvec(factors.D, c))

    def _square(self, factors: BlockFactors, b: Float[Array, "m"]) -> Float[Array, "m"]:
        return flat(solved(self.pattern, factors.factors, by_block(b, self.pattern.rows), self.loop))


def factorized(
    pattern: BlockPattern, D: Float[Array, "r c s"], drop: Any, damping: Any = None, loop: Loop | None = None
) -> tuple[Any, Bool[Array, ""]]:
    """Factorize D D^T; return what `solved` takes, and whether every pivot exceeds `drop` times its row's diagonal.

    In a loop that XLA compiles into one function by code written out, where there is any.
    """
    if damping is None and loop is not None and loop.fuses and pattern.written_out is not None:
        return pattern.written_out.factor(D, drop, loop)
    diagonal, coupling = (pattern.copies or pattern).gram(D)
    if damping is not None:  # of the rows themselves, not of welds
        squares = jnp.sum(D**2, 1).reshape(pattern.rows, pattern.deep, pattern.blocks).sum(1).T
        row = np.arange(pattern.rows)
        diagonal = diagonal.at[: pattern.blocks, row, row].add(damping * squares)
    factors, safe = pattern.levels.factor(diagonal, coupling, drop)
    return Leveled(factors), safe


def solved(
    pattern: BlockPattern, factors: Any, r: Float[Array, "r blocks"], loop: Loop | None = None
) -> Float[Array, "r blocks"]:
    """Return y with D D^T y = r, by factors from `factorized`."""
    if isinstance(factors, Leveled):
        return pattern.levels.solve(factors.factors, r.T).T
    assert pattern.written_out is not None
    return pattern.written_out.solve(factors, r, loop)


class PartFactors(NamedTuple):
    """D, and what the method made of the parts of each shape."""

    D: Float[Array, "r c s"]
    factors: list[Any]
    rank: Int[Array, ""]


class DenseParts(Blockwise):
    """A dense method applied to each connected part of rows that come in blocks: operator, b and x as in
    `Blockwise`.

    Parts that do not touch make D block diagonal, and D^+ too: n parts cost n times one of them, and the rank of each is
    decided by its own largest singular value.
    """

    method: Any = None

    def __init__(self, pattern: BlockPattern, method: Any):
        self.rank_tol, self.relative, self.method, self.pattern = method.rank_tol, method.relative, method, pattern

    def factor(self, D: Float[Array, "r c s"]) -> PartFactors:
        factors = [jax.vmap(self.method.factor)(part.matrices(D)) for part in self.pattern.parts]
        return PartFactors(D, factors, sum((f.rank.sum() for f in factors), jnp.array(0)))

    def apply(self, factors: PartFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        x = jnp.zeros(self.shape(factors.D)[1], b.dtype)
        for part, found in zip(self.pattern.parts, factors.factors, strict=True):
            x = x.at[part.columns].set(jax.vmap(self.method.apply)(found, take(b, part.rows)))
        return x

    def apply_transpose(self, factors: PartFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        y = jnp.zeros(self.shape(factors.D)[0], c.dtype)
        for part, found in zip(self.pattern.parts, factors.factors, strict=True):
            y = y.at[part.rows].set(jax.vmap(self.method.apply_transpose)(found, take(c, part.columns)))
        return y
