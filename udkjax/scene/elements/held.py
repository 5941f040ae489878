"""Numbers that are held between samples: the output of a digital controller, or a table of measured forces.

Sampled numbers, including splines, are constant or cubic between breakpoints: a program contains one interval, and a run
replaces the numbers of the interval when it restarts after a breakpoint.
"""

import dataclasses
from collections.abc import Sequence
from functools import cache
from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import make_module
from udkjax.printing import PrintsLine
from udkjax.scene.elements.drivers import Motion, Spline
from udkjax.scene.elements.fields import NOT_EMPTY, POSITIVE, given_number
from udkjax.scene.elements.splines import spline_pieces


class Held(PrintsLine):
    """A number or vector that is held between samples (zero-order hold): values[k] from t0 + k dt to t0 + (k + 1) dt.

    The value is the first one before t0, and the last one after the last sample. Steps of the integrator end at the samples. The
    values may be traced and differentiated; code and time per step do not depend on their number. Any field of a force element
    may be a `Held`; in this package, `torque.value`, `force.vector` and `torsion_spring.angle` accept it.

    Args:
        values: the samples (N,), or (N, 2) for a vector, in the unit of the number that they replace.
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
            except (TypeError, ValueError):  # traced or not a number: the mechanism reports it
                continue

    def __call__(self, t: Number) -> Array:
        """Return the value at time t (s)."""
        if len(self.values) == 1:  # programs contain a single interval: no operation is needed
            return self.values[0]
        return self.values[jnp.searchsorted(jnp.asarray(self.breakpoints), t, side="right")]

    @property
    def breakpoints(self) -> Float[np.ndarray, "N-1"]:
        """The times (s) of all samples after the first."""
        return self.t0 + self.dt * np.arange(1, len(self.values))


def given_sampled(value: Any) -> Any:
    """Convert a number of a field as `given_number` does; a `Held` stays as it is."""
    return value if isinstance(value, Held) else given_number(value)


def value_at(x: Float[Array, "..."] | Held, t: Number) -> Any:
    """Return the value of a `Held` at time t (s); return any other number unchanged."""
    return x(t) if isinstance(x, Held) else x


# --- sampled numbers and motions as a table: one row of numbers per interval between breakpoints


class SplinePiece(Motion):
    """A spline between two knots: c0 + c1 s + c2 s^2 + c3 s^3, with s = t - start.

    Args:
        row: start (s), c0, c1, c2 and c3.
    """

    row: Float[Array, "5"]

    def __call__(self, t):
        start, *c = (self.row[k] for k in range(5))
        s = t - start
        return ((c[3] * s + c[2]) * s + c[1]) * s + c[0]


Sampled = Held | Spline


def sampled_fields(elements: Sequence[eqx.Module]) -> list[tuple[int, str]]:
    """Return the index of the element and the field of each sampled number: a `Held`, or a spline that is only called."""
    return [
        (k, name)
        for k, e in enumerate(elements)
        for name, value in vars(e).items()
        if isinstance(value, Held) or (isinstance(value, Spline) and name in _called_fields(type(e)))
    ]


@cache
def _called_fields(cls: type) -> frozenset[str]:
    return frozenset(field.name for field in dataclasses.fields(cls) if field.metadata.get("called"))


def row_size(x: Sampled) -> int:
    """Return the number of entries of a row of `rows_of`."""
    return 5 if isinstance(x, Spline) else int(np.prod(x.values.shape[1:]))


def rows_of(x: Sampled, xp: ModuleType) -> Any:
    """Return the numbers of all intervals between breakpoints, one row for each (intervals, `row_size`), by NumPy or JAX."""
    if isinstance(x, Spline):
        return spline_pieces(xp.asarray(x.times), xp.asarray(x.values), xp)
    return xp.reshape(xp.asarray(x.values), (len(x.values), row_size(x)))


def with_row(x: Sampled, row: Any) -> Any:
    """Return a `Held` or a `SplinePiece` with a single interval, from its row of numbers.

    The row may also be None or another object that stands for numbers.
    """
    if isinstance(x, Spline):
        return make_module(SplinePiece, row=row)
    return make_module(Held, values=row.reshape(1, *x.values.shape[1:]) if hasattr(row, "reshape") else row, dt=1.0, t0=0.0)


def row_at(x: Sampled, t: Any, xp: ModuleType) -> Any:
    """Return the row of `rows_of` for the interval that contains time t (s)."""
    return rows_of(x, xp)[xp.searchsorted(xp.asarray(x.breakpoints, float), t, side="right")]
