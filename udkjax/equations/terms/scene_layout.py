"""The layout of a scene's numbers in the arrays of its programs.

A loop runs one kernel for every element of a group, or for every body. Its table has one row for each element or body: the
indices at which its coordinates, constants, rows of Psi and entries of Psi_q begin in their arrays.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import TypeVar

import jax
import numpy as np

from udkjax.annotations import TreeDef
from udkjax.equations.terms.element_programs import (
    ConstraintPrograms,
    ElementPrograms,
    ForcePrograms,
    RubbingPrograms,
    constraint_programs,
    force_programs,
    rubbing_programs,
)
from udkjax.equations.terms.structure import (
    ElementKind,
    ElementStructure,
    LeafShapes,
    element_kinds,
    element_structure,
    rubbing_joints,
)
from udkjax.expressions import Scalar
from udkjax.expressions.loops.loop_program import KernelWriter
from udkjax.scene.mechanism import Mechanism

# Columns of the table of bodies: start indices of a body's coordinates, of its sine and cosine, and of its constants.
BODY_COORDINATES, SINE, BODY_CONSTANTS = 0, 1, 2
# Columns of the table of a group: start indices of an element's constants, of its entries of Psi_q, of its eliminated rows, and
# of all its rows; then the three columns above for each of its bodies.
OWN_CONSTANTS, ENTRIES, RIGHT, ROW, BODIES = 0, 1, 2, 3, 4
# Columns at the end of the table of a group whose friction depends on its load: start indices of the constants of the friction,
# and of its slopes; before them, if redundant rows share the loads, the index of the first of its redundant rows among these.
RUBBING_CONSTANTS, SLOPES, SHARED = -2, -1, -3
# Indices of constants of the scene. The constants of each body follow: its entries of M^(-1) for x and y, and for the angle.
DROP_TOL, SAFE_TOL, GAINS = 0, 1, 2
PER_BODY, MASS_OR_INERTIA = 2, (0, 0, 1)  # number of entries of a body; indices for x, y and the angle

AnyIndex = TypeVar("AnyIndex", int, np.ndarray)

SOLVES = 4  # maximum number of linear systems in one program
# Arrays of each system: Psi_q M^(-1) Psi_q^T x = right, and jt_x = Psi_q^T x; y = right - sum, where L y = right.
SOLVE_ARRAYS = ("right", "sum", "y", "x", "jt_x")


def arrays_of_solve(solve: int) -> dict[str, str]:
    """Return the names that the arrays of one linear system have in a program."""
    return {name: f"{name}{solve}" for name in SOLVE_ARRAYS}


@dataclass(eq=False, frozen=True)
class ElementGroup:
    """Elements of one structure, with the table of the loops over them."""

    programs: ElementPrograms
    members: np.ndarray  # (elements,) indices among the constraints or force elements
    bodies: np.ndarray  # (bodies of an element, elements)
    table: np.ndarray  # (elements, columns)

    @property
    def coordinates(self) -> int:
        """The number of coordinates that an element depends on."""
        return 3 * len(self.bodies)


@dataclass(eq=False, frozen=True)
class ConstraintGroup(ElementGroup):
    """Constraints of one structure with the same eliminated rows."""

    programs: ConstraintPrograms
    rows: tuple[int, ...] = ()  # the eliminated rows of each constraint
    entry_index: dict[int, int] = field(default_factory=dict)  # index in `psi_q` of each node of Psi_q that is not constant
    rubbing: RubbingPrograms | None = None  # friction that depends on the load
    slope_index: dict[int, int] = field(default_factory=dict)  # index in `slopes` of each node of its slopes
    shared_rows: tuple[int, ...] = ()  # the redundant rows of each constraint that share its loads

    @property
    def loaded_rows(self) -> tuple[int, ...]:
        """The rows whose multipliers determine the loads of friction: the eliminated rows, then the redundant ones."""
        return self.rows + self.shared_rows

    def column(self, from_end: int) -> int:
        """Return the index of a column of the table from its negative index, which counts from the end."""
        return self.table.shape[1] + from_end

    def slope(self, w: KernelWriter, row: int, k: int, base: int = SLOPES) -> Scalar:
        """Return the derivative of component k of the friction's loads by x of a row, read from `slopes` or zero.

        `base` is the column of the table with the start index of an element's slopes; negative: counted from the end.
        """
        s = w.graph.constant(0.0)
        if self.rubbing is not None:
            s = self.rubbing.outputs["slopes"][self.loaded_rows.index(row) * self.coordinates + k]
        if s.is_zero:
            return w.graph.constant(0.0)
        value = w.read("slopes", self.column(base) if base < 0 else base, self.slope_index[s.index])
        return value if s.sign > 0 else -value

    def slopes(self, w: KernelWriter, row: int) -> list[Scalar]:
        """Return the derivatives of all components of the friction's loads by x of a row."""
        return [self.slope(w, row, k) for k in range(self.coordinates)]

    def entry(self, w: KernelWriter, row: int, k: int, base: int = ENTRIES) -> Scalar:
        """Return the entry of Psi_q in a row and for coordinate k of an element: a constant, or read from `psi_q`.

        Loops over the elements have written it there. `base` is the column of the table with the start index of their entries.
        """
        s = self.programs.outputs["psi_q"][row * self.coordinates + k]
        if s.constant is not None:
            return w.graph.constant(s.constant)
        value = w.read("psi_q", base, self.entry_index[s.index])
        return value if s.sign > 0 else -value

    def entries(self, w: KernelWriter, row: int, base: int = ENTRIES) -> list[Scalar]:
        """Return all entries of a row of Psi_q, as `entry` does."""
        return [self.entry(w, row, k, base) for k in range(self.coordinates)]


