"""Springs, dampers and actuators of an MJCF model as force elements; unsupported parts are refused, or left out on demand."""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from udkjax.scene.elements.forces import Force, ForceElement, Spring, Torque, TorsionSpring
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mjcf.body_tree import unique_name
from udkjax.scene.mjcf.coupled_lengths import CoupledLength, CoupledLengths
from udkjax.scene.mjcf.model_settings import merge_parts
from udkjax.scene.mjcf.vocabulary import ACTUATORS
from udkjax.scene.mjcf.xml_tree import AttributeReader, XmlElement
from udkjax.wording import quote

LEFT_OUT = ("limits", "frictionloss", "forceranges", "contacts")  # parts of a model that a caller may leave out
# Sizes of a model: the distance of a point that no slide reaches, but not so large that it looks like a mistake.
FAR_AWAY = 16.0


class LinearForce(NamedTuple):
    """The force -stiffness (length - at_rest) - damping rate + constant along a coordinate.

    Without a motor, `constant` is None.
    """

    stiffness: float = 0.0
    damping: float = 0.0
    at_rest: float = 0.0
    constant: float | None = None


class ForceReader:
    """A reader of springs, dampers and actuators of a model, whose attribute `forces` has the force elements by name."""

    def __init__(self, root: XmlElement, lengths: CoupledLengths, controls: Mapping[str, float], leave_out: Collection[str]):
        self.lengths, self.model, self.settings, self.leave_out = lengths, lengths.model, lengths.settings, leave_out
        self.forces: dict[str, ForceElement] = {}
        # Hinges that are revolute joints of the mechanism.
        self.revolute = {name for name, _, joints in self.model.named_joints() if [joint.kind for joint in joints] == ["hinge"]}
        for joint in self.model.joints:
            self._add_passive(joint.name, lengths.joints[joint.name], joint.read)
        for name, length in lengths.tendons.items():
            if length:
                self._add_passive(name, length, lengths.tendon_attributes[name])
        for element in merge_parts(root, ("actuator",)).children:
            if element.tag in ACTUATORS and "actuation" not in self.settings.disabled:
                self._add_actuator(self.settings.read(element), controls.get(element.attributes.get("name", ""), 0.0))

    def _add_passive(self, name: str, length: CoupledLength, read: AttributeReader) -> None:
        """Add the spring and the damper of a joint or a tendon, and refuse its unsupported attributes."""
        disabled = self.settings.disabled
        if "limit" not in disabled and self.settings.is_limited(read, "limited", "range"):
            self._leave_or_refuse("limits", read, f"range is not supported: {self._limit_cure(name, length, read)}")
        if "frictionloss" not in disabled and (loss := read.number("frictionloss")):
            self._add_friction(name, read, loss)
        if "actuation" not in disabled and self.settings.is_limited(read, "actuatorfrclimited", "actuatorfrcrange"):
            self._leave_or_refuse("forceranges", read, "actuatorfrcrange is not supported: forces have no limits here")
        stiffness, damping = (
            0.0 if flag in disabled else self._linear_term(read, key)
            for key, flag in (("stiffness", "spring"), ("damping", "damper"))
        )
        self._add_force(name, length, read, LinearForce(stiffness, damping, length.at_rest))

    def _add_friction(self, name: str, read: AttributeReader, loss: float) -> None:
        """Add the dry friction of a hinge, whose torque is at most `loss`."""
        if loss < 0:
            read.refuse("frictionloss must not be negative")
        elif read.element.tag != "joint" or name not in self.revolute:
            self._leave_or_refuse("frictionloss", read, "frictionloss is supported in a hinge that is its body's only joint")
        elif "frictionloss" not in self.leave_out:
            self._put(name, Friction(name, torque=loss, law="set-valued"))

    def _linear_term(self, read: AttributeReader, name: str) -> float:
        value = read.numbers(name, (0.0, 0.0, 0.0), fewest=1)
        if value[1:].any():
            read.refuse(f"{name}={quote(read.text(name))} grows with powers of the motion: only its first number is supported")
        return float(value[0])

    def _limit_cure(self, name: str, length: CoupledLength, read: AttributeReader) -> str:
        low, high = read.numbers("range", (0.0, 0.0))
        if len(length.angles) == 2 and min(length.angles) >= 0 and read.element.tag == "joint":
            holder, body = sorted(length.angles)
            sign, radians = length.angles[body], self.settings.radians
            limits = sorted(self.model.relative_angle(holder, body) + sign * (x * radians - length.length) for x in (low, high))
            return f'give the event `udk.JointLimit("{name}", {limits[0]:.6g}, {limits[1]:.6g})`'
        return "give an event, `udk.JointLimit` or `udk.Stop`"

    def _leave_or_refuse(self, kind: str, read: AttributeReader, text: str) -> None:
        """Refuse a part of the model unless the caller leaves out parts of its kind."""
        if kind not in self.leave_out:
            read.refuse(f'{text}; leave_out=["{kind}"] leaves it out')

    def _add_actuator(self, read: AttributeReader, control: float) -> None:
        kind = read.element.tag
        gain, bias = read.numbers("gainprm", (1.0, 0.0, 0.0), fewest=1)[0], np.zeros(3)
        if kind == "position":
            gain = read.number("kp", 1.0)
            bias[1:] = -gain, -read.number("kv")
        elif kind == "velocity":
            gain = read.number("kv", 1.0)
            bias[2] = -gain
        elif kind == "general":
            read.choice("gaintype", ("fixed",), "fixed")
            if read.choice("biastype", ("none", "affine"), "none") == "affine":
                bias = read.numbers("biasprm", (0.0, 0.0, 0.0), fewest=1)
        if self.settings.is_limited(read, "forcelimited", "forcerange"):
            self._leave_or_refuse("forceranges", read, "forcerange is not supported: forces have no limits here")
        if self.settings.is_limited(read, "ctrllimited", "ctrlrange"):
            control = float(np.clip(control, *read.numbers("ctrlrange", (0.0, 0.0))))
        if "tendon" in read:
            length = self.lengths.named_tendon(read, "tendon")
        else:
            length = self.lengths.named_joint(read, "joint")
        if length is None or kind not in ACTUATORS:
            return
        gear = read.numbers("gear", (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), fewest=1)[0]
        # The force gear (gain control + bias0 + bias1 gear x + bias2 gear x_dot) of the length x: with bias1, its constant part
        # shifts the length of a spring at rest; without, it is a motor's.
        constant, at_rest = gear * (gain * control + bias[0]), 0.0
        if bias[1] and gear:
            constant, at_rest = 0.0, -constant / (bias[1] * gear**2)
        is_motor = not np.any(bias[1:]) or constant
        force = LinearForce(-bias[1] * gear**2, -bias[2] * gear**2, at_rest, constant if is_motor else None)
        self._add_force(read.text("name") or kind, length, read, force)

    def _add_force(self, name: str, length: CoupledLength, read: AttributeReader, force: LinearForce) -> None:
        stiffness, damping, at_rest, constant = force
        if not stiffness and not damping and constant is None:
            return
        if stiffness < 0 or damping < 0:
            read.refuse("stiffness and damping must not be negative")
        elif length.slide:
            self._add_slide_force(name, length, read, force)
        elif length.ends and constant is None:
            self._put(name, Spring(*self.model.attached(length.ends), stiffness, max(at_rest, 0.0), damping or None))
        elif len(length.angles) == 2 and min(length.angles) >= 0:
            (body1, _), (body2, factor) = length.angles.items()
            bodies, angle = self.model.names((body1, body2)), self.model.relative_angle(body1, body2)
            if stiffness or damping:
                free = angle + (at_rest - length.length) / factor
                self._put(name, TorsionSpring(bodies, factor**2 * stiffness, factor**2 * damping or None, free))
            if constant is not None:
                self._put(name, Torque(bodies, factor * constant))
        else:
            action = "with a constant force between two sites" if length.ends else "on the angles of more than two bodies"
            read.refuse(f"acts {action}, or on one of two hinges of a body: not supported")

    def _add_slide_force(self, name: str, length: CoupledLength, read: AttributeReader, force: LinearForce) -> None:
        stiffness, damping, at_rest, constant = force
        joint = length.slide
        assert joint is not None
        slider, holder = joint.body, self.model.holder(joint.body)
        kinds = "".join(j.kind[0] for j in self.model.tree.bodies[slider].joints)
        hinges = [j for j in self.model.tree.bodies[slider].joints if j.kind == "hinge"]
        pin, axis = self.model.plane.flat((hinges or [joint])[0].anchor), self.model.plane.flat(joint.axis)
        if kinds not in ("s", "sh", "hs"):
            read.refuse("acts on a slide of a body with several slides: not supported")
            return
        owner, other, axis = (slider, holder, -axis) if kinds == "hs" else (holder, slider, axis)
        bodies, end = self.model.names((owner, other)), self.model.local(other, pin)
        if stiffness:  # of zero length, attached at the rest position: linear in both directions of the slide
            self._put(
                name, Spring(bodies, [self.model.local(owner, pin + axis * (at_rest - length.length)), end], stiffness, 0.0)
            )
        if damping:  # attached to a point on the line of the slide that is too far to be reached
            self._put(
                name, Spring(bodies, [self.model.local(owner, pin - FAR_AWAY * self.model.size * axis), end], 0.0, 0.0, damping)
            )
        if constant is None:
            return
        push = constant * axis
        if not owner:
            self._put(name, Force(bodies[1], (push.real, push.imag), end))
        elif kinds == "s":
            for body, sign in ((other, 1), (owner, -1)):
                local_push = sign * push * np.exp(-1j * self.model.bodies[body].angle)
                force_on_body = Force(
                    self.model.bodies[body].name, (local_push.real, local_push.imag), self.model.local(body, pin), "body"
                )
                self._put(name, force_on_body)
        else:
            read.refuse("acts on a slide between two moving bodies that turn against each other: not supported")

    def _put(self, name: str, force: ForceElement) -> None:
        self.forces[unique_name(name, self.forces)] = force
