"""`udkjax identify`."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from udkjax.cli.common import Json, Quiet, Scene, fail, load, show
from udkjax.cli.datasets import check_folder

if TYPE_CHECKING:
    from udkjax import Estimate
    from udkjax.study.identify.profile_likelihood import ProfileLikelihood

# The names of udkjax.study.identify, which cannot be imported before a command is known: it imports JAX.
Loss = Literal["least_squares", "huber", "soft_l1"]
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
    estimate_initial_state: Annotated[Estimated, tyro.conf.arg(aliases=["--estimate-start"])] = "nothing",
    ignore: Names = (),
    loss: Loss = "least_squares",
    n_starts: Annotated[int, tyro.conf.arg(aliases=["--starts"])] = 15,
    tol: float = 1e-11,
    seed: int = 0,
    profile: Names = (),
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Find numbers of a scene from measured motion: values, standard errors, and what the measurements do not show.

    Columns of the data are `time` and channels, such as `body.crank.angle [deg]`, `body.rod(0.5, 0).x [mm]`, `joint.A.fx` or
    `driver.motor.load`; empty cells are gaps, a column `record` tells runs apart, and each file is a run of its own.

    The folder gets the scene with the values in (identified.toml), the figures (estimate.json, estimate.csv), what was measured
    and what the mechanism shows (fit.nc), and pictures. The exit code is 1 where the fit does not settle or the measurements do
    not show every parameter, which is named; all is written all the same.

    Args:
        scene: the mechanism, with first guesses.
        data: measurements, in .csv or .nc files.
        parameters: `body.a.mass`, `length(a)`, a tie "length(a) = length(b)", a common factor "scale(body.a.mass, body.b.mass)".
        out: folder for the results.
        noise: standard deviation, in SI units, of what was measured: of all channels, or of one; else it is estimated.
        guess: a first guess other than the scene's value.
        bounds: lower and upper bound of a parameter.
        prior: prior knowledge of a parameter.
        estimate_initial_state: parts of the initial state of each run to estimate, too.
        ignore: columns of the data that are not to be read.
        loss: huber and soft_l1 let single wrong numbers count less.
        n_starts: most further first guesses to try.
        tol: tolerance of the integration.
        seed: of the first guesses.
        profile: parameters whose confidence intervals are to be found by profile likelihood, which needs no linear model.
        json: write the results as JSON, as in estimate.json.
    """
    check_folder(out)
    mech, text = load(scene)

    import udkjax as udk
    from udkjax.cli.identify_options import IdentifyOptions

    settings = {"loss": loss, "n_starts": n_starts, "tol": tol, "seed": seed}
    options = IdentifyOptions(mech, parameters, {"guess": guess, "bounds": bounds, "prior": prior})
    options.check(settings)
    records = options.records(data, noise, ignore, estimate_initial_state)
    profiled = options.profiled(profile)
    if options.problems:
        raise udk.IdentificationError(options.problems)
    estimate = udk.identify(mech, records, options.parameters, progress=False if quiet else None, **settings)
    profiles = [estimate.profile(name) for name in profiled]
    several = {"parameters": parameters, "noise": noise, "guess": guess, "bounds": bounds, "prior": prior, "ignore": ignore}
    given = {name: [item for group in groups for item in group] for name, groups in several.items()}
    results = estimate.to_dict() | {
        "settings": {**given, "estimate_initial_state": estimate_initial_state, **settings},
        "intervals": {found.name: found.interval for found in profiles},
        "data": [{"file": str(file), "sha256": hashlib.sha256(file.read_bytes()).hexdigest()} for file in data],
        "scene_file": str(scene),
        "scene": text,
    }
    files = _write(estimate, profiles, results, out)
    lines = [str(estimate), *(found.text for found in profiles), f"wrote {', '.join(files)} to {out}"]
    show(results | {"files": [out / name for name in files]}, "\n".join(lines), json)
    if not estimate.success:
        fail("the fit has not settled" if not estimate.converged else "the measurements do not show every parameter")


def _write(estimate: "Estimate", profiles: Sequence["ProfileLikelihood"], results: Mapping[str, object], out: Path) -> list[str]:
    """Write everything, and return the names of the files."""
    import csv
    import json

    import udkjax as udk
    from udkjax.scene.wording import plain
    from udkjax.show.identify_figures import save_fit_pictures
    from udkjax.study.identify.estimate import Row

    out.mkdir(exist_ok=True)
    udk.save(estimate.mechanism, out / "identified.toml")
    (out / "estimate.json").write_text(json.dumps(plain(results), indent=1) + "\n", encoding="utf-8")
    with (out / "estimate.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([Row._fields, *estimate.rows()])
    dataset = estimate.to_xarray(profiles)
    dataset.to_netcdf(out / "fit.nc", engine="h5netcdf")
    return ["identified.toml", "estimate.json", "estimate.csv", "fit.nc", *save_fit_pictures(dataset, out)]
