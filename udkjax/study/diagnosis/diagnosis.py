"""What `diagnose` finds, as numbers and as text."""

from typing import Any, NamedTuple

import numpy as np

from udkjax.scene.mechanism import Mechanism
from udkjax.study.diagnosis.clearance import Clearance
from udkjax.study.diagnosis.fixes import Fix
from udkjax.study.diagnosis.second_order import Branch
from udkjax.study.diagnosis.texts import as_dict, as_html, as_text
from udkjax.study.diagnosis.timeline import Timeline


class Redundancy(NamedTuple):
    """A minimal set of constraints that depend on each other: take any of them away, and the others do not."""

    constraints: tuple[str, ...]
    count: int  # of their rows that are redundant
    permanent: bool  # along the motion; otherwise in this configuration only
    fixes: tuple[Fix, ...]  # verified: each takes redundancy away and leaves the mobility; none of a momentary one


class JointForces(NamedTuple):
    """Which multipliers of a constraint equilibrium decides."""

    unique: tuple[bool, ...]  # row by row
    share: tuple[float, ...]  # the length of each row of N: 0 unique, 1 arbitrary
    direction: (
        float | None
    )  # of a joint that holds a point: the only direction (rad) in which its force is unique, if there is one


class Diagnosis(NamedTuple):
    """The freedoms, redundancies, singularities and determinate forces of a mechanism in one configuration."""

    mechanism: Mechanism
    t: float  # s
    q: np.ndarray  # (bodies, 3)
    coordinates: int
    rows: int
    rank: int  # of Psi_q in this configuration
    ordinary_rank: int  # in closed positions around it
    joint_rank: int  # of the rows of joints alone, in this configuration
    joint_rows: int
    can_move: bool  # whether closed positions around it were found
    redundancies: tuple[Redundancy, ...]
    cure: tuple[Fix, ...]  # fixes one after another, after which nothing is redundant; empty where nothing helps, or need not
    branches: tuple[Branch, ...]
    forces: dict[str, JointForces]
    singular_values: np.ndarray  # of the scaled Jacobian
    clearance: Clearance
    timeline: Timeline | None

    @property
    def gruebler(self) -> int:
        """Coordinates less rows: Gruebler's count, which takes every row for independent."""
        return self.coordinates - self.rows

    @property
    def degrees_of_freedom(self) -> int:
        """In which the mechanism can move away from here, along the branch that has most, with drivers held."""
        if self.is_singular or not self.can_move:
            return max((branch.degrees_of_freedom for branch in self.branches if branch.followed), default=0)
        return self.coordinates - self.ordinary_rank

    @property
    def mobility(self) -> int:
        """To first order: coordinates less the rank here, with drivers held."""
        return self.coordinates - self.rank

    @property
    def joint_mobility(self) -> int:
        """To first order, of the joints alone: what drivers have to move."""
        return self.coordinates - self.joint_rank

    @property
    def is_singular(self) -> bool:
        """Whether the rank here is lower than around it, or it moves to first order only."""
        return self.rank < self.ordinary_rank or (self.mobility > 0 and not any(branch.followed for branch in self.branches))

    @property
    def redundant(self) -> int:
        """How many rows are redundant in this configuration."""
        return self.rows - self.rank

    @property
    def conditioning(self) -> float:
        """The largest singular value of the scaled Jacobian over the smallest that counts."""
        return float(self.singular_values[0] / self.singular_values[self.rank - 1]) if self.rank else 1.0

    @property
    def cured(self) -> Mechanism | None:
        """The mechanism after the fixes of `cure`: the same motion, nothing redundant. None where there are none."""
        return self.cure[-1].mechanism if self.cure else None

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, lists and texts, for JSON; angles in rad."""
        return as_dict(self)

    def __str__(self) -> str:
        return as_text(self)

    def __repr__(self) -> str:
        return f"Diagnosis({self.mechanism.name!r}, rank {self.rank}, {self.degrees_of_freedom} degrees of freedom)"

    def _repr_html_(self) -> str:
        return as_html(self)
