"""Characteristics of a mechanism as textbooks define them: type, mobility, strokes, dead points, transmission, ratios."""

from typing import NamedTuple

import equinox as eqx
import numpy as np

from udkjax.arrays import ROUNDING
from udkjax.positions.answers.counting import Count
from udkjax.positions.answers.linkage_type import FourBarType, Mobility, four_bars, mobility, transmission_pins
from udkjax.positions.answers.pressure import pressure_angles
from udkjax.positions.answers.turning_points import Combination, Cycle, Measured, PointAlong, TurningPoint
from udkjax.positions.assembling.coordinates import Coordinate, element_of
from udkjax.positions.following.drive import Drive, only_driver
from udkjax.printing import PrintedTable, PrintsTable, format_number
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.couplings import Gear
from udkjax.scene.elements.joints import Cam, Prismatic, Revolute, Slot
from udkjax.scene.mechanism import Mechanism

SAME_SPEED_TOL = 1e-9  # relative to the fastest: speeds of mirrored positions, which rounding separates
# Rounds in which the extremes of pressure angles are refined, and values in each: a round divides the step by ten.
REFINEMENTS, VALUES_PER_ROUND = 6, 21


class SpeedRatio(NamedTuple):
    """The least or the largest speed of a link per unit speed of the driver.

    Attributes:
        ratio: the speed (rad or m) per rad of the driver, with its sign.
        at: the values of the driver (rad) at which it is reached; empty if the ratio is constant.
    """

    ratio: float
    at: tuple[float, ...]


class Output(NamedTuple):
    """The motion of a link on the ground over the whole range of the driver.

    Attributes:
        kind: swings, slides or turns.
        extent: its swing angle (rad) or its stroke (m); for a link that turns all the way round, a whole turn.
        dead_points: the values of the driver (rad, m) at which it turns back.
        time_ratio: for a link that turns back twice a turn of the driver, the driver's longer way between the dead points over
            the shorter one; otherwise None.
        speed_ratios: the least and the largest speed per unit speed of the driver, with their signs; None unless the driver makes
            whole turns, because in its toggle positions the ratio has no limit.
    """

    kind: str
    extent: float
    dead_points: tuple[float, ...]
    time_ratio: float | None
    speed_ratios: tuple[SpeedRatio, SpeedRatio] | None = None


class Characteristics(PrintsTable):
    """Characteristics of a mechanism over the whole range of its driver. Angles in rad, lengths in m.

    Attributes:
        mobility: degrees of freedom, counted by Gruebler and true; a motor is no constraint.
        four_bars: Grashof's type of each four-bar loop on the ground.
        turns: whether the driver makes whole turns.
        limits: the toggle positions of the driver; empty if it has none.
        outputs: the motions of the links on the ground, by name.
        transmission_angles: by pin, the least and the largest acute angle between coupler and output (rad).
        pressure_angles: by cam, the least and the largest pressure angle (rad).
        ratios: by link, its angular velocity per unit angular velocity of the driver, if it is constant; empty without gears.
        count: the zero and the units in which values of the driver are shown.
    """

    mobility: Mobility
    four_bars: list[FourBarType]
    turns: bool
    limits: tuple[float, ...]
    outputs: dict[str, Output]
    transmission_angles: dict[str, tuple[float, float]]
    pressure_angles: dict[str, tuple[float, float]]
    ratios: dict[str, float]
    count: Count = eqx.field(static=True)

    def lines(self) -> dict[str, str]:
        """Return the characteristics as texts by title, in the units of the drawing; `count` shows values of the driver."""
        count = self.count
        lines = {"mobility": self.mobility.words}
        lines |= {_numbered("type", k, len(self.four_bars)): bar.words for k, bar in enumerate(self.four_bars)}
        ends = " and ".join(count.text(value) for value in self.limits)
        lines["driver"] = (
            f"{count.words}: {'turns all the way round' if self.turns else f'toggles at {ends}' if ends else 'no limit'}"
        )
        for name, output in self.outputs.items():
            extent = count.units.text(output.extent, "m") if output.kind == "slides" else f"{np.degrees(output.extent):.6g} deg"
            lines[name] = "turns all the way round" if output.kind == "turns" else f"{output.kind} by {extent}"
            if output.dead_points:
                lines[f"dead points of {name}"] = "driver at " + ", ".join(
                    map(count.within_turn if self.turns else count.text, output.dead_points)
                )
            if output.time_ratio is not None:
                lines[f"time ratio of {name}"] = f"{output.time_ratio:.6g}"
            if output.speed_ratios is not None:
                lines[f"speed ratio of {name}"] = self._speed_words(output)
        angles = {f"transmission angle at {pin}": ends for pin, ends in self.transmission_angles.items()}
        for title, ends in (angles | {f"pressure angle of {cam}": ends for cam, ends in self.pressure_angles.items()}).items():
            least, most = (format_number(np.degrees(x), scale=90.0) for x in ends)
            lines[title] = f"{least} to {most} deg"
        lines |= {f"ratio of {name}": f"{ratio:.9g}" for name, ratio in self.ratios.items()}
        return lines

    def _speed_words(self, output: Output) -> str:
        """Return the least and the largest speed ratio as text, with the values of the driver at which they occur."""
        assert output.speed_ratios is not None
        units, scale = self.count.units, max(abs(extreme.ratio) for extreme in output.speed_ratios)
        slides = output.kind == "slides"
        size, unit = (units.size("m"), f" {units.shown('m')}/rad") if slides else (1.0, "")
        words = [
            format_number(ratio / size, scale=scale / size)
            + unit
            + (f" at {', '.join(map(self.count.within_turn, at))}" if at else "")
            for ratio, at in output.speed_ratios
        ]
        return " to ".join(words) if output.speed_ratios[0].at else f"constantly {words[0]}"

    def _table(self) -> PrintedTable:
        return PrintedTable("characteristics", list(self.lines().items()))


