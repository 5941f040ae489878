"""Planar mechanisms with any redundancy of constraints: simulated, batched and differentiated in JAX.

Nothing is imported before it is used, so that the command line answers at once: the public names stand in `__init__.pyi`.
Importing this package turns float64 on in JAX, unless the environment says `JAX_ENABLE_X64=0`, and does nothing else.
"""

import os
import pkgutil
import re
import sys
from importlib import import_module

_STUB = (pkgutil.get_data(__name__, "__init__.pyi") or b"").decode()
_HOME: dict[str, str] = {name: module for module, name in re.findall(r"^from (\S+) import (\w+) as", _STUB, re.MULTILINE)}

__version__ = "0.1.0"
__all__ = [*_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = _HOME[name]
    value = import_module(f"{home}.{name}") if home == __name__ else getattr(import_module(home), name)
    globals()[name] = value
    return value


def __dir__():
    return sorted([*__all__, "__version__"])


os.environ["JAX_ENABLE_X64"] = os.environ.get("JAX_ENABLE_X64") or "1"
if "jax" in sys.modules:
    if os.environ["JAX_ENABLE_X64"].lower() not in ("0", "n", "no", "f", "false", "off"):
        sys.modules["jax"].config.update("jax_enable_x64", True)  # it has read its environment already
    # Equinox imports this, which adds to what JAX knows its traces by: a function that is traced when a name of this package is
    # first asked for would be traced and compiled again on its second call.
    import_module("jax.extend")
