"""Mechanisms and systems in which named coordinates and velocities have given values, for `assemble`.

A given coordinate is a constant driver, or a row of Psi; a given velocity is a driver that moves on, or a row of phi. Positions
are closed first, with the coordinates alone, so that a coordinate may be given without its velocity.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import NumberLike
from udkjax.arrays import is_traced, number
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.positions.assembling.channels import RATES, channel_of
from udkjax.positions.assembling.coordinates import Coordinate, coordinate_of, value_of
from udkjax.printing import format_number
from udkjax.requirements import ArgumentError, describe, require_text
from udkjax.scene.elements.bodies import COORDINATES
from udkjax.scene.elements.drivers import Polynomial
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.origin import Origin
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote

GivenValues: TypeAlias = Mapping[str, NumberLike]
_Motions: TypeAlias = Mapping[str, tuple[Coordinate, Sequence[Array]]]  # by name, coefficients of powers of the time
_COORDINATE_OF: dict[str, str] = dict(zip(RATES, COORDINATES, strict=True))  # vx: x, ...


class GivenState:
    """The given values of a model, by name, as conditions on its position and on its velocity.

    Args:
        model: A mechanism, or a `ConstrainedSystem`.
        given: Values by name: `body.link1.angle`, `joint.A.omega`, `q[0]`, `v[0]`.

    Raises:
        ArgumentError: a name is unknown, or of another quantity; or a value is not a number.
    """

    def __init__(self, model: Mechanism | ConstrainedSystem, given: GivenValues):
        if not isinstance(given, Mapping):
            raise ArgumentError(f"given must map names to values, such as {{'q[0]': 1.0}}, {describe(given)}")
        for name in given:
            require_text("given: a name", name)
        self.model = model
        self.values = {name: _value_called(name, value) for name, value in given.items()}
        self._conditions: Any = _GivenCoordinates(model) if isinstance(model, Mechanism) else _GivenEntries(model)
        self.parsed = {name: self._conditions.parse(name) for name in given}

    def __str__(self) -> str:
        return ", ".join(f"{name} = {format_number(float(value))}" for name, value in self.values.items())

    def at_position(self) -> Any:
        """Return the model with constraints that give its position the given coordinates; the model itself if none are given."""
        return self._imposed(False)

    def at_velocity(self, t: NumberLike, q: Array) -> Any:
        """Return the model with constraints that give it the given velocities at time t (s) in the position q.

        If no velocities are given, the model itself is returned.
        """
        return self._imposed(True, t, q)

    def _imposed(self, rates: bool, *at: Any) -> Any:
        known = {name: (where, self.values[name]) for name, (is_rate, where) in self.parsed.items() if is_rate == rates}
        return self._conditions.impose(known, *at) if known else self.model


class _GivenEntries(NamedTuple):
    """The conditions that entries of q and v of a `ConstrainedSystem` have given values, as additional rows of Psi and phi."""

    model: ConstrainedSystem

    def parse(self, name: str) -> tuple[bool, int]:
        """Return True for the name of a velocity (`v[0]`), False for a coordinate (`q[0]`), and the index of the entry."""
        try:
            channel = channel_of(self.model, name)
        except ValueError as problem:
            raise ArgumentError(f"given: {problem}") from None
        return channel.owner == "v", int(channel.quantity)

    def impose(self, entries: Mapping[str, tuple[int, Array]], *at: Any) -> ConstrainedSystem:
        """Return the system with additional rows, by which entries have given values.

        Args:
            entries: the index and the value of each entry, by name.
            at: nothing, for entries of q; t and q, for entries of v.
        """
        places, values = np.array([k for k, _ in entries.values()]), jnp.stack([value for _, value in entries.values()])
        name = "velocity_constraint" if at else "constraint"
        old = getattr(self.model, name)

        def rows(*state: Any) -> Any:
            own, more = {} if old is None else old(*state), state[-1][places] - values
            if isinstance(own, Mapping):
                return {**own, "given": more}
            return jnp.concatenate([jnp.atleast_1d(jnp.asarray(own)), more])

        return replace(self.model, **{name: rows})


class _GivenCoordinates(NamedTuple):
    """The conditions that coordinates and velocities of a mechanism have given values, as additional drivers."""

    model: Mechanism

    def parse(self, name: str) -> tuple[bool, Coordinate]:
        """Return True for the name of a velocity and False for that of a coordinate, and the (differentiated) coordinate."""
        owner, _, last = name.strip().rpartition(".")
        try:
            coordinate = coordinate_of(self.model, f"{owner}.{_COORDINATE_OF.get(last, last)}")
        except SceneError as error:
            problem = error.problems[0].partition(": ")[2] or error.problems[0]
            cure = "give coordinates such as body.NAME.angle or joint.NAME.angle, and velocities such as body.NAME.omega"
            raise ArgumentError(f"given: {quote(name)} is neither a coordinate nor a velocity ({problem}); {cure}") from None
        return last in RATES, coordinate

    def impose(self, coordinates: Mapping[str, tuple[Coordinate, Array]], *at: Any) -> Mechanism:
        """Return the mechanism with additional drivers, by which coordinates have given values or rates.

        Args:
            coordinates: the coordinate and its value or rate, by name.
            at: nothing, if values are given; t and q, if rates at this time and position are given.
        """
        motions = {
            name: (c, [value_of(self.model, c)(at[1]) - x * at[0], x] if at else [x]) for name, (c, x) in coordinates.items()
        }
        if not self.model.is_concrete or not is_traced(motions):
            return self._driven(motions)
        # As of other mechanisms whose numbers have become traced, the redundant rows are those of a concrete one, here with the
        # values of its guess: where they are unknown, machine code has no second derivatives.
        with jax.ensure_compile_time_eval():
            values = {name: value_of(self.model, c)(self.model.q0) for name, (c, _) in coordinates.items()}
            guessed = {name: (c, [values[name], *map(jnp.zeros_like, x[1:])]) for name, (c, x) in motions.items()}
            origin = Origin(self._driven(guessed))
        return self._driven(motions, origin)

    def _driven(self, motions: _Motions, origin: Origin | None = None) -> Mechanism:
        """Return the mechanism with additional drivers, whose motions are polynomials of time.

        If numbers are traced, `origin` is the concrete mechanism from which redundant rows are determined.
        """
        more = {f"given {name}": c.driver(Polynomial(jnp.stack(x))).complete() for name, (c, x) in motions.items()}
        return self.model.with_drivers({**self.model.drivers, **more}, origin)


def _value_called(name: str, value: Any) -> Float[Array, ""]:
    try:
        found = number(value)
    except (TypeError, ValueError):
        found = None
    if found is None or np.shape(found) != ():
        raise ArgumentError(f"given[{quote(name)}] must be a number, {describe(value)}")
    return found
