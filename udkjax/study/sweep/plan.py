"""A plan: what a sweep is, before anything is computed. Its members, their groups and the chunks in which they are computed."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from udkjax.scene.mechanism import Mechanism
from udkjax.study.sweep.axes import Dimension


@dataclass(frozen=True, eq=False)
class Variable:
    """What is kept of each member under one name."""

    dims: tuple[str, ...]  # besides those of the sweep
    shape: tuple[int, ...]
    dtype: np.dtype
    units: str
    long_name: str


@dataclass(frozen=True, eq=False)
class Group:
    """Members that share all choices, and so one compiled program."""

    index: int
    choices: Mapping[str, Any]  # "method": SVD(), ...; only those that are axes
    labels: Mapping[str, str]  # the same, readable
    members: Int[np.ndarray, "n"]  # places in the flattened grid, row-major over the dimensions in their order


@dataclass(frozen=True, eq=False)
class Chunk:
    """Members of one group that are computed together: the unit of progress, of storage and of a task."""

    index: int  # its place in `Plan.chunks`
    group: int  # `Group.index`
    members: Int[np.ndarray, "n"]  # places in the flattened grid, in the order in which they are computed


@dataclass(frozen=True, eq=False)
class Plan:
    """What a sweep is. Immutable; it pickles, so that other processes can compute parts of it."""

    mechanism: Mechanism
    dimensions: tuple[Dimension, ...]
    ts: np.ndarray  # (T,) s
    settings: Mapping[str, Any]  # of simulate, those that are no axes
    measures: Mapping[str, Any]
    derivatives: tuple[str, ...]
    seed: int | None  # of the design

    @property
    def shape(self) -> tuple[int, ...]:
        """How many values each dimension has."""
        return tuple(dimension.size for dimension in self.dimensions)

    @property
    def size(self) -> int:
        """How many members there are."""
        return int(np.prod(self.shape))

    @property
    def groups(self) -> tuple[Group, ...]:
        """One for each combination of choices."""
        raise NotImplementedError

    @property
    def variables(self) -> Mapping[str, Variable]:
        """What is kept of each member: names, dimensions, units. `result` and `end_time` are always among them."""
        raise NotImplementedError

    @property
    def bytes_per_member(self) -> int:
        """What the kept variables of one member take."""
        return sum(int(np.prod(v.shape)) * v.dtype.itemsize for v in self.variables.values())

    def chunks(self, memory: int = 2**30) -> list[Chunk]:
        """Cut the members into chunks of at most `memory` bytes and a few seconds of work, those alike in cost together.

        Deterministic on one kind of machine: where the cost is not known beforehand, a sample of the members is run.
        """
        raise NotImplementedError

    def fingerprint(self) -> dict[str, Any]:
        """Everything that decides the results, as JSON takes it: two plans of one fingerprint give the same dataset."""
        raise NotImplementedError
