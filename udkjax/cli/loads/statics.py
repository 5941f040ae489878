"""`udkjax statics`."""

from pathlib import Path

from udkjax.cli.common import Json, Scene, fail, show
from udkjax.cli.datasets import load_to_write, write
from udkjax.cli.options import NotNegativeCount, PositiveCount, refuse_without_effect


def statics(
    scene: Scene,
    /,
    stable: bool = False,
    starts: PositiveCount = 1,
    seed: NotNegativeCount = 0,
    t: float = 0.0,
    out: Path | None = None,
    json: Json = False,
) -> None:
    """Find equilibria of a scene, their stability, and the forces in them; exit with 1 if none is found.

    Args:
        scene: the mechanism; its drivers are held.
        stable: find a stable equilibrium only, at lower energy than the initial guess; otherwise the nearest equilibrium, or, if
            there is none, the stable one.
        starts: number of positions to search from; with more than one, all equilibria found are listed.
        seed: seed of these positions.
        t: time of drivers and loads (s).
        out: file to write (.nc, .h5, .csv or .npz): q (equilibrium, body, coordinate), omega2 (equilibrium, mode), multiplier
            (equilibrium, row), and the holding torques and forces of drivers and the forces at pins (equilibrium).
    """
    if starts == 1:
        refuse_without_effect(["--seed"], "with one start: give --starts")
    mech, text = load_to_write(scene, out)
    import numpy as np

    import udkjax as udk
    from udkjax.positions.assembling.channels import LOADS
    from udkjax.statics.resting_forces import force_lines, resting_forces

    if starts == 1:  # the equilibrium nearby, or else a stable one downhill from the guess, as in the studio
        tried = (udk.equilibrium(mech, t=t, stable=x) for x in ([True] if stable else [False, True]))
        equilibria = [x for x in tried if x.balanced][:1]
    else:
        equilibria = [x for x in udk.equilibria(mech, starts, seed, t) if x.stable or not stable]
    forces = [resting_forces(mech, e.q, t) for e in equilibria]
    results = {
        "bodies": mech.body_names,
        "equilibria": [
            {"q": e.q, "omega2": e.omega2, "stable": bool(e.stable), "multipliers": e.multipliers, "residual": e.residual}
            | reactions._asdict()
            for e, reactions in zip(equilibria, forces, strict=True)
        ],
    }
    if equilibria:
        variables = {
            "q": (("equilibrium", "body", "coordinate"), np.stack([np.asarray(e.q) for e in equilibria]), "m, m, rad"),
            "omega2": (("equilibrium", "mode"), np.stack([np.asarray(e.omega2) for e in equilibria]), "1/s2"),
            "multiplier": (("equilibrium", "row"), np.stack([np.asarray(e.multipliers) for e in equilibria]), "N, N m"),
        }
        for name in mech.driver_names:
            variables[f"effort.{name}"] = (
                ("equilibrium",),
                [x.efforts[name] for x in forces],
                mech.drivers[name].effort_unit,
            )
        for pin, by_body in forces[0].forces.items():
            for body in by_body:
                for k, (component, unit) in enumerate(LOADS.items()):
                    values = [x.forces[pin][body][k] for x in forces]
                    variables[f"pin.{pin}.{body}.{component}"] = (("equilibrium",), values, unit)
        write(out, text, variables, {"body": list(mech.body_names)}, {"t": t, "starts": starts})
    words = (
        f"{mech.name or 'mechanism'}, {e}\n{force_lines(mech, reactions)}"
        for e, reactions in zip(equilibria, forces, strict=True)
    )
    show(results, "\n".join(words), json)
    if not equilibria:
        kind = "stable equilibrium" if stable else "equilibrium"
        near = f"no {kind} was found near the initial guess, nor downhill from it: search from other positions by --starts 64"
        many = f"no {kind} was found from {starts} positions: loads may move the mechanism without end; or try another --seed"
        fail(near if starts == 1 else many)
