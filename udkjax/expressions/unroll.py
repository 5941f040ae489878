"""Write a program of loops out: as expressions of one graph, on arrays of scalars.

A number that is stored and read again passes as an argument then, not through memory. Equal expressions of different elements are
one node, and what is zero vanishes, as everywhere in a graph.
"""

from collections.abc import Callable, Collection, Mapping

from udkjax.expressions.differential import Row, accumulate, product
from udkjax.expressions.graph import Graph, Scalar
from udkjax.expressions.loop_program import ADD, ALL, MAXIMUM, LoopProgram, Reset
from udkjax.expressions.selection import both, maximum

Arrays = dict[str, dict[int, Scalar]]  # the numbers of each array, by their places; all others are zero


Place = tuple[str, int]  # a number: its array, and its place there


class _Joined(list[Scalar]):
    """Numbers of which the largest, or the conjunction, is asked for: joined by halves, so that few wait for others."""

    def __init__(self, join: Callable[[Scalar, Scalar], Scalar], first: Scalar | None):
        super().__init__([] if first is None else [first])
        self.join = join

    def value(self) -> Scalar:
        found = list(self)
        while len(found) > 1:
            found = [*map(self.join, found[::2], found[1::2]), *found[len(found) // 2 * 2 :]]
        return found[0]


def unroll(program: LoopProgram, arrays: Mapping[str, Mapping[int, Scalar]], graph: Graph, linear: str | None = None) -> Arrays:
    """Return the arrays as a program leaves them; the given arrays stay as they are.

    Args:
        program: The program.
        arrays: Its inputs by array.
        graph: The graph of all scalars.
        linear: A group of inputs in which the program is linear, such as tangents: a sum has one product for each number that it
            depends on, whose coefficients are added up beforehand.
    """
    found: dict[str, dict[int, Scalar]] = {name: dict(x) for name, x in arrays.items()}
    joined: dict[Place, _Joined] = {}
    zero = graph.constant(0.0)

    # Places that numbers were added to since they were read, in order: equal programs are equal texts, which are compiled once.
    sums: dict[Place, None] = {}
    atoms: set[int] = set()  # numbers of a linear program that sums are combinations of

    def read(name: str, place: int) -> Scalar:
        if (name, place) in joined:
            found.setdefault(name, {})[place] = joined.pop((name, place)).value()
        s = found.get(name, {}).get(place, zero)
        if (name, place) in sums:
            del sums[name, place]
            if linear in s.node.depends:
                s = found[name][place] = collect(s, linear, atoms)
        if linear in s.node.depends:
            atoms.add(s.index)
        return s

    for part in program.parts:
        if isinstance(part, Reset):
            value = graph.constant(part.value)
            places = range(part.start, part.start + part.count)
            found.setdefault(part.array, {}).update(dict.fromkeys(places, value))
            for place in places:
                joined.pop((part.array, place), None)
            continue
        inputs = [(s, part.array(x.array), x) for s, x in zip(part.kernel.program.inputs, part.kernel.inputs, strict=True)]
        inputs = [(s.index, name, x) for s, name, x in inputs if part.kernel.program.uses(s)]
        outputs = [(part.array(x.array), x) for x in part.kernel.outputs]
        for row in part.table.tolist():
            known = {s: read(name, x.offset + (0 if x.base is None else row[x.base])) for s, name, x in inputs}
            for value, (name, x) in zip(graph.copy(part.kernel.program, known), outputs, strict=True):
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
                    found.setdefault(name, {})[place] = found.get(name, {}).get(place, zero) + value
                    sums[name, place] = None
                else:
                    found.setdefault(name, {})[place] = value
                    sums.pop((name, place), None)
                    if linear in value.node.depends:
                        atoms.add(value.index)
    for name, place in [*sums, *joined]:
        read(name, place)
    return found


def collect(s: Scalar, group: str, atoms: Collection[int]) -> Scalar:
    """Return a linear combination of atoms, and of inputs of a group, with one product for each."""
    graph, one = s.graph, s.graph.constant(1.0)
    forms: dict[int, Row] = {}

    def form(a: Scalar, factor: Scalar) -> tuple[Row, Scalar]:
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
            is_factored = one_side.index in forms and one_side.node.kind != "mul"  # a sum with a factor taken out stays as it is
            if is_factored or group in factor.node.depends:
                continue
            accumulate(total, *form(one_side, factor))
        forms[index] = total
    row, factor = form(s, one)
    return product(row, {k: Scalar(graph, k) for k in row}, graph) * factor
