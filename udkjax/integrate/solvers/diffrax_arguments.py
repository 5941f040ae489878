"""Requirements on the arguments of `simulate` that are objects of diffrax."""

import sys
from typing import Any

from udkjax.argument_types import ArgumentRequirement
from udkjax.requirements import ArgumentCheck, ArgumentError, ArgumentTypeError, GivenArguments, describe


def _of_diffrax(kind: str, example: str) -> ArgumentCheck:
    def check(name: str, value: Any, given: GivenArguments):
        diffrax = sys.modules.get("diffrax")  # no instance of its classes exists before it is imported
        if not (diffrax and isinstance(value, getattr(diffrax, kind))):
            expected = f"an instance of a diffrax class, such as {name}={example}, or None"
            raise ArgumentTypeError(f"{name} must be {expected}, {describe(value)}")

    return check


def _check_solver(name: str, value: Any, given: GivenArguments) -> None:
    """Require a solver that estimates its errors, since these decide the steps."""
    _of_diffrax("AbstractSolver", "diffrax.Tsit5()")(name, value, given)
    diffrax, controller = sys.modules["diffrax"], given.get("stepsize_controller")
    is_adaptive = controller is None or isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    if is_adaptive and not isinstance(value, diffrax.AbstractAdaptiveSolver):
        kind = type(value).__name__
        estimated = f"give a solver such as diffrax.Tsit5(), or diffrax.HalfSolver(diffrax.{kind}()), which estimates them"
        cure = f"{estimated}, or constant steps, stepsize_controller=diffrax.ConstantStepSize() with dt0"
        raise ArgumentError(
            f"{name}: steps follow from estimated errors, even with dt0, and {kind} does not estimate any; {cure}"
        )


def _check_controller(name: str, value: Any, given: GivenArguments) -> None:
    """Require a step size controller, and a first step for constant ones."""
    _of_diffrax("AbstractStepSizeController", "diffrax.ConstantStepSize()")(name, value, given)
    if isinstance(value, sys.modules["diffrax"].ConstantStepSize) and given.get("dt0") is None:
        raise ArgumentError(f"{name}: constant steps need their length: dt0=1e-3")


SOLVER = ArgumentRequirement("a solver that estimates its errors", _check_solver)
CONTROLLER = ArgumentRequirement("a step size controller of diffrax", _check_controller)
ADJOINT = ArgumentRequirement("an adjoint of diffrax", _of_diffrax("AbstractAdjoint", "diffrax.ForwardMode()"))
