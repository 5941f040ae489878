"""Programs that are compiled when they have been called often: before that NumPy evaluates them (numpy_program.py).

XLA takes some two milliseconds to compile an operation, NumPy two microseconds to evaluate it, and who asks for one derivative
waits for the first alone. So a program is evaluated by NumPy until that has taken as many operations as compiling is worth; from
then on XLA's program serves. Both agree to rounding.

To JAX such a program is one operation, whose derivatives and batches are such programs again.

Everything in the package that is to be done once, and what it is for:

    deferred                        a program that users wait for: NumPy evaluates it at first
    deferred_if_traced              the same, of a function whose concrete numbers decide something, or are checked
    traced_once                     a function that larger programs call many times: one trace, compiled within each of them
    equations.control_flow.solve    an algorithm too long to trace: Python's loops where all is concrete, else one program
    native call_seldom              a part of a compiled program that is hardly ever reached: NumPy evaluates it there
    scene cached_by_identity        a result that no number changes: found again for the same objects, without any program
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

from udkjax.programs.numpy_program import Meter, TooLongError, count_operations, numpy_program
from udkjax.programs.varying_axes import varies

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

WORTH = 700  # evaluations by NumPy, 2 to 3 us an operation, that take as long as compiling it, 2 ms
MOST = 400_000  # operations that NumPy takes before any program is compiled: about a second
_SPENT: "WeakKeyDictionary[Any, int]" = WeakKeyDictionary()  # of those, by program


def deferred(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function of trees of arrays and of static values, traced once for each structure as by `equinox.filter_jit`.

    Where it is not within a program that is compiled as a whole, NumPy evaluates it and its derivatives and batches at first.
    """
    by_jit = eqx.filter_jit(function)
    if deferred_p is None:
        return by_jit

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if jax.config.jax_disable_jit:
            return function(*args, **kwargs)
        if any(varies(x) for x in jax.tree.leaves((args, kwargs))):  # within a program of devices, whose types say so
            return by_jit(*args, **kwargs)
        try:
            program, leaves, out = trace_once(function, args, kwargs)
        except _ClosesOverError:
            return by_jit(*args, **kwargs)
        # Bound, JAX would trace a program with rules of derivatives again, to leave them out before it is evaluated.
        is_concrete = not any(isinstance(x, Tracer) for x in (*leaves, jax.device_put(0.0)))
        found = (_evaluate if is_concrete else deferred_p.bind)(*leaves, call_jaxpr=program)
        return out.rebuild(found)

    return run


def trace_once(
    function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any] | None = None
) -> "tuple[Any, list[Any], Out]":
    """Return the program of a function, traced once for each structure of its arguments, their arrays, and the result's form."""
    dynamic, static = eqx.partition((args, kwargs or {}), _is_array)
    leaves, tree = jax.tree.flatten(dynamic)
    fixed, fixed_tree = jax.tree.flatten(static)
    types = tuple(jax.typeof(x) for x in leaves)
    program, out = _trace(function, tree, tuple(fixed), fixed_tree, types, jax.config.jax_enable_x64)
    return program, leaves, out


