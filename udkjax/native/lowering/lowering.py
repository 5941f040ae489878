"""The lowering of jaxprs into one function: memory, loops and branches.

If a loop may end earlier in some lanes than in others, it runs until it ends in all, and a lane that has ended keeps its state.
If lanes may take different branches, each branch that any lane takes is run, and its results are selected in these lanes.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

from udkjax.native.language.ir import BOOL, DOUBLE, INT, POINTER, Function, Value, Variable
from udkjax.native.lowering.arrays import Array, Constant, Index, Lazy, SingleNumber, Stored, base_of, fit
from udkjax.native.lowering.varying import parts_of, places_of_calls, states_of_while, varying, varying_states, without_constants

# Operations of a branch, of the body of a loop or of a call that becomes a function of its own: equal ones are one function,
# and LLVM takes more than in proportion to the length of a function. The instants of a box on two corners with friction take
# 13 s in one function, 2.9 s in functions of more than 60 operations, 3.3 s in those of more than 200.
SEPARATE_FUNCTION_SIZE = 60
UNROLLED_ELEMENTS = 16  # loops over at most this many elements are unrolled
LONGEST_ELEMENT = 40  # an array whose elements take more operations is stored, so that the text of one loop stays short


EquationRule = Callable[["Lowering", Any, list[Array]], list[Array]]


def traced(function: Callable[..., Any], given: Sequence[jax.ShapeDtypeStruct]) -> Any:
    """Return the jaxpr of a function, with constants folded: the same within other traces of JAX, and where `jit` is disabled."""
    with jax.ensure_compile_time_eval(), jax.disable_jit(False):  # without `jit`, loops would be repeated in the text
        return jax.make_jaxpr(function)(*given)


class LoweredFunction(Function):
    """A function with its own tables of constants.

    Args:
        name: The name of the function.
        pointers: The names of its arguments, addresses of arrays.
        width: The number of lanes.
        in_module: Whether it can call functions of a module. The arguments are then the pointer `work` to the memory of the
            module, and indices there in place of `pointers`.
    """

    def __init__(self, name: str, pointers: Sequence[str], width: int, in_module: bool = False):
        super().__init__(name, [(POINTER, "work")] * in_module + [(INT if in_module else POINTER, x) for x in pointers], width)
        for x in pointers if in_module else ():
            self.given[x] = self.at(self.given["work"], self.given[x])
        self.tables: list[str] = []
        self.noinline = True

    def text(self, local: Any = None) -> str:
        return "".join(f"{line.replace('@table', f'@{self.name}.table')}\n" for line in self.tables) + super().text(
            local
        ).replace("@table", f"@{self.name}.table")

    @property
    def parts(self) -> tuple[list[str], ...]:
        """The lines of the function's text, for `of_parts`."""
        return self._lines, self._reserved, self.tables, sorted(self.declared)

    @classmethod
    def of_parts(
        cls, name: str, pointers: Sequence[str], width: int, in_module: bool, parts: Sequence[list[str]]
    ) -> "LoweredFunction":
        """Return a function with the `parts` of a function that calls no lowered functions, for example one from the cache."""
        f = cls(name, pointers, width, in_module)
        f._lines, f._reserved, f.tables, declared = parts
        f.declared = set(declared)
        return f

    def call_in(self, f: Function, *arguments: Value):
        """Call this function in the function `f`, whose module then has to define it."""
        f.evaluated |= self.evaluated | {self.name: self}
        f.call(self.name, *arguments)


