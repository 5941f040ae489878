"""Drake: a tree of four revolute joints, two ball constraints, its discrete solver; its continuous plants take no constraints."""

import numpy as np

from benchmarks.peers.peer import GRAVITY, INERTIA, MASS, PINS, PIVOTS, SPACING, Coordinates, Peer, Problem, Run, coordinates


def setup(problem: Problem) -> Run:
    """The coupler is attached to link 1."""
    from pydrake.math import RigidTransform  # pyright: ignore[reportMissingImports]
    from pydrake.multibody import plant as multibody  # pyright: ignore[reportMissingImports]
    from pydrake.multibody import tree  # pyright: ignore[reportMissingImports]
    from pydrake.systems.analysis import Simulator  # pyright: ignore[reportMissingImports]

    def at(x: float):
        return np.array([x, 0.0, 0.0])

    def run(step: float) -> Coordinates:
        plant = multibody.MultibodyPlant(SPACING / round(SPACING / step))
        plant.set_discrete_contact_approximation(multibody.DiscreteContactApproximation.kSap)
        plant.mutable_gravity_field().set_gravity_vector([0.0, -GRAVITY, 0.0])

        def joint(name: str, parent, x: float, i: int, centre: float):
            turning = tree.RotationalInertia(INERTIA[i], INERTIA[i], INERTIA[i])
            body = plant.AddRigidBody(name, tree.SpatialInertia.MakeFromCentralInertia(MASS[i], at(centre), turning))
            place = plant.AddFrame(tree.FixedOffsetFrame(f"{name}_at", parent.body_frame(), RigidTransform(at(x))))
            return body, plant.AddJoint(tree.RevoluteJoint(name, place, body.body_frame(), [0.0, 0.0, 1.0]))

        links = [joint(f"link{i + 1}", plant.world_body(), PIVOTS[i], i, 0.5) for i in range(3)]
        coupler, hinge = joint("coupler", links[0][0], 1.0, 3, -PINS[0])
        for i in (1, 2):
            plant.AddBallConstraint(coupler, at(PINS[i] - PINS[0]), links[i][0], at(1.0))
        plant.Finalize()
        simulator = Simulator(plant)
        context = simulator.get_mutable_context()
        for _, each in links:
            each.set_angle(context, problem.angle)
        hinge.set_angle(context, -problem.angle)
        angles = np.empty((len(problem.ts), 4))
        for k, t in enumerate(problem.ts):
            simulator.AdvanceTo(t)
            angles[k] = [each.get_angle(context) for _, each in links] + [hinge.get_angle(context)]
        return coordinates(angles[:, :3], angles[:, 0] + angles[:, 3])

    return run


STEPS = tuple(SPACING / n for n in (1, 2, 5, 10, 20, 50, 100, 200, 500))  # s
PEERS = (Peer("Drake SAP", "drake", "step", STEPS, setup),)
