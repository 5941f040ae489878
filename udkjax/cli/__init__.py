"""The command line: `udkjax report | simulate | sweep | identify | check | doctor`.

Only the standard library and tyro are imported before a command is known, so that help comes at once.
"""

import atexit
import gc

import tyro

from udkjax.cli.check import check
from udkjax.cli.doctor import doctor
from udkjax.cli.identify import identify
from udkjax.cli.report import report
from udkjax.cli.simulate import simulate
from udkjax.cli.sweep import sweep


def main(arguments: list[str] | None = None) -> None:
    """Run one command; exit with 1 after a run that failed, with 2 after wrong input."""
    # At its end Python would look for garbage among all that JAX has made, for a third of a second.
    atexit.register(gc.freeze)
    commands = {
        "report": report,
        "simulate": simulate,
        "sweep": sweep,
        "identify": identify,
        "check": check,
        "doctor": doctor,
    }
    tyro.extras.subcommand_cli_from_dict(
        commands, prog="udkjax", args=arguments, description="Planar mechanisms, however redundantly constrained."
    )
