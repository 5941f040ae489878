"""Planar mechanisms with any redundancy of constraints: simulated, batched and differentiated in JAX.

Nothing is imported before it is used, so that the command line answers at once: the public names stand in `__init__.pyi`.
Importing this package turns float64 on in JAX, unless the environment says `JAX_ENABLE_X64=0`, and lets Python end without
looking for garbage among what JAX has made, which would take a third of a second; it does nothing else.
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
        sys.modules["jax"].config.update("jax_enable_x64", True)  # it has read its environment already
    # Equinox imports this, which adds to what JAX knows its traces by: a function that is traced when a name of this package is
    # first asked for would be traced and compiled again on its second call.
    import_module("jax.extend")
