"""Models in which every feature of a scene occurs, for the table of functions by models (experiments/crossings.py)."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from experiments.common import HERE

EXAMPLES = HERE.parent / "examples"
ROD = '<geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1"/>'
MJCF = f"""<mujoco><option gravity="0 0 -9.81"/><worldbody>
<body name="a" pos="0 0 0"><joint name="j" axis="0 1 0" type="hinge"/>{ROD}
<body name="b" pos=".5 0 0"><joint name="k" axis="0 1 0" damping=".1"/>{ROD}</body></body></worldbody></mujoco>"""


class Drag(udk.ForceElement):
    """A force of one's own: smooth."""

    drag: jax.Array

    def loads(self, t, *frames):
        return [(0.0, 0.0, -self.drag * frames[0].omega)]


class Stopper(udk.ForceElement):
    """A force of one's own with a kink: an elastic stop, met during the run."""

    at: jax.Array
    stiffness: jax.Array

    def loads(self, t, *frames):
        return [(0.0, 0.0, -self.stiffness * jnp.maximum(frames[0].angle - self.at, 0.0))]


class Rod(eqx.Module):
    """A spherical pendulum, by functions."""

    weight: jax.Array
    length: jax.Array

    def mass(self, q):
        return self.weight * jnp.eye(3)

    def rows(self, t, q):
        return {"rod": q @ q - self.length**2}

    def height(self, t, q):
        return self.weight * 9.81 * q[2]


class Model(NamedTuple):
    """A model, and the events of its runs."""

    build: Callable[[], Any]
    events: Callable[[], Any] = lambda: None


def system() -> udk.ConstrainedSystem:
    """A `ConstrainedSystem`."""
    rod = Rod(jnp.array(2.0), jnp.array(1.0))
    start: Any = {"q0": jnp.array([0.6, 0.0, -0.8]), "v0": jnp.array([0.0, 1.0, 0.0])}
    return udk.ConstrainedSystem(rod.mass, constraint=rod.rows, potential=rod.height, **start)


def plain(*forces: udk.ForceElement, drivers: Any = None, **named: udk.ForceElement) -> udk.Mechanism:
    """A four-bar of bodies and joints, not of a drawing, with forces; it starts at 60 deg from a drawing of the library."""
    drawn = udk.library.four_bar()
    return udk.Mechanism(drawn.bodies, drawn.joints, drivers, {**named} or list(forces), drawn.gravity)


PIN, CRANK, COUPLER = "A", "crank", "coupler"


def rub(**numbers: Any) -> Callable[[], udk.Mechanism]:
    """A four-bar with friction in one pin."""
    return lambda: plain(udk.Friction(next(iter(plain().joints)), **numbers))


def drawn(**more: Any) -> Callable[[], udk.Mechanism]:
    """A four-bar of a drawing in millimetres, with further parts."""
    return lambda: udk.Drawing(
        pins={
            "O": (0, 0),
            "C": (100, 0),
            "A": udk.polar("O", 40, 60),
            "B": udk.circles(("A", "C"), (120, 80), "left"),
            "P": udk.polar("A", 70, 40, line=("A", "B")),
        },
        links={
            "crank": {"pins": ["O", "A"], "density": 7850, "width": 15, "thickness": 5},
            "coupler": {"pins": ["A", "B", "P"], "density": 7850, "thickness": 5},
            "rocker": {"pins": ["C", "B"], "density": 7850, "width": 15, "thickness": 5},
        },
        ground=["O", "C"],
        units={"length": "mm", "angle": "deg"},
        **more,
    ).mechanism()


