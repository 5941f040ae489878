"""Result of `diagnose`, as numbers and as text."""

from typing import Any, NamedTuple

import numpy as np

from udkjax.printing import PrintedTable, html_table
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.wording import plain, plural, row_label
from udkjax.study.diagnosis.clearance import Clearance, RankChange
from udkjax.study.diagnosis.configuration import JointForces
from udkjax.study.diagnosis.fixes import Fix, Redundancy
from udkjax.study.diagnosis.second_order import Branch
from udkjax.study.diagnosis.timeline import Timeline

LABEL_WIDTH = 14  # characters of a section's title
MOST_FIXES_SHOWN = 8  # fixes of one set that are printed
SMALLEST_POSE_NUMBER = 1e-9  # rad, and of the length: smaller numbers of a pose are rounding


class Diagnosis(NamedTuple):
    """The freedoms, redundancies, singularities and determinate forces of a mechanism in one configuration.

    Attributes:
        mechanism: of which it is.
        coordinates: number of coordinates.
        rows: number of rows, of joints and drivers.
        joint_rows: number of rows of joints.
        redundancies: minimal sets of dependent rows, with their fixes.
        branches: motions that meet in a singular configuration.
        forces: for each joint, which components of its forces are unique.
        clearance: distance to where the rank changes.
        timeline: rank and singular values along a solution; None without one.
    """

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
        """Number of directions in which the mechanism can move, along the branch that has most, with drivers held."""
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
        """True if the rank here is lower than around it, or it moves to first order only."""
        return self.rank < self.ordinary_rank or (self.mobility > 0 and not any(branch.followed for branch in self.branches))

    @property
    def redundant(self) -> int:
        """Number of rows that are redundant in this configuration."""
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
        found, names, line = plain(self), self.mechanism.body_names, self.timeline
        for branch in found["branches"]:
            branch["tangent"] = dict(zip(names, branch["tangent"], strict=True))
        if line is not None:
            closest = dict(zip(("time", "smallest"), line.closest, strict=True))
            found["timeline"] |= plain({"smallest": line.smallest, "closest": closest})
        further = ("gruebler", "degrees_of_freedom", "mobility", "joint_mobility", "conditioning")
        return (
            found
            | {name: plain(getattr(self, name)) for name in further}
            | {"q": dict(zip(names, self.q.tolist(), strict=True)), "singular": self.is_singular}
        )

    def __str__(self) -> str:
        lines = [self.mechanism.name or "mechanism"]
        for title, entries in _sections(self):
            lines += [f"  {title if k == 0 else '':<{LABEL_WIDTH}}  {entry}" for k, entry in enumerate(entries)]
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"Diagnosis({self.mechanism.name!r}, rank {self.rank}, {self.degrees_of_freedom} degrees of freedom)"

    def _repr_html_(self) -> str:
        rows = [(title if k == 0 else "", entry) for title, entries in _sections(self) for k, entry in enumerate(entries)]
        return html_table(PrintedTable(self.mechanism.name or "mechanism", rows))


# --- as text


def _sections(found: Diagnosis) -> list[tuple[str, list[str]]]:
    """Say everything, title by title, in lines."""
    parts = [
        ("freedoms", _freedoms(found)),
        ("dependent", [line for r in found.redundancies for line in _redundancy(r)]),
        ("cure", _cure(found)),
        ("singular", _singular(found)),
        ("branches", _branches(found)),
        ("forces", _forces(found)),
        ("conditioning", _conditioning(found)),
        ("timeline", [] if found.timeline is None else _timeline(found.timeline)),
    ]
    return [(title, lines) for title, lines in parts if lines]


def _freedoms(found: Diagnosis) -> list[str]:
    bodies = f"{found.coordinates // 3} {'body' if found.coordinates == 3 else 'bodies'}"
    free = plural(found.degrees_of_freedom, "degree") + " of freedom"
    lines = [
        f"Gruebler's count: 3 x {bodies} - {plural(found.rows, 'row')} = {found.gruebler}",
        f"true: {found.coordinates} - rank {found.ordinary_rank} = {found.coordinates - found.ordinary_rank}"
        + (f" ({free})" if found.degrees_of_freedom == found.coordinates - found.ordinary_rank else f"; it moves in {free}"),
    ]
    if found.gruebler != found.coordinates - found.ordinary_rank:
        extra = found.rows - found.ordinary_rank
        lines.append(
            f"the count takes every row for independent; {extra} {'says' if extra == 1 else 'say'} what others say already"
        )
    if found.rows > found.joint_rows:
        lines.append(
            f"the joints alone leave {found.joint_mobility}, of which drivers hold {found.joint_mobility - found.mobility}"
        )
    return lines


