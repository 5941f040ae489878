"""Numbers that are held between samples: what a digital controller puts out, or a table of measured forces."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.printing import PrintsLine
from udkjax.scene.fields import NOT_EMPTY, POSITIVE, Number, given_number

Sampled = Float[Array, "..."] | float  # a number or a vector, which may be a `Held`


class Held(PrintsLine):
    """A number, or a vector, that is held between samples (zero-order hold): values[k] from t0 + k dt to t0 + (k + 1) dt.

    Before t0 it is the first value, behind the last sample the last one. Steps of an integrator end at the samples. The values
    may be traced and differentiated; a run takes the same code and the same time per step, however many there are. A force
    element may have one in any of its fields; `torque.value`, `force.vector` and `torsion_spring.angle` of this package take one.

    Args:
        values: the samples (N,), or (N, 2) of a vector, in the unit of the number that they stand for.
        dt: the time between two samples (s), greater than zero.
        t0: the time of the first sample (s).
    """

    values: Float[Array, "n ..."] = eqx.field(converter=given_number, metadata=NOT_EMPTY)
    dt: float = eqx.field(static=True, metadata=POSITIVE)
    t0: float = eqx.field(static=True, default=0.0)

    def __post_init__(self):
        for name in ("dt", "t0"):
            value = getattr(self, name)
            try:
                object.__setattr__(self, name, float(value))
            except (TypeError, ValueError):  # traced, or no number: the mechanism says so
                continue

    def __call__(self, t: Number) -> Array:
        """Return the value at time t (s)."""
        if len(self.values) == 1:  # also where it stands for all samples: no operation
            return self.values[0]
        return self.values[jnp.searchsorted(jnp.asarray(self.breakpoints), t, side="right")]

    @property
    def breakpoints(self) -> Float[np.ndarray, "N-1"]:
        """The times (s) of the samples but the first."""
        return self.t0 + self.dt * np.arange(1, len(self.values))

    @property
    def first(self) -> "Held":
        """The first sample alone, in place of all: that has the structure of every one."""
        values = self.values[:1] if isinstance(self.values, jax.Array | np.ndarray) else self.values
        if isinstance(self.values, jax.ShapeDtypeStruct):
            values = jax.ShapeDtypeStruct((1, *self.values.shape[1:]), self.values.dtype)
        return make_held(values)


def given_sampled(value: Any) -> Any:
    """Convert a number of a field as `given_number` does; a `Held` stays as it is."""
    return value if isinstance(value, Held) else given_number(value)


def make_held(values: Any) -> Held:
    """Return one sample as a `Held`, whatever stands for its values."""
    held = object.__new__(Held)
    for name, value in {"values": values, "dt": 1.0, "t0": 0.0}.items():
        object.__setattr__(held, name, value)
    return held


def value_at(x: Sampled | Held, t: Number) -> Any:
    """Return a number at time t (s): that of a `Held`, or what does not depend on time as it is."""
    return x(t) if isinstance(x, Held) else x


def held_fields(elements: Sequence[eqx.Module]) -> list[tuple[int, str]]:
    """Return where the elements have a `Held`: the index of each with the name of the field."""
    return [(k, name) for k, e in enumerate(elements) for name, value in vars(e).items() if isinstance(value, Held)]
