"""Parts of all commands: options that are spelled alike, reading a scene, and showing results.

A command is a function of its options that imports what it needs when it runs:

    def modes(scene: Scene, /, count: int = 5, json: Json = False) -> None:
        '''Find the natural frequencies of a scene at rest.

        Args:
            scene: the mechanism.
            count: how many.
        '''
        mech, _ = load(scene)
        from udkjax.show.summary import table
        from udkjax.statics.modes import modes as compute

        found = compute(mech)
        show({"frequencies": found.frequencies}, table(mech.name, {...}), json)

Wrong input ends with `refuse("--count 0: must be positive")`, a run that failed with `fail(...)` after `show(...)`. Errors that
udkjax raises by itself (`SceneError`, `SimulationError`, ...) need no handling: see `exits.exit_codes`.
"""

import json as json_text
import math
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from udkjax.cli.exits import BAD_INPUT, BAD_RUN, INTERRUPTED, fail, refuse, say
from udkjax.extras import OptionalImport

with OptionalImport():
    import tyro

if TYPE_CHECKING:
    import numpy as np

    from udkjax import Mechanism
    from udkjax.positions.channels import Channel, StateHistory

    Columns = dict[str, tuple[np.ndarray, str]]  # values over time and their unit, by name

__all__ = ["BAD_INPUT", "BAD_RUN", "INTERRUPTED", "Json", "Quiet", "Scene"]
__all__ += ["channels_of", "choose_driver", "fail", "load", "measure_channels", "output_times", "refuse", "say", "show"]

Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE.toml|MODEL.xml")]
Json = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help="write the results as JSON.")]
MOST_TIMES = 10**7  # output times of a command: some gigabytes for a few bodies
Quiet = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help="do not show how far it is.")]


def parse_and_run(commands: Mapping[str, Callable[..., None]], arguments: list[str] | None) -> None:
    """Run the command that the arguments (default: those of the process) name, with their options."""
    tyro.extras.subcommand_cli_from_dict(
        dict(commands), prog="udkjax", args=arguments, description="Planar mechanisms, however redundantly constrained."
    )


def load(scene: Path, leave_out: Sequence[str] = (), key: str | None = None) -> tuple["Mechanism", str]:
    """Read a scene and its text; the options are those of `read_mjcf`."""
    import udkjax as udk

    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)  # as is an `MjcfWarning`
            mechanism = udk.read_mjcf(scene, leave_out, key) if leave_out or key is not None else udk.load(scene)
        for warning in caught:
            say(f"{scene}: {warning.message}")
        return mechanism, scene.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as problem:
        refuse(f"cannot read {scene}: {problem}")


def output_times(t0: float, t1: float, dt: float) -> "np.ndarray":
    """Return the times from t0 in steps of dt, t1 too, where it is one of them up to rounding; or refuse the options and exit."""
    if not 0 < dt <= t1 - t0 < math.inf:
        refuse(f"from --t0 {t0:g} to --t1 {t1:g} there must be at least one --dt {dt:g}, which must be positive")
    if (t1 - t0) / dt > MOST_TIMES:
        refuse(f"--dt {dt:g} makes {(t1 - t0) / dt:.3g} output times; at most {MOST_TIMES:.0e} are written: make it longer")
    import numpy as np

    return t0 + dt * np.arange(int((t1 - t0) / dt + 1e-6) + 1)


def show(results: Mapping[str, object], text: str, json: bool) -> None:
    """Write the results of a command to stdout: as text, or as one JSON object, and the text then to stderr.

    Args:
        results: results by names that scripts can rely on; arrays become lists, numbers that are not finite become null.
        text: the same for people.
        json: whether JSON was asked for.
    """
    if json:
        from udkjax.scene.wording import plain

        print(text, file=sys.stderr)
        print(json_text.dumps(plain(results), ensure_ascii=False, allow_nan=False), flush=True)
    else:
        print(text, flush=True)


# --- commands that measure a motion


def channels_of(mech: "Mechanism", names: Sequence[str]) -> "list[Channel]":
    """Return the channels of these names, or say what is wrong with one and exit."""
    from udkjax.positions.channels import channel_of

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

    from udkjax.programs.deferred import deferred
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
        from udkjax.positions.drive import suggested_coordinate

        refuse(f"--driver: the scene has none; name a coordinate, such as {suggested_coordinate(mech)}")
    return next(iter(mech.drivers)) if given is None else given
