"""Exudyn: four rigid bodies and six revolute joints in the plane, by the generalized alpha method and by the trapezoidal rule."""

from functools import partial

import numpy as np

from benchmarks.peers.peer import GRAVITY, INERTIA, MASS, PINS, PIVOTS, SPACING, Coordinates, Peer, Problem, Run

SPECTRAL_RADIUS = 0.9  # spectral radius of the generalized alpha method at infinite frequency


def setup(problem: Problem, index: int, radius: float = SPECTRAL_RADIUS) -> Run:
    """`index` 3 solves with joints in positions, 2 in velocities. The factorization handles the redundant row."""
    import exudyn  # pyright: ignore[reportMissingImports]
    import exudyn.itemInterface as item  # pyright: ignore[reportMissingImports]

    exudyn.config.printToConsole = False
    system = exudyn.SystemContainer()
    mbs = system.AddSystem()
    ground = mbs.AddObject(item.ObjectGround())
    bodies, sensors = [], []
    for i, coordinates in enumerate(problem.q0.reshape(4, 3)):
        node = mbs.AddNode(item.NodeRigidBody2D(referenceCoordinates=coordinates))
        bodies.append(mbs.AddObject(item.ObjectRigidBody2D(physicsMass=MASS[i], physicsInertia=INERTIA[i], nodeNumber=node)))
        centre = mbs.AddMarker(item.MarkerBodyPosition(bodyNumber=bodies[i]))
        mbs.AddLoad(item.Force(markerNumber=centre, loadVector=[0.0, -MASS[i] * GRAVITY, 0.0]))
        kind = exudyn.OutputVariableType.Coordinates
        sensors.append(mbs.AddSensor(item.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=kind)))

    def marker(body: int, x: float):
        return mbs.AddMarker(item.MarkerBodyPosition(bodyNumber=body, localPosition=[x, 0.0, 0.0]))

    for i, link in enumerate(bodies[:3]):
        for other, at, own in ((ground, PIVOTS[i], -0.5), (bodies[3], PINS[i], 0.5)):
            mbs.AddObject(item.ObjectJointRevolute2D(markerNumbers=[marker(other, at), marker(link, own)]))
    mbs.Assemble()

    settings = exudyn.SimulationSettings()
    settings.timeIntegration.endTime = problem.ts[-1]
    settings.timeIntegration.generalizedAlpha.spectralRadius = radius
    settings.timeIntegration.generalizedAlpha.useIndex2Constraints = settings.timeIntegration.generalizedAlpha.useNewmark = (
        index == 2
    )
    settings.timeIntegration.newton.useModifiedNewton = True
    settings.timeIntegration.newton.relativeTolerance = settings.timeIntegration.newton.absoluteTolerance = 1e-10
    settings.timeIntegration.adaptiveStep = False  # it would only halve a failed step
    settings.timeIntegration.verboseMode = 0
    settings.linearSolver.solverType = exudyn.LinearSolverType.EigenDense
    settings.linearSolver.ignoreSingularJacobian = True
    settings.solutionSettings.writeSolutionToFile = False
    settings.solutionSettings.sensorsWritePeriod = SPACING
    settings.displayComputationTime = False

    def run(step: float) -> Coordinates:
        settings.timeIntegration.numberOfSteps = round(SPACING / step) * (len(problem.ts) - 1)
        mbs.SolveDynamic(settings, updateInitialValues=False)
        stored = [mbs.GetSensorStoredData(sensor)[:, 1:4] for sensor in sensors]
        return problem.q0 + np.concatenate(stored, axis=1)  # it is relative to the reference

    return run


STEPS = tuple(SPACING / n for n in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000))  # s
PEERS = (
    Peer("Exudyn generalized alpha", "exudyn", "step", STEPS, partial(setup, index=3)),
    Peer("Exudyn trapezoidal rule, index 2", "exudyn", "step", STEPS, partial(setup, index=2, radius=1.0)),
)
