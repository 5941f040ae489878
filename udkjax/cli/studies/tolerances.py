"""`udkjax tolerances`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

from udkjax.cli.common import Json, Quiet, Scene, choose_driver, load, refuse, show
from udkjax.cli.datasets import PICTURE_SUFFIXES, check_target
from udkjax.cli.options import NotNegativeCount, PositiveCount, refuse_without_effect
from udkjax.extras import OptionalImport, require

with OptionalImport():
    import tyro


def tolerances(
    scene: Scene,
    /,
    tol: tuple[str, ...],
    measure: tuple[str, ...],
    limit: tuple[str, ...] = (),
    driver: str | None = None,
    first: Annotated[str | None, tyro.conf.arg(name="from")] = None,
    last: Annotated[str | None, tyro.conf.arg(name="to")] = None,
    count: PositiveCount = 72,
    samples: NotNegativeCount = 100_000,
    seed: NotNegativeCount = 0,
    cheapest: float | None = None,
    plot: Path | None = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Find how often a mechanism made with tolerances stays within limits, which tolerances matter, and which cost least.

    Plain numbers are in the unit of the drawing, or in SI units without one, and so are the printed ones.

    Args:
        scene: the mechanism.
        tol: tolerances: "length(crank)=0.05 mm", "pin.D[0]=h9", or "clearance(B)=0.02 mm", the play of a pin.
        measure: measures over the drive: "range(body.rocker.angle)", "deviation(pin.C)"; max, min, range, mean, rms, first, last.
        limit: limits of measures: "deviation(pin.C)=0.5 mm".
        driver: a driver of the scene, by default its only one; or a coordinate, such as body.crank.angle.
        first: first value of the driver, such as "60 deg", counted as by `udkjax kinematics`; by default, every 5 degrees of a
            turn from the drawn position.
        last: last value.
        count: number of values, with --from and --to.
        samples: number of samples.
        seed: seed of the samples.
        cheapest: also find the tolerances of least cost with this yield, such as 0.99.
        plot: picture to write (.png, .svg, .pdf or .jpg): the measures of the samples with their limits, and shares.
    """
    if (first is None) != (last is None):
        refuse("give both --from and --to, or neither")
    if first is None:
        refuse_without_effect(["--count"], "without a range: give --from and --to")
    if cheapest is not None and not limit:
        refuse(f"--cheapest {cheapest:g}: a yield needs limits; give --limit")
    if cheapest is not None and not 0 < cheapest < 1:
        refuse(f"--cheapest {cheapest:g}: must be between 0 and 1")
    check_target(plot, PICTURE_SUFFIXES, "--plot")
    require(*(["matplotlib"] if plot else ()))
    mech, _ = load(scene)
    import numpy as np

    import udkjax as udk
    from udkjax.positions.answers.counting import Count

    chosen, values = choose_driver(mech, driver), None
    if first is not None and last is not None:
        counted = Count.of(mech, chosen)
        values = np.linspace(counted.read(first, "--from"), counted.read(last, "--to"), count)
    given: dict[str, str | udk.PinClearance] = {}
    for name, text in _pairs("--tol", tol):
        of_pin = name.startswith("clearance(") and name.endswith(")")
        given[name[10:-1] if of_pin else name] = udk.PinClearance(text) if of_pin else text
    limits = dict(_pairs("--limit", limit))
    found = udk.tolerances(
        mech, given, list(measure), drive=chosen, values=values, limits=limits, samples=samples, seed=seed,
        progress=False if quiet else None,
    )  # fmt: skip
    results: dict[str, object] = {
        "yield": found.yield_, "standard_error": found.standard_error, "not_assembled": found.not_assembled,
        "outside": found.outside, "mean": found.mean, "standard_deviation": found.standard_deviation,
        "quantiles": found.quantiles(), "shares": found.shares, "trusted": found.second_order.trusted,
    }  # fmt: skip
    text = str(found)
    if cheapest is not None:
        try:
            best = results["cheapest"] = found.cheapest(cheapest)
        except ValueError as problem:
            refuse(f"--cheapest {cheapest:g}: {problem}")
        text += f"\n{best}"
    if plot is not None:
        from udkjax.show.figures import tolerances_figure

        tolerances_figure(found, mech.name).savefig(plot, dpi=150)
    show(results, text, json)


def _pairs(option: str, given: Iterable[str]) -> list[tuple[str, str]]:
    """Return the name and the value of each text "NAME=VALUE"; exit with a message if one has another form."""
    pairs = []
    for text in given:
        name, equals, value = (part.strip() for part in text.rpartition("="))
        if not equals or not name or not value:
            refuse(f'{option} "{text}": write NAME=VALUE')
        pairs.append((name, value))
    return pairs
