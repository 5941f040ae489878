"""One instance of each type of the scene format, included in every test of elements: add a new type here in one line.

Each element is read from a file and written to one, and its rows are counted; its loads, or Psi, Psi_q, Psi_dot and gamma, are
compared in both engines with JAX's derivatives.
"""

import udkjax.scene as udk

P = ((0.2, -0.1), (-0.3, 0.15))  # attachments (m)
BODIES = {
    "b": udk.Body(1.0, 0.1, [0.3, -0.2], 0.4, [0.1, 0.2], -0.3),
    "a": udk.Body(2.0, 0.2, [1.0, 0.5], -1.1),
    "c": udk.Body(0.7, 1.9, [-0.4, 0.1], 2.0),
}
JOINTS = {
    "revolute": udk.Revolute(["ground", "b"], P),
    "prismatic": udk.Prismatic(["a", "b"], P, axis=0.3),
    "slot": udk.Slot(["a", "b"], P, axis=0.3),
    "weld": udk.Weld(["a", "ground"], P),
    "distance": udk.Distance(["a", "b"], P),
    "angle": udk.Angle(["c", "b"]),
    "gear": udk.Gear(["a", "b"], [0.1, 0.2]),
    "inner gear": udk.Gear(["a", "b"], [0.1, 0.2], internal=True, carrier="c"),
    "rack": udk.Rack(["ground", "b"], radius=0.2, axis=0.1),
    "screw": udk.Screw(["ground", "b"], P, 0.3, ["a", "c"], 0.2),
    "coupled slide": udk.Coupling(["c", "b"], ["ground", "a"], [0.3, -0.5, 0.2], axis=1.1, points=P),
    "coupled slides": udk.Coupling(["a", "b"], ["b", "c"], [0.1, 2.0], 0.3, -0.4, P),
    "edge": udk.KnifeEdge(["a", "b"], P[0], 0.3),
    "wheel": udk.Wheel(["ground", "b"], P[1], -0.2, ["c", "a"], 0.2),
    "cam": udk.Cam(["a", "b"], P, udk.Profile([-1.0, 0.5, 2.0, 4.0], [1.0, 1.1, 1.2, 1.1])),
}
ROWS = {"revolute": 2, "prismatic": 2, "weld": 3, "wheel": 2}  # how many; all other joints have one
DRIVERS = {
    "turn": udk.Driver(["ground", "b"], "angle", udk.Polynomial([0.1, 2.0, -0.7, 0.2])),
    "push": udk.Driver(["ground", "b"], "x", udk.Sine(1.0, 2.0, 0.3, -0.2)),
    "lift": udk.Driver(["a", "b"], "y", udk.Spline([0.0, 1.0, 3.0], [0.0, 0.5, 0.1]), P),
    "slide": udk.Driver(["a", "b"], "x", udk.Sine(0.8, 1.0, 0.3, -0.2), P, axis=0.7),
    "stretch": udk.Driver(["a", "b"], "distance", udk.Polynomial([1.0]), P),
}
FORCES = {
    "damped": udk.Spring(["a", "b"], P, stiffness=10.0, length=0.4, damping=0.3),
    "undamped": udk.Spring(["ground", "b"], P, stiffness=10.0, length=0.4),
    "torsion": udk.TorsionSpring(["a", "b"], stiffness=3.0, damping=0.2, angle=0.1),
    "push": udk.Force("a", [1.0, 2.0], point=[0.1, 0.4]),
    "follow": udk.Force("a", [1.0, 2.0], point=[-0.3, 0.2], frame="body"),
    "torque": udk.Torque(["a", "b"], value=0.7),
    "rub": udk.Friction("revolute", torque=0.5, velocity=0.3),
}