def _redundancy(r: Redundancy) -> list[str]:
    when = "everywhere along the motion" if r.permanent else "in this configuration only"
    lines = [f"{', '.join(r.constraints)}: {plural(r.count, 'redundant row')}, {when}"]
    for fix in r.fixes[:MOST_FIXES_SHOWN]:
        more = f", takes {fix.removes} redundant rows" if fix.removes > 1 and fix.removes > r.count else ""
        lines.append(f"  fix {fix.constraint}: {fix.change} (condition {1 / fix.conditioning:.3g}{more})")
    lines += [f"  ... {len(r.fixes) - MOST_FIXES_SHOWN} more"] if len(r.fixes) > MOST_FIXES_SHOWN else []
    if r.permanent and not r.fixes:
        lines.append("  no single change of a joint was found that takes redundancy away and leaves the mobility")
    return lines


def _cure(found: Diagnosis) -> list[str]:
    return [f"{fix.constraint}: {fix.change}" for fix in found.cure] if len(found.cure) > 1 else []


def _singular(found: Diagnosis) -> list[str]:
    if found.rank < found.ordinary_rank:
        return [
            f"the rank here is {found.rank}, around it {found.ordinary_rank}; to first order the mobility is {found.mobility}"
        ]
    if found.is_singular:
        return [f"it moves to first order only, in {found.mobility}: no displacement satisfies the constraints to second order"]
    return []


def _branches(found: Diagnosis) -> list[str]:
    if not found.is_singular:
        return []
    lines = [f"{len(found.branches)} meet" if len(found.branches) != 1 else "one goes through"]
    for k, branch in enumerate(found.branches):
        moving = [
            f"{name} ({', '.join(f'{x:.3g}' if abs(x) > SMALLEST_POSE_NUMBER else '0' for x in row)})"
            for name, row in zip(found.mechanism.body_names, branch.tangent, strict=True)
            if np.abs(row).max() > SMALLEST_POSE_NUMBER
        ]
        state = f"rank {branch.rank}" if branch.followed else "not followed: it may end here"
        lines.append(f"  {k + 1}: {state}; dx, dy, dangle of {'; '.join(moving)}")
    return lines


def _forces(found: Diagnosis) -> list[str]:
    """Name the multipliers that are not unique, constraints with the same direction together."""
    groups: dict[str, list[str]] = {}
    for name, forces in found.forces.items():
        if all(forces.unique):
            continue
        loose = [row_label(found.mechanism, name, k) for k, unique in enumerate(forces.unique) if not unique]
        along = "" if forces.direction is None else f"; unique only along {np.rad2deg(forces.direction):.4g} degrees"
        groups.setdefault(along, []).extend(loose)
    lines = [f"not unique: {', '.join(loose)}{along}" for along, loose in groups.items()]
    return lines or (["all unique"] if found.rows else [])


def _conditioning(found: Diagnosis) -> list[str]:
    c = found.clearance
    lines = [f"{found.conditioning:.4g}, the largest singular value over the smallest of rank {found.rank}"]
    if found.rank == found.ordinary_rank and np.isfinite(c.estimate):
        lines.append(f"next rank change, by the slope of the smallest: {c.estimate:.3g} away (lengths over L, angles in rad)")
    if c.nearest is not None:
        lines.append(
            f"next rank change on the path: {c.nearest.distance:.6g} away, rank {c.nearest.rank}, at {_pose(found, c.nearest)}"
        )
    elif c.searched:
        lines.append(f"no rank change on the path within {c.searched:.3g}")
    return lines


def _pose(found: Diagnosis, change: RankChange) -> str:
    angles = np.rad2deg(np.where(np.abs(change.q[:, 2]) > SMALLEST_POSE_NUMBER, change.q[:, 2], 0.0))
    return ", ".join(f"{name} {angle:.4g}" for name, angle in zip(found.mechanism.body_names, angles, strict=True)) + " degrees"


def _timeline(line: Timeline) -> list[str]:
    ordinary = int(line.rank.max(initial=0))
    lines = [f"{line.ts[0]:g} to {line.ts[-1]:g} s, {len(line.ts)} instants: rank {ordinary}"]
    lines[0] += f"; the smallest singular value is least at {line.closest[0]:.6g} s: {line.closest[1]:.3g} of the largest"
    for change in line.changes:
        half = (change.latest - change.earliest) / 2
        lines.append(f"  rank {change.rank} at {change.time:.10g} s (+- {half:.1g} s)")
    return lines
