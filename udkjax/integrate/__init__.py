"""Time integration: from a mechanism to its motion. Only this folder imports diffrax, and only when a run needs it."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
