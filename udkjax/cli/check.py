"""`udkjax check`."""

import sys

from udkjax.cli.common import BAD_RUN, Scene, load


def check(scene: Scene, /) -> None:
    """Count what a scene is made of, name its redundant constraints, and try to close it; exit with 1 if it stays open.

    Args:
        scene: the mechanism.
    """
    mech, _ = load(scene)
    from udkjax.integrate.assembly import check as checked
    from udkjax.show.summary import check_summary

    found = checked(mech)
    print(check_summary(mech, found))
    if not found.closed:
        sys.exit(BAD_RUN)
