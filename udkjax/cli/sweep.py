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
    memory: float = 1024.0,
    dry_run: bool = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Simulate a scene with all combinations of some of its numbers, tolerances and methods, or with a design over their ranges.

    Finished members stay in the folder, whatever happens: the same command again goes on from there. At the end the folder
    holds the dataset, sweep.nc, with the scene, settings and versions, and a picture of each number that was kept of a member.
    Members that fail have a result that says how; examples/grids shows what a grid can be.

    Args:
        scene: the mechanism.
        grid: file of the axes, and of what to keep of each member.
        out: folder for the dataset, the pictures and what is finished so far.
        engine: place to compute members: the devices of this machine, or as tasks of dask.distributed.
        scheduler: address of a scheduler of dask, such as tcp://host:8786; without one, workers are processes of this machine.
        memory: memory of the members that are computed at a time, at most (MiB).
        dry_run: say how many members there are, and what they will take, from a sample; compute nothing else.
    """
    if out is None and not dry_run:
        refuse("--out FOLDER is missing (or --dry-run)")
    if out is not None:
        check_folder(out)
    if not memory > 0:
        refuse(f"--memory {memory:g}: must be positive")
    if scheduler is not None and engine == "devices":
        refuse("--scheduler is for --engine dask")
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
        say(f"stopped; what is finished is in {out}, and the same command goes on from there")
        sys.exit(INTERRUPTED)


def _estimate(mech: "Mechanism", arguments: dict[str, Any], memory: int, json: bool) -> None:
    from udkjax.show.sweep_summary import estimate_summary
    from udkjax.study.sweep.chunks import estimate_cost
    from udkjax.study.sweep.plan import make_plan

    plan = make_plan(mech, **arguments)
    found = estimate_cost(plan, memory)
    show(asdict(found), estimate_summary(plan, found), json)


def _sweep(mech: "Mechanism", text: str, arguments: dict[str, Any], out: Path, json: bool, choices: dict[str, Any]) -> None:
    import udkjax as udk
    from udkjax.show.sweep_figures import save_sweep_pictures
    from udkjax.show.sweep_summary import sweep_results, sweep_summary

    begun = time.perf_counter()
    data = udk.sweep(mech, **arguments, out=out, **choices)
    seconds = time.perf_counter() - begun
    data.attrs["scene"] = text
    unfinished = out / ".sweep.nc"
    data.to_netcdf(unfinished, engine="h5netcdf")
    unfinished.replace(out / "sweep.nc")
    files = ["sweep.nc", *save_sweep_pictures(data, out)]
    results = {**sweep_results(data), "seconds": seconds, "folder": out, "files": files}
    show(results, f"{sweep_summary(data, seconds)}\nwrote {', '.join(files)} to {out}", json)
