"""Goals of a design: targets of the motion at some positions along it.

A goal measures each position (`measure`, in JAX) and compares the measures with the target (`residual`). The loss of a
design is the sum of the squares of all residuals.
"""

from abc import abstractmethod
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Numbers, NumericArray
from udkjax.positions.assembling.channels import locate
from udkjax.positions.assembling.coordinates import Coordinate, value_of
from udkjax.printing import PrintedTable, PrintsTable
from udkjax.requirements import require_choice, require_finite, require_names, require_number, require_numbers, require_text
from udkjax.scene.elements.bodies import GROUND, Frame
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote, suggestion


def _targets(name: str, columns: int) -> Callable[[Numbers], np.ndarray]:
    def convert(value: Numbers) -> np.ndarray:
        require_finite(name, value)
        array = np.asarray(value, float)
        array = array[:, None] if columns == 1 and array.ndim == 1 else array
        if array.ndim != 2 or array.shape[1] != columns or not len(array):
            shape = "(J,)" if columns == 1 else f"(J, {columns})"
            raise ValueError(f"{name} must have the shape {shape}, one row for each position, not {np.shape(value)}")
        return array

    return convert


def _names_of_pins(value: Any) -> tuple[str, ...]:
    require_names("line", value)
    return tuple(value)


def _values(value: Numbers | None) -> np.ndarray | None:
    if value is None:
        return None
    require_finite("values", value)
    array = np.asarray(value, float)
    if array.ndim != 1:
        raise ValueError(f"values must be one value of the driver for each position, shape (J,), not {array.shape}")
    return array


class CombinedResiduals(NamedTuple):
    """Residuals r (M, J, G) of M trials, and their derivatives by the driver's values and by the unknowns.

    `rest` (M,) is the part of each loss that is not a sum of squares of residuals.
    """

    r: np.ndarray
    by_value: np.ndarray
    by_unknowns: np.ndarray
    rest: np.ndarray


