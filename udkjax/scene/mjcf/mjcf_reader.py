"""Read planar MJCF models, the XML format of MuJoCo, as mechanisms."""

import os
import warnings
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME, Body
from udkjax.scene.elements.couplings import Gear
from udkjax.scene.elements.joints import Angle, Distance, Joint, Prismatic, Revolute, Slot
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.mechanism_tables import is_xml
from udkjax.scene.mjcf.body_tree import BodyTree, TreeJoint, unique_name
from udkjax.scene.mjcf.coupled_lengths import CoupledLengths
from udkjax.scene.mjcf.equality_reader import EqualityReader
from udkjax.scene.mjcf.force_reader import LEFT_OUT, ForceReader
from udkjax.scene.mjcf.model_settings import ModelSettings, merge_parts
from udkjax.scene.mjcf.plane_model import AXES_TOL, PlaneModel, PlaneMotion, contact_pairs, plane_of
from udkjax.scene.mjcf.vocabulary import unknown_parts
from udkjax.scene.mjcf.xml_tree import AttributeReader, XmlElement, parse_xml
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import abbreviate, suggestion

INITIAL_KEYFRAME = "initial"  # the keyframe with velocities and controls that `mjcf_text` writes
OPEN_LOOP_TOL = 1e-9  # relative to the size of the model: smaller gaps are rounding errors
ROTOR_MASS = 0.01  # mass of a rotor relative to the body that carries it


class MjcfWarning(UserWarning):
    """A warning that an MJCF model may not behave as intended: loops are open, or contacts are ignored."""


def read_mjcf(source: str | os.PathLike[str], leave_out: Collection[str] = (), key: str | None = None) -> Mechanism:
    """Read a planar mechanism from an MJCF model, the XML format of MuJoCo.

    The plane may have any orientation: y of the mechanism is the world's z, or the world's y if the plane is horizontal.
    Constraints are ideal, whereas MuJoCo's are soft. A `MjcfWarning` lists loops that are open in the file.

    Args:
        source: The file, or its text.
        leave_out: Parts to ignore, of "limits", "frictionloss", "forceranges" and "contacts". By default limits and force ranges
            are refused, frictionloss is read in hinges and refused elsewhere, and contacts give a warning.
        key: The keyframe of the initial state; by default the one named "initial", or else the position of the file.

    Returns:
        The mechanism.

    Raises:
        SceneError: The model is wrong, not planar, or has unsupported parts; the error lists all of them, with line numbers.
        OSError: The file cannot be read.
    """
    path = "" if isinstance(source, str) and is_xml(source) else os.fspath(source)
    wrong = [name for name in leave_out if name not in LEFT_OUT]
    if isinstance(leave_out, str) or wrong:
        raise SceneError([f"leave_out: must be a list of {', '.join(LEFT_OUT)}, not {abbreviate(leave_out)}"], path)
    try:
        return mechanism_of_text(Path(path).read_text(encoding="utf-8") if path else str(source), path, leave_out, key)
    except UnicodeDecodeError as error:
        raise SceneError([f"not a text file in UTF-8 ({error})"], path) from None


