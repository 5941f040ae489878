"""Ends of commands: the exit codes, and what is said on stderr."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from udkjax.extras import MissingExtraError

BAD_RUN = 1  # it ran, and failed
BAD_INPUT = 2  # it did not run: wrong options, an unreadable file, a missing package; tyro exits with it, too
INTERRUPTED = 130  # Ctrl-C, as of a shell


def say(text: str) -> None:
    """Write a line to stderr, where all words go that are not a result."""
    print(f"udkjax: {text}", file=sys.stderr)


def refuse(problem: object) -> NoReturn:
    """Name the mistake in the input, and exit."""
    say(str(problem))
    sys.exit(BAD_INPUT)


def fail(problem: object) -> NoReturn:
    """Name the cause of a failed run, and exit."""
    say(str(problem))
    sys.exit(BAD_RUN)


def _show_warning(message: Warning | str, category: type[Warning], *place: object) -> None:
    """Say a warning of ours without the place in our code; a warning of others has its kind."""
    say(f"{message}" if category.__module__.startswith("udkjax.") else f"{category.__name__}: {message}")


@contextmanager
def exit_codes() -> Iterator[None]:
    """Turn what a command may raise, or warn of, into a line on stderr and an exit code; a defect of ours keeps its traceback."""
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            yield
    except MissingExtraError as error:
        refuse(error)
    except KeyboardInterrupt:
        print(file=sys.stderr)  # the terminal's ^C stands on this line
        say("stopped")
        sys.exit(INTERRUPTED)
    except BrokenPipeError:  # whoever read our output, such as `head`, has had enough
        sys.stderr.close()
        sys.exit(BAD_RUN)
    except OSError as error:  # no such folder, no permission, no space
        fail(error)
    except MemoryError:
        fail("there is not enough memory for what was asked")
    except (ValueError, RuntimeError) as error:
        if not type(error).__module__.startswith("udkjax."):
            raise
        if isinstance(error, ValueError):  # of a scene, a grid, a parameter: what was given cannot be
            refuse(error)
        fail(error)
