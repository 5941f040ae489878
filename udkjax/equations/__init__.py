"""What moves a mechanism: pure functions of its numbers, time, coordinates and velocities."""

from udkjax.equations.analysis import Analysis as Analysis
from udkjax.equations.analysis import analyse as analyse
from udkjax.equations.assembly import AssemblyError as AssemblyError
from udkjax.equations.assembly import Check as Check
from udkjax.equations.assembly import State as State
from udkjax.equations.assembly import assemble as assemble
from udkjax.equations.assembly import check as check
from udkjax.equations.formulations import Augmented as Augmented
from udkjax.equations.formulations import Formulation as Formulation
from udkjax.equations.formulations import NullSpaceQR as NullSpaceQR
from udkjax.equations.formulations import NullSpaceSVD as NullSpaceSVD
from udkjax.equations.general import ConstrainedSystem as ConstrainedSystem
from udkjax.equations.partitioning import CoordinatePartitioning as CoordinatePartitioning
from udkjax.equations.programs import Baumgarte as Baumgarte
from udkjax.equations.programs import Equations as Equations
from udkjax.equations.programs import prepare as prepare
from udkjax.equations.quantities import Energy as Energy
from udkjax.equations.quantities import accelerations as accelerations
from udkjax.equations.quantities import energy as energy
from udkjax.equations.quantities import equations_of as equations_of
from udkjax.equations.quantities import reactions as reactions
from udkjax.equations.quantities import violation as violation