def _numbered(title: str, k: int, count: int) -> str:
    return title if count == 1 else f"{title} {k + 1}"


@checked
@concrete_only()
def characteristics(mechanism: Mechanism, driver: Drive = None) -> Characteristics:
    """Return the characteristics of a mechanism: type, mobility, strokes, dead points, transmission, ratios.

    Extremes over the driver's range are located to rounding, from exact derivatives of the positions. The transmission angle is
    that between two links, folded to at most 90 degrees.

    Args:
        mechanism: a mechanism of one degree of freedom once its drivers hold; its numbers are not traced.
        driver: a driver or coordinate, as for `kinematics`; by default the only driver.

    Returns:
        A `Characteristics`, which prints as a table.

    Raises:
        SceneError: there is no such driver, or positions do not follow from it.
    """
    driver = only_driver(mechanism) if driver is None else driver
    element, cycle = element_of(mechanism, driver), Cycle(mechanism, driver)
    limits = tuple(value for value, _ in cycle.ends)
    measured = _outputs(mechanism, element) if cycle.is_known else {}
    turning = dict(zip(measured, cycle.turning_points([weights for _, weights in measured.values()]), strict=True))
    outputs = {name: _output(cycle, kind, weights, turning[name]) for name, (kind, weights) in measured.items()}
    if cycle.turns:
        fastest = cycle.speed_extremes([weights for _, weights in measured.values()])
        outputs = {
            name: outputs[name]._replace(speed_ratios=_speed_ratios(cycle, weights, extremes))
            for (name, (_, weights)), extremes in zip(measured.items(), fastest, strict=True)
        }
    angles = _transmission_angles(mechanism, element, cycle) if cycle.is_known else {}
    has_gears = any(isinstance(joint, Gear) for joint in mechanism.joints.values())
    pressures = _pressure_angles(mechanism, driver, cycle) if cycle.is_known else {}
    ratios = _ratios(mechanism, cycle, element) if has_gears and cycle.is_known else {}
    bars = four_bars(mechanism, element)
    count = Count.of(mechanism, driver)
    return Characteristics(mobility(mechanism), bars, cycle.turns, limits, outputs, angles, pressures, ratios, count)


def _outputs(mechanism: Mechanism, driven: Coordinate) -> dict[str, tuple[str, Measured]]:
    """Return the angle or the displacement of each link or pin that a joint connects to the ground, except the driven one.

    By the name of the link or pin, the result has the kind of its motion, "swings" or "slides", and the measured quantity.
    A pin in a slot of the ground has its own name, unless its link is a slider that turns on it.
    """
    found: dict[str, tuple[str, Measured]] = {}
    for name, joint in mechanism.joints.items():
        moving = [body for body in getattr(joint, "bodies", ()) if body != GROUND]
        if len(moving) != 1 or not isinstance(joint, Revolute | Prismatic | Slot):
            continue
        body, weights = moving[0], np.zeros((len(mechanism.bodies), 3))
        k = mechanism.body_names.index(body)
        if isinstance(joint, Revolute):
            weights[k, 2] = 1.0
            if not (driven.coordinate == "angle" and {*driven.bodies} == {GROUND, body}):
                found[body] = ("swings", Combination(weights))
        elif isinstance(joint, Prismatic):
            axis = float(np.asarray(joint.axis)) if joint.bodies[0] == GROUND else None
            if axis is not None and driven.bodies != joint.bodies:
                weights[k, :2] = np.cos(axis), np.sin(axis)
                found[body] = ("slides", Combination(weights))
        elif joint.bodies[0] == GROUND:
            drawn = {} if mechanism.drawing is None else mechanism.drawing.groups["slot"]
            pin = getattr(drawn.get(name), "pin", name)
            found.setdefault(pin, ("slides", PointAlong(k, np.asarray(joint.points)[1], float(np.asarray(joint.axis)))))
    return found