def pendulum(driven: bool = False) -> udk.Mechanism:
    """Two rods in a row, for events; or both of them driven."""
    bodies = {"a": udk.Body(1.0, 1 / 12, [0.5, 0.0]), "b": udk.Body(1.0, 1 / 12, [1.5, 0.0])}
    joints = {
        "top": udk.Revolute(["ground", "a"], [[0.0, 0.0], [-0.5, 0.0]]),
        "knee": udk.Revolute(["a", "b"], [[0.5, 0.0], [-0.5, 0.0]]),
    }
    drivers = {
        "shoulder": udk.Driver(["ground", "a"], "angle", udk.Sine(0.3, 5.0)),
        "elbow": udk.Driver(["a", "b"], "angle", udk.Polynomial([0.0, 1.0, 2.0])),
    }
    return udk.Mechanism(bodies, joints, drivers if driven else None, gravity=[0.0, -9.81])


def wheels(kind: str) -> udk.Mechanism:
    """Two wheels, or a wheel and a slide, joined by gears, a rack, a screw or a belt."""
    bodies = {"w": udk.Body(1.0, 0.1, angular_velocity=2.0), "x": udk.Body(1.0, 0.1, [1.0, 0.0], angular_velocity=-2.0)}
    pins: dict[str, Any] = {k: udk.Revolute(["ground", k], [[p, 0.0], [0.0, 0.0]]) for k, p in (("w", 0.0), ("x", 1.0))}
    joint: Any = {"gear": udk.Gear(["w", "x"], [0.5, 0.5])}
    if kind == "rack":
        bodies["x"] = udk.Body(1.0, 0.1, [0.0, 0.5], velocity=[-1.0, 0.0])
        pins["x"] = udk.Prismatic(["ground", "x"], [[0.0, 0.5], [0.0, 0.0]], axis=0.0)
        joint = {"rack": udk.Rack(["x", "w"], radius=0.5, axis=0.0)}
    motor = {"motor": udk.Torque(["ground", "w"], 0.3), "spring": udk.TorsionSpring(["ground", "w"], 2.0, 0.05)}
    return udk.Mechanism(bodies, pins | joint, forces=motor)


def belt() -> udk.Mechanism:
    """Two wheels of a drawing, joined by a belt."""
    return udk.Drawing(
        pins={"O": (0, 0), "C": (200, 0), "A": (30, 0), "B": (260, 0)},
        links={
            "small": {"pins": ["O", "A"], "mass": "1 kg", "inertia": "0.001 kg m2"},
            "large": {"pins": ["C", "B"], "mass": "2 kg", "inertia": "0.004 kg m2"},
        },
        ground=["O", "C"],
        gears=[{"links": ["small", "large"], "radii": ["30 mm", "60 mm"], "belt": "open"}],
        units={"length": "mm"},
    ).mechanism()


def cam_of_laws() -> udk.Mechanism:
    """A drawn cam that moves a follower along its slide by laws."""
    profile = {"base": 40, "law": ["4-5-6-7", "4-5-6-7"], "angle": [180, 180], "lift": [20, -20]}
    return udk.Drawing(
        pins={"O": (0, 0), "P": (0, 40)},
        links={"cam": {"pins": ["O"], "mass": 1, "width": 60}, "follower": {"pins": ["P"], "mass": 1, "width": 10}},
        ground=["O"],
        slides=[{"link": "follower", "direction": [0, 1]}],
        cams=[{"pins": ["O", "P"], "profile": profile}],
        motors=[{"pin": "O", "speed": "60 rpm"}],
        units={"length": "mm", "angle": "deg"},
    ).mechanism()


def smooth_slide() -> udk.Mechanism:
    """A slider-crank whose guide rubs by its load."""
    scene = udk.library.slider_crank()
    guide = next(name for name, joint in scene.joints.items() if isinstance(joint, udk.Prismatic | udk.Slot))
    return udk.Mechanism(scene.bodies, scene.joints, scene.drivers, [udk.Friction(guide, coefficient=0.1)], scene.gravity)


def set_valued() -> udk.Mechanism:
    """A drawing with set-valued friction in all pins."""
    rubs = [{"pin": p, "coefficient": 0.15, "radius": 3, "law": "set-valued"} for p in "OABC"]
    return drawn(friction=rubs, velocities={"A": ["-0.5 m/s", "0.2887 m/s"]})()


