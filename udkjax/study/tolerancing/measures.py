"""Measures of samples: of positions over a drive, by machine code in lanes, or functions of the mechanism.

A measure of positions is read at each value of the drive, and then reduced: the largest, the least, their difference, a mean, or
the largest deviation from the mechanism with nominal numbers.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Numbers
from udkjax.arrays import FULL_TURN
from udkjax.equations.programs.position_programs import trace_model
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.positions.assembling.channels import locate
from udkjax.positions.assembling.coordinates import value_of
from udkjax.positions.following.drive import Drive, drive
from udkjax.positions.following.free_numbers import position_model
from udkjax.positions.following.position_batch import compile_positions
from udkjax.scene.elements.bodies import GROUND, Frame
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.study.members import Program
from udkjax.study.tolerancing.dimensions import ToleratedNumbers
from udkjax.synthesis.goals import FunctionGoal, Goal
from udkjax.threads import thread_count
from udkjax.wording import quote

ToleratedMeasure: TypeAlias = "str | Goal | Callable[[Mechanism], Any]"
ToleratedMeasures: TypeAlias = "Sequence[str] | Mapping[str, ToleratedMeasure]"

REDUCTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "max": lambda x: x.max(1),
    "min": lambda x: x.min(1),
    "range": lambda x: x.max(1) - x.min(1),
    "mean": lambda x: x.mean(1),
    "rms": lambda x: np.sqrt((x**2).mean(1)),
    "first": lambda x: x[:, 0],
    "last": lambda x: x[:, -1],
}
DEVIATION = "deviation"  # the largest distance from the position of the nominal mechanism
VALUES_PER_TURN = 72  # values over a turn, if none are given: every 5 degrees
IN_CACHE = 1024  # samples at a time: their positions stay in the processor's cache
IN_PROGRAM = 256  # samples at a time of a function of the mechanism


class _Reading(NamedTuple):
    """A measure of positions: the columns that the program returns, and how they are reduced."""

    columns: slice
    reduction: str
    read: Callable[[Mechanism, Array, Array], list[Array]]  # from the mechanism, q (bodies, 3) and data of the position


class Measuring:
    """The measures of samples, as a function of the numbers of samples.

    Args:
        numbers: the numbers that differ between samples.
        measures: measures by name, or texts that are their own names.
        driver: the driver or coordinate, as for `kinematics`; by default the only driver.
        values: values of the driver; by default every 5 degrees of a turn.

    Raises:
        SceneError: lists every mistake.
    """

    def __init__(self, numbers: ToleratedNumbers, measures: ToleratedMeasures, driver: Drive, values: Numbers | None):
        given = dict(measures) if isinstance(measures, Mapping) else {text: text for text in measures}
        only = numbers.mechanism.driver_names[0] if len(numbers.mechanism.driver_names) == 1 else None
        self.numbers, self.names, self.driver = numbers, tuple(given), only if driver is None else driver
        self._functions = {k: x for k, x in given.items() if callable(x) and not isinstance(x, Goal | str)}
        of_positions = {k: x for k, x in given.items() if k not in self._functions}
        self.units = dict.fromkeys(given, "") | dict.fromkeys(of_positions, "m")  # of the measures
        self.values = np.zeros(0) if not of_positions else self._drive(values)
        self._readings, problems = {}, [] if given else ['measures: none is given, such as "range(body.rocker.angle)"']
        data: list[np.ndarray] = []
        for name, measure in of_positions.items():
            try:
                self._readings[name] = self._reading(measure, data)
                is_angle = (isinstance(measure, str) and measure.endswith("angle)")) or isinstance(measure, FunctionGoal)
                self.units[name] = "rad" if is_angle else "m"
            except SceneError as error:
                problems += [f"measures: {quote(name)}: {problem}" for problem in error.problems]
            except (ValueError, TypeError) as problem:
                problems.append(f"measures: {quote(name)}: {problem}")
        if problems:
            raise SceneError(problems, numbers.mechanism.name)
        self._data = np.concatenate(data, 1) if data else np.zeros((len(self.values), 0))
        if self._readings:
            self._compile()
        if self._functions:
            self._program = Program(self._of_mechanism, 0, IN_PROGRAM)
        at_nominal = numbers.nominal[None]
        self._nominal = self._read(at_nominal) if self._readings else np.zeros((1, 0, 0))
        wrong = [name for name, x in zip(self.names, self(at_nominal)[0], strict=True) if not np.isfinite(x)]
        if wrong:
            cure = "the nominal mechanism must move over all values: change the values, or look at udk.kinematics"
            raise SceneError(
                [f"measures: {', '.join(wrong)} has no value at the nominal numbers; {cure}"], numbers.mechanism.name
            )

    def __call__(self, x: Float[np.ndarray, "N P"]) -> Float[np.ndarray, "N G"]:
        """Return the G measures of N samples of the numbers.

        A measure is NaN if the sample does not reach all values of the driver, or if its function is not finite.
        """
        found = np.empty((len(x), len(self.names)))
        place = {name: k for k, name in enumerate(self.names)}
        if self._readings:
            starts = range(0, len(x), IN_CACHE)
            with ThreadPoolExecutor(thread_count()) as pool:
                for first, part in zip(starts, pool.map(lambda k: self._reduced(x[k : k + IN_CACHE]), starts), strict=True):
                    found[first : first + IN_CACHE, [place[name] for name in self._readings]] = part
        if self._functions:
            results, _ = self._program(self.numbers.nominal, x, on_threads=True)
            for name in self._functions:
                found[:, place[name]] = results[name]
        found[~np.isfinite(found)] = np.nan
        return found

    # --- positions

    def _drive(self, values: Numbers | None) -> np.ndarray:
        mechanism = self.numbers.mechanism
        self._driven = drive(mechanism, self.driver)
        if values is None:
            if not self._driven.is_angle:
                raise SceneError(["values: give the values of the driver, which is not an angle"], mechanism.name)
            return float(self._driven.value(mechanism.q0)) + FULL_TURN / VALUES_PER_TURN * np.arange(VALUES_PER_TURN)
        found = np.asarray(values, float)
        if found.ndim != 1 or not len(found) or not np.isfinite(found).all():
            raise ValueError("values must be a list of finite numbers, those of the driver")
        return found

    def _reading(self, measure: Any, data: list[np.ndarray]) -> _Reading:
        first = sum(reading.columns.stop - reading.columns.start for reading in self._readings.values())
        if isinstance(measure, Goal):
            return self._of_goal(measure, first, data)
        if not isinstance(measure, str):
            raise TypeError("must be a text such as range(body.rocker.angle), a goal, or a function of the mechanism")
        reduction, _, rest = measure.strip().partition("(")
        if not rest.endswith(")") or reduction not in {*REDUCTIONS, DEVIATION}:
            known = ", ".join([*REDUCTIONS, DEVIATION])
            raise ValueError(f"is read as one of {known} of a coordinate or a pin, such as range(body.rocker.angle)")
        read, count = self._coordinate(rest[:-1].strip(), reduction == DEVIATION)
        return _Reading(slice(first, first + count), reduction, read)

    def _coordinate(self, text: str, both: bool) -> tuple[Callable[[Mechanism, Array, Array], list[Array]], int]:
        """Return a function that reads the coordinate named by a text, and the number of values that it reads.

        If `both`, the text may also name a point, of which the function reads x and y.
        """
        of, _, component = text.rpartition(".")
        if both and component not in ("x", "y", "angle"):
            of, component = text, ""
        if component not in ("x", "y", "") or (component == "" and not both) or not of:
            value_of(self.numbers.mechanism, text)  # raises an error that suggests a name
            return lambda mechanism, q, data: [value_of(mechanism, text)(q)], 1
        locate(self.numbers.mechanism, of)
        which = [0, 1] if not component else ["xy".index(component)]

        def place(mechanism: Mechanism, q: Array, data: Array) -> list[Array]:
            body, local = locate(mechanism, of)
            if body == GROUND:
                return [jnp.asarray(local[k]) for k in which]
            x, y, angle = q[mechanism.body_names.index(body)]
            point = Frame.at((x, y), angle).point(local)
            return [jnp.asarray((point.x, point.y)[k]) for k in which]

        return place, len(which)

    def _of_goal(self, goal: Goal, first: int, data: list[np.ndarray]) -> _Reading:
        if goal.extras or goal.is_combined or len(goal.targets) != len(self.values):
            raise ValueError(
                f"the goal must have a target for each of the {len(self.values)} values, and no start that is to be found"
            )
        goal.check(self.numbers.mechanism)
        start = sum(x.shape[1] for x in data)
        place = slice(start, start + goal.targets.shape[1])
        data.append(goal.targets)

        def differences(mechanism: Mechanism, q: Array, data: Array) -> list[Array]:
            return list(map(jnp.asarray, goal.residual(goal.measure(mechanism, q), data[place], jnp.zeros(0), jnp)))

        count = len(goal.residual(goal.targets, goal.targets, np.zeros((len(self.values), 0)), np))
        return _Reading(slice(first, first + count), "", differences)

    def _compile(self):
        numbers, driven = self.numbers, self._driven

        def measures(mechanism: Mechanism, x: Array, q: Array, data: Array) -> Array:
            return jnp.stack([jnp.asarray(y) for r in self._readings.values() for y in r.read(mechanism, q, data)])

        model: Any = position_model(numbers, self.driver, measures)  # pyright: ignore[reportArgumentType]
        coordinates, D = 3 * len(numbers.mechanism.body_names), self._data.shape[1]
        _, self._code = compile_positions(
            numbers.mechanism, trace_model(model, numbers.count, coordinates, D), numbers.count, coordinates, data=D,
            transmission=False, derivatives=False, rows=np.asarray(driven.analysis.scales.rows),
        )  # fmt: skip
        analysis = driven.analysis
        self._unit = np.asarray(analysis.scales.coordinates(analysis.coordinates))

    def _read(self, x: np.ndarray) -> Float[np.ndarray, "N T columns"]:
        longest = CLOSURE.longest_step * float(self._driven.unit)
        found = self._code(x, self.values, self._unit, self._data, longest=longest, threads=1)
        return np.where(np.isfinite(found.end)[..., None], found.out, np.nan)

    def _reduced(self, x: np.ndarray) -> np.ndarray:
        read = self._read(x)
        columns = []
        for reading in self._readings.values():
            part = read[..., reading.columns]
            if reading.reduction == DEVIATION:
                part = part - self._nominal[..., reading.columns]
            if reading.reduction in REDUCTIONS:
                columns.append(REDUCTIONS[reading.reduction](part[..., 0]))
            else:
                columns.append(np.sqrt((part**2).sum(-1)).max(1))
        return np.stack(columns, 1)

    def _of_mechanism(self, shared: Array, x: Array, shift: Array) -> dict[str, Array]:
        mechanism = self.numbers.moved(x)
        return {name: jnp.asarray(function(mechanism), float) for name, function in self._functions.items()}
