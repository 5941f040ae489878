"""Unroll a loop program into expressions of one graph, on arrays of scalars.

A number that is stored and read again becomes an argument instead of passing through memory. Equal expressions of different
elements become one node, and zeros vanish, as everywhere in a graph.
"""

from collections.abc import Callable, Collection, Mapping

from udkjax.expressions.algebra.differential import SparseRow, accumulate, product
from udkjax.expressions.loops.loop_program import ADD, ALL, MAXIMUM, LoopProgram, Reset
from udkjax.expressions.scalars.graph import Graph, Scalar
from udkjax.expressions.scalars.selection import both, maximum

Arrays = dict[str, dict[int, Scalar]]  # the nonzero numbers of each array by index


ArrayPlace = tuple[str, int]  # the name of an array and an index into it


class _Joined(list[Scalar]):
    """Numbers whose maximum or conjunction is computed by a balanced tree, to keep chains of dependent operations short."""

    def __init__(self, join: Callable[[Scalar, Scalar], Scalar], first: Scalar | None):
        super().__init__([] if first is None else [first])
        self.join = join

    def value(self) -> Scalar:
        numbers = list(self)
        while len(numbers) > 1:
            numbers = [*map(self.join, numbers[::2], numbers[1::2]), *numbers[len(numbers) // 2 * 2 :]]
        return numbers[0]


def unroll(program: LoopProgram, arrays: Mapping[str, Mapping[int, Scalar]], graph: Graph, linear: str | None = None) -> Arrays:
    """Return the arrays after a run of the program; the given arrays do not change.

    Args:
        program: The program.
        arrays: The nonzero numbers of each array before the run, by index.
        graph: The graph of all scalars.
        linear: A group of inputs in which the program is linear, such as tangents: the coefficients of each input are added up
            first, so that a sum has only one product for each number on which it depends. None: no such group.
    """
    results: dict[str, dict[int, Scalar]] = {name: dict(x) for name, x in arrays.items()}
    joined: dict[ArrayPlace, _Joined] = {}
    zero = graph.constant(0.0)

    # Places that have been added to since they were last read. A dict keeps their order: equal programs are compiled once.
    sums: dict[ArrayPlace, None] = {}
    atoms: set[int] = set()  # nodes of a linear program that sums combine

    def read(name: str, place: int) -> Scalar:
        if (name, place) in joined:
            results.setdefault(name, {})[place] = joined.pop((name, place)).value()
        s = results.get(name, {}).get(place, zero)
        if (name, place) in sums:
            del sums[name, place]
            if linear in s.node.depends:
                s = results[name][place] = collect(s, linear, atoms)
        if linear in s.node.depends:
            atoms.add(s.index)
        return s

    for part in program.parts:
        if isinstance(part, Reset):
            value = graph.constant(part.value)
            places = range(part.start, part.start + part.count)
            results.setdefault(part.array, {}).update(dict.fromkeys(places, value))
            for place in places:
                joined.pop((part.array, place), None)
            continue
        inputs = [(s, part.array(x.array), x) for s, x in zip(part.kernel.program.inputs, part.kernel.inputs, strict=True)]
        inputs = [(s.index, name, x) for s, name, x in inputs if part.kernel.program.uses(s)]
        outputs = [(part.array(x.array), x) for x in part.kernel.outputs]
        for row in part.table.tolist():
            inputs_of_row = {s: read(name, x.offset + (0 if x.base is None else row[x.base])) for s, name, x in inputs}
            for value, (name, x) in zip(graph.copy(part.kernel.program, inputs_of_row), outputs, strict=True):
                place = x.offset + (0 if x.base is None else row[x.base])
                if x.update in (MAXIMUM, ALL):
                    key = name, place
                    if key not in joined:
                        first = read(name, place)
                        joined[key] = _Joined(
                            maximum if x.update == MAXIMUM else both, None if first.constant is not None else first
                        )
                    joined[key].append(value)
                elif x.update == ADD:
                    results.setdefault(name, {})[place] = results.get(name, {}).get(place, zero) + value
                    sums[name, place] = None
                else:
                    results.setdefault(name, {})[place] = value
                    sums.pop((name, place), None)
                    if linear in value.node.depends:
                        atoms.add(value.index)
    for name, place in [*sums, *joined]:
        read(name, place)
    return results


def collect(s: Scalar, group: str, atoms: Collection[int]) -> Scalar:
    """Return a scalar, rewritten as a linear combination of nodes `atoms` and of inputs of a group, with one product for each."""
    graph, one = s.graph, s.graph.constant(1.0)
    forms: dict[int, SparseRow] = {}

    def form(a: Scalar, factor: Scalar) -> tuple[SparseRow, Scalar]:
        return forms.get(a.index, {a.index: one}), factor if a.sign > 0 else -factor

    for index in graph.dependencies([s.index], atoms, group):
        node, total = graph.nodes[index], {}
        if node.kind not in ("add", "sub", "mul"):
            continue
        a, b = node.arguments
        if node.kind != "mul":
            accumulate(total, *form(a, one))
            accumulate(total, *form(b, one if node.kind == "add" else -one))
        else:
            one_side, factor = (a, b) if group in a.node.depends else (b, a)
            is_factored = one_side.index in forms and one_side.node.kind != "mul"  # a factored sum stays as it is
            if is_factored or group in factor.node.depends:
                continue
            accumulate(total, *form(one_side, factor))
        forms[index] = total
    row, factor = form(s, one)
    return product(row, {k: Scalar(graph, k) for k in row}, graph) * factor
