"""`udkjax animate`."""

import math
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from udkjax.cli.common import Json, fail, is_of_library, load, output_times, refuse, show
from udkjax.cli.datasets import check_target
from udkjax.cli.options import Positive, PositiveCount, in_option_words, refuse_without_effect
from udkjax.extras import NETCDF_PACKAGES, WRITING_PACKAGES, require

if TYPE_CHECKING:
    import numpy as np

    from udkjax import Mechanism
    from udkjax.show.player.marks.measure_curves import ShownMotion

    ShownRun = tuple[Mechanism, ShownMotion, dict[str, np.ndarray]]  # the last entry: further measures by name

ANIMATION_SUFFIXES = (".html", ".gif", ".mp4", ".svg", ".png", ".dxf")
PICTURES, FILMS = (".svg", ".png"), (".gif", ".mp4")
KINDS_OF_OPTION = {  # kinds of files on which an option has an effect
    "--measures": (".html",),
    "--autoplay": (".html",),
    "--theme": (".html", *FILMS, *PICTURES),
    "--t": (*PICTURES, ".dxf"),
    "--fps": FILMS,
    "--speed": FILMS,
    "--width": (*FILMS, *PICTURES),
}
Files = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN.nc|SCENE.toml|NAME")]


def animate(
    files: Files,
    /,
    out: Path,
    t1: float = 10.0,
    dt: float = 0.02,
    labels: tuple[str, ...] = (),
    measures: tuple[str, ...] = ("violation", "energy", "rank"),
    reactions: bool = False,
    traces: tuple[str, ...] = (),
    gaps: bool = False,
    live: tuple[str, ...] | None = None,
    theme: Literal["light", "dark"] | None = None,
    autoplay: bool = False,
    t: float | None = None,
    fps: Positive | None = None,
    speed: Positive | None = None,
    width: PositiveCount | None = None,
    json: Json = False,
) -> None:
    """Show one or several synchronized motions as a page for the browser, a film or a picture.

    A failed run is shown up to its end, with the cause, and the exit code is 1.

    Args:
        files: runs written by `udkjax simulate` (NetCDF), or scenes (TOML, MJCF or names of `udkjax.library`) to
            simulate.
        out: file to write: .html, a self-contained page; .gif or .mp4, a film; .svg, .png or .dxf, one pose.
        t1: end of the run of a scene (s).
        dt: time between outputs of the run of a scene (s).
        labels: names of the runs, if there are several; by default the files' names.
        measures: curves over time: violation (of the constraints), energy, rank, or a variable of the file over time.
        reactions: draw the forces of the joints as arrows.
        traces: joints or bodies whose paths are drawn; by default the moving pins.
        gaps: paint links red while they touch, on pages, in films and pictures; a button of a page leads to their least gap.
        live: make a page that simulates, with bodies to drag and a slider for every number of the scene, or for those that are
            named (motor.crank.speed, pin.B).
        theme: colours; by default, on a page, the preference of the reader's system, otherwise light.
        autoplay: start the motion when the page is opened.
        t: time of a pose (s); by default the start.
        fps: frames per second of a film.
        speed: seconds of motion per second of a film; by default a comfortable speed.
        width: width of a film or a picture (px).
    """
    check_target(out, ANIMATION_SUFFIXES)
    kind = out.suffix.lower()
    for option, kinds in KINDS_OF_OPTION.items():
        if kind not in kinds:
            refuse_without_effect([option], f"on --out {out.name}: it is for {', '.join(kinds)}")
    if not any(map(_is_scene, files)):
        refuse_without_effect(["--t1", "--dt"], "on runs that are read: it is for scenes")
    require(
        *WRITING_PACKAGES.get(kind, ()),
        *(NETCDF_PACKAGES if any(file.suffix.lower() in (".nc", ".h5") for file in files) else ()),
    )
    if not files:
        refuse("give a run (.nc) or a scene (.toml)")
    if not 0 < dt <= t1 < math.inf:
        refuse(f"--dt {dt:g} must be positive, and at most --t1 {t1:g}")
    if labels and len(labels) != len(files):
        refuse(f"{len(labels)} --labels for {len(files)} files")
    if live is not None and kind != ".html":
        refuse(f"--live makes a page that simulates: --out must be a .html file, not {out.name}")
    if gaps and kind == ".dxf":
        refuse(f"--gaps paints links red: --out must be a page, a film or a picture, not {out.name}")
    names = list(labels or (file.stem if len(files) > 1 else "" for file in files))
    if len(set(names)) < len(names):
        refuse(f"runs must have different labels, not {', '.join(names)}: give --labels")

    import udkjax as udk
    from udkjax.show.player.animation import FailedRunWarning

    runs = {name: _run(file, t1, dt) for name, file in zip(names, files, strict=True)}
    look = {"theme": theme, "fps": fps, "speed": speed, "width": width, "autoplay": autoplay or None}
    options = {name: value for name, value in look.items() if value is not None}
    try:
        with warnings.catch_warnings(action="ignore", category=FailedRunWarning):  # reported below
            animation = udk.animate(
                {name: mechanism for name, (mechanism, _, _) in runs.items()},
                {name: run for name, (_, run, _) in runs.items()},
                measures=_measures(measures, runs) if kind == ".html" else (),
                reactions=reactions,
                traces=traces or None,
                gaps=gaps,
                live=list(live or ()) or live is not None,  # names, True for all numbers, or False
            )
        animation.save(out, t, **options)
    except (ValueError, OSError) as problem:
        refuse(in_option_words(str(problem), animate))
    size = out.stat().st_size
    data = animation.data
    results = {"files": [out], "bytes": size, "start": data["start"], "end": data["end"], "speed": data["speed"]}
    show(results | {"failures": animation.failures}, f"wrote {out} ({size / 1e3:.0f} kB)", json)
    if animation.failures:
        fail("; ".join(f"{name}: {cause}" if name else f"the run failed: {cause}" for name, cause in animation.failures.items()))


def _is_scene(file: Path) -> bool:
    """Return True for a scene, which is simulated, and False for a run."""
    return file.suffix.lower() in (".toml", ".xml") or is_of_library(file) or not (file.suffix or file.exists())


def _run(file: Path, t1: float, dt: float) -> "ShownRun":
    """Return the mechanism of a file, its run, and further measures that the file contains, by "name (unit)".

    A scene is simulated until `t1` with an output time each `dt`, and has no further measures.
    """
    if _is_scene(file):
        mechanism, _ = load(file)

        import udkjax as udk

        run = udk.simulate(mechanism, output_times(0.0, t1, dt), throw=False)
        return mechanism, run, {}

    from udkjax.show.player.run_files import read_run

    try:
        run = read_run(file)
    except (ValueError, OSError) as problem:
        refuse(f"cannot read {file}: {problem}" if isinstance(problem, OSError) else problem)
    return run.mechanism, run, run.others


def _measures(wanted: tuple[str, ...], runs: dict[str, "ShownRun"]) -> "dict[str, dict[str, np.ndarray] | None]":
    """Return the wanted measures by name: None if a measure is to be computed, else its values in the file of each run."""
    measures: dict[str, dict[str, np.ndarray] | None] = {}
    for name in wanted:
        by_run = {
            label: {key: value for key, value in further.items() if key.split(" (")[0] == name}
            for label, (_, _, further) in runs.items()
        }
        keys = {key for variables in by_run.values() for key in variables}
        for key in keys or {name}:
            measures[key] = {label: variables[key] for label, variables in by_run.items() if key in variables} if keys else None
    return measures
