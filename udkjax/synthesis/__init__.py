"""Design by gradient: mechanisms of which a point, a link or an output moves as wanted.

`design` is the door and `DesignSearch` what it compiles. `goals` say what is wanted, `limits` what must hold; `design_problem`
evaluates trials in lanes; `starts` are where searches begin, `search` and `polish` improve them, and `found` is what comes out,
moved by `kinematics`. `goal_file` reads designs from files.
"""

from udkjax.synthesis.design import DesignSearch as DesignSearch
from udkjax.synthesis.design import design as design
from udkjax.synthesis.found import Designs as Designs
from udkjax.synthesis.found import FoundDesign as FoundDesign
from udkjax.synthesis.goals import FunctionGoal as FunctionGoal
from udkjax.synthesis.goals import PathGoal as PathGoal
from udkjax.synthesis.goals import PoseGoal as PoseGoal
from udkjax.synthesis.motion_goals import EnergyGoal as EnergyGoal
from udkjax.synthesis.motion_goals import FrequencyGoal as FrequencyGoal
from udkjax.synthesis.motion_goals import LoadGoal as LoadGoal
from udkjax.synthesis.motion_goals import MotionGoal as MotionGoal
from udkjax.synthesis.motion_goals import MotionPoint as MotionPoint
from udkjax.synthesis.motion_goals import ToleranceGoal as ToleranceGoal
from udkjax.synthesis.motion_goals import TorqueGoal as TorqueGoal
