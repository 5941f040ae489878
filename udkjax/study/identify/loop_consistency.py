"""Parameters that may move: those that leave the loops of an overconstrained mechanism closed.

Rows of Psi that depend on each other hold for some values of all parameters only: three cranks carry one coupler as long as they
are equal. With N the left null space of Psi_q at a closed position, a change dp of parameters keeps it closed to first order if

    N^T (dPsi/dp) dp = 0        with dPsi/dp at fixed q

at that position, and only then; it has to be so at all of them. To first order is not enough: cranks of l + d, l and l - d
satisfy it, and miss each other by distances of second order. So what is closed to first order is moved by a finite step and
closed again: the rank must still be what it was. All of it is NumPy on the programs of the rows; without redundant rows there is
nothing to do.
"""

import dataclasses
from collections.abc import Callable, Hashable, Iterator, Sequence

import jax
import numpy as np
from jaxtyping import Array

from udkjax.annotations import Numbers
from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.redundancy import ORDINARY_TOL, PositionRows, choose_redundant_rows, dense, kinematic_rows, sample_positions
from udkjax.equations.scales import concrete_scales
from udkjax.pinv.row_spaces import SMALLEST_COEFFICIENT, connected_columns, echelon, null_space, row_space
from udkjax.positions.assembly import close, require_closed
from udkjax.programs.deferred import deferred
from udkjax.scene.checks import SceneError, quote
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.wording import join_names, ratio
from udkjax.study.identify.records import IdentificationError
from udkjax.study.identify.unknowns import Unknowns, apply_values, sample_guesses

# Of what a parameter does to Psi at all, the part along N that counts as none. Where there is none, differences and positions
# that are closed to 1e-11 leave 5e-12 of it; a parameter that opens a loop leaves a tenth or more.
DEPENDENT_PART = 1e-6
DIFFERENCE_STEP = 1e-5  # of a parameter's value: the step of the central differences
# Of a parameter's size, which is its value, or less where that changes a row by more than the row's own size: the step after
# which a mechanism must close again. A loop that opens to second order does so by 1e-4 of the size, ten million times what is
# left of closing (`position_closure.CLOSED_TOL`).
CLOSING_STEP = 1e-2
SMALL_VALUE = 1e-5  # of the size by effect: a value as small as this, such as that of a coordinate, counts as zero
MOST_POSITIONS = 4  # positions that are closed again
NEARBY_GUESSES = 64  # guesses to try if the first cannot be closed
MOST_STORED = 256  # structures of mechanisms whose parameters keep all loops closed
SAME_CHANGE = 1e-3  # relative: changes, found by differences, that are said to be the same or in proportion
SAME_VALUE = 1e-9  # relative: values, as they are given, that are said to be the same
_consistent: set[Hashable] = set()


def loop_problems(
    mechanism: Mechanism, apply: Callable[[Mechanism, Array], Mechanism], x: Numbers, names: Sequence[str]
) -> list[str]:
    """Return the objections to moving parameters each by itself; nothing if loops stay closed whatever they are.

    `apply` assigns values (P,), which may be traced, to a mechanism that closes; x are those around which they are to move. A
    message names the constraints that close a loop, the parameters that would open it, and the ties that leave it closed.
    """
    redundant = analyse(mechanism).redundant_rows
    if redundant == () or not names:
        return []
    placed = deferred(lambda x: apply(mechanism, x).without_origin)  # traced: no step of differences is refused for its sign
    x = np.asarray(x, float)
    steps = DIFFERENCE_STEP * np.where(x != 0.0, np.abs(x), min(_length(placed(x)), 1.0))
    moving = [
        i for i, step in enumerate(np.diag(steps)) if _constraint_bytes(placed(x + step)) != _constraint_bytes(placed(x - step))
    ]
    if not moving:  # only masses, forces
        return []
    names = [names[i] for i in moving]
    at = np.eye(len(x))[moving]
    loops = RedundantLoops(mechanism, lambda change: placed(x + change @ at), x[moving], steps[moving])
    if redundant and loops.redundant < len(redundant):
        return [
            f"the first guesses of {join_names(names)} open a loop that closes with the scene's own values: it has more "
            "constraints than it needs, and only certain values satisfy all of them; start from such values"
        ]
    return loops.problems(names) if loops.redundant else []


def nearest_closable(mechanism: Mechanism, unknowns: Unknowns, seed: int) -> tuple[Analysis, Unknowns]:
    """Return the analysis of the mechanism at its first guess, or, where that cannot be closed, at the nearest that can."""
    z = sample_guesses(unknowns, np.zeros(len(unknowns.names)), NEARBY_GUESSES, seed)
    nearby = unknowns.values(z[np.argsort(np.linalg.norm(z, axis=1))])
    for k, x in enumerate([unknowns.guess, *nearby]):
        try:
            placed = mechanism if k == 0 and unknowns.at_scene_values else apply_values(mechanism, unknowns.targets, x)
        except SceneError:
            continue
        if close(placed).is_closed:
            return analyse(placed), dataclasses.replace(unknowns, guess=np.asarray(x, float))
    placed = apply_values(mechanism, unknowns.targets, unknowns.guess)
    require_closed(placed, close(placed))
    raise AssertionError


