"""A long scalar program in pieces: the time to compile one function grows faster than its length."""

from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from udkjax.expressions.scalars.scalar_program import ScalarProgram

LONGEST = 4_000  # operations of a piece; with 2,000, runs take a tenth longer; with 26,000, LLVM takes ten times as long


class ProgramPiece(NamedTuple):
    """A part of a program that is compiled as one function."""

    order: Sequence[int]
    """The nodes that it computes, in order."""
    inputs: Collection[int]
    """The nodes of the program's inputs that it reads."""
    received: Mapping[int, int]
    """The nodes that earlier pieces have computed, with their places in the memory that pieces share."""
    passed: Mapping[int, int]
    """The nodes that later pieces read, with their places."""
    outputs: Sequence[int]
    """The indices of the outputs that it stores."""


def pieces_of(program: ScalarProgram, late: Collection[int] = (), longest: int = LONGEST) -> tuple[list[ProgramPiece], int]:
    """Cut a program into pieces of equal length. Pieces do not pass constants: each writes its own.

    Args:
        program: The program.
        late: Indices of outputs that the last piece has to store, since they replace inputs.
        longest: Maximum number of operations of a piece.

    Returns:
        The pieces, and the number of places in the memory that they share.
    """
    nodes, order = program.graph.nodes, program.order
    count = max(-(-len(order) // longest), 1)
    cuts = [len(order) * k // count for k in range(count + 1)]
    parts = [order[a:b] for a, b in pairwise(cuts)]
    made = {index: k for k, part in enumerate(parts) for index in part if nodes[index].kind != "constant"}
    stored: list[list[int]] = [[] for _ in parts]
    last = len(parts) - 1
    for k, s in enumerate(program.outputs):
        stored[last if k in late else made.get(s.index, last)].append(k)
    reads = [
        dict.fromkeys([a.index for i in part for a in nodes[i].arguments] + [program.outputs[k].index for k in own])
        for part, own in zip(parts, stored, strict=True)
    ]
    until = {index: k for k, own in enumerate(reads) for index in own}  # the last piece that reads each node
    places: dict[int, int] = {}
    free: list[int] = []
    size, pieces = 0, []
    given = {s.index for s in program.inputs}
    for k, part in enumerate(parts):
        received = {index: places[index] for index in reads[k] if made.get(index, k) < k}
        passed = {}
        for index in part:
            if until.get(index, k) > k and index in made:
                if not free:
                    free.append(size)
                    size += 1
                places[index] = passed[index] = free.pop()
        free += [place for index, place in received.items() if until[index] == k]
        # Constants that an earlier piece has computed
        own = {*part}
        constants = [i for i in reads[k] if i not in made and i not in given and i not in own]
        pieces.append(ProgramPiece([*sorted(constants), *part], {i for i in reads[k] if i in given}, received, passed, stored[k]))
    return pieces, size
