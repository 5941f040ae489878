"""The prologue of a scene: the program of all constants that depend only on its numbers, which runs once for each run."""

from collections.abc import Sequence

import jax
import numpy as np

from udkjax.equations.terms.element_programs import ConstraintPrograms, ElementPrograms
from udkjax.equations.terms.scene_layout import (
    DROP_TOL,
    GAINS,
    OWN_CONSTANTS,
    RIGHT,
    ROW,
    RUBBING_CONSTANTS,
    SAFE_TOL,
    ConstraintGroup,
    ElementGroup,
    SceneLayout,
)
from udkjax.equations.terms.structure import Element, rubbing_joints
from udkjax.expressions.loops.loop_program import KernelLoop, KernelWriter, LoopProgram
from udkjax.scene.mechanism import Mechanism


def write_prologue(layout: SceneLayout, places: Mechanism, number_count: int) -> LoopProgram:
    """Write the program that computes the array `constants` from the array `numbers`.

    Args:
        layout: Layout of the constants.
        places: The scene, with each number replaced by its index in `numbers`.
        number_count: Number of numbers of the scene; the gains, the marks of rows, `drop_tol` and `safe_tol` follow them.

    Returns:
        Loops over the bodies and over the elements of each group.
    """
    scene = KernelWriter()
    copies = [(GAINS + k, number_count + k) for k in range(layout.gains)]
    copies += [(k, number_count + layout.gains + layout.marks + k) for k in (DROP_TOL, SAFE_TOL)]
    copies += [(layout.gravity + k, int(source)) for k, source in enumerate(np.ravel(places.gravity))]
    for target, source in copies:
        scene.write(scene.read("numbers", None, source), "constants", None, target)
    body = KernelWriter()
    for k in range(2):
        body.write(1.0 / body.read("numbers", k), "constants", 2, k)
    bodies = [[int(b.mass), int(b.inertia), layout.of_body(k)] for k, b in enumerate(places.bodies.values())]
    loops = [KernelLoop(scene.kernel(), np.zeros((1, 1), int)), KernelLoop(body.kernel(), np.array(bodies).reshape(-1, 3))]
    constraints, forces = list(places.constraints.values()), list(places.forces.values())
    rubbing = rubbing_joints(places)
    loops += [_group_constants(layout, group, constraints) for group in layout.constraints]
    loops += [_constants(layout, group, group.rubbing, rubbing, group.column(RUBBING_CONSTANTS)) for group in layout.rubbing]
    loops += [_group_constants(layout, group, forces) for group in layout.forces]
    if layout.marks:
        start = number_count + layout.gains
        loops += [_marks(layout, group, start) for group in layout.constraints if group.rows]
        loops += [_weights(layout, start)] if layout.shared else []
    return LoopProgram(loops)


def _marks(layout: SceneLayout, group: ConstraintGroup, start: int) -> KernelLoop:
    w = KernelWriter()
    for i, row in enumerate(group.rows):
        w.write(w.read("numbers", ROW, start + row), "constants", RIGHT, layout.first_mark + i)
    return KernelLoop(w.kernel(), group.table)


def _weights(layout: SceneLayout, start: int) -> KernelLoop:
    w = KernelWriter()
    w.write(w.read("numbers", 0, start), "constants", 1, layout.first_weight)
    return KernelLoop(w.kernel(), np.array([[row, k] for k, row in enumerate(layout.shared)]))


def _group_constants(layout: SceneLayout, group: ElementGroup, elements: Sequence[Element]) -> KernelLoop:
    return _constants(layout, group, group.programs, elements, OWN_CONSTANTS)


def _constants(
    layout: SceneLayout, group: ElementGroup, programs: ElementPrograms | None, elements: Sequence[Element | None], to: int
) -> KernelLoop:
    """Return the loop that computes the constants of each element; column `to` of the table has their start indices."""
    assert programs is not None
    table = group.table
    members = [jax.tree.leaves(elements[i]) for i in group.members]
    starts = np.array([[np.ravel(x)[0] if np.size(x) else 0 for x in leaves] for leaves in members], int)
    w, columns = KernelWriter(programs.graph), table.shape[1]
    for k, leaf in enumerate(programs.leaves):
        for index, s in enumerate(leaf.flat):
            w.bind(s, "numbers", columns + k, index)
    if isinstance(programs, ConstraintPrograms):
        for k, s in enumerate([*programs.gains, *programs.gravity]):
            w.bind(s, "constants", None, (GAINS if layout.gains else layout.gravity) + k)
    for k, s in enumerate(programs.constants):
        w.write(s, "constants", to, k)
    return KernelLoop(w.kernel(), np.concatenate([table, starts.reshape(len(members), -1)], 1))
