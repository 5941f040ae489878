"""The names of trajectories, each from the module that it is in."""

from udkjax.integrate.projection import Projection as Projection
from udkjax.integrate.simulate import simulate as simulate
from udkjax.integrate.solution import Result as Result
from udkjax.integrate.solution import SimulationError as SimulationError
from udkjax.integrate.solution import Solution as Solution
from udkjax.integrate.solvers.adams import Adams as Adams
from udkjax.integrate.solvers.bdf import BDF as BDF
from udkjax.integrate.solvers.verner import Verner65 as Verner65
from udkjax.integrate.stepping import step as step

__all__: list[str]
