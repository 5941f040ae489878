"""The variables of an FMU: names, units and places, in the order of their value references in sources/fmu.c."""

import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.integrate.portable.c.scene import SceneCode
from udkjax.integrate.portable.parameters import NumberProgram, scalar_parameters, traced_program
from udkjax.native.language.ir import Function
from udkjax.native.language.program import vector_function
from udkjax.positions.assembling.channel_values import measure
from udkjax.positions.assembling.channels import Channel, channel_of, channels_of
from udkjax.requirements import ArgumentError
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.forces import Force, Torque
from udkjax.scene.elements.held import Held
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError

COLUMNS = ("x", "y", "angle"), ("vx", "vy", "omega"), ("ax", "ay", "alpha")  # of a body, as in tables of runs
UNITS = ("m", "m", "rad"), ("m/s", "m/s", "rad/s"), ("m/s2", "m/s2", "rad/s2")
INPUT_FIELDS = {Torque: "value", Force: "vector"}  # numbers of force elements that are inputs unless others are named
INPUT_FIELD_NAMES = ("value", "vector", "torque", "force")  # their names in scenes and in drawings
START_FIELDS = ("position", "angle", "velocity", "angular_velocity")  # of a body: the start values of states


class FMUVariable(NamedTuple):
    """A variable of an FMU, with its start value; None if the value is calculated."""

    name: str
    unit: str
    start: float | None = None


class MeasuredState(NamedTuple):
    """A state as a motion with one output time, so that channels can measure it."""

    ts: Array
    q: Array
    v: Array


class FMUVariables:
    """The variables of an FMU of a scene.

    Attributes:
        coordinates: positions, velocities and accelerations, one list after the other.
        states: the integrated state, positions before velocities, with start values.
        rates: the derivatives of the states.
        parameters: numbers that can be set before a run.
        inputs: numbers that can be set during a run.
        measures: further outputs.
    """

    def __init__(
        self,
        scene: SceneCode,
        parameters: Sequence[str] | None,
        inputs: Sequence[str] | None,
        outputs: Sequence[str] | None,
    ):
        bodies, given = scene.mechanism.body_names, scene.mechanism
        self.coordinates = [
            FMUVariable(f"body.{body}.{name}", unit)
            for names, units in zip(COLUMNS, UNITS, strict=True)
            for body in bodies
            for name, unit in zip(names, units, strict=True)
        ]
        start = np.concatenate([scene.inputs["q"], scene.inputs["v"]])
        n = len(start) // 2
        states, rates = self.coordinates[: 2 * n], self.coordinates[n:]
        self.states = [FMUVariable(f"state.{x.name}", x.unit, float(y)) for x, y in zip(states, start, strict=True)]
        self.rates = [FMUVariable(f"der(state.{x.name})", y.unit) for x, y in zip(states, rates, strict=True)]
        named = _controlled(given) if inputs is None else inputs
        chosen = scalar_parameters(given, named)
        values = _parameters(given) if parameters is None else scalar_parameters(given, parameters)
        both = sorted(set(chosen) & set(values)) if parameters is not None else []
        if both:
            raise ArgumentError(f"{', '.join(both)}: an input is no parameter as well; name it in one of the two")
        self.inputs = [FMUVariable(name, _unit(given, name), value) for name, value in chosen.items()]
        kept = {name: value for name, value in values.items() if name not in chosen}
        self.parameters = [FMUVariable(name, _unit(given, name), value) for name, value in kept.items()]
        self._mechanism, self._channels = given, _channels(given, outputs, {x.name for x in self.coordinates})
        self.measures = [FMUVariable(channel.name, channel.units) for channel in self._channels]

    @property
    def values(self) -> list[FMUVariable]:
        """The parameters and the inputs."""
        return [*self.parameters, *self.inputs]

    def measure(self) -> Function:
        """Return the function `measure(at, found)`, which computes the measures.

        `at` has the values, q and v, then their changes; `found` receives the measures, then their changes.
        """
        names, n = [x.name for x in self.values], len(self.states)
        length = len(names) + n

        def of(x: Array) -> Array:
            given = self._mechanism.with_parameters({name: x[k] for k, name in enumerate(names)})
            q, v = x[len(names) :].reshape(2, 1, -1, 3)
            return measure(given, MeasuredState(jnp.zeros(1), q, v), self._channels)[0]

        def both(x: Array) -> Array:
            return jnp.concatenate(jax.jvp(of, (x[:length],), (x[length:],)))

        program, places = traced_program(both, 2 * length)
        return vector_function(program, "measure", "at", "found", places)


def _channels(mechanism: Mechanism, names: Sequence[str] | None, known: Collection[str]) -> list[Channel]:
    """Return the channels of the requested outputs that are not `known`; None: positions and velocities of all moving pins."""
    if names is None:
        found = [channel_of(mechanism, name) for name in channels_of(mechanism) if name.startswith("pin.")]
        return [x for x in found if x.needs == "states" and x.bodies != (GROUND,)]
    try:
        found = {x.name: x for x in (channel_of(mechanism, name) for name in names)}
    except ValueError as error:
        raise ArgumentError(f"outputs: {error}") from None
    if wrong := [name for name, x in found.items() if x.needs != "states" or {*x.bodies} == {GROUND}]:
        raise ArgumentError(f"outputs are positions and velocities of moving points: leave out {', '.join(wrong)}")
    return [x for name, x in found.items() if name not in known]


def least_of(mechanism: Mechanism, name: str) -> str:
    """Return the constant of fmu.c that says which values a parameter may have: ANY_NUMBER, NOT_NEGATIVE or POSITIVE."""
    if not mechanism.must_be_positive(name):
        return "ANY_NUMBER"
    try:
        mechanism.with_parameters({name: 0.0})
    except SceneError:
        return "POSITIVE"
    return "NOT_NEGATIVE"


def _unit(mechanism: Mechanism, name: str) -> str:
    unit = mechanism.unit_of(name)
    return "" if unit == "1" else unit


def _controlled(mechanism: Mechanism) -> list[str]:
    """Return the names of the constant torques and forces, by which a controller acts on the scene."""
    found = []
    for name in mechanism.independent_parameters():
        section, _, rest = name.partition(".")
        owner, _, field = rest.rpartition(".")
        element = mechanism.forces.get(owner)
        own = INPUT_FIELDS.get(type(element)) if section in ("force", "load") else None
        if own and field in INPUT_FIELD_NAMES and not isinstance(getattr(element, own), Held):
            found.append(name)
    return found


def _parameters(mechanism: Mechanism) -> dict[str, float]:
    """Return the parameters of a scene with their values.

    Poses and velocities are left out, as are parameters that move times at which the motion is not smooth.
    """
    found = scalar_parameters(mechanism)
    values = {k: x for k, x in found.items() if not re.match(rf"body\..*\.({'|'.join(START_FIELDS)})(\[|$)", k)}
    values = {k: x for k, x in values.items() if not k.endswith(".velocity") and ".velocity[" not in k}
    if _moves_times(mechanism, values):
        values = {k: x for k, x in values.items() if not _moves_times(mechanism, {k: x})}
    return values


def _moves_times(mechanism: Mechanism, values: dict[str, float]) -> bool:
    program = NumberProgram(mechanism, values, lambda given: given.without_origin)
    return any(k >= program.count for k in program.changing_numbers)
