"""Vocabulary of MJCF: parts that are read, parts without effect on a motion, and parts that are refused unless they are inactive.

Elements and attributes that are not listed here are refused by name.
"""

from collections.abc import Mapping
from typing import NamedTuple

from udkjax.scene.mjcf.xml_tree import XmlElement
from udkjax.wording import quote

# Elements without effect on motions.
WITHOUT_EFFECT = ("visual", "statistic", "asset", "sensor", "custom", "size", "light", "camera")
CONTEXT_TAGS = ("equality", "spatial", "fixed")  # parents that determine the meaning of the tags of their children
ACTUATORS = ("motor", "position", "velocity", "general")
DEFAULTS_ONLY = ("material", "mesh", "texture", "pair")  # only in defaults

_POSE_ATTRIBUTES = "pos quat axisangle xyaxes zaxis euler"
_LOOK_ATTRIBUTES = "group material rgba user"
_SOFTNESS = "solref solimp"  # softness of constraints, which are ideal here


class _Attributes(NamedTuple):
    used: str
    idle: str = ""  # attributes without effect on the motion
    inactive: Mapping[str, str] = {}  # attributes with the only value that is accepted, which has no effect


def _actuator(used: str = "", **inactive: str) -> _Attributes:
    shared = "name class joint tendon gear ctrlrange ctrllimited forcerange forcelimited"
    idle = "group user lengthrange input actlimited actrange"
    return _Attributes(f"{shared} {used}", idle, {"damping": "0", "armature": "0", "delay": "0", "nsample": "0", **inactive})


_EQUALITY = _Attributes("name class active", _SOFTNESS)
_TENDON = _Attributes(
    "name class limited range springlength stiffness damping frictionloss",
    f"width margin solreflimit solimplimit solreffriction solimpfriction {_LOOK_ATTRIBUTES}",
    {"armature": "0", "springyield": "0"},
)
_KNOWN_ATTRIBUTES: dict[str, _Attributes] = {
    "compiler": _Attributes(
        "angle eulerseq autolimits inertiafromgeom inertiagrouprange settotalmass",
        "meshdir texturedir assetdir strippath discardvisual usethread fusestatic saveinertial savecompiled savecanonical "
        "conflict passthrough fitaabb alignfree convexhull exactmeshinertia",
        {"coordinate": "local", "boundmass": "0", "boundinertia": "0", "balanceinertia": "false"},
    ),
    "option": _Attributes(
        "gravity",
        "timestep apirate impratio wind magnetic o_margin o_solref o_solimp o_friction integrator cone jacobian solver "
        "iterations tolerance ls_iterations ls_tolerance noslip_iterations noslip_tolerance mpr_iterations mpr_tolerance "
        "ccd_iterations ccd_tolerance sleep_tolerance sdf_iterations sdf_initpoints",
        {"density": "0", "viscosity": "0"},
    ),
    "flag": _Attributes(
        "constraint equality limit contact spring damper gravity actuation frictionloss",
        "clampctrl warmstart filterparent refsafe sensor midphase nativeccd island eulerdamp autoreset energy fwdinv invdiscrete "
        "multiccd sleep diagexact override",
    ),
    "mujoco": _Attributes("model"),
    "default": _Attributes("class"),
    "worldbody": _Attributes(""),
    "body": _Attributes(f"name childclass {_POSE_ATTRIBUTES}", "user sleep simple fuse", {"mocap": "false", "gravcomp": "0"}),
    "frame": _Attributes(f"name childclass {_POSE_ATTRIBUTES}"),
    "inertial": _Attributes(f"mass diaginertia fullinertia {_POSE_ATTRIBUTES}"),
    "joint": _Attributes(
        "name class type pos axis range limited ref springref stiffness damping armature frictionloss actuatorfrcrange "
        "actuatorfrclimited",
        "group user margin solreflimit solimplimit solreffriction solimpfriction actuatorgravcomp",
        {"springdamper": "0 0", "springyield": "0"},
    ),
    "geom": _Attributes(
        f"name class type size fromto mass density contype conaffinity group {_POSE_ATTRIBUTES}",
        f"mesh hfield condim priority friction solmix margin gap fluidcoef {_SOFTNESS} {_LOOK_ATTRIBUTES}",
        {"shellinertia": "false", "fluidshape": "none"},
    ),
    "site": _Attributes(f"name class fromto {_POSE_ATTRIBUTES}", f"type mesh size {_LOOK_ATTRIBUTES}"),
    "equality": _EQUALITY,
    "connect": _EQUALITY._replace(used=f"{_EQUALITY.used} body1 body2 anchor site1 site2"),
    "weld": _EQUALITY._replace(
        used=f"{_EQUALITY.used} body1 body2 anchor relpose site1 site2 torquescale",
    ),
    "equality/joint": _EQUALITY._replace(used=f"{_EQUALITY.used} joint1 joint2 polycoef"),
    "equality/tendon": _EQUALITY._replace(used=f"{_EQUALITY.used} tendon1 tendon2 polycoef"),
    "tendon": _TENDON,
    "spatial": _TENDON,
    "spatial/site": _Attributes("site"),
    "fixed": _TENDON,
    "fixed/joint": _Attributes("joint coef"),
    "actuator": _Attributes(""),
    "motor": _actuator(),
    "position": _actuator("kp kv", timeconst="0", dampratio="0", inheritrange="0"),
    "velocity": _actuator("kv"),
    "general": _actuator("gainprm biasprm gaintype biastype", dyntype="none", dynprm="1", actdim="-1", inheritrange="0"),
    "contact": _Attributes(""),
    "pair": _Attributes("name class geom1 geom2", f"condim friction gap margin solreffriction {_SOFTNESS}"),
    "exclude": _Attributes("name body1 body2"),
    "keyframe": _Attributes(""),
    "key": _Attributes("name qpos qvel ctrl", "time act mpos mquat plastic"),
}
_CURES = {
    "freejoint": 'a free planar body has two <joint type="slide"/> and a hinge',
    "springdamper": "give stiffness and damping",
    "dampratio": "give kv",
    "gravcomp": "balance the weight by a <motor>",
}


