"""The programs of a scene at rest: loads of force elements, their derivatives, and the curvature of constraints under load.

    K = -F_q + (lambda^T Psi)_qq,        C = -F_v.

An element writes the nonzero entries of its own blocks of these matrices. Where they belong in the whole matrices is known when
the scene is built, so that statics needs neither traces nor compilation.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from udkjax.equations.terms.scene_layout import BODIES, BODY_COORDINATES, ROW, ConstraintGroup, ElementGroup
from udkjax.equations.terms.scene_terms import ProgramParts, SceneTerms, compliance
from udkjax.expressions import KernelWriter, LoopProgram, Scalar, tangents
from udkjax.expressions.loops.loop_program import ADD, KernelLoop, Reset

LOADS, STIFFNESS, DAMPING, CURVATURE = "loads_at_rest", "stiffness", "damping", "curvature"
REDUCED = "reduced"  # u^T M u, u^T K u and u^T C u
OF_LOADS = LOADS, STIFFNESS, DAMPING


class EntryPlaces(NamedTuple):
    """The rows and columns of the entries that elements write to an array."""

    rows: np.ndarray
    columns: np.ndarray


class RestProgram(NamedTuple):
    """Programs of a scene at rest.

    `loads` computes the loads of force elements, from t, q and v, and their negative derivatives by q and v; `curvature` the
    second derivatives of lambda^T Psi, from the array `multipliers` of all rows. `reduction` computes u^T M u, u^T K u and
    u^T C u of the array u = `dq1` from these, with the negative multipliers.
    """

    loads: LoopProgram
    curvature: LoopProgram
    reduction: LoopProgram
    places: dict[str, EntryPlaces]  # of the entries in each array

    def of(self, *outputs: str) -> LoopProgram:
        """Return the program that computes the arrays `outputs`: `curvature` if this is the only one, else `loads`."""
        return self.curvature if outputs == (CURVATURE,) else self.loads

    @property
    def sizes(self) -> dict[str, int]:
        """The number of entries of each array that elements write, by name."""
        return {name: len(place.rows) for name, place in self.places.items()}


class _Entries:
    """The places of the entries of an array, collected from the elements that write them."""

    def __init__(self):
        self._rows, self._columns, self.size = [np.zeros(0, int)], [np.zeros(0, int)], 0

    def add(self, group: ElementGroup, places: Sequence[tuple[int, int]]) -> np.ndarray:
        """Add entries at (row, column) of each element's own block; return the index of each element's first entry."""
        start = self.size + len(places) * np.arange(len(group.table))
        coordinates = [group.table[:, BODIES + 3 * (k // 3) + BODY_COORDINATES] + k % 3 for k in range(group.coordinates)]
        for target, k in ((self._rows, 0), (self._columns, 1)):
            ordered = [coordinates[place[k]] for place in places]
            target.append(np.stack(ordered, 1).ravel() if ordered else np.zeros(0, int))
        self.size += len(places) * len(group.table)
        return start

    def places(self) -> EntryPlaces:
        return EntryPlaces(np.concatenate(self._rows), np.concatenate(self._columns))


def write_rest_program(terms: SceneTerms) -> RestProgram:
    """Return the programs of a scene at rest."""
    entries = {name: _Entries() for name in (LOADS, STIFFNESS, DAMPING, CURVATURE)}
    loads = [*([terms.sincos()] if terms.layout.forces else []), *_write_loads(terms, entries)]
    curvature = [terms.sincos(), *_write_curvature(terms, entries[CURVATURE])]
    places = {name: x.places() for name, x in entries.items()}
    reduction = LoopProgram(list(_write_reduction(terms, places)))
    return RestProgram(LoopProgram(loads), LoopProgram(curvature), reduction, places)


def _write_loads(terms: SceneTerms, entries: dict[str, _Entries]) -> ProgramParts:
    for group in terms.layout.forces:
        programs = group.programs
        loads = programs.outputs["loads"]
        blocks = {LOADS: {(k, k): s for k, s in enumerate(loads) if not s.is_zero}}
        blocks |= {name: _derivatives(loads, variables) for name, variables in ((STIFFNESS, programs.q), (DAMPING, programs.v))}
        blocks = {name: {place: s if name == LOADS else -s for place, s in block.items()} for name, block in blocks.items()}
        starts = [entries[name].add(group, list(block)) for name, block in blocks.items()]
        base = group.table.shape[1]

        def write(w: KernelWriter, blocks: dict = blocks, base: int = base):
            for column, (name, block) in enumerate(blocks.items(), base):
                for k, s in enumerate(block.values()):
                    w.write(s, name, column, k)

        loop = terms.over_group(LOADS, group, write)
        yield loop._replace(table=np.column_stack([group.table, *starts]))


def _write_curvature(terms: SceneTerms, entries: _Entries) -> ProgramParts:
    for group in terms.layout.constraints:
        base = group.table.shape[1]
        graph, pull = group.programs.graph, [group.programs.graph.constant(0.0)] * group.coordinates
        multipliers = [graph.input(("multiplier", row), "multiplier") for row in range(group.programs.row_count)]
        for index, entry in enumerate(group.programs.outputs["psi_q"]):
            row, k = divmod(index, group.coordinates)
            pull[k] = pull[k] + multipliers[row] * entry
        block = _derivatives(pull, group.programs.q)

        def write(w: KernelWriter, group: ConstraintGroup = group, block: dict = block, base: int = base, given=multipliers):
            for row, s in enumerate(given):
                w.bind(s, "multipliers", ROW, row)
            for k, s in enumerate(block.values()):
                w.write(s, CURVATURE, base, k)

        start = entries.add(group, list(block))
        if block:
            loop = terms.over_group(CURVATURE, group, write)
            yield loop._replace(table=np.column_stack([group.table, start]))


def _write_reduction(terms: SceneTerms, places: dict[str, EntryPlaces]) -> ProgramParts:
    yield Reset(REDUCED, 0, 3)

    def add_mass(w: KernelWriter):
        for k in range(3):
            u = w.read("dq1", BODY_COORDINATES, k)
            w.write(u * u / compliance(w, k), REDUCED, None, 0, ADD)

    yield terms.over_bodies(("reduced", "mass"), add_mass)
    for name, place, sign in ((STIFFNESS, 1, 1.0), (CURVATURE, 1, -1.0), (DAMPING, 2, 1.0)):

        def add(w: KernelWriter, name: str = name, place: int = place, sign: float = sign):
            entry = w.read(name, 0) * w.graph.constant(sign)
            w.write(entry * w.read("dq1", 1) * w.read("dq1", 2), REDUCED, None, place, ADD)

        rows, columns = places[name]
        if len(rows):
            yield KernelLoop(terms.kernel(("reduced", name), add), np.stack([np.arange(len(rows)), rows, columns], 1))


def _derivatives(outputs: Sequence[Scalar], variables: Iterable[Scalar]) -> dict[tuple[int, int], Scalar]:
    """Return the nonzero derivatives of outputs with respect to variables, by the indices (output, variable)."""
    graph, found = outputs[0].graph, {}
    for k, variable in enumerate(variables):
        for i, s in enumerate(tangents(graph, outputs, {variable: graph.constant(1.0)})):
            if not s.is_zero:
                found[i, k] = s
    return found
