"""The fit of a design to its goal, in the words and the units of a drawing."""

from typing import NamedTuple

import numpy as np

from udkjax.positions.answers.characteristics import characteristics
from udkjax.positions.assembling.coordinates import element_of
from udkjax.printing import format_number
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.curve_goal import CurveGoal
from udkjax.synthesis.designs import FoundDesign
from udkjax.synthesis.goals import FunctionGoal, Goal, PoseGoal

# Deviation relative to the extent of the targets beyond which a design is no fit: its motion looks like another one. The word is
# for people: no computation depends on it, and a curve of another form misses its targets by about this much.
LARGEST_DEVIATION = 0.1


class Deviation(NamedTuple):
    """The largest deviation of a design from its goal, and the extent of the goal.

    Attributes:
        largest: the largest distance of a target from the motion, or difference of an output (m, rad).
        extent: the length of the path through the targets, or the range of the outputs (m, rad).
        angle: for a `PoseGoal`, the largest difference of the link's angle (rad); otherwise None.
        unit: the unit of `largest` and `extent`, "m" or "rad".
        size: the extent of the targets in the plane, or the range of the outputs, of which a tenth is accepted (m, rad).
    """

    largest: float
    extent: float
    angle: float | None
    unit: str
    size: float

    @property
    def is_fit(self) -> bool:
        """True if the deviation is at most a tenth of the extent of the targets; for an angle, a tenth of a radian."""
        return self.largest <= LARGEST_DEVIATION * self.size and (self.angle is None or self.angle <= LARGEST_DEVIATION)

    def words(self, units: Units) -> str:
        """Return the deviation as text: `at most 0.4 mm off on a path of 170 mm`."""
        extent = units.text(self.extent, self.unit)
        largest = format_number(self.largest / units.size(self.unit), units.shown(self.unit), self.extent / units.size(self.unit))
        along = "over" if self.unit == "rad" else "on a path of"
        return f"at most {largest} off {along} {extent}" + (
            "" if self.angle is None else f", and {units.text(self.angle, 'rad')}"
        )


def deviation_of(design: FoundDesign, goal: Goal) -> Deviation:
    """Return the largest deviation of a design from its goal."""
    residuals = design.residuals
    targets = goal.targets
    if isinstance(goal, FunctionGoal):
        is_angle = element_of(design.mechanism, goal.output).coordinate == "angle"
        extent, unit = float(np.ptp(targets)), "rad" if is_angle else "m"
        return Deviation(float(np.max(np.abs(residuals))), extent, None, unit, extent)
    places, angle = targets[:, :2], None
    if isinstance(goal, PoseGoal):
        arm = float(np.max(np.ptp(places, axis=0))) if goal.arm is None else goal.arm
        angle = float(np.max(2.0 * np.arcsin(np.minimum(np.abs(residuals[:, 2]) / (2.0 * arm), 1.0))))
    way = float(np.sum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    each = goal.distances(residuals) if isinstance(goal, CurveGoal) else np.linalg.norm(residuals[:, :2], axis=1)
    off = float(np.max(each))
    return Deviation(off, way, angle, "m", float(np.linalg.norm(np.ptp(places, axis=0))))


def design_lines(design: FoundDesign, goal: Goal) -> dict[str, str]:
    """Return a design as texts by title: deviation, type, transmission angle, pins and lengths, in the units of its drawing."""
    mechanism, units = design.mechanism, Units.of(design.mechanism.drawing)
    deviation = deviation_of(design, goal)
    lines = {"deviation": deviation.words(units) if deviation.is_fit else f"not a fit: {deviation.words(units)}"}
    try:
        found = characteristics(mechanism, design.driver)
        lines |= {f"type{f' {k + 1}' if k else ''}": bar.words for k, bar in enumerate(found.four_bars)}
    except SceneError:  # its positions do not follow over the whole range of the driver
        found = None
    lines["driver"] = "turns all the way round" if design.turns else "does not turn all the way round"
    least = np.degrees(np.arcsin(np.clip(design.transmission, 0.0, 1.0)))
    lines["transmission angle"] = f"at least {least:.4g} deg at the targets"
    for pin, ends in {} if found is None else found.transmission_angles.items():
        low, high = np.degrees(ends)
        lines["transmission angle"] = f"{low:.4g} to {high:.4g} deg at {pin}"
    size = units.size("m")
    lines |= {
        f"pin {name}": f"{float(x) / size:.6g}, {float(y) / size:.6g} {units.shown('m')}" for name, (x, y) in design.pins.items()
    }
    lengths = {} if design.drawing is None else design.drawing.length_texts()
    return lines | {f"lengths of {name}": text for name, text in lengths.items()}
