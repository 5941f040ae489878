"""Mechanisms made from drawings: a four-bar, a slider-crank, a scissor lift. SI units, radians."""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from jaxtyping import ArrayLike

from udkjax.annotations import NumberLike
from udkjax.argument_types import COUNT, POSITIVE, several
from udkjax.arrays import array_namespace
from udkjax.requirements import ArgumentError
from udkjax.scene.drawing.drawing import Drawing
from udkjax.scene.drawing.drawn_forces import Motor
from udkjax.scene.drawing.drawn_joints import PinInSlot, Slide
from udkjax.scene.drawing.link import Link
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.forces import Spring
from udkjax.scene.library.posed_bodies import (
    ORIGINS,
    apex,
    as_array,
    gravity_vector,
    unit_vector,
    value_and_rate,
    with_concrete_numbers,
)
from udkjax.scene.mechanism import Mechanism


@with_concrete_numbers
def four_bar(
    angle: NumberLike = np.pi / 3,
    angular_velocity: NumberLike = 0.0,
    lengths: Annotated[Sequence[NumberLike], several(3, "positive")] = (1.0, 2.5, 2.0),
    ground: Annotated[NumberLike, POSITIVE] = 2.5,
    density: Annotated[NumberLike, POSITIVE] = 1.0,
    gravity: NumberLike = 9.81,
) -> Mechanism:
    """Return a four-bar, by default a crank-rocker: crank, coupler and rocker of `lengths`, uniform, `density` in kg/m.

    The crank, at `angle`, turns about the origin, and the rocker about D = (`ground`, 0). The pin of coupler and rocker is to the
    left of the line from the pin of the crank to D.
    """
    a, b, c = lengths

    def places(s):
        start, end = a * unit_vector(s), ground * np.array([1.0, 0.0])
        return {"A": np.zeros(2), "B": start, "C": apex(start, end, b, c), "D": end}

    through = {"crank": ("AB", a), "coupler": ("BC", b), "rocker": ("DC", c)}
    links = {name: Link(list(pins), mass=density * length) for name, (pins, length) in through.items()}
    return draw_on_pose(places, angle, angular_velocity, links, ["A", "D"], gravity, "four-bar")


@with_concrete_numbers
def slider_crank(
    angle: NumberLike = 0.0,
    angular_velocity: NumberLike = 4.0,
    driven: bool = True,
    crank: Annotated[NumberLike, POSITIVE] = 0.5,
    rod: Annotated[NumberLike, POSITIVE] = 1.5,
    masses: Annotated[Sequence[NumberLike], several(3, "positive")] = (1.0, 1.5, 2.0),
    slider_inertia: Annotated[NumberLike, POSITIVE] = 0.1,
    gravity: NumberLike = 9.81,
    spring: Annotated[Sequence[NumberLike] | None, several(3)] = None,
) -> Mechanism:
    """Return a slider-crank on the x axis: crank of length `crank` about the origin, connecting rod, slider in a guide.

    `driven`: a motor turns the crank at constant `angular_velocity` from `angle`; otherwise these are its initial state.
    `masses` are those of crank, rod (both uniform) and slider. `spring`: stiffness (N/m), length (m) and damping (N s/m) of a
    spring between slider and origin, whose distance is between rod - crank and rod + crank.
    """

    def places(s):
        xp = array_namespace(s, crank, rod)
        if xp is np and abs(np.sin(s.real) * crank) > rod:
            raise ArgumentError(f"a rod of {rod:g} m does not reach from a crank of {crank:g} m to the guide in this position")
        tilt = -xp.arcsin(crank * xp.sin(s) / rod)
        pin = crank * unit_vector(s)
        return {"O": np.zeros(2), "P": pin, "B": pin + rod * unit_vector(tilt)}

    links = {"crank": Link(["O", "P"], mass=masses[0]), "rod": Link(["P", "B"], mass=masses[1])}
    return draw_on_pose(
        places,
        angle,
        angular_velocity,
        links | {"slider": Link(["B"], mass=masses[2], inertia=slider_inertia)},
        ["O"],
        gravity,
        "slider-crank",
        slides={"guide": Slide("slider", direction=0.0)},
        motors={"motor": Motor("O", speed=angular_velocity)} if driven else {},
        forces={} if spring is None else {"spring": Spring((GROUND, "slider"), ORIGINS, *spring)},
    )


@with_concrete_numbers
def scissor_lift(
    stages: Annotated[int, COUNT] = 2,
    angle: NumberLike = np.pi / 6,
    angular_velocity: NumberLike = 0.0,
    length: Annotated[NumberLike, POSITIVE] = 1.0,
    mass: Annotated[NumberLike, POSITIVE] = 1.0,
    platform_mass: Annotated[NumberLike, POSITIVE] = 5.0,
    gravity: NumberLike = 9.81,
) -> Mechanism:
    """Return a scissor lift: `stages` pairs of crossed bars and a platform, whose guide makes 2 rows redundant.

    The bars rising0, falling0, ... are pinned where they cross, at their middles, at `angle` to the horizontal; their left ends
    stay on the y axis.
    """
    left = ["foot", *(f"left{i}" for i in range(stages - 1)), "head"]  # pins, from the bottom up
    right = ["sliding foot", *(f"right{i}" for i in range(stages))]

    def places(s):
        x, y = length * unit_vector(s)
        positions = {f"middle{i}": (0.5 * x, (i + 0.5) * y) for i in range(stages)}
        positions |= {pin: (x * k, i * y) for k, side in enumerate((left, right)) for i, pin in enumerate(side)}
        positions["end"] = (0.0 * x + length, stages * y)
        return {name: as_array(position) for name, position in positions.items()}

    links = {}
    for i in range(stages):
        links[f"rising{i}"] = Link([left[i], f"middle{i}", right[i + 1]], mass=mass, width=0.0)
        links[f"falling{i}"] = Link([left[i + 1], f"middle{i}", right[i]], mass=mass, width=0.0)
    slots = {
        "sliding foot": PinInSlot("sliding foot", direction=0.0),
        "sliding head": PinInSlot(right[-1], along=("head", "end"), on="platform"),
    }
    return draw_on_pose(
        places,
        angle,
        angular_velocity,
        links | {"platform": Link(["head", "end"], mass=platform_mass)},
        ["foot"],
        gravity,
        "scissor lift",
        slides={"guide": Slide("platform", direction=np.pi / 2)},
        slots=slots,
    )


def draw_on_pose(
    places: Callable,
    s: ArrayLike,
    rate: ArrayLike,
    links: Mapping[str, Link],
    ground: Sequence[str],
    gravity: ArrayLike,
    name: str,
    **more: Any,
) -> Mechanism:
    """Return the mechanism of a drawing of links through pins at places(s), {name: position}.

    Velocities of the pins follow from the rate of s; `more` are further arguments of `Drawing`.
    """
    pins, velocities = value_and_rate(places, as_array(s), rate)
    drawing = Drawing(pins, links, ground, velocities=velocities, gravity=gravity_vector(gravity), name=name, **more)
    return drawing.mechanism()