def deferred_if_traced(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return the same of a function whose known numbers decide something, or are checked: they stay known.

    So do NumPy's results of these alone. Where nothing is traced, the function itself is called.
    """

    call: Callable[..., Any] = function

    def with_concrete(leaves: list[Any], tree: Any, concrete: tuple["_ConcreteLeaf", ...]) -> Any:
        numbers = iter(concrete)
        found = [x if _is_traced(x) else next(numbers).value for x in leaves]
        args, kwargs = jax.tree.unflatten(tree, found)
        traced, rest = eqx.partition(call(*args, **kwargs), _is_traced)
        return traced, _Rest(rest)

    program = deferred(with_concrete)

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        leaves, tree = jax.tree.flatten((args, kwargs))
        if deferred_p is None or not any(map(_is_traced, leaves)):
            return function(*args, **kwargs)
        concrete = tuple(_ConcreteLeaf(x) for x in leaves if not _is_traced(x))
        traced, rest = program([x if _is_traced(x) else None for x in leaves], tree, concrete)
        return eqx.combine(traced, rest.value)

    return run


def traced_once(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function of a mechanism and of numbers that is traced once for each structure, however often programs take it.

    One program takes Psi, its Jacobian and the loads dozens of times: in each stage, in projection, under each derivative. JAX
    finds the trace of a function under `jit` again, and of its derivatives and batches too.
    """
    program: Callable[..., Any] = eqx.filter_jit(function)

    @wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        return program(*map(_as_traced, args), **{name: _as_traced(value) for name, value in kwargs.items()})

    return run


def _as_traced(value: Any) -> Any:
    """Return a mechanism without its origin, and numbers as arrays: neither is part of what is traced."""
    return value.without_origin if isinstance(value, eqx.Module) else jnp.asarray(value, jnp.result_type(float))


class _ConcreteLeaf:
    """A number, or anything else that is not traced, compared by its content: what is traced for it serves its equals."""

    def __init__(self, value: Any):
        self.value = value
        content = np.asarray(value) if isinstance(value, float | jax.Array | np.ndarray | np.generic) else value
        if isinstance(content, np.ndarray):
            content = content.shape, content.dtype.str, content.tobytes()
        self._key = content if isinstance(content, Hashable) else id(content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ConcreteLeaf) and type(self.value) is type(other.value) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


class _Rest:
    """The part of a result that is known, and no part of a program."""

    def __init__(self, value: Any):
        self.value = value


def _is_traced(x: Any) -> bool:
    return isinstance(x, Tracer)


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray | np.generic)


class _ClosesOverError(Exception):
    """A function among the arguments knows numbers that are traced: results for it serve no other call."""


class Out:
    """The form of a result: the tree of its arrays, and all else."""

    tree: Any
    static: Any

    def rebuild(self, arrays: Sequence[Any]) -> Any:
        """Return the result of these arrays."""
        return eqx.combine(jax.tree.unflatten(self.tree, arrays), self.static)


@lru_cache(maxsize=128)
def _trace(
    function: Callable[..., Any], tree: Any, fixed: tuple[Hashable, ...], fixed_tree: Any, types: tuple[Any, ...], x64: bool
) -> tuple[Any, Out]:
    del x64  # a trace is of it
    out = Out()

    def flat(*leaves: Array) -> list[Array]:
        static = jax.tree.unflatten(fixed_tree, fixed)
        args, kwargs = eqx.combine(jax.tree.unflatten(tree, leaves), static)
        dynamic, out.static = eqx.partition(function(*args, **kwargs), _is_array)
        found, out.tree = jax.tree.flatten(dynamic)
        return found

    shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in types]
    program = jax.jit(flat).trace(*shapes).jaxpr
    if any(isinstance(x, Tracer) for x in program.consts):
        raise _ClosesOverError
    return program, out


def _evaluate(*xs: Any, call_jaxpr: Any) -> list[Array]:
    spent, limit = _SPENT.get(call_jaxpr, 0), _limit(call_jaxpr)
    if spent < limit and not jax.config.jax_debug_nans:
        meter = Meter(limit - spent)
        try:
            with np.errstate(all="ignore"):
                found = numpy_program(call_jaxpr)(meter, [np.asarray(x) for x in xs])
        except TooLongError:
            _SPENT[call_jaxpr] = limit
        else:
            _SPENT[call_jaxpr] = spent + meter.count
            return jax.device_put([np.asarray(x, a.dtype) for x, a in zip(found, call_jaxpr.out_avals, strict=True)])
    return _compiled(call_jaxpr)(*xs)


@lru_cache(maxsize=512)
def _limit(program: Any) -> int:
    return min(WORTH * count_operations(program), MOST)


@lru_cache(maxsize=512)
def _compiled(program: Any) -> Callable[..., list[Array]]:
    return jax.jit(jax.extend.core.jaxpr_as_fun(program))


_make = getattr(jax.extend.core, "create_call_primitive", None)  # of JAX 0.12 on
deferred_p: Any = None if _make is None else _make("deferred_program")
if deferred_p is not None:
    deferred_p.def_impl(_evaluate)
