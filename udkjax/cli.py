"""The command line: `udkjax report | simulate | check | doctor`.

Only the standard library and tyro are imported before a command is known, so that help comes at once.
"""

import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import tyro

if TYPE_CHECKING:
    from udkjax import Mechanism

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
FORMULATIONS = {
    "augmented": "Augmented",
    "null-space-qr": "NullSpaceQR",
    "null-space-svd": "NullSpaceSVD",
    "partitioning": "CoordinatePartitioning",
}
SOLVERS = {
    "dopri8": "Dopri8",
    "dopri5": "Dopri5",
    "tsit5": "Tsit5",
    "bosh3": "Bosh3",
    "heun": "Heun",
    "kvaerno5": "Kvaerno5",
    "verner65": "Verner65",
    "adams": "Adams",
    "bdf": "BDF",
}

Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE.toml")]


def main(arguments: list[str] | None = None) -> None:
    """Run one command; exit with 1 after a run that failed, with 2 after wrong input."""
    commands = {"report": report, "simulate": simulate, "check": check, "doctor": doctor}
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
    formulation: Literal["udwadia-kalaba", "augmented", "null-space-qr", "null-space-svd", "partitioning"] = "udwadia-kalaba",
    solver: Literal["dopri8", "dopri5", "tsit5", "bosh3", "heun", "kvaerno5", "verner65", "adams", "bdf"] = "dopri8",
    stabilization: Literal["projection", "baumgarte", "none"] = "projection",
    alpha: float = 5.0,
    beta: float = 5.0,
    dt0: float | None = None,
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
        formulation: how accelerations are found; partitioning integrates independent coordinates only, without Baumgarte.
        solver: integrator, by its name in diffrax or, verner65, adams and bdf, here.
        stabilization: what keeps the constraints: a projection of each step, Baumgarte's terms, or nothing.
        alpha: Baumgarte's gain on the rate of the constraints (1/s).
        beta: Baumgarte's gain on the constraints (1/s).
        dt0: first step to try (s); by default it is chosen.
        max_steps: give up after so many steps.
        plot: picture to write; by default beside the NetCDF file.
    """
    if not 0 < dt <= t1 - t0 < math.inf:
        _refuse(f"from --t0 {t0:g} to --t1 {t1:g} there must be at least one --dt {dt:g}, which must be positive")
    plot = plot or out.with_suffix(".png")
    if dt0 is not None and not 0 < dt0 < math.inf:
        _refuse(f"the first step --dt0 {dt0:g} must be positive")
    if formulation == "partitioning" and stabilization == "baumgarte":
        _refuse("--formulation partitioning keeps the constraints itself: take --stabilization projection or none")
    if plot == out:
        _refuse(f"--out {out} and --plot {plot} are the same file")
    for target in (out, plot):
        if not target.parent.is_dir():
            _refuse(f"there is no folder {target.parent} to write {target.name} to")
    mech, text = _load(scene)

    import numpy as np

    import udkjax as udk
    from udkjax.integrate.solvers import solver_named
    from udkjax.show.plots import trajectory
    from udkjax.show.summary import run_summary

    pseudoinverse = getattr(udk, METHODS[method])
    stabilizations = {"projection": udk.Projection, "baumgarte": lambda: udk.Baumgarte(alpha, beta), "none": lambda: None}
    choices: dict[str, Any] = {
        "rtol": rtol,
        "atol": atol,
        "method": pseudoinverse() if rank_tol is None else pseudoinverse(rank_tol=rank_tol),
        "formulation": getattr(udk, FORMULATIONS[formulation])() if formulation in FORMULATIONS else None,
        "solver": None if solver == "dopri8" else solver_named(SOLVERS[solver]),  # the default
        "dt0": dt0,
        "stabilization": stabilizations[stabilization](),
        "throw": False,
    }
    if max_steps is not None:
        choices["max_steps"] = max_steps
    ts = t0 + dt * np.arange(int((t1 - t0) / dt + 1e-6) + 1)  # t1 itself too, where it is a multiple of dt up to rounding
    with _stopwatch() as seconds:
        sol = udk.simulate(mech, ts, **choices)
        np.asarray(sol.q)  # JAX runs ahead: wait for it

    data = sol.to_xarray(mech)
    data.attrs |= {"scene": text, "scene_file": scene.name}
    data.to_netcdf(out, engine="h5netcdf")
    trajectory(mech, sol).savefig(plot, dpi=150)
    print(run_summary(mech, sol, seconds["all"], seconds["compiling"]))
    print(f"wrote {out} and {plot}")
    if sol.result:
        print(f"udkjax: {sol.cause}", file=sys.stderr)
        sys.exit(BAD_RUN)


def report(
    out: Path = Path("report"),
    quick: bool = False,
    start: float = -45.0,
    seed: int = 0,
    from_file: Annotated[Path | None, tyro.conf.arg(name="from", metavar="FILE.nc")] = None,
) -> None:
    """Do the paper's study again, with what would have been better, and write a page about it (HTML) with its data (NetCDF).

    Five pseudoinverses, three tolerances, with and without Baumgarte's stabilization, on the paper's five-bar parallelogram, each
    run held against the exact solution.

    Args:
        out: page to write (.html), or folder for report.html; the data goes beside it.
        quick: cut the stiff runs short and compare fewer integrators: a minute and a half instead of eight, on two cores.
        start: angle of the links (degrees) from which they are released at rest.
        seed: of the starts that differ by rounding errors.
        from_file: draw the page from this file instead of running anything.
    """
    target = out if out.suffix == ".html" else out / "report.html"
    if seed < 0:
        _refuse(f"--seed {seed} must not be negative")
    if out.suffix not in ("", ".html"):
        _refuse(f"--out {out} is neither a page (.html) nor a folder")
    folder = target.parent if out.suffix else out.parent
    if not folder.is_dir():
        _refuse(f"there is no folder {folder} to write {out.name} to")
    if not -180 < start < 0 or start == -90:
        _refuse(f"--start {start:g}: between -180 and 0 degrees the links swing without becoming collinear; at -90 they hang")

    from udkjax.show.report import write
    from udkjax.study.cases import FULL, QUICK
    from udkjax.study.paper import study
    from udkjax.study.progress import Progress
    from udkjax.study.record import read, save

    if from_file:
        try:
            data = read(from_file)
        except (OSError, ValueError) as problem:
            _refuse(f"cannot read {from_file}: {problem}")
    else:
        data = study(QUICK if quick else FULL, start, seed, tell=Progress())
    target.parent.mkdir(exist_ok=True)
    if not from_file:
        save(data, target.with_suffix(".nc"))
        print(f"wrote {target.with_suffix('.nc')}")
    write(data, target)
    print(f"wrote {target}")


def check(scene: Scene, /) -> None:
    """Count what a scene is made of, name its redundant constraints, and try to close it; exit with 1 if it stays open.

    Args:
        scene: the mechanism.
    """
    mech, _ = _load(scene)
    from udkjax.equations.assembly import check as checked
    from udkjax.show.summary import check_summary

    found = checked(mech)
    print(check_summary(mech, found))
    if not found.closed:
        sys.exit(BAD_RUN)


def doctor() -> None:
    """Tell versions, devices and precision, ready to paste into a bug report."""
    from udkjax.show import doctor as show

    print(show.doctor())


def _load(scene: Path) -> tuple["Mechanism", str]:
    """Read a scene and its text, or say everything that is wrong with it and exit."""
    import udkjax as udk

    try:
        return udk.load(scene), scene.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as problem:
        _refuse(f"cannot read {scene}: {problem}")
    except udk.SceneError as problem:
        _refuse(str(problem))


def _refuse(problem: str) -> NoReturn:
    print(f"udkjax: {problem}", file=sys.stderr)
    sys.exit(BAD_INPUT)


@contextmanager
def _stopwatch() -> Iterator[dict[str, float]]:
    """Measure wall time (s), and how much of it went into tracing and compiling."""
    import jax

    seconds, spans = {"all": 0.0, "compiling": 0.0}, []

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith("/jax/core/compile/"):
            end = time.perf_counter()
            while spans and spans[-1][0] > end - duration_secs:  # what is traced inside this is a part of it
                spans.pop()
            spans.append((end - duration_secs, end))

    jax.monitoring.register_event_duration_secs_listener(listen)
    start = time.perf_counter()
    yield seconds
    seconds["all"] = time.perf_counter() - start
    seconds["compiling"] = sum(end - begin for begin, end in spans)
