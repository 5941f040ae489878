"""Equations of motion: pure functions of a mechanism's numbers, time, coordinates and velocities."""

from udkjax.equations import constraints, determinacy, loads
from udkjax.equations.analysis import Analysis as Analysis
from udkjax.equations.analysis import analyse as analyse
from udkjax.equations.compiled import compiled
from udkjax.equations.determinacy import Uniqueness as Uniqueness
from udkjax.equations.formulations import Augmented as Augmented
from udkjax.equations.formulations import Formulation as Formulation
from udkjax.equations.formulations import NullSpaceQR as NullSpaceQR
from udkjax.equations.formulations import NullSpaceSVD as NullSpaceSVD
from udkjax.equations.general import ConstrainedSystem as ConstrainedSystem
from udkjax.equations.partitioning import CoordinatePartitioning as CoordinatePartitioning
from udkjax.equations.quantities import Energy as Energy
from udkjax.equations.quantities import accelerations as accelerations
from udkjax.equations.quantities import efforts as efforts
from udkjax.equations.quantities import energy as energy
from udkjax.equations.quantities import equations_of as equations_of
from udkjax.equations.quantities import violation as violation
from udkjax.equations.reactions import reactions as reactions
from udkjax.equations.reactions import unique_reactions as unique_reactions
from udkjax.equations.textbook import TextbookEquations as TextbookEquations
from udkjax.equations.textbook import prepare as prepare
from udkjax.equations.udwadia_kalaba import Baumgarte as Baumgarte

psi = compiled(constraints.psi)
psi_q = compiled(constraints.psi_q)
psi_dot = compiled(constraints.psi_dot)
gamma = compiled(constraints.gamma)
force = compiled(loads.force)
mass = compiled(loads.mass)
kinetic_energy = compiled(loads.kinetic_energy)
potential_energy = compiled(loads.potential_energy)
singular_values = compiled(determinacy.singular_values)
uniqueness = compiled(determinacy.uniqueness)
