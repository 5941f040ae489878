"""What moves a mechanism: pure functions of its numbers, time, coordinates and velocities."""

from udkjax.equations.analysis import Analysis as Analysis
from udkjax.equations.analysis import analyse as analyse
from udkjax.equations.constraints import gamma as gamma
from udkjax.equations.constraints import psi as psi
from udkjax.equations.constraints import psi_dot as psi_dot
from udkjax.equations.constraints import psi_q as psi_q
from udkjax.equations.formulations import Augmented as Augmented
from udkjax.equations.formulations import Formulation as Formulation
from udkjax.equations.formulations import NullSpaceQR as NullSpaceQR
from udkjax.equations.formulations import NullSpaceSVD as NullSpaceSVD
from udkjax.equations.general import ConstrainedSystem as ConstrainedSystem
from udkjax.equations.loads import force as force
from udkjax.equations.loads import kinetic_energy as kinetic_energy
from udkjax.equations.loads import mass as mass
from udkjax.equations.loads import potential_energy as potential_energy
from udkjax.equations.partitioning import CoordinatePartitioning as CoordinatePartitioning
from udkjax.equations.quantities import Energy as Energy
from udkjax.equations.quantities import accelerations as accelerations
from udkjax.equations.quantities import energy as energy
from udkjax.equations.quantities import equations_of as equations_of
from udkjax.equations.quantities import reactions as reactions
from udkjax.equations.quantities import violation as violation
from udkjax.equations.textbook import TextbookEquations as TextbookEquations
from udkjax.equations.textbook import prepare as prepare
from udkjax.equations.udwadia_kalaba import Baumgarte as Baumgarte
