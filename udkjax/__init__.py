"""Planar mechanisms with any redundancy of constraints: simulated, batched and differentiated in JAX.

Names are imported at first use, so that the command line starts quickly; `__init__.pyi` lists them. Importing this package
enables float64 in JAX, unless the environment sets `JAX_ENABLE_X64=0`, and skips garbage collection when Python exits, which
takes a third of a second with JAX. It has no other effects.
"""

import atexit
import gc
import os
import sys
from importlib import import_module

from udkjax.lazy_names import lazy_names

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]

atexit.register(gc.freeze)
os.environ["JAX_ENABLE_X64"] = os.environ.get("JAX_ENABLE_X64") or "1"
if "jax" in sys.modules:
    if os.environ["JAX_ENABLE_X64"].lower() not in ("0", "n", "no", "f", "false", "off"):
        sys.modules["jax"].config.update("jax_enable_x64", True)  # JAX has already read its environment
    # Equinox imports this module, which changes the key of JAX's cache of traces. If it were imported later, at the first use of
    # a name, a function traced before would be traced and compiled again on its second call.
    import_module("jax.extend")
