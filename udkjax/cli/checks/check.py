"""`udkjax check`."""

import sys

from udkjax.cli.common import BAD_RUN, Json, Scene, load, show


def check(scene: Scene, /, json: Json = False) -> None:
    """Summarize a scene, name its redundant constraints, and close its loops; exit with 1 if they cannot be closed.

    Args:
        scene: the mechanism.
    """
    mech, _ = load(scene)
    import udkjax as udk
    from udkjax.show.summary import check_summary

    report = udk.check(mech)
    results = {
        **report._asdict(),
        "redundant": [{"constraint": name, "row": row} for name, row in report.redundant],
    }
    show(results, check_summary(mech, report), json)
    if not report.closed:
        sys.exit(BAD_RUN)
