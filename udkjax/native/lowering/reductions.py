"""Reductions of arrays, whose results are stored in memory: sums, products of matrices, extremes."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from udkjax.native.language.ir import BOOL, DOUBLE, INT, Operand, Value
from udkjax.native.language.program import UnsupportedError
from udkjax.native.lowering.arrays import Array, Index, Lazy, SingleNumber, fit, plus
from udkjax.native.lowering.lowering import UNROLLED_ELEMENTS, Lowering

MOST_IN_REGISTERS, BLOCK_LENGTH = 12, 8  # results in registers at once: a short row, or a part of a longer one


def _reduced(
    to: Lowering,
    x: Array,
    shape: Sequence[int],
    terms: Sequence[int],
    term: Callable[[Index, Index], Value],
    start: Any,
    join: Callable[[Value, Value], Value],
) -> Array:
    """Return an array, each element of which joins several terms; the elements of a block are computed together, in registers.

    Args:
        to: The lowering.
        x: An array with the base type of the result, which varies if the result does.
        shape: The shape of the result.
        terms: The shape of the terms of each element.
        term: The term of the element at an index (first argument), at an index among the terms.
        start: The number from which each element begins.
        join: The operation that joins an element so far and a term.
    """
    f, lanes = to.f, to.f.width if x.varies else 1

    def block(indices: Sequence[Index]) -> list[Value]:
        if len(indices) * int(np.prod(terms)) <= UNROLLED_ELEMENTS:
            found = [f.const(start, x.base, lanes) for _ in indices]
            for over in np.ndindex(*terms):
                found = [join(total, fit(f, term(i, over), x.varies)) for total, i in zip(found, indices, strict=True)]
            return found
        totals = [f.variable(start, x.base, lanes) for _ in indices]

        def add(over: Index):
            for total, i in zip(totals, indices, strict=True):
                total.value = join(total.value, fit(f, term(i, over), x.varies))

        to.each(terms, add, most=max(1, UNROLLED_ELEMENTS // len(indices)))
        return [total.value for total in totals]

    if not shape:
        return SingleNumber(block([()])[0], x.varies)
    whole, (*outer, count) = to.new(shape, x.base, x.varies), shape

    def blocks(index: Index, first: Operand, size: int):
        places = [(*index, plus(first, k)) for k in range(size)]
        for place, value in zip(places, block(places), strict=True):
            whole.write(f, place, value)

    def row(index: Index):
        if count <= MOST_IN_REGISTERS:
            return blocks(index, 0, count)
        with f.each(count // BLOCK_LENGTH) as k:
            blocks(index, k * BLOCK_LENGTH, BLOCK_LENGTH)
        return blocks(index, count - count % BLOCK_LENGTH, count % BLOCK_LENGTH)

    to.each(outer, row, most=1)
    return whole


def reduce_axes(start: Any, join: Any, to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Reduce an array along some axes by the operation `join`, from the number `start` on (or `start[base]`, by base type)."""
    x, axes = inputs[0], p["axes"]
    kept = [a for a in range(len(x.shape)) if a not in axes]

    def term(index: Index, over: Index) -> Value:
        full: list[Any] = [0] * len(x.shape)
        for a, i in (*zip(kept, index, strict=True), *zip(axes, over, strict=True)):
            full[a] = i
        return x.read(to.f, tuple(full))

    first = start[x.base] if isinstance(start, dict) else start
    return _reduced(to, x, out.shape, [x.shape[a] for a in axes], term, first, join)


def extreme(name: str, to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Reduce an array along some axes to its largest elements if `name` is "max", else to its smallest; NaN stays."""
    f, sign = to.f, -1 if name == "max" else 1

    def join(a: Value, b: Value) -> Value:
        if a.base == BOOL:
            return a | b if name == "max" else a & b
        if a.base == INT:
            return f.select(f.compare("gt" if name == "max" else "lt", a, b), a, b)
        return f.intrinsic(f"{name}imum", a, b)

    whole = np.iinfo(out.dtype) if out.dtype.kind == "i" else None
    start = {BOOL: name == "min", DOUBLE: sign * np.inf, INT: 0 if whole is None else int(whole.min if sign < 0 else whole.max)}
    return reduce_axes(start, join, to, inputs, p, out)


def cumulative(join: Any, to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return an array of cumulative sums or products by `join`, from the start or in reverse from the end of an axis."""
    x, f, axis, n = to.stored(inputs[0]), to.f, p["axis"], out.shape[p["axis"]]
    whole = to.new(out.shape, x.base, x.varies)

    def put(index: Index):
        for k in range(n):
            places = [(*index[:axis], n - 1 - i if p["reverse"] else i, *index[axis:]) for i in (k, k - 1)]
            new = x.read(f, places[0])
            whole.write(f, places[0], join(whole.read(f, places[1]), new) if k else new)

    to.each(out.shape[:axis] + out.shape[axis + 1 :], put)
    return whole


def argument(name: str, to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return the index of the first largest (`name` is "max") or smallest element along an axis, or of the first NaN."""
    f, x, (axis,) = to.f, to.stored(inputs[0]), p["axes"]
    lanes, base = f.width if x.varies else 1, INT if x.base == BOOL else x.base

    def read(index: Index) -> Value:
        def element(k: Operand) -> Value:
            return fit(f, f.like(y := x.read(f, (*index[:axis], k, *index[axis:])), base, y.width), x.varies)

        best, place = f.variable(element(0), base, lanes), f.variable(0, INT, lanes)
        with f.each(x.shape[axis], 1) as k:
            new, old = element(k), best.value
            takes = f.compare("gt" if name == "max" else "lt", new, old)
            if base == DOUBLE:
                takes = (takes | new.is_not(new)) & old.is_(old)
            best.where(takes, new)
            place.where(takes, k)
        return place.value

    return to.copied(Lazy(out.shape, INT, [x], read))


def dot(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return products of two arrays, summed over some of their axes (`jax.lax.dot_general`)."""
    (over_a, over_b), (batch_a, batch_b) = p["dimension_numbers"]
    f, a, b = to.f, to.stored(inputs[0]), to.stored(inputs[1])
    if a.base != DOUBLE or b.base != DOUBLE:
        raise UnsupportedError("the operation dot_general of integers")
    free_a = [k for k in range(len(a.shape)) if k not in (*over_a, *batch_a)]
    free_b = [k for k in range(len(b.shape)) if k not in (*over_b, *batch_b)]
    count = len(batch_a)

    def term(index: Index, over: Index) -> Value:
        of_a: list[Any] = [0] * len(a.shape)
        of_b: list[Any] = [0] * len(b.shape)
        for j in range(count):
            of_a[batch_a[j]] = of_b[batch_b[j]] = index[j]
        for k, i in zip((*free_a, *over_a), (*index[count : count + len(free_a)], *over), strict=True):
            of_a[k] = i
        for k, i in zip((*free_b, *over_b), (*index[count + len(free_a) :], *over), strict=True):
            of_b[k] = i
        return a.read(f, tuple(of_a)) * b.read(f, tuple(of_b))

    both = Lazy((), DOUBLE, [a, b], lambda index: f.const(0.0))
    return _reduced(to, both, out.shape, [a.shape[k] for k in over_a], term, 0.0, lambda total, x: total + x)
