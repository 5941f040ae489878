"""Planar mechanisms with any redundancy of constraints: simulated, batched and differentiated in JAX.

Nothing is imported before it is used, so that the command line answers at once. Importing this package turns float64 on in
JAX, unless the environment says `JAX_ENABLE_X64=0`, and does nothing else.
"""

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the public names, for type checkers and editors; a test compares them with those below
    from udkjax import equations as equations
    from udkjax import pinv as pinv
    from udkjax.equations import Analysis as Analysis
    from udkjax.equations import Augmented as Augmented
    from udkjax.equations import Baumgarte as Baumgarte
    from udkjax.equations import ConstrainedSystem as ConstrainedSystem
    from udkjax.equations import CoordinatePartitioning as CoordinatePartitioning
    from udkjax.equations import NullSpaceQR as NullSpaceQR
    from udkjax.equations import NullSpaceSVD as NullSpaceSVD
    from udkjax.equations import accelerations as accelerations
    from udkjax.equations import analyse as analyse
    from udkjax.equations import efforts as efforts
    from udkjax.equations import energy as energy
    from udkjax.equations import reactions as reactions
    from udkjax.equations import singular_values as singular_values
    from udkjax.equations import unique_reactions as unique_reactions
    from udkjax.equations import uniqueness as uniqueness
    from udkjax.equations import violation as violation
    from udkjax.integrate import BDF as BDF
    from udkjax.integrate import Adams as Adams
    from udkjax.integrate import Projection as Projection
    from udkjax.integrate import Result as Result
    from udkjax.integrate import SimulationError as SimulationError
    from udkjax.integrate import Solution as Solution
    from udkjax.integrate import Verner65 as Verner65
    from udkjax.integrate import simulate as simulate
    from udkjax.integrate import step as step
    from udkjax.integrate.assembly import AssemblyError as AssemblyError
    from udkjax.integrate.assembly import State as State
    from udkjax.integrate.assembly import assemble as assemble
    from udkjax.integrate.assembly import check as check
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
    from udkjax.pinv import SVD as SVD
    from udkjax.pinv import Auto as Auto
    from udkjax.pinv import Elimination as Elimination
    from udkjax.pinv import GramSchmidt as GramSchmidt
    from udkjax.pinv import Greville as Greville
    from udkjax.pinv import Householder as Householder
    from udkjax.pinv import Varga as Varga
    from udkjax.scene import GROUND as GROUND
    from udkjax.scene import Angle as Angle
    from udkjax.scene import Body as Body
    from udkjax.scene import Cam as Cam
    from udkjax.scene import Constraint as Constraint
    from udkjax.scene import Distance as Distance
    from udkjax.scene import Drawing as Drawing
    from udkjax.scene import Driver as Driver
    from udkjax.scene import Force as Force
    from udkjax.scene import ForceElement as ForceElement
    from udkjax.scene import Frame as Frame
    from udkjax.scene import Friction as Friction
    from udkjax.scene import Gear as Gear
    from udkjax.scene import Held as Held
    from udkjax.scene import Joint as Joint
    from udkjax.scene import Link as Link
    from udkjax.scene import Mechanism as Mechanism
    from udkjax.scene import Motion as Motion
    from udkjax.scene import Point as Point
    from udkjax.scene import Polynomial as Polynomial
    from udkjax.scene import Prismatic as Prismatic
    from udkjax.scene import Profile as Profile
    from udkjax.scene import Rack as Rack
    from udkjax.scene import Revolute as Revolute
    from udkjax.scene import SceneError as SceneError
    from udkjax.scene import Sine as Sine
    from udkjax.scene import Slot as Slot
    from udkjax.scene import Spline as Spline
    from udkjax.scene import Spring as Spring
    from udkjax.scene import Torque as Torque
    from udkjax.scene import TorsionSpring as TorsionSpring
    from udkjax.scene import Weld as Weld
    from udkjax.scene import dumps as dumps
    from udkjax.scene import library as library
    from udkjax.scene import load as load
    from udkjax.scene import loads as loads
    from udkjax.scene import mjcf_text as mjcf_text
    from udkjax.scene import read_mjcf as read_mjcf
    from udkjax.scene import save as save
    from udkjax.scene import with_angle as with_angle
    from udkjax.scene import with_length as with_length
    from udkjax.show.player import Animation as Animation
    from udkjax.show.player import animate as animate
    from udkjax.show.player import animate_modes as animate_modes
    from udkjax.study.branches import branches as branches
    from udkjax.study.channel_values import path as path
    from udkjax.study.continuation import Reached as Reached
    from udkjax.study.design import Designs as Designs
    from udkjax.study.design import DesignSearch as DesignSearch
    from udkjax.study.design import FoundDesign as FoundDesign
    from udkjax.study.design import FunctionGoal as FunctionGoal
    from udkjax.study.design import PathGoal as PathGoal
    from udkjax.study.design import PoseGoal as PoseGoal
    from udkjax.study.design import design as design
    from udkjax.study.diagnosis import Diagnosis as Diagnosis
    from udkjax.study.diagnosis import diagnose as diagnose
    from udkjax.study.drive import Coordinate as Coordinate
    from udkjax.study.equilibrium import Equilibrium as Equilibrium
    from udkjax.study.equilibrium import equilibria as equilibria
    from udkjax.study.equilibrium import equilibrium as equilibrium
    from udkjax.study.explain import explain as explain
    from udkjax.study.explanation import Explanation as Explanation
    from udkjax.study.identify import Candidate as Candidate
    from udkjax.study.identify import Design as Design
    from udkjax.study.identify import Estimate as Estimate
    from udkjax.study.identify import GradientCheck as GradientCheck
    from udkjax.study.identify import IdentificationError as IdentificationError
    from udkjax.study.identify import Parameter as Parameter
    from udkjax.study.identify import Quantity as Quantity
    from udkjax.study.identify import Record as Record
    from udkjax.study.identify import Start as Start
    from udkjax.study.identify import check_gradients as check_gradients
    from udkjax.study.identify import design_experiment as design_experiment
    from udkjax.study.identify import identify as identify
    from udkjax.study.identify import length as length
    from udkjax.study.inverse_dynamics import Effort as Effort
    from udkjax.study.inverse_dynamics import InverseDynamics as InverseDynamics
    from udkjax.study.inverse_dynamics import feed_forward as feed_forward
    from udkjax.study.inverse_dynamics import inverse_dynamics as inverse_dynamics
    from udkjax.study.kinematics import Kinematics as Kinematics
    from udkjax.study.kinematics import Travel as Travel
    from udkjax.study.kinematics import kinematics as kinematics
    from udkjax.study.kinematics import travel as travel
    from udkjax.study.modes import Modes as Modes
    from udkjax.study.modes import modes as modes
    from udkjax.study.position_batch import BatchPositions as BatchPositions
    from udkjax.study.position_batch import PositionBatch as PositionBatch
    from udkjax.study.power_balance import PowerBalance as PowerBalance
    from udkjax.study.power_balance import power_balance as power_balance
    from udkjax.study.reaction_peaks import envelope as envelope
    from udkjax.study.reaction_peaks import pin_reactions as pin_reactions
    from udkjax.study.reaction_peaks import reaction_peaks as reaction_peaks
    from udkjax.study.sweep import Axis as Axis
    from udkjax.study.sweep import LatinHypercube as LatinHypercube
    from udkjax.study.sweep import Random as Random
    from udkjax.study.sweep import Sobol as Sobol
    from udkjax.study.sweep import SweepError as SweepError
    from udkjax.study.sweep import Zipped as Zipped
    from udkjax.study.sweep import sweep as sweep
    from udkjax.study.transmission import Workspace as Workspace
    from udkjax.study.transmission import coupler_curve as coupler_curve
    from udkjax.study.transmission import mechanical_advantage as mechanical_advantage
    from udkjax.study.transmission import transmission_angle as transmission_angle
    from udkjax.study.transmission import workspace as workspace

