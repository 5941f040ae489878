"""Graphs of scalar expressions: structural zeros vanish, and equal expressions are computed once."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
