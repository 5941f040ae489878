"""Old public names, which work for one more version with a warning that says the new one."""

import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def deprecated_getattr(module: str, renamed: Mapping[str, str], stacklevel: int = 2) -> Callable[[str], Any]:
    """Return a module's `__getattr__` under which old names still work.

    `__getattr__ = deprecated_getattr(__name__, {"March": "IntegratorState", "Trial": "udkjax.integrate.steps.StepResult"})`

    Args:
        module: the module's own name.
        renamed: the new name of each old one: in the same module, or in another one with that module before it.
        stacklevel: which of the callers the warning is about; 2: who asks for the attribute.
    """

    def get(name: str) -> Any:
        if name not in renamed:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        home, _, new = renamed[name].rpartition(".")
        warnings.warn(f"{module}.{name} is now {home or module}.{new}", DeprecationWarning, stacklevel=stacklevel)
        return getattr(import_module(home or module), new)

    return get
