"""`udkjax statics`."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from udkjax.cli.common import Json, Scene, fail, refuse, show
from udkjax.cli.datasets import load_to_write, write

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from udkjax import Mechanism


def statics(
    scene: Scene,
    /,
    stable: bool = False,
    starts: int = 1,
    seed: int = 0,
    t: float = 0.0,
    out: Path | None = None,
    json: Json = False,
) -> None:
    """Find where a scene rests, whether it is stable there, and the forces there; exit with 1 where it rests nowhere.

    Args:
        scene: the mechanism; its drivers hold.
        stable: go downhill to a stable position only.
        starts: number of positions to search from; from more than one, all that are found are listed.
        seed: of these positions.
        t: time of drivers and loads (s).
        out: file to write (.nc, .h5, .csv or .npz): q (equilibrium, body, coordinate), omega2 (equilibrium, mode), multiplier
            (equilibrium, row), and the efforts of drivers and the forces at pins (equilibrium).
    """
    if starts < 1:
        refuse(f"--starts {starts}: must be positive")
    mech, text = load_to_write(scene, out)
    import numpy as np

    import udkjax as udk
    from udkjax.study.channels import LOADS

    one = udk.equilibrium(mech, t=t, stable=stable) if starts == 1 else None
    found = ([one] if one.balanced else []) if one is not None else udk.equilibria(mech, starts, seed, t)
    forces = [forces_at(mech, e.q, t) for e in found]
    results = {
        "bodies": mech.body_names,
        "equilibria": [
            {"q": e.q, "omega2": e.omega2, "stable": bool(e.stable), "multipliers": e.multipliers, "residual": e.residual}
            | held._asdict()
            for e, held in zip(found, forces, strict=True)
        ],
    }
    if found:
        variables = {
            "q": (("equilibrium", "body", "coordinate"), np.stack([np.asarray(e.q) for e in found]), "m, m, rad"),
            "omega2": (("equilibrium", "mode"), np.stack([np.asarray(e.omega2) for e in found]), "1/s2"),
            "multiplier": (("equilibrium", "row"), np.stack([np.asarray(e.multipliers) for e in found]), "N, N m"),
        }
        for name in mech.driver_names:
            variables[f"effort.{name}"] = (
                ("equilibrium",),
                [held.efforts[name] for held in forces],
                mech.drivers[name].effort_unit,
            )
        for pin, on in forces[0].forces.items():
            for body in on:
                for k, (part, unit) in enumerate(LOADS.items()):
                    values = [held.forces[pin][body][k] for held in forces]
                    variables[f"pin.{pin}.{body}.{part}"] = (("equilibrium",), values, unit)
        write(out, text, variables, {"body": list(mech.body_names)}, {"t": t, "starts": starts})
    words = (f"{mech.name or 'mechanism'}, {e}\n{words_of(mech, held)}" for e, held in zip(found, forces, strict=True))
    show(results, "\n".join(words), json)
    if not found:
        fail("no position of rest was found near the initial guess; try --stable, or --starts 64")


class RestingForces(NamedTuple):
    """Efforts of drivers (N, N m), and forces x and y (N) and a torque (N m) at pins on bodies, that hold a mechanism at rest."""

    efforts: dict[str, float]
    forces: dict[str, dict[str, list[float]]]
    unique: dict[str, dict[str, bool]]  # whether equilibrium alone determines the force


def forces_at(mech: "Mechanism", q: "ArrayLike", t: float) -> RestingForces:
    """Return the forces in a position of rest, where drivers stand still as they are at time t (s)."""
    import numpy as np

    import udkjax as udk
    from udkjax.study.drive import with_halted_drivers
    from udkjax.study.reaction_peaks import RestingPositions, unique_pin_forces

    still, q = with_halted_drivers(mech, t), np.asarray(q)
    rest = RestingPositions(np.array([t]), q[None], np.zeros((1, *q.shape)))
    at_pins = udk.pin_reactions(still, rest)
    forces = {pin: {body: np.asarray(load)[0].tolist() for body, load in on.items()} for pin, on in at_pins.items()}
    efforts = {name: float(effort[0]) for name, effort in udk.efforts(still, rest).items()}
    return RestingForces(efforts, forces, unique_pin_forces(still, rest))


def words_of(mech: "Mechanism", held: RestingForces) -> str:
    """Describe the forces: a line for each driver, and one for each pin and body."""
    import numpy as np

    from udkjax.printing import align_columns, format_number

    loads = [load[:2] for on in held.forces.values() for load in on.values()]
    scale = float(np.max(np.abs(loads), initial=0.0))
    rows = [(f"{name} holds by", format_number(x, mech.drivers[name].effort_unit)) for name, x in held.efforts.items()]
    for pin, on in held.forces.items():
        for body, (fx, fy, _) in on.items():
            components = ", ".join(format_number(x, scale=scale) for x in (fx, fy))
            known = "" if held.unique[pin][body] else ", not unique: of least norm"
            rows.append((f"at {pin} on {body}", f"{format_number(np.hypot(fx, fy), 'N', scale)}: ({components}) N{known}"))
    return "\n".join(align_columns(rows)) if rows else "  no forces: nothing holds it"
