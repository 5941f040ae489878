"""The tableaus of diffrax's explicit Runge-Kutta methods.

diffrax is imported where one is given: that takes as long as all of JAX.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from udkjax.native.tableau import DOPRI8, Method, method

if TYPE_CHECKING:
    import diffrax


def is_explicit(solver: "diffrax.AbstractSolver | None") -> bool:
    """Whether a solver is an explicit Runge-Kutta method with one tableau; None is the default, which is."""
    if solver is None:
        return True
    import diffrax

    return isinstance(solver, diffrax.AbstractERK) and isinstance(solver.tableau, diffrax.ButcherTableau)


def method_of(solver: "diffrax.AbstractERK | None") -> Method:
    """Read the tableau of a solver; None is the default."""
    if solver is None:
        return DOPRI8
    import diffrax

    tableau: Any = solver.tableau
    order: Any = solver.error_order(diffrax.ODETerm(lambda t, y, args: y))
    c, stages, b, error = np.append(0.0, tableau.c), tableau.a_lower, np.asarray(tableau.b_sol), np.asarray(tableau.b_error)
    ends = bool(tableau.fsal and error[-1] != 0)
    if tableau.fsal and not ends:  # the last stage is there for interpolation, or for the next step
        c, stages, b, error = c[:-1], stages[:-1], b[:-1], error[:-1]
    return method(c, stages, b, error, order, ends)
