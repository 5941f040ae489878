"""A user-defined pseudoinverse, written in jax.numpy (`udkjax.pinv.MatrixPseudoinverse`), as machine code."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np

from udkjax import pinv
from udkjax.native.code import processor
from udkjax.native.language.program import UnsupportedError
from udkjax.native.lowering.own_objects import Input, OwnObject, Written, named, written
from udkjax.native.pseudoinverses.dense import DenseMatrices, DenseMethod

_TRIAL_SHAPE = (2, 3)  # the shape of a matrix by which the operations of a method are looked at


@dataclass(frozen=True)
class OwnCode(DenseMethod):
    """A user-defined method, lowered to machine code, which computes D^+ as the matrix `plus`.

    The only number among the fields of the method is the rank tolerance.
    """

    own: OwnObject

    @classmethod
    def of(cls, method: pinv.MatrixPseudoinverse) -> "OwnCode":
        """Return the machine code of a method.

        Raises:
            UnsupportedError: the method uses an operation without machine code, or arrays other than the rank tolerance.
        """
        marked = eqx.tree_at(lambda x: x.rank_tol, method, np.float64(0.0), is_leaf=lambda x: x is None)
        with named("pseudoinverse", method):
            code = cls(method.relative, OwnObject.of(marked))
            if len(code.own.sizes) > 1:
                raise UnsupportedError("arrays other than rank_tol")
            code.written(*_TRIAL_SHAPE)
        return code

    def evaluate(self, D: Any, tol: Any) -> Any:
        """Return D^+ (n, m) and the rank, from D (m, n) and the rank tolerance, by the user's code."""
        plus, rank = self.own.filled(tol).factor(D)
        if plus.shape != D.shape[::-1]:
            raise ValueError(f"matrix(D) must have the shape {D.shape[::-1]}, not {plus.shape}")
        return plus, rank

    def written(self, m: int, n: int, width: int = 1, stride: int | None = None) -> Written:
        """Return the lowered function `evaluate` for D (m, n) in `width` lanes.

        `stride`: the distance between the beginnings of two rows of D, in numbers; None: that of a single member.
        """
        stride = -(-n // processor.lanes()) * processor.lanes() if stride is None else stride
        return written(self, (Input("D", (m, n), stride), Input("tol", (1,))), width)

    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        return {"plus": (n, m), "rank": (1, 1), "tol": (1, 1), "scratch": (1, self.written(m, n).size)}

    def factor(self, d: DenseMatrices):
        f, scratch = d.f, d.row("scratch")
        d.row("tol").put(0, d.tol)
        found = self.written(d.m, d.n, f.width, d.row("D").registers * d.vector // f.width)
        function = found.within(d.columns("scratch"))
        function.call_in(f, d.row("D").address, d.row("tol").address, scratch.address)
        with f.each(d.n) as i:  # the function stores rows of D^+ without gaps; padded rows are filled here
            row = d.row("plus", i)
            row.clear()
            with f.each(d.m) as j:
                row.put(j, scratch.entry(i * d.m + j))
        d.row("rank").put(0, scratch.entry(d.n * d.m))

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
