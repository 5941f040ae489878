"""Pseudoinverses that are differentiable at every constant rank: D^+ b, D^+ and the rank, by interchangeable methods."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
