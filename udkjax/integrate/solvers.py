"""Solvers by name: diffrax's own, and those that are written here."""

from typing import TYPE_CHECKING

from udkjax import integrate

if TYPE_CHECKING:
    import diffrax


def solver_named(name: str) -> "diffrax.AbstractSolver":
    """Return the solver of this name: `Adams`, `BDF`, `Verner65`, or any solver of diffrax that needs no arguments."""
    import diffrax

    solver = getattr(integrate if name in integrate.SOLVERS else diffrax, name, None)
    if not (isinstance(solver, type) and issubclass(solver, diffrax.AbstractSolver)):
        here = ", ".join(integrate.SOLVERS)
        raise ValueError(f"{name!r} is no solver: it is none of {here}, nor a solver of diffrax such as 'Dopri8'")
    return solver()


def forward_mode() -> "diffrax.AbstractAdjoint":
    """Return the adjoint with which `simulate` is differentiated forward."""
    import diffrax

    return diffrax.ForwardMode()
