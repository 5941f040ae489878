"""Andrews' squeezing mechanism: a standard test problem, with published numbers and a published motion."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated

import numpy as np

from udkjax.annotations import NumberLike, Numbers
from udkjax.argument_types import POSITIVE, several
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.forces import Spring, Torque
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.library.posed_bodies import bodies_on_pose, unit_vector, with_concrete_numbers
from udkjax.scene.mechanism import Mechanism

# Masses (kg) and inertias (kg m^2) of K1 to K7.
MASSES = (0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498)
INERTIAS = (2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5)
# Points and lengths (m), with the names of the sources.
A, B, C = (-0.06934, -0.00227), (-0.03635, 0.03273), (0.014, 0.072)
D, DA, E, EA, FA = 0.028, 0.0115, 0.02, 0.01421, 0.01421
RR, RA, SS, SA, SB, SC, SD = 0.007, 0.00092, 0.035, 0.01874, 0.01043, 0.018, 0.02
ZT, TA, TB, U, UA, UB, ZF = 0.04, 0.02308, 0.00916, 0.04, 0.01228, 0.00449, 0.02
START_ANGLES: Mapping[str, float] = MappingProxyType(  # rad
    {
        "beta": -0.0617138900142764496358948458001,
        "theta": 0.0,
        "gamma": 0.455279819163070380255912382449,
        "phi": 0.222668390165885884674473185609,
        "delta": 0.487364979543842550225598953530,
        "omega": -0.222668390165885884674473185609,
        "epsilon": 1.23054744454982119249735015568,
    }
)


@with_concrete_numbers
def andrews_squeezer(
    torque: NumberLike = 0.033,
    stiffness: NumberLike = 4530.0,
    spring_length: Annotated[NumberLike, POSITIVE] = 0.07785,
    gravity: Annotated[Numbers, several(2)] = (0.0, 0.0),
) -> Mechanism:
    """Return Andrews' squeezing mechanism: seven bodies in three loops, driven by a constant torque against a stiff spring.

    The bodies K1 (the crank) to K7 start at rest; their angles are beta, beta + theta, gamma, phi + delta, delta, omega +
    epsilon and epsilon of the source. Torque in N m, stiffness in N/m. The motion is so fast that 0.03 s is a long run.

    Source: Schiehlen (ed.), Multibody Systems Handbook, 1990; Hairer and Wanner, Solving Ordinary Differential Equations II,
    section VII.7; the state at 0.03 s is published in the Test Set for Initial Value Problem Solvers.
    """

    def pose(angles):
        beta, theta, gamma, phi, delta, omega, epsilon = angles
        x = unit_vector
        y = lambda s: unit_vector(s)[::-1] * np.array([-1.0, 1.0])  # noqa: E731
        tip = RR * x(beta)
        return [
            (RA * x(beta), beta),
            (tip - DA * x(beta + theta), beta + theta),
            (np.array(B) + SB * x(gamma) - SA * y(gamma), gamma),
            (np.array(A) + ZT * x(delta) - (E - EA) * y(phi + delta), phi + delta),
            (np.array(A) + TA * x(delta) + TB * y(delta), delta),
            (np.array(A) - U * y(epsilon) + (ZF - FA) * x(omega + epsilon), omega + epsilon),
            (np.array(A) - UB * x(epsilon) - UA * y(epsilon), epsilon),
        ]

    tip_of_k3 = (-SB, SA - SS)
    joints = {
        "O": Revolute((GROUND, "K1"), [(0.0, 0.0), (-RA, 0.0)]),
        "tip": Revolute(("K1", "K2"), [(RR - RA, 0.0), (DA, 0.0)]),
        "B": Revolute((GROUND, "K3"), [B, (-SB, SA)]),
        "A5": Revolute((GROUND, "K5"), [A, (-TA, -TB)]),
        "A7": Revolute((GROUND, "K7"), [A, (UB, UA)]),
        "K5-K4": Revolute(("K5", "K4"), [(ZT - TA, -TB), (0.0, E - EA)]),
        "K7-K6": Revolute(("K7", "K6"), [(UB, UA - U), (FA - ZF, 0.0)]),
        "F2": Revolute(("K3", "K2"), [tip_of_k3, (DA - D, 0.0)]),
        "F4": Revolute(("K3", "K4"), [tip_of_k3, (0.0, -EA)]),
        "F6": Revolute(("K3", "K6"), [tip_of_k3, (FA, 0.0)]),
    }
    forces = {
        "motor": Torque((GROUND, "K1"), torque),
        "spring": Spring((GROUND, "K3"), [C, (SD - SB, SA - SC)], stiffness, spring_length),
    }
    angles = np.array(list(START_ANGLES.values()))
    bodies = bodies_on_pose([f"K{i}" for i in range(1, 8)], list(zip(MASSES, INERTIAS, strict=True)), pose, angles, np.zeros(7))
    return Mechanism(bodies, joints, forces=forces, gravity=gravity, name="Andrews' squeezing mechanism")
