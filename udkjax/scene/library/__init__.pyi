"""The mechanisms, each from its own module."""

from udkjax.scene.library.andrews import andrews_squeezer as andrews_squeezer
from udkjax.scene.library.drawn_mechanisms import four_bar as four_bar
from udkjax.scene.library.drawn_mechanisms import scissor_lift as scissor_lift
from udkjax.scene.library.drawn_mechanisms import slider_crank as slider_crank
from udkjax.scene.library.excavator import excavator as excavator
from udkjax.scene.library.linkages import elliptic_trammel as elliptic_trammel
from udkjax.scene.library.linkages import n_four_bar as n_four_bar
from udkjax.scene.library.linkages import parallelogram as parallelogram
from udkjax.scene.library.machines import peaucellier as peaucellier
from udkjax.scene.library.machines import planetary_gear as planetary_gear
from udkjax.scene.library.pendulums import chain as chain
from udkjax.scene.library.pendulums import compound_pendulum as compound_pendulum
from udkjax.scene.library.pendulums import double_pendulum as double_pendulum
from udkjax.scene.library.pendulums import driven_pendulum as driven_pendulum
from udkjax.scene.library.pendulums import simple_pendulum as simple_pendulum

__all__: list[str]