_MODULES = {"pinv": "udkjax.pinv", "equations": "udkjax.equations", "library": "udkjax.scene.library"}
_NAMES = {
    "udkjax.scene": """
        load loads save dumps read_mjcf mjcf_text with_length with_angle SceneError
        Drawing Link Mechanism Body GROUND Frame Point Constraint Joint Driver Motion ForceElement
        Revolute Prismatic Slot Weld Distance Angle Gear Rack Cam
        Polynomial Sine Spline Profile
        Spring TorsionSpring Force Torque Friction Held""",
    "udkjax.pinv": "SVD Varga Greville Householder GramSchmidt Elimination Auto",
    "udkjax.integrate.assembly": "AssemblyError State assemble check",
    "udkjax.integrate.events": "Event Events JointLimit Contact Stop Log Impact Release Attach Lock",
    "udkjax.equations": """
        ConstrainedSystem Baumgarte Analysis analyse accelerations violation energy efforts reactions
        unique_reactions uniqueness singular_values
        Augmented NullSpaceQR NullSpaceSVD CoordinatePartitioning""",
    "udkjax.study.design": "design DesignSearch Designs FoundDesign PathGoal PoseGoal FunctionGoal",
    "udkjax.study.diagnosis": "diagnose Diagnosis",
    "udkjax.study.explain": "explain",
    "udkjax.study.explanation": "Explanation",
    "udkjax.study.reaction_peaks": "reaction_peaks pin_reactions envelope",
    "udkjax.study.power_balance": "power_balance PowerBalance",
    "udkjax.study.identify": """
        identify Record Start Parameter length Quantity Estimate IdentificationError check_gradients GradientCheck
        design_experiment Candidate Design""",
    "udkjax.show.player": "animate animate_modes Animation",
    "udkjax.study.sweep": "sweep Axis Zipped Sobol LatinHypercube Random SweepError",
    "udkjax.study.branches": "branches",
    "udkjax.study.channel_values": "path",
    "udkjax.study.continuation": "Reached",
    "udkjax.study.drive": "Coordinate",
    "udkjax.study.equilibrium": "equilibria equilibrium Equilibrium",
    "udkjax.study.inverse_dynamics": "feed_forward inverse_dynamics Effort InverseDynamics",
    "udkjax.study.modes": "modes Modes",
    "udkjax.study.position_batch": "BatchPositions PositionBatch",
    "udkjax.study.kinematics": "kinematics Kinematics travel Travel",
    "udkjax.study.transmission": "coupler_curve mechanical_advantage transmission_angle workspace Workspace",
    "udkjax.integrate": "simulate step Solution Projection Result SimulationError Verner65 Adams BDF",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__version__ = "0.1.0"
__all__ = [*_MODULES, *_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    if name in _MODULES:
        value = import_module(_MODULES[name])
    elif name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__():
    return sorted([*__all__, "__version__"])


os.environ["JAX_ENABLE_X64"] = os.environ.get("JAX_ENABLE_X64") or "1"
if "jax" in sys.modules:
    if os.environ["JAX_ENABLE_X64"].lower() not in ("0", "n", "no", "f", "false", "off"):
        sys.modules["jax"].config.update("jax_enable_x64", True)  # it has read its environment already
    # Equinox imports this, which adds to what JAX knows its traces by: a function that is traced when a name of this package is
    # first asked for would be traced and compiled again on its second call.
    import_module("jax.extend")
