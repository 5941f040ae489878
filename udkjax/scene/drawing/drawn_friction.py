"""Friction of a drawing, in its pins, slides and slots."""

from typing import Any, Literal

import equinox as eqx
from jaxtyping import Array, Float

from udkjax.scene.drawing.placement import DrawnElement, Parts, PinLayout, pair_mistakes
from udkjax.scene.elements.fields import LINK, NOT_NEGATIVE, PIN, POSITIVE, SLIDE, SLOT, given_names, given_or_none
from udkjax.scene.elements.friction import SLIDING_SPEED, Friction
from udkjax.scene.elements.joints import Prismatic, Revolute, Slot
from udkjax.scene.tables.schema import table_of
from udkjax.wording import quote


class PinFriction(DrawnElement):
    """Friction at a `pin`, in a `slide` or in a `slot`, by a `coefficient` or, at a pin, a constant `torque`.

    A pin needs its `radius` for a coefficient; a slide may have the `length` of its guide.
    """

    pin: str | None = eqx.field(static=True, default=None, metadata=PIN)
    slide: str | None = eqx.field(static=True, default=None, metadata=SLIDE)
    slot: str | None = eqx.field(static=True, default=None, metadata=SLOT)
    of: tuple[str, ...] = eqx.field(
        static=True, converter=given_names, default=(), metadata=LINK
    )  # the two links, if more than two meet
    torque: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)  # N m
    velocity: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # rad/s
    coefficient: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)
    radius: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # m
    static_coefficient: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)
    speed: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # m/s
    viscous: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)  # s/m
    length: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # m
    law: Literal["smooth", "set-valued"] = eqx.field(static=True, default="smooth")

    def __post_init__(self):
        if self.speed is None and self.law == "smooth":
            self.speed = given_or_none(SLIDING_SPEED)

    @property
    def measured_as(self):
        return "Friction"

    def mistakes(self, layout):
        if (self.pin is not None) + (self.slide is not None) + (self.slot is not None) != 1:
            yield "pin: give one of a pin, a slide and a slot"
            return
        if self.pin is not None:
            wrong = list(pair_mistakes(layout, self.pin, self.of))
            yield from wrong
            if not wrong and self._joint(layout) is None:
                first = quote(layout.members(self.pin)[0])
                yield f"of: all links at pin {quote(self.pin)} turn on {first}, which must be one of the two"
        kind = Revolute if self.pin is not None else Prismatic if self.slide is not None else Slot
        yield from Friction.mistakes(table_of(self), kind)

    def parts(self, placement):
        joint = self._joint(placement)
        assert joint is not None  # a mistake
        numbers: dict[str, Any] = {k: x for k, x in table_of(self).items() if k not in ("pin", "slide", "slot", "of")}
        return Parts(force=Friction(joint, **numbers))

    def _joint(self, layout: PinLayout) -> str | None:
        """Return the name of the joint that has the friction: the slide, the slot, or the revolute of the two links at the pin.

        None if the two links have no revolute of their own, since both turn on a third link at the pin.
        """
        if self.pin is None:
            return self.slide or self.slot
        first, *others = layout.members(self.pin)
        pair = layout.pair(self.pin, self.of)
        k = next((k for k, other in enumerate(others) if {first, other} == set(pair)), None)
        return None if k is None else self.pin if k == 0 else f"{self.pin}-{k + 1}"
