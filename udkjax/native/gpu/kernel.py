"""A run as a kernel: each thread of a GPU integrates one member, with the functions that serve members on the CPU.

A thread's memory (`Layout`) is local memory, which the hardware interleaves by threads, so that the threads of a warp read a
contiguous part of it together. The call record is a parameter of the kernel. The threads of a block begin each step together: all
warps of a multiprocessor then run the same functions at about the same time, which fit into its instruction cache.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

from udkjax.native.derivatives.record import Recorded
from udkjax.native.language.ir import SHARED_SPACE
from udkjax.native.language.program import UnsupportedError
from udkjax.native.language.text import external_functions, text_of_module, with_evaluated
from udkjax.native.module.memory import Memory, ThreadCode
from udkjax.native.module.module import Module
from udkjax.native.operations import Operation
from udkjax.native.runs import RunStates

KERNEL_NAME = "run_members"  # of the kernel
# Coordinates whose numbers are read together, as a thread waits for memory most of the time. The paper's linkage is slower with 4
# or 6.
VECTOR_LENGTH = 2
# The arguments of functions that point to the memory of a thread, or into it.
LOCAL_POINTERS = ("work", "out", "tangent", "bar", "stored", "accelerations", "projection")
# A barrier that also asks whether the condition holds in any thread of the block.
ANY_OF_BLOCK = "{ .reg .pred p, q; setp.ne.u32 p, $1, 0; barrier.cta.red.or.pred q, 0, p; selp.u32 $0, 1, 0, q; }"
KERNEL_TEXT = f"""
declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ntid.x()

define i1 @meet(i1 %goes_on) alwaysinline {{
  %mine = zext i1 %goes_on to i32
  %any = call i32 asm sideeffect "{ANY_OF_BLOCK}", "=r,r"(i32 %mine)
  %result = icmp ne i32 %any, 0
  ret i1 %result
}}

define ptx_kernel void @{KERNEL_NAME}(ptr byval([FIELDS x i64]) align 8 %call) {{
  %thread = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()
  %block = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
  %threads = call i32 @llvm.nvvm.read.ptx.sreg.ntid.x()
  %before = mul i32 %block, %threads
  %index = add i32 %before, %thread
  %number = zext i32 %index to i64
  %work = alloca [SIZE x double], align 64
  call void @run_member(ptr %call, ptr %work, i64 %number)
  ret void
}}
"""


@dataclass(frozen=True)
class KernelCode:
    """The code of a kernel, and the module, which describes the call record that the kernel takes."""

    module: Memory
    code: ThreadCode
    constants: int  # in the shared memory of a block

    @cached_property
    def text(self) -> str:
        """LLVM's text of the kernel."""
        kernel = KERNEL_TEXT.replace("FIELDS", str(len(self.module.call_fields))).replace("SIZE", str(self.code.size))
        return self.functions_text(LOCAL_POINTERS) + kernel

    def functions_text(self, local: Collection[str]) -> str:
        """Return LLVM's text of the functions; `local` are the names of arguments that point to a thread's own memory."""
        space = f"addrspace({SHARED_SPACE}) " if local else ""
        shared_memory = f"@block_memory = internal {space}global [{max(self.constants, 1)} x double] undef, align 16"
        return text_of_module(self.code.functions, [shared_memory, *self.code.globals], local=local, shared=self.code.shared)


def kernel_code(operation: Operation, directions: int = 0, shares_numbers: bool = False) -> KernelCode:
    """Return the code of the kernel of an operation; raise `UnsupportedError` if the operation cannot run as a kernel.

    Args:
        operation: The operation.
        directions: The number of directions of its tangents.
        shares_numbers: Whether all members have the same numbers. Their constants are then in the shared memory of a block,
            which leaves room for other numbers in the caches.
    """
    if isinstance(operation, RunStates):  # the matrix of implicit steps would take most of the memory of a thread
        operation = replace(operation, changes=False, leaves=False)
    module = operation.module(1, 1, VECTOR_LENGTH)
    constants = 0
    if isinstance(module, Recorded):
        module.has_buffer = True
    if isinstance(module, Module):
        if module.ways:
            module.tangents_begin = module.places.add("all tangents", directions * len(module.ways) * module.tangents.size)
        module.shares_constants = shares_numbers and module.unrolled is not None and not module.plan.sampled
        constants = module.constants if module.shares_constants else 0
    code = module.thread_code()
    declared = (x for f in with_evaluated([*code.functions, *code.shared]) for x in f.declared)
    for name in sorted(external_functions("\n".join(declared))):
        raise UnsupportedError(f"{name} on a GPU")  # LLVM would end the process
    return KernelCode(module, code, constants)