def require_consistent_loops(mechanism: Mechanism, unknowns: Unknowns) -> None:
    """Raise where the parameters would open a loop.

    Parameters that keep loops closed do so for other numbers with the same structure.
    """
    structure = jax.tree.structure(mechanism), unknowns.targets
    if structure in _consistent:
        return
    wrong = loop_problems(mechanism, lambda mech, x: apply_values(mech, unknowns.targets, x), unknowns.guess, unknowns.names)
    if wrong:
        raise IdentificationError(wrong)
    if len(_consistent) >= MOST_STORED:
        _consistent.clear()
    _consistent.add(structure)


def _length(mechanism: Mechanism) -> float:
    """Return its characteristic length (m)."""
    return float(concrete_scales(mechanism).length)


def _constraint_bytes(mechanism: Mechanism) -> list[bytes]:
    """Return all numbers of its joints and drivers."""
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(list(mechanism.constraints.values()))]


class RedundantLoops:
    """The positions of a mechanism with redundant rows, and what parameters do to these rows there.

    `changed` maps changes (P,) of the parameters, whose values are x, to mechanisms; `steps` (P,) are those of differences.
    """

    def __init__(self, mechanism: Mechanism, changed: Callable[[np.ndarray], Mechanism], x: np.ndarray, steps: np.ndarray):
        self._rows = lambda change: kinematic_rows(changed(change))
        original = changed(np.zeros(len(x)))
        self.x, rows = x, kinematic_rows(original)
        with np.errstate(all="ignore"):
            found = sample_positions(rows, np.asarray(original.q0, float).ravel())
        self.redundant = rows.count - found[0].rank if found else 0
        if not self.redundant:
            return
        self._drivers = mechanism.driver_names
        self._positions = [p for p in found if p.smallest > ORDINARY_TOL] or found
        self._names = [name for name, _ in rows.names]
        self._redundant_rows = list(choose_redundant_rows(rows, found))
        self._measure(rows, steps, _length(original))

    def _measure(self, rows: PositionRows, steps: np.ndarray, length_scale: float):
        """Differentiate Psi by each parameter, and project on what no motion makes up for."""
        at = [rows.at(p.t, p.q) for p in self._positions]
        columns = []
        for step in np.diag(steps):
            ahead, behind = self._rows(step), self._rows(-step)
            moved = [ahead.at(p.t, p.q)[0] - behind.at(p.t, p.q)[0] for p in self._positions]
            columns.append(np.array(moved) / (2 * step.sum()))
        slope = np.stack(columns, -1)  # (positions, rows, P)
        # The natural size of a row: the longest arm at which it turns a body, which is 1 for rows of angles.
        arms = np.max([length * np.abs(dense(D[:, 2::3]) / rows.metric[2::3]).max(1) for _, length, D in at], axis=0)
        most = np.abs(slope / np.where(arms > 0.0, arms, length_scale)[:, None]).max((0, 1))
        by_effect = 1.0 / np.where(most > 0.0, most, np.inf)
        own = np.abs(self.x)
        self._size = np.where(own < SMALL_VALUE * by_effect, by_effect, np.minimum(own, by_effect))
        effect = slope / np.array([length for _, length, _ in at])[:, :, None]
        total = np.sqrt((effect**2).sum((0, 1)) / len(effect))
        self._unit = 1.0 / np.where(total > 0, total, 1.0)  # of each parameter, in which it has an effect of one
        self._effect = effect * self._unit
        null_spaces = [dense(p.null_space) for p in self._positions]
        self._unclosed = np.concatenate([N.T @ e for N, e in zip(null_spaces, self._effect, strict=True)])
        # One combination of rows for each redundant row: that row as the others make it up.
        self._circuits = np.array([N @ np.linalg.inv(N[self._redundant_rows]) for N in null_spaces])

    def problems(self, names: Sequence[str]) -> list[str]:
        """Return a message for each set of parameters that depend on each other."""
        found = []
        relations = row_space(self._unclosed, DEPENDENT_PART)
        sets = connected_columns(relations)
        free = sorted(set(range(len(self.x))) - {i for members in sets for i in members})
        if free and not self._closes(np.eye(len(self.x))[free]):
            ties = self._ties(free, np.eye(len(free)))
            for part in connected_columns(row_space(null_space(ties, SMALLEST_COEFFICIENT), SMALLEST_COEFFICIENT)):
                members = [free[i] for i in part]
                inside = [i for i in range(len(ties)) if np.any(ties[i, part])]
                found.append(self._message(names, members, ties[np.ix_(inside, part)]))
        for members in sets:
            ties = self._ties(members, null_space(self._unclosed[:, members], DEPENDENT_PART))
            found.append(self._message(names, members, ties))
        return found

    def _closes(self, directions: np.ndarray) -> bool:
        """Return whether the mechanism closes, as redundant as before, after a step along all of some directions at once."""
        if not len(directions):
            return True
        step = np.random.default_rng(1).uniform(0.5, 1.0, len(directions)) @ directions
        step = step * CLOSING_STEP / np.max(np.abs(step * self._unit) / self._size) * self._unit
        rows = self._rows(step)
        every = max(1, len(self._positions) // MOST_POSITIONS)
        for p in self._positions[::every]:
            with np.errstate(all="ignore"):
                closed = rows.close(p.t, p.q)
            if closed is None or closed.rank != p.rank:
                return False
        return True

    def _ties(self, members: Sequence[int], closed: np.ndarray) -> np.ndarray:
        """Return directions (ties, members) in which parameters may move, the simplest first, of those closed to first order."""
        chosen = np.zeros((0, len(members)))
        for candidate in self._candidates(members, closed):
            size = np.linalg.norm(candidate)
            outside = candidate - closed.T @ (closed @ candidate)
            if np.linalg.norm(outside) > SMALLEST_COEFFICIENT * size:
                continue
            trial = np.vstack([chosen, candidate / size])
            if np.linalg.svd(trial)[1][-1] < SMALLEST_COEFFICIENT:
                continue
            every = np.zeros((len(trial), len(self.x)))
            every[:, members] = trial
            if self._closes(every):
                chosen = trial
            if len(chosen) == len(closed):
                break
        return chosen

    def _candidates(self, members: Sequence[int], closed: np.ndarray) -> Iterator[np.ndarray]:
        """Iterate over each by itself, two and all by the same amount or factor, and whatever else is closed to first order."""
        x, unit, n = self.x[members], self._unit[members], len(members)
        each = np.eye(n)
        yield from each
        for together in (np.ones(n), x):
            for i in range(n):
                yield from ((each[i] + each[j]) * together / unit for j in range(i) if together[i] and together[j])
        yield from (together / unit for together in (x, np.ones(n)) if np.any(together))
        yield from echelon(closed)

    def _message(self, names: Sequence[str], members: Sequence[int], ties: np.ndarray) -> str:
        ties = np.where(np.abs(ties) > SMALLEST_COEFFICIENT, ties, 0.0)
        ties = ties[np.count_nonzero(ties, axis=1) > 1] * self._unit[members]
        own, x = [names[i] for i in members], self.x[members]
        who = join_names(own)
        stuck = [name for name, tied in zip(own, np.any(ties, axis=0), strict=True) if not tied]
        if len(own) == 1:
            return (
                f"{who} cannot move by itself: {self._loop_text(members)} that only holds for the value that it has; "
                "leave it fixed, or tie it to what has to move with it"
            )
        if not len(ties):
            return (
                f"{who} cannot move, each by itself or together: {self._loop_text(members)} that only holds for the values "
                "that they have; leave them fixed"
            )
        condition = ", for ".join(tie_text(own, x, u) for u in ties)
        leave = f"tie them, and leave {join_names(stuck)} fixed" if stuck else "tie them, or leave them fixed"
        return f"{who} cannot move each by itself: {self._loop_text(members)} that only holds for {condition}; {leave}"

    def _loop_text(self, members: Sequence[int]) -> str:
        """Name the constraints that close what these parameters would open."""
        opened = np.einsum("srk,srm->skm", self._circuits, self._effect[:, :, members])
        part_of = np.abs(opened).max((0, 2)) > DEPENDENT_PART
        circuits = self._circuits[:, :, part_of if part_of.any() else slice(None)]
        involved = np.abs(circuits).max((0, 2)) > SMALLEST_COEFFICIENT
        constraints = list(dict.fromkeys(name for name, there in zip(self._names, involved, strict=True) if there))
        what = "constraints" if set(constraints) & set(self._drivers) else "joints"
        return f"{what} {join_names([quote(name) for name in constraints])} close a loop"


def tie_text(names: Sequence[str], x: np.ndarray, u: np.ndarray) -> str:
    """Return the relation in words by which parameters of the values x move together, with changes u."""
    nonzero = np.flatnonzero(u).tolist()
    names, x, u = [names[i] for i in nonzero], x[nonzero], u[nonzero]
    same = np.allclose(u, u[0], rtol=SAME_CHANGE)
    if same and np.allclose(x, x[0], rtol=SAME_VALUE):
        return " = ".join(names)
    if np.all(x != 0) and np.allclose(u / x, u[0] / x[0], rtol=SAME_CHANGE):
        return f"{join_names(names)} in proportion {ratio(x)}"
    if same:
        return f"{join_names(names)} changing by the same amount"
    return f"{join_names(names)} changing in proportion {ratio(u)}"
