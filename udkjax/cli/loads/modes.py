"""`udkjax modes`."""

from pathlib import Path

from udkjax.cli.common import Json, Scene, fail, show
from udkjax.cli.datasets import load_to_write, write


def modes(scene: Scene, /, stable: bool = True, t: float = 0.0, out: Path | None = None, json: Json = False) -> None:
    """Find the frequencies, damping and mode shapes of small oscillations about an equilibrium; exit with 1 if there is none.

    Args:
        scene: the mechanism; its drivers are held.
        stable: find a stable equilibrium, at lower energy than the initial guess; otherwise the nearest one.
        t: time of drivers and loads (s).
        out: file to write (.nc, .h5, .csv or .npz): omega2 (mode), shape (mode, body, coordinate), and q of the equilibrium.
    """
    mech, text = load_to_write(scene, out)
    import numpy as np

    import udkjax as udk

    balance = udk.equilibrium(mech, t=t, stable=stable)
    oscillations = udk.modes(mech, balance.state, t)
    results = {
        "bodies": mech.body_names,
        "omega2": oscillations.omega2,
        "frequencies": oscillations.frequencies,
        "s": [[s.real, s.imag] for s in np.asarray(oscillations.s)],
        "damping": oscillations.damping,
        "shapes": oscillations.shapes,
        "q": oscillations.q,
        "balanced": bool(balance.balanced),
    }
    variables = {
        "omega2": (("mode",), oscillations.omega2, "1/s2"),
        "shape": (("mode", "body", "coordinate"), oscillations.shapes, "m, m, rad, of modal mass 1 kg"),
        "q": (("body", "coordinate"), oscillations.q, "m, m, rad"),
    }
    write(out, text, variables, {"body": list(mech.body_names)}, {"t": t})
    show(results, f"{mech.name or 'mechanism'}, {oscillations}", json)
    if not balance.balanced:
        fail("no equilibrium was found near the initial guess")
