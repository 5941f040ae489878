"""The result of `diagnose`, as numbers and as text."""

from typing import Any, NamedTuple

import numpy as np

from udkjax.printing import PrintedTable, html_table
from udkjax.scene.mechanism import Mechanism
from udkjax.study.diagnosis.clearance import Clearance, RankChange
from udkjax.study.diagnosis.configuration import JointForces
from udkjax.study.diagnosis.fixes import Fix, Redundancy
from udkjax.study.diagnosis.joint_friction import JointFriction
from udkjax.study.diagnosis.second_order import Branch
from udkjax.study.diagnosis.timeline import Timeline
from udkjax.study.report import plain, row_label
from udkjax.wording import plural

LABEL_WIDTH = 14  # width of a section's title in characters
MOST_FIXES_SHOWN = 8  # largest number of printed fixes of a set
MOST_SETS_IN_FULL = 3  # largest number of sets that are printed with all numbers; more are a line each
SMALLEST_POSE_NUMBER = 1e-9  # smallest number of a pose that is not rounding, in rad and relative to the length


class Diagnosis(NamedTuple):
    """Mobility, redundant constraints, singularities and unique forces of a mechanism in one configuration.

    Attributes:
        mechanism: the mechanism.
        coordinates: number of coordinates.
        rows: number of rows (scalar constraint equations) of joints and drivers.
        joint_rows: number of rows of joints.
        redundancies: minimal sets of dependent constraints, with their fixes.
        branches: motions that meet in a singular configuration.
        forces: for each constraint, which components of its forces are unique.
        clearance: distance to the next rank change.
        timeline: rank and singular values along a solution; None if no solution was given.
    """

    mechanism: Mechanism
    t: float  # s
    q: np.ndarray  # (bodies, 3)
    coordinates: int
    rows: int
    rank: int  # rank of Psi_q in this configuration
    ordinary_rank: int  # rank in nearby closed positions: the generic rank
    joint_rank: int  # rank of the rows of joints alone, in this configuration
    joint_rows: int
    can_move: bool  # True if closed positions nearby were found
    redundancies: tuple[Redundancy, ...]
    cure: tuple[Fix, ...]  # fixes to apply in sequence, after which nothing is redundant; empty if none helps or is needed
    branches: tuple[Branch, ...]
    forces: dict[str, JointForces]
    singular_values: np.ndarray  # singular values of the scaled Jacobian
    clearance: Clearance
    timeline: Timeline | None
    friction: dict[str, JointFriction]  # by joint: whether the load of its friction, and its effect, are unique
    held: tuple[str, ...] = ()  # pins that constraints hold to second order only, along the whole motion

    @property
    def gruebler(self) -> int:
        """Gruebler's count, coordinates minus rows, as if all rows were independent."""
        return self.coordinates - self.rows

    @property
    def degrees_of_freedom(self) -> int:
        """Number of degrees of freedom with locked drivers, on the branch with the most."""
        if self.is_singular or not self.can_move:
            return max((branch.degrees_of_freedom for branch in self.branches if branch.followed), default=0)
        return self.coordinates - self.ordinary_rank - len(self.held)

    @property
    def mobility(self) -> int:
        """First-order mobility with locked drivers: coordinates minus the rank in this configuration."""
        return self.coordinates - self.rank

    @property
    def joint_mobility(self) -> int:
        """First-order mobility of the joints alone, without drivers."""
        return self.coordinates - self.joint_rank

    @property
    def is_singular(self) -> bool:
        """True if the rank is lower in this configuration than nearby, or the mechanism moves to first order only."""
        return self.rank < self.ordinary_rank or (self.mobility > 0 and not any(branch.followed for branch in self.branches))

    @property
    def redundant(self) -> int:
        """Number of rows that are redundant in this configuration."""
        return self.rows - self.rank

    @property
    def conditioning(self) -> float:
        """Condition number of the scaled Jacobian: the ratio of its largest to its smallest nonzero singular value."""
        return float(self.singular_values[0] / self.singular_values[self.rank - 1]) if self.rank else 1.0

    @property
    def cured(self) -> Mechanism | None:
        """The mechanism after the fixes of `cure`, with the same motion and without redundancy; None if `cure` is empty."""
        return self.cure[-1].mechanism if self.cure else None

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, lists and strings, for JSON; angles in rad."""
        results, names, timeline = plain(self), self.mechanism.body_names, self.timeline
        for branch in results["branches"]:
            branch["tangent"] = dict(zip(names, branch["tangent"], strict=True))
        if timeline is not None:
            closest = dict(zip(("time", "smallest"), timeline.closest, strict=True))
            results["timeline"] |= plain({"smallest": timeline.smallest, "closest": closest})
        further = ("gruebler", "degrees_of_freedom", "mobility", "joint_mobility", "conditioning")
        return (
            results
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


def _sections(result: Diagnosis) -> list[tuple[str, list[str]]]:
    """Return the title and the lines of each section that is not empty."""
    parts = [
        ("mobility", _mobility(result)),
        ("redundancy", _redundancies(result)),
        ("cure", _cure(result)),
        ("singular", _singular(result)),
        ("branches", _branches(result)),
        ("forces", _forces(result)),
        ("friction", _friction(result)),
        ("conditioning", _conditioning(result)),
        ("timeline", [] if result.timeline is None else _timeline(result.timeline)),
    ]
    return [(title, lines) for title, lines in parts if lines]


def _mobility(result: Diagnosis) -> list[str]:
    bodies = f"{result.coordinates // 3} {'body' if result.coordinates == 3 else 'bodies'}"
    actual, free = result.coordinates - result.ordinary_rank, plural(result.degrees_of_freedom, "degree") + " of freedom"
    lines = [
        f"Gruebler's count: 3 x {bodies} - {plural(result.rows, 'row')} (constraint equations) = {result.gruebler}",
        f"by the rank: {result.coordinates} coordinates - rank {result.ordinary_rank} = {actual}"
        + (f" ({free})" if result.degrees_of_freedom == actual else f"; it moves with {free}"),
    ]
    if result.gruebler != actual and not result.held:
        extra = plural(result.rows - result.ordinary_rank, "row")
        lines.append(f"Gruebler's count treats every row as independent, but {extra} can be left out without any effect")
    if result.rows > result.joint_rows:
        driven = result.joint_mobility - result.mobility
        lines.append(f"without drivers: {plural(result.joint_mobility, 'degree')} of freedom, of which drivers control {driven}")
    return lines


def _when(r: Redundancy) -> str:
    return "along the whole motion" if r.held else "in every position" if r.permanent else "in this configuration only"


def _redundancy(r: Redundancy, has_cure: bool) -> list[str]:
    lines = [f"{', '.join(r.constraints)}: {plural(r.count, 'redundant constraint')} {_when(r)}"]
    if r.fixes:
        lines[0] += "; any one of these changes removes it:" if r.count == 1 else "; any one of these changes helps:"
    for fix in r.fixes[:MOST_FIXES_SHOWN]:
        more = f", removes {fix.removes} redundant constraints" if fix.removes > 1 and fix.removes > r.count else ""
        lines.append(f"  {fix.constraint}: {fix.change} (condition number {1 / fix.conditioning:.3g}{more})")
    lines += [f"  ... {len(r.fixes) - MOST_FIXES_SHOWN} more"] if len(r.fixes) > MOST_FIXES_SHOWN else []
    if r.held:
        lines.insert(
            1, f"  their gradients depend on each other wherever it can go, and hold {', '.join(r.held)} to second order only"
        )
    if r.permanent and not r.fixes and not r.held and not has_cure:
        lines.append("  no single change of a joint was found that removes redundancy and keeps the mobility")
    return lines


def _redundancies(result: Diagnosis) -> list[str]:
    """Return lines on the redundant sets: all numbers of each set, or, if there are many sets, one line each.

    In the latter case, sets of the same kind share a title.
    """
    sets, has_cure = result.redundancies, bool(result.cure)
    if len(sets) <= MOST_SETS_IN_FULL:
        return [line for r in sets for line in _redundancy(r, has_cure)]
    groups: dict[tuple[int, str], list[Redundancy]] = {}
    for r in sets:
        groups.setdefault((r.count, _when(r)), []).append(r)
    lines = []
    for (count, when), group in groups.items():
        each = f"in each of these {len(group)} sets" if len(group) > 1 else "in this set"
        helps = ""
        if any(r.fixes for r in group):
            helps = "; any one of the changes after the colon removes it:" if count == 1 else "; any one of these changes helps:"
        lines += [f"{plural(count, 'redundant constraint')} {when} {each}{helps}", *(f"  {_set_in_a_line(r)}" for r in group)]
    return lines


def _set_in_a_line(r: Redundancy) -> str:
    text = ", ".join(r.constraints)
    if r.held:
        text += f" (they hold {', '.join(r.held)} to second order only)"
    kinds: dict[str, list[str]] = {}  # the constraints of each kind of change; the angles of slots are left to the cure
    for fix in r.fixes:
        kinds.setdefault("make a slot of" if fix.change.startswith("make it a slot") else fix.change, []).append(fix.constraint)
    if len(kinds) == 1 and set(next(iter(kinds.values()))) == set(r.constraints):
        kinds = {change: ["any of them"] for change in kinds}
    changes = [f"{change.replace(' it', '', 1)} {_either(names)}" for change, names in kinds.items()]
    return f"{text}: {'; '.join(changes)}" if changes else text


def _either(names: list[str]) -> str:
    shown, rest = names[:MOST_FIXES_SHOWN], len(names) - MOST_FIXES_SHOWN
    if rest > 0:
        return f"{', '.join(shown)} or one of {rest} more"
    return f"{', '.join(shown[:-1])} or {shown[-1]}" if len(shown) > 1 else shown[0]


def _cure(result: Diagnosis) -> list[str]:
    """Return lines with the changes that together remove all redundancy, or no lines if there are fewer than two changes.

    Constraints with the same change share a line.
    """
    if len(result.cure) < 2:
        return []
    kinds: dict[str, list[str]] = {}
    for fix in result.cure:
        kinds.setdefault(fix.change, []).append(fix.constraint)
    return ["these changes together remove all redundancy:", *(f"  {', '.join(x)}: {change}" for change, x in kinds.items())]


def _singular(result: Diagnosis) -> list[str]:
    if result.rank < result.ordinary_rank:
        return [
            f"the rank is {result.rank} here, and {result.ordinary_rank} nearby; "
            f"the first-order mobility is {result.mobility} here"
        ]
    if result.is_singular:
        return [
            f"the first-order mobility is {result.mobility}, but no displacement satisfies the constraints to second order: "
            "the mechanism cannot move"
        ]
    return []


def _branches(result: Diagnosis) -> list[str]:
    if not result.is_singular:
        return []
    lines = [f"{len(result.branches)} branches meet here" if len(result.branches) != 1 else "one branch passes through"]
    for k, branch in enumerate(result.branches):
        moving = [
            f"{name} ({', '.join(f'{x:.3g}' if abs(x) > SMALLEST_POSE_NUMBER else '0' for x in row)})"
            for name, row in zip(result.mechanism.body_names, branch.tangent, strict=True)
            if np.abs(row).max() > SMALLEST_POSE_NUMBER
        ]
        state = f"rank {branch.rank}" if branch.followed else "not followed: it may end here"
        lines.append(f"  {k + 1}: {state}; direction (dx, dy, dangle): {'; '.join(moving)}")
    return lines


def _forces(result: Diagnosis) -> list[str]:
    """Return lines with the multipliers that are not unique; constraints with the same unique direction share a line."""
    groups: dict[str, list[str]] = {}
    for name, forces in result.forces.items():
        if all(forces.unique):
            continue
        labels = [row_label(result.mechanism, name, k) for k, unique in enumerate(forces.unique) if not unique]
        loose = f"{name} ({', '.join(label[len(name) + 2 : -1] for label in labels)})"
        angle = None if forces.direction is None else np.rad2deg(forces.direction)
        remark = "" if angle is None else f"; only the component along {angle:.4g} degrees is unique"
        groups.setdefault(remark, []).append(loose)
    lines = [f"not unique: {', '.join(loose)}{remark}" for remark, loose in groups.items()]
    return lines or (["all unique"] if result.rows else [])


def _friction(result: Diagnosis) -> list[str]:
    """Return a line on the uniqueness of the joint loads on which friction depends; no line if there is no such friction."""
    loose = [joint for joint, friction in result.friction.items() if not friction.load]
    if not loose:
        return ["all loads are unique, and so are the accelerations"] if result.friction else []
    text = f"the loads of {', '.join(loose)} are not unique"
    if all(friction.accelerations for friction in result.friction.values()):
        return [f"{text}, but the accelerations are"]
    return [f"{text}, nor are the accelerations: those computed belong to the loads of least norm"]


def _conditioning(result: Diagnosis) -> list[str]:
    c = result.clearance
    lines = [f"{result.conditioning:.4g}: the largest over the smallest nonzero singular value of the scaled Jacobian"]
    if result.rank == result.ordinary_rank and np.isfinite(c.estimate):
        lines.append(
            f"next rank change, estimated from the slope of the smallest singular value: {c.estimate:.3g} away "
            "(rad, and lengths over the characteristic length)"
        )
    if c.nearest is not None:
        lines.append(
            f"next rank change on the path: {c.nearest.distance:.6g} away, rank {c.nearest.rank}, at {_pose(result, c.nearest)}"
        )
    elif c.searched:
        lines.append(f"no rank change on the path within {c.searched:.3g}")
    return lines


def _pose(result: Diagnosis, change: RankChange) -> str:
    angles = np.rad2deg(np.where(np.abs(change.q[:, 2]) > SMALLEST_POSE_NUMBER, change.q[:, 2], 0.0))
    return ", ".join(f"{name} {angle:.4g}" for name, angle in zip(result.mechanism.body_names, angles, strict=True)) + " degrees"


def _timeline(line: Timeline) -> list[str]:
    generic_rank = int(line.rank.max(initial=0))
    counted = f"{len(line.ts)} output {'times' if line.unit == 's' else 'values'}"
    lines = [f"{line.ts[0]:g} to {line.ts[-1]:g} {line.unit}, {counted}: rank {generic_rank}"]
    time, smallest = line.closest
    lines[0] += f"; the smallest nonzero singular value has its minimum, {smallest:.3g} of the largest, at {time:.6g} {line.unit}"
    for change in line.changes:
        half = (change.latest - change.earliest) / 2
        lines.append(f"  rank {change.rank} at {change.time:.10g} {line.unit} (+- {half:.1g} {line.unit})")
    return lines
