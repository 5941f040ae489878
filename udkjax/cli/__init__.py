"""The command line: `udkjax COMMAND`, each command a function in the module of its name.

Only the standard library and tyro are imported before a command is known, so that help comes at once.
"""

import atexit
import gc
import sys
from importlib import import_module
from importlib.metadata import version

from udkjax.cli.exits import exit_codes

COMMANDS = (
    "report",
    "simulate",
    "animate",
    "studio",
    "sweep",
    "identify",
    "kinematics",
    "inverse",
    "reactions",
    "statics",
    "modes",
    "check",
    "convert",
    "diagnose",
    "explain",
    "doctor",
)


def main(arguments: list[str] | None = None) -> None:
    """Run one command; exit with one of the codes of `udkjax.cli.exits`."""
    # At its end Python would look for garbage among all that JAX has made, for a third of a second.
    atexit.register(gc.freeze)
    if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
        print(f"udkjax {version('udkjax')}")
        return
    with exit_codes():
        from udkjax.cli.common import parse_and_run

        commands = {name: getattr(import_module(f"udkjax.cli.{name}"), name) for name in COMMANDS}
        parse_and_run(commands, arguments)
