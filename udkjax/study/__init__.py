"""Studies: accuracy, diagnosis, identification, sweeps and other analyses of mechanisms and their motions."""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
