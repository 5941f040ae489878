"""The public quantities of a state, with arguments: tests include each of them, so that a new one needs no list."""

import inspect
from collections.abc import Callable
from typing import Any

from udkjax.equations.states import evaluate

QUANTITIES: dict[str, Callable[..., Any]] = {
    name: function
    for name, function in vars(evaluate).items()
    if hasattr(function, "__wrapped__") and function.__module__.startswith("udkjax.equations.terms.") and not name.startswith("_")
}


def arguments(function: Callable[..., Any], t: Any, q: Any, v: Any) -> list[Any]:
    """Return the arguments of a quantity after the mechanism: those of time, positions and velocities that it takes."""
    given = {"t": t, "q": q, "v": v}
    return [given[name] for name in inspect.signature(function).parameters if name in given]
