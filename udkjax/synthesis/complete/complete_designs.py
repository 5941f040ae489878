"""All four-bars that meet a goal exactly, with their certificates and the classification of their motions."""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.positions.following.drive import Drive
from udkjax.printing import PrintedTable, PrintsTable
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.curves.found_mechanism import FoundMechanism

NEARLY_REAL = 1e-4  # relative to the extent; singular ends are at best accurate to the square root of the rounding error


class CompleteDesign(FoundMechanism):
    """One four-bar, drawn in the first position of the goal.

    Attributes:
        mechanism: the mechanism, to be run, animated or saved.
        values: the driver's values in the positions (J,) (rad); continuous if there is no defect.
        kind: Grashof's kind: "crank-rocker", "double crank", "double rocker", "rocker-crank" or "triple rocker".
        turns: whether the driver makes a whole turn.
        defect: "none" if one motion of the driver passes all positions in order; "circuit" if the four-bar has to be taken apart
            in between, "branch" if it passes a dead point of the driver, "order" if it passes the positions in another order.
        circuits: the circuit of each position (J,), numbered from that of the first position, 0.
        branches: the branch of each position (J,), numbered in the same way.
        order: indices of the positions in the order of a motion along the circuit of the first one.
        transmission: the smallest sine of the transmission angle over the positions, from 0 to 1.
        confirmed: mask of the positions (J,) reached by motions of the mechanism from the first position of their branch.
        radius: largest distance (m) of the pins from those of the exact four-bar.
        number: the number of its class; four-bars of one class trace the same curve.
        cognate: index within the class (0, 1, 2).
        driver: the driver.
    """

    mechanism: Mechanism
    values: Float[np.ndarray, "J"]
    kind: str = eqx.field(static=True)
    turns: bool = eqx.field(static=True)
    defect: str = eqx.field(static=True)
    circuits: Int[np.ndarray, "J"]
    branches: Int[np.ndarray, "J"]
    order: tuple[int, ...] = eqx.field(static=True)
    transmission: float
    confirmed: Bool[np.ndarray, "J"]
    radius: float
    number: int = eqx.field(static=True)
    cognate: int = eqx.field(static=True)
    driver: Drive = eqx.field(static=True)

    @property
    def last_value(self) -> float:
        """The value of the driver at the end of the branch of the first position."""
        on_branch = self.values[self.branches == 0]
        return on_branch[np.argmax(np.abs(on_branch - self.values[0]))]

    def _table(self) -> PrintedTable:
        rows = [("kind", f"{self.kind}{', turns' if self.turns else ''}"), ("defect", self.defect)]
        rows += [("confirmed by motion", f"{int(self.confirmed.sum())} of {len(self.values)} positions")]
        rows += [("transmission", f"{self.transmission:.3g}"), ("proven within", f"{self.radius:.2g} m")]
        rows += [("class", f"{self.number}, cognate {self.cognate}")]
        rows += self._pin_rows()
        return PrintedTable(f"four-bar {self.mechanism.name}".strip(), rows)


class OtherSolution(NamedTuple):
    """A solution that is not a design: the end of a path, or a real solution without a proof.

    Attributes:
        kind: "singular" if solutions meet or are not isolated, "infinite" if a joint goes to infinity, "lost" if the path could
            not be tracked to its end; "unproven" if a real solution is too close to singular for a proof.
        pins: the coordinates of the pins in the first position by name (2,) (m), complex unless the solution is real.
    """

    kind: str
    pins: dict[str, np.ndarray]

    @property
    def is_real(self) -> bool:
        """True if the coordinates are real to within their accuracy."""
        places = np.array(list(self.pins.values()))
        return bool(np.max(np.abs(np.imag(places))) <= NEARLY_REAL * np.max(np.abs(places - places.mean(axis=0))))