@dataclass(eq=False, frozen=True)
class ForceGroup(ElementGroup):
    """Force elements of one structure."""

    programs: ForcePrograms


class LoadShares(Enum):
    """Ways in which programs treat redundant rows that share the loads of joints with friction (load_sharing.py).

    `NONE`: no rows share loads. `KNOWN`: the redundant rows are known; the numbers of programs include weights of all rows, from
    which programs compute the shares. `SWITCHED`: the same, but rows of weight zero are left out. `MARKED`: the redundant rows
    are unknown; the numbers include marks, which are negative for redundant rows that share loads, and the programs that
    `RunPrograms.with_shared_rows` returns compute the shares.
    """

    NONE, KNOWN, SWITCHED, MARKED = range(4)

    @property
    def weighs(self) -> bool:
        """True if the numbers of programs include weights of the rows, in place of marks."""
        return self in (LoadShares.KNOWN, LoadShares.SWITCHED)


class SceneLayout:
    """The groups of a scene's elements, and the sizes of all arrays, for one choice of eliminated rows.

    Args:
        mechanism: The scene; only its structure is used.
        redundant_rows: Rows that are not eliminated; None: unknown, so that marks among the numbers select the rows.
        baumgarte: Whether the gains of Baumgarte's stabilization are among the constants.
        every_row: Whether redundant rows are eliminated as well.
        sharing: Treatment of the loads of joints with friction. If it weighs rows, the redundant ones are the `shared` rows.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        redundant_rows: tuple[int, ...] | None,
        baumgarte: bool,
        every_row: bool,
        sharing: LoadShares = LoadShares.NONE,
    ):
        self.gains, self.baumgarte = 2 if baumgarte else 0, baumgarte
        self.body_count = len(mechanism.body_names)
        self.coordinate_count = 3 * self.body_count
        self.gravity = GAINS + self.gains
        self.first_body = self.gravity + 2
        self.constant_count = self.first_body + PER_BODY * self.body_count
        n = self.coordinate_count
        self.sizes = {
            "sines": 2 * self.body_count,
            "sines1": 2 * self.body_count,  # at corrected positions
            "free": n,
            "load": n,
            "z": n,
            "rest": n,
            "nearness": 1,
            "trusted": 1,
            "psi_q": 0,
            "gram": 0,
            "slopes": 0,
        }
        self._eliminated = 0  # number of eliminated rows so far
        self._mechanism, self._loaded = mechanism, bool(mechanism.forces)
        rows = self._find_rows(redundant_rows or ())
        self._rubbing = [None if x is None else element_structure(x, x.bodies) for x in rubbing_joints(mechanism)]
        # Weights of the shared rows, then marks of independent rows, or weights, of the others in the order of elimination.
        self.shared = redundant_rows or () if sharing.weighs and not every_row else ()
        self.marks = self.row_count if redundant_rows is None or sharing.weighs else 0
        self.first_weight = self.constant_count
        self.first_mark = self.first_weight + len(self.shared)
        self.constant_count += self.marks
        may_lack = redundant_rows is None or sharing is LoadShares.SWITCHED
        self.leaves_out_marked = may_lack and bool(self.marks) and not every_row
        self.constraints = [
            self._constraint_group(kind, rows, every_row) for kind in self._kinds(list(zip(rows, self._rubbing, strict=True)))
        ]
        self.rubbing = [group for group in self.constraints if group.rubbing is not None and group.loaded_rows]
        forces = element_kinds(mechanism, list(mechanism.forces.values()))
        self.forces = [self._force_group(kind) for kind in forces]
        self.one = self.reserve("psi_q", 1)
        self.eliminated = [group for group in self.constraints if group.rows]
        self.rolling_rows = tuple(
            sorted(
                start + row
                for group in self.constraints
                for row in range(group.programs.row_count)
                if group.programs.outputs["psi"][row].is_zero
                for start in group.table[:, ROW].tolist()
            )
        )
        self.sizes["pieces"] = 0
        self.pieces = [
            (group, self.reserve("pieces", len(group.table)) + np.arange(len(group.table)))
            for group in (*self.constraints, *self.forces)
            if "piece" in group.programs.outputs
        ]
        self.edges, self.first_edge = [], self.sizes["pieces"]  # shared loads are no results of a run's programs
        for group in self.rubbing if not self.shared else ():
            assert group.rubbing is not None
            count = len(group.rubbing.outputs["edges"])
            if count:
                self.edges.append((group, self.reserve("pieces", count * len(group.table)) + count * np.arange(len(group.table))))
        self.has_piecewise_loads = bool(self.edges) or any(isinstance(group, ForceGroup) for group, _ in self.pieces)
        self.body_table = np.array([[3 * b, 2 * b, self.of_body(b)] for b in range(self.body_count)]).reshape(-1, 3)

    def _kinds(self, labels: Sequence[Hashable] | None = None) -> list[ElementKind]:
        return element_kinds(self._mechanism, list(self._mechanism.constraints.values()), labels)

    def _programs(self, kind: ElementKind) -> ConstraintPrograms:
        return constraint_programs(kind.structure, self.baumgarte, self._loaded)

    def _find_rows(self, redundant_rows: tuple[int, ...]) -> list[tuple[int, ...]]:
        """Set the numbers and names of rows; return, for each constraint, the indices of its rows that are not redundant."""
        sizes = np.zeros(len(self._mechanism.constraints), int)
        for kind in self._kinds():
            sizes[kind.members] = self._programs(kind).row_count
        self.row_starts = np.cumsum([0, *sizes])
        self.row_count = int(self.row_starts[-1])
        names = zip(self._mechanism.constraints, sizes, strict=True)
        self.row_names = [(name, k) for name, size in names for k in range(size)]
        independent = ~np.isin(np.arange(self.row_count), redundant_rows)
        spans = zip(self.row_starts, self.row_starts[1:], strict=False)
        return [tuple(np.flatnonzero(independent[i:j]).tolist()) for i, j in spans]

    def _constraint_group(self, kind: ElementKind, rows: list[tuple[int, ...]], every_row: bool) -> ConstraintGroup:
        programs, size = self._programs(kind), len(kind.members)
        eliminated = tuple(range(programs.row_count)) if every_row else rows[kind.members[0]]
        index: dict[int, int] = {}
        for s in programs.outputs["psi_q"]:
            if s.constant is None:
                index.setdefault(s.index, len(index))
        starts = self._own_constants(programs, size), self.reserve("psi_q", len(index) * size), self._eliminated
        steps = len(programs.constants), len(index), len(eliminated)
        self._eliminated += len(eliminated) * size
        columns = [start + step * np.arange(size) for start, step in zip(starts, steps, strict=True)]
        table = self._table(kind, [*columns, self.row_starts[kind.members]])
        friction = self._rubbing[kind.members[0]]
        if friction is None:
            return ConstraintGroup(programs, kind.members, kind.bodies, table, eliminated, index)
        return self._rubbing_group(programs, kind, table, eliminated, index, friction)

    def _rubbing_group(
        self,
        programs: ConstraintPrograms,
        kind: ElementKind,
        table: np.ndarray,
        eliminated: tuple[int, ...],
        index: dict[int, int],
        friction: ElementStructure,
    ) -> ConstraintGroup:
        first, size = self.row_starts[kind.members], len(kind.members)
        shared = [k for k, row in enumerate(self.shared) if 0 <= row - first[0] < programs.row_count]
        shared_rows = tuple(int(self.shared[k] - first[0]) for k in shared)
        rubbing = rubbing_programs(friction, programs.row_count, eliminated + shared_rows)
        slopes: dict[int, int] = {}
        for s in rubbing.outputs["slopes"]:
            if not s.is_zero:
                slopes.setdefault(s.index, len(slopes))
        starts = self._own_constants(rubbing, size), self.reserve("slopes", len(slopes) * size)
        steps = len(rubbing.constants), len(slopes)
        columns = [start + step * np.arange(size) for start, step in zip(starts, steps, strict=True)]
        if self.shared:
            columns = [np.searchsorted(self.shared, first), *columns]
        table = np.concatenate([table, np.stack(columns, 1)], 1)
        return ConstraintGroup(programs, kind.members, kind.bodies, table, eliminated, index, rubbing, slopes, shared_rows)

    def _force_group(self, kind: ElementKind) -> ForceGroup:
        programs, size = force_programs(kind.structure), len(kind.members)
        constants = self._own_constants(programs, size) + len(programs.constants) * np.arange(size)
        return ForceGroup(programs, kind.members, kind.bodies, self._table(kind, [constants, 0, 0, 0]))

    def _own_constants(self, programs: ElementPrograms, size: int) -> int:
        self.constant_count += len(programs.constants) * size
        return self.constant_count - len(programs.constants) * size

    def _table(self, kind: ElementKind, columns: Sequence[np.ndarray | int]) -> np.ndarray:
        of_bodies = [column for b in kind.bodies for column in (3 * b, 2 * b, self.of_body(b))]
        return np.stack([np.broadcast_to(c, (len(kind.members),)) for c in (*columns, *of_bodies)], 1)

    def of_body(self, body: AnyIndex) -> AnyIndex:
        """Return the index at which the constants of a body, or of several bodies, begin."""
        return self.first_body + PER_BODY * body

    def reserve(self, name: str, count: int) -> int:
        """Reserve room for `count` more numbers in an array; return the index of the first one."""
        self.sizes[name] += count
        return self.sizes[name] - count

    @property
    def row_numbers(self) -> int:
        """The number of rows whose multipliers determine the loads of joints: the shared rows, then the eliminated ones."""
        return len(self.shared) + self._eliminated

    def place_of_row(self, row: int) -> tuple[ConstraintGroup, int, int]:
        """Return the group of a row of Psi, the index of its element within the group, and of the row within the element."""
        for group in self.constraints:
            for i, start in enumerate(group.table[:, ROW].tolist()):
                if 0 <= row - start < group.programs.row_count:
                    return group, i, row - start
        raise IndexError(row)

    def add_solves(self) -> None:
        """Add the arrays of all linear systems of a program; called when the number of eliminated rows is final."""
        self.sizes["factors"] = self.sizes["gram"]
        for k in range(SOLVES):
            self.add_solve(k)

    def add_solve(self, k: int) -> None:
        """Add the arrays of the linear system with the number k."""
        self.sizes |= {f"{name}{k}": self.coordinate_count if name == "jt_x" else self._eliminated for name in SOLVE_ARRAYS}

    @cached_property
    def psi_q_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The entries of Psi_q: their rows, columns, indices in the array `psi_q`, and the factors of the numbers there."""
        blocks = [np.zeros((4, 0))]
        for group in self.constraints:
            for k, s in enumerate(group.programs.outputs["psi_q"]):
                if s.is_zero:
                    continue
                row, coordinate = divmod(k, group.coordinates)
                ones = np.ones(len(group.table))
                index = self.one * ones if s.constant is not None else group.table[:, ENTRIES] + group.entry_index[s.index]
                factor = ones * (s.sign if s.constant is None else s.constant)
                column = group.table[:, BODIES + 3 * (coordinate // 3)] + coordinate % 3
                blocks.append(np.stack([group.table[:, ROW] + row, column, index, factor]))
        row, column, index, factor = np.concatenate(blocks, 1)
        return row.astype(int), column.astype(int), index.astype(int), factor


def abstract_mechanism(tree: TreeDef, shapes: LeafShapes) -> Mechanism:
    """Return the mechanism of a structure, with shapes instead of numbers."""
    return jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*s) for s in shapes])
