"""The interface of all pseudoinverses, and the derivative rule that they share.

A method defines how to factorize D, how to apply the factors, and its rank threshold. D^+ b, D^+ itself and derivatives of any
order, forward or reverse, follow from these. No factorization is ever differentiated.
"""

from abc import abstractmethod
from functools import partial
from typing import Any, NamedTuple, Protocol, Self, TypeAlias

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from udkjax.annotations import NumberLike, Numbers
from udkjax.argument_types import checks_instances, require_thresholds
from udkjax.arrays import number_called
from udkjax.pinv.linear_primitive import linear_primitive
from udkjax.printing import PrintsLine
from udkjax.programs.varying_axes import result_type

# Accelerators round float32 products to ten bits by default.
dot = partial(jnp.matmul, precision="highest")


Operator: TypeAlias = PyTree[Array]  # a matrix, or a method's representation of one


class Factors(Protocol):
    """The factors of an operator: a pytree of arrays, with the rank that the method decided."""

    @property
    def rank(self) -> Int[Array, ""]: ...


class LeastSquaresSolution(NamedTuple):
    """The minimum-norm least-squares solution of D x = b, and the numerical rank of D."""

    x: Float[Array, "n *k"]
    rank: Int[Array, ""]


number = number_called("a threshold (rank_tol, or branch_tol of Auto)", optional=True)


class Pseudoinverse(PrintsLine):
    """A method to apply the Moore-Penrose pseudoinverse D^+ of an (m, n) operator D, truncated at a numerical rank.

    With `relative=True` a number counts as zero if it is at most `rank_tol` times the method's scale of D (the largest singular
    value, or instead the largest norm of a column or row); with `relative=False` if it is at most `rank_tol`, in the units
    of D. `rank_tol=None` stands for max(m, n) eps, eps the rounding unit of D: right for data that is exact up to rounding.
    (For Greville and elimination it is eps^(1/3).) `rank_tol` is an array leaf: it may be traced and batched; its derivative is
    zero.

    The operator may be any pytree, defined by the seven functions below. Derivatives assume that the rank is constant nearby;
    where it jumps, no derivative exists.

    Args:
        rank_tol: threshold of the rank, relative to the method's scale of D; None: the rounding error.
        relative: whether `rank_tol` is relative to that scale, or in the units of D.
    """

    rank_tol: Float[Array, ""] | None = eqx.field(converter=number, default=None)
    relative: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        if self.rank_tol is None and not self.relative:
            raise ValueError("an absolute rank threshold has no default: give rank_tol, in the units of the matrix")

    @classmethod
    def absolute(cls, rank_tol: NumberLike, **choices: object) -> Self:
        """Return the method with a threshold in the units of D. The paper uses the tolerance of the integration."""
        return cls(rank_tol=rank_tol, relative=False, **choices)

    # The functions of a method. They are linear in b, x, c and y, and written in ordinary jax.numpy.

    @abstractmethod
    def admit(self, D: Operator) -> Operator:
        """Return the operator D as arrays; raise an error that names the method if D is not valid."""

    @abstractmethod
    def shape(self, D: Operator) -> tuple[int, int]:
        """Return the shape (m, n) of the operator D."""

    @abstractmethod
    def matvec(self, D: Operator, x: Float[Array, "n"]) -> Float[Array, "m"]:
        """Return D x, bilinear in D and x."""

    @abstractmethod
    def rmatvec(self, D: Operator, y: Float[Array, "m"]) -> Float[Array, "n"]:
        """Return D^T y, bilinear in D and y."""

    @abstractmethod
    def factor(self, D: Operator) -> Factors:
        """Return the factors for `apply`: a pytree with an integer leaf `.rank`. They are never differentiated."""

    @abstractmethod
    def apply(self, factors: Any, b: Float[Array, "m"]) -> Float[Array, "n"]:
        """Return D^+ b."""

    @abstractmethod
    def apply_transpose(self, factors: Any, c: Float[Array, "n"]) -> Float[Array, "m"]:
        """Return (D^+)^T c."""

    # The functions that all methods share.

    def plus(self, D: Operator) -> "Plus":
        """Return D^+ as an operator, factorized once: `plus @ b`, `plus.T @ x`, `plus.rank`."""
        if np.shape(self.rank_tol):
            raise ValueError(f"rank_tol must be one number, not of the shape {np.shape(self.rank_tol)}; a batch is for jax.vmap")
        D = self.admit(D)
        method = jax.lax.stop_gradient(self)
        return Plus(method, jax.lax.stop_gradient(method.factor(jax.lax.stop_gradient(D))), D)

    def solve(self, D: Operator, b: Float[ArrayLike, "m *k"]) -> LeastSquaresSolution:
        """Return the minimum-norm least-squares solution x = D^+ b, for one b (m,) or columns (m, k), and rank(D)."""
        plus = self.plus(D)
        return LeastSquaresSolution(plus @ jnp.asarray(b), plus.rank)

    def rank(self, D: Operator) -> Int[Array, ""]:
        """Return the numerical rank: the number of directions above the threshold."""
        return self.plus(D).rank

    def __call__(self, D: Operator) -> Float[Array, "n m"]:
        """Return D^+ itself, as a matrix."""
        plus = self.plus(D)
        rows, _ = self.shape(plus.matrix)
        dtype = jnp.result_type(*(leaf for leaf in jtu.tree_leaves(plus.matrix) if eqx.is_inexact_array(leaf)))
        return plus @ jnp.eye(rows, dtype=dtype)


