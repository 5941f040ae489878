"""The forces that hold a mechanism in a position of rest: efforts of its drivers, and forces at its pins."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike

from udkjax.annotations import NumberLike
from udkjax.equations.rows.analysis import analyse
from udkjax.equations.states.quantities import efforts
from udkjax.positions.following.drive import with_halted_drivers
from udkjax.printing import PrintedTable, align_columns, format_number
from udkjax.scene.mechanism import Mechanism
from udkjax.statics.reaction_peaks import RestingPositions, pin_reactions, unique_pin_forces
from udkjax.wording import join_names


class RestingForces(NamedTuple):
    """Efforts of drivers (N, N m), and forces x and y (N) and a torque (N m) at pins on bodies, that hold a mechanism at rest."""

    efforts: dict[str, float]
    forces: dict[str, dict[str, list[float]]]
    unique: dict[str, dict[str, bool]]  # whether equilibrium alone determines the force


def resting_forces(mechanism: Mechanism, q: ArrayLike, t: NumberLike) -> RestingForces:
    """Return the forces that hold a mechanism at rest in a position q (bodies, 3), with the drivers halted at time t (s).

    Without gravity, links need no mass: forces that equilibrium determines do not depend on it.
    """
    if mechanism.massless and not has_gravity(mechanism):
        mechanism = mechanism.with_parameters({f"body.{name}.mass": mechanism.bodies[name].mass for name in mechanism.massless})
    still, q = with_halted_drivers(mechanism, t), np.asarray(q)
    rest = RestingPositions(np.array([t]), q[None], np.zeros((1, *q.shape)))
    at_pins = pin_reactions(still, rest)
    forces = {pin: {body: np.asarray(load)[0].tolist() for body, load in loads.items()} for pin, loads in at_pins.items()}
    effort_of = {name: float(effort[0]) for name, effort in efforts(still, rest).items()}
    return RestingForces(effort_of, forces, unique_pin_forces(still, rest))


def has_gravity(mechanism: Mechanism) -> bool:
    """Return True if the mechanism has gravity, which must be concrete."""
    return bool(np.any(np.asarray(mechanism.gravity) != 0.0))


def forces_table(mechanism: Mechanism, q: ArrayLike) -> PrintedTable | None:
    """Return the table of the forces at rest in a position (bodies, 3); None without forces and gravity, or if a link can move.

    If links have weight but no mass, the table has only a title that asks for masses, or is None without force elements.
    """
    is_loaded = bool(mechanism.forces)
    if not (is_loaded or has_gravity(mechanism)) or analyse(mechanism).degrees_of_freedom != 0:
        return None
    if mechanism.massless and has_gravity(mechanism):
        words = f"{join_names([*mechanism.massless])} without mass: give masses, or the scene gravity = [0, 0]"
        return PrintedTable(f"forces at rest need weights; {words}", [], ("",)) if is_loaded else None
    held = resting_forces(mechanism, q, 0.0)
    loads = [load[:2] for on in held.forces.values() for load in on.values()]
    scale = float(np.max(np.abs(loads), initial=0.0))
    rows = [[f"{name} holds by", _effort(mechanism, name, x, scale), "", ""] for name, x in held.efforts.items()]
    for pin, on in held.forces.items():
        for body, (x, y, _) in on.items():
            note = "" if held.unique[pin][body] else ", not unique"
            parts = [format_number(part, scale=scale) for part in (x, y)]
            rows.append([f"{pin} on {body}", format_number(np.hypot(x, y), "N", scale) + note, *parts])
    return PrintedTable("forces at rest", rows, ("", "force", "x (N)", "y (N)"))


def _effort(mechanism: Mechanism, name: str, effort: Any, scale: float) -> str:
    """Return the effort of a driver as text with its unit; 0 if it is a rounding error of forces of the size `scale` (N)."""
    unit = mechanism.drivers[name].effort_unit
    return format_number(effort, unit, scale if unit == "N" else scale * float(analyse(mechanism).length))


def force_lines(mechanism: Mechanism, held: RestingForces) -> str:
    """Return the forces as text, with a line for each driver, and for each pin and body."""
    loads = [load[:2] for on in held.forces.values() for load in on.values()]
    scale = float(np.max(np.abs(loads), initial=0.0))
    rows = [(f"{name} holds by", _effort(mechanism, name, x, scale)) for name, x in held.efforts.items()]
    for pin, on in held.forces.items():
        for body, (fx, fy, _) in on.items():
            components = ", ".join(format_number(x, scale=scale) for x in (fx, fy))
            note = "" if held.unique[pin][body] else ", not unique: of least norm"
            rows.append((f"at {pin} on {body}", f"{format_number(np.hypot(fx, fy), 'N', scale)}: ({components}) N{note}"))
    return "\n".join(align_columns(rows)) if rows else "  no forces: nothing holds it"
