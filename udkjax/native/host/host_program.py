"""Deferred programs (programs/deferred.py) within programs for devices other than the CPU: each becomes a call of the host.

On a graphics card each operation of a program takes microseconds to begin, each step of a loop waits for the host, and each
factorization of a small matrix takes a large part of a millisecond. Deferred programs with loops over small arrays, or with a few
matrices to factorize, are therefore compiled for the CPU, when the program around them is lowered, and called as functions of the
host (host_function.py). On the CPU they are parts of the program around them.

Derivatives and batches of deferred programs are deferred programs too, and are therefore handled here as well.
"""

import math
from collections.abc import Sequence
from functools import cached_property, lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun, jaxprs_in_params
from jax.interpreters import mlir
from jax.sharding import SingleDeviceSharding
from jaxtyping import Array, Float

from udkjax.devices import cpu_device
from udkjax.native.gpu import host_handler
from udkjax.native.host.host_function import call_host
from udkjax.programs.deferred import deferred_p

LOOPS = {"scan", "while"}
FACTORIZATIONS = {"cholesky", "eig", "eigh", "hessenberg", "householder_product", "lu", "qr", "geqrf", "geqp3", "schur", "svd"}
HOST = "cpu"  # the platform for which a program is a part of the program around it
FEW_NUMBERS = 2**14  # for fewer numbers than this, the host completes an operation before a card has started it
FEW_MATRICES = 64  # the host takes some 10 us for each factorization, a card half a millisecond for any number of them


class HostProgram:
    """A program compiled for the CPU, as a `HostFunction` of one vector that holds all inputs; its result is one vector, too.

    Several arrays would take longer: each that is copied from or to a card takes some 10 us.
    """

    def __init__(self, program: Any):
        self._program = program

    @property
    def description(self) -> str:
        """The text of the program."""
        return str(self._program)

    def __call__(self, *inputs: Any) -> Sequence[Any]:
        """Return the packed results for packed inputs. A thread of XLA calls this, in which nothing may be traced or compiled."""
        with jax.transfer_guard("allow"), jax.debug_nans(False):
            return [np.asarray(self.compiled(inputs[0][0]))[None]]

    def shapes(self, members: int) -> Sequence[tuple[int, ...]]:
        """Return the shape of the result. The program is called for one member: batches are axes of its arrays."""
        return [(members, sum(map(_word_count, self._program.out_avals)))]

    @cached_property
    def compiled(self) -> Any:
        """The compiled function of a packed vector."""
        place = SingleDeviceSharding(cpu_device())
        size = sum(map(_word_count, self._program.in_avals))
        with jax.default_device(cpu_device()):
            return jax.jit(self._packed).lower(jax.ShapeDtypeStruct((size,), np.float64, sharding=place)).compile()

    def _packed(self, words: Float[Array, "N"]) -> Float[Array, "M"]:
        return pack(jaxpr_as_fun(self._program)(*unpack(words, self._program.in_avals)))


@lru_cache(maxsize=256)
def host_program(program: Any) -> HostProgram:
    """Return the host's function that runs a program; all programs that contain it share one object."""
    return HostProgram(program)


def runs_on_host(program: Any) -> bool:
    """Return True if, in programs for other devices than the CPU, a deferred program is to run on the host."""
    avals = [*program.in_avals, *program.out_avals]
    return (
        jax.config.jax_enable_x64
        and cpu_device() is not None
        and not program.effects
        and all(map(_has_words, avals))
        and _is_slow(program)
    )


def _is_slow(jaxpr: Any) -> bool:
    """Return True if a program has loops over operations on small arrays, or factorizations of a few matrices."""
    for equation in jaxpr.eqns:
        name, inner = equation.primitive.name, list(jaxprs_in_params(equation.params))
        if name in LOOPS and max(map(_largest, inner)) <= FEW_NUMBERS:
            return True
        if name in FACTORIZATIONS and math.prod(equation.invars[0].aval.shape[:-2]) <= FEW_MATRICES:
            return True
        if any(map(_is_slow, inner)):
            return True
    return False


def _largest(jaxpr: Any) -> int:
    """Return the size of the largest result of the operations of a jaxpr; zero without operations."""
    return max((getattr(v.aval, "size", 0) for equation in jaxpr.eqns for v in equation.outvars), default=0)


# --- arrays of any kind as words of 64 bits


def _has_words(aval: Any) -> bool:
    dtype = getattr(aval, "dtype", None)
    return isinstance(dtype, np.dtype) and dtype.kind in "biufc" and not (dtype.kind in "fc" and dtype.itemsize == 2)


def _word_count(aval: Any) -> int:
    return aval.size * (2 if aval.dtype.kind == "c" else 1)


def pack(xs: Sequence[Array]) -> Float[Array, "N"]:
    """Return the numbers of arrays of any type, one after another, as a vector of float64, from which `unpack` restores them."""
    return jnp.concatenate([jnp.zeros(0), *(_words(x) for x in xs)])


def _words(x: Array) -> Float[Array, "N"]:
    x = jnp.ravel(x)
    if x.dtype.kind == "c":
        return jnp.concatenate([x.real, x.imag]).astype(float)
    if x.dtype.kind in "iu" and x.dtype.itemsize == 8:
        return jax.lax.bitcast_convert_type(x, np.float64)
    return x.astype(float)


def unpack(words: Float[Array, "N"], avals: Sequence[Any]) -> list[Array]:
    """Return the arrays from which `pack` has made a vector; `avals` have their shapes and dtypes."""
    ends = np.cumsum([0, *map(_word_count, avals)])
    return [_array(words[a:b], aval) for a, b, aval in zip(ends, ends[1:], avals, strict=False)]


def _array(words: Float[Array, "N"], aval: Any) -> Array:
    if aval.dtype.kind == "c":
        words = jax.lax.complex(*jnp.split(words, 2))
    elif aval.dtype.kind in "iu" and aval.dtype.itemsize == 8:
        words = jax.lax.bitcast_convert_type(words, aval.dtype)
    return words.astype(aval.dtype).reshape(aval.shape)


# --- the rule of lowering


def _call_on_host(*inputs: Any, call_jaxpr: Any) -> list[Array]:
    program = host_program(call_jaxpr)
    if host_handler.driver() is not None:  # else the program around it is only written here
        program.compiled  # noqa: B018
    return unpack(call_host(program, [pack(inputs)[None]])[0][0], call_jaxpr.out_avals)


def _call_or_inline(*inputs: Any, call_jaxpr: Any) -> list[Array]:
    on_host = partial(_call_on_host, call_jaxpr=call_jaxpr)
    return jax.lax.platform_dependent(*inputs, default=on_host, **{HOST: jaxpr_as_fun(call_jaxpr)})


def _lower(context: Any, *inputs: Any, call_jaxpr: Any) -> Any:
    # The choice is made here, as JAX refuses rules for single platforms of such a primitive in programs for several platforms.
    platforms = context.module_context.platforms
    if tuple(platforms) != (HOST,) and runs_on_host(call_jaxpr):
        call = _call_or_inline if HOST in platforms else _call_on_host
        return mlir.lower_fun(call)(context, *inputs, call_jaxpr=call_jaxpr)
    return mlir.core_call_lowering(context, *inputs, name=deferred_p.name, inline_jax_late=True, call_jaxpr=call_jaxpr)


def register() -> None:
    """Register the rule by which JAX lowers deferred programs."""
    if deferred_p is not None:
        mlir.register_lowering(deferred_p, _lower, cacheable=False)
