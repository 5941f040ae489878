"""The command line: `udkjax COMMAND`, each command a function in the module of the same name, in the folder of its subject.

Only the standard library and tyro are imported before a command runs, so that help is fast.
"""

import gc
import os
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version

from udkjax.cli.exits import exit_codes
from udkjax.extras import STUDIO_PACKAGES, require

COMMANDS = {  # in the order of the help, each with its folder
    "report": "studies",
    "simulate": "motion",
    "animate": "motion",
    "studio": "files",
    "sweep": "studies",
    "identify": "studies",
    "design": "studies",
    "kinematics": "motion",
    "gaps": "motion",
    "solve": "worked",
    "exercise": "worked",
    "inverse": "loads",
    "reactions": "loads",
    "tolerances": "studies",
    "statics": "loads",
    "modes": "loads",
    "export": "files",
    "check": "checks",
    "convert": "files",
    "diagnose": "checks",
    "explain": "worked",
    "doctor": "checks",
}

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
        require("tyro", *(STUDIO_PACKAGES if words[:1] == ["studio"] else ()))
        from udkjax.cli.common import parse_and_run

        parse_and_run({name: command(name) for name in COMMANDS}, arguments)


def command(name: str) -> Callable:
    """Return the function of the command with this name, and import its module."""
    return getattr(import_module(f"udkjax.cli.{COMMANDS[name]}.{name}"), name)


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
