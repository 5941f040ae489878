"""Indexing operations of JAX programs in NumPy: slices, gathers and scatters."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.lax import GatherScatterMode


def dynamic_slice(x: np.ndarray, *starts: Any, slice_sizes: Sequence[int]) -> np.ndarray:
    """Return a slice of a fixed size, shifted to lie within the array."""
    return x[_window(np.shape(x), starts, slice_sizes)]


def dynamic_update_slice(x: np.ndarray, update: np.ndarray, *starts: Any) -> np.ndarray:
    """Return an array with a slice replaced."""
    result = np.array(x)
    result[_window(result.shape, starts, np.shape(update))] = update
    return result


def _window(shape: Sequence[int], starts: Sequence[Any], sizes: Sequence[int]) -> tuple[slice, ...]:
    clipped = [min(max(int(s), 0), n - size) for s, n, size in zip(starts, shape, sizes, strict=True)]
    return tuple(slice(s, s + size) for s, size in zip(clipped, sizes, strict=True))


def gather(
    x: np.ndarray,
    indices: np.ndarray,
    dimension_numbers: Any,
    slice_sizes: Sequence[int],
    mode: GatherScatterMode,
    fill_value: Any = None,
    **_: Any,
) -> np.ndarray:
    """Return the slices of an array that begin at given indices, by the rules and parameters of `jax.lax.gather_p`."""
    d = dimension_numbers
    dropped = (*d.collapsed_slice_dims, *d.operand_batching_dims)
    batch, inside, places = _places(
        np.shape(x),
        indices,
        d.start_index_map,
        d.operand_batching_dims,
        d.start_indices_batching_dims,
        dropped,
        slice_sizes,
        mode,
    )
    slices = np.asarray(x)[places]
    if inside is not None:
        missing = (
            np.nan if np.issubdtype(slices.dtype, np.inexact) else np.iinfo(slices.dtype).min if slices.dtype != bool else True
        )
        if fill_value is not None:
            missing = fill_value
        slices = np.where(inside.reshape(*inside.shape, *[1] * (slices.ndim - inside.ndim)), slices, missing).astype(slices.dtype)
    offsets = list(d.offset_dims)
    return np.moveaxis(slices, range(batch, slices.ndim), offsets) if offsets else slices


def scatter(combine: Callable[[np.ndarray, Any, np.ndarray], None]) -> Callable[..., np.ndarray]:
    """Return a rule for one of JAX's scatter primitives, which update the slices of an array that begin at given indices.

    `combine(array, places, updates)` changes, in place, the entries of an array at places with the updates.
    """

    def apply(
        x: np.ndarray, indices: np.ndarray, updates: np.ndarray, dimension_numbers: Any, mode: GatherScatterMode, **_: Any
    ) -> np.ndarray:
        d, result, updates = dimension_numbers, np.array(x), np.asarray(updates)
        dropped = (*d.inserted_window_dims, *d.operand_batching_dims)
        window = [size for k, size in enumerate(updates.shape) if k in d.update_window_dims]
        window_sizes = iter(window)
        sizes = [1 if k in dropped else next(window_sizes) for k in range(result.ndim)]
        batch, inside, places = _places(
            result.shape,
            indices,
            d.scatter_dims_to_operand_dims,
            d.operand_batching_dims,
            d.scatter_indices_batching_dims,
            dropped,
            sizes,
            mode,
        )
        updates = np.moveaxis(updates, d.update_window_dims, range(batch, updates.ndim))
        if inside is not None:
            shape = updates.shape
            places = tuple(np.broadcast_to(p, shape)[inside] for p in places)
            updates = updates[inside]
        combine(result, places, updates)
        return result

    return apply


def _places(
    shape: Sequence[int],
    indices: np.ndarray,
    index_map: Sequence[int],
    batching: Sequence[int],
    index_batching: Sequence[int],
    dropped: Sequence[int],
    sizes: Sequence[int],
    mode: GatherScatterMode,
) -> tuple[int, np.ndarray | None, tuple[np.ndarray, ...]]:
    """Return the places of the entries of the slices that begin at `indices`, for a gather or a scatter.

    Returns:
        The number of batch dimensions; for each slice True if it lies within the array (None: all do, or are shifted so that they
        do); and the places, an array of indices for each dimension of the array. These arrays have the batch dimensions of
        `indices` first, then the dimensions of the slices.
    """
    indices = np.asarray(indices)
    batch_shape, batch = indices.shape[:-1], indices.ndim - 1
    retained = [k for k in range(len(shape)) if k not in dropped]
    inside, places = None, []
    for k, n in enumerate(shape):
        start = np.zeros((), int)
        if k in index_map:
            start = indices[..., list(index_map).index(k)].astype(int)
            last = n - sizes[k]
            if mode == GatherScatterMode.FILL_OR_DROP:
                fits = (start >= 0) & (start <= last)
                inside = fits if inside is None else inside & fits
            start = np.clip(start, 0, max(last, 0))
        elif k in batching:
            axis = index_batching[list(batching).index(k)]
            start = np.arange(n).reshape([-1 if j == axis else 1 for j in range(batch)])
        start = start.reshape(*start.shape, *[1] * len(retained)) if start.ndim else start
        if k in retained:
            start = start + np.arange(sizes[k]).reshape([-1 if j == k else 1 for j in retained])
        places.append(start)
    result_shape = (*batch_shape, *(sizes[k] for k in retained))
    if not places:
        return batch, None, ()
    places[0] = np.broadcast_to(places[0], result_shape)
    return batch, None if inside is None or inside.all() else inside, tuple(places)
