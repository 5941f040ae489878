"""The names of drawings, each from its own module."""

from udkjax.scene.drawing.drawing import Drawing as Drawing
from udkjax.scene.drawing.drawn_forces import Load as Load
from udkjax.scene.drawing.drawn_forces import Motor as Motor
from udkjax.scene.drawing.drawn_forces import PinDamper as PinDamper
from udkjax.scene.drawing.drawn_forces import PinSpring as PinSpring
from udkjax.scene.drawing.drawn_joints import CamPair as CamPair
from udkjax.scene.drawing.drawn_joints import GearPair as GearPair
from udkjax.scene.drawing.drawn_joints import PinInSlot as PinInSlot
from udkjax.scene.drawing.drawn_joints import Slide as Slide
from udkjax.scene.drawing.link import Link as Link
