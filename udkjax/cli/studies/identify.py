"""`udkjax identify`."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from udkjax.cli.common import Json, Quiet, Scene, fail, load, show
from udkjax.cli.datasets import check_folder
from udkjax.extras import BAYES_PACKAGES, NETCDF_PACKAGES, require

if TYPE_CHECKING:
    from udkjax import Estimate, Posterior
    from udkjax.study.identify.answers.profile_likelihood import ProfileLikelihood

# The names in udkjax.study.identify, which cannot be imported here, since it imports JAX.
Loss = Literal["least_squares", "huber", "soft_l1"]
Estimated = Literal["nothing", "position", "velocity", "both"]

Several = tuple[tuple[str, ...], ...]  # values of an option that may be repeated
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
    posterior: Path | None = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Identify parameters of a scene from measured motion: values, standard errors, and parameters that are undetermined.

    Columns of the data are `time` and channels, such as `body.crank.angle [deg]`, `body.rod(0.5, 0).x [mm]`, `joint.A.fx` or
    `driver.motor.load`. Empty cells are gaps. Each file is a separate run, or several runs, named by a column `record`.

    The folder gets the scene with the identified values (identified.toml), the results (estimate.json, estimate.csv), the
    measurements and predictions (fit.nc), and pictures. The exit code is 1 if the fit does not converge or the measurements do
    not determine every parameter; the files are written even then.

    Args:
        scene: the mechanism, with first guesses.
        data: measurements, in .csv or .nc files.
        parameters: `body.a.mass`, `length(a)`, a tie "length(a) = length(b)", a common factor "scale(body.a.mass, body.b.mass)".
        out: folder for the results.
        noise: standard deviation of the measurements, in SI units, for all channels or for one; by default it is estimated.
        guess: first guess, instead of the scene's value.
        bounds: lower and upper bound of a parameter.
        prior: mean and standard deviation of prior knowledge of a parameter.
        estimate_initial_state: parts of each run's initial state to estimate, too.
        ignore: columns of the data to ignore.
        loss: function of the residuals (predicted minus measured) to minimize; huber and soft_l1 give outliers less weight.
        n_starts: maximum number of further first guesses to try.
        tol: tolerance of the integration.
        seed: seed of the further first guesses.
        profile: parameters for which to compute confidence intervals by profile likelihood, which does not assume a linear model.
        posterior: folder for draws from the posterior density, as draws.nc, their summary, as summary.json, and pictures. An
            interrupted command continues from the draws that are there.
        json: write the results as JSON, as in estimate.json.
    """
    check_folder(out)
    if posterior is not None:
        check_folder(posterior, "--posterior")
    require(*NETCDF_PACKAGES, "matplotlib", *(BAYES_PACKAGES if posterior else ()))
    mech, text = load(scene)

    import udkjax as udk
    from udkjax.cli.studies.identify_options import IdentifyOptions

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
        "intervals": {likelihood.name: likelihood.interval for likelihood in profiles},
        "data": [{"file": str(file), "sha256": hashlib.sha256(file.read_bytes()).hexdigest()} for file in data],
        "scene_file": str(scene),
        "scene": text,
    }
    files = _write(estimate, profiles, results, out)
    lines = [str(estimate), *(likelihood.text for likelihood in profiles), f"wrote {', '.join(files)} to {out}"]
    if posterior is not None:
        from udkjax.show.posterior_figures import save_posterior_pictures

        drawn = udk.sample(estimate, seed=seed, out=posterior, progress=False if quiet else None)
        results |= _write_draws(drawn, posterior)
        drawings = [*save_posterior_pictures(drawn, estimate, posterior)]
        lines += [str(drawn), f"wrote draws.nc, summary.json, {' and '.join(drawings)} to {posterior}"]
    show(results | {"files": [out / name for name in files]}, "\n".join(lines), json)
    if not estimate.success:
        fail("the fit has not converged" if not estimate.converged else "the measurements do not determine every parameter")


def _write_draws(drawn: "Posterior", folder: Path) -> Mapping[str, Any]:
    """Write the draws and their summary to a folder, and return the summary."""
    import json

    from udkjax.study.report import plain

    drawn.to_arviz(pointwise=False).to_netcdf(str(folder / "draws.nc"), engine="h5netcdf")
    rows = {name: row._asdict() for name, row in drawn.summary().items()}
    found = {"posterior": {"parameters": rows, "converged": drawn.converged, "message": drawn.message}}
    (folder / "summary.json").write_text(json.dumps(plain(found), indent=1) + "\n", encoding="utf-8")
    return found


def _write(estimate: "Estimate", profiles: Sequence["ProfileLikelihood"], results: Mapping[str, object], out: Path) -> list[str]:
    """Write the scene, the results, the dataset and the pictures of an estimate to the folder, and return the file names."""
    import csv
    import json

    import udkjax as udk
    from udkjax.show.identify_figures import save_fit_pictures
    from udkjax.study.report import plain

    out.mkdir(exist_ok=True)
    udk.save(estimate.mechanism, out / "identified.toml")
    (out / "estimate.json").write_text(json.dumps(plain(results), indent=1) + "\n", encoding="utf-8")
    with (out / "estimate.csv").open("w", encoding="utf-8", newline="") as file:
        rows = estimate.rows()
        csv.writer(file).writerows([rows[0]._fields, *rows])
    dataset = estimate.to_xarray(profiles)
    dataset.to_netcdf(out / "fit.nc", engine="h5netcdf")
    return ["identified.toml", "estimate.json", "estimate.csv", "fit.nc", *save_fit_pictures(dataset, out)]
