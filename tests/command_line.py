"""The command line, run in the process of a test."""

from udkjax.cli import main


def udkjax(*arguments) -> int:
    """Run the command line here, and return its exit code."""
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    return 0
