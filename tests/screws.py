"""Screws and wedges with friction, and the only motion that their equations allow, by enumeration of the signs of all loads."""

from itertools import product
from typing import Any, Literal

import numpy as np

import udkjax as udk

G = 9.81
Law = Literal["smooth", "set-valued"]
GUIDES = ("turn", "guide", "thread")


def screw(law: Law = "set-valued", mass: float = 1.0, angle: float = 0.1, speed: float = 0.0, **more: Any) -> udk.Mechanism:
    """Return a screw that slides along x below a nut of 100 kg, which it lifts by a thread: a wedge.

    Args:
        law: The law of friction of all three guides.
        mass: The mass of the screw (kg).
        angle: The angle of the thread (rad).
        speed: The speed of the screw (m/s).
        more: `push`, the force on the screw (N), and the coefficients of the guides: `turn`, `guide`, `thread`.
    """
    bodies = {
        "screw": udk.Body(mass, 1.0, velocity=[speed, 0.0]),
        "nut": udk.Body(100.0, 1.0, position=[0.0, 1.0], velocity=[0.0, speed * np.tan(angle)]),
    }
    joints = {
        "turn": udk.Prismatic(["ground", "screw"], [[0, 0], [0, 0]], axis=0.0),
        "guide": udk.Prismatic(["ground", "nut"], [[0, 0], [0, 0]], axis=np.pi / 2),
        "thread": udk.Slot(["screw", "nut"], [[0, 1.0], [0, 0]], axis=-angle),
    }
    forces: dict[str, Any] = {"push": udk.Force("screw", [more.get("push", 0.0), 0.0])}
    forces |= {f"rub {x}": udk.Friction(x, coefficient=more.get(x, 0.0), law=law) for x in GUIDES}
    return udk.Mechanism(bodies, joints, forces=forces, gravity=[0, -G])


def accelerations(
    direction: float, mass: float, angle: float, push: float, turn: float, guide: float, thread: float
) -> list[float]:
    """Return the accelerations of a screw that slides in a direction which do not run away if its guides yield."""
    c, s, nut, found = np.cos(angle), np.sin(angle), 100.0, []

    def equations(signs: tuple[float, ...]) -> np.ndarray:
        """Rows: x and y of the nut, x and y of the screw; columns: its acceleration, the forces of thread, guide and turn."""
        of_thread, of_guide, of_turn = (direction * mu * sign for mu, sign in zip((thread, guide, turn), signs, strict=True))
        return np.array(
            [
                [0.0, s + of_thread * c, 1.0, 0.0],
                [-nut * np.tan(angle), c - of_thread * s, -of_guide, 0.0],
                [-mass, -s - of_thread * c, 0.0, -of_turn],
                [0.0, -c + of_thread * s, 0.0, 1.0],
            ]
        )

    without = np.linalg.det(equations((0.0,) * len(GUIDES)))
    for signs in product((1.0, -1.0), repeat=len(GUIDES)):
        matrix = equations(signs)
        a, of_thread, of_guide, of_turn = np.linalg.solve(matrix, [0.0, nut * G, -push, mass * G])
        if (
            all(x * sign > 0 for x, sign in zip((of_thread, of_guide, of_turn), signs, strict=True))
            and np.linalg.det(matrix) * without > 0
        ):
            found.append(float(a))
    return found


def random_screw(random: np.random.Generator) -> dict[str, float]:
    """Return the numbers of a screw or a wedge, often a light one."""
    mass, angle = 100.0 * 10.0 ** random.uniform(-5, 0), random.uniform(0.02, 0.6)
    coefficients = {name: random.uniform(0.0, 0.5) for name in GUIDES}
    return {"mass": mass, "angle": angle, "push": 1000.0 * random.uniform(-1.0, 2.0)} | coefficients


def numbers_of(screws: list[dict[str, float]]) -> dict[str, np.ndarray]:
    """Return the parameters of `screw` for several screws, by their names in the scene."""
    of = {name: np.array([x[name] for x in screws]) for name in screws[0]}
    found = {"body.screw.mass": of["mass"], "joint.thread.axis": -of["angle"]}
    found["force.push.vector"] = np.stack([of["push"], np.zeros(len(screws))], axis=1)
    return found | {f"force.rub {x}.coefficient": of[x] for x in GUIDES}
