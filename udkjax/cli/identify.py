"""`udkjax identify`."""

import hashlib
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from udkjax.cli.common import BAD_RUN, INTERRUPTED, Scene, load, refuse

if TYPE_CHECKING:
    from udkjax import Estimate
    from udkjax.study.identify.profile import Profile

# The names of udkjax.study.identify, which cannot be imported before a command is known: it imports JAX.
Loss = Literal["least_squares", "huber"]
Estimated = Literal["nothing", "position", "velocity", "both"]

Several = tuple[tuple[str, ...], ...]  # of an option that may be given again
Data = Annotated[
    tuple[Path, ...],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="DATA.csv [DATA2.nc ...]", help_behavior_hint="(required)"),
]
Names = Annotated[Several, tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME [NAME ...]")]
Noise = Annotated[Several, tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NUMBER|CHANNEL=NUMBER [...]")]
Guesses = Annotated[Several, tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE [...]")]
Bounds = Annotated[Several, tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=LOW,HIGH [...]")]
Priors = Annotated[Several, tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=MEAN,DEVIATION [...]")]


def identify(
    scene: Scene,
    data: Data,
    /,
    parameters: Annotated[Names, tyro.conf.arg(metavar="NAME [NAME ...]", help_behavior_hint="(required, repeatable)")],
    out: Path,
    noise: Noise = (),
    guess: Guesses = (),
    bounds: Bounds = (),
    prior: Priors = (),
    estimate_start: Estimated = "nothing",
    ignore: Names = (),
    loss: Loss = "least_squares",
    starts: int = 15,
    tol: float = 1e-11,
    seed: int = 0,
    profile: Names = (),
    quiet: bool = False,
) -> None:
    """Find numbers of a scene from measured motion: values, standard errors, and what the measurements cannot tell.

    Columns of the data are `time` and channels, such as `body.crank.angle [deg]`, `body.rod(0.5, 0).x [mm]`, `joint.A.fx` or
    `driver.motor.load`; empty cells are gaps, a column `record` tells runs apart, and each file is a run of its own.

    The folder gets the scene with the values in (identified.toml), the figures (estimate.json, estimate.csv), what was measured
    and what the mechanism shows (fit.nc), and pictures. The exit code is 1 where the fit does not settle or the measurements do
    not tell every parameter, which is said by name; all is written all the same.

    Args:
        scene: the mechanism, with first guesses.
        data: measurements, in .csv or .nc files.
        parameters: `body.a.mass`, `length(a)`, a tie "length(a) = length(b)", a common factor "scale(body.a.mass, body.b.mass)".
        out: folder for the results.
        noise: standard deviation, in SI units, of what was measured: of all channels, or of one; else it is estimated.
        guess: a first guess other than the scene's value.
        bounds: what a parameter stays between.
        prior: what was known of a parameter before.
        estimate_start: what of the state in which each run begins is to be found too.
        ignore: columns of the data that are not to be read.
        loss: huber lets single wrong numbers count less.
        starts: how many more first guesses may be tried.
        tol: tolerance of the integration.
        seed: of the first guesses.
        profile: parameters whose confidence intervals are to be found by profile likelihood, which needs no linear model.
        quiet: do not show how far it is.
    """
    if out.exists() and not out.is_dir():
        refuse(f"--out {out} is no folder")
    if not out.parent.is_dir():
        refuse(f"there is no folder {out.parent} to make {out.name} in")
    mech, text = load(scene)

    import udkjax as udk
    from udkjax.cli.identify_texts import Texts

    settings = {"loss": loss, "starts": starts, "tol": tol, "seed": seed}
    asked = Texts(mech, parameters, {"start": guess, "bounds": bounds, "prior": prior})
    asked.check(settings)
    records = asked.records(data, noise, ignore, estimate_start)
    profiled = asked.profiled(profile)
    if asked.problems:
        refuse(str(udk.IdentificationError(asked.problems)))
    try:
        estimate = udk.identify(mech, records, asked.parameters, progress=False if quiet else None, **settings)
        profiles = [estimate.profile(name) for name in profiled]
    except (udk.IdentificationError, udk.AssemblyError) as problem:
        refuse(str(problem))
    except KeyboardInterrupt:
        print("\nudkjax: stopped; nothing was written", file=sys.stderr)
        sys.exit(INTERRUPTED)
    several = {"parameters": parameters, "noise": noise, "guess": guess, "bounds": bounds, "prior": prior, "ignore": ignore}
    options = {name: [item for group in groups for item in group] for name, groups in several.items()}
    facts = {
        "settings": {**options, "estimate_start": estimate_start, **settings},
        "intervals": {found.name: [end if math.isfinite(end) else None for end in found.interval] for found in profiles},
        "data": [{"file": str(file), "sha256": hashlib.sha256(file.read_bytes()).hexdigest()} for file in data],
        "scene_file": str(scene),
        "scene": text,
    }
    print("\n".join([str(estimate), *(found.text for found in profiles)]))
    print(f"wrote {', '.join(_written(estimate, profiles, facts, out))} to {out}")
    if not estimate.success:
        sys.exit(BAD_RUN)


def _written(estimate: "Estimate", profiles: list["Profile"], facts: dict[str, Any], out: Path) -> list[str]:
    """Write everything, and return the names of the files."""
    import csv
    import json

    import udkjax as udk
    from udkjax.show.identify_figures import save_pictures
    from udkjax.study.identify.held import with_profiles
    from udkjax.study.identify.results import Row, rows

    out.mkdir(exist_ok=True)
    udk.save(estimate.mechanism, out / "identified.toml")
    (out / "estimate.json").write_text(json.dumps({**estimate.to_dict(), **facts}, indent=1) + "\n", encoding="utf-8")
    with (out / "estimate.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([Row._fields, *rows(estimate)])
    found = estimate.to_xarray()
    found = with_profiles(found, estimate, profiles) if profiles else found
    found.to_netcdf(out / "fit.nc", engine="h5netcdf")
    return ["identified.toml", "estimate.json", "estimate.csv", "fit.nc", *save_pictures(found, out)]
