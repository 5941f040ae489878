"""The command line: `udkjax simulate | check | doctor`.

Only the standard library and tyro are imported before a command is known, so that help comes at once.
"""

import json
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from udkjax import Mechanism, Solution

BAD_RUN, BAD_INPUT = 1, 2  # exit codes

METHODS = {
    "auto": "Auto",
    "elimination": "Elimination",
    "svd": "SVD",
    "varga": "Varga",
    "greville": "Greville",
    "householder": "Householder",
    "gram-schmidt": "GramSchmidt",
}
SOLVERS = {"dopri8": "Dopri8", "dopri5": "Dopri5", "tsit5": "Tsit5", "bosh3": "Bosh3", "heun": "Heun", "kvaerno5": "Kvaerno5"}

Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE.toml")]


def main(arguments: list[str] | None = None) -> None:
    """Run one command; exit with 1 after a run that failed, with 2 after wrong input."""
    commands = {"simulate": simulate, "check": check, "doctor": doctor}
    tyro.extras.subcommand_cli_from_dict(
        commands, prog="udkjax", args=arguments, description="Planar mechanisms, however redundantly constrained."
    )


def simulate(
    scene: Scene,
    /,
    t1: float,
    out: Path,
    dt: float = 0.05,
    t0: float = 0.0,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    method: Literal["auto", "elimination", "svd", "varga", "greville", "householder", "gram-schmidt"] = "auto",
    rank_tol: float | None = None,
    solver: Literal["dopri8", "dopri5", "tsit5", "bosh3", "heun", "kvaerno5"] = "dopri8",
    stabilization: Literal["projection", "baumgarte", "none"] = "projection",
    alpha: float = 5.0,
    beta: float = 5.0,
    max_steps: int | None = None,
    plot: Path | None = None,
) -> None:
    """Simulate a scene: write its motion (NetCDF) and a picture of it, and say how far both can be trusted.

    Args:
        scene: the mechanism.
        t1: end of the run (s).
        out: NetCDF file to write: time, q and v (time, body, coordinate), settings, statistics and the scene itself.
        dt: time between two instants that are kept (s); the steps of the solver are its own.
        t0: start of the run (s).
        rtol: relative tolerance of a step.
        atol: absolute tolerance of a step.
        method: pseudoinverse of the weighted constraint Jacobian.
        rank_tol: what this method counts as rank deficient; by default, what suits the method.
        solver: integrator, by its name in diffrax.
        stabilization: what keeps the constraints: a projection of each step, Baumgarte's terms, or nothing.
        alpha: Baumgarte's gain on the rate of the constraints (1/s).
        beta: Baumgarte's gain on the constraints (1/s).
        max_steps: give up after so many steps.
        plot: picture to write; by default beside the NetCDF file.
    """
    settings = {name: str(value) if isinstance(value, Path) else value for name, value in locals().items() if name != "scene"}
    if not (t1 > t0 and dt > 0):
        _refuse(f"--t1 {t1:g} must lie after --t0 {t0:g}, and --dt {dt:g} must be positive")
    mech, text = _load(scene)
    plot = plot or out.with_suffix(".png")
    if plot == out:
        _refuse(f"--out {out} and --plot {plot} are the same file")
    for target in (out, plot):
        if not target.parent.is_dir():
            _refuse(f"there is no folder {target.parent} to write {target.name} to")

    import diffrax
    import numpy as np

    import udkjax as udk
    from udkjax.show.plots import trajectory
    from udkjax.show.summary import run_summary

    ts = t0 + dt * np.arange(round((t1 - t0) / dt * (1 - 1e-12)) + 1)  # t1 itself, where dt divides the run
    choices: dict[str, Any] = {} if max_steps is None else {"max_steps": max_steps}
    pseudoinverse = getattr(udk, METHODS[method])
    choices["method"] = pseudoinverse() if rank_tol is None else pseudoinverse(rank_tol=rank_tol)
    choices["solver"] = getattr(diffrax, SOLVERS[solver])()
    choices["stabilization"] = {"projection": udk.Projection, "baumgarte": lambda: udk.Baumgarte(alpha, beta), "none": lambda: None}[
        stabilization
    ]()
    with _compile_seconds() as compiling:
        start = time.perf_counter()
        sol = udk.simulate(mech, ts, rtol=rtol, atol=atol, throw=False, **choices)
        float(np.asarray(sol.q)[-1, 0, 0])  # wait for it
        seconds = time.perf_counter() - start

    _dataset(sol, settings, text).to_netcdf(out, engine="h5netcdf")
    trajectory(mech, sol).savefig(plot, dpi=150)
    print(run_summary(mech, sol, seconds, compiling[0]))
    print(f"wrote {out} and {plot}")
