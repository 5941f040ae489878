"""Scenes: mechanisms of bodies, joints, drivers and force elements, and their files. The equations are in `udkjax.equations`."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
