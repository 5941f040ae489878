"""A coordinate that drives a mechanism through its positions: the value s of the coordinate replaces time.

With a driver that prescribes `coordinate = t`, Psi(s, q) = 0 are the positions, Psi_dot = 0 gives dq/ds, and Psi_q a = gamma
gives d2q/ds2, as for any other mechanism.
"""

import itertools
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, PyTree

from udkjax.annotations import Number, NumberLike
from udkjax.arrays import is_traced, make_module, number, number_called
from udkjax.equations import constraints
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.rows.dense_rows import DenseTerms, KinematicRows
from udkjax.equations.rows.redundancy import holders_of_driver
from udkjax.pinv.row_spaces import null_space
from udkjax.positions.assembling.coordinates import Coordinate, constant_motion, named_element, value_of
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.elements.drivers import Driver, Motion, Polynomial
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.origin import Origin
from udkjax.scene.tables.checks import SceneError
from udkjax.scene.tables.position_only import refuse_rolling
from udkjax.wording import join_names, quote

MOTION_TOL = 1e-6  # relative to the longest free direction, in the metric of the links' arms and radians; less is rounding
Drive = str | Coordinate | None  # the name of a driver or coordinate, a coordinate; None: all drivers along time


class ValueMotion(Motion):
    """The motion law origin + t: time is the value of a coordinate, counted from `origin` (rad, m)."""

    origin: Float[Array, ""] = eqx.field(converter=number_called("origin"), default=0.0)

    def __call__(self, t: NumberLike) -> Float[Array, ""]:
        return self.origin + t


class Driven(NamedTuple):
    """A mechanism driven by a value s instead of time."""

    mechanism: Mechanism
    analysis: Analysis
    name: str  # name of the driver; empty if s is time
    row: int  # row of the driver in Psi; -1 if s is time
    unit: Number  # the unit of s: one radian, the characteristic length or the characteristic time

    @property
    def is_angle(self) -> bool:
        """True if s is an angle."""
        return bool(self.name) and self.mechanism.drivers[self.name].coordinate == "angle"

    @property
    def value_unit(self) -> str:
        """The unit of s: "rad", "m" or "s"."""
        return "rad" if self.is_angle else "m" if self.name else "s"

    def value(self, q: Float[Array | np.ndarray, "n"] | Float[Array | np.ndarray, "bodies 3"]) -> Float[Array, ""]:
        """Return the value of the coordinate (rad, m) in a position, by NumPy if all numbers are concrete."""
        if is_traced((self.mechanism, q)):
            return constraints.psi(self.mechanism, 0.0, q)[self.row]
        return DenseTerms.of(self.mechanism).psi(0.0, np.ravel(q))[self.row]


def drive(mechanism: Mechanism, driver: Drive, t: NumberLike = 0.0, held: Mapping[str, NumberLike] | None = None) -> Driven:
    """Return a mechanism as driven by one coordinate, while other drivers keep their values of time t (s).

    `held` has, by name, other values for these drivers, or values of further coordinates. If `driver` is None, all drivers move
    along time. Raises `SceneError` if there is no such driver or coordinate, or positions do not follow from its value.
    """
    refuse_rolling(mechanism, "positions do not follow from a driver")
    if not mechanism.is_concrete or is_traced((driver, t, held)):
        return _drive(mechanism, driver, t, held)
    pairs = [(name, np.asarray(value, float).item()) for name, value in (held or {}).items()]
    return _drive_concrete(mechanism, driver, np.asarray(t, float).item(), *itertools.chain(*pairs))


@cached_by_identity
def _drive_concrete(mechanism: Mechanism, driver: Drive, t: float, *held: Any) -> Driven:
    """Return the result of `drive` for concrete numbers; `held` has names and values in turn, which the cache compares."""
    with jax.ensure_compile_time_eval():  # concrete even while something else is traced
        return _drive(mechanism, driver, t, dict(zip(held[::2], held[1::2], strict=True)))


