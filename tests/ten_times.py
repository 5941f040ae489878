"""Constants of the package ten times as large or as small, for tests that results do not depend on them."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import jax
import pytest

# What serves machine code of any constants.
MACHINE = tuple(f"udkjax.native.{folder}" for folder in ("language", "code", "module", "host"))


def _multiplied(value: Any, factor: float) -> Any:
    """Return a number, or numbers, times a factor; counts stay whole, and at least one."""
    if isinstance(value, tuple):
        return tuple(_multiplied(x, factor) for x in value)
    return max(round(value * factor), 1) if isinstance(value, int) else value * factor


def _forget_programs() -> None:
    """Drop what was traced or compiled with other constants; results by identity belong to mechanisms, which tests build anew."""
    for name, module in list(sys.modules.items()):
        if name.startswith("udkjax.") and not name.startswith(MACHINE):
            for value in list(vars(module).values()):
                if callable(clear := getattr(value, "cache_clear", None)) and not isinstance(value, type):
                    clear()
    jax.clear_caches()


@contextmanager
def multiplied(factor: float, *constants: str) -> Iterator[None]:
    """Multiply constants by a factor within the block, wherever they are imported.

    Args:
        factor: The factor.
        constants: Their names, such as `integrate.drift.DEPENDENT_DISTANCE`; of a class,
            `equations.run_programs.RunPrograms.STAGES`.
    """
    with pytest.MonkeyPatch.context() as patch:
        for path in constants:
            home, _, name = path.rpartition(".")
            if home.rpartition(".")[2][0].isupper():
                module, _, owner = home.rpartition(".")
                kind = getattr(import_module(f"udkjax.{module}"), owner)
                patch.setattr(kind, name, _multiplied(getattr(kind, name), factor))
                continue
            value = getattr(import_module(f"udkjax.{home}"), name)
            for module in [m for key, m in list(sys.modules.items()) if key.startswith("udkjax.")]:
                if vars(module).get(name) is value:
                    patch.setattr(module, name, _multiplied(value, factor))
        _forget_programs()
        yield
    _forget_programs()
