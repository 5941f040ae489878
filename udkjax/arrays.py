"""Arrays of NumPy or JAX: the choice of the library, tests for traced numbers, and conversions that compile no program."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial, update_wrapper
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import Primitive
from jax.interpreters import mlir
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Float

from udkjax.annotations import Numbers

ArrayLibrary: TypeAlias = ModuleType  # numpy or jax.numpy

# Bound on computed numbers that are zero in theory, relative to the largest number of the same kind: 256 times the precision.
ROUNDING = 256 * float(np.finfo(float).eps)
FULL_TURN = 2.0 * np.pi  # rad
Module = TypeVar("Module")


def array_namespace(*numbers: ArrayLike | Sequence[ArrayLike]) -> ModuleType:
    """Return jax.numpy if one of the numbers is a JAX array, else NumPy."""
    return jnp if any(isinstance(x, jax.Array) for x in jax.tree.leaves(numbers)) else np


def is_array(x: object) -> bool:
    """Return True if an object, such as a leaf of a tree, is an array of JAX or NumPy."""
    return isinstance(x, jax.Array | np.ndarray)


def is_traced(tree: Any) -> bool:
    """Return True if any number in a tree is traced."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(tree))


def without_derivatives(tree: Any) -> Any:
    """Return a tree without tangents: numbers become concrete where only derivatives trace them, as in `jax.grad(f)(x)`.

    A tree without traced numbers is returned as the same object, with everything that is cached for it.
    """
    if not is_traced(tree):
        return tree
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, Tracer) else x, tree)


def is_within_jit() -> bool:
    """Return True while a program is traced, as by `jax.jit`: even operations on concrete numbers then become part of it."""
    return isinstance(_evaluated_p.bind(), Tracer)


_evaluated_p = Primitive("is_evaluated")  # without inputs, so that the test for tracing puts nothing on a device
_evaluated_p.def_impl(lambda: np.True_)
_evaluated_p.def_abstract_eval(lambda: ShapedArray((), np.dtype(bool)))
mlir.register_lowering(_evaluated_p, mlir.lower_fun(lambda: jnp.asarray(True), multiple_results=False))


def library_for(tree: Any) -> ModuleType:
    """Return jax.numpy if a number in a tree is traced, else NumPy, since JAX would compile a program for each operation."""
    return jnp if is_traced(tree) else np


def stored(x: Any) -> Any:
    """Convert a NumPy array to a JAX array, which may share its memory, so that the NumPy array must not be changed afterwards.

    Anything else is returned unchanged.
    """
    return jax.device_put(x) if isinstance(x, np.ndarray | np.generic) else x


# Under `jax.disable_jit` they convert without a compiled program.
_put_together, _put_alone = jax.jit(lambda *arrays: [jnp.asarray(x) for x in arrays]), jax.jit(jnp.asarray)
_WORTH_A_PROGRAM = 60  # calls after which a program is compiled, in 15 ms; it saves 0.3 ms per call
_FEW_NUMBERS = 2**16  # up to which copying them into one vector takes less time than passing arrays one by one
_calls: Counter[tuple[tuple[int, ...], ...]] = Counter()  # number of calls by the shapes of the arrays


def by_numpy(x: Any) -> Any:
    """Return a number as a NumPy array, so that results stay concrete; return None and traced numbers unchanged."""
    return x if x is None or isinstance(x, Tracer) else np.asarray(x)


def put_arrays(arrays: Any) -> Any:
    """Return a tree of NumPy arrays and numbers as a tree of JAX arrays.

    A compiled program converts the trees whose shapes occur often, which takes less time than one transfer per array.
    """
    leaves, tree = jax.tree.flatten(arrays)
    _calls[shapes := tuple(map(np.shape, leaves))] += 1
    if _calls[shapes] <= _WORTH_A_PROGRAM or jax.config.jax_debug_nans or jax.config.jax_debug_infs:
        return jax.device_put(arrays)
    leaves = [np.asarray(x) for x in leaves]
    has_words = jax.config.jax_enable_x64 and all(x.dtype in (np.float64, np.int64, np.bool_) for x in leaves)
    if not has_words or (jax.default_backend() == "cpu" and sum(x.size for x in leaves) > _FEW_NUMBERS):
        return jax.tree.unflatten(tree, _put_together(*leaves))
    words = np.concatenate([(x.astype(int) if x.dtype == bool else x).ravel().view(np.float64) for x in leaves])
    return jax.tree.unflatten(tree, _unpacked(words, tuple([(x.shape, x.dtype) for x in leaves])))


