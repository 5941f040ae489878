"""Exit codes of commands, and messages on stderr."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from udkjax.extras import MissingExtraError

BAD_RUN = 1  # the command ran, and failed
BAD_INPUT = 2  # the command did not run: wrong options, an unreadable file, a missing package; tyro uses the same code
NO_FIT = 3  # a design was found, but its motion is far from the goal
INTERRUPTED = 130  # Ctrl-C, as in a shell


def say(text: str) -> None:
    """Write a message to stderr; only results are written to stdout."""
    print(f"udkjax: {text}", file=sys.stderr)


def refuse(problem: object) -> NoReturn:
    """Print the mistake in the input, and exit with the code `BAD_INPUT`."""
    say(str(problem))
    sys.exit(BAD_INPUT)


def fail(problem: object, code: int = BAD_RUN) -> NoReturn:
    """Print the cause of a failed run, and exit with a code."""
    say(str(problem))
    sys.exit(code)


def _show_warning(message: Warning | str, category: type[Warning], *place: object) -> None:
    """Print a warning, preceded by its category if it is not from udkjax, without the line of code that issued it."""
    say(f"{message}" if category.__module__.startswith("udkjax.") else f"{category.__name__}: {message}")


@contextmanager
def exit_codes() -> Iterator[None]:
    """Return a context in which an exception of a command becomes a message on stderr and an exit code, and a warning a message.

    Defects of the package keep their traceback.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            yield
    except MissingExtraError as error:
        refuse(error)
    except KeyboardInterrupt:
        print(file=sys.stderr)  # after the ^C that the terminal prints
        say("stopped")
        sys.exit(INTERRUPTED)
    except BrokenPipeError:  # the program that reads the output, such as `head`, has closed the pipe
        sys.stderr.close()
        sys.exit(BAD_RUN)
    except OSError as error:  # no such folder, no permission, no space
        fail(error)
    except MemoryError:
        fail("not enough memory")
    except (ValueError, RuntimeError) as error:
        if not type(error).__module__.startswith("udkjax."):
            raise
        if isinstance(error, ValueError):  # an invalid scene, grid or parameter
            refuse(error)
        fail(error)
