"""`udkjax doctor`."""


def doctor() -> None:
    """Tell versions, devices and precision, ready to paste into a bug report."""
    from udkjax.show import doctor as show

    print(show.doctor())
