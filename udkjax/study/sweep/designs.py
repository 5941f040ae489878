"""Designs: members spread over ranges, instead of all combinations of values."""

import abc
import inspect
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Design(abc.ABC):
    """`n` members in the ranges of the axes; the same `seed` gives the same members."""

    n: int
    seed: int = 0

    def __post_init__(self):
        if self.n < 1:
            raise ValueError(f"a design needs at least one member, not {self.n}")

    @abc.abstractmethod
    def unit(self, dimensions: int) -> Float[np.ndarray, "n d"]:
        """Points of the unit cube."""


class Sobol(Design):
    """A scrambled Sobol sequence: it fills the ranges most evenly where `n` is a power of two."""

    def unit(self, dimensions: int) -> Float[np.ndarray, "n d"]:
        from scipy.stats import qmc

        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The balance properties", category=UserWarning)
            return qmc.Sobol(dimensions, **_seeded(qmc.Sobol, self.seed)).random(self.n)


class LatinHypercube(Design):
    """Each axis is cut into `n` parts of equal probability, with one member in each."""

    def unit(self, dimensions: int) -> Float[np.ndarray, "n d"]:
        from scipy.stats import qmc

        return qmc.LatinHypercube(dimensions, **_seeded(qmc.LatinHypercube, self.seed)).random(self.n)


class Random(Design):
    """Independent members."""

    def unit(self, dimensions: int) -> Float[np.ndarray, "n d"]:
        return np.random.default_rng(self.seed).random((self.n, dimensions))


def _seeded(engine: Any, seed: int) -> dict[str, Any]:
    """SciPy calls it `rng` since 1.15."""
    name = "rng" if "rng" in inspect.signature(engine).parameters else "seed"
    return {name: np.random.default_rng(seed)}


def spread(values: Any, unit: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"] | None:
    """Points of the unit interval in a range (low, high) or a frozen distribution of scipy.stats; None: it is neither."""
    if hasattr(values, "ppf"):
        return np.asarray(values.ppf(unit), float)
    ends = np.asarray(values, float)
    if ends.shape != (2,) or not ends[0] < ends[1]:
        return None
    return ends[0] + (ends[1] - ends[0]) * unit
