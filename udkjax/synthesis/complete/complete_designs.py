"""All four-bars that meet a goal exactly, each with its certificate and what its motion is like."""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.positions.drive import Drive
from udkjax.positions.kinematics import FULL_TURN, Kinematics, kinematics
from udkjax.printing import PrintedTable, PrintsTable, format_numbers
from udkjax.scene.checks import SceneError
from udkjax.scene.mechanism import AbstractDrawing, Mechanism

NEARLY_REAL = 1e-4  # of the extent: singular ends are known to the root of rounding, and less


class CompleteDesign(PrintsTable):
    """One four-bar, drawn in the first position of the goal.

    Attributes:
        mechanism: the mechanism, to be run, animated or saved.
        values: of the driver in the positions (J,) (rad); without jumps where there is no defect.
        kind: by Grashof: "crank-rocker", "double crank", "double rocker", "rocker-crank" or "triple rocker".
        turns: whether the driver makes a whole turn.
        defect: "none" where one motion of the driver passes all positions in their order; "circuit" where the four-bar has to be
            taken apart in between, "branch" where it passes a dead point of the driver, "order" where it passes them in another.
        circuits: of each position (J,), counted from the first one's, which is 0.
        branches: likewise.
        order: the positions in the order in which a motion along the first one's circuit passes them.
        transmission: the least over the positions, from 0 to 1: the sine of the transmission angle.
        confirmed: mask of the positions that motions of the mechanism passed (J,), each from the first one of its branch on.
        radius: m: the exact four-bar has its pins no farther than that from these.
        number: of its class: four-bars of one class trace one curve.
        cognate: index within the class (0, 1, 2).
        driver: its driver.
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

    def motion(self, count: int = 361) -> Kinematics:
        """Return a motion from the first position, by `kinematics`: a whole turn, or as far as the positions of its branch lead.

        Args:
            count: of values.
        """
        on_branch = self.values[self.branches == 0]
        farthest = on_branch[np.argmax(np.abs(on_branch - self.values[0]))]
        last = self.values[0] + FULL_TURN if self.turns else farthest if len(on_branch) > 1 else self.values[0]
        return kinematics(self.mechanism, self.driver, np.linspace(self.values[0], last, count))

    @property
    def pins(self) -> dict[str, Float[Array, "2"]]:
        """The places of the pins by name (m), in the first position."""
        drawn = {} if self.mechanism.drawing is None else self.mechanism.drawing.groups["pin"]
        return {name: getattr(pin, "position") for name, pin in drawn.items()}  # noqa: B009  # of a drawing, whose class is above

    @property
    def drawing(self) -> AbstractDrawing | None:
        """The drawing, with these pins."""
        return self.mechanism.drawing

    def _table(self) -> PrintedTable:
        rows = [("kind", f"{self.kind}{', turns' if self.turns else ''}"), ("defect", self.defect)]
        rows += [("confirmed by motion", f"{int(self.confirmed.sum())} of {len(self.values)} positions")]
        rows += [("transmission", f"{self.transmission:.3g}"), ("proven within", f"{self.radius:.2g} m")]
        rows += [("class", f"{self.number}, cognate {self.cognate}")]
        rows += [(f"pin.{name}", format_numbers(place, "m")) for name, place in self.pins.items()]
        return PrintedTable(f"four-bar {self.mechanism.name}".strip(), rows)


class OtherSolution(NamedTuple):
    """A solution beside the designs: where the path to it ended, or what could not be proven.

    Attributes:
        kind: "singular" where solutions meet or are no isolated ones, "infinite" where a joint goes to infinity, "lost" where a
            path could not be followed to its end; "unproven" where a real solution is too nearly singular for a proof.
        pins: the coordinates of the pins in the first position by name (2,), in m, complex ones unless the solution is real.
    """

    kind: str
    pins: dict[str, np.ndarray]

    @property
    def is_real(self) -> bool:
        """True if the coordinates are real, to within what is known of them."""
        places = np.array(list(self.pins.values()))
        return bool(np.max(np.abs(np.imag(places))) <= NEARLY_REAL * np.max(np.abs(places - places.mean(axis=0))))


class CompleteDesigns(PrintsTable):
    """All four-bars that meet a goal: a sequence of `CompleteDesign`, each made when it is asked for.

    Those without defects come first, of these what motions confirm; then those whose driver turns; then those with the better
    transmission. Each four-bar is there twice, once with its crank on either side; through nine points each class has three
    cognates.

    Attributes:
        pins: the pins of each in the first position, by name (M, 2), in m.
        values: of the driver in the positions (M, J) (rad).
        kinds: the kind of each.
        turns: whether the driver makes a whole turn (M,).
        defects: the defect of each.
        circuits: of each position (M, J).
        branches: of each position (M, J).
        order: the positions as motions pass them (M, J), then -1.
        transmission: the least over the positions (M,).
        confirmed: mask of the positions that motions passed (M, J).
        radius: of the certificates (M,) (m).
        numbers: of classes (M,).
        cognates: index within the class (M,).
        classes: number of real classes, or dyads of a link in poses, proven to be different.
        others: the other solutions, complex ones counted, that are singular, infinite, lost or unproven.
        left_out: number of designs left out because they exceed a limit.
        paths: counts of the solutions of the whole problem, complex ones too, by what became of them.
        mechanism: the drawing's, as it was given.
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
        """The number of further classes that appear to be real without a proof."""
        return sum(other.kind == "unproven" for other in self.others)

    def __len__(self) -> int:
        return len(self.kinds)

    def __getitem__(self, k: int) -> CompleteDesign:
        if not -len(self) <= k < len(self):
            raise IndexError(f"design {k} of {len(self)}")
        places = {name: jnp.asarray(pins[k]) for name, pins in self.pins.items()}
        try:
            mechanism = self.mechanism.with_parameters(places)
        except SceneError:  # a coupler whose pins are on one line is no plate, but a rod
            mechanism = self.mechanism.with_parameters(places | {f"link.{self.coupler}.width": 0.0})
        order = tuple(int(j) for j in self.order[k] if j >= 0)
        return CompleteDesign(
            mechanism, self.values[k], self.kinds[k], bool(self.turns[k]), self.defects[k], self.circuits[k], self.branches[k],
            order, float(self.transmission[k]), self.confirmed[k], float(self.radius[k]), int(self.numbers[k]),
            int(self.cognates[k]), self.driver,
        )  # fmt: skip

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