class CompleteDesigns(PrintsTable):
    """All four-bars that meet a goal: a sequence of `CompleteDesign`, created on access.

    They are sorted by defect (designs without a defect first, and among these the confirmed ones), then by whether the driver
    turns fully, then by transmission. Each four-bar occurs twice, driven from either side; each class of four-bars through nine
    points has three cognates.

    Attributes:
        pins: the places of the pins in the first position, by name (M, 2), in m.
        values: the driver's values in the positions (M, J) (rad).
        kinds: Grashof's kind of each design.
        turns: whether the driver makes a whole turn (M,).
        defects: the defect of each design.
        circuits: the circuit of each position (M, J).
        branches: the branch of each position (M, J).
        order: indices of the positions in the order of a motion (M, J), padded with -1.
        transmission: the smallest sine of the transmission angle over the positions (M,).
        confirmed: mask of the positions that motions reach (M, J).
        radius: radii of the certificates (M,) (m).
        numbers: numbers of the classes (M,).
        cognates: indices within the classes (M,).
        classes: number of different proven real classes; for poses, number of proven real dyads.
        others: the other solutions, including complex ones, that are singular, infinite, lost or unproven.
        left_out: number of designs that exceed a limit.
        paths: counts of all solutions of the problem, including complex ones, by outcome.
        mechanism: the mechanism of the given drawing.
        coupler: the name of its coupler.
        driver: the driver.
    """

    pins: dict[str, Float[np.ndarray, "M 2"]]
    values: Float[np.ndarray, "M J"]
    kinds: tuple[str, ...] = eqx.field(static=True)
    turns: Bool[np.ndarray, "M"]
    defects: tuple[str, ...] = eqx.field(static=True)
    circuits: Int[np.ndarray, "M J"]
    branches: Int[np.ndarray, "M J"]
    order: Int[np.ndarray, "M J"]
    transmission: Float[np.ndarray, "M"]
    confirmed: Bool[np.ndarray, "M J"]
    radius: Float[np.ndarray, "M"]
    numbers: Int[np.ndarray, "M"]
    cognates: Int[np.ndarray, "M"]
    classes: int = eqx.field(static=True)
    others: tuple[OtherSolution, ...]
    left_out: int = eqx.field(static=True)
    paths: dict[str, int] = eqx.field(static=True)
    mechanism: Mechanism
    coupler: str = eqx.field(static=True)
    driver: Drive = eqx.field(static=True)

    @property
    def unproven(self) -> int:
        """The number of classes, or dyads, that appear to be real but are not proven; `classes` does not include them."""
        return sum(other.kind == "unproven" for other in self.others)

    def __len__(self) -> int:
        return len(self.kinds)

    def __getitem__(self, k: int) -> CompleteDesign:
        if not -len(self) <= k < len(self):
            raise IndexError(f"design {k} of {len(self)}")
        places = {name: jnp.asarray(pins[k]) for name, pins in self.pins.items()}
        try:
            mechanism = self.mechanism.with_parameters(places)
        except SceneError:  # a coupler with collinear pins is a rod, not a plate
            mechanism = self.mechanism.with_parameters(places | {f"link.{self.coupler}.width": 0.0})
        order = tuple(int(j) for j in self.order[k] if j >= 0)
        return CompleteDesign(
            mechanism=mechanism,
            values=self.values[k],
            kind=self.kinds[k],
            turns=bool(self.turns[k]),
            defect=self.defects[k],
            circuits=self.circuits[k],
            branches=self.branches[k],
            order=order,
            transmission=float(self.transmission[k]),
            confirmed=self.confirmed[k],
            radius=float(self.radius[k]),
            number=int(self.numbers[k]),
            cognate=int(self.cognates[k]),
            driver=self.driver,
        )

    def __iter__(self) -> Iterator[CompleteDesign]:
        return (self[k] for k in range(len(self)))

    def _table(self) -> PrintedTable:
        rows = [("solutions", ", ".join(f"{count} {name}" for name, count in self.paths.items()))]
        rows += [("real, proven", f"{self.classes}{f'; {self.unproven} more without a proof' if self.unproven else ''}")]
        rows += [("defects", ", ".join(f"{self.defects.count(name)} {name}" for name in dict.fromkeys(self.defects)))]
        rows += [("beyond limits", str(self.left_out))] if self.left_out else []
        for k, (kind, defect) in enumerate(zip(self.kinds[:8], self.defects, strict=False)):
            rows.append((str(k + 1), f"{kind}, defect {defect}, transmission {self.transmission[k]:.3g}"))
        return PrintedTable(f"{len(self)} four-bars", rows)
