"""Programs that NumPy evaluates at first (numpy_program.py), and that are compiled once they have been called often.

XLA takes about two milliseconds to compile an operation, and NumPy two microseconds to evaluate it: a program that runs once is
faster without compilation. NumPy therefore evaluates a program until the evaluations have cost as much as compilation; from then
on the compiled program runs, also on the host. The results agree up to rounding errors.

For JAX such a program is one operation, whose derivatives and batches are again deferred programs. In programs of a graphics card
the host runs it, if it has loops or factorizations (native/host/host_program.py).

All means of avoiding repeated work in the package, and their uses:

    deferred                        a program that users wait for: NumPy evaluates it at first
    traced_once                     a function that larger programs call many times: one trace, compiled within each of them
    control_flow.solve              an algorithm too long to trace: Python loops if everything is concrete, else one program
    native call_seldom              a rarely reached part of a compiled program: NumPy evaluates it there
    cached_by_identity              a result of objects that do not change: cached by their identity, also within a trace
    cached_by_size                  programs and machine code, which take megabytes: bounded by their memory in all
"""

from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import equinox as eqx
import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from udkjax.arrays import is_traced, is_within_jit
from udkjax.devices import on_host
from udkjax.programs.numpy_program import Meter, TooLongError, count_operations, numpy_program
from udkjax.programs.varying_axes import varies

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

WORTH_COMPILING = 700  # evaluations by NumPy (2 to 3 us per operation) that take as long as compilation (2 ms per operation)
# Operations evaluated by NumPy before any program is compiled: ten seconds, as long as the longest compilation.
MOST_NUMPY_OPERATIONS = 2_000_000
_SPENT_OPERATIONS: "WeakKeyDictionary[Any, int]" = WeakKeyDictionary()  # operations evaluated by NumPy so far, by program


def deferred(function: Callable[Arguments, Result], keeps_concrete: bool = False) -> Callable[Arguments, Result]:
    """Return a deferred version of a function: outside of compiled programs, NumPy evaluates it until compiling it pays off.

    The same holds for its derivatives and its batches. Arguments are trees of arrays and static values; the function is traced
    once for each structure of these, as by `equinox.filter_jit`.

    Args:
        function: the function.
        keeps_concrete: for a function that checks or branches on concrete numbers: they stay concrete within it, and results that
            depend only on them are concrete as well. If nothing is traced, the function itself is called.
    """
    if keeps_concrete:
        return _deferred_if_traced(function)
    by_jit = on_host(eqx.filter_jit(function))
    if deferred_p is None:
        return by_jit

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if jax.config.jax_disable_jit:
            return function(*args, **kwargs)
        leaves = jax.tree.leaves((args, kwargs))
        if any(varies(x) for x in leaves if isinstance(x, Tracer)):  # within `shard_map`, which the types of its values show
            return by_jit(*args, **kwargs)
        try:
            program, leaves, out = trace_once(function, args, kwargs)
        except _ClosesOverError:
            return by_jit(*args, **kwargs)
        # Binding would make JAX retrace a program with custom derivative rules, to remove them before evaluation.
        is_concrete = not (is_traced(leaves) or is_within_jit())
        results = (_evaluate if is_concrete else deferred_p.bind)(*leaves, call_jaxpr=program)
        return out.rebuild(results)

    return run


def trace_once(
    function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any] | None = None
) -> "tuple[Any, list[Any], ResultForm]":
    """Trace a function once for each structure of its arguments; the program is cached.

    Args:
        function: the function, of trees of arrays and static values.
        args: its arguments.
        kwargs: its keyword arguments.

    Returns:
        The program as a closed jaxpr, the arrays of the arguments, which are its inputs, and the form of the function's result.
    """
    given, tree = jax.tree.flatten((args, kwargs or {}))
    are_arrays = tuple([isinstance(x, _ARRAY_TYPES) for x in given])
    leaves = [x for x, is_array in zip(given, are_arrays, strict=True) if is_array]
    fixed = tuple([x for x, is_array in zip(given, are_arrays, strict=True) if not is_array])
    program, out = _trace(function, tree, are_arrays, fixed, tuple(map(jax.typeof, leaves)), jax.config.jax_enable_x64)
    return program, leaves, out


