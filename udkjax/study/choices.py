"""Methods, formulations, stabilizations and solvers by their names in files and on the command line."""

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeAlias

from udkjax.equations.laws.formulations import Augmented, Formulation, NullSpaceQR, NullSpaceSVD
from udkjax.equations.laws.partitioning import CoordinatePartitioning
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.integrate import Projection
from udkjax.integrate.solvers import Solver, StepController, solver_named
from udkjax.pinv import SVD, Auto, Elimination, GramSchmidt, Greville, Householder, Pseudoinverse, Varga
from udkjax.wording import abbreviate, quote, suggestion

Choice: TypeAlias = "Pseudoinverse | Formulation | Projection | Baumgarte | Solver | StepController | None"
Constructors = dict[str, Callable[..., Choice]]


def _none() -> None:
    return None


METHODS: Constructors = {
    "auto": Auto,
    "elimination": Elimination,
    "svd": SVD,
    "varga": Varga,
    "greville": Greville,
    "householder": Householder,
    "gram-schmidt": GramSchmidt,
}
FORMULATIONS: Constructors = {
    "udwadia-kalaba": _none,
    "augmented": Augmented,
    "null-space-qr": NullSpaceQR,
    "null-space-svd": NullSpaceSVD,
    "partitioning": CoordinatePartitioning,
}
STABILIZATIONS: Constructors = {"projection": Projection, "baumgarte": Baumgarte, "none": _none}
SOLVERS: Constructors = {
    name.lower(): partial(solver_named, name)
    for name in ("Dopri8", "Dopri5", "Tsit5", "Bosh3", "Heun", "Kvaerno5", "Verner65", "Adams", "BDF")
}
CHOICES = {"method": METHODS, "formulation": FORMULATIONS, "stabilization": STABILIZATIONS, "solver": SOLVERS}


def choice(setting: str, given: str | Mapping[str, str | float]) -> Choice:
    """Return the object for a setting ("method") from its name ("svd"), or from a table with its `type` and arguments.

    Raises:
        ValueError: the name or an argument is unknown; the message lists the valid ones.
    """
    options = CHOICES[setting]
    table = given if isinstance(given, Mapping) else {"type": given}
    name, numbers = table.get("type"), {key: value for key, value in table.items() if key != "type"}
    if not isinstance(name, str) or name not in options:
        raise ValueError(
            f"unknown {setting} {abbreviate(name)}{suggestion(name, options) or '; choose one of ' + ', '.join(options)}"
        )
    constructor = options[name]
    expected = [] if setting == "solver" else list(inspect.signature(constructor).parameters)
    for key in numbers:
        if key not in expected:
            raise ValueError(f"{quote(name)} has no {quote(key)}{suggestion(key, expected)}")
    return constructor(**numbers)
