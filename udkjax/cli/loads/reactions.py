"""`udkjax reactions`."""

from pathlib import Path
from typing import Any

from udkjax.cli.common import Json, Scene, fail, output_times, refuse, show
from udkjax.cli.datasets import load_to_write, write


def reactions(
    scene: Scene,
    /,
    t1: float,
    t0: float = 0.0,
    dt: float = 0.01,
    out: Path | None = None,
    plot: Path | None = None,
    json: Json = False,
) -> None:
    """Simulate a scene and find the forces at its pins, in ground axes; exit with 1 if the run fails.

    Args:
        scene: the mechanism.
        t1: end of the run (s).
        t0: start of the run (s).
        dt: time between outputs (s).
        out: file to write (.nc, .h5, .csv or .npz): fx, fy and torque (time) at each pin on each body.
        plot: picture to write (.png, .svg, .pdf or .jpg): magnitude of the force at each pin over time.
    """
    ts = output_times(t0, t1, dt)
    mech, text = load_to_write(scene, out, plot)
    import numpy as np

    import udkjax as udk
    from udkjax.positions.assembling.channels import LOADS
    from udkjax.printing import PrintedTable, format_number, text_table
    from udkjax.statics.reaction_peaks import cam_forces, unique_pin_forces

    sol = udk.simulate(mech, ts, throw=False)
    forces = {pin: {body: np.asarray(x) for body, x in by_body.items()} for pin, by_body in udk.pin_reactions(mech, sol).items()}
    if not forces:
        refuse("the scene has no pins")
    unique = unique_pin_forces(mech, sol)
    variables: dict[str, Any] = {}
    rows: list[tuple[str, ...]] = []
    results: dict[str, dict[str, Any]] = {}
    for pin, by_body in forces.items():
        for body, x in by_body.items():
            for k, (name, unit) in enumerate(LOADS.items()):
                variables[f"pin.{pin}.{body}.{name}"] = (("time",), x[:, k], unit)
            force = np.hypot(x[:, 0], x[:, 1])
            highest, size = int(np.nanargmax(force)) if np.isfinite(force).any() else 0, float(np.nanmax(force, initial=0.0))
            is_unique = unique[pin][body]
            cells = [format_number(value, scale=size) for value in (force[highest], x[highest, 0], x[highest, 1])]
            rows.append((pin, body, *cells, f"{ts[highest]:g}", "" if is_unique else "not unique: minimum-norm value"))
            peak = {"force": force[highest], "fx": x[highest, 0], "fy": x[highest, 1], "time": ts[highest], "unique": is_unique}
            results.setdefault(pin, {})[body] = peak
    write(out, text, variables, {"time": ts}, {})
    if plot is not None:
        from udkjax.show.figures import reactions_figure

        reactions_figure(ts, forces, mech.name).savefig(plot, dpi=150)
    remarks, cams = [], {}
    for cam, contact_force in cam_forces(mech, sol).items():
        lowest = int(np.nanargmin(contact_force)) if np.isfinite(contact_force).any() else 0
        cams[cam] = {"least": contact_force[lowest], "time": ts[lowest]}
        lift_off = "; where it is negative, the follower lifts off" if contact_force[lowest] < 0 else ""
        remarks.append(
            f"  smallest contact force of cam {cam}: {format_number(contact_force[lowest], 'N')}, at {ts[lowest]:g} s{lift_off}"
        )
    heads = "pin", "on body", "largest force (N)", "fx (N)", "fy (N)", "at (s)", ""
    show(
        {"result": sol.result, "peaks": results, "cams": cams},
        text_table(PrintedTable(f"{mech.name or 'mechanism'}, forces at its pins", rows, heads, remarks), len(rows)),
        json,
    )
    if not sol.result.is_success:
        fail(sol.cause)