def _deferred_if_traced(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    call: Callable[..., Any] = function

    def with_concrete(leaves: list[Any], tree: Any, concrete: tuple["ConcreteLeaf", ...]) -> Any:
        numbers = iter(concrete)
        values = [x if _is_traced(x) else next(numbers).value for x in leaves]
        args, kwargs = jax.tree.unflatten(tree, values)
        traced, rest = eqx.partition(call(*args, **kwargs), _is_traced)
        return traced, _StaticPart(rest)

    program = deferred(with_concrete)

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        leaves, tree = jax.tree.flatten((args, kwargs))
        if deferred_p is None or not any(map(_is_traced, leaves)):
            return function(*args, **kwargs)
        concrete = tuple(ConcreteLeaf(x) for x in leaves if not _is_traced(x))
        traced, rest = program([x if _is_traced(x) else None for x in leaves], tree, concrete)
        return eqx.combine(traced, rest.value)

    return run


def traced_once(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function of a mechanism and of numbers that is traced once per structure, however often programs call it.

    One program calls Psi, its Jacobian and the loads dozens of times: in each stage, in projection, under each derivative. JAX
    caches the trace of a function under `jit`, and of its derivatives and batches.
    """
    program: Callable[..., Any] = eqx.filter_jit(function)

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        return program(*map(_as_traced, args), **{name: _as_traced(value) for name, value in kwargs.items()})

    return run


def _as_traced(value: Any) -> Any:
    """Return a mechanism without its origin (the file or drawing that it comes from), and any other value as an array.

    Equal structures then share a trace.
    """
    if isinstance(value, eqx.Module):
        return value.without_origin  # pyright: ignore[reportAttributeAccessIssue]
    return jnp.asarray(value, jnp.result_type(float))


class ConcreteLeaf:
    """A concrete number or any other object, compared by content, so that calls with equal ones share a trace.

    Objects that cannot be hashed are compared by identity.
    """

    def __init__(self, value: Any):
        self.value = value
        content = np.asarray(value) if isinstance(value, float | jax.Array | np.ndarray | np.generic) else value
        if isinstance(content, np.ndarray):
            content = content.shape, content.dtype.str, content.tobytes()
        self._key = content if isinstance(content, Hashable) else id(content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ConcreteLeaf) and type(self.value) is type(other.value) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


class _StaticPart:
    """The static part of a result: everything in it that is not a traced array."""

    def __init__(self, value: Any):
        self.value = value


def _is_traced(x: Any) -> bool:
    return isinstance(x, Tracer)


_ARRAY_TYPES = (jax.Array, np.ndarray, np.generic)


def _is_array(x: Any) -> bool:
    return isinstance(x, _ARRAY_TYPES)


class _ClosesOverError(Exception):
    """An exception for a function that closes over traced numbers, itself or by its arguments: its program cannot be reused."""


class ResultForm:
    """The form of a function's result: the structure of the tree of its arrays, and everything in it except arrays."""

    tree: Any
    static: Any

    def rebuild(self, arrays: Sequence[Any]) -> Any:
        """Return the result that has this form and these arrays."""
        return eqx.combine(jax.tree.unflatten(self.tree, arrays), self.static)


@lru_cache(maxsize=128)
def _trace(
    function: Callable[..., Any],
    tree: Any,
    are_arrays: tuple[bool, ...],
    fixed: tuple[Hashable, ...],
    types: tuple[Any, ...],
    x64: bool,
) -> tuple[Any, ResultForm]:
    """Return the program of a function of the arrays among the leaves of a tree, and the form of its result.

    The other leaves are `fixed`: their values are part of the program.
    """
    del x64  # only part of the key of the cache
    out = ResultForm()

    def flat(*leaves: Array) -> list[Array]:
        arrays, others = iter(leaves), iter(fixed)
        args, kwargs = jax.tree.unflatten(tree, [next(arrays if is_array else others) for is_array in are_arrays])
        dynamic, out.static = eqx.partition(function(*args, **kwargs), _is_array)
        outputs, out.tree = jax.tree.flatten(dynamic)
        return outputs

    shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in types]
    program = jax.jit(flat).trace(*shapes).jaxpr
    if any(isinstance(x, Tracer) for x in program.consts):
        raise _ClosesOverError
    return program, out


def _evaluate(*xs: Any, call_jaxpr: Any) -> list[Array]:
    spent, limit = _SPENT_OPERATIONS.get(call_jaxpr, 0), _limit(call_jaxpr)
    if spent < limit and not jax.config.jax_debug_nans:
        meter = Meter(limit - spent)
        try:
            with np.errstate(all="ignore"):
                results = numpy_program(call_jaxpr)(meter, [np.asarray(x) for x in xs])
        except TooLongError:
            _SPENT_OPERATIONS[call_jaxpr] = limit
        else:
            _SPENT_OPERATIONS[call_jaxpr] = spent + meter.count
            return jax.device_put([np.asarray(x, a.dtype) for x, a in zip(results, call_jaxpr.out_avals, strict=True)])
    return _compiled(call_jaxpr)(*xs)


@lru_cache(maxsize=512)
def _limit(program: Any) -> int:
    return min(WORTH_COMPILING * count_operations(program), MOST_NUMPY_OPERATIONS)


@lru_cache(maxsize=512)
def _compiled(program: Any) -> Callable[..., list[Array]]:
    return on_host(jax.jit(jax.extend.core.jaxpr_as_fun(program)))


_make = getattr(jax.extend.core, "create_call_primitive", None)  # from JAX 0.12 on
deferred_p: Any = None if _make is None else _make("deferred_program")
if deferred_p is not None:
    deferred_p.def_impl(_evaluate)
