"""Mechanisms found by design: the common base of the results of a search and of a complete design."""

from abc import abstractmethod

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from udkjax.arrays import FULL_TURN
from udkjax.positions.following.drive import Drive
from udkjax.positions.following.kinematics import Kinematics, kinematics
from udkjax.printing import PrintsTable, format_numbers
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.sources import AbstractDrawing


class FoundMechanism(PrintsTable):
    """A mechanism, with the values of its driver in the positions of the goal."""

    mechanism: eqx.AbstractVar[Mechanism]
    values: eqx.AbstractVar[Float[np.ndarray, "J"]]
    turns: eqx.AbstractVar[bool]
    driver: eqx.AbstractVar[Drive]

    @property
    @abstractmethod
    def last_value(self) -> float:
        """The value of the driver at the end of the motion if it does not make a whole turn."""

    def motion(self, count: int = 361) -> Kinematics:
        """Return the motion from the first position, found by `kinematics`: a whole turn, or up to `last_value`.

        Args:
            count: number of values.

        Returns:
            The `Kinematics`.
        """
        last = self.values[0] + FULL_TURN if self.turns else self.last_value
        return kinematics(self.mechanism, self.driver, np.linspace(self.values[0], last, count))

    @property
    def pins(self) -> dict[str, Float[Array, "2"]]:
        """The places of the drawing's pins by name (m), in the first position; empty without a drawing."""
        return {} if self.drawing is None else dict(self.drawing.pins)

    @property
    def drawing(self) -> AbstractDrawing | None:
        """The drawing, if the mechanism has one."""
        return self.mechanism.drawing

    def _pin_rows(self) -> list[tuple[str, str]]:
        return [(f"pin.{name}", format_numbers(place, "m")) for name, place in self.pins.items()]
