"""Positions of mechanisms: closed, followed along a drive, in batches, and where their branches meet. No dynamics."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
