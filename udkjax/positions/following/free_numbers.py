"""Free numbers of a mechanism as one vector: the numbers that differ in a batch, or that a design varies."""

from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.equations import constraints
from udkjax.positions.following.drive import Drive, drive
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.number_fields import split_index
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote, suggestion


class FreeNumbers:
    """Some numbers of a mechanism by name (`pin.A`, `pin.C[0]`, `link.crank.width`), and all of their entries as one vector.

    Args:
        mechanism: the mechanism.
        names: names of the free numbers.

    Raises:
        SceneError: a name does not belong to a number, or is given twice.
    """

    def __init__(self, mechanism: Mechanism, names: Sequence[str]):
        known = mechanism.parameters()
        self.mechanism, self.names, self.values = mechanism, tuple(names), []
        problems = []
        for name in self.names:
            owner, index = split_index(name, known)
            if owner not in known:
                problems.append(f"free: no number named {quote(name)}{suggestion(name, known)}")
            elif any(i >= n for i, n in zip(index, np.shape(known[owner]), strict=False)):
                problems.append(f"free: {quote(name)}: {owner} has the shape {np.shape(known[owner])}")
            else:
                self.values.append(np.asarray(known[owner])[index])
        problems += [f"free: {quote(name)} is named twice" for name in {*names} if list(names).count(name) > 1]
        if problems:
            raise SceneError(problems, mechanism.name)
        self.starts = np.cumsum([0, *(np.size(x) for x in self.values)])
        self.count = int(self.starts[-1])

    @property
    def vector(self) -> Float[np.ndarray, "P"]:
        """The values of the free numbers in the mechanism, as one vector."""
        return np.concatenate([np.zeros(0), *(np.ravel(x) for x in self.values)])

    def entries(self) -> list[str]:
        """Return the name of each entry of the vector."""
        found = []
        for name, value in zip(self.names, self.values, strict=True):
            found += [name + "".join(f"[{k}]" for k in place) for place in np.ndindex(*np.shape(value))]
        return found

    def split(self, x: Array | np.ndarray) -> dict[str, Array | np.ndarray]:
        """Return the numbers by name whose entries are in vectors (..., P), each with its shape after the leading axes."""
        parts = zip(self.names, self.values, self.starts, self.starts[1:], strict=False)
        return {name: x[..., a:b].reshape((*x.shape[:-1], *np.shape(value))) for name, value, a, b in parts}

    def join(self, values: Mapping[str, object]) -> Float[np.ndarray, "M P"]:
        """Return a vector for each of M members, from numbers (M, ...) by name.

        Raises a `SceneError` if a number is missing, is not free, or has the wrong shape.
        """
        problems, arrays = [], []
        sizes = {len(x) for x in map(np.asarray, values.values()) if x.ndim}
        for name, value in zip(self.names, self.values, strict=True):
            given = np.asarray(values.get(name, np.nan), float)
            if name not in values:
                problems.append(f"parameters: {quote(name)} is missing")
            elif given.shape[1:] != np.shape(value) or not given.ndim or len(sizes) > 1:
                problems.append(f"parameters.{name} must have the shape (members, {', '.join(map(str, np.shape(value)))}): "
                                f"it has the shape {given.shape}")  # fmt: skip
            arrays.append(given.reshape(len(given) if given.ndim else 1, -1))
        problems += [
            f"parameters: {quote(name)} is not free{suggestion(name, self.names)}" for name in values if name not in self.names
        ]
        if problems:
            raise SceneError(problems, self.mechanism.name)
        return np.concatenate(arrays, 1)

    def moved(self, x: Array) -> Mechanism:
        """Return the mechanism with the free numbers of the vector x, which may be traced."""
        return self.mechanism.with_parameters(self.split(x))


def position_model(
    free: FreeNumbers,
    driver: Drive,
    measures: Callable[[Mechanism, Array, Array, Array], Array],
    origin: Callable[[Mechanism], Array] | None = None,
    shifted: bool = False,
) -> Callable[..., dict[str, jax.Array]]:
    """Return the function from which position programs are traced (equations/programs/position_programs.py).

    It has the arguments x, s, q and data, and returns Psi, q0 and s0 of the initial guess, and measures, by name.

    Args:
        free: the free numbers, whose vector is x.
        driver: the driver of the mechanism, whose value is s plus its origin.
        measures: a function of the mechanism, x, q (bodies, 3) and data that returns the numbers to be measured.
        origin: the driver's value at s = 0, as a function of the mechanism; by default zero.
        shifted: whether x has one more entry, which is added to s.
    """

    def model(x: Array, s: Array, q: Array, data: Array) -> dict[str, jax.Array]:
        mechanism = free.moved(x[: free.count])
        driven = drive(mechanism, driver)
        zero = jnp.zeros(()) if origin is None else origin(mechanism)
        zero = zero + x[free.count] if shifted else zero
        return {
            "psi": constraints.psi(driven.mechanism, s + zero, q),
            "q0": jnp.ravel(mechanism.q0),
            "s0": driven.value(mechanism.q0) - zero,
            "measures": jnp.ravel(measures(mechanism, x, q.reshape(-1, 3), data)),
        }

    return model
