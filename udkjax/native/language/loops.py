"""Programs of loops (expressions/loops/loop_program.py) as LLVM functions."""

from collections.abc import Mapping, Sequence

import numpy as np

from udkjax.expressions.loops.loop_program import ADD, ALL, MAXIMUM, Address, Kernel, LoopProgram, Reset
from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.language.program import PointerPlace, Writer, from_memory


class LoopWriter:
    """The writer of loop programs as functions of one module.

    `functions` has all functions: one for each program, and one for each kernel, which programs share. `globals` has the
    definitions of tables.

    Args:
        width: The number of lanes of the module.
        cold: Whether the functions are not optimized.
    """

    def __init__(self, width: int, cold: bool = False):
        self.width, self._cold = width, cold
        self.functions: list[Function] = []
        self.globals: list[str] = []
        self._kernels: dict[tuple[Kernel, int, int], str] = {}
        self._tables: dict[bytes, str] = {}

    @property
    def parts(self) -> tuple[list[Function], list[Function]]:
        """The functions of programs, and the functions of the kernels that these call."""
        kernels = {*self._kernels.values()}
        return [f for f in self.functions if f.name not in kernels], [f for f in self.functions if f.name in kernels]

    def write(
        self, program: LoopProgram, name: str, pointers: Sequence[str], at: Mapping[str, PointerPlace], width: int | None = None
    ) -> None:
        """Write a program as a function of some pointers.

        Args:
            program: The program.
            name: The function's name.
            pointers: The names of the function's arguments.
            at: The place of each array of the program: the pointer to its memory, and its offset there in units of `width`
                numbers.
            width: The number of lanes; by default that of the module.
        """
        width = width or self.width
        f = Function(name, [(POINTER, x) for x in pointers], width, cold=self._cold)

        def address(array: str) -> Value:
            pointer, place = at[array]
            return f.at(f.given[pointer], place * width)

        for part in program.parts:
            if isinstance(part, Reset):
                with f.each(part.count) as i:
                    f.store(part.value, address(part.array), (i + part.start) * width, width)
            elif len(part.table):
                arrays = [address(part.array(x)) for x in part.kernel.arrays]
                table = Value(f, self._table(part.table), POINTER)
                f.call(self._kernel(part.kernel, part.table.shape[1], width), *arrays, table, f.const(len(part.table), INT))
        self.functions.append(f)

    def _kernel(self, kernel: Kernel, columns: int, width: int) -> str:
        key = kernel, columns, width
        if key not in self._kernels:
            self._kernels[key] = name = f"loop{len(self._kernels)}"
            self.functions.append(self._write_result(kernel, columns, width, name))
        return self._kernels[key]

    def _write_result(self, kernel: Kernel, columns: int, width: int, name: str) -> Function:
        """Return the function `name(arrays..., table, count)`: it runs a kernel for each row of a table of `columns` columns."""
        f = Function(name, [*((POINTER, a) for a in kernel.arrays), (POINTER, "table"), (INT, "count")], width, cold=self._cold)
        f.noinline = True  # inlined copies in each program would multiply the time of compilation
        with f.each(f.given["count"]) as i:
            row = f.at(f.given["table"], i * columns, "i32")
            bases: dict[tuple[str, int], Value] = {}

            def address(slot: Address) -> tuple[Value, int]:
                if slot.base is None:
                    return f.given[slot.array], slot.offset * width
                if (slot.array, slot.base) not in bases:
                    base32 = f.op(f"load i32, ptr {f.at(row, slot.base, 'i32').name}, align 4", "i32")
                    base = f.op(f"sext i32 {base32.name} to i64", INT)
                    bases[slot.array, slot.base] = f.at(f.given[slot.array], base * width)
                return bases[slot.array, slot.base], slot.offset * width

            writer = Writer(f, kernel.program)
            for s, slot in zip(kernel.program.inputs, kernel.inputs, strict=True):
                if kernel.program.uses(s):
                    writer.values[s.index] = from_memory(f, f.load(*address(slot), width), s.node.dtype)
            for value, slot in zip(writer.run(), kernel.outputs, strict=True):
                new = f.like(value, DOUBLE, width)
                if slot.update == ADD:
                    new = f.load(*address(slot), width) + new
                elif slot.update in (MAXIMUM, ALL):  # NaN stays
                    name = "maximum" if slot.update == MAXIMUM else "minimum"
                    new = f.intrinsic(name, f.load(*address(slot), width), new)
                f.store(new, *address(slot), width)
        return f

    def _table(self, table: np.ndarray) -> str:
        data = np.ascontiguousarray(table, "<i4").tobytes()
        if data not in self._tables:
            self._tables[data] = name = f"@table{len(self._tables)}"
            text = "".join(f"\\{byte:02X}" for byte in data)
            self.globals.append(f'{name} = private unnamed_addr constant [{len(data)} x i8] c"{text}", align 4')
        return self._tables[data]
