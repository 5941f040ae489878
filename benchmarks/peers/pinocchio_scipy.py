"""Pinocchio's constrained forward dynamics in SciPy's DOP853: a tree of four revolute joints, two points that close its loops."""

from functools import partial

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.peers.peer import GRAVITY, INERTIA, MASS, PINS, PIVOTS, Coordinates, Peer, Problem, Run, coordinates
from benchmarks.peers.scipy_numpy import TOLERANCES

WEAK, STRONG = 5.0, 30.0  # 1/s, both gains: weak is less stiff, strong crosses singular configurations
MU = 1e-4  # proximal parameter: with a smaller one +60 degrees loses its branch in singular configurations
RESIDUAL = 1e-12  # at which the proximal iterations end
ITERATIONS = 10


def setup(problem: Problem, gain: float) -> Run:
    """States are the angles of joints: links 1, 2, 3 on the ground, the coupler on link 1."""
    import pinocchio as pin  # pyright: ignore[reportMissingImports]

    def at(x: float):
        return pin.SE3(np.eye(3), np.array([x, 0.0, 0.0]))

    def body(i: int, centre: float):
        return pin.Inertia(MASS[i], np.array([centre, 0.0, 0.0]), INERTIA[i] * np.eye(3))

    model = pin.Model()
    model.gravity = pin.Motion(np.array([0.0, -GRAVITY, 0.0]), np.zeros(3))
    links = [model.addJoint(0, pin.JointModelRZ(), at(PIVOTS[0]), "link1")]
    coupler = model.addJoint(links[0], pin.JointModelRZ(), at(1.0), "coupler")  # branches must be numbered one after another
    links += [model.addJoint(0, pin.JointModelRZ(), at(PIVOTS[i]), f"link{i + 1}") for i in (1, 2)]
    for i, link in enumerate(links):
        model.appendBodyToJoint(link, body(i, 0.5), pin.SE3.Identity())
    model.appendBodyToJoint(coupler, body(3, -PINS[0]), pin.SE3.Identity())
    data = model.createData()

    loops = pin.StdVec_RigidConstraintModel()
    for i in (1, 2):
        kind, axes = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
        loop = pin.RigidConstraintModel(kind, model, coupler, at(PINS[i] - PINS[0]), links[i], at(1.0), axes)
        loop.setBaumgarteCorrectorParameters(pin.BaumgarteCorrectorParameters(gain**2, 2 * gain))
        loops.append(loop)
    loop_data = pin.StdVec_RigidConstraintData()
    for loop in loops:
        loop_data.append(loop.createData())
    pin.initConstraintDynamics(model, data, loops, loop_data)
    settings = pin.ProximalSettings(RESIDUAL, RESIDUAL, MU, ITERATIONS)
    order, tau = [links[0] - 1, links[1] - 1, links[2] - 1, coupler - 1], np.zeros(4)

    def rhs(t, y):
        q, v = y[:4], y[4:]
        return np.concatenate([v, pin.constraintDynamics(model, data, q, v, tau, loops, loop_data, settings)])

    start = np.zeros(8)
    start[order] = [problem.angle] * 3 + [-problem.angle]

    def run(tol: float) -> Coordinates:
        y = solve_ivp(rhs, (0.0, problem.ts[-1]), start, method="DOP853", rtol=tol, atol=tol, t_eval=problem.ts).y
        angles = y[order].T
        return coordinates(angles[:, :3], angles[:, 0] + angles[:, 3])

    return run


PEERS = (
    Peer("Pinocchio, SciPy DOP853", "pin", "tolerance", TOLERANCES, partial(setup, gain=WEAK)),
    Peer("Pinocchio, SciPy DOP853, gain 30", "pin", "tolerance", TOLERANCES, partial(setup, gain=STRONG)),
)
