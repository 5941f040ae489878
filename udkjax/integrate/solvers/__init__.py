"""Solvers by name, from diffrax and from this package, and the tableaus of Runge-Kutta methods.

diffrax is imported on demand, since its import takes as long as that of JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from udkjax.native.module.tableau import DOPRI8, Method

if TYPE_CHECKING:
    import diffrax

Solver: TypeAlias = "diffrax.AbstractSolver"
StepController: TypeAlias = "diffrax.AbstractStepSizeController"
OWN_SOLVERS = {"Adams": "adams", "BDF": "bdf", "Verner65": "verner"}  # the solvers of this folder, with their modules


def own_solver(name: str) -> "type[diffrax.AbstractSolver]":
    """Return the class of a solver of this package; raise KeyError for any other name."""
    return getattr(import_module(f"udkjax.integrate.solvers.{OWN_SOLVERS[name]}"), name)


def solver_named(name: str) -> "diffrax.AbstractSolver":
    """Return the solver of this name: `Adams`, `BDF`, `Verner65`, or any solver of diffrax that needs no arguments.

    Raises:
        ValueError: there is no such solver.
    """
    import diffrax

    solver = own_solver(name) if name in OWN_SOLVERS else getattr(diffrax, name, None)
    if not (isinstance(solver, type) and issubclass(solver, diffrax.AbstractSolver)):
        raise ValueError(
            f"{name!r} is not a solver: take one of {', '.join(OWN_SOLVERS)}, or a solver of diffrax such as 'Dopri8'"
        )
    return solver()


def is_explicit(solver: "diffrax.AbstractSolver | None") -> bool:
    """Return True if a solver is an explicit Runge-Kutta method with one tableau, such as the default, None."""
    if solver is None:
        return True
    import diffrax

    # A wrapped solver counts as an instance of the class of the one within, but has no tableau.
    return isinstance(solver, diffrax.AbstractERK) and isinstance(getattr(solver, "tableau", None), diffrax.ButcherTableau)


def has_method(solver: "diffrax.AbstractSolver | None") -> bool:
    """Return True if `method_of` can convert a solver: a Runge-Kutta method, explicit or singly diagonally implicit.

    The first stage of an implicit tableau is explicit, and its last stage is the end of the step, as in `diffrax.Kvaerno5`.
    """
    if is_explicit(solver):
        return True
    import diffrax

    tableau: Any = getattr(solver, "tableau", None)
    if not isinstance(solver, diffrax.AbstractESDIRK) or not isinstance(tableau, diffrax.ButcherTableau):
        return False
    diagonal: Any = tableau.a_diagonal
    last = np.append(tableau.a_lower[-1], diagonal[-1])
    return bool(np.array_equal(last, tableau.b_sol)) and tableau.a_predictor is not None


def method_of(solver: "diffrax.AbstractRungeKutta | None") -> Method:
    """Return the method of a solver for machine code, with its tableau; None is the default, Dopri8."""
    if solver is None:
        return DOPRI8
    import diffrax

    tableau: Any = solver.tableau
    order: Any = solver.error_order(diffrax.ODETerm(lambda t, y, args: y))
    c, stages, b, error = np.append(0.0, tableau.c), tableau.a_lower, np.asarray(tableau.b_sol), np.asarray(tableau.b_error)
    if not is_explicit(solver):
        return Method.of(c, stages, b, error, order, diagonal=tableau.a_diagonal[-1], predictor=tableau.a_predictor)
    ends = bool(tableau.fsal and error[-1] != 0)
    if tableau.fsal and not ends:  # the last stage is used for interpolation or by the next step
        c, stages, b, error = c[:-1], stages[:-1], b[:-1], error[:-1]
    return Method.of(c, stages, b, error, order, ends)
