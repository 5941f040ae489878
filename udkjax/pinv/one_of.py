"""D^+ by one of several methods, chosen by its index."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from udkjax.annotations import NumberLike
from udkjax.pinv.gram_schmidt import GramSchmidt
from udkjax.pinv.greville import Greville
from udkjax.pinv.householder import Householder
from udkjax.pinv.rule import Dense, number
from udkjax.pinv.svd import SVD
from udkjax.pinv.varga import Varga


class OneOfFactors(NamedTuple):
    """The factors of each method: those of the chosen method, and zeros for the others."""

    of_each: tuple[Any, ...]

    @property
    def rank(self) -> Int[Array, ""]:
        return sum((factors.rank for factors in self.of_each), jnp.array(0))


def _number(value: NumberLike) -> Float[Array, ""]:
    """Convert a number to an array leaf; None is an error."""
    array = number(value)
    if array is None:
        raise TypeError("number must be one number, not None")
    return array


class OneOf(Dense):
    """One of several methods, chosen by an index that may be traced and batched: one compiled program serves all of them.

    All share one threshold. In machine code the members of a batch may use different methods, and a method that no member has
    chosen is not executed. In a program without machine code, `vmap` over the index executes all methods.

    Args:
        methods: the methods, each with `rank_tol=None`; by default the five methods of the paper.
        number: index of the method, from zero; a traced index out of range is clipped to the first or the last.
    """

    methods: tuple[Dense, ...] = eqx.field(converter=tuple, default=(SVD(), Varga(), Greville(), Householder(), GramSchmidt()))
    number: Float[Array, ""] = eqx.field(converter=_number, default=0.0)

    def __check_init__(self):
        of_kind = [isinstance(method, Dense) and not isinstance(method, OneOf) for method in self.methods]
        if not all(of_kind) or not of_kind or any(method.rank_tol is not None for method in self.methods):
            raise ValueError("methods must be pseudoinverses without a rank_tol: one threshold, of OneOf itself, serves them all")
        if not isinstance(self.number, Tracer):
            numbers = np.asarray(self.number)
            if not np.all((numbers >= 0) & (numbers < len(self.methods))):
                raise ValueError(f"number must be from 0 to {len(self.methods) - 1}, one for each of the methods, not {numbers}")

    @property
    def choices(self) -> tuple[Dense, ...]:
        """The methods, each with the `rank_tol` and `relative` of this object."""
        return tuple(replace(method, rank_tol=self.rank_tol, relative=self.relative) for method in self.methods)

    def factor(self, D: Float[Array, "m n"]) -> OneOfFactors:
        choices = self.choices
        shapes = jax.eval_shape(lambda D: tuple(method.factor(D) for method in choices), D)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

        def factor(k: int, D: Float[Array, "m n"]) -> OneOfFactors:
            return OneOfFactors((*zeros[:k], choices[k].factor(D), *zeros[k + 1 :]))

        return self._switch([lambda D, k=k: factor(k, D) for k in range(len(choices))], D)

    def apply(self, factors: OneOfFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        choices = zip(self.choices, factors.of_each, strict=True)
        return self._switch([lambda b, m=method, f=factors_of_method: m.apply(f, b) for method, factors_of_method in choices], b)

    def apply_transpose(self, factors: OneOfFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        choices = zip(self.choices, factors.of_each, strict=True)
        return self._switch(
            [lambda c, m=method, f=factors_of_method: m.apply_transpose(f, c) for method, factors_of_method in choices], c
        )

    def _switch(self, branches: Sequence[Any], x: Array) -> Any:
        return jax.lax.switch(self.number.astype(int), branches, x)