class Goal(PrintsTable):
    """Targets for a motion; `targets` has a row for each position.

    With `values`, the driver's value at each position is given (rad, m); otherwise the search determines the values, and
    positions are passed in order. If `start` is "free", the search determines the origin of `values`; with `line` they are
    measured from the direction from one pin to another, such as along the ground link.
    """

    if TYPE_CHECKING:  # each goal has these fields, in a different order

        @property
        def targets(self) -> np.ndarray: ...
        @property
        def values(self) -> np.ndarray | None: ...
        @property
        def start(self) -> str: ...
        @property
        def line(self) -> tuple[str, ...]: ...

    def __check_init__(self):
        if self.values is not None and len(self.values) != len(self.targets):
            raise ValueError(
                f"give one value for each target: there are {len(self.values)} values and {len(self.targets)} targets"
            )
        require_choice("start", self.start, ("given", "free"))
        if self.values is None and (self.start != "given" or self.line):
            raise ValueError("start and line define where values are measured from: give values, too")
        if self.line and len(self.line) != 2:
            raise ValueError("line must name two pins, from one to the other")

    @property
    def extras(self) -> int:
        """The number of unknowns of the goal itself, in addition to free numbers and the start of values."""
        return 0

    @property
    def bounds_of_extras(self) -> tuple[float, float]:
        """The lower and the upper limit of the goal's own unknowns."""
        return -np.inf, np.inf

    @property
    def has_place(self) -> bool:
        """True if the first two measures are x and y of a place that moves and scales with the mechanism."""
        return False

    @property
    def is_combined(self) -> bool:
        """True if the loss of a position depends on the other positions."""
        return False

    def combine(self, r: np.ndarray, by_value: np.ndarray, by_unknowns: np.ndarray) -> CombinedResiduals:
        """Return residuals of trials whose squares, plus a rest, are the losses; by default the given residuals, without a rest.

        Args:
            r: residuals of all positions (M, J, G).
            by_value: derivatives of r by the driver's values (M, J, G).
            by_unknowns: derivatives of r by the unknowns (M, J, G, P).
        """
        return CombinedResiduals(r, by_value, by_unknowns, np.zeros(len(r)))

    def report(self, r: np.ndarray) -> np.ndarray:
        """Return the residuals (J, G) that a design reports, whose squares are its loss; by default those of positions, r."""
        return r

    def values_at(self, extras: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the driver's values (M, J) of trials, from the goal's own unknowns (M, extras); by default `values`."""
        return values

    @abstractmethod
    def check(self, mechanism: Mechanism) -> None:
        """Raise `SceneError` if the mechanism lacks the measured element."""

    @abstractmethod
    def measure(self, mechanism: Mechanism, q: Float[Array, "bodies 3"]) -> Float[Array, "G"]:
        """Return the measures of a position."""

    @abstractmethod
    def residual(self, measured: NumericArray, target: NumericArray, extras: NumericArray, xp: ModuleType) -> list[NumericArray]:
        """Return the differences between measures and a target as a list of arrays (...), one for each residual.

        Args:
            measured: the measures (..., G).
            target: the row of `targets` (..., columns).
            extras: the goal's own unknowns (..., extras).
            xp: NumPy or jax.numpy.
        """

    def origin(self, mechanism: Mechanism) -> Array:
        """Return the value of the driver (rad, m) from which `values` are measured: the angle of `line`, or zero."""
        if not self.line:
            return jnp.zeros(())
        pins = mechanism.drawing.pins  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
        direction = pins[self.line[1]] - pins[self.line[0]]
        return jnp.arctan2(direction[1], direction[0])

    def check_line(self, mechanism: Mechanism) -> None:
        """Raise `SceneError` if `line` names a missing pin."""
        known = {} if mechanism.drawing is None else mechanism.drawing.groups["pin"]
        problems = [f"line: no pin named {quote(name)}{suggestion(name, known)}" for name in self.line if name not in known]
        if problems:
            raise SceneError(problems, mechanism.name)

    def _table(self) -> PrintedTable:
        how = "in order" if self.values is None else f"at given values{', from a free start' if self.start == 'free' else ''}"
        return PrintedTable(type(self).__name__, [("positions", f"{len(self.targets)}, {how}")])


def place_of(mechanism: Mechanism, of: str, point: Numbers | None, q: Float[Array, "bodies 3"]) -> list[Array]:
    """Return x and y (m), in ground axes, of a pin, or of a point given in the frame of a body, in the position q."""
    body, local = locate(mechanism, of, point)
    if body == GROUND:
        return [jnp.asarray(local[0]), jnp.asarray(local[1])]
    x, y, angle = q[mechanism.body_names.index(body)]
    result = Frame.at((x, y), angle).point(local)
    return [jnp.asarray(result.x), jnp.asarray(result.y)]


def check_place(mechanism: Mechanism, of: str, point: Numbers | None) -> None:
    """Raise `SceneError` if there is no such pin or body."""
    try:
        locate(mechanism, of, point)
    except ValueError as problem:
        raise SceneError([f"goal: {problem}"], mechanism.name) from None


class PathGoal(Goal):
    """A point of the mechanism passes through given positions in order.

    Args:
        point: the name of a pin, or of a body together with `at`.
        targets: the positions (J, 2) in m; on a closed curve the last may equal the first.
        values: values of the driver at each position (rad, m); by default found by the search.
        start: "given": values count from zero; "free": from a value found by the search.
        line: two pins; values are measured from the direction from the first to the second pin.
        at: the point in the body's own frame (m).
    """

    point: str = eqx.field(static=True)
    targets: np.ndarray = eqx.field(converter=_targets("targets", 2))
    values: np.ndarray | None = eqx.field(converter=_values, default=None)
    start: str = eqx.field(static=True, default="given")
    line: tuple[str, ...] = eqx.field(static=True, converter=_names_of_pins, default=())
    at: tuple[float, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        require_text("point", self.point)
        if self.at is not None:
            require_numbers("at", self.at, (2,), "two numbers, x and y in m")

    @property
    def has_place(self) -> bool:
        return True

    def check(self, mechanism):
        check_place(mechanism, self.point, self.at)

    def measure(self, mechanism, q):
        return jnp.stack(place_of(mechanism, self.point, self.at, q))

    def residual(self, measured, target, extras, xp):
        return [measured[..., 0] - target[..., 0], measured[..., 1] - target[..., 1]]


class PoseGoal(Goal):
    """A link passes through poses: one of its points reaches positions, and the link reaches angles.

    Angles are measured from one that the search determines; their residual is 2 `arm` sin(difference / 2), in m.

    Args:
        body: the link.
        targets: x, y (m) and angle (rad) of each pose (J, 3).
        arm: the length (m) that weights angles; by default the extent of the positions.
        pin: the pin of the link that passes through the positions; by default the link's origin, its centre of mass.
        values: values of the driver, as in a `PathGoal`.
        start: as in a `PathGoal`.
        line: as in a `PathGoal`.
    """

    body: str = eqx.field(static=True)
    targets: np.ndarray = eqx.field(converter=_targets("targets", 3))
    arm: float | None = eqx.field(static=True, default=None)
    pin: str | None = eqx.field(static=True, default=None)
    values: np.ndarray | None = eqx.field(converter=_values, default=None)
    start: str = eqx.field(static=True, default="given")
    line: tuple[str, ...] = eqx.field(static=True, converter=_names_of_pins, default=())

    def __check_init__(self):
        require_text("body", self.body)
        if self.arm is not None:
            require_number("arm", self.arm, "positive")
        if self.pin is not None:
            require_text("pin", self.pin)

    @property
    def extras(self) -> int:
        return 1

    @property
    def has_place(self) -> bool:
        return True

    def check(self, mechanism):
        if self.body not in mechanism.body_names:
            problem = f"goal: no body named {quote(self.body)}{suggestion(self.body, mechanism.body_names)}"
            raise SceneError([problem], mechanism.name)
        if self.pin is not None:
            check_place(mechanism, self.pin, None)

    def measure(self, mechanism, q):
        place = place_of(mechanism, f"body.{self.body}" if self.pin is None else f"joint.{self.pin}", None, q)
        return jnp.stack([*place, q[mechanism.body_names.index(self.body), 2]])

    def residual(self, measured, target, extras, xp):
        arm = float(np.max(np.ptp(self.targets[:, :2], axis=0))) if self.arm is None else self.arm
        turn = measured[..., 2] - target[..., 2] - extras[..., 0]
        return [measured[..., 0] - target[..., 0], measured[..., 1] - target[..., 1], 2.0 * arm * xp.sin(0.5 * turn)]


class FunctionGoal(Goal):
    """A coordinate is a function of the driver. Output and input values are each measured from their own start.

    Args:
        output: the coordinate, such as `body.rocker.angle`, named as for `kinematics`.
        values: values of the driver (rad, m).
        targets: the output at each value (rad, m).
        start: "free": the driver's values count from a value found by the search; "given": from zero.
        output_start: "free": the targets count from an output found by the search; "given": from zero.
        line: as in a `PathGoal`.
    """

    output: str | Coordinate = eqx.field(static=True)
    values: np.ndarray | None = eqx.field(converter=_values)
    targets: np.ndarray = eqx.field(converter=_targets("targets", 1))
    start: str = eqx.field(static=True, default="free")
    output_start: str = eqx.field(static=True, default="free")
    line: tuple[str, ...] = eqx.field(static=True, converter=_names_of_pins, default=())

    def __check_init__(self):
        if self.values is None:
            raise ValueError("give values: those of the driver at which the output has its targets")
        if not isinstance(self.output, Coordinate):
            require_text("output", self.output)
        require_choice("output_start", self.output_start, ("given", "free"))

    @property
    def extras(self) -> int:
        return int(self.output_start == "free")

    def check(self, mechanism):
        value_of(mechanism, self.output)

    def measure(self, mechanism, q):
        return jnp.reshape(value_of(mechanism, self.output)(q), (1,))

    def residual(self, measured, target, extras, xp):
        return [measured[..., 0] - target[..., 0] - (extras[..., 0] if self.extras else 0.0)]


def goal_scale(goal: Goal, mechanism: Mechanism) -> float:
    """Return the scale of the residuals: the extent of the targets (m); for a function one radian or metre."""
    if not goal.has_place:
        return 1.0
    extent = float(np.max(np.ptp(goal.targets[:, :2], axis=0)))
    return extent if extent > 0 else float(np.max(np.ptp(np.asarray(mechanism.q0)[:, :2], axis=0), initial=0.0)) or 1.0
