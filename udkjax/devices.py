"""The devices on which JAX computes by default, and the CPU of the host."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np
from jax.core import Tracer

from udkjax.arrays import is_within_jit

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def default_devices() -> list[Any]:
    """Return the devices on which JAX computes by default: the choice of `jax.default_device`, else all of this process."""
    chosen = jax.config.jax_default_device
    if chosen is None:
        return jax.local_devices()
    return jax.local_devices(backend=chosen)[:1] if isinstance(chosen, str) else [chosen]


def host_device() -> Any:
    """Return the CPU device if JAX computes on other devices by default.

    Return None if it computes on the CPU by default, or if `JAX_PLATFORMS` excludes the CPU.
    """
    return None if default_devices()[0].platform == "cpu" else cpu_device()


def cpu_device() -> Any:
    """Return the CPU device; None where `JAX_PLATFORMS` excludes it."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None


def computing_on_host() -> AbstractContextManager[Any]:
    """Return a context in which JAX computes on the CPU by default; without a CPU device, the context changes nothing."""
    host = host_device()
    return nullcontext() if host is None else jax.default_device(host)


def on_host(program: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function that runs a compiled function on the host's CPU, unless it is called while another program is traced.

    It is meant for programs with many small operations: a graphics card needs microseconds to begin each operation, and JAX takes
    ten times as long to compile for it. If an argument is committed to a device, the program runs on that device. The results are
    moved to the default device.
    """

    @wraps(program)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if host_device() is None or is_within_jit():
            return program(*args, **kwargs)
        with computing_on_host():
            results = program(*args, **kwargs)
        leaves, tree = jax.tree.flatten(results)
        places = [k for k, x in enumerate(leaves) if isinstance(x, jax.Array) and not isinstance(x, Tracer)]
        for k, x in zip(places, jax.device_put([np.asarray(leaves[k]) for k in places]), strict=True):
            leaves[k] = x
        return jax.tree.unflatten(tree, leaves)

    return run