def mechanism_of_text(
    text: str, source: str, leave_out: Collection[str] = (), key: str | None = None, stacklevel: int = 3
) -> Mechanism:
    """Return the mechanism of the text of a model, as `read_mjcf` does.

    `source` is the path of the file, or "" for a text without one. Warnings point to the caller `stacklevel` levels up.
    """
    root = parse_xml(text, source)
    problems = unknown_parts(root)
    unknown_count = len(problems)
    settings = ModelSettings(root, problems)
    tree = BodyTree(root, settings)
    plane = plane_of(list(tree.joints.values()), settings.gravity)
    if not tree.joints:
        problems.append("<mujoco>: no body has a joint: nothing moves")
    if len(problems) > unknown_count:
        raise SceneError(problems, source)
    model = PlaneModel(tree, plane)
    values, rates, controls = _initial_state(root, model, key)
    motions = model.motions(values, rates)
    tree_joints = {name: joint for name, body, joints in model.named_joints() if (joint := _tree_joint(model, body, joints))}
    lengths = CoupledLengths(root, model)
    forces = ForceReader(root, lengths, controls, leave_out).forces
    loops = EqualityReader(root, lengths, motions, list(tree_joints)).joints
    bodies = {model.bodies[k].name: _body(model, k, motions[k]) for k, _ in tree.moving()}
    joints = tree_joints | loops
    for name, body, joints_of_body in model.named_joints():
        for joint in joints_of_body:
            _add_armature(model, joint, name, body, bodies, joints)
    if problems:
        raise SceneError(problems, source)
    gravity = plane.flat(settings.gravity)
    name = root.attributes.get("model", "")
    mechanism = Mechanism(bodies, joints, {}, forces, (gravity.real, gravity.imag), name)
    messages = [
        f"{loop} is open by {gap:.3g} (m, rad), which assembly closes" for loop, gap in _gaps(mechanism, list(loops), model.size)
    ]
    if "contact" not in settings.disabled and "contacts" not in leave_out and (pairs := contact_pairs(root, tree, plane)):
        further = f" and {len(pairs) - 3} more pairs" * (len(pairs) > 3)
        messages.append(
            f"contacts are not read: {'; '.join(pairs[:3])}{further}; give an event `udk.Contact` for each point that hits"
        )
    for message in messages:
        warnings.warn(message, MjcfWarning, stacklevel=stacklevel)
    return mechanism


def _initial_state(root: XmlElement, model: PlaneModel, key: str | None) -> tuple[dict[str, float], ...]:
    """Return values and rates of joints, and controls of actuators, by name, from a keyframe; empty without one.

    The keyframe is that named `key`, or by default the one named "initial".
    """
    keys = {element.attributes.get("name", ""): element for element in merge_parts(root, ("keyframe",)).children}
    problems, joints = model.tree.settings.problems, [joint.name for joint in model.joints]
    if key is not None and key not in keys:
        problems.append(f"<keyframe>: no key has the name {abbreviate(key)}{suggestion(key, keys)}")
    element = keys.get(INITIAL_KEYFRAME if key is None else key)
    if element is None:
        return {}, {}, {}
    read = AttributeReader(element, element.attributes, problems)
    actuators = [child.attributes.get("name", "") for child in merge_parts(root, ("actuator",)).children]
    values = []
    for attribute, names in (("qpos", joints), ("qvel", joints), ("ctrl", actuators)):
        given = attribute in read and names
        values.append(dict(zip(names, read.numbers(attribute, np.zeros(len(names))).tolist(), strict=True)) if given else {})
    return tuple(values)


def _tree_joint(model: PlaneModel, body: int, joints: list[TreeJoint]) -> Joint | None:
    """Return the joint between a body and its holder, from its hinges and slides in order; None if the body is free.

    None also if the hinges and slides are refused.
    """
    holder, kinds = model.holder(body), "".join(joint.kind[0] for joint in joints)
    names, angle = model.names((holder, body)), model.relative_angle(holder, body)
    anchors, axes = [model.plane.flat(joint.anchor) for joint in joints], [model.plane.flat(joint.axis) for joint in joints]
    slides = [axis for axis, joint in zip(axes, joints, strict=True) if joint.kind == "slide"]
    parallel = len(slides) == 2 and abs((slides[0] * np.conj(slides[1])).imag) < AXES_TOL
    if sorted(kinds) == ["h", "s", "s"] and not parallel:
        return None
    pin = anchors[kinds.find("h")] if "h" in kinds else anchors[0]
    points = [model.local(holder, pin), model.local(body, pin)]
    if kinds == "h":
        return Revolute(names, points)
    if kinds == "s":
        return Prismatic(names, points, model.direction(holder, axes[0]), angle)
    if kinds == "sh":
        return Slot(names, points, model.direction(holder, axes[0]))
    if kinds == "hs":
        return Slot(names[::-1], points[::-1], model.direction(body, axes[1]))
    if kinds == "ss" and not parallel:
        return Angle(names, angle)
    if kinds == "hh" and abs(anchors[1] - anchors[0]) > AXES_TOL * model.size:
        ends = [model.local(holder, anchors[0]), model.local(body, anchors[1])]
        return Distance(names, ends, abs(anchors[1] - anchors[0]))
    text = "a body in a plane has at most one hinge and two slides that are not parallel"
    model.tree.settings.problems.append(f"{model.tree.bodies[body].where}: {text}")
    return None


