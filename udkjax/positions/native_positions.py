"""Machine code of positions of batches (native/closing/positions.py) for models of mechanisms; errors name the scene."""

from typing import Any

from udkjax.equations.position_programs import PositionPrograms, TracedModel
from udkjax.native.base.program import UnsupportedError
from udkjax.native.closing.positions import PositionCode
from udkjax.scene.checks import SceneError
from udkjax.scene.mechanism import Mechanism


def compile_programs(
    mechanism: Mechanism, model: TracedModel, parameters: int, coordinates: int, **choices: Any
) -> PositionPrograms:
    """Return the programs of a model; raise `SceneError` where positions do not follow."""
    try:
        return PositionPrograms(model, parameters, coordinates, **choices)
    except ValueError as problem:
        raise SceneError([f"positions do not follow from the driver: {problem}"], mechanism.name) from None


def position_code(mechanism: Mechanism, programs: PositionPrograms) -> PositionCode:
    """Return the machine code of programs; raise `SceneError` where there is no instruction for something."""
    try:
        return PositionCode(programs)
    except UnsupportedError as problem:
        raise SceneError([f"machine code has no instruction for {problem}"], mechanism.name) from None