checks_instances(Pseudoinverse)(require_thresholds)


class Dense(Pseudoinverse):
    """A method whose operator is a real matrix."""

    def admit(self, D: Numbers) -> Float[Array, "m n"]:
        D = jnp.asarray(D)
        if D.ndim != 2 or 0 in D.shape:
            name = type(self).__name__
            raise ValueError(f"{name} takes one matrix (m, n) with m, n > 0, not shape {D.shape}; batch it by jax.vmap")
        if jnp.iscomplexobj(D):
            raise TypeError(f"{type(self).__name__} takes a real matrix, not {D.dtype}")
        return D.astype(jnp.result_type(D, jnp.float32) if jnp.issubdtype(D.dtype, jnp.floating) else jnp.result_type(float))

    def shape(self, D: Float[Array, "m n"]) -> tuple[int, int]:
        rows, columns = D.shape
        return rows, columns

    def matvec(self, D: Float[Array, "m n"], x: Float[Array, "n"]) -> Float[Array, "m"]:
        return dot(D, x)

    def rmatvec(self, D: Float[Array, "m n"], y: Float[Array, "m"]) -> Float[Array, "n"]:
        return dot(D.T, y)

    def threshold(self, D: Float[Array, "m n"], scale: Float[Array, ""], default: float | None = None) -> Float[Array, ""]:
        """Return the threshold at or below which a singular value, or its substitute in this method, counts as zero.

        Args:
            D: the matrix.
            scale: the method's scale of D, such as the largest singular value.
            default: the threshold relative to `scale` if `rank_tol` is None; None: max(m, n) eps, the rounding error of a
                factorization.
        """
        if self.rank_tol is None:
            return scale * (max(D.shape) * float(jnp.finfo(D.dtype).eps) if default is None else default)
        tol = self.rank_tol.astype(D.dtype)
        return tol * scale if self.relative else tol


def exceeds(size: Float[Array, "*s"], threshold: Float[Array, ""]) -> Bool[Array, "*s"]:
    """Return True where a size exceeds the threshold, and so counts as nonzero.

    NaN counts as nonzero, too, so that an invalid matrix results in NaN instead of rank zero.
    """
    return ~(size <= threshold)


