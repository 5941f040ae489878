"""The studio: a page in which mechanisms are drawn, moved and diagnosed, served to this machine only."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
