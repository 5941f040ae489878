"""The door of `synthesis`: the names that floors above import, each from its own module."""

from udkjax.synthesis.complete import CompleteDesign as CompleteDesign
from udkjax.synthesis.complete import CompleteDesigns as CompleteDesigns
from udkjax.synthesis.complete import design_all as design_all
from udkjax.synthesis.complete.complete_design import CompleteSearch as CompleteSearch
from udkjax.synthesis.curve_goal import CurveGoal as CurveGoal
from udkjax.synthesis.curves.curve_designs import CurveDesign as CurveDesign
from udkjax.synthesis.curves.curve_designs import CurveDesigns as CurveDesigns
from udkjax.synthesis.curves.curve_file import read_curve_file as read_curve_file
from udkjax.synthesis.curves.curve_file import read_curve_table as read_curve_table
from udkjax.synthesis.curves.mechanisms_for import mechanisms_for as mechanisms_for
from udkjax.synthesis.design import DesignSearch as DesignSearch
from udkjax.synthesis.design import design as design
from udkjax.synthesis.designs import Designs as Designs
from udkjax.synthesis.designs import FoundDesign as FoundDesign
from udkjax.synthesis.fit import design_lines as design_lines
from udkjax.synthesis.fit import deviation_of as deviation_of
from udkjax.synthesis.goal_file import read_design as read_design
from udkjax.synthesis.goals import FunctionGoal as FunctionGoal
from udkjax.synthesis.goals import Goal as Goal
from udkjax.synthesis.goals import PathGoal as PathGoal
from udkjax.synthesis.goals import PoseGoal as PoseGoal
from udkjax.synthesis.motion_goals import EnergyGoal as EnergyGoal
from udkjax.synthesis.motion_goals import FrequencyGoal as FrequencyGoal
from udkjax.synthesis.motion_goals import GapGoal as GapGoal
from udkjax.synthesis.motion_goals import LoadGoal as LoadGoal
from udkjax.synthesis.motion_goals import MotionGoal as MotionGoal
from udkjax.synthesis.motion_goals import MotionPoint as MotionPoint
from udkjax.synthesis.motion_goals import ToleranceGoal as ToleranceGoal
from udkjax.synthesis.motion_goals import TorqueGoal as TorqueGoal
from udkjax.synthesis.ranges.deviations import PinClearance as PinClearance
from udkjax.synthesis.ranges.deviations import Tolerance as Tolerance
from udkjax.synthesis.ranges.deviations import ToleranceLike as ToleranceLike
from udkjax.synthesis.ranges.deviations import read_tolerance as read_tolerance
from udkjax.synthesis.ranges.second_order import Quadratic as Quadratic
from udkjax.synthesis.ranges.second_order import quadratic as quadratic
from udkjax.synthesis.robust_goal import RobustGoal as RobustGoal

__all__: list[str]
