"""The door of `integrate`: the names that floors above import, each from its own module."""

from udkjax.integrate.causes.find import cause_of_standstill as cause_of_standstill
from udkjax.integrate.compiled_mechanism import reason_for_plain as reason_for_plain
from udkjax.integrate.events import Attach as Attach
from udkjax.integrate.events import Contact as Contact
from udkjax.integrate.events import Event as Event
from udkjax.integrate.events import Events as Events
from udkjax.integrate.events import Impact as Impact
from udkjax.integrate.events import JointLimit as JointLimit
from udkjax.integrate.events import Lock as Lock
from udkjax.integrate.events import Log as Log
from udkjax.integrate.events import Release as Release
from udkjax.integrate.events import Stop as Stop
from udkjax.integrate.events.law.conditions import Gap as Gap
from udkjax.integrate.events.law.conditions import frames_of as frames_of
from udkjax.integrate.events.law.event import EventsLike as EventsLike
from udkjax.integrate.events.law.event import ExpandsToEvents as ExpandsToEvents
from udkjax.integrate.events.law.event import expand_events as expand_events
from udkjax.integrate.events.law.event import listed_events as listed_events
from udkjax.integrate.portable import drawn_points as drawn_points
from udkjax.integrate.portable import names_of_run as names_of_run
from udkjax.integrate.portable import portable_engine as portable_engine
from udkjax.integrate.portable import scalar_parameters as scalar_parameters
from udkjax.integrate.portable.c import export_c as export_c
from udkjax.integrate.portable.fmi import export_fmu as export_fmu
from udkjax.integrate.projection import Projection as Projection
from udkjax.integrate.simulate import simulate as simulate
from udkjax.integrate.solution import CAUSES as CAUSES
from udkjax.integrate.solution import Result as Result
from udkjax.integrate.solution import SimulationError as SimulationError
from udkjax.integrate.solution import Solution as Solution
from udkjax.integrate.solution import format_work as format_work
from udkjax.integrate.solution import scene_text as scene_text
from udkjax.integrate.solution import versions as versions
from udkjax.integrate.solvers import Solver as Solver
from udkjax.integrate.solvers import StepController as StepController
from udkjax.integrate.solvers import has_method as has_method
from udkjax.integrate.solvers import solver_named as solver_named
from udkjax.integrate.solvers.adams import Adams as Adams
from udkjax.integrate.solvers.bdf import BDF as BDF
from udkjax.integrate.solvers.verner import Verner65 as Verner65
from udkjax.integrate.stabilization import ConstraintState as ConstraintState
from udkjax.integrate.stabilization import Stabilization as Stabilization
from udkjax.integrate.stepping import step as step

__all__: list[str]
