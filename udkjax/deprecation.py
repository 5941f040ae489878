"""Old public names, which work for one more version with a warning that says the new one."""

import warnings
from collections.abc import Callable, Mapping
from functools import wraps
from importlib import import_module
from typing import Any, TypeVar, cast

Decorated = TypeVar("Decorated", bound=Callable[..., Any])


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


def renamed_arguments(**renamed: str) -> Callable[[Decorated], Decorated]:
    """Return a decorator under which old keyword arguments of a function, or of the constructor of a class, still work.

    `@renamed_arguments(start="initial_state")`
    """

    def decorate(decorated: Decorated) -> Decorated:
        function: Any = decorated.__init__ if isinstance(decorated, type) else decorated

        @wraps(function)
        def with_new_names(*args: Any, **kwargs: Any) -> Any:
            for old in [name for name in kwargs if name in renamed]:
                new, place = renamed[old], decorated.__qualname__.removesuffix(".__init__")
                if new in kwargs:
                    raise TypeError(f"{place}: {old} is now {new}; give only that")
                warnings.warn(f"{place}: {old} is now {new}", DeprecationWarning, stacklevel=2)
                kwargs[new] = kwargs.pop(old)
            return function(*args, **kwargs)

        if not isinstance(decorated, type):
            return cast(Decorated, with_new_names)
        decorated.__init__ = with_new_names
        return cast(Decorated, decorated)

    return decorate


def renamed_attributes(owner: str, **renamed: str) -> Callable[[Any, str], Any]:
    """Return a class's `__getattr__` under which old attributes of its instances still work.

    `__getattr__ = renamed_attributes("Estimate", knowledge="uncertainty")`
    """

    def get(self: Any, name: str) -> Any:
        if name not in renamed:
            raise AttributeError(f"{owner!r} object has no attribute {name!r}")
        warnings.warn(f"{owner}.{name} is now {owner}.{renamed[name]}", DeprecationWarning, stacklevel=2)
        return getattr(self, renamed[name])

    return get


def renamed_methods(**renamed: str) -> Any:
    """Return a class's `__init_subclass__` under which subclasses may still define a method or property by its old name.

    `__init_subclass__ = renamed_methods(resolved="complete")`
    """

    def init_subclass(cls: type) -> None:
        for old, new in renamed.items():
            if old in vars(cls) and new not in vars(cls):
                warnings.warn(f"{cls.__name__}.{old} is now {cls.__name__}.{new}", DeprecationWarning, stacklevel=5)
                setattr(cls, new, vars(cls)[old])

    return classmethod(init_subclass)
