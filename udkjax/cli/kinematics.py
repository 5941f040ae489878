"""`udkjax kinematics`."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from udkjax.cli.common import Json, Scene, channels_of, choose_driver, fail, measure_channels, refuse, show
from udkjax.cli.datasets import load_to_write, write
from udkjax.extras import OptionalImport

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from udkjax.positions.kinematics import Travel

with OptionalImport():
    import tyro


def kinematics(
    scene: Scene,
    /,
    driver: str | None = None,
    first: Annotated[float | None, tyro.conf.arg(name="from")] = None,
    last: Annotated[float | None, tyro.conf.arg(name="to")] = None,
    count: int = 361,
    rate: float | None = None,
    branches: bool = False,
    channels: tuple[str, ...] = (),
    out: Path | None = None,
    plot: Path | None = None,
    json: Json = False,
) -> None:
    """Drive a scene through a range of positions: limits of travel, positions, velocities and accelerations.

    The limits of travel are toggle positions (dead points), where the driver can move no further. The exit code is 1 if a value
    cannot be reached.

    Args:
        scene: the mechanism.
        driver: a driver of the scene, by default its only one; or a coordinate: body.crank.angle, joint.B.angle, pin.C.x.
        first: first value (rad, m); by default the lower limit of travel, or the initial value if there is no limit.
        last: last value; by default the upper limit of travel, or one turn after the first value.
        count: number of values.
        rate: rate of the driver (rad/s, m/s), for velocities and accelerations; by default that of a motor at constant speed,
            or 1.
        branches: also find all assembly modes (branches) at the first value.
        channels: further channels to write, such as pin.C.x, pin.C.vy or body.coupler(0.1, 0).ay.
        out: file to write (.nc, .h5, .csv or .npz): value, q, v and a (value, body, coordinate), status.
        plot: picture to write (.png, .svg, .pdf or .jpg): poses and angles, or the channels.
    """
    if count < 1:
        refuse(f"--count {count}: must be positive")
    mech, text = load_to_write(scene, out, plot)
    driver, measured = choose_driver(mech, driver), channels_of(mech, channels)
    import numpy as np

    import udkjax as udk
    from udkjax.positions.coordinates import value_of
    from udkjax.positions.drive import constant_speed
    from udkjax.positions.motion_ranges import range_lines
    from udkjax.printing import format_number
    from udkjax.show.summary import table

    travel = udk.travel(mech, driver)
    rate = (constant_speed(mech, driver) or 1.0) if rate is None else rate
    first = _default(first, float(travel.lower), float(value_of(mech, driver)(udk.assemble(mech).q)))
    last = _default(last, float(travel.upper), first + (2 * math.pi if travel.unit == "rad" else float(udk.analyse(mech).length)))
    motion = udk.kinematics(mech, driver, np.linspace(first, last, count), rate=rate)
    assembly_modes = udk.branches(mech, driver, first) if branches else None
    names = [udk.Reached(int(code)).name for code in np.asarray(motion.status)]
    reached = int(np.sum(np.asarray(motion.reached)))
    free = (
        math.isinf(float(travel.lower)) and math.isinf(float(travel.upper)) and udk.Reached.lost not in np.asarray(travel.status)
    )
    lines = {
        "travel": "unlimited" if free else f"{_end(travel, 0)} to {_end(travel, 1)}",
        "reached": f"{reached} of {count} values from {_value(first, travel.unit)} to {_value(last, travel.unit)}",
    }
    if out is not None or plot is not None:
        lines["velocities"] = f"at {format_number(rate)} {travel.unit}/s of {driver}"
    if math.isfinite(float(motion.limit)):
        lines["toggle at"] = f"{float(motion.limit):.15g} {travel.unit}"
    for name, words in (("singular", "singular at"), ("not_determined", "rates undetermined at")):
        if name in names:
            lines[words] = ", ".join(f"{float(s):g}" for s, n in zip(np.asarray(motion.values), names, strict=True) if n == name)
    if assembly_modes is not None:
        lines["branches"] = f"{len(assembly_modes)} at {first:g}"
    ranges = udk.motion_ranges(mech, motion, driver)
    lines |= range_lines(ranges)
    columns = measure_channels(mech, motion, measured)
    results: dict[str, object] = {
        "driver": driver,
        "travel": [travel.lower, travel.upper],
        "values": motion.values,
        "status": names,
        "limit": motion.limit,
        "ranges": {name: getattr(ranges, name) for name in ("swings", "strokes", "transmission_angles")},
        "bodies": list(motion.bodies),
        **{name: getattr(motion, name) for name in ("q", "v", "a")},
        "channels": {name: values for name, (values, _) in columns.items()},
    }
    if assembly_modes is not None:
        results["branches"] = assembly_modes
    dims = ("value", "body", "coordinate")
    variables: "dict[str, tuple[tuple[str, ...], ArrayLike, str]]" = {
        "q": (dims, motion.q, "m, m, rad"),
        "v": (dims, motion.v, "m/s, m/s, rad/s"),
        "a": (dims, motion.a, "m/s2, m/s2, rad/s2"),
        "status": (("value",), motion.status, "0 closed, 1 singular, 2 beyond limit, 3 lost, 4 open, 5 not determined"),
    }
    coordinates = {"value": np.asarray(motion.values), "body": list(motion.bodies)}
    variables |= {name: (("value",), values, unit) for name, (values, unit) in columns.items()}
    if plot is not None:
        from udkjax.show.figures import channels_figure, driven_figure

        label = f"{driver} ({motion.unit})"
        picture = channels_figure(motion.values, columns, label, mech.name) if columns else driven_figure(mech, motion, driver)
        picture.savefig(plot, dpi=150)
    write(out, text, variables, coordinates, {"driver": driver, "rate": rate})
    show(results, table(f"{mech.name or 'mechanism'}, driven by {driver}", lines), json)
    if reached < count:
        fail(f"{count - reached} values cannot be reached: {names[int(np.argmin(np.asarray(motion.reached)))].replace('_', ' ')}")


def _end(travel: "Travel", side: int) -> str:
    """Return an end of travel as text: its value, or that it has no limit, or that the limit was not found."""
    import numpy as np

    import udkjax as udk

    lost = np.asarray(travel.status)[side] == udk.Reached.lost
    value = float((travel.lower, travel.upper)[side])
    return "unknown (lost on the way)" if lost else "no limit" if math.isinf(value) else _value(value, travel.unit)


def _value(x: float, unit: str) -> str:
    """Format a value with its unit; an angle in degrees, too."""
    from udkjax.printing import format_number

    degrees = f" ({format_number(math.degrees(x), scale=360.0)} deg)" if unit == "rad" else ""
    return f"{format_number(x, scale=1.0)} {unit}{degrees}"


def _default(given: float | None, limit: float, otherwise: float) -> float:
    """Return the given value if there is one, else the limit if it is finite, else another value."""
    if given is not None:
        return given
    return limit if math.isfinite(limit) else otherwise
