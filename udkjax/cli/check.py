"""`udkjax check`."""

import sys

from udkjax.cli.common import BAD_RUN, Json, Scene, load, show


def check(scene: Scene, /, json: Json = False) -> None:
    """Summarize a scene, name its redundant constraints, and close its loops; exit with 1 if they cannot be closed.

    Args:
        scene: the mechanism.
    """
    mech, _ = load(scene)
    from udkjax.positions.assembly import check as checked
    from udkjax.show.summary import check_summary

    found = checked(mech)
    results = {
        **found._asdict(),
        "redundant": [{"constraint": name, "row": row} for name, row in found.redundant],
    }
    show(results, check_summary(mech, found), json)
    if not found.closed:
        sys.exit(BAD_RUN)