def unknown_parts(root: XmlElement) -> list[str]:
    """Return messages about the elements and attributes of a model that are not supported and could change its motion."""
    problems: list[str] = []
    if root.tag != "mujoco":
        return [f"{root.where}: an MJCF model begins with <mujoco>"]
    skipped: set[int] = set()
    for element, parent in [(root, root), *root.walk()]:
        if id(parent) in skipped or element.tag in WITHOUT_EFFECT or (parent.tag == "default" and element.tag in DEFAULTS_ONLY):
            skipped.add(id(element))
            continue
        path = f"{parent.tag}/{element.tag}"
        key = path if parent.tag in CONTEXT_TAGS and element.tag in ("joint", "tendon", "site", "geom") else element.tag
        if key not in _KNOWN_ATTRIBUTES:
            skipped.add(id(element))
            problems.append(f"{element.where}: not supported{_cure(element.tag)}")
            continue
        known = _KNOWN_ATTRIBUTES[key]
        words = {*known.used.split(), *known.idle.split()}
        for name, value in element.attributes.items():
            if name not in words and not _is_without_effect(value, known.inactive.get(name)):
                problems.append(f"{element.where}: {name}={quote(value)} is not supported{_cure(name)}")
    return problems


def _cure(name: str) -> str:
    return f": {_CURES[name]}" if name in _CURES else ""


def _is_without_effect(value: str, inactive: str | None) -> bool:
    if inactive is None or value == inactive:
        return inactive is not None
    try:
        given, empty = ([float(word) for word in text.split()] for text in (value, inactive))
    except ValueError:
        return False
    return all(x == (empty[k] if k < len(empty) else 0.0) for k, x in enumerate(given)) or (
        len(given) == 1 and given[0] < 0 >= empty[0]
    )
