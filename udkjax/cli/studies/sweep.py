"""`udkjax sweep`."""

import sys
import time
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from udkjax.cli.common import INTERRUPTED, Json, Quiet, Scene, load, refuse, say, show
from udkjax.cli.datasets import check_folder
from udkjax.cli.options import Positive
from udkjax.extras import NETCDF_PACKAGES, require

if TYPE_CHECKING:
    from udkjax import Mechanism

Grid = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="GRID.toml")]


def sweep(
    scene: Scene,
    grid: Grid,
    /,
    out: Path | None = None,
    engine: Literal["auto", "devices", "dask"] = "auto",
    scheduler: str | None = None,
    memory: Positive = 1024.0,
    dry_run: bool = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Simulate a scene for all combinations of values of numbers, tolerances and methods, or for samples from their ranges.

    Each run is a member of the sweep. Finished members stay in the folder, even if the command is interrupted: run it again to
    continue. At the end the folder contains the dataset (sweep.nc) with the scene, settings and versions, and a picture of each
    stored number. The `result` of a member says how its run ended. For examples of grids, see examples/grids.

    Args:
        scene: the mechanism.
        grid: file with the axes (the varied quantities) and the measures to store for each member.
        out: folder for the dataset, the pictures and finished members.
        engine: compute members on the devices of this machine, or as tasks of dask.distributed.
        scheduler: address of a dask scheduler, such as tcp://host:8786; by default workers are started on this machine.
        memory: limit of the memory of members in computation (MiB).
        dry_run: only print the number of members, and their cost estimated from a sample.
    """
    if out is None and not dry_run:
        refuse("give --out FOLDER, or --dry-run")
    if out is not None:
        check_folder(out)
    if scheduler is not None and engine == "devices":
        refuse("--scheduler needs --engine dask")
    require(*NETCDF_PACKAGES, "matplotlib", *(("dask", "distributed") if engine == "dask" else ()))
    mech, text = load(scene)

    from udkjax.study.sweep.dimensions import SweepError
    from udkjax.study.sweep.executors import start_client
    from udkjax.study.sweep.grid import load_grid

    try:
        arguments = load_grid(grid)
    except OSError as problem:
        refuse(f"cannot read {grid}: {problem}")
    limit = int(memory * 2**20)
    try:
        if dry_run:
            _estimate(mech, arguments, limit, json)
            return
        assert out is not None
        with nullcontext() if engine != "dask" and scheduler is None else start_client(scheduler) as client:
            choices = {"engine": engine, "client": client, "memory": limit, "progress": False if quiet else None}
            _sweep(mech, text, arguments, out, json, choices)
    except SweepError as problem:
        refuse(f"{grid}: {problem}")
    except KeyboardInterrupt:
        say(f"stopped; finished members are in {out}: run the same command to continue")
        sys.exit(INTERRUPTED)


def _estimate(mech: "Mechanism", arguments: dict[str, Any], memory: int, json: bool) -> None:
    from udkjax.show.sweep_summary import estimate_summary
    from udkjax.study.sweep.chunks import estimate_cost
    from udkjax.study.sweep.plan import make_plan

    plan = make_plan(mech, **arguments)
    cost = estimate_cost(plan, memory)
    show(asdict(cost), estimate_summary(plan, cost), json)


def _sweep(mech: "Mechanism", text: str, arguments: dict[str, Any], out: Path, json: bool, choices: dict[str, Any]) -> None:
    import udkjax as udk
    from udkjax.show.sweep_figures import save_sweep_pictures
    from udkjax.show.sweep_summary import sweep_results, sweep_summary

    start_time = time.perf_counter()
    data = udk.sweep(mech, **arguments, out=out, **choices)
    seconds = time.perf_counter() - start_time
    data.attrs["scene"] = text
    unfinished = out / ".sweep.nc"
    data.to_netcdf(unfinished, engine="h5netcdf")
    unfinished.replace(out / "sweep.nc")
    files = ["sweep.nc", *save_sweep_pictures(data, out)]
    results = {**sweep_results(data), "seconds": seconds, "folder": out, "files": files}
    show(results, f"{sweep_summary(data, seconds)}\nwrote {', '.join(files)} to {out}", json)
