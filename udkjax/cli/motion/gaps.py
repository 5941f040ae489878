"""`udkjax gaps`."""

import math
from typing import Annotated

from udkjax.cli.common import Json, Scene, choose_driver, fail, show
from udkjax.extras import OptionalImport

with OptionalImport():
    import tyro


def gaps(
    scene: Scene,
    /,
    driver: str | None = None,
    first: Annotated[str | None, tyro.conf.arg(name="from")] = None,
    last: Annotated[str | None, tyro.conf.arg(name="to")] = None,
    width: str | None = None,
    layers: bool = False,
    json: Json = False,
) -> None:
    """Find how close links come to each other over the range of a driver, and where they touch; exit with 1 if any do.

    Measured are all pairs of links that share no joint. No smaller gap lies between the computed positions.

    Args:
        scene: the mechanism.
        driver: a driver of the scene, by default its only one; or a coordinate: body.crank.angle, joint.B.angle, pin.C.x.
        first: first value, such as "60 deg"; by default the whole range, one turn or from toggle to toggle. Values are counted as
            by `udkjax kinematics`.
        last: last value; by default the whole range.
        width: width of all links, such as "12 mm", instead of those that are drawn.
        layers: also find the fewest layers in which nothing hits anything; then links that touch are no failure.
    """
    from udkjax.cli.common import load, refuse

    mech, _ = load(scene)
    driver = choose_driver(mech, driver)
    if (first is None) != (last is None):
        refuse("--from and --to: give both, or neither")
    import udkjax as udk
    from udkjax.positions.answers.counting import Count

    counted = Count.of(mech, driver)
    values = None if first is None or last is None else [counted.read(first, "--from"), counted.read(last, "--to")]
    problems: list[str] = []
    given = None if width is None else counted.units.convert("--width", width, "m", problems)
    if problems:
        refuse(problems[0])
    if isinstance(given, float) and not 0 <= given < math.inf:
        refuse(f"--width {width}: must be finite and not negative")
    shapes = None if given is None else dict.fromkeys(mech.body_names, given)
    found = udk.gaps(mech, driver, values=values, shapes=shapes)
    results = {
        "unit": found.unit,
        "gaps": [gap._asdict() for gap in found.pairs],
        "contacts": [touch._asdict() for touch in found.contacts],
        "missing": found.missing,
    }
    text = repr(found)
    if layers:
        passed = udk.layers(mech, driver, values=values, shapes=shapes)
        results["layers"] = passed.of
        text += f"\n\n{passed!r}"
    show(results, text, json)
    if found.contacts and not layers:
        fail(found.summary())
