"""What exists: bodies, joints, drivers, force elements, the mechanism of them all, and its files. No equations."""

from udkjax.scene import library
from udkjax.scene.bodies import GROUND, Body, Frame, Point, between
from udkjax.scene.checks import SceneError
from udkjax.scene.drivers import Driver, Motion, Polynomial, Sine, Spline
from udkjax.scene.forces import Force, ForceElement, Friction, Spring, Torque, TorsionSpring
from udkjax.scene.joints import Angle, Cam, Constraint, Distance, Gear, Joint, Prismatic, Profile, Rack, Revolute, Slot, Weld
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.reshaping import with_angle, with_length
from udkjax.scene.toml_files import dumps, load, loads, save

__all__ = [
    "GROUND",
    "Angle",
    "Body",
    "Cam",
    "Constraint",
    "Distance",
    "Driver",
    "Force",
    "ForceElement",
    "Frame",
    "Friction",
    "Gear",
    "Joint",
    "Mechanism",
    "Motion",
    "Point",
    "Polynomial",
    "Prismatic",
    "Profile",
    "Rack",
    "Revolute",
    "SceneError",
    "Sine",
    "Slot",
    "Spline",
    "Spring",
    "Torque",
    "TorsionSpring",
    "Weld",
    "between",
    "dumps",
    "library",
    "load",
    "loads",
    "save",
    "with_angle",
    "with_length",
]
