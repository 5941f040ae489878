"""Views of arrays, whose elements are read where they are used, and arrays joined from others in new memory."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from udkjax.native.language.ir import BOOL, DOUBLE, INT, Function, Operand, Value
from udkjax.native.language.program import UnsupportedError
from udkjax.native.lowering.arrays import Array, Constant, Index, Lazy, Stored, base_of, plus
from udkjax.native.lowering.lowering import Lowering


def _view(x: Array, shape: Sequence[int], place: Callable[[Index], Index], f: Function) -> Array:
    return Lazy(shape, x.base, [x], lambda index: x.read(f, place(index)))


def broadcast(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return an array repeated along new axes, and along axes of length one."""
    x, axes = to.stored(inputs[0]), p["broadcast_dimensions"]
    kept = [None if n == 1 else a for n, a in zip(x.shape, axes, strict=True)]
    return _view(x, out.shape, lambda index: tuple(0 if a is None else index[a] for a in kept), to.f)


def transpose(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return an array with its axes in another order."""
    where = list(p["permutation"])
    return _view(inputs[0], out.shape, lambda index: tuple(index[where.index(a)] for a in range(len(where))), to.f)


def reshape(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return the same elements in another shape."""
    x = inputs[0]
    if [n for n in x.shape if n != 1] == [n for n in out.shape if n != 1]:  # only axes of length one come or go
        after = [a for a, n in enumerate(out.shape) if n != 1]
        kept = [None if n == 1 else after.pop(0) for n in x.shape]
        return _view(x, out.shape, lambda index: tuple(0 if a is None else index[a] for a in kept), to.f)
    if isinstance(x, Constant):
        return to.constant(x.numbers.reshape(out.shape))
    x = x if isinstance(x, Stored) and x.is_contiguous else to.copied(x)
    return Stored(x.pointer, out.shape, x.base, x.varies) if isinstance(x, Stored) else x


def take_slice(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return the part of an array between constant indices, with constant steps."""
    starts, steps = p["start_indices"], p["strides"] or (1,) * len(out.shape)
    return _view(inputs[0], out.shape, lambda index: tuple(i * k + s for s, i, k in zip(starts, index, steps, strict=True)), to.f)


def reverse(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return an array reversed along some axes."""

    def place(index: Index) -> Index:
        return tuple((out.shape[a] - 1) - i if a in p["dimensions"] else i for a, i in enumerate(index))

    return _view(inputs[0], out.shape, place, to.f)


def clamped(f: Function, i: Operand, most: int) -> Operand:
    """Return the index i, or the nearer one of 0 and `most` if i is outside of this range."""
    if not isinstance(i, Value):
        return min(max(int(i), 0), most)
    if most == 0:
        return 0
    low = f.select(i < 0, f.const(0, INT, i.width), i)
    return f.select(low > most, f.const(most, INT, i.width), low)


def index_of(f: Function, x: Array) -> Operand:
    """Return an array of one number as an index: a Python integer if it is known, else a value."""
    return int(x.numbers) if isinstance(x, Constant) else x.read(f, ())


def dynamic_slice(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return a block of an array from start indices on, which are clamped so that the block fits."""
    x, f = to.stored(inputs[0]), to.f
    starts = [clamped(f, index_of(f, s), n - k) for s, n, k in zip(inputs[1:], x.shape, out.shape, strict=True)]
    found = Lazy(
        out.shape, x.base, inputs, lambda index: x.read(f, tuple(plus(s, i) for s, i in zip(starts, index, strict=True)))
    )
    found.cost = 0
    return found


def gather(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return the windows of an array that begin at given indices (`jax.lax.gather`)."""
    d, sizes, f = p["dimension_numbers"], p["slice_sizes"], to.f
    x, places = to.stored(inputs[0]), to.stored(inputs[1])
    batch = [k for k in range(len(out.shape)) if k not in d.offset_dims]
    kept = [a for a in range(len(x.shape)) if a not in d.collapsed_slice_dims and a not in d.operand_batching_dims]
    fills = "FILL" in str(p["mode"])

    def read(index: Index) -> Value:
        full: list[Any] = [0] * len(x.shape)
        for a, k in zip(kept, d.offset_dims, strict=True):
            full[a] = index[k]
        of_batch, inside = [index[k] for k in batch], None
        for a, k in zip(d.operand_batching_dims, d.start_indices_batching_dims, strict=True):
            full[a] = of_batch[k]
        for j, a in enumerate(d.start_index_map):
            start, most = places.read(f, (*of_batch, j)), x.shape[a] - sizes[a]
            if fills:
                is_in = (start >= 0) & (start <= most)
                inside = is_in if inside is None else inside & is_in
            full[a] = plus(clamped(f, start, most), full[a])
        found = x.read(f, tuple(full))
        missing = {DOUBLE: np.nan, INT: np.iinfo(out.dtype).min if x.base == INT else 0, BOOL: True}[x.base]
        return found if inside is None else f.select(inside, found, missing)

    return Lazy(out.shape, x.base, [x, places], read, 4)


def concatenate(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return arrays joined along an axis."""
    f, axis, start = to.f, p["dimension"], 0
    whole = to.new(out.shape, base_of(out.dtype), any(x.varies for x in inputs))
    for x in inputs:

        def put(index: Index, x: Array = x, start: int = start):
            whole.write(f, (*index[:axis], index[axis] + start, *index[axis + 1 :]), x.read(f, index))

        to.each(x.shape, put)
        start += x.shape[axis]
    return whole


def pad(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return an array with a number before, after and between its elements along each axis (`jax.lax.pad`)."""
    (x, number), f, config = inputs, to.f, p["padding_config"]
    if any(low < 0 or high < 0 for low, high, _ in config):
        raise UnsupportedError("the operation pad that removes elements")
    whole = to.new(out.shape, base_of(out.dtype), x.varies or number.varies)
    to.each(out.shape, lambda index: whole.write(f, index, number.read(f, ())))

    def put(index: Index):
        places = tuple(i * (between + 1) + low for i, (low, _, between) in zip(index, config, strict=True))
        whole.write(f, places, x.read(f, index))

    to.each(x.shape, put)
    return whole


def stack(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return arrays of equal shape joined along a new axis."""
    f, axis = to.f, p["axis"] % len(out.shape)
    whole = to.new(out.shape, base_of(out.dtype), any(x.varies for x in inputs))
    for k, x in enumerate(inputs):

        def put(index: Index, x: Array = x, k: int = k):
            whole.write(f, (*index[:axis], k, *index[axis:]), x.read(f, index))

        to.each(x.shape, put)
    return whole


def unstack(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    """Return the elements of an array along an axis as separate arrays without this axis."""
    x = to.stored(inputs[0])
    axis = equation.params["axis"] % len(x.shape)
    shape = (*x.shape[:axis], *x.shape[axis + 1 :])

    def part(k: int) -> Array:
        return _view(x, shape, lambda index: (*index[:axis], k, *index[axis:]), to.f)

    return [part(k) for k in range(x.shape[axis])]


def split(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    """Return consecutive parts of an array along an axis."""
    axis, start, found = equation.params["axis"], 0, []
    for v, n in zip(equation.outvars, equation.params["sizes"], strict=True):
        p = {"start_indices": [start if a == axis else 0 for a in range(len(v.aval.shape))], "strides": None}
        found.append(take_slice(to, inputs, p, v.aval))
        start += n
    return found


def platform_index(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return the index of the variant of a function that is for the CPU, or for any platform."""
    return to.constant(np.array(next(k for k, names in enumerate(p["platforms"]) if names is None or "cpu" in names)))


def iota(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return an array whose elements are their indices along an axis."""
    f, axis, base = to.f, p["dimension"], base_of(out.dtype)

    def read(index: Index) -> Value:
        i = index[axis]
        return f.like(i if isinstance(i, Value) else f.const(i, INT), base, 1)

    return Lazy(out.shape, base, [], read)
