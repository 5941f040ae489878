"""The command line: `udkjax COMMAND`, each command a function in the module of its name.

Only the standard library and tyro are imported before a command is known, so that help comes at once.
"""

import gc
import os
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
    "design",
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

GARBAGE_EVERY = 50_000  # objects: most that a command makes are there to stay, and looking them through takes a tenth of a second
PROGRAM_CACHE_BYTES = 200_000_000  # bytes of programs of JAX; those that were used longest ago make room


def main(arguments: list[str] | None = None) -> None:
    """Run one command; exit with one of the codes of `udkjax.cli.exits`."""
    gc.set_threshold(GARBAGE_EVERY)
    if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
        print(f"udkjax {version('udkjax')}")
        return
    store_compiled_programs()
    with exit_codes():
        from udkjax.cli.common import parse_and_run

        commands = {name: getattr(import_module(f"udkjax.cli.{name}"), name) for name in COMMANDS}
        parse_and_run(commands, arguments)


def store_compiled_programs() -> None:
    """Let JAX store what it compiles beside the machine code: a command that is run again then compiles nothing.

    A folder that the environment names for JAX's programs stays, and JAX is left alone where it is imported already.
    """
    from udkjax.native.base.code_cache import cache_folder

    folder = cache_folder()
    if folder is None or "jax" in sys.modules:
        return
    for name, value in {"DIR": f"{folder / 'jax'}", "MAX_SIZE": f"{PROGRAM_CACHE_BYTES}"}.items():
        os.environ.setdefault(f"JAX_COMPILATION_CACHE_{name}", value)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
