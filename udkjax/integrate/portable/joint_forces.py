"""Forces of joints as sums over the solution of the linear system: what a page needs to find them.

The load of a constraint on a body is -Psi_q^T lambda = Psi_q^T x, with x the solution for its rows. It is unique where no row is
redundant; where rows are left out, a share of them would be a choice.
"""

from typing import Any

import numpy as np

from udkjax.equations.scene_programs import ScenePrograms
from udkjax.scene.bodies import GROUND
from udkjax.scene.mechanism import Mechanism

Json = dict[str, Any]


def joint_forces(mechanism: Mechanism, code: ScenePrograms) -> list[Json]:
    """Return for each constraint at a point how the force on its second body is found (its first one, where that is the ground).

    Args:
        mechanism: The scene.
        code: Its programs, of all rows.

    Returns:
        A list of {constraint, x, y}; the force (N) along each axis of the ground is the sum of x0[i] psi_q[j] f over the entries
        (i, j, f), without psi_q where j is null.
    """
    row, column, place, factor = code.psi_q_entries
    found, owners = [], [name for name, _ in code.row_names]
    for name, constraint in mechanism.constraints.items():
        if getattr(constraint, "points", None) is None or getattr(constraint, "coordinate", "") == "angle":
            continue
        body = constraint.bodies[0 if constraint.bodies[1] == GROUND else 1]
        start = 3 * mechanism.body_names.index(body)
        own = np.flatnonzero([owner == name for owner in owners])
        parts: dict[str, list] = {"x": [], "y": []}
        for axis, entries in enumerate(parts.values()):
            for k in np.flatnonzero(np.isin(row, own) & (column == start + axis)):
                where = None if place[k] == code.constant_entry else int(place[k])
                entries.append([code.eliminated_rows[int(row[k])], where, float(factor[k])])
        found.append({"constraint": name, **parts})
    return found
