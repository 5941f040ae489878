"""The door of `statics`: the names that floors above import, each from its own module."""

from udkjax.statics.equilibrium import Equilibrium as Equilibrium
from udkjax.statics.equilibrium import equilibria as equilibria
from udkjax.statics.equilibrium import equilibrium as equilibrium
from udkjax.statics.holding import HoldingEfforts as HoldingEfforts
from udkjax.statics.holding import holding_efforts as holding_efforts
from udkjax.statics.load_scale import load_sizes as load_sizes
from udkjax.statics.modes import Modes as Modes
from udkjax.statics.modes import modes as modes
from udkjax.statics.reaction_peaks import RestingPositions as RestingPositions
from udkjax.statics.reaction_peaks import cam_forces as cam_forces
from udkjax.statics.reaction_peaks import envelope as envelope
from udkjax.statics.reaction_peaks import pin_reactions as pin_reactions
from udkjax.statics.reaction_peaks import reaction_peaks as reaction_peaks
from udkjax.statics.reaction_peaks import unique_pin_forces as unique_pin_forces
from udkjax.statics.resting_forces import force_lines as force_lines
from udkjax.statics.resting_forces import forces_table as forces_table
from udkjax.statics.resting_forces import has_gravity as has_gravity
from udkjax.statics.resting_forces import resting_forces as resting_forces

__all__: list[str]
