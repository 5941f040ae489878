"""The driver of the graphics card, with ctypes functions in place of the real ones."""

import ctypes
from types import SimpleNamespace

import pytest

from udkjax.native.gpu.driver import CudaDriver, CudaError

NO_DEVICE = 100


def stand_in(calls, **answers):
    """Functions of the driver that record their calls, write requested values, and return given errors."""
    functions = SimpleNamespace()

    def add(name, arguments, writes=None):
        @ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_uint64] * arguments)
        def function(*given):
            calls.append((name, *given[writes is not None :]))
            if name not in answers and writes is not None:
                ctypes.c_int64.from_address(given[0]).value = writes
            return answers.get(name, 0)

        setattr(functions, name, function)

    def describe(name, text):
        @ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_uint64, ctypes.c_uint64)
        def function(answer, place):
            ctypes.c_void_p.from_address(place).value = ctypes.cast(text, ctypes.c_void_p).value if answer == NO_DEVICE else None
            return 0

        setattr(functions, name, function)

    add("cuInit", 1)
    add("cuDeviceGet", 2, writes=3)
    add("cuDevicePrimaryCtxRetain", 2, writes=2**40)
    add("cuCtxPushCurrent_v2", 1)
    add("cuCtxPopCurrent_v2", 1, writes=0)
    functions.texts = [ctypes.c_char_p(b"no device"), ctypes.c_char_p(b"CUDA_ERROR_NO_DEVICE")]
    describe("cuGetErrorString", functions.texts[0])
    describe("cuGetErrorName", functions.texts[1])
    return functions


def test_the_context_of_a_device_is_retained_once():
    calls = []
    driver = CudaDriver(stand_in(calls))
    for _ in range(2):
        with driver.current(1):
            calls.append(("inside",))
    once = [("cuInit", 0), ("cuDeviceGet", 1), ("cuDevicePrimaryCtxRetain", 3)]
    assert calls == [*once, *[("cuCtxPushCurrent_v2", 2**40), ("inside",), ("cuCtxPopCurrent_v2",)] * 2]


def test_errors_are_in_words():
    with pytest.raises(CudaError, match=r"^cuInit: no device \(CUDA_ERROR_NO_DEVICE\)$"):
        CudaDriver(stand_in([], cuInit=NO_DEVICE))
    driver = CudaDriver(stand_in([], cuDevicePrimaryCtxRetain=999))
    with pytest.raises(CudaError, match="cuDevicePrimaryCtxRetain: error 999"):
        driver.primary_context(0)


def test_machine_code_gets_the_address_of_a_function():
    functions = stand_in([])
    address = CudaDriver(functions).address("cuInit")
    assert address == ctypes.cast(functions.cuInit, ctypes.c_void_p).value
    with pytest.raises(AttributeError):
        CudaDriver(functions).address("cuUnknown")