@partial(jax.jit, static_argnums=1)
def _unpacked(words: Float[Array, "N"], kinds: Sequence[tuple[tuple[int, ...], np.dtype]]) -> list[Array]:
    """Return the arrays of given shapes and types (`kinds`) that are stored one after another in a vector of 64-bit words.

    Each argument of a program takes some 5 us, and 10 us on a graphics card; this vector is a single argument.
    """
    ends = np.cumsum([math.prod(shape) for shape, _ in kinds])[:-1]
    parts = zip(jnp.split(words, ends), kinds, strict=True)
    return [
        jax.lax.bitcast_convert_type(part, np.int64 if kind == np.bool_ else kind).astype(kind).reshape(shape)
        for part, (shape, kind) in parts
    ]


def fractions(text: str) -> Float[np.ndarray, "n"]:
    """Return numbers that are written as fractions with spaces between them, such as "1/6 4/15 1"."""
    return np.array([float(Fraction(x)) for x in text.split()])


def make_module(cls: type[Module], **fields: Any) -> Module:
    """Make an instance from all of its fields, without the checks and conversions of its constructor."""
    module = object.__new__(cls)
    for name, value in fields.items():
        object.__setattr__(module, name, value)
    return module


def solve_each(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return x (M, n) with A x = b for matrices (M, n, n) and vectors (M, n), NaN where a matrix is singular or not finite.

    `numpy.linalg.solve` raises an error for all of them if one is singular.
    """
    is_finite = np.isfinite(A).all((1, 2))
    regular = np.where(is_finite[:, None, None], A, np.eye(A.shape[-1]))
    try:
        x = np.linalg.solve(regular, b[..., None])[..., 0]
    except np.linalg.LinAlgError:
        is_finite &= np.linalg.slogdet(regular)[0] != 0
        x = np.linalg.solve(np.where(is_finite[:, None, None], A, np.eye(A.shape[-1])), b[..., None])[..., 0]
    return np.where(is_finite[:, None], x, np.nan)


class TreeMethod:
    """A descriptor of a method: on an instance, it returns the bound method as a tree (`Partial`) that contains the instance."""

    def __init__(self, function: FunctionType):
        self.function = function
        update_wrapper(self, function)  # pyright: ignore[reportArgumentType]

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            return self.function
        method = Partial(function := self.function, instance)
        vars(method).update({key: getattr(function, key) for key in _COPIED_ATTRIBUTES})
        return method


class QuickMethods(eqx.Module):
    """An Equinox module in which looking up a field or a method takes the same time for any number of array leaves.

    Methods are trees, as in every Equinox module, so that `jax.jit(module.method)` traces the module's numbers. Equinox examines
    each attribute for that in Python when it is looked up, and makes methods with a check that visits all leaves each time.
    """

    if not TYPE_CHECKING:
        __getattribute__ = object.__getattribute__  # without a call of Python

        def __init_subclass__(cls, **given: Any):
            super().__init_subclass__(**given)
            for name, value in list(vars(cls).items()):
                if isinstance(value, FunctionType) and not name.startswith("__"):
                    setattr(cls, name, TreeMethod(value))


_COPIED_ATTRIBUTES = "__doc__", "__name__", "__qualname__", "__module__"


_FLOAT64, _FLOAT32 = np.dtype(np.float64), np.dtype(np.float32)


def float_type() -> np.dtype:
    """Return the dtype that JAX gives to Python floats; `jax.numpy.result_type(float)` takes fifty times as long to return it."""
    return _FLOAT64 if jax.config.jax_enable_x64 else _FLOAT32


def number(value: Numbers) -> Float[Array, "..."]:
    """Return a number, or an array of numbers, as a JAX array of the type `float_type()`, to be stored as a field of a module.

    A Python float in a field would be static: each new value would be compiled. A JAX array of this type is returned as it is.
    """
    dtype = float_type()
    if isinstance(value, jax.Array) and value.dtype == dtype and not value.weak_type:  # the same object: a leaf stays this leaf
        return value
    if all(isinstance(x, float | int | np.number | np.ndarray) for x in jax.tree.leaves(value)):
        value = np.array(value, dtype)  # a copy, since JAX may use its memory
        _calls[shapes := (value.shape,)] += 1
        put = jax.device_put if _calls[shapes] <= _WORTH_A_PROGRAM else _put_alone  # a program takes a fifth of the time
        array = put(value)
        if not isinstance(array, Tracer):
            return array
        with jax.ensure_compile_time_eval():  # concrete numbers stay concrete while something else is traced
            return put(value)
    return jnp.asarray(value, dtype=dtype)


def optional_number(value: Numbers | None) -> Float[Array, "..."] | None:
    """Convert a number as `number` does; return None, an absent number, as it is."""
    return None if value is None else number(value)


def number_called(name: str, optional: bool = False) -> Callable[[Any], Any]:
    """Return `number` as a converter whose errors name the field or argument; if `optional`, None stays None."""

    def converted(value: Any) -> Any:
        if optional and value is None:
            return None
        try:
            return number(value)
        except (TypeError, ValueError, OverflowError):
            kind = "a string" if isinstance(value, str) else f"an object of type {type(value).__name__}"
            raise TypeError(f"{name} must be a number or an array of numbers, not {kind}") from None

    return converted
