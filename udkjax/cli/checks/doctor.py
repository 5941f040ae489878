"""`udkjax doctor`."""

from udkjax.cli.common import Json, show


def doctor(json: Json = False) -> None:
    """Print versions, devices, precision, and the engine in use with the reason, to paste into a bug report."""
    from udkjax.show.doctor import facts, summary

    report = facts()
    show(report, summary(report), json)
