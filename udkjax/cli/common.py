"""Parts shared by all commands: common options, reading a scene, and showing results.

A command is a function of its options that imports what it needs when it runs:

    def modes(scene: Scene, /, count: int = 5, json: Json = False) -> None:
        '''Find the natural frequencies of a scene at rest.

        Args:
            scene: the mechanism.
            count: number of frequencies.
        '''
        mech, _ = load(scene)
        from udkjax.show.summary import table
        from udkjax.statics.modes import modes as compute

        result = compute(mech)
        show({"frequencies": result.frequencies}, table(mech.name, {...}), json)

Numbers of options are finite, and within the limits of their types (`PositiveCount`, see `options`). Other wrong input ends with
`refuse("--count 0: must be positive")`, options that have no effect with `refuse_without_effect(...)`, a failed run with
`fail(...)` after `show(...)`. Exceptions of udkjax (`SceneError`, `SimulationError`, ...) need no handling: see
`exits.exit_codes`.
"""

import json as json_text
import math
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from udkjax.cli.exits import BAD_INPUT, BAD_RUN, INTERRUPTED, fail, refuse, say
from udkjax.cli.options import with_checked_options
from udkjax.extras import OptionalImport

with OptionalImport():
    import tyro

if TYPE_CHECKING:
    import numpy as np

    from udkjax import Mechanism
    from udkjax.positions.assembling.channels import Channel, StateHistory

    Columns = dict[str, tuple[np.ndarray, str]]  # values over time, and their unit, by name

__all__ = ["BAD_INPUT", "BAD_RUN", "INTERRUPTED", "Json", "Quiet", "Scene"]
__all__ += ["channels_of", "choose_driver", "fail", "load", "measure_channels", "output_times", "refuse", "say", "show"]

Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE.toml|MODEL.xml|NAME")]
Json = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help="write the results as JSON.")]
MOST_TIMES = 10**7  # output times of a command: some gigabytes for a few bodies
Quiet = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help="do not show progress.")]


def parse_and_run(commands: Mapping[str, Callable[..., None]], arguments: list[str] | None) -> None:
    """Parse arguments (by default those of the process), and run the command that they name."""
    words = sys.argv[1:] if arguments is None else arguments
    tyro.extras.subcommand_cli_from_dict(
        {name: with_checked_options(command, words) for name, command in commands.items()},
        prog="udkjax",
        args=arguments,
        description="Planar mechanisms, even with redundant constraints.",
    )


def load(scene: Path, leave_out: Sequence[str] = (), key: str | None = None) -> tuple["Mechanism", str]:
    """Return a mechanism and the text of its scene; exit with a message if the file cannot be read.

    Args:
        scene: the file; or the name of a function of `udkjax.library`, if no file has this name.
        leave_out: elements that may be left out of an MJCF model (`read_mjcf`).
        key: keyframe of an MJCF model that gives the initial state; None for none.
    """
    import udkjax as udk

    try:
        if is_of_library(scene) and not leave_out and key is None:
            mechanism = getattr(udk.library, str(scene))()
            return mechanism, udk.dumps(mechanism)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)  # including `MjcfWarning`
            mechanism = udk.read_mjcf(scene, leave_out, key) if leave_out or key is not None else udk.load(scene)
        for warning in caught:
            say(f"{scene}: {warning.message}")
        return mechanism, scene.read_text(encoding="utf-8")
    except FileNotFoundError:
        refuse(f"cannot read {scene}: there is no such file; scenes of udkjax.library are {', '.join(udk.library.__all__)}")
    except (OSError, UnicodeDecodeError) as problem:
        refuse(f"cannot read {scene}: {problem}")


def is_of_library(scene: Path) -> bool:
    """Return True if a mechanism of `udkjax.library`, and no file, has this name."""
    import udkjax as udk

    return str(scene) in udk.library.__all__ and not scene.exists()


def output_times(t0: float, t1: float, dt: float) -> "np.ndarray":
    """Return the times from t0 in steps of dt, including t1 if a step ends there; exit if the options are invalid."""
    if not 0 < dt <= t1 - t0 < math.inf:
        refuse(f"--dt {dt:g} must be positive, and at most the time from --t0 {t0:g} to --t1 {t1:g}")
    if (t1 - t0) / dt > MOST_TIMES:
        refuse(f"--dt {dt:g} makes {(t1 - t0) / dt:.3g} output times, more than {MOST_TIMES:.0e}: give a larger --dt")
    import numpy as np

    return t0 + dt * np.arange(int((t1 - t0) / dt + 1e-6) + 1)


def show(results: Mapping[str, object], text: str, json: bool) -> None:
    """Write the results of a command to stdout: as text, or as one JSON object, with the text on stderr.

    Args:
        results: results by stable names; arrays become lists, numbers that are not finite become null.
        text: the results as text for people.
        json: True for JSON.
    """
    if json:
        from udkjax.study.report import plain

        print(text, file=sys.stderr)
        print(json_text.dumps(plain(results), ensure_ascii=False, allow_nan=False), flush=True)
    else:
        print(text, flush=True)


# --- commands that measure a motion


def channels_of(mech: "Mechanism", names: Sequence[str]) -> "list[Channel]":
    """Return the channels with the given names; exit with a message if a name is invalid."""
    from udkjax.positions.assembling.channels import channel_of

    channels = []
    for name in names:
        try:
            channels.append(channel_of(mech, name))
        except ValueError as problem:
            refuse(f"--channels {name}: {problem}")
    return channels


def measure_channels(mech: "Mechanism", motion: "StateHistory", channels: "Sequence[Channel]") -> "Columns":
    """Return the values of channels along a motion, with their unit, by the name of the channel."""
    import numpy as np

    from udkjax.positions.assembling.channel_values import measure
    from udkjax.programs.deferred import deferred

    if not channels:
        return {}
    values = np.asarray(deferred(lambda mech, motion: measure(mech, motion, channels))(mech, motion))
    return {channel.name: (values[:, k], channel.units) for k, channel in enumerate(channels)}


def choose_driver(mech: "Mechanism", given: str | None) -> str:
    """Return the given driver, by default the scene's only one; exit with a message if the scene has several drivers or none."""
    if given is not None:
        return given
    from udkjax.positions.following.drive import only_driver
    from udkjax.scene.tables.checks import SceneError

    try:
        return only_driver(mech)
    except SceneError as error:
        refuse(f"--{error.problems[0]}")
