"""The names of drawings, each from its own module."""

from udkjax.scene.drawing.drawing import Drawing as Drawing
from udkjax.scene.drawing.drawn_forces import Load as Load
from udkjax.scene.drawing.drawn_forces import Motor as Motor
from udkjax.scene.drawing.drawn_forces import PinDamper as PinDamper
from udkjax.scene.drawing.drawn_forces import PinSpring as PinSpring
from udkjax.scene.drawing.drawn_friction import PinFriction as PinFriction
from udkjax.scene.drawing.drawn_joints import CamPair as CamPair
from udkjax.scene.drawing.drawn_joints import GearPair as GearPair
from udkjax.scene.drawing.drawn_joints import PinInSlot as PinInSlot
from udkjax.scene.drawing.drawn_joints import ScrewPair as ScrewPair
from udkjax.scene.drawing.drawn_joints import Slide as Slide
from udkjax.scene.drawing.link import Link as Link
from udkjax.scene.drawing.pin_forms import CirclesPin as CirclesPin
from udkjax.scene.drawing.pin_forms import LinePin as LinePin
from udkjax.scene.drawing.pin_forms import Pin as Pin
from udkjax.scene.drawing.pin_forms import PolarPin as PolarPin
from udkjax.scene.drawing.pin_forms import RailPin as RailPin
from udkjax.scene.drawing.pin_forms import StackedPin as StackedPin
from udkjax.scene.drawing.pin_tables import circles as circles
from udkjax.scene.drawing.pin_tables import on_line as on_line
from udkjax.scene.drawing.pin_tables import on_rail as on_rail
from udkjax.scene.drawing.pin_tables import polar as polar
from udkjax.scene.drawing.pin_tables import stacked as stacked
