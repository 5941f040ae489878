"""Laws with inequalities: contacts that press and do not pull, joints that stick or slip."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