class Plus(eqx.Module):
    """D^+, or its transpose, as an operator, with the factors of D: `plus @ b` for b (m,) or (m, k)."""

    method: Pseudoinverse
    factors: Factors
    matrix: Operator
    transposed: bool = eqx.field(static=True, default=False)

    @property
    def T(self) -> "Plus":
        return Plus(self.method, self.factors, self.matrix, not self.transposed)

    @property
    def rank(self) -> Int[Array, ""]:
        return self.factors.rank

    def __matmul__(self, b: Float[Array, "m *k"]) -> Float[Array, "n *k"]:
        size = self.method.shape(self.matrix)[1 if self.transposed else 0]
        if b.ndim not in (1, 2) or b.shape[0] != size:
            raise ValueError(f"D^+{'^T' if self.transposed else ''} applies to ({size},) or ({size}, k), not to shape {b.shape}")
        dtypes = [leaf.dtype for leaf in jtu.tree_leaves(self.matrix) if eqx.is_inexact_array(leaf)]
        b = b.astype(jnp.result_type(b, *dtypes))
        if b.ndim == 2:
            return jax.vmap(partial(_bind, self), in_axes=1, out_axes=1)(b)
        return _bind(self, b)


# The derivative, for x = D^+ b at constant rank. Write ' for a tangent. Differentiating the four Penrose conditions gives
# (Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413, theorem 4.3, and Stewart, SIAM Review 19 (1977) 634)
#
#     (D^+)' = -D^+ D' D^+ + D^+ D^+^T D'^T (I - D D^+) + (I - D^+ D) D'^T D^+^T D^+
#
# The first term is the derivative of an inverse. D^+ maps onto the row space of D, which rotates when D changes (third term), and
# ignores vectors orthogonal to the column space, which rotates as well (second term). With y = D^+^T x, r = b - D x, w = D'^T y:
#
#     x' = D^+ b' + (D^+)' b = w + D^+ (b' - D' x - D w + D^+^T D'^T r)
#
# Only D^+ and its transpose are applied, by the existing factors; there is no division by differences of singular values. Since
# (D^+)^T = (D^T)^+, the same rule holds for the transpose, with D and D^T exchanged. And D^+ b is linear in b with the
# transpose D^+^T, which is all that reverse mode needs. Both rules apply D^+, and so are themselves differentiable, to any
# order. This is a primitive because a jax.custom_jvp is lost in the linear part of a reverse pass, whose second derivative
# would then go through the factorization.


def _apply(plus: Plus, b):
    apply = plus.method.apply_transpose if plus.transposed else plus.method.apply
    return apply(plus.factors, b)


@eqxi.filter_primitive_def
def _shape_of_apply(plus, b):
    structs = jtu.tree_map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), (plus, b))
    out = jax.eval_shape(_apply, *structs)
    return result_type(out.shape, jax.tree.leaves((plus, b)), out.dtype)


@eqxi.filter_primitive_jvp
def _derivative(primals, tangents):
    plus, b = primals
    d_plus, db = tangents
    dD = d_plus.matrix  # the factors, functions of D, need no tangents
    x = _bind(plus, b)
    s = jnp.zeros_like(b) if db is None else db
    if not jtu.tree_leaves(dD):
        return x, _bind(plus, s)

    forward, backward = plus.method.matvec, plus.method.rmatvec
    if plus.transposed:
        forward, backward = backward, forward

    def value_and_change(product, v):
        return eqx.filter_jvp(lambda D: product(D, v), (plus.matrix,), (dD,))

    Dx, dD_x = value_and_change(forward, x)
    w = value_and_change(backward, _bind(plus.T, x))[1]
    g = value_and_change(backward, b - Dx)[1]
    return x, w + _bind(plus, s - dD_x - forward(plus.matrix, w) + _bind(plus.T, g))


@eqxi.filter_primitive_transpose(materialise_zeros=True)  # pyright: ignore
def _transpose(inputs, cotangent):
    plus, _ = inputs
    return jtu.tree_map(lambda _: None, plus), _bind(plus.T, cotangent)


_apply_p = linear_primitive("pseudoinverse", _apply, _shape_of_apply, _derivative, _transpose)


def _bind(plus: Plus, b: Float[Array, "m"]) -> Float[Array, "n"]:
    return eqxi.filter_primitive_bind(_apply_p, plus, b)
