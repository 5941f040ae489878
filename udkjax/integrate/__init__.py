"""Trajectories: the only floor that knows diffrax, which it imports where a run asks for it."""

from typing import TYPE_CHECKING

from udkjax.integrate.assembly import AssemblyError as AssemblyError
from udkjax.integrate.assembly import Check as Check
from udkjax.integrate.assembly import State as State
from udkjax.integrate.assembly import assemble as assemble
from udkjax.integrate.assembly import check as check
from udkjax.integrate.projection import Projection as Projection
from udkjax.integrate.simulate import simulate as simulate
from udkjax.integrate.solution import Result as Result
from udkjax.integrate.solution import SimulationError as SimulationError
from udkjax.integrate.solution import Solution as Solution
from udkjax.integrate.solvers import OWN, own_solver
from udkjax.integrate.stepping import step as step

if TYPE_CHECKING:
    import diffrax

    from udkjax.integrate.solvers.adams import Adams as Adams
    from udkjax.integrate.solvers.bdf import BDF as BDF
    from udkjax.integrate.solvers.verner import Verner65 as Verner65


def __getattr__(name: str) -> "type[diffrax.AbstractSolver]":
    if name not in OWN:
        raise AttributeError(f"module 'udkjax.integrate' has no attribute {name!r}")
    return own_solver(name)
