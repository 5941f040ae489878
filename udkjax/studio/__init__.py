"""The studio: a page, served to this machine alone, in which mechanisms are drawn, moved and diagnosed."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
