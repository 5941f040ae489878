"""`udkjax doctor`."""

from udkjax.cli.common import Json, show


def doctor(json: Json = False) -> None:
    """Tell versions, devices, precision and which engine is used and why, ready to paste into a bug report."""
    from udkjax.show.doctor import facts, summary

    found = facts()
    show(found, summary(found), json)
