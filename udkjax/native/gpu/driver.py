"""NVIDIA's driver (libcuda), called by ctypes: addresses of its functions, errors in words, and contexts.

The driver belongs to the graphics card. Nothing is compiled against it or linked with it, so that the package needs no CUDA.
"""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

DRIVER_LIBRARY = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"


class CudaError(RuntimeError):
    """An error of the CUDA driver, in the driver's words."""


class CudaDriver:
    """The functions of the driver.

    Args:
        library: libcuda, or an object with functions of the same names.

    Raises:
        CudaError: the driver cannot be initialized, for example because it finds no device.
    """

    def __init__(self, library: Any):
        self._library, self._contexts, self._retaining = library, {}, Lock()
        self("cuInit", 0)

    def __call__(self, name: str, *arguments: Any) -> None:
        """Call a function.

        Args:
            name: its name in the library, for example "cuMemAlloc_v2".
            arguments: numbers and addresses as whole numbers, each passed in 64 bits, or objects of ctypes.

        Raises:
            CudaError: the function reports an error.
        """
        answer = getattr(self._library, name)(*(ctypes.c_uint64(x) if isinstance(x, int) else x for x in arguments))
        if answer:
            raise CudaError(f"{name}: {self.words(answer)}")

    def address(self, name: str) -> int:
        """Return the address of a function, for machine code that calls it."""
        address = ctypes.cast(getattr(self._library, name), ctypes.c_void_p).value
        assert address  # ctypes raises AttributeError for a missing function
        return address

    def words(self, answer: int) -> str:
        """Return the meaning of an answer (CUresult), for example "out of memory (CUDA_ERROR_OUT_OF_MEMORY)"."""
        texts = []
        for function in ("cuGetErrorString", "cuGetErrorName"):
            text = ctypes.c_char_p()
            getattr(self._library, function)(ctypes.c_uint64(answer), ctypes.c_uint64(ctypes.addressof(text)))
            texts.append((text.value or b"").decode(errors="replace"))
        return f"{texts[0]} ({texts[1]})" if all(texts) else f"error {answer}"

    def device_count(self) -> int:
        """Return the number of visible devices."""
        return self._answer("cuDeviceGetCount", ctypes.c_int)

    def attribute(self, which: int, ordinal: int) -> int:
        """Return the attribute `which` (CUdevice_attribute) of a device, for example 75 and 76 for its compute capability."""
        return self._answer("cuDeviceGetAttribute", ctypes.c_int, which, self._device(ordinal))

    def primary_context(self, ordinal: int) -> int:
        """Return the handle of the context of a device that JAX uses as well; the context is retained until the process ends."""
        with self._retaining:
            if ordinal not in self._contexts:
                self._contexts[ordinal] = self._answer("cuDevicePrimaryCtxRetain", ctypes.c_void_p, self._device(ordinal))
            return self._contexts[ordinal]

    @contextmanager
    def current(self, ordinal: int) -> Iterator[None]:
        """Make the primary context of a device current in this thread for the duration of the block."""
        self("cuCtxPushCurrent_v2", self.primary_context(ordinal))
        try:
            yield
        finally:
            self._answer("cuCtxPopCurrent_v2", ctypes.c_void_p)

    def _device(self, ordinal: int) -> int:
        return self._answer("cuDeviceGet", ctypes.c_int, ordinal)

    def _answer(self, name: str, kind: Any, *arguments: int) -> Any:
        """Return the number that a function of the driver writes to the address which is its first argument."""
        found = kind()
        self(name, ctypes.addressof(found), *arguments)
        return found.value


@cache
def driver() -> CudaDriver | None:
    """Return the driver of this machine; None if there is no driver or no device."""
    try:
        return CudaDriver(ctypes.CDLL(DRIVER_LIBRARY))
    except (OSError, CudaError):
        return None