def _body(model: PlaneModel, number: int, motion: PlaneMotion) -> Body:
    """Return a moving body in its initial state."""
    body = model.bodies[number]
    centre = motion.point(body.centre)
    velocity = motion.velocity(centre)
    angle = body.angle + motion.angle
    return Body(body.mass, body.inertia, (centre.real, centre.imag), angle, (velocity.real, velocity.imag), motion.omega)


def _add_armature(
    model: PlaneModel, joint: TreeJoint, name: str, number: int, bodies: dict[str, Body], joints: dict[str, Joint]
) -> None:
    """Add the rotor of a joint, with energy 1/2 A w^2, w the rate of the joint and A its `armature`.

    If the ground holds the body, the armature adds to its inertia, or mass. Between body 1 and body 2, a rotor is
    pinned to the centre of body 1; relative to body 1 it turns N = 1 + 2 A / I2 times as fast as body 2. With the inertia
    J = A / (N (N - 1)) its energy is

        1/2 J (w1 + N (w2 - w1))^2 = 1/2 A (w2 - w1)^2 - 1/2 (A / N) w1^2 + 1/2 (A / (N - 1)) w2^2,

    so A / N is added to the inertia of body 1, and A / (N - 1), half of the inertia of body 2, is subtracted from that of body 2.
    The rotor's mass is taken from body 1.
    """
    armature, holder = joint.read.number("armature"), model.holder(number)
    if not armature:
        return
    body1, body2 = model.names((holder, number))
    body, alone = bodies[body2], len(model.tree.bodies[number].joints) == 1
    if armature < 0:
        joint.read.refuse("armature must not be negative")
    elif model.has_rod(number):
        joint.read.refuse("the armature of one of two hinges of a body is not supported")
    elif joint.kind == "slide":
        weight = model.plane.flat(model.tree.settings.gravity) * np.conj(model.plane.flat(joint.axis))
        if holder or not alone or abs(weight.real) > AXES_TOL * abs(weight):
            joint.read.refuse(
                "the armature of a slide is supported only on the ground, across gravity, and without other joints of its body"
            )
        bodies[body2] = replace(body, mass=body.mass + armature)
    elif not holder:
        bodies[body2] = replace(body, inertia=body.inertia + armature)
    else:
        carrier, ratio = bodies[body1], float(1 + 2 * armature / body.inertia)
        spin = carrier.angular_velocity + ratio * (body.angular_velocity - carrier.angular_velocity)
        rotor, axle = unique_name(f"{joint.name} rotor", bodies), unique_name(f"{joint.name} axle", joints)
        mass = ROTOR_MASS * carrier.mass
        inertia = body.inertia / (2 * ratio)  # A / (N (N - 1))
        bodies[rotor] = Body(mass, inertia, carrier.position, carrier.angle, carrier.velocity, spin)
        bodies[body1] = replace(carrier, mass=carrier.mass - mass, inertia=carrier.inertia + armature / ratio)
        bodies[body2] = replace(body, inertia=body.inertia / 2)
        joints[axle] = Revolute((body1, rotor), [(0.0, 0.0), (0.0, 0.0)])
        joints[unique_name(f"{joint.name} gear", joints)] = Gear((rotor, body2), (1.0, ratio), internal=True, carrier=body1)


def _gaps(mechanism: Mechanism, loops: list[str], size: float) -> list[tuple[str, float]]:
    """Return the names of those of the joints `loops` that are open in the initial guess, and their gaps (m, rad)."""
    gaps = []
    for name in loops:
        joint = mechanism.joints[name]
        frames = [GROUND_FRAME if body == GROUND else mechanism.bodies[body].frame() for body in joint.frame_names]
        gap = float(np.max(np.abs(np.asarray(joint.residual(0.0, *frames)))))
        gaps += [(name, gap)] if gap > OPEN_LOOP_TOL * max(size, 1.0) else []
    return gaps
