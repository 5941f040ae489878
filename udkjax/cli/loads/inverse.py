"""`udkjax inverse`."""

import math
from pathlib import Path
from typing import Any

from udkjax.cli.common import Json, Scene, fail, output_times, refuse, show
from udkjax.cli.datasets import load_to_write, write


def inverse(
    scene: Scene,
    /,
    t1: float,
    t0: float = 0.0,
    dt: float = 0.01,
    drivers: tuple[str, ...] = (),
    out: Path | None = None,
    plot: Path | None = None,
    json: Json = False,
) -> None:
    """Find the efforts (torques or forces) that drivers need for their prescribed motion; exit with 1 if it is not possible.

    Args:
        scene: the mechanism, with the drivers that prescribe its motion.
        t1: end of the motion (s).
        t0: start of the motion (s).
        dt: time between outputs (s).
        drivers: drivers or coordinates that exert efforts, such as body.crank.angle; by default the scene's drivers.
        out: file to write (.nc, .h5, .csv or .npz): effort and power (time, driver).
        plot: picture to write (.png, .svg, .pdf or .jpg): efforts and powers over time.
    """
    ts = output_times(t0, t1, dt)
    mech, text = load_to_write(scene, out, plot)
    if not mech.drivers:
        refuse("the scene has no driver that prescribes a motion: add one, such as a motor of the drawing")
    import numpy as np

    import udkjax as udk

    solution = udk.inverse_dynamics(mech, ts, drivers=list(drivers) or None)
    efforts = {name: np.asarray(x) for name, x in solution.efforts.items()}
    results: dict[str, Any] = {
        "time": ts,
        "efforts": efforts,
        "powers": solution.powers,
        "residual": solution.residual,
        "peaks": {},
    }
    for name, x in efforts.items():
        finite = np.isfinite(x)
        k = int(np.nanargmax(np.abs(x))) if finite.any() else 0
        root_mean_square = float(np.sqrt(np.mean(x[finite] ** 2))) if finite.any() else math.nan
        energies = {"work": solution.works[name], "swing": solution.swings[name]}
        results["peaks"][name] = {"effort": x[k], "time": ts[k], "rms": root_mean_square, **energies}
    units = sorted({unit for _, unit in solution.effort_units}, reverse=True)
    variables = {
        "effort": (("time", "driver"), np.stack(list(efforts.values()), 1), " or ".join(units)),
        "power": (("time", "driver"), np.stack([np.asarray(x) for x in solution.powers.values()], 1), "W"),
    }
    if plot is not None:
        from udkjax.show.figures import channels_figure

        shown = {name: (x, unit) for (name, x), (_, unit) in zip(efforts.items(), solution.effort_units, strict=True)}
        shown |= {f"power of {name}": (np.asarray(x), "W") for name, x in solution.powers.items()}
        channels_figure(ts, shown, title=mech.name).savefig(plot, dpi=150)
    write(out, text, variables, {"time": ts, "driver": list(efforts)}, {})
    show(results, f"{mech.name or 'mechanism'}, {solution}", json)
    determined = np.asarray(solution.determined)
    if not determined.all():
        k = int(np.argmin(determined))
        cause = udk.Reached(int(solution.motion.status[k])) if solution.motion is not None else udk.Reached.closed
        if cause in (udk.Reached.closed, udk.Reached.singular, udk.Reached.not_determined):
            fail(f"at {ts[k]:g} s the efforts are not determined: the position is singular")
        fail(f"the prescribed motion ends at {ts[k]:g} s: {cause.label}")
