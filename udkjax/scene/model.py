"""The questions that runs and studies ask of a model of either kind: a `Mechanism`, or a user-defined system.

Questions that need the equations of motion are answered, for both kinds, by `equations_of` and `analysis_of` in
`udkjax/equations`.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Self

from jaxtyping import Array, Float

from udkjax.annotations import Numbers, NumericArray, Time
from udkjax.arrays import QuickMethods
from udkjax.requirements import ArgumentError
from udkjax.scene.numbers.number_fields import NumberField, must_be_positive
from udkjax.scene.numbers.units import units_of
from udkjax.wording import join_names, quote

_NO_NUMBERS: Mapping[str, Any] = MappingProxyType({})


class RunModel(QuickMethods):
    """The questions that a run asks of a model. By default it has coordinates alone: no bodies, elements or sampled numbers.

    Attributes:
        has_bodies: True if coordinates are those of bodies, and rows those of joints and drivers.
        has_programs: True if programs are generated from the model; False if it has functions of JAX alone.
        body_names: the names of the bodies, in the order of coordinates.
    """

    has_bodies: ClassVar[bool] = False
    has_programs: ClassVar[bool] = True
    body_names: ClassVar[tuple[str, ...]] = ()

    @property
    @abstractmethod
    def breakpoints(self) -> Float[Array, "k"] | None:
        """The times (s) where the motion is not smooth; None if it is smooth."""

    @property
    @abstractmethod
    def is_concrete(self) -> bool:
        """True if no number is traced."""

    @property
    def constraints(self) -> Mapping[str, Any]:
        """The joints and drivers by name, in the order of the rows."""
        return _NO_NUMBERS

    @property
    def forces(self) -> Mapping[str, Any]:
        """The force elements by name."""
        return _NO_NUMBERS

    @property
    def coordinate_count(self) -> int:
        """The number n of coordinates."""
        raise NotImplementedError

    def state_shape(self, state: object = None) -> tuple[int, ...]:
        """Return the shape of the coordinates: (bodies, 3), or that of a user-defined system.

        The latter follows from the coordinates of `state`, or of the initial guess if `state` is None; () if neither is known.
        """
        return (self.coordinate_count,)

    @property
    def may_have_kinks(self) -> bool:
        """True if the model's loads may have jumps or kinks, which a run has to locate."""
        return False

    @property
    def massless(self) -> tuple[str, ...]:
        """The names of the links of a drawing for which no mass is given; positions, velocities and driven motions need none."""
        return ()

    def require_masses(self, asked_by: str, cure: str = "") -> None:
        """Require masses of all links.

        Args:
            asked_by: The results that depend on masses, in the plural: "reactions".
            cure: Another cure than a mass: "let motors determine the motion".

        Raises:
            ArgumentError: A link has no mass.
        """
        if names := self.massless:
            links, lacks = join_names([quote(name) for name in names]), "has" if len(names) == 1 else "have"
            cures = "give each a density with a thickness, or a mass" + (f", or {cure}" if cure else "")
            raise ArgumentError(f"{links} {lacks} no mass, on which {asked_by} depend: {cures}")

    @property
    def without_origin(self) -> Self:
        """The model from which programs are generated, without anything that does not enter the equations."""
        return self

    def without_origin_beside(self, names: Sequence[str]) -> Self:
        """Return the model for programs in which the numbers of these names change: `without_origin`, if that is possible.

        If these numbers determine others, the result keeps the parts of the model from which those follow.
        """
        return self.without_origin

    def at(self, t: Time) -> Self:
        """Return the model with the values of sampled numbers at time t (s)."""
        return self

    def with_samples(self, samples: Mapping[Any, Any]) -> Self:
        """Return the model with other sampled numbers, by the places of `Mechanism.samples`."""
        return self

    def require_bodies(self, message: str) -> None:
        """Raise an `ArgumentError` with this message if the model has no bodies."""
        if not self.has_bodies:
            raise ArgumentError(message)


class Model(RunModel):
    """The questions that a study asks of a model in addition: its numbers by name, and its initial guess.

    Attributes:
        name: the name, for titles.
    """

    name: ClassVar[str] = "system"

    @property
    @abstractmethod
    def q0(self) -> Float[Array, "..."] | None:
        """The initial guess of the coordinates; None if the model has none, so that states must be given."""

    @property
    @abstractmethod
    def v0(self) -> Float[Array, "..."] | None:
        """The initial guess of the velocities; None if the model has none."""

    @abstractmethod
    def number_fields(self) -> Mapping[str, NumberField]:
        """Return all numbers by name, with their shapes, including absent ones."""

    def unit_of(self, name: str) -> str:
        """Return the unit of a parameter or of a setting of a run; an empty string if unknown."""
        return units_of(self, name)

    def must_be_positive(self, name: str) -> bool:
        """Return True for a number, or an entry of one, that its type requires to be positive or zero."""
        return must_be_positive(self, name)

    def parameters(self) -> dict[str, Array]:
        """Return the values of all numbers by name."""
        return {name: p.value for name, p in self.number_fields().items() if p.value is not None}

    @abstractmethod
    def with_parameters(self, values: Mapping[str, Numbers]) -> Self:
        """Return the model with new values of some numbers, or of their entries."""

    @abstractmethod
    def with_guess(self, q: NumericArray, v: NumericArray) -> Self:
        """Return the model with another initial guess."""

    def traced(self, n: int) -> Any:
        """Return the model from which programs are generated, for n coordinates: a `TracedSystem` for a `ConstrainedSystem`.

        Other models return themselves, and so do all models without float64.
        """
        return self
