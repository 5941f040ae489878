"""Names of rows of constraints, coordinates and directions in texts."""

from udkjax.scene.bodies import COORDINATES
from udkjax.scene.mechanism import Mechanism

_ROWS = {"Revolute": ("x", "y"), "Weld": ("x", "y", "angle"), "Prismatic": ("across", "angle")}


def row_label(mechanism: Mechanism, constraint: str, row: int) -> str:
    """Name one row of a constraint, such as `B2 (y)`; the only row of one by the constraint alone."""
    kind = type(mechanism.constraints[constraint]).__name__
    if kind in _ROWS:
        return f"{constraint} ({_ROWS[kind][row]})"
    return f"{constraint} (row {row + 1})"


def column_labels(mechanism: Mechanism) -> list[str]:
    """Name the coordinates: x, y and angle of each body."""
    return [f"{coordinate} {body}" for body in mechanism.body_names for coordinate in COORDINATES]
