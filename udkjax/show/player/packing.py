"""Numbers as short strings, which the player's `unpack` and `floats` read.

A table of numbers is rounded to integer multiples of a given step. The second differences of each column, which are small for a
smooth motion, are mapped to unsigned integers (zigzag: 0, -1, 1, -2 ... become 0, 1, 2, 3 ...), written as LEB128 (seven bits per
byte, the least significant first, the eighth bit set if another byte follows), and encoded as base64. Unpacked numbers are within
half a step.
"""

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from udkjax.annotations import JsonObject, Numbers


def pack(table: Float[np.ndarray, "T n"], step: Numbers) -> JsonObject:
    """Return a table of finite numbers, rounded to the `step` of each column (or of all columns), as plain data.

    These are its `rows` (their number), the `steps` of its columns, and the encoded `bytes`.
    """
    table = np.asarray(table, float)
    steps = np.broadcast_to(np.asarray(step, float), table.shape[1:])
    integers = np.rint(table / steps).astype(np.int64)
    second = np.diff(integers, n=2, axis=0, prepend=np.zeros((2, table.shape[1]), np.int64)).T.ravel()
    unsigned = np.where(second < 0, -2 * second - 1, 2 * second).astype(np.uint64)
    return {"rows": len(table), "steps": steps.tolist(), "bytes": base64.b64encode(_leb128(unsigned)).decode()}


def unpack(data: Mapping[str, Any]) -> Float[np.ndarray, "T n"]:
    """Return the table that `pack` has packed, as the player reads it."""
    integers, value, shift = [], 0, 0
    for byte in base64.b64decode(data["bytes"]):
        value, shift = value | (byte & 127) << shift, shift + 7
        if byte < 128:
            integers.append(-(value + 1) // 2 if value % 2 else value // 2)
            value = shift = 0
    columns = np.array(integers, np.int64).reshape(len(data["steps"]), data["rows"])
    return columns.cumsum(axis=1).cumsum(axis=1).T * np.asarray(data["steps"])


def floats(values: Numbers) -> str:
    """Return numbers, finite or not, in single precision, as base64."""
    return base64.b64encode(np.asarray(values, "<f4").tobytes()).decode()


def _leb128(values: np.ndarray) -> bytes:
    places = 7 * np.arange(10, dtype=np.uint64)
    groups = (values[:, None] >> places) & np.uint64(127)
    lengths = 1 + np.max(np.where(groups > 0, np.arange(10), 0), axis=1)
    used = np.arange(10) < lengths[:, None]
    more = np.arange(10) < lengths[:, None] - 1
    return (groups | (more * np.uint64(128)).astype(np.uint64))[used].astype(np.uint8).tobytes()