def _drive(mechanism: Mechanism, driver: Drive, t: NumberLike, held: Mapping[str, NumberLike] | None) -> Driven:
    if driver is None:
        if held:
            problem = "held is given with driver=None, which moves all drivers along time: name the one that drives"
            raise SceneError([problem], mechanism.name)
        analysis = analyse(mechanism)
        if not mechanism.drivers and analysis.degrees_of_freedom != 0:  # or unknown, since numbers are traced
            problem = "driver is None, and the scene has no driver: name a coordinate that drives it, such as"
            raise SceneError([f"{problem} {_suggested_coordinate(mechanism)}"], mechanism.name)
        _require_determinate(mechanism, analysis, "all drivers")
        rate = analysis.scales.rate
        return Driven(mechanism.without_origin, analysis, "", -1, jnp.where(rate > 0, 1 / jnp.where(rate > 0, rate, 1.0), 1.0))
    names: dict[str, str] = {}  # names of coordinates by the drivers that hold them
    for key, value in (held or {}).items():
        try:
            holder, element = named_element(mechanism, key)
        except SceneError as error:
            raise SceneError([f"held: {problem}" for problem in error.problems], mechanism.name) from None
        names[holder] = f"{quote(key)}, which `held` gives"
        mechanism = _with_driver(mechanism, holder, element, constant_motion(value))
    name, element = named_element(mechanism, driver)
    driven = _add_driver(mechanism, name, element, t)
    concrete = _from_guess(driven, name)
    analysis = analyse(concrete)
    driver_text = driver if isinstance(driver, str) else f"the {element.coordinate} of {' and '.join(element.bodies)}"
    if concrete.is_concrete and analysis.redundant_rows != ():
        with jax.ensure_compile_time_eval():  # concrete even while something else is traced
            require_free(concrete, name, driver_text, names)
    _require_determinate(driven, analysis, driver_text)
    row = next(k for k, (owner, _) in enumerate(analysis.row_names) if owner == name)
    rows = analysis.scales.rows
    unit = rows[row] if isinstance(rows, Tracer) else number(np.asarray(rows)[row])
    return Driven(driven.without_origin, analysis, name, row, unit)


def constant_speed(mechanism: Mechanism, driver: str) -> float:
    """Return the constant speed (rad/s, m/s) of a driver; 0 if its speed is not constant, or if there is no such driver."""
    motion = mechanism.drivers[driver].motion if driver in mechanism.drivers else None
    return float(np.asarray(motion.coefficients)[1]) if isinstance(motion, Polynomial) and len(motion.coefficients) == 2 else 0.0


def only_driver(mechanism: Mechanism) -> str:
    """Return the name of the only driver; raise `SceneError` unless there is exactly one."""
    names = mechanism.driver_names
    if len(names) == 1:
        return names[0]
    problem = f"driver: the scene has {len(names)} drivers; name one of {', '.join(names)}"
    if not names:
        problem = f"driver: the scene has no driver; name a coordinate, such as {_suggested_coordinate(mechanism)}"
    raise SceneError([problem], mechanism.name)


def without_drivers(mechanism: Mechanism, forces: Mapping[str, ForceElement] | None = None) -> Mechanism:
    """Return the mechanism without its drivers; if `forces` is not None, these replace its forces."""
    return _without_drivers(mechanism) if forces is None else _with_forces_alone(mechanism, forces)


@cached_by_identity(within_trace=True)  # so that later calls reuse its analysis
def _without_drivers(mechanism: Mechanism) -> Mechanism:
    return _with_forces_alone(mechanism, None)


def _with_forces_alone(mechanism: Mechanism, forces: Mapping[str, ForceElement] | None) -> Mechanism:
    with jax.ensure_compile_time_eval():
        origin = mechanism.origin and Origin(with_drivers(mechanism.origin.mechanism, {}))
    return with_drivers(mechanism, {}, forces, origin)


def _add_driver(mechanism: Mechanism, name: str, element: Coordinate, t: NumberLike) -> Mechanism:
    """Return the mechanism with a driver of this name that follows the value s; all others hold their values of time t (s)."""
    concrete = mechanism.origin and mechanism.origin.mechanism
    with jax.ensure_compile_time_eval():
        origin = concrete and Origin(_add_driver(concrete, name, _concrete_element(concrete, name, element), _value_or(t, 0.0)))
    return with_drivers(mechanism, {**_halted(mechanism, t), name: element.driver(ValueMotion())}, origin=origin)


def with_halted_drivers(mechanism: Mechanism, t: NumberLike, q: Any = None) -> Mechanism:
    """Return the mechanism whose drivers hold their values of time t (s), or those of a position q (bodies, 3) if it is given."""
    return mechanism.with_drivers(_halted(mechanism, t, q))


def _halted(mechanism: Mechanism, t: NumberLike, q: Any = None) -> dict[str, Driver]:
    def halted(name: str, driver: Driver) -> Driver:
        value: Any = driver.motion(number(t)) if q is None else value_of(mechanism, name)(q)
        return eqx.tree_at(lambda d: d.motion, driver, constant_motion(value))

    return {name: halted(name, driver) for name, driver in mechanism.drivers.items()}


def _with_driver(mechanism: Mechanism, name: str, element: Coordinate, motion: Polynomial) -> Mechanism:
    """Return the mechanism with a driver of this name, coordinate and motion, which replaces a driver of the same name."""
    drivers = {**mechanism.drivers, name: element.driver(motion)}
    concrete = mechanism if mechanism.is_concrete else mechanism.origin and mechanism.origin.mechanism
    result = with_drivers(mechanism, drivers)
    if concrete is None or result.is_concrete:
        return result
    with jax.ensure_compile_time_eval():
        element = _concrete_element(concrete, name, element)
        # For the analysis, the coordinate is held at its value of the guess.
        motion = constant_motion(value_of(concrete, element)(concrete.q0))
        of_origin = {**concrete.drivers, name: element.driver(motion)}
        return with_drivers(mechanism, drivers, origin=Origin(with_drivers(concrete, of_origin)))


