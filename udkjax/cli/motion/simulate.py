"""`udkjax simulate`."""

import math
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from udkjax.cli.common import Json, Scene, channels_of, fail, load, measure_channels, output_times, refuse, show
from udkjax.cli.datasets import PICTURE_SUFFIXES, check_target, save
from udkjax.cli.options import refuse_without_effect
from udkjax.extras import NETCDF_PACKAGES, require

# The names in udkjax.study.choices, which cannot be imported here, since it imports JAX.
Method = Literal["auto", "elimination", "svd", "varga", "greville", "householder", "gram-schmidt"]
Formulation = Literal["udwadia-kalaba", "augmented", "null-space-qr", "null-space-svd", "partitioning"]
Solver = Literal["dopri8", "dopri5", "tsit5", "bosh3", "heun", "kvaerno5", "verner65", "adams", "bdf"]
Stabilization = Literal["projection", "baumgarte", "none"]


def simulate(
    scene: Scene,
    /,
    t1: float,
    out: Path,
    dt: float = 0.05,
    t0: float = 0.0,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    method: Method = "auto",
    rank_tol: float | None = None,
    formulation: Formulation = "udwadia-kalaba",
    solver: Solver = "dopri8",
    stabilization: Stabilization = "projection",
    alpha: float = 5.0,
    beta: float = 5.0,
    dt0: float | None = None,
    max_steps: int | None = None,
    channels: tuple[str, ...] = (),
    plot: Path | None = None,
    json: Json = False,
) -> None:
    """Simulate a scene; write its motion and a picture, and report the accuracy of the run.

    Args:
        scene: the mechanism.
        t1: end of the run (s).
        out: file to write. NetCDF (.nc or .h5) and NumPy files (.npz) contain time, q and v (time, body, coordinate), settings,
            statistics and the scene itself; .csv contains the time and a column for each coordinate and its rate.
        dt: time between outputs (s); the solver chooses its steps independently.
        t0: start of the run (s).
        rtol: relative tolerance of a step.
        atol: absolute tolerance of a step, in units of the scene's characteristic length and time (printed by `udkjax check`).
        method: pseudoinverse of the weighted constraint Jacobian; formulations other than udwadia-kalaba use it only for
            projection.
        rank_tol: relative threshold of the rank; by default, one that suits the method.
        formulation: formulation of the accelerations; partitioning integrates independent coordinates only, without Baumgarte.
        solver: integrator; verner65, adams and bdf are part of udkjax, the others of diffrax.
        stabilization: projection of each step onto the constraints, Baumgarte's terms, or none.
        alpha: Baumgarte's gain on the rate of the constraints (1/s), with --stabilization baumgarte.
        beta: Baumgarte's gain on the constraints (1/s), with --stabilization baumgarte.
        dt0: first step to try (s); by default it is estimated.
        max_steps: maximum number of steps, after which the run fails.
        channels: further channels to write, such as pin.C.x, joint.A.fx or driver.motor.load, and to draw in a separate picture.
        plot: picture to write (.png, .svg, .pdf or .jpg); by default a .png with the name of the file.
    """
    ts = output_times(t0, t1, dt)
    if stabilization != "baumgarte":
        refuse_without_effect(["--alpha", "--beta"], f"with --stabilization {stabilization}: use --stabilization baumgarte")
    if formulation != "udwadia-kalaba" and stabilization != "projection":
        both = f"--formulation {formulation} and --stabilization {stabilization}"
        refuse_without_effect(["--method", "--rank-tol"], f"with {both}, which use no pseudoinverse")
    check_target(out)
    plot = plot or out.with_suffix(".png")
    if dt0 is not None and not 0 < dt0 < math.inf:
        refuse(f"the first step --dt0 {dt0:g} must be positive")
    if formulation == "partitioning" and stabilization == "baumgarte":
        refuse("--formulation partitioning keeps the constraints itself: use --stabilization projection or none")
    if plot == out:
        refuse(f"--out {out} and --plot {plot} are the same file")
    check_target(plot, PICTURE_SUFFIXES, "--plot")
    require(*NETCDF_PACKAGES, "matplotlib")
    mech, text = load(scene)
    measured = channels_of(mech, channels)

    import numpy as np

    import udkjax as udk
    from udkjax.positions.assembling.assembly import AssemblyWarning, moves_of_assembly
    from udkjax.show.figures import channels_figure
    from udkjax.show.plots import trajectory
    from udkjax.show.summary import run_summary
    from udkjax.study.accuracy import accuracy
    from udkjax.study.choices import choice

    gains = {"alpha": alpha, "beta": beta} if stabilization == "baumgarte" else {}
    choices: dict[str, Any] = {
        "rtol": rtol,
        "atol": atol,
        "method": choice("method", {"type": method, **({} if rank_tol is None else {"rank_tol": rank_tol})}),
        "formulation": choice("formulation", formulation),
        "solver": None if solver == "dopri8" else choice("solver", solver),  # the default
        "dt0": dt0,
        "stabilization": choice("stabilization", {"type": stabilization, **gains}),
        "throw": False,
    }
    if max_steps is not None:
        choices["max_steps"] = max_steps
    with _stopwatch() as seconds, warnings.catch_warnings():
        warnings.simplefilter("ignore", AssemblyWarning)  # the summary reports it
        sol = udk.simulate(mech, ts, **choices)
        np.asarray(sol.q)  # wait for JAX, which runs asynchronously

    data = sol.to_xarray(mech)
    data.attrs |= {"scene": text, "scene_file": scene.name}
    columns, files = measure_channels(mech, sol, measured), [out, plot]
    for name, (values, unit) in columns.items():
        data[name] = ("time", values, {"units": unit})
    save(data, out)
    trajectory(mech, sol).savefig(plot, dpi=150)
    if columns:
        files.append(plot.with_stem(f"{plot.stem}-channels"))
        channels_figure(sol.ts, columns, title=mech.name).savefig(files[-1], dpi=150)
    achieved = accuracy(mech, sol)
    moved = () if t0 and mech.drivers else moves_of_assembly(mech, udk.assemble(mech, t0, throw=False).q)
    results = {
        "result": sol.result,
        "end_time": sol.time,
        "moved": moved,
        **sol.stats,
        **achieved._asdict(),
        "seconds": seconds["all"],
        "seconds_compiling": seconds["compiling"],
        "files": files,
    }
    text = run_summary(mech, sol, achieved, seconds["all"], seconds["compiling"], moved)
    show(results, f"{text}\nwrote {' and '.join(map(str, files))}", json)
    if sol.result:
        fail(sol.cause)


@contextmanager
def _stopwatch() -> Iterator[dict[str, float]]:
    """Yield times that are measured when the body of the `with` statement ends.

    They are the wall time of the body, `all` (s), and the part of it spent on tracing and compiling, `compiling` (s).
    """
    import jax

    seconds, spans = {"all": 0.0, "compiling": 0.0}, []

    def listen(event: str, duration_secs: float, **_: object) -> None:
        if event.startswith("/jax/core/compile/"):
            end = time.perf_counter()
            while spans and spans[-1][0] > end - duration_secs:  # inner traces are included in this trace
                spans.pop()
            spans.append((end - duration_secs, end))

    jax.monitoring.register_event_duration_secs_listener(listen)
    start = time.perf_counter()
    yield seconds
    seconds["all"] = time.perf_counter() - start
    seconds["compiling"] = sum(end - begin for begin, end in spans)
