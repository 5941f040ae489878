"""Calls of machine code with arrays that are ready."""

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from udkjax.threads import shared_threads


class PreparedCall(NamedTuple):
    """A call of machine code: its record, with the arrays that it points to."""

    run: Callable[[int], Any]
    record: ctypes.Array
    shared: ctypes.Array  # the index of the next member, and whether memory was refused
    threads: int
    inputs: list[np.ndarray]  # float64, contiguous in memory
    outputs: list[np.ndarray]

    def __call__(self) -> list[np.ndarray]:
        """Return the outputs, which the next call overwrites; raise `MemoryError` if there is no memory for the computation."""
        self.shared[:], address = (0, 0), ctypes.addressof(self.record)
        others = [shared_threads().submit(self.run, address) for _ in range(self.threads - 1)]
        self.run(address)
        for other in others:
            other.result()
        if self.shared[1]:
            raise MemoryError("no memory for a computation by machine code")
        return self.outputs