def with_drivers(
    mechanism: Mechanism,
    drivers: Mapping[str, Driver],
    forces: Mapping[str, ForceElement] | None = None,
    origin: Origin | None = None,
) -> Mechanism:
    """Return the mechanism with `drivers` instead of its drivers and, if `forces` is not None, `forces` instead of its forces.

    If numbers are traced, `origin` is the concrete mechanism from which redundant rows are determined.
    """
    if forces is None and not drivers:
        return mechanism.with_drivers({}, origin)
    changed = {"driver": drivers} if forces is None else {"driver": drivers, "force": forces}
    return mechanism.with_elements(mechanism.groups | changed, origin=origin)


def _concrete_element(concrete: Mechanism, name: str, element: Coordinate) -> Coordinate:
    """Return a coordinate with a concrete axis and points: those of the driver of this name, or zeros for traced ones."""
    if name in concrete.drivers:
        return Coordinate.of(concrete.drivers[name])
    return jax.tree.map(lambda x: jnp.zeros(x.shape) if isinstance(x, Tracer) else x, element)


def _from_guess(mechanism: Mechanism, name: str) -> Mechanism:
    """Return the concrete mechanism, if known, with the named driver at its value of the initial guess at time zero.

    An analysis closes the mechanism at time zero.
    """
    mechanism = mechanism if mechanism.origin is None else mechanism.origin.mechanism
    with _at_once(mechanism):
        value = jax.lax.stop_gradient(value_of(mechanism, name)(mechanism.q0))
        driver = make_module(Driver, **vars(mechanism.drivers[name]) | {"motion": ValueMotion(value)})
        return with_drivers(mechanism, {**mechanism.drivers, name: driver})


def _at_once(given: PyTree) -> AbstractContextManager:
    """Return a context in which JAX evaluates at once even while something else is traced, if `given` is concrete."""
    traced = is_traced(given)
    return nullcontext() if traced else jax.ensure_compile_time_eval()


def _value_or(x: NumberLike, otherwise: float) -> NumberLike:
    return otherwise if isinstance(x, Tracer) else x


def _require_determinate(mechanism: Mechanism, analysis: Analysis, driven: str) -> None:
    free = analysis.degrees_of_freedom
    if free:
        problem = f"driven by {driven}, it keeps {free} degree{'s' * (free > 1)} of freedom: its positions do not follow"
        loose = [body for body, moves in free_motion(mechanism).items() if moves.any()] if mechanism.is_concrete else []
        those = f"what still moves, {join_names(loose)}," if 0 < len(loose) < len(mechanism.bodies) else "the others"
        raise SceneError([f"{problem}; drive or hold {those} by drivers of the scene"], mechanism.name)


def free_motion(mechanism: Mechanism) -> dict[str, Bool[np.ndarray, "3"]]:
    """Return for each body a mask of the coordinates x, y, angle that can move at the initial guess."""
    rows = KinematicRows(mechanism)
    free = null_space(rows.at(0.0, np.ravel(mechanism.q0))[2], MOTION_TOL)
    moves = np.linalg.norm(free, axis=0).reshape(-1, 3) > MOTION_TOL
    return dict(zip(mechanism.body_names, moves, strict=True))


def _suggested_coordinate(mechanism: Mechanism) -> str:
    """Return the name of a coordinate that moves and can be driven, preferably an angle; if numbers are traced, of any angle."""
    moves = free_motion(mechanism) if mechanism.is_concrete else {}
    free = [f"body.{body}.{name}" for k, name in ((2, "angle"), (0, "x"), (1, "y")) for body in moves if moves[body][k]]
    return (free or [f"body.{mechanism.body_names[0]}.angle"])[0]


def require_free(driven: Mechanism, name: str, driver: str, names: Mapping[str, str]) -> None:
    """Raise an error if the joints and the other drivers hold the coordinate of a driver.

    The coordinate is held if its row of Psi_q depends on their rows in a generic configuration.

    Args:
        driven: the mechanism with the driver; its numbers are concrete.
        name: name of the driver in the mechanism.
        driver: the name of the driver in the message.
        names: names of other drivers in the message, if not their own.

    Raises:
        SceneError: the coordinate is held; the message names the drivers that hold it.
    """
    involved = holders_of_driver(driven, name)
    if involved is None:
        return
    holding = [names.get(other, f"driver {quote(other)}") for other in driven.driver_names if other in involved]
    if not holding:
        raise SceneError([f"{driver} cannot be driven: the joints leave it no motion"], driven.name)
    cure = "drive that, or take it out of the scene" if len(holding) == 1 else "drive one of them, or take one out of the scene"
    raise SceneError([f"{driver} is held by {join_names(holding)}: {cure}"], driven.name)
