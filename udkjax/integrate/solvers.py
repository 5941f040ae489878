"""Solvers by name: diffrax's own, and those that are written here."""

from importlib import import_module

import diffrax

HERE = {"Adams": "adams", "BDF": "bdf", "Verner65": "verner"}


def solver_named(name: str) -> diffrax.AbstractSolver:
    """Return the solver of this name: `Adams`, `BDF`, `Verner65`, or any solver of diffrax that needs no arguments."""
    home = import_module(f"udkjax.integrate.{HERE[name]}") if name in HERE else diffrax
    solver = getattr(home, name, None)
    if not (isinstance(solver, type) and issubclass(solver, diffrax.AbstractSolver)):
        raise ValueError(f"{name!r} is no solver: it is none of {', '.join(HERE)}, nor a solver of diffrax such as 'Dopri8'")
    return solver()