def with_driver(motion: udk.Motion) -> Callable[[], udk.Mechanism]:
    """A four-bar whose crank is driven."""
    return lambda: plain(drivers={"motor": udk.Driver(["ground", CRANK], "angle", motion)})


def jack() -> udk.Mechanism:
    """A screw that a torque turns lifts a nut in an inclined guide, which the nut loads across; both rub."""
    bodies = {"screw": udk.Body(2.0, 0.05, angular_velocity=3.0), "nut": udk.Body(1.0, 0.02, [0.0, 0.1])}
    guide = ["ground", "nut"], [[0.0, 0.1], [0.0, 0.0]]
    joints = {
        "pin": udk.Revolute(["ground", "screw"], [[0.0, 0.0], [0.0, 0.0]]),
        "guide": udk.Prismatic(*guide, axis=1.2),
        "thread": udk.Screw(*guide, axis=1.2, turning=["ground", "screw"], lead=0.01),
    }
    rubs = {"bearing": udk.Friction("pin", torque=0.05, velocity=0.1), "rub": udk.Friction("guide", coefficient=0.2)}
    return udk.Mechanism(bodies, joints, forces=rubs | {"motor": udk.Torque(["ground", "screw"], 0.4)})


def finger() -> udk.Mechanism:
    """A finger of three phalanges: a tendon couples the last two, the first rubs, and a torque bends it."""
    lengths, ends, names = (0.05, 0.03, 0.02), (0.0, 0.05, 0.08), ("proximal", "middle", "distal")
    bodies = {
        name: udk.Body(size, size * length**2 / 12, [at + length / 2, 0.0])
        for name, size, length, at in zip(names, (0.03, 0.02, 0.01), lengths, ends, strict=True)
    }
    joints: dict[str, Any] = {"knuckle": udk.Revolute(["ground", "proximal"], [[0.0, 0.0], [-0.025, 0.0]])}
    for (first, second), (a, b) in zip(pairwise(names), pairwise(lengths), strict=True):
        joints[second] = udk.Revolute([first, second], [[a / 2, 0.0], [-b / 2, 0.0]])
    joints["tendon"] = udk.Coupling(["proximal", "middle"], ["middle", "distal"], [0.0, 0.7])
    forces = {
        "flexor": udk.Torque(["ground", "proximal"], -0.02),
        "extensor": udk.TorsionSpring(["proximal", "middle"], 0.05, 1e-4),
        "rub": udk.Friction("knuckle", torque=1e-3, law="set-valued"),
    }
    return udk.Mechanism(bodies, joints, forces=forces)


def block() -> udk.Mechanism:
    """A block that slides along a rail with set-valued friction."""
    rail = {"rail": udk.Prismatic(["ground", "block"], [[0.0, 0.0], [0.0, 0.0]], axis=0.0)}
    rub = udk.Friction("rail", coefficient=0.1, law="set-valued")
    return udk.Mechanism({"block": udk.Body(1.0, 0.1, velocity=[2.0, 0.0])}, rail, forces={"rub": rub})


def start_angle() -> float:
    """The angle of the crank of the library's four-bar."""
    return float(udk.library.four_bar().q0[0, 2])


