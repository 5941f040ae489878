"""A user-defined pseudoinverse, written in jax.numpy (`udkjax.pinv.MatrixPseudoinverse`), as machine code."""

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax

from udkjax import pinv
from udkjax.native.code import processor
from udkjax.native.language.ir import DOUBLE
from udkjax.native.language.program import UnsupportedError
from udkjax.native.lowering.arrays import Stored, fit
from udkjax.native.lowering.lowering import LoweredFunction, Lowering
from udkjax.native.lowering.rules import lower
from udkjax.native.pseudoinverses.dense import DenseMatrices, DenseMethod

_TOL = object()  # stands for the rank tolerance, which is a number of the run
_TRIAL = (2, 3)  # the shape of a matrix by which the operations of a method are looked at


class Written(NamedTuple):
    """The function that computes D^+, and how many numbers of memory it takes."""

    function: LoweredFunction
    size: int


@dataclass(frozen=True)
class OwnCode(DenseMethod):
    """D^+ is the matrix `plus`, computed by the lowered text of the method.

    `structure` and `leaves` are the method as a tree, in which the rank tolerance is marked.
    """

    structure: Any
    leaves: tuple[Any, ...]

    @classmethod
    def of(cls, method: pinv.MatrixPseudoinverse) -> "OwnCode":
        """Return the machine code of a method.

        Raises:
            UnsupportedError: the message says which operation has none.
        """
        name = type(method).__name__
        marked = eqx.tree_at(lambda x: x.rank_tol, method, _TOL, is_leaf=lambda x: x is None)
        leaves, structure = jax.tree.flatten(marked)
        if any(eqx.is_array_like(x) and not isinstance(x, bool | int | float) for x in leaves):
            raise UnsupportedError(f"arrays of the pseudoinverse {name}, which has numbers other than rank_tol")
        code = cls(method.relative, structure, tuple(leaves))
        try:
            code.written(*_TRIAL)
        except UnsupportedError as error:
            raise UnsupportedError(f"the operation {error} of the pseudoinverse {name}") from error
        except Exception as error:  # text of a user may raise any error
            raise UnsupportedError(f"the pseudoinverse {name} ({type(error).__name__} while it was traced)") from error
        return code

    def factors(self, D: Any, tol: Any) -> Any:
        """Return D^+ and the rank."""
        method = jax.tree.unflatten(self.structure, [tol if x is _TOL else x for x in self.leaves])
        return tuple(method.factor(D))

    def written(self, m: int, n: int) -> Written:
        """Return the function for one lane; a member alone runs it, its rows of D filling registers."""
        return _written(self, m, n, 1, -(-n // processor.lanes()) * processor.lanes())

    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        size = self.written(m, n).size
        return {"plus": (n, m), "rank": (1, 1), "tol": (1, 1), "scratch": (1, max(size, 1))}

    def factor(self, d: DenseMatrices):
        f = d.f
        written = _written(self, d.m, d.n, f.width, d.row("D").registers * d.vector // f.width)
        f.evaluated |= written.function.evaluated | {written.function.name: written.function}
        d.row("tol").put(0, d.tol)
        # The function stores rows of D^+ without gaps; its padded rows are filled here.
        f.call(written.function.name, *(d.row(x).address for x in ("D", "tol", "scratch", "rank")))
        scratch = d.row("scratch")
        with f.each(d.n) as i:
            row = d.row("plus", i)
            row.clear()
            with f.each(d.m) as j:
                row.put(j, scratch.entry(i * d.m + j))

    def solve(self, d: DenseMatrices):
        x, b = d.row("x"), d.row("b")
        x.clear()
        with d.f.each(d.n) as i:
            x.put(i, d.dot(d.row("plus", i), b))

    def solve_transposed(self, d: DenseMatrices):
        x, b = d.row("x"), d.row("b")
        b.clear()
        with d.f.each(d.n) as i:
            d.axpy(x.entry(i), d.row("plus", i), b)


@lru_cache(maxsize=64)
def _traced(code: OwnCode, m: int, n: int) -> Any:
    """Return the jaxpr of `factors`."""
    return jax.make_jaxpr(code.factors)(jax.ShapeDtypeStruct((m, n), float), jax.ShapeDtypeStruct((), float))


@lru_cache(maxsize=64)
def _written(code: OwnCode, m: int, n: int, width: int, stride: int) -> Written:
    """Write `name(D, tol, scratch, rank)`; D^+ is at the beginning of `scratch`, `stride` is the length of a row of D."""
    f = LoweredFunction("own", ("D", "tol", "scratch", "rank"), width)
    to = Lowering(f, f.given["scratch"], lower)
    plus = to.new((n, m), DOUBLE, True)
    D = Stored(f.given["D"], (m, n), DOUBLE, True, strides=(stride, 1))
    tol = Stored(f.given["tol"], (), DOUBLE, True)
    found, rank = to.closed(_traced(code, m, n), [D, tol])
    if found.shape != (n, m):
        raise ValueError(f"matrix(D) must have the shape {(n, m)}, not {found.shape}")
    to.fill(plus, found)
    f.store(fit(f, rank.read(f, ()), True), f.given["rank"], 0, width)
    f.name = f"own_{hashlib.sha256(f.text().encode()).hexdigest()[:16]}"
    return Written(f, to.size)