class Lowering:
    """The lowering of jaxprs into one function.

    Args:
        f: The function.
        scratch: The address of its memory; `size` is the number of elements that it takes, each in all lanes.
        lower: The function that lowers one equation (`rules.lower`).
    """

    def __init__(self, f: LoweredFunction, scratch: Value, lower: EquationRule):
        self.f, self._scratch, self._lower, self.size = f, scratch, lower, 0
        self._tables: dict[tuple[bytes, str], Value] = {}

    # --- arrays

    def constant(self, numbers: Any) -> Constant:
        return Constant(numbers, self._table)

    def _table(self, numbers: np.ndarray) -> Stored:
        """Return an array of numbers in a table of constants of the function, which equal numbers share."""
        base, key = base_of(numbers.dtype), (numbers.tobytes(), str(numbers.dtype))
        if key not in self._tables:
            name, stored = f"@table{len(self._tables)}", DOUBLE if base == DOUBLE else INT
            texts = ", ".join(f"{stored} {self.f.const(x, stored).name}" for x in numbers.ravel())
            self.f.tables.append(f"{name} = private constant [{numbers.size} x {stored}] [{texts}], align 64")
            self._tables[key] = Value(self.f, name, POINTER)
        return Stored(self._tables[key], numbers.shape, base, False)

    def new(self, shape: Sequence[int], base: str, varies: bool) -> Stored:
        """Return an array in new memory, whose elements are not yet set."""
        address = self.f.at(self._scratch, self.size * self.f.width)
        self.size += int(np.prod(shape))
        return Stored(address, shape, base, varies)

    def stored(self, x: Array) -> Array:
        """Return an array whose elements need no further operations: x itself, or a copy of x in memory."""
        if isinstance(x, SingleNumber | Stored | Constant):
            return x
        return self.copied(x)

    def copied(self, x: Array) -> Array:
        """Return a copy of an array in new memory; a single number is in registers."""
        if not x.shape:
            return SingleNumber(fit(self.f, x.read(self.f, ()), x.varies), x.varies)
        to = self.new(x.shape, x.base, x.varies)
        self.fill(to, x)
        return to

    def fill(self, to: Stored, x: Array):
        """Compute all elements of x, and store them in the array `to`."""
        self.each(x.shape, lambda index: to.write(self.f, index, x.read(self.f, index)))

    def each(self, shape: Sequence[int], do: Callable[[Index], None], index: Index = (), most: int = UNROLLED_ELEMENTS):
        """Run the code of `do` for all indices of a shape, after `index`; loops over at most `most` indices are unrolled."""
        if not shape:
            do(index)
        elif int(np.prod(shape)) <= most:
            for rest in np.ndindex(*shape):
                do((*index, *rest))
        else:
            with self.f.each(shape[0]) as i:
                self.each(shape[1:], do, (*index, i), most)

    # --- jaxprs

    def closed(self, closed: Any, given: Sequence[Array]) -> list[Array]:
        """Lower a jaxpr with its constants; return its outputs."""
        return self.run(without_constants(closed), [self.constant(c) for c in getattr(closed, "consts", ())], given)

    def run(self, jaxpr: Any, constants: Sequence[Array], given: Sequence[Array]) -> list[Array]:
        uses = Counter(a for e in jaxpr.eqns for a in e.invars if not isinstance(a, core.Literal))
        uses.update(a for a in jaxpr.outvars if not isinstance(a, core.Literal))
        values: dict[Any, Array] = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *given), strict=True))

        def value(a: Any) -> Array:
            aval: Any = a.aval
            return self.constant(np.asarray(a.val, aval.dtype)) if isinstance(a, core.Literal) else values[a]

        for equation in jaxpr.eqns:
            found = self._lower(self, equation, [value(a) for a in equation.invars])
            for variable, x in zip(equation.outvars, found, strict=True):
                is_dear = (uses[variable] > 1 and x.cost > 0) or x.cost > LONGEST_ELEMENT or not x.shape
                values[variable] = self.stored(x) if is_dear and variable in uses else x
        return [value(a) for a in jaxpr.outvars]

    # --- loops and branches

    def scan(
        self, body: Any, constants: Sequence[Array], start: Sequence[Array], rows: Sequence[Array], length: int, reverse: bool
    ) -> list[Array]:
        """Lower a loop over the rows of arrays (`jax.lax.scan`); return the last states and the stacked outputs."""
        f = self.f
        constants, rows = [self.stored(x) for x in constants], [self.stored(x) for x in rows]
        of_constants, of_rows = [x.varies for x in constants], [x.varies for x in rows]
        flags = varying_states(body, of_constants, [x.varies for x in start], of_rows)
        states = [LoopState(self, x.shape, x.base, flag, x) for x, flag in zip(start, flags, strict=True)]
        everywhere = varying(body, [*of_constants, *flags, *of_rows])[len(states) :]
        avals = [v.aval for v in without_constants(body).outvars[len(states) :]]
        found = [self.new((length, *v.shape), base_of(v.dtype), flag) for v, flag in zip(avals, everywhere, strict=True)]
        with f.each(length) as k:
            i = (length - 1) - k if reverse else k
            outs = self.part(body, [*constants, *(s.value() for s in states), *(row_of(f, x, i) for x in rows)])
            for to, x in zip(found, outs[len(states) :], strict=True):
                self.each(x.shape, lambda index, to=to, x=x: to.write(f, (i, *index), x.read(f, index)))
            self.move(states, outs[: len(states)])
        return [*(s.value() for s in states), *found]

    def while_(
        self, test: Any, body: Any, of_test: Sequence[Array], of_body: Sequence[Array], start: Sequence[Array]
    ) -> list[Array]:
        """Lower a loop that runs while a condition holds in any lane (`jax.lax.while_loop`); return the last states."""
        f = self.f
        of_test, of_body = [self.stored(x) for x in of_test], [self.stored(x) for x in of_body]
        given = [x.varies for x in of_test], [x.varies for x in of_body], [x.varies for x in start]
        flags = states_of_while(test, body, *given)
        parts = varying(test, [*given[0], *flags])[0]
        states = [LoopState(self, x.shape, x.base, flag, x) for x, flag in zip(start, flags, strict=True)]
        active: list[Value] = []

        def goes_on() -> Value:
            active.append(fit(f, self.closed(test, [*of_test, *(s.value() for s in states)])[0].read(f, ()), parts))
            return f.any_of(active[0])

        with f.while_(goes_on):
            outs = self.part(body, [*of_body, *(s.value() for s in states)])
            self.move(states, outs, active[0] if parts else None)
        return [s.value() for s in states]

    def cond(self, which: Array, branches: Sequence[Any], operands: Sequence[Array]) -> list[Array]:
        """Lower branches, of which those run that any lane takes (`jax.lax.switch`); return the results."""
        if isinstance(which, Constant):
            return self.closed(branches[min(max(int(which.numbers), 0), len(branches) - 1)], operands)
        f, index, last = self.f, which.read(self.f, ()), len(branches) - 1
        operands = [self.stored(x) for x in operands]
        flags = [varying(branch, [x.varies for x in operands]) for branch in branches]
        avals = [v.aval for v in without_constants(branches[0]).outvars]
        states = [
            LoopState(self, v.shape, base_of(v.dtype), which.varies or any(x))
            for v, x in zip(avals, zip(*flags, strict=True), strict=True)
        ]
        for k, branch in enumerate(branches):
            if index.base == BOOL:
                chosen = index if k else ~index
            else:
                chosen = index <= 0 if k == 0 else index >= k if k == last else index.is_(k)
            with f.if_(f.any_of(chosen)):
                self.move(states, self.part(branch, operands), chosen if which.varies else None)
        return [s.value() for s in states]

    def part(self, closed: Any, given: Sequence[Array]) -> list[Array]:
        """Lower a jaxpr with its constants, as a function of its own if it is long; return its outputs."""
        return self._apart(closed, given) if operations(closed) > SEPARATE_FUNCTION_SIZE else self.closed(closed, given)

    def _apart(self, closed: Any, given: Sequence[Array]) -> list[Array]:
        """Lower a jaxpr as a separate function, and call it; return the outputs. Functions with equal texts are one function."""
        f, in_module = self.f, "work" in self.f.given
        known = [x if isinstance(x, Constant) else self._in_memory(x) for x in given]
        memory = {f"in{k}": x for k, x in enumerate(known) if isinstance(x, Stored)}
        flags, places = varying(closed, [x.varies for x in known]), sorted(places_of_calls(closed)) if in_module else []
        avals = [v.aval for v in without_constants(closed).outvars]
        outs = [self.new(v.shape, base_of(v.dtype), flag) for v, flag in zip(avals, flags, strict=True)]
        pointers = [*memory, *places, *(f"out{k}" for k in range(len(outs))), "scratch"]
        own = LoweredFunction("part", pointers, f.width, in_module)
        to = Lowering(own, own.given["scratch"], self._lower)
        inner = [to.constant(x.numbers) if isinstance(x, Constant) else x.at(own.given[f"in{k}"]) for k, x in enumerate(known)]
        for k, x in enumerate(to.closed(closed, inner)):
            to.fill(outs[k].at(own.given[f"out{k}"]), x)
        own.name = f"part_{hashlib.sha256(own.text().encode()).hexdigest()[:16]}"
        scratch = self.new((to.size,), DOUBLE, True)
        addresses = [*(x.pointer for x in memory.values()), *(f.given[x] for x in places), *(x.pointer for x in (*outs, scratch))]
        if in_module:
            work = f.given["work"]
            own.call_in(f, work, *(f.distance(work, x) for x in addresses))
        else:
            own.call_in(f, *addresses)
        return list(outs)

    def _in_memory(self, x: Array) -> Stored:
        """Return x itself if it is in memory, else a copy in memory, also for single numbers and constants."""
        x = self.stored(x)
        if isinstance(x, Stored):
            return x
        to = self.new(x.shape, x.base, x.varies)
        self.fill(to, x)
        return to

    def move(self, states: Sequence["LoopState"], nodes: Sequence[Array], mask: Value | None = None):
        """Assign the values `nodes` to all states at once, in the lanes of a mask; None: in all lanes."""
        places = {s.memory.pointer.name for s in states if s.memory is not None}
        known = []
        for x in nodes:
            is_state = isinstance(x, Stored) and x.pointer.name in places
            known.append(self.copied(x) if is_state else self.stored(x))
        for s, x in zip(states, known, strict=True):
            s.assign(x, mask)


