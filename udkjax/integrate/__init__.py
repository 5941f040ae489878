"""Trajectories: the only floor that knows diffrax, which it imports where a run asks for it."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from udkjax.integrate.adams import Adams as Adams
    from udkjax.integrate.bdf import BDF as BDF
    from udkjax.integrate.verner import Verner65 as Verner65

SOLVERS = {"Adams": "adams", "BDF": "bdf", "Verner65": "verner"}  # our own, each a solver of diffrax, and their modules


def __getattr__(name: str) -> Any:
    if name not in SOLVERS:
        raise AttributeError(f"module 'udkjax.integrate' has no attribute {name!r}")
    return getattr(import_module(f"udkjax.integrate.{SOLVERS[name]}"), name)
