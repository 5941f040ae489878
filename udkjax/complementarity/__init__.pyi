"""The door of `complementarity`: the names that other folders import, each from its own module."""

from udkjax.complementarity.linear import diagonal as diagonal
from udkjax.complementarity.linear import eliminate as eliminate
from udkjax.complementarity.linear import solve_complementarity as solve_complementarity
from udkjax.complementarity.linear import times as times
from udkjax.complementarity.linear_program import maximize as maximize
from udkjax.complementarity.rubbing_impacts import RubbingContacts as RubbingContacts
from udkjax.complementarity.rubbing_impacts import rubbing_impact as rubbing_impact
from udkjax.complementarity.stick_or_slip import AT_REST as AT_REST
from udkjax.complementarity.stick_or_slip import BLOCK_STEPS as BLOCK_STEPS
from udkjax.complementarity.stick_or_slip import SIDES as SIDES
from udkjax.complementarity.stick_or_slip import SINGLE_STEPS as SINGLE_STEPS
from udkjax.complementarity.stick_or_slip import ContactsAtRest as ContactsAtRest
from udkjax.complementarity.stick_or_slip import FrictionModes as FrictionModes
from udkjax.complementarity.stick_or_slip import JointsAtRest as JointsAtRest
from udkjax.complementarity.stick_or_slip import Response as Response

__all__: list[str]
