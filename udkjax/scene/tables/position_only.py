"""The refusal of mechanisms with joints that restrict velocities alone, by functions of positions."""

from typing import Any

from udkjax.scene.elements.rolling import rolling_joints
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import join_names, quote


def refuse_rolling(mechanism: Any, what: str) -> None:
    """Raise a `SceneError` that names the rolling joints of a mechanism, if it has any.

    `what` begins the message: it states the need for positions, as in "modes need positions that the constraints determine".
    """
    if names := rolling_joints(mechanism):
        cure = "positions depend on the path there; simulate it, or leave these joints out"
        raise SceneError([f"{what}: {join_names(list(map(quote, names)))} restrict velocities alone: {cure}"], mechanism.name)
