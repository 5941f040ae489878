"""MuJoCo: a tree of four hinges, two points connected as stiffly as the step allows, the Runge-Kutta method of order four."""

from functools import partial
from importlib import import_module

import numpy as np

from benchmarks.peers.peer import GRAVITY, INERTIA, MASS, PINS, PIVOTS, SPACING, Coordinates, Peer, Problem, Run, coordinates

STIFFNESS = 1.5  # frequency of a connection times the step: damped critically, the method is stable up to 2.8
HARD, SOFT = 0.9999, 0.999  # impedances: MuJoCo's largest; and one that crosses singular configurations in larger steps

LINK = """
    <body name="link{i}" pos="{x} 0 0">
      <joint name="link{i}" axis="0 0 1"/>
      <inertial pos="0.5 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>{carried}
    </body>"""
COUPLER = """
      <body name="coupler" pos="1 0 0">
        <joint name="coupler" axis="0 0 1"/>
        <inertial pos="{centre} 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
      </body>"""
MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option integrator="RK4" solver="Newton" iterations="4" tolerance="1e-15" jacobian="dense" gravity="0 -{gravity} 0">
    <flag contact="disable" limit="disable" frictionloss="disable"/>
  </option>
  <worldbody>{links}
  </worldbody>
  <equality>
    <connect body1="coupler" body2="link2" anchor="{one} 0 0"/>
    <connect body1="coupler" body2="link3" anchor="{two} 0 0"/>
  </equality>
</mujoco>"""


def mjcf() -> str:
    """Return the linkage with all angles zero, where it is closed."""
    coupler = COUPLER.format(centre=-PINS[0], mass=MASS[3], inertia=INERTIA[3])
    numbers = [{"i": i + 1, "x": PIVOTS[i], "mass": MASS[i], "inertia": INERTIA[i]} for i in range(3)]
    links = "".join(LINK.format(**each, carried="" if each["i"] > 1 else coupler) for each in numbers)
    return MODEL.format(gravity=GRAVITY, links=links, one=PINS[1] - PINS[0], two=PINS[2] - PINS[0])


def stiffened(model, step: float, impedance: float):
    """Return the model with this step (s), its connections critically damped and as stiff as the step allows."""
    frequency = STIFFNESS / step
    model.opt.timestep = step
    model.eq_solref[:] = -(frequency**2), -2 * frequency
    model.eq_solimp[:, :2] = impedance
    return model


def setup(problem: Problem, impedance: float = HARD) -> Run:
    """The coupler is attached to link 1."""
    mujoco = import_module("mujoco")

    mujoco.set_mju_user_warning(lambda message: None)  # warnings of unstable runs: the error shows it, and no log file remains
    model = mujoco.MjModel.from_xml_string(mjcf())
    data = mujoco.MjData(model)
    links = [model.joint(f"link{i + 1}").qposadr[0] for i in range(3)]
    coupler = model.joint("coupler").qposadr[0]

    def run(step: float) -> Coordinates:
        steps = round(SPACING / step)
        stiffened(model, SPACING / steps, impedance)
        mujoco.mj_resetData(model, data)
        data.qpos[links], data.qpos[coupler] = problem.angle, -problem.angle
        q = np.empty((len(problem.ts), 4))
        q[0] = data.qpos
        for k in range(1, len(q)):
            mujoco.mj_step(model, data, steps)
            q[k] = data.qpos
        return coordinates(q[:, links], q[:, links[0]] + q[:, coupler])

    return run


STEPS = tuple(SPACING / n for n in (1, 2, 3, 5, 8, 12, 20, 40, 80, 160, 320, 640, 1280))  # s
PEERS = (
    Peer("MuJoCo RK4", "mujoco", "step", STEPS, setup),
    Peer("MuJoCo RK4, softer", "mujoco", "step", STEPS, partial(setup, impedance=SOFT)),
)
