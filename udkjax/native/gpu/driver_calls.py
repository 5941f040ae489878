"""Calls of the driver from machine code: each handler has a table of words with the addresses of the driver's functions."""

import ctypes

from udkjax.native.code import machine
from udkjax.native.gpu.driver import CudaDriver
from udkjax.native.host.ffi import CONTEXT, CREATE_ERROR, INTERNAL, STREAM, arguments_struct, call_api, call_with, text_of, word
from udkjax.native.language.ir import INT, POINTER, Function, Value

PLATFORM = "CUDA"  # XLA's name of the platform
CONTEXT_OF_STREAM, PUSH_CONTEXT, POP_CONTEXT = "cuStreamGetCtx", "cuCtxPushCurrent_v2", "cuCtxPopCurrent_v2"
COPY_TO_HOST, COPY_TO_DEVICE, WAIT_FOR_STREAM = "cuMemcpyDtoHAsync_v2", "cuMemcpyHtoDAsync_v2", "cuStreamSynchronize"
DESCRIBE_ERROR = "cuGetErrorString"
ARGUMENTS_OFFSET = 24  # offset in bytes of the first number in a struct of arguments of XLA's functions, after the context
UNKNOWN_ERROR = b"the driver does not say why"
MOST_WORDS = 400  # bytes of the driver's words in an error
STRNCAT = "declare ptr @strncat(ptr, ptr, i64)"


class Words:
    """The table of 64-bit words that a handler reads: addresses of functions of the CUDA driver, then further numbers.

    Args:
        functions: the names of functions, in addition to those that every handler needs.
        further: the names of further words.
    """

    def __init__(self, functions: tuple[str, ...], further: tuple[str, ...]):
        self.functions = (CONTEXT_OF_STREAM, PUSH_CONTEXT, POP_CONTEXT, DESCRIBE_ERROR, *functions)
        self.names = (*self.functions, *further)

    @property
    def text(self) -> str:
        """LLVM's definition of the table."""
        return f"@words = global [{len(self.names)} x i64] zeroinitializer"

    def fill(self, library: machine.Library, of: CudaDriver, *further: int):
        """Write the table of a loaded handler: the addresses of its functions in the driver `of`, then the `further` numbers."""
        words = (ctypes.c_int64 * len(self.names)).from_address(library["words"])
        words[:] = [*map(of.address, self.functions), *further]

    def load(self, f: Function, name: str, base: str = POINTER) -> Value:
        """Load the entry `name` of the table."""
        return f.load("@words", self.names.index(name), base=base)

    def drive(self, f: Function, name: str, *arguments: Value | str) -> Value:
        """Call a function of the driver with values, or with constants in LLVM's text; return its answer, 0 without an error."""
        address = self.load(f, name)
        given = ", ".join(x if isinstance(x, str) else f"{x.type} {x.name}" for x in arguments)
        answer = f.op(f"call i32 {address.name}({given})", "i32")
        return f.op(f"zext i32 {answer.name} to i64", INT)

    def error(self, f: Function, frame: Value, failed: bytes, answer: Value) -> Value:
        """Return the address of a new error of XLA for an error of the driver.

        Its message is `failed`, followed by the driver's description of the `answer` of one of its functions.
        """
        text, place = text_of(f, failed, MOST_WORDS), Value(f, f.reserve(POINTER), POINTER)
        f.store(Value(f, "null", POINTER), place, base=POINTER)
        self.drive(f, DESCRIBE_ERROR, answer, place)
        described = f.load(place, base=POINTER)
        words = f.select(f.is_null(described), text_of(f, UNKNOWN_ERROR), described)
        f.op(f"call ptr @strncat(ptr {text.name}, ptr {words.name}, i64 {MOST_WORDS - 8})", POINTER)
        f.declared.add(STRNCAT)
        return call_api(f, frame, CREATE_ERROR, text, f.const(INTERNAL, INT))


def stream_of(f: Function, frame: Value) -> Value:
    """Return the stream on which XLA calls a handler; without a stream, the handler returns XLA's error."""
    asked = arguments_struct(f, word(f, frame, CONTEXT, POINTER), f.const(0, INT))
    refused = call_with(f, frame, STREAM, asked)
    with f.if_(~f.is_null(refused)):
        f.leave(f"ptr {refused.name}")
    return word(f, asked, ARGUMENTS_OFFSET, POINTER)
