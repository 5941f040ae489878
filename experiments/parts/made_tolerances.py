"""Tolerances of linkages whose positions have closed forms, and mechanisms on which second-order terms are tried."""

from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import udkjax as udk
from udkjax.scene import length_of

DRAWINGS = Path(udk.__file__).parent / "studio" / "drawings"
TURN = 0.7  # rad by which the crank has turned from the drawn position where positions are compared


class ClosedForm(NamedTuple):
    """A linkage, the standard deviations of its numbers, and its measure as a function of them, with the crank's angle."""

    mechanism: udk.Mechanism
    drive: str
    sizes: Mapping[str, Any]
    measure: str
    function: Callable[..., Any]  # of the numbers in the order of `sizes`, entry by entry, and the turn from the drawn position
    clearance: float = 0.0

    def tolerances(self) -> dict[str, Any]:
        """Return the tolerances: three standard deviations."""
        if self.clearance:
            return {next(iter(self.sizes)): udk.PinClearance(self.clearance)}
        return {name: udk.Tolerance(3.0 * size) for name, size in self.sizes.items()}

    def moments(self) -> tuple[float, float]:
        """Return mean and standard deviation of the closed form, by Gauss's rule with three nodes for each number."""
        if self.clearance:
            at = 2 * np.pi * (np.arange(360) + 0.5) / 360
            values, weights = self.function(self.clearance * np.cos(at), self.clearance * np.sin(at), TURN), np.full(360, 1 / 360)
        else:
            known, rows = self.mechanism.parameters(), []
            for name, size in self.sizes.items():
                nominal = known[name] if name in known else length_of(self.mechanism, name[7:-1])
                rows += [(float(x), size) for x in np.ravel(np.asarray(nominal))]
            nominal, sizes = np.array(rows).T
            nodes = np.array(list(product((-1, 0, 1), repeat=len(rows))))
            weights = np.prod(np.where(nodes == 0, 2 / 3, 1 / 6), axis=1)
            values = self.function(*(nominal + sizes * 3**0.5 * nodes).T, TURN)
        mean = float(weights @ values)
        return mean, float(np.sqrt(weights @ (values - mean) ** 2))


def meet(A: Any, B: Any, lengths: Any, side: str) -> Any:
    """Return the point, as a complex number, at two distances from A and from B, to one side of the way from A to B."""
    (a, b), way = lengths, B - A
    d = np.abs(way)
    along = (a**2 - b**2 + d**2) / (2 * d)
    return A + way / d * (along + (1j if side == "left" else -1j) * np.sqrt(a**2 - along**2))


def drawing(name: str) -> udk.Mechanism:
    """Return a drawing of the studio."""
    return udk.load(DRAWINGS / f"{name}.toml")


def closed_forms() -> dict[str, ClosedForm]:
    """Return ten linkages with closed forms."""

    def jansen(a, b, c, d, e, f, turn):
        P, A = -0.38 - 0.078j, a * np.exp(1j * turn)
        B, C = meet(A, P, b, "right"), meet(A, P, c, "left")
        D = meet(P, B, d, "left")
        E = meet(D, C, e, "right")
        return meet(E, C, f, "right").real

    def klann(a, h, f, e, g, turn):
        B, D, C = -0.0388 - 0.0125j, -0.0146 + 0.0419j, a * np.exp(1j * turn)
        F = meet(C, meet(C, B, h, "right"), f, "right")
        return meet(meet(D, F, e, "right"), F, g, "left").real

    def four_bar(side, point):
        def function(a, b, c, p, turn):
            A = a * np.exp(1j * (np.pi / 3 + turn))
            B = meet(A, 0.1, (b, c), side)
            return B.real if point == "B" else (A + p * np.exp(1j * np.deg2rad(40)) * (B - A) / np.abs(B - A)).real

        return function

    def slider(offset):
        def function(a, b, turn):
            A = a * np.exp(1j * (1.0 + turn))
            return A.real + np.sqrt(b**2 - (A.imag - offset) ** 2)

        return function

    def offset_slider(offset):
        A = 0.5 * np.exp(1j)
        pins = {"O": [0, 0], "P": [A.real, A.imag], "B": [A.real + np.sqrt(1.5**2 - (A.imag - offset) ** 2), offset]}
        links = {
            "crank": udk.Link(["O", "P"], mass=1),
            "rod": udk.Link(["P", "B"], mass=1),
            "slider": udk.Link(["B"], mass=1, inertia=1),
        }
        return udk.Drawing(
            pins=pins, links=links, ground=["O"], slides={"guide": {"link": "slider", "direction": [1, 0]}},
            motors={"motor": {"pin": "O", "speed": 1.0}},
        ).mechanism()  # fmt: skip

    def with_play(x, y, turn):
        A = 0.5 * np.exp(1j * (1.0 + turn))
        return A.real + np.sqrt(1.5**2 - (A.imag - y) ** 2) - x

    def quick_return(a, lever, rod, turn):
        A = 0.2j + a * np.exp(1j * (np.arctan2(0.04, 0.06) + turn))
        P = lever * A / np.abs(A)
        return P.real + np.sqrt(rod**2 - (P.imag - 0.52) ** 2)

    def parallel(function, *counts):
        """Return a function of single numbers from one that takes pairs."""

        def flat(*x):
            ends = np.cumsum(counts)
            return function(*(x[e - n] if n == 1 else x[e - n : e] for n, e in zip(counts, ends, strict=True)), x[-1])

        return flat

    crossed = udk.load(DRAWINGS / "crank_rocker.toml")
    text = udk.dumps(crossed).replace('side = "left"', 'side = "right"')
    sizes = {"pin.A.length": 1e-4, "pin.B.length": 1e-4, "pin.P.length": 1e-4}
    bars = {"length(crank)": 1e-3, "length(rod)": 2e-3}
    legs = {f"pin.{x}.length": 3e-4 for x in "ABCDEF"}
    short = {f"pin.{x}.length": 5e-5 for x in "CHFEG"}
    lengths = {"length(crank)": 1e-4, "length(lever)": 2e-4, "length(rod)": 2e-4}
    in_line = udk.library.slider_crank(angle=1.0)
    motor = "motor1"
    return {
        "slider-crank": ClosedForm(in_line, "motor", bars, "last(pin.B.x)", slider(0.0)),
        "offset slider-crank": ClosedForm(offset_slider(0.3), "motor", bars, "last(pin.B.x)", slider(0.3)),
        "slider-crank with play": ClosedForm(in_line, "motor", {"B": 0.0}, "last(body.slider.x)", with_play, 2e-3),
        "four-bar, rocker": ClosedForm(crossed, motor, sizes, "last(pin.B.x)", four_bar("left", "B")),
        "four-bar, coupler": ClosedForm(crossed, motor, sizes, "last(pin.P.x)", four_bar("left", "P")),
        "crossed four-bar": ClosedForm(udk.loads(text), motor, sizes, "last(pin.B.x)", four_bar("right", "B")),
        "crossed coupler": ClosedForm(udk.loads(text), motor, sizes, "last(pin.P.x)", four_bar("right", "P")),
        "quick return": ClosedForm(drawing("quick_return"), motor, lengths, "last(pin.R.x)", quick_return),
        "Jansen's leg": ClosedForm(
            drawing("jansen_leg"), motor, legs, "last(pin.F.x)", parallel(jansen, 1, 2, 2, 2, 2, 2)
        ),
        "Klann's leg": ClosedForm(drawing("klann_leg"), motor, short, "last(pin.G.x)", parallel(klann, 1, 2, 2, 2, 2)),
    }  # fmt: skip
