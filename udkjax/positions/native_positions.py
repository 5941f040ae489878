"""Position programs of batches and their machine code (native/closing/positions.py), with errors that name the scene."""

from typing import Any

from udkjax.equations.position_programs import PositionPrograms, TracedModel
from udkjax.native.base.program import UnsupportedError
from udkjax.native.closing.positions import PositionCode
from udkjax.scene.checks import SceneError
from udkjax.scene.mechanism import Mechanism


def compile_programs(
    mechanism: Mechanism, model: TracedModel, parameters: int, coordinates: int, **choices: Any
) -> PositionPrograms:
    """Return the programs of a model; raise `SceneError` if positions do not follow from the driver."""
    try:
        return PositionPrograms(model, parameters, coordinates, **choices)
    except ValueError as problem:
        raise SceneError([f"positions do not follow from the driver: {problem}"], mechanism.name) from None


def position_code(mechanism: Mechanism, programs: PositionPrograms) -> PositionCode:
    """Return the machine code of programs; raise `SceneError` if an operation has no instruction."""
    try:
        return PositionCode(programs)
    except UnsupportedError as problem:
        raise SceneError([f"machine code has no instruction for {problem}"], mechanism.name) from None
