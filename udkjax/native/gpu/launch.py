"""Batches as kernels in programs of a graphics card: kernels are compiled, loaded and registered with XLA.

The card's driver keeps a kernel for all cards of the machine (a library of cuLibraryLoadData), and loads it on a card when it is
first launched there.
"""

import ctypes
import os
from collections.abc import Sequence
from functools import lru_cache
from threading import Lock
from typing import Any

import jax

from udkjax.native.code import machine
from udkjax.native.gpu import target
from udkjax.native.gpu.driver import CudaDriver, driver
from udkjax.native.gpu.driver_calls import PLATFORM
from udkjax.native.gpu.kernel import KERNEL_NAME, KernelCode, kernel_code
from udkjax.native.gpu.launch_handler import LAUNCH_WORDS, launch_handler
from udkjax.native.language.program import UnsupportedError
from udkjax.native.language.text import text_of_module
from udkjax.native.operations import Operation
from udkjax.threads import thread_count

# A kernel takes about as long, however small the batch, as a core of the host for this number of members; measured on an H100.
# Batches of fewer members for each core run on the host, unless `UDKJAX_KERNEL_MEMBERS` sets the smallest batch.
MEMBERS_OF_CORE = 128
MOST_MEMORY = 2**16  # bytes of a thread; the driver reserves them for each of the 270,000 threads that an H100 can hold
TARGET_PREFIX = "udkjax_kernel_"  # prefix of the names of FFI targets
# Attributes of a function and of a device (CUfunction_attribute, CUdevice_attribute).
LOCAL_BYTES, MAJOR, MINOR, MULTIPROCESSORS, THREADS_PER_MULTIPROCESSOR = 3, 75, 76, 16, 39


def kernel_members() -> float:
    """Return the smallest number of members that run as a kernel: `UDKJAX_KERNEL_MEMBERS` if it is set; infinite for "never"."""
    setting = os.environ.get("UDKJAX_KERNEL_MEMBERS", "").strip()
    if not setting:
        return MEMBERS_OF_CORE * thread_count()
    if setting == "never":
        return float("inf")
    if not setting.isdecimal():
        raise ValueError(f'UDKJAX_KERNEL_MEMBERS is "{setting}", not a number of members or "never"')
    return int(setting)


def kernel_target(operation: Operation, inputs: Sequence[Any]) -> str | None:
    """Return the name of the FFI target that runs a batch as a kernel; None if the batch has to run on the host.

    Args:
        operation: the operation.
        inputs: arrays, or their shapes, (1 or members, ...).
    """
    if max(x.shape[0] for x in inputs) < kernel_members():
        return None
    directions, shares_numbers = inputs[-1].shape[1] if operation.tangents else 0, inputs[0].shape[0] == 1
    try:
        return _load(operation, directions, shares_numbers)
    except UnsupportedError:
        return None


@lru_cache(maxsize=256)
def _load(operation: Operation, directions: int, shares_numbers: bool) -> str | None:
    """Compile and register the kernel of an operation; return the name of its FFI target.

    None if its threads take too much memory, or the card or its driver is too old. Without a graphics card nothing is compiled:
    programs are then only written here, to run elsewhere.
    """
    code, found = kernel_code(operation, directions, shares_numbers), driver()
    if 8 * code.code.size > MOST_MEMORY:
        return None
    name = f"{TARGET_PREFIX}{machine.digest(code.text)}"
    if found is None:
        return name
    with _REGISTERING_LOCK:
        if name not in _REGISTERED:
            loaded = load_kernel(found, code)
            if loaded is None or not _has_memory(found, loaded):
                return None
            library = load_handler(found, code, loaded)
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(ctypes.c_void_p(library["launch"])), platform=PLATFORM)
            _REGISTERED[name] = library
    return name


_REGISTERED: dict[str, machine.Library] = {}  # XLA may call these for as long as the process runs
_REGISTERING_LOCK = Lock()
_reserved: dict[int, int] = {}  # bytes of all threads' memory that the driver holds, by device


def load_kernel(of: CudaDriver, code: KernelCode) -> int | None:
    """Compile and load a kernel; return its handle for all devices. None if the driver or a device is too old for the kernel."""
    kinds = {(of.attribute(MAJOR, k), of.attribute(MINOR, k)) for k in range(of.device_count())}
    if min(kinds) < target.OLDEST_CAPABILITY:
        return None
    library, kernel = ctypes.c_void_p(), ctypes.c_void_p()
    # If `ptxas` refuses the kernel, or is newer than the driver, the driver assembles it.
    for is_assembled in (True, False) if len(kinds) == 1 else (False,):
        try:
            image = target.compile_kernel(code.text, min(kinds), is_assembled)
            of("cuLibraryLoadData", ctypes.addressof(library), image, 0, 0, 0, 0, 0, 0)
            of("cuLibraryGetKernel", ctypes.addressof(kernel), library, KERNEL_NAME.encode())
        except AttributeError:  # a driver of CUDA 11
            return None
        except RuntimeError:
            continue
        return kernel.value
    return None


def _has_memory(of: CudaDriver, kernel: int) -> bool:
    """Return whether each device has the memory that the driver will reserve for the threads of a kernel; note it as reserved."""
    for k in range(of.device_count()):
        with of.current(k):
            size, free, total = ctypes.c_int(), ctypes.c_size_t(), ctypes.c_size_t()
            of("cuKernelGetAttribute", ctypes.addressof(size), LOCAL_BYTES, kernel, k)
            of("cuMemGetInfo_v2", ctypes.addressof(free), ctypes.addressof(total))
            needed = size.value * of.attribute(MULTIPROCESSORS, k) * of.attribute(THREADS_PER_MULTIPROCESSOR, k)
            if needed - _reserved.get(k, 0) > free.value:
                return False
            _reserved[k] = max(needed, _reserved.get(k, 0))
    return True


def load_handler(of: CudaDriver, code: KernelCode, kernel: int) -> machine.Library:
    """Return the loaded code of the handler `launch(frame)` for a kernel, which is given by its code and its handle."""
    text = text_of_module([launch_handler(code)], [LAUNCH_WORDS.text])
    library = machine.library(text, ("launch", "words"))
    LAUNCH_WORDS.fill(library, of, kernel)
    return library