def _output(cycle: Cycle, kind: str, weights: Measured, turning: list[TurningPoint]) -> Output:
    heights = cycle.heights(weights, turning)
    extent = float(np.ptp(heights))
    if kind == "swings" and extent >= 2 * np.pi * (1 - 1e-9) and not turning:
        return Output("turns", 2 * np.pi, (), None)
    values, ratio = tuple(point.value for point in turning if not point.dwells), None
    if cycle.turns and len(values) == len(turning) == 2:
        way = (values[1] - values[0]) % (2 * np.pi)
        ratio = max(way, 2 * np.pi - way) / min(way, 2 * np.pi - way)
    return Output(kind, extent, values, ratio)


def _speed_ratios(cycle: Cycle, weights: Measured, extremes: list[tuple[float, float]]) -> tuple[SpeedRatio, SpeedRatio]:
    """Return the least and the largest ratio of the `extremes`, pairs of the driver's value and the ratio there.

    If there are none, the constant ratio is returned twice.
    """
    if not extremes:
        constant = SpeedRatio(float(cycle.rates(weights)[0]), ())
        return constant, constant
    rates = [rate for _, rate in extremes]
    same = SAME_SPEED_TOL * max(map(abs, rates))

    def reached(best: float) -> SpeedRatio:
        return SpeedRatio(best, tuple(value for value, rate in extremes if abs(rate - best) <= same))

    return reached(min(rates)), reached(max(rates))


def _transmission_angles(mechanism: Mechanism, driven: Coordinate, cycle: Cycle) -> dict[str, tuple[float, float]]:
    """Return by pin the least and the largest acute angle between two moving links of two pins each, except at driven links."""
    found = {}
    for pin, links in transmission_pins(mechanism, driven.bodies).items():
        weights, directions = np.zeros((len(mechanism.bodies), 3)), []
        for sign, (body, here, other) in zip((-1.0, 1.0), links, strict=True):
            weights[mechanism.body_names.index(body), 2] = sign
            directions.append(np.arctan2(*(other - here)[::-1]))
        between = Combination(weights)
        heights = cycle.heights(between, cycle.turning_points([between])[0]) + directions[1] - directions[0]
        found[pin] = acute_range(float(np.min(heights)), float(np.max(heights)))
    return found


def acute_range(low: float, high: float) -> tuple[float, float]:
    """Return the least and the largest acute angle (rad) of two lines whose angle runs from `low` to `high`."""
    quarters = np.arange(np.ceil(low / (np.pi / 2)), np.floor(high / (np.pi / 2)) + 1)  # lines along or across each other
    angles = np.array([low, high, *(quarters * np.pi / 2)])
    acute = np.abs(angles - np.pi * np.round(angles / np.pi))
    return float(acute.min()), float(acute.max())


def _pressure_angles(mechanism: Mechanism, driver: str | Coordinate, cycle: Cycle) -> dict[str, tuple[float, float]]:
    """Return the least and the largest pressure angle of each cam with a moving follower, on a grid that is refined there."""
    found = {}
    for name, joint in mechanism.joints.items():
        if not isinstance(joint, Cam) or joint.bodies[1] == GROUND:
            continue
        angles, ends = pressure_angles(mechanism, cycle.q, name, driver), []
        for sign in (-1.0, 1.0):
            k, values = int(np.nanargmax(sign * angles)), cycle.values
            best, step = angles[k], float(np.max(np.diff(values)))
            centre = values[k]
            for _ in range(REFINEMENTS):
                near = centre + step * np.linspace(-1.0, 1.0, VALUES_PER_ROUND)
                around = pressure_angles(mechanism, np.asarray(cycle.at(near).q), name, driver)
                k, step = int(np.nanargmax(sign * around)), 2 * step / VALUES_PER_ROUND
                best, centre = sign * max(sign * best, sign * around[k]), near[k]
            ends.append(float(best))
        found[name] = (ends[0], ends[1])
    return found


def _ratios(mechanism: Mechanism, cycle: Cycle, driven: Coordinate) -> dict[str, float]:
    """Return the angular velocities of links per unit angular velocity of the driver, without links whose ratio varies."""
    if driven.coordinate != "angle":
        return {}
    rates = cycle.dq[:, :, 2]
    varies = np.ptp(rates, axis=0) > ROUNDING * 1e3 * np.max(np.abs(rates), initial=1.0)
    names = zip(mechanism.body_names, rates[0], varies, strict=True)
    return {name: float(rate) for name, rate, various in names if not various and name not in driven.bodies}
