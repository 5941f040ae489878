"""`udkjax kinematics`."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from udkjax.cli.common import Json, Scene, channels_of, choose_driver, fail, measure_channels, refuse, show
from udkjax.cli.datasets import load_to_write, write
from udkjax.cli.options import PositiveCount
from udkjax.extras import OptionalImport

if TYPE_CHECKING:
    from udkjax import Travel
    from udkjax.annotations import Numbers
    from udkjax.cli.common import Columns
    from udkjax.positions.answers.counting import Count

with OptionalImport():
    import tyro


def kinematics(
    scene: Scene,
    /,
    driver: str | None = None,
    at: str | None = None,
    first: Annotated[str | None, tyro.conf.arg(name="from")] = None,
    last: Annotated[str | None, tyro.conf.arg(name="to")] = None,
    count: PositiveCount | None = None,
    rate: str | None = None,
    branches: bool = False,
    channels: tuple[str, ...] = (),
    out: Path | None = None,
    plot: Path | None = None,
    json: Json = False,
) -> None:
    """Answer what a course asks of a mechanism: positions, velocities, accelerations, dead points, strokes, type, transmission.

    With --at, tables of all pins and links in one position, with its instant centres, and the forces at rest if a motor holds
    the mechanism; with --count, tables by the driver's value. Values may have units, "60 deg" or "2 turns"; plain numbers are in
    the unit of the drawing, or in SI units without one. Angles are those of the drawing: that of a crank is measured from the x
    axis to the line from its pin on the ground to its other pin. The exit code is 1 if a value cannot be reached.

    Args:
        scene: the mechanism.
        driver: a driver of the scene, by default its only one; or a coordinate: body.crank.angle, joint.B.angle, pin.C.x.
        at: value of the driver for which all pins and links are shown.
        first: first value; by default the lower limit of travel, or the initial value if there is no limit.
        last: last value; by default the upper limit of travel, or one turn after the first value.
        count: number of values, with tables of the pins and links at each; by default 361 without tables.
        rate: rate of the driver, such as "60 rpm", for velocities and accelerations; by default that of a motor at constant
            speed, or 1 rad/s or m/s.
        branches: also find all assembly modes (branches) at the first value.
        channels: further channels to write, such as pin.C.x, pin.C.vy or body.coupler(0.1, 0).ay.
        out: file to write (.nc, .h5, .csv or .npz): value, q, v and a (value, body, coordinate), status.
        plot: picture to write (.png, .svg, .pdf or .jpg): poses and angles, or the channels.
    """
    if at is not None and (first, last, count) != (None, None, None):
        refuse("--at is one value: leave out --from, --to and --count")
    mech, text = load_to_write(scene, out, plot)
    driver, measured = choose_driver(mech, driver), channels_of(mech, channels)
    import numpy as np

    import udkjax as udk
    from udkjax.positions.answers.centres import centres_table
    from udkjax.positions.answers.counting import Count
    from udkjax.positions.answers.pin_motion import usual_rate
    from udkjax.positions.assembling.coordinates import value_of
    from udkjax.printing import text_table
    from udkjax.show.summary import table
    from udkjax.statics.resting_forces import forces_table

    counted, travel = Count.of(mech, driver), udk.travel(mech, driver)
    speed = usual_rate(mech, driver) if rate is None else counted.read_rate(rate, "--rate")
    drawn = float(value_of(mech, driver)(udk.assemble(mech).q))
    if at is not None:
        values = np.array([counted.nearest(counted.read(at, "--at"), drawn)])
    else:
        start = _default(None if first is None else counted.read(first, "--from"), float(travel.lower), drawn)
        turn = start + (2 * math.pi if counted.is_angle else float(udk.analyse(mech).length))
        end = _default(None if last is None else counted.read(last, "--to"), float(travel.upper), turn)
        values = np.linspace(start, end, count or 361)
    motion = udk.kinematics(mech, driver, values, rate=speed)
    found = udk.characteristics(mech, driver)
    assembly_modes = udk.branches(mech, driver, values[0]) if branches else None
    names = [udk.Reached(int(code)).name for code in np.asarray(motion.status)]
    reached, number = int(np.sum(np.asarray(motion.reached))), len(values)
    free = (
        math.isinf(float(travel.lower)) and math.isinf(float(travel.upper)) and udk.Reached.lost not in np.asarray(travel.status)
    )
    lines = {
        "values count": counted.words,
        "travel": "unlimited" if free else f"{_end(travel, 0, counted)} to {_end(travel, 1, counted)}",
        "reached": f"{reached} of {number} values from {counted.text(values[0])} to {counted.text(values[-1])}",
        "velocities": f"{counted.rate_text(speed)} of {driver}",
    }
    if math.isfinite(float(motion.limit)):
        lines["toggle at"] = counted.text(float(motion.limit))
    for name, words in (("singular", "singular at"), ("not_determined", "rates undetermined at")):
        if name in names:
            lines[words] = ", ".join(counted.text(s) for s, n in zip(values, names, strict=True) if n == name)
    if assembly_modes is not None:
        lines["branches"] = f"{len(assembly_modes)} at {counted.text(values[0])}"
    lines |= {title: words for title, words in found.lines().items() if title != "driver"}
    said = table(f"{mech.name or 'mechanism'}, driven by {driver}", lines)
    if at is not None or count is not None:
        tables = udk.pin_motion(mech, motion).counted(counted).tables()
        said = "\n\n".join([said, *(text_table(one, 10**9) for one in tables)])
    if at is not None and reached:
        said += "\n\n" + text_table(centres_table(mech, motion, counted), 10**9)
        if forces := forces_table(mech, np.asarray(motion.q)[0]):
            said += "\n\n" + text_table(forces, 10**9)
    columns = measure_channels(mech, motion, measured)
    results: dict[str, object] = {
        "driver": driver,
        "travel": [travel.lower, travel.upper],
        "values": motion.values,
        "status": names,
        "limit": motion.limit,
        "characteristics": {
            "mobility": found.mobility._asdict(),
            "four_bars": [bar._asdict() for bar in found.four_bars],
            "outputs": {name: output._asdict() for name, output in found.outputs.items()},
            "transmission_angles": found.transmission_angles,
            "ratios": found.ratios,
        },
        "bodies": list(motion.bodies),
        **{name: getattr(motion, name) for name in ("q", "v", "a")},
        "channels": {name: values for name, (values, _) in columns.items()},
    }
    if assembly_modes is not None:
        results["branches"] = assembly_modes
    dims = ("value", "body", "coordinate")
    variables: "dict[str, tuple[tuple[str, ...], Numbers, str]]" = {
        "q": (dims, motion.q, "m, m, rad"),
        "v": (dims, motion.v, "m/s, m/s, rad/s"),
        "a": (dims, motion.a, "m/s2, m/s2, rad/s2"),
        "status": (("value",), motion.status, "0 closed, 1 singular, 2 beyond limit, 3 lost, 4 open, 5 not determined"),
    }
    coordinates = {"value": np.asarray(motion.values), "body": list(motion.bodies)}
    variables |= {name: (("value",), values, unit) for name, (values, unit) in columns.items()}
    if plot is not None:
        from udkjax.show.figures import channels_figure, driven_figure

        label = f"{driver}: {counted.words} ({counted.unit})"
        along = np.array([counted.shown(value) for value in np.asarray(motion.values)])
        if columns:
            picture = channels_figure(along, _in_units(columns, counted), label, mech.name)
        else:
            picture = driven_figure(mech, motion, along, label)
        picture.savefig(plot, dpi=150)
    write(out, text, variables, coordinates, {"driver": driver, "rate": speed})
    show(results, said, json)
    if reached < number:
        fail(
            f"{number - reached} values cannot be reached: {names[int(np.argmin(np.asarray(motion.reached)))].replace('_', ' ')}"
        )


def _in_units(columns: "Columns", counted: "Count") -> "Columns":
    """Return channels with lengths and angles converted from SI units to the units of the drawing."""
    length, size = counted.units.shown("m"), counted.units.size("m")
    shown = {"m": (length, size), "m/s": (f"{length}/s", size), "m/s2": (f"{length}/s²", size)}
    shown["rad"] = counted.units.shown("rad"), counted.units.size("rad")
    found = {name: (values, *shown.get(unit, (unit, 1.0))) for name, (values, unit) in columns.items()}
    return {name: (values / size, unit) for name, (values, unit, size) in found.items()}


def _end(travel: "Travel", side: int, counted: "Count") -> str:
    """Return the lower (`side` 0) or upper end (1) of a travel as text: its value, "no limit", or that it was not found."""
    import numpy as np

    import udkjax as udk

    lost = np.asarray(travel.status)[side] == udk.Reached.lost
    value = float((travel.lower, travel.upper)[side])
    return "unknown (lost on the way)" if lost else "no limit" if math.isinf(value) else counted.text(value)


def _default(given: float | None, limit: float, otherwise: float) -> float:
    """Return the given value if there is one; else the limit if it is finite; else the value `otherwise`."""
    if given is not None:
        return given
    return limit if math.isfinite(limit) else otherwise