def operations(jaxpr: Any) -> int:
    """Return the number of operations of a jaxpr; those within a loop or a branch count once."""
    return sum(1 + sum(map(operations, parts_of(e))) for e in without_constants(jaxpr).eqns)


class LoopState:
    """An array that a loop or a branch assigns: a variable if it is a single number, else memory."""

    def __init__(self, to: Lowering, shape: Sequence[int], base: str, varies: bool, start: Array | None = None):
        self._in, self.shape, self.base, self.varies = to, tuple(shape), base, varies
        self.memory: Stored | None = None
        f, nothing = to.f, {DOUBLE: 0.0, INT: 0, BOOL: False}[base]
        if not self.shape:
            first = nothing if start is None else fit(f, start.read(f, ()), varies)
            self._variable: Variable = f.variable(first, base, f.width if varies else 1)
            return
        self.memory = to.new(shape, base, varies)
        if start is not None:
            to.fill(self.memory, start)

    def value(self) -> Array:
        """Return the present value of the state."""
        return SingleNumber(self._variable.value, self.varies) if self.memory is None else self.memory

    def assign(self, x: Array, mask: Value | None = None):
        """Set the value of the state, in the lanes of a mask; None: in all lanes."""
        f, memory = self._in.f, self.memory
        if memory is None:
            new = fit(f, x.read(f, ()), self.varies)
            self._variable.value = new if mask is None else f.select(mask, new, self._variable.value)
            return

        def put(index: Index):
            new = x.read(f, index)
            memory.write(f, index, new if mask is None else f.select(mask, new, memory.read(f, index)))

        self._in.each(self.shape, put)


def row_of(f: Function, x: Array, i: Value) -> Array:
    """Return row i of an array, whose elements are read where they are used."""
    return Lazy(x.shape[1:], x.base, [x], lambda index: x.read(f, (i, *index)))
