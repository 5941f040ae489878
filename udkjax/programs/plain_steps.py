"""Operations of JAX as functions of their arrays alone, which take the fewest calls of Python at each evaluation."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from operator import itemgetter, methodcaller
from typing import Any

import numpy as np

from udkjax.programs.numpy_rules import PRESERVED_DTYPES, RULES, UFUNCS


def _plain_broadcast(parameters: Mapping[str, Any], types: Sequence[Any]) -> Callable[..., Any]:
    shape, sizes = parameters["shape"], dict(zip(parameters["broadcast_dimensions"], types[0].shape, strict=True))
    inner = tuple([sizes.get(k, 1) for k in range(len(shape))])
    return methodcaller("reshape", shape) if inner == shape else lambda x: np.broadcast_to(x.reshape(inner), shape)


def _plain_slice(parameters: Mapping[str, Any], _: Sequence[Any]) -> Callable[..., Any]:
    starts = parameters["start_indices"]
    steps = parameters["strides"] or (1,) * len(starts)
    return itemgetter(tuple(map(slice, starts, parameters["limit_indices"], steps)))


def _plain_reshape(_: Mapping[str, Any], types: Sequence[Any]) -> Callable[..., Any]:
    return methodcaller("reshape", types[-1].shape)


def _plain_reduction(function: np.ufunc, of_bools: bool = False) -> Callable[..., Any]:
    def plain(parameters: Mapping[str, Any], types: Sequence[Any]) -> Callable[..., Any] | None:
        (given, _), axes = types, tuple(parameters["axes"])
        if not axes or not given.size or (given.dtype == bool) != of_bools:
            return None
        return partial(function.reduce, axis=axes)

    return plain


# Functions of the arrays alone, made once from the parameters and the types of inputs and outputs, without a call of Python where
# NumPy has a method.
_PLAIN_RULES: dict[str, Callable[[Mapping[str, Any], Sequence[Any]], Callable[..., Any] | None]] = {
    "broadcast_in_dim": _plain_broadcast,
    "slice": _plain_slice,
    "reshape": _plain_reshape,
    "squeeze": _plain_reshape,
    "expand_dims": _plain_reshape,
    "div": lambda _, types: np.divide if types[0].dtype == float else None,
    "select_n": lambda _, types: (lambda p, x, y: np.where(p, y, x)) if types[0].dtype == bool and len(types) == 4 else None,
    "convert_element_type": lambda parameters, _: methodcaller("astype", parameters["new_dtype"]),
    "concatenate": lambda parameters, _: lambda *xs: np.concatenate(xs, parameters["dimension"]),
    "transpose": lambda parameters, _: methodcaller("transpose", parameters["permutation"]),
    "iota": lambda parameters, _: partial(RULES["iota"], **parameters),
    "reduce_sum": _plain_reduction(np.add),
    "reduce_max": _plain_reduction(np.maximum),
    "reduce_min": _plain_reduction(np.minimum),
    "reduce_and": _plain_reduction(np.logical_and, of_bools=True),
    "reduce_or": _plain_reduction(np.logical_or, of_bools=True),
}


MOST_INPUTS = {"broadcast_in_dim": 1, "reshape": 1, "iota": 0}  # others are sizes that are known only at run time


def plain_step(name: str, parameters: Mapping[str, Any], types: Sequence[Any]) -> Callable[..., Any] | None:
    """Return an operation as a function of its NumPy arrays alone, without parameters.

    Args:
        name: the name of the primitive.
        parameters: its parameters.
        types: the types of its inputs, then of its outputs.

    Returns:
        The function, which always succeeds and returns arrays of the right type; None if there is no such function.
    """
    if any(x.dtype not in PRESERVED_DTYPES for x in types) or len(types) > MOST_INPUTS.get(name, len(types) - 1) + 1:
        return None
    if name in _PLAIN_RULES:
        return _PLAIN_RULES[name](parameters, types)
    function = UFUNCS.get(name)
    return function if isinstance(function, np.ufunc) else None
