"""Calls of machine code if redundant rows share the loads of joints with friction, and these rows are known only at the call.

Marks among the numbers of each member are negative for its redundant rows (equations/elimination/load_sharing.py). Members with
the same redundant rows run together, by machine code for these rows. Most members have no redundant rows and share one code.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Array, Bool

from udkjax.devices import computing_on_host
from udkjax.native.host.host_function import call_host
from udkjax.native.module.layout import INPUTS
from udkjax.native.operations import Operation

NUMBERS, SETTINGS, ROWS = (INPUTS.index(name) for name in ("numbers", "settings", "rows"))

Call = Callable[..., list[np.ndarray]]


def call_by_rows(call: Call, inputs: Sequence[np.ndarray], operation: Operation, times: int) -> list[np.ndarray]:
    """Return the outputs of all members, each from machine code for its redundant rows.

    Args:
        call: A function that runs an operation: (*inputs, operation, times) -> outputs.
        inputs: The inputs of the operation, (1 or members, ...) each.
        operation: The operation; its code `shares_by_marks`.
        times: The number of output times.
    """
    is_shared = inputs[NUMBERS][:, operation.code.marks] < 0
    if (is_shared == is_shared[0]).all():
        return _call_of_rows(call, inputs, operation, times, is_shared[0])
    outputs = [np.full(shape, np.nan) for shape in operation.shapes(inputs, times)]
    for own in np.unique(is_shared, axis=0):
        members = np.flatnonzero((is_shared == own).all(axis=1))
        of_members = [x[members] if len(x) > 1 else x for x in inputs]
        for x, found in zip(outputs, _call_of_rows(call, of_members, operation, times, own), strict=True):
            x[members] = found
    return outputs


def _call_of_rows(
    call: Call, inputs: Sequence[np.ndarray], operation: Operation, times: int, is_shared: Bool[np.ndarray, "m"]
) -> list[np.ndarray]:
    """Return the outputs of members with the same redundant rows; `is_shared` is the mask of these rows."""
    rows = tuple(np.flatnonzero(is_shared).tolist())
    with computing_on_host():  # programs are traced here, while a graphics card may wait
        with_rows = replace(operation, code=operation.code.with_shared_rows(rows))
    return call(*(_with_weights(inputs, operation, len(rows)) if rows else inputs), operation=with_rows, times=times)


@dataclass(frozen=True)
class CallByRows:
    """`call_by_rows` for one operation, as a function that compiled JAX programs call on the host."""

    call: Call
    operation: Operation
    times: int
    of_member: tuple[tuple[int, ...], ...]  # shapes of the outputs of one member

    needed_by: ClassVar[str] = (
        "friction depends on loads that redundant rows share: remove the redundant constraint that udkjax.diagnose names"
    )

    def __call__(self, *inputs: np.ndarray) -> list[np.ndarray]:
        return call_by_rows(self.call, inputs, self.operation, self.times)

    def shapes(self, members: int) -> list[tuple[int, ...]]:
        """Return the shapes of the outputs of `members` members."""
        return [(members, *shape) for shape in self.of_member]


def bind_by_rows(call: Call, inputs: Sequence[Any], operation: Operation, times: int) -> list[Array]:
    """Return the outputs of `call_by_rows` on arrays that may be traced."""
    shapes = tuple(shape[1:] for shape in operation.shapes(inputs, times))
    return call_host(CallByRows(call, operation, times, shapes), inputs)


def _with_weights(inputs: Sequence[np.ndarray], operation: Operation, shared: int) -> list[np.ndarray]:
    """Return the inputs with weights of the rows in place of their marks, and with a rank bound lowered by `shared` rows."""
    settings, names, marks = inputs[SETTINGS].copy(), operation.all_settings, operation.code.marks
    weights = settings[:, names.index("length"), None] / inputs[ROWS]
    numbers = np.broadcast_to(inputs[NUMBERS], (max(len(inputs[NUMBERS]), len(weights)), inputs[NUMBERS].shape[1])).copy()
    numbers[:, marks] = np.where(numbers[:, marks] == 0, 0.0, weights)
    if "max_rank" in names:
        settings[:, names.index("max_rank")] -= shared
    changed = {NUMBERS: numbers, SETTINGS: settings}
    return [changed.get(k, x) for k, x in enumerate(inputs)]
