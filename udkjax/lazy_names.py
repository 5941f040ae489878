"""Lazy packages, whose names are imported at first use, as listed in the package's `__init__.pyi`."""

import pkgutil
import re
import sys
from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Any


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` for a package, with the names that its stub `__init__.pyi` imports.

    Editors read this stub, too. Its names take precedence over modules of the same name: `from udkjax.integrate import simulate`
    is the function, even if the module `udkjax.integrate.simulate` is already loaded.
    """
    stub = (pkgutil.get_data(package, "__init__.pyi") or b"").decode()
    homes = {name: module for module, name in re.findall(r"^from (\S+) import (\w+) as", stub, re.MULTILINE)}

    class Face(ModuleType):
        def __setattr__(self, name: str, value: Any) -> None:
            if not (isinstance(value, ModuleType) and value.__name__ == homes.get(name)):
                super().__setattr__(name, value)

        def __reduce__(self) -> tuple[Callable[[str], ModuleType], tuple[str]]:
            # Pickled by name: cloudpickle would store the module by its contents, as it does with any class but `ModuleType`.
            return import_module, (package,)

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home = homes[name]
        if home == package or not hasattr(holder := import_module(home), name):
            value = import_module(f"{home}.{name}")  # a module of this folder, or of one of its subfolders
        else:
            value = getattr(holder, name)
        setattr(sys.modules[package], name, value)
        return value

    def list_names() -> list[str]:
        return sorted([*homes, *({"__version__"} & vars(sys.modules[package]).keys())])

    sys.modules[package].__class__ = Face
    return find, list_names, [*homes]
