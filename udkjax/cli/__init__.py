"""The command line: `udkjax COMMAND`, each command a function in the module of the same name.

Only the standard library and tyro are imported before a command runs, so that help is fast.
"""

import gc
import os
import sys
from importlib import import_module
from importlib.metadata import version

from udkjax.cli.exits import exit_codes
from udkjax.extras import STUDIO, require

COMMANDS = (
    "report",
    "simulate",
    "animate",
    "studio",
    "sweep",
    "identify",
    "design",
    "kinematics",
    "gaps",
    "solve",
    "exercise",
    "inverse",
    "reactions",
    "tolerances",
    "statics",
    "modes",
    "export",
    "check",
    "convert",
    "diagnose",
    "explain",
    "doctor",
)

# New objects between garbage collections: most objects live to the end of a command, and scanning them takes 0.1 s.
GARBAGE_EVERY = 50_000
PROGRAM_CACHE_BYTES = 200_000_000  # limit of stored JAX programs; the least recently used are removed


def main(arguments: list[str] | None = None) -> None:
    """Run a command, and exit with a code of `udkjax.cli.exits`."""
    gc.set_threshold(GARBAGE_EVERY)
    words = sys.argv[1:] if arguments is None else arguments
    if words == ["--version"]:
        print(f"udkjax {version('udkjax')}")
        return
    store_compiled_programs()
    with exit_codes():
        require("tyro", *(STUDIO if words[:1] == ["studio"] else ()))
        from udkjax.cli.common import parse_and_run

        commands = {name: getattr(import_module(f"udkjax.cli.{name}"), name) for name in COMMANDS}
        parse_and_run(commands, arguments)


def store_compiled_programs() -> None:
    """Make JAX store its compiled programs in the cache of machine code, so that a repeated command compiles nothing.

    A folder named by the environment takes precedence. Nothing is changed if JAX is already imported, if the folder cannot be
    written, or if others may write it.
    """
    from udkjax.folders import is_writable, refusal
    from udkjax.native.code.code_cache import cache_folder

    folder = cache_folder()
    if folder is None or "jax" in sys.modules or not is_writable(folder) or refusal(folder):
        return
    for name, value in {"DIR": f"{folder / 'jax'}", "MAX_SIZE": f"{PROGRAM_CACHE_BYTES}"}.items():
        os.environ.setdefault(f"JAX_COMPILATION_CACHE_{name}", value)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
