"""Results of a search for mechanisms that draw a curve."""

from collections.abc import Iterator

import equinox as eqx
import numpy as np
from jaxtyping import Float

from udkjax.positions.following.drive import Drive, drive, only_driver
from udkjax.printing import PrintedTable, PrintsTable, format_number
from udkjax.scene.mechanism import Mechanism
from udkjax.synthesis.curves.curve_search import FoundLinkage, drawn
from udkjax.synthesis.curves.dyads import SPAN_INDEX
from udkjax.synthesis.curves.found_mechanism import FoundMechanism
from udkjax.synthesis.curves.linkage_drawing import PATH_PIN, drawing_of, turns_on_its_branch
from udkjax.synthesis.curves.targets import WantedCurve, as_points


class CurveDesign(FoundMechanism):
    """A mechanism with one motor, whose pin draws a curve; drawn at the beginning of the curve.

    Attributes:
        error: Chamfer distance of the drawn curve from the wanted one, in RMS radii of the wanted curve: both by 2000 points at
            equal arc lengths, the mean distance of each from the other, added.
        mechanism: the mechanism, to be run, animated or saved; `drawing` is its drawing.
        pin: the name of the drawing pin.
        curve: the drawn curve (m, 2) (m).
        bars: number of links, with the ground.
        size: largest distance (m) of any pin from the middle of the curve over the whole turn.
        transmission: smallest angle (rad) between the two links of a dyad, or between one and the other prolonged; at a slide,
            between a link and its rail, or its line and the perpendicular through the pins of the dyad.
        values: values of the driver (rad) at the ends of the curve.
        turns: True: `kinematics` follows the mechanism over 720 positions of a whole turn, on one branch.
        driver: the driver.
    """

    error: float
    mechanism: Mechanism
    pin: str = eqx.field(static=True)
    curve: Float[np.ndarray, "m 2"]
    bars: int = eqx.field(static=True)
    size: float
    transmission: float
    values: Float[np.ndarray, "2"]
    turns: bool = eqx.field(static=True)
    driver: Drive = eqx.field(static=True)

    @property
    def last_value(self) -> float:
        """The value of the driver at the end of the curve."""
        return float(self.values[-1])

    def _table(self) -> PrintedTable:
        rows = [("error", f"{self.error:.4g} of the curve's RMS radius"), ("bars", str(self.bars))]
        rows += [
            ("size", format_number(self.size, "m")),
            ("transmission angle", f"at least {np.degrees(self.transmission):.3g} deg"),
        ]
        rows += [("part of the turn", f"{np.degrees(np.ptp(self.values)):.4g} deg"), *self._pin_rows()]
        return PrintedTable(f"design {self.mechanism.name}".strip(), rows)


class CurveDesigns(PrintsTable):
    """Different mechanisms that draw a curve, the best first: a sequence of `CurveDesign`.

    Attributes:
        found: the designs.
        rounds: number of completed rounds; the same seed and number of rounds give the same designs.
        candidates: number of linkages that were improved.
        seconds: CPU time of the search (s).
        reason: why no design was found, and the cure; empty if there are designs.
    """

    found: tuple[CurveDesign, ...]
    rounds: int = eqx.field(static=True)
    candidates: int = eqx.field(static=True)
    seconds: float = eqx.field(static=True)
    reason: str = eqx.field(static=True, default="")

    def __len__(self) -> int:
        return len(self.found)

    def __getitem__(self, k: int) -> CurveDesign:
        return self.found[k]

    def __iter__(self) -> Iterator[CurveDesign]:
        return iter(self.found)

    def _table(self) -> PrintedTable:
        rows = [("rounds", f"{self.rounds}, {self.candidates} linkages, {self.seconds:.1f} s of CPU time")]
        rows += [("nothing was found", self.reason)] if self.reason else []
        for k, design in enumerate(self.found):
            angle = f"{np.degrees(design.transmission):.3g} deg"
            rows.append((str(k + 1), f"error {design.error:.4g}, {design.bars} bars, transmission angle at least {angle}"))
        return PrintedTable(f"{len(self.found)} mechanisms for a curve", rows)


def confirmed(found: FoundLinkage, wanted: WantedCurve, name: str, unit: str) -> CurveDesign | None:
    """Return a linkage as a design; None if `kinematics` does not follow its mechanism over the whole turn on its branch."""
    mechanism = drawing_of(found.x, found.topology, wanted, name, unit).mechanism()
    size = wanted.scale * found.size
    if not turns_on_its_branch(mechanism, found.x, found.topology, wanted, size + abs(wanted.middle)):
        return None
    driver = only_driver(mechanism)
    start = float(drive(mechanism, driver).value(mechanism.q0))
    path = wanted.middle + wanted.scale * drawn(found.x, found.topology, wanted.is_whole)
    return CurveDesign(
        error=found.error,
        mechanism=mechanism,
        pin=PATH_PIN,
        curve=as_points(path),
        bars=found.bars,
        size=size,
        transmission=float(np.arcsin(found.sine)),
        values=start + np.array([0.0, found.x[SPAN_INDEX]]),
        turns=True,
        driver=driver,
    )


def ranked(found: dict[int, list[FoundLinkage]], wanted: WantedCurve, count: int, worth: float, unit: str) -> list[CurveDesign]:
    """Return up to `count` different, confirmed designs, the best first by error and simplicity.

    Two more bars must reduce the error by the fraction `worth`. `found` has linkages by the number of bars.
    """
    every = sorted((one for same in found.values() for one in same), key=lambda one: one.error / (1.0 - worth) ** (one.bars / 2))
    chosen: list[CurveDesign] = []
    errors: list[tuple[bytes, float]] = []
    for one in every:
        structure = b"".join(a.tobytes() for a in one.topology if a is not one.topology.side)
        if len(chosen) == count or any(s == structure and abs(e - one.error) < 0.02 * e for s, e in errors):
            continue
        try:
            design = confirmed(one, wanted, f"curve {len(chosen) + 1}", unit)
        except KeyboardInterrupt:  # the best so far
            if chosen:
                break
            raise
        if design is not None:
            chosen.append(design)
            errors.append((structure, one.error))
    return chosen
