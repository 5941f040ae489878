"""A JAX function of one member, lowered and run for many."""

import ctypes
from typing import Any

import jax
import numpy as np

from udkjax.native.code import machine
from udkjax.native.language.text import text_of_module
from udkjax.native.lowering.arrays import Stored, base_of
from udkjax.native.lowering.lowering import LoweredFunction, Lowering
from udkjax.native.lowering.rules import lower


def write(function, given, width):
    """Write `lowered(inputs..., outputs..., scratch)`; return it, and the shapes and types of the outputs."""
    closed = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in given))
    outs: list[Any] = [v.aval for v in closed.jaxpr.outvars]
    names = [*(f"in{k}" for k in range(len(given))), *(f"out{k}" for k in range(len(outs)))]
    f = LoweredFunction("lowered", [*names, "scratch"], width)
    to = Lowering(f, f.given["scratch"], lower)
    arrays = [Stored(f.given[f"in{k}"], x.shape[1:], base_of(x.dtype), True) for k, x in enumerate(given)]
    for k, x in enumerate(to.closed(closed, arrays)):
        to.fill(Stored(f.given[f"out{k}"], x.shape, x.base, True), x)
    return f, [(x.shape, np.float64 if x.dtype == np.float64 else np.int64) for x in outs], to.size


def lowered(function, given, width):
    """Return the outputs for all members; memory that was never written holds NaN."""
    f, outs, size = write(function, given, width)
    library = machine.library(text_of_module([f, *f.evaluated.values()]), ["lowered"])
    call, found = machine.function(library["lowered"], *[ctypes.c_void_p] * (len(given) + len(outs) + 1)), []
    count = len(given[0])
    for k in range(0, count, width):
        chosen = np.minimum(np.arange(k, k + width), count - 1)
        kinds = [np.float64 if x.dtype == np.float64 else np.int64 for x in given]
        ins = [np.ascontiguousarray(np.moveaxis(x[chosen].astype(t), 0, -1)) for x, t in zip(given, kinds, strict=True)]
        results = [np.zeros((*shape, width), t) for shape, t in outs]
        scratch = np.full(size * width + 8, np.nan)
        call(*(x.ctypes.data for x in (*ins, *results, scratch)))
        found.append([np.moveaxis(x, -1, 0) for x in results])
    return [np.concatenate([x[j] for x in found])[:count] for j in range(len(outs))]
