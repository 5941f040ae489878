"""Trajectories: the only floor that knows diffrax."""

from udkjax.integrate.adams import Adams as Adams
from udkjax.integrate.bdf import BDF as BDF
from udkjax.integrate.projection import Projection as Projection
from udkjax.integrate.simulate import simulate as simulate
from udkjax.integrate.solution import Result as Result
from udkjax.integrate.solution import SimulationError as SimulationError
from udkjax.integrate.solution import Solution as Solution
from udkjax.integrate.verner import Verner65 as Verner65
