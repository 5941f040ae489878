"""Options of commands that measure a motion: channels by their names, and the driver that is meant."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from udkjax.cli.common import refuse

if TYPE_CHECKING:
    import numpy as np

    from udkjax import Mechanism
    from udkjax.study.channels import Channel, StateHistory

    Columns = dict[str, tuple[np.ndarray, str]]  # values over time and their unit, by name


def channels_of(mech: "Mechanism", names: Sequence[str]) -> "list[Channel]":
    """Return the channels of these names, or say what is wrong with one and exit."""
    from udkjax.study.channels import channel_of

    found = []
    for name in names:
        try:
            found.append(channel_of(mech, name))
        except ValueError as problem:
            refuse(f"--channels {name}: {problem}")
    return found


def measure_channels(mech: "Mechanism", motion: "StateHistory", channels: "Sequence[Channel]") -> "Columns":
    """Return the values of channels over a motion."""
    import numpy as np

    from udkjax.expressions.deferred import deferred
    from udkjax.study.channel_values import measure

    if not channels:
        return {}
    values = np.asarray(deferred(lambda mech, motion: measure(mech, motion, channels))(mech, motion))
    return {channel.name: (values[:, k], channel.units) for k, channel in enumerate(channels)}


def choose_driver(mech: "Mechanism", given: str | None) -> str:
    """Return the driver that is given, or the scene's only one."""
    if given is None and len(mech.driver_names) > 1:
        refuse(f"--driver: the scene has {len(mech.driver_names)}; name one of {', '.join(mech.driver_names)}")
    if given is None and not mech.driver_names:
        refuse(f"--driver: the scene has none; name a coordinate, such as body.{mech.body_names[0]}.angle")
    return next(iter(mech.drivers)) if given is None else given
