"""Mechanisms from literature and practice, ready to use: every number is an argument."""

from udkjax.scene.library.andrews import andrews_squeezer
from udkjax.scene.library.excavator import excavator
from udkjax.scene.library.linkages import elliptic_trammel, four_bar, n_four_bar, parallelogram, slider_crank
from udkjax.scene.library.machines import peaucellier, planetary_gear, scissor_lift
from udkjax.scene.library.pendulums import chain, compound_pendulum, double_pendulum, driven_pendulum, simple_pendulum

__all__ = [
    "andrews_squeezer",
    "chain",
    "compound_pendulum",
    "double_pendulum",
    "driven_pendulum",
    "elliptic_trammel",
    "excavator",
    "four_bar",
    "n_four_bar",
    "parallelogram",
    "peaucellier",
    "planetary_gear",
    "scissor_lift",
    "simple_pendulum",
    "slider_crank",
]
