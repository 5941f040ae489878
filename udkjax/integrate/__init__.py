"""Trajectories: the only floor that knows diffrax, which it imports where a run asks for it."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