SAMPLES = np.array([0.1, -0.1, 0.2])
MODELS: dict[str, Model] = {
    "plain, redundant": Model(udk.library.parallelogram),
    "plain": Model(plain),
    "library, drawn": Model(udk.library.four_bar),
    "file": Model(lambda: udk.load(EXAMPLES / "six_bar.toml")),
    "MJCF": Model(lambda: udk.read_mjcf(MJCF)),
    "system": Model(system),
    "driver": Model(udk.library.slider_crank),
    "driver, polynomial": Model(lambda: with_driver(udk.Polynomial([start_angle(), 2.0, 1.0]))()),
    "driver, spline": Model(
        lambda: with_driver(udk.Spline([0.0, 0.07, 0.3], [start_angle(), start_angle() + 0.1, start_angle() + 0.5]))()
    ),
    "two drivers": Model(lambda: pendulum(driven=True)),
    "three freedoms": Model(udk.library.excavator),
    "friction torque": Model(rub(torque=0.01, velocity=0.01)),
    "friction by load": Model(rub(coefficient=0.1, radius=0.01)),
    "friction, set-valued": Model(set_valued),
    "friction in a guide": Model(smooth_slide),
    "torsion spring, damper": Model(lambda: plain(udk.TorsionSpring(["ground", CRANK], 1.0, 0.01))),
    "samples, torque": Model(lambda: plain(udk.Torque(["ground", CRANK], udk.Held(SAMPLES, 0.05)))),
    "samples, servo": Model(lambda: plain(udk.TorsionSpring(["ground", CRANK], 2.0, 0.1, udk.Held(SAMPLES, 0.05)))),
    "own force": Model(lambda: plain(Drag([CRANK], jnp.array(0.01)))),
    "own force, kinked": Model(lambda: plain(Stopper([CRANK], jnp.array(start_angle() + 1e-3), jnp.array(5.0)))),
    "own force, kinked, drawn": Model(
        lambda: drawn(forces={"stop": Stopper([CRANK], jnp.array(np.deg2rad(59.5)), jnp.array(-0.5))})()
    ),
    "drawn, spring": Model(drawn(springs=[{"between": ["O", "P"], "stiffness": "1 N/mm", "length": 60}])),
    "drawn, damper": Model(drawn(dampers=[{"between": ["O", "P"], "damping": "1 N s/m"}])),
    "drawn, load": Model(drawn(loads=[{"pin": "P", "force": ["0 N", "-5 N"]}])),
    "drawn, motor, friction": Model(
        drawn(
            motors={"motor": {"pin": "O", "speed": "60 rpm"}},
            friction=[{"pin": "B", "coefficient": 0.1, "radius": 5}],
        )
    ),
    "gears": Model(lambda: wheels("gear")),
    "planetary gear": Model(udk.library.planetary_gear),
    "rack": Model(lambda: wheels("rack")),
    "belt": Model(belt),
    "cam": Model(lambda: udk.load(EXAMPLES / "drawings" / "cam_follower.toml")),
    "cam of laws, drawn": Model(cam_of_laws),
    "slots": Model(udk.library.elliptic_trammel),
    "no gravity": Model(
        lambda: udk.Mechanism(plain().bodies, plain().joints, None, [udk.TorsionSpring(["ground", CRANK], 1.0)], [0.0, 0.0])
    ),
    "stop": Model(pendulum, lambda: udk.Event(lambda t, frames: frames["a"].angle + 0.1, udk.Stop())),
    "log": Model(pendulum, lambda: udk.Event(lambda t, frames: frames["a"].angle + 0.1, udk.Log())),
    "impact": Model(pendulum, lambda: udk.Event(lambda t, frames: frames["a"].angle + 0.1, udk.Impact(0.5))),
    "joint limit": Model(pendulum, lambda: udk.JointLimit("top", lower=-0.1, restitution=0.3)),
    "contact, friction": Model(
        pendulum,
        lambda: udk.Contact("b", [0.5, 0.0], [0.0, -0.2], restitution=0.0, coefficient=0.3),
    ),
    "release": Model(pendulum, lambda: udk.Event(lambda t, frames: t - 0.1, udk.Release("knee"), direction=1)),
    "lock": Model(pendulum, lambda: udk.Event(lambda t, frames: t - 0.1, udk.Lock("knee"), direction=1)),
    "attach": Model(
        pendulum,
        lambda: udk.Event(lambda t, frames: t - 0.1, udk.Attach(udk.Angle(["a", "b"]), "straight"), direction=1),
    ),
    "screw, friction": Model(jack),
    "coupling, contact that sticks": Model(
        finger, lambda: udk.Contact("distal", [0.01, 0.0], [0.0, -0.03], restitution=0.0, coefficient=1.0)
    ),
    "limit, friction, set-valued": Model(block, lambda: udk.JointLimit("rail", upper=0.3)),
}
