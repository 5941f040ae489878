"""Equations of motion: pure functions of a mechanism's numbers, time, coordinates and velocities."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
