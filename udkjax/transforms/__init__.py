"""Linear maps, tangents and cotangents of trees of numbers, and repeated steps of Newton's method."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
