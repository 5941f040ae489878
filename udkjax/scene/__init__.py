"""Scenes: bodies, joints, drivers, force elements, the mechanism of them all, and its files. No equations."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
