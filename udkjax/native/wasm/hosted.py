"""Functions of JAX as a WebAssembly module that calls functions of its host, such as a page.

All functions take the address of one block of float64, in which inputs, results and the arguments of the host's functions have
their places. A function of the host is imported with the same argument: it reads its arguments there, and writes its result.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function
from udkjax.native.language.text import text_of_module
from udkjax.native.lowering.arrays import Stored
from udkjax.native.lowering.lowering import LoweredFunction, Lowering, traced
from udkjax.native.lowering.module_calls import ModuleCall, simplified
from udkjax.native.lowering.rules import lower
from udkjax.native.module.layout import Layout
from udkjax.native.wasm.object_code import LinkedModule
from udkjax.native.wasm.target import compile_wasm


class ImportedFunction(NamedTuple):
    """A function of the host, which functions of JAX may call.

    Attributes:
        name: The name of the function, and of the place of its result.
        arguments: The shapes of its arguments by the names of their places, which functions may share.
        size: The number of elements of its result.
    """

    name: str  # also of the place of its result
    arguments: dict[str, tuple[int, ...]]
    size: int

    def __call__(self, *arguments: Any) -> jax.Array:
        """Return the result as a traced array; this is called in functions that JAX traces."""
        given = {name: x for name, x in zip(self.arguments, arguments, strict=True) if np.size(x)}
        return ModuleCall((self.name,), tuple(given), ((self.name, (self.size,)),))(*given.values())[0]


class HostedModule(NamedTuple):
    """A compiled module; and, by name, the index and the shape of each array in its block of `size` numbers."""

    linked: LinkedModule
    places: dict[str, tuple[int, tuple[int, ...]]]
    size: int


def hosted_module(
    functions: Mapping[str, Callable[..., dict[str, Any]]],
    inputs: Mapping[str, tuple[int, ...]],
    imports: Mapping[str, tuple[dict[str, tuple[int, ...]], int]],
) -> HostedModule:
    """Compile functions of the same inputs to a module.

    Args:
        functions: the functions by name. Each takes the functions of the host, by name, as its first argument, then all inputs in
            order. It returns arrays by name; an array with the name of an input replaces this input.
        inputs: the shapes of the inputs.
        imports: by name, for each function of the host, the shapes of its arguments, which functions may share by their names,
            and the size of its result.
    """
    host = {name: ImportedFunction(name, *x) for name, x in imports.items()}
    given = [jax.ShapeDtypeStruct(shape, float) for shape in inputs.values()]
    layout, places = Layout(1, 1), dict[str, tuple[int, tuple[int, ...]]]()

    def place(name: str, shape: tuple[int, ...]) -> None:
        if name not in places:
            places[name] = (layout.add(name, max(int(np.prod(shape)), 1)), shape)

    for name, shape in (*inputs.items(), *(x for f in host.values() for x in (*f.arguments.items(), (f.name, (f.size,))))):
        place(name, shape)
    of_host, written, sizes = list(places)[len(inputs) :], {}, []
    for name, function in functions.items():
        names = list[str]()

        def listed(*arrays: jax.Array, function=function, names=names) -> list[jax.Array]:
            found = function(host, *arrays)
            names[:] = found
            return list(found.values())

        closed = simplified(traced(listed, given))
        for output, v in zip(names, closed.jaxpr.outvars, strict=True):
            place(output, v.aval.shape)
        pointers = [*inputs, *of_host, *(x for x in names if x not in inputs), "scratch"]
        f = LoweredFunction(f"{name}_text", pointers, 1, in_module=True)
        to = Lowering(f, f.given["scratch"], lower)
        found = to.closed(closed, [Stored(f.given[x], shape, DOUBLE, True) for x, shape in inputs.items()])
        # Results may be inputs: all are copied before the first is written.
        for output, x in zip(names, [to.copied(x) for x in found], strict=True):
            to.fill(Stored(f.given[output], x.shape, DOUBLE, True), x)
        written[name] = f, pointers
        sizes.append(to.size)
    layout.add("scratch", max(sizes))
    entries = []
    for name, (f, pointers) in written.items():
        entry = Function(name, [(POINTER, "work")])
        f.call_in(entry, entry.given["work"], *(entry.const(layout[x], INT) for x in pointers))
        entries.append(entry)
    text = text_of_module(entries, declared=[f"declare void @{name}(ptr)" for name in host])
    return HostedModule(compile_wasm(text, tuple(functions)), places, layout.size)
