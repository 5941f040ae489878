"""NumPy rules for JAX primitives: functions of arrays and of the primitive's parameters, which return the result.

If a rule returns `NotImplemented`, JAX evaluates the operation.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jax import lax

from udkjax.programs.numpy_indexing import dynamic_slice, dynamic_update_slice, gather, scatter

Rule = Callable[..., Any]
PRESERVED_DTYPES = (np.dtype(float), np.dtype(int), np.dtype(bool))  # dtypes that every NumPy operation preserves


def _put(x: np.ndarray, places: Any, updates: np.ndarray) -> None:
    x[places] = updates


def _divide(x: Any, y: Any) -> Any:
    return np.divide(x, y) if _is_inexact(x) else np.trunc(np.divide(x, np.where(y == 0, 1, y))).astype(np.asarray(x).dtype)


def _is_inexact(x: Any) -> bool:
    return np.issubdtype(np.asarray(x).dtype, np.inexact)


def _total_less(x: Any, y: Any) -> Any:
    """Return x < y in the total order in which NaN is largest and -0 is less than 0."""
    if not _is_inexact(x):
        return np.less(x, y)
    zero = (x == y) & np.signbit(x) & ~np.signbit(y)
    return (x < y) | (~np.isnan(x) & np.isnan(y)) | zero


def _broadcast(x: Any, shape: Sequence[int], broadcast_dimensions: Sequence[int], **_: Any) -> np.ndarray:
    sizes = dict(zip(broadcast_dimensions, np.shape(x), strict=True))
    return np.broadcast_to(np.reshape(x, [sizes.get(k, 1) for k in range(len(shape))]), shape)


def _select(which: Any, *cases: Any) -> Any:
    if len(cases) == 1:
        return cases[0]
    return np.where(which, cases[1], cases[0]) if np.asarray(which).dtype == bool else np.choose(which, cases)


def _convert(x: Any, new_dtype: Any, **_: Any) -> np.ndarray:
    return np.asarray(x).astype(new_dtype)


def _slice(
    x: np.ndarray, start_indices: Sequence[int], limit_indices: Sequence[int], strides: Sequence[int] | None
) -> np.ndarray:
    steps = strides or (1,) * len(start_indices)
    return x[tuple(map(slice, start_indices, limit_indices, steps))]


def _pad(x: np.ndarray, value: Any, padding_config: Sequence[tuple[int, int, int]]) -> np.ndarray:
    sizes = [n + max(n - 1, 0) * inner for n, (_, _, inner) in zip(np.shape(x), padding_config, strict=True)]
    result = np.full(
        [low + n + high for n, (low, high, _) in zip(sizes, padding_config, strict=True)], value, np.asarray(x).dtype
    )
    target, source = [], []
    for n, (low, _, inner), size in zip(np.shape(x), padding_config, result.shape, strict=True):
        places = low + np.arange(n) * (1 + inner)
        inside = (places >= 0) & (places < size)
        target.append(places[inside])
        source.append(np.flatnonzero(inside))
    result[np.ix_(*target)] = np.asarray(x)[np.ix_(*source)]
    return result


def _iota(*_: Any, dtype: Any, shape: Sequence[int], dimension: int, **__: Any) -> np.ndarray:
    numbers = np.arange(shape[dimension], dtype=dtype).reshape([-1 if k == dimension else 1 for k in range(len(shape))])
    return np.broadcast_to(numbers, shape)


def _reduce(function: Callable[..., Any]) -> Rule:
    return lambda x, axes, **_: function(x, axis=tuple(axes)) if axes else x


def _extremum(function: Callable[..., Any]) -> Rule:
    def rule(x: Any, axes: Sequence[int], **_: Any) -> Any:
        if not np.size(x):  # XLA returns an infinity
            return NotImplemented
        return function(x, axis=tuple(axes)) if axes else x

    return rule


def _argument(function: Callable[..., Any]) -> Rule:
    return lambda x, axes, index_dtype: function(x, axis=axes[0]).astype(index_dtype)


def _cumulate(function: np.ufunc) -> Rule:
    def rule(x: np.ndarray, axis: int, reverse: bool) -> np.ndarray:
        return np.flip(function.accumulate(np.flip(x, axis), axis), axis) if reverse else function.accumulate(x, axis)

    return rule


def _split(x: np.ndarray, sizes: Sequence[int], axis: int) -> list[np.ndarray]:
    return np.split(x, np.cumsum(sizes)[:-1], axis)


def _unstack(x: np.ndarray, axis: int) -> list[np.ndarray]:
    return list(np.moveaxis(x, axis, 0))


def _sort(*arrays: np.ndarray, dimension: int, num_keys: int, **_: Any) -> list[np.ndarray]:
    order = np.lexsort(arrays[num_keys - 1 :: -1] if num_keys > 1 else (arrays[0],), axis=dimension)
    return [np.take_along_axis(x, order, dimension) for x in arrays]


def _dot(x: Any, y: Any, dimension_numbers: Any, **_: Any) -> np.ndarray:
    (in_x, in_y), (batch_x, batch_y) = dimension_numbers
    x, y = np.asarray(x), np.asarray(y)
    free_x = [k for k in range(x.ndim) if k not in (*in_x, *batch_x)]
    free_y = [k for k in range(y.ndim) if k not in (*in_y, *batch_y)]
    batch, rows, columns = ([z.shape[k] for k in which] for z, which in ((x, batch_x), (x, free_x), (y, free_y)))
    inner = int(np.prod([x.shape[k] for k in in_x], dtype=int))
    left = x.transpose(*batch_x, *free_x, *in_x).reshape(*batch, -1 if inner else int(np.prod(rows, dtype=int)), inner)
    right = y.transpose(*batch_y, *in_y, *free_y).reshape(*batch, inner, -1 if inner else int(np.prod(columns, dtype=int)))
    return np.reshape(left @ right, (*batch, *rows, *columns))


def _svd(x: np.ndarray, full_matrices: bool, compute_uv: bool, **_: Any) -> Any:
    if 0 in x.shape:
        return NotImplemented
    finite = np.isfinite(x).all((-2, -1), keepdims=True)
    of_finite = np.where(finite, x, 0.0)
    if not compute_uv:
        return [np.where(finite[..., 0], np.linalg.svd(of_finite, compute_uv=False), np.nan)]
    u, s, vt = np.linalg.svd(of_finite, full_matrices)
    return [np.where(finite[..., 0], s, np.nan), np.where(finite, u, np.nan), np.where(finite, vt, np.nan)]


def _lu(x: np.ndarray) -> Any:
    if x.ndim > 2:
        return NotImplemented
    x, rows, pivots = np.array(x), np.arange(len(x), dtype=np.int32), []
    for k in range(min(x.shape)):
        p = k + int(np.argmax(np.abs(x[k:, k])))
        pivots.append(p)
        x[[k, p]], rows[[k, p]] = x[[p, k]], rows[[p, k]]
        if x[k, k] != 0:
            x[k + 1 :, k] /= x[k, k]
        x[k + 1 :, k + 1 :] -= np.outer(x[k + 1 :, k], x[k, k + 1 :])
    return [x, np.array(pivots, np.int32), rows]


def _triangular_solve(
    a: np.ndarray, b: np.ndarray, left_side: bool, lower: bool, transpose_a: bool, unit_diagonal: bool, **_: Any
) -> Any:
    a = np.tril(a) if lower else np.triu(a)
    if unit_diagonal:
        a = a * (1 - np.eye(a.shape[-1])) + np.eye(a.shape[-1])
    if not np.all(np.diagonal(a, axis1=-2, axis2=-1)):
        return NotImplemented  # NumPy raises an error for a singular matrix, and JAX returns infinite numbers
    a = np.swapaxes(a, -1, -2) if transpose_a else a
    if left_side:
        return np.linalg.solve(a, b)
    return np.swapaxes(np.linalg.solve(np.swapaxes(a, -1, -2), np.swapaxes(b, -1, -2)), -1, -2)


def _round(x: Any, rounding_method: Any) -> Any:
    if rounding_method == lax.RoundingMethod.TO_NEAREST_EVEN:
        return np.rint(x)
    return np.copysign(np.floor(np.abs(x)) + (np.abs(x) - np.floor(np.abs(x)) >= 0.5), x)


def _element_by_element(function: Callable[[float], float]) -> Callable[[Any], np.ndarray]:
    return np.vectorize(function, otypes=[float])


def _ufunc(function: Callable[..., Any]) -> Rule:
    return lambda *xs, **_: function(*xs)


UFUNCS = {
    "add": np.add,
    "add_any": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "neg": np.negative,
    "max": np.maximum,
    "min": np.minimum,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "sqrt": np.sqrt,
    "square": np.square,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "cbrt": np.cbrt,
    "exp": np.exp,
    "exp2": np.exp2,
    "expm1": np.expm1,
    "log": np.log,
    "log1p": np.log1p,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "log2": np.log2,
    "logistic": lambda x: 1 / (1 + np.exp(-x)),
    "erf": _element_by_element(math.erf),
    "erfc": _element_by_element(math.erfc),
    "one_minus_square": lambda x: (1 - x) * (1 + x),
    "shift_left": np.left_shift,
    "shift_right_arithmetic": np.right_shift,
    "pow": np.power,
    "nextafter": np.nextafter,
    "rem": np.fmod,
    "div": _divide,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "lt_to": _total_less,
    "le_to": lambda x, y: ~_total_less(y, x),
    "is_finite": np.isfinite,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "stop_gradient": lambda x: x,
    "copy": lambda x: x,
    "copy_p": lambda x: x,
    "real": np.real,
}
RULES: dict[str, Rule] = {name: _ufunc(function) for name, function in UFUNCS.items()} | {
    "is_evaluated": lambda: np.True_,
    "integer_pow": lambda x, y: np.power(x, y) if y != 2 else x * x,
    "round": _round,
    "select_n": _select,
    "broadcast_in_dim": _broadcast,
    "convert_element_type": _convert,
    "reshape": lambda x, new_sizes, **_: np.reshape(x, new_sizes),
    "squeeze": lambda x, dimensions: np.squeeze(x, tuple(dimensions)),
    "expand_dims": lambda x, dimensions: np.expand_dims(x, tuple(dimensions)),
    "transpose": lambda x, permutation: np.transpose(x, permutation),
    "rev": lambda x, dimensions: np.flip(x, tuple(dimensions)),
    "concatenate": lambda *xs, dimension: np.concatenate(xs, dimension),
    "stack": lambda *xs, axis: np.stack(xs, axis),
    "unstack": _unstack,
    "split": _split,
    "tile": lambda x, reps: np.tile(x, reps),
    "pad": _pad,
    "iota": _iota,
    "slice": _slice,
    "dynamic_slice": dynamic_slice,
    "dynamic_update_slice": dynamic_update_slice,
    "gather": gather,
    "scatter": scatter(_put),
    "scatter-add": scatter(np.add.at),
    "reduce_sum": _reduce(np.sum),
    "reduce_prod": _reduce(np.prod),
    "reduce_max": _extremum(np.max),
    "reduce_min": _extremum(np.min),
    "reduce_or": _reduce(np.any),
    "reduce_and": _reduce(np.all),
    "argmax": _argument(np.argmax),
    "argmin": _argument(np.argmin),
    "cumsum": _cumulate(np.add),
    "cumprod": _cumulate(np.multiply),
    "cummax": _cumulate(np.maximum),
    "cummin": _cumulate(np.minimum),
    "sort": _sort,
    "dot_general": _dot,
    "svd": _svd,
    "lu": _lu,
    "triangular_solve": _triangular_solve,
    "empty2": lambda dtype, **_: np.zeros((), dtype),
}


# Rules whose results equal those of JAX bit by bit: they move elements, compare, or compute with integers.
_EXACT_RULES = frozenset(
    """eq ne lt le gt ge and or xor not add sub mul neg iota broadcast_in_dim reshape squeeze expand_dims transpose rev slice pad
    tile concatenate convert_element_type""".split()
)
_OF_INTEGERS = frozenset(("add", "sub", "mul", "neg"))


def exact_rule(name: str) -> Rule | None:
    """Return a rule of a primitive whose results equal those of JAX bit by bit; None if there is no such rule.

    For arguments for which this is not certain, the rule returns `NotImplemented`.
    """
    if name not in _EXACT_RULES:
        return None
    rule = RULES[name]

    def exact(*inputs: np.ndarray, **parameters: Any) -> Any:
        of_floats = any(map(_is_inexact, inputs))
        if of_floats and (name in _OF_INTEGERS or _makes_integers(parameters)):
            return NotImplemented
        with np.errstate(over="ignore"):  # integers wrap, as in JAX
            return rule(*inputs, **parameters)

    return exact


def _makes_integers(parameters: Mapping[str, Any]) -> bool:
    """Return True if parameters are those of a conversion to integers, for which JAX clips numbers that are too large."""
    return "new_dtype" in parameters and np.dtype(parameters["new_dtype"]).kind in "iu"
