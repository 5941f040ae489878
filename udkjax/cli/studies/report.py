"""`udkjax report`."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Annotated

import tyro

from udkjax.cli.common import Json, Quiet, refuse, show
from udkjax.cli.options import NotNegativeCount, refuse_without_effect

# Variables of each run in the JSON.
RUN_VARIABLES = (
    "group",
    "method",
    "solver",
    "tol",
    "alpha",
    "beta",
    "verdict",
    "error_max",
    "psi2_end",
    "right_hand_sides",
    "accepted",
)


def report(
    out: Path = Path("report"),
    quick: bool = False,
    start: float = -45.0,
    seed: NotNegativeCount = 0,
    from_file: Annotated[Path | None, tyro.conf.arg(name="from", metavar="FILE.nc")] = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Repeat the paper's study with further methods, and write a report (HTML) and its data (NetCDF).

    Five pseudoinverses at three tolerances, with and without Baumgarte stabilization, are compared with the exact solution of the
    paper's five-bar parallelogram.

    Args:
        out: page to write (.html), or folder for report.html; the data is written to the same folder.
        quick: shorten the stiff runs and compare fewer integrators: half a minute on two cores.
        start: angle of the links (degrees) from which they are released at rest.
        seed: seed of initial states that differ by rounding errors.
        from_file: file of an earlier report: only draw the page from it, without running anything.
    """
    target = out if out.suffix == ".html" else out / "report.html"
    if from_file is not None:
        refuse_without_effect(["--quick", "--start", "--seed"], "with --from, which runs nothing")
    if out.suffix not in ("", ".html"):
        refuse(f"--out {out} is neither a page (.html) nor a folder")
    folder = target.parent if out.suffix else out.parent
    if not folder.is_dir():
        refuse(f"cannot write {out.name}: there is no folder {folder}")
    if not -180 < start < 0 or start == -90:
        refuse(f"--start {start:g}: must be between -180 and 0 degrees (no collinear links); at -90 they hang at rest")

    from udkjax.progress import report_progress

    cases, page, record, study = (_module(name) for name in ("cases", "page", "record", "study"))
    if from_file:
        try:
            data = record.read(from_file)
        except (OSError, ValueError) as problem:
            refuse(f"cannot read {from_file}: {problem}")
    else:
        with report_progress(False if quiet else None, 1.0, "report") as report_part:
            progress = lambda message, part: report_part(part, message)  # noqa: E731
            data = study.study(cases.QUICK if quick else cases.FULL, start, seed, tell=progress)
    target.parent.mkdir(exist_ok=True)
    files = [target]
    if not from_file:
        files.insert(0, target.with_suffix(".nc"))
        record.save(data, files[0])
    page.write(data, target)
    verdicts = [dict(zip(RUN_VARIABLES, row)) for row in zip(*(data[name].values for name in RUN_VARIABLES))]
    show({"runs": verdicts, "files": files}, "\n".join(f"wrote {file}" for file in files), json)


def _module(name: str) -> ModuleType:
    """Import a module of the paper's study from the installed package, or else from a clone; exit with a message without both."""
    package = "udkjax.paper" if find_spec("udkjax.paper") else "experiments.paper"
    try:
        return import_module(f"{package}.{name}")
    except ModuleNotFoundError as error:
        if error.name in ("experiments", "experiments.paper"):
            refuse("the paper's study is neither installed nor in this folder: run udkjax from a clone, or install the wheel")
        raise
