"""What an explicit Runge-Kutta method needs of its tableau for q'' = a(t, q, v)."""

from typing import Any, NamedTuple

import diffrax
import numpy as np


class Method(NamedTuple):
    """A tableau as q'' = a needs it, without stages that serve interpolation alone."""

    nodes: np.ndarray  # c, and below it 1: the end of the step is one state more
    v: np.ndarray  # A, and below it b
    q: np.ndarray  # A A, and below it b A
    error_v: np.ndarray  # (stages,)
    error_q: np.ndarray
    order: float
    ends: bool  # whether the last stage is the next step's first

    @property
    def stages(self) -> int:
        return len(self.error_v)


def method_of(solver: diffrax.AbstractERK) -> Method:
    """Read the tableau of a solver."""
    tableau: Any = solver.tableau
    s = tableau.num_stages
    A = np.zeros((s, s))
    for i, row in enumerate(tableau.a_lower):
        A[i + 1, : i + 1] = row
    b, error, c = (np.asarray(x, float) for x in (tableau.b_sol, tableau.b_error, np.append(0.0, tableau.c)))
    error_q = error @ A
    ends = bool(tableau.fsal and error[-1] != 0)
    if tableau.fsal and not ends:  # the last stage is there for interpolation, or for the next step
        A, b, error, error_q, c = A[:-1, :-1], b[:-1], error[:-1], error_q[:-1], c[:-1]
    order: Any = solver.error_order(diffrax.ODETerm(lambda t, y, args: y))
    return Method(np.append(c, 1.0), np.vstack([A, b]), np.vstack([A @ A, b @ A]), error, error_q, float(order), ends)
