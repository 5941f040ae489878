"""Updates of arrays at indices that may be unknown until a run; results are in new memory."""

from typing import Any

from udkjax.native.language.program import UnsupportedError
from udkjax.native.lowering.arrays import Array, Index, base_of, plus
from udkjax.native.lowering.lowering import Lowering
from udkjax.native.lowering.views import clamped, index_of


def scatter(adds: bool, to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return an array with windows written into it, or added if `adds`; a window that is not entirely inside is dropped."""
    x, places, change = to.stored(inputs[0]), to.stored(inputs[1]), to.stored(inputs[2])
    d, f = p["dimension_numbers"], to.f
    if d.operand_batching_dims:
        raise UnsupportedError("the operation scatter of batches")
    whole = to.new(out.shape, base_of(out.dtype), any(a.varies for a in inputs))
    to.fill(whole, x)
    axes = [a for a in range(len(x.shape)) if a not in d.inserted_window_dims]
    sizes = [1] * len(x.shape)
    for a, k in zip(axes, d.update_window_dims, strict=True):
        sizes[a] = change.shape[k]
    several = [k for k in range(len(change.shape)) if k not in d.update_window_dims]

    def put(index: Index):
        full: list[Any] = [0] * len(x.shape)
        for a, k in zip(axes, d.update_window_dims, strict=True):
            full[a] = index[k]
        inside = None
        for j, a in enumerate(d.scatter_dims_to_operand_dims):
            start, most = places.read(f, (*(index[k] for k in several), j)), x.shape[a] - sizes[a]
            is_in = (start >= 0) & (start <= most)
            inside = is_in if inside is None else inside & is_in
            full[a] = plus(clamped(f, start, most), full[a])
        old, new = whole.read(f, tuple(full)), change.read(f, index)
        new = old + new if adds else new
        whole.write(f, tuple(full), new if inside is None else f.select(inside, new, old))

    to.each(change.shape, put)
    return whole


def dynamic_update_slice(to: Lowering, inputs: list[Array], p: dict[str, Any], out: Any) -> Array:
    """Return an array with a block written into it; start indices are clamped so that the block fits."""
    x, change, *given = inputs
    f, starts = to.f, []
    for s, n, k in zip(given, x.shape, change.shape, strict=True):
        starts.append(clamped(f, index_of(f, s), n - k))
    whole = to.new(out.shape, base_of(out.dtype), any(a.varies for a in inputs))
    to.fill(whole, x)
    change = to.stored(change)

    def put(index: Index):
        whole.write(f, tuple(plus(s, i) for s, i in zip(starts, index, strict=True)), change.read(f, index))

    to.each(change.shape, put)
    return whole
