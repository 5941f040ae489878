"""Check that the loops of an overconstrained mechanism remain closed when parameters vary.

Redundant rows of Psi are consistent only for certain values of the parameters: three cranks can carry one coupler only if they
are equally long. With N the left null space of Psi_q at a closed position, a change dp of parameters keeps it closed to first
order if and only if

    N^T (dPsi/dp) dp = 0        with dPsi/dp at fixed q.

This must hold at all positions, and it is not sufficient: cranks of l + d, l and l - d satisfy it, and violate the constraints to
second order. A change that is consistent to first order is therefore verified by a finite step: the mechanism must close with the
same rank. NumPy computes all of this from the programs of the rows. Without redundant rows nothing is checked.
"""

import dataclasses
from collections.abc import Callable, Hashable, Iterator, Sequence

import jax
import numpy as np
from jaxtyping import Array

from udkjax.annotations import Numbers
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.rows.position_rows import PositionRows
from udkjax.equations.rows.redundancy import kinematic_rows
from udkjax.pinv.row_spaces import SMALLEST_COEFFICIENT, connected_columns, echelon, null_space, row_space
from udkjax.positions.assembling.assembly import close, require_closed
from udkjax.programs.deferred import deferred
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.study.identify.problem.unknowns import Unknowns, apply_values, sample_guesses
from udkjax.study.identify.records.records import IdentificationError
from udkjax.study.report import ratio
from udkjax.wording import join_names, quote

# Fraction of a parameter's effect on Psi along N that counts as zero. Differences at positions that are closed to 1e-11 have
# errors of 5e-12; a parameter that opens a loop has a fraction of a tenth or more.
DEPENDENT_PART = 1e-6
DIFFERENCE_STEP = 1e-5  # step of the central differences, relative to a parameter's value
# Step after which a mechanism must close again, relative to a parameter's size (its value, or less if that changes a row by more
# than the row's size). A loop that opens to second order does so by 1e-4 of the size, ten million times the tolerance of
# closing (`position_closure.CLOSURE.tol`).
CLOSING_STEP = 1e-2
SMALL_VALUE = 1e-5  # values below this count as zero, relative to the size by effect; coordinates can be so small
MOST_POSITIONS = 4  # number of positions that are closed again
NEARBY_GUESSES = 64  # number of guesses to try if the first cannot be closed
MOST_STORED = 256  # number of stored structures of mechanisms whose parameters keep all loops closed
SAME_CHANGE = 1e-3  # relative difference of changes that count as equal or proportional
SAME_VALUE = 1e-9  # relative difference of values that count as equal
_consistent: set[Hashable] = set()


def loop_problems(
    mechanism: Mechanism, apply: Callable[[Mechanism, Array], Mechanism], x: Numbers, names: Sequence[str]
) -> list[str]:
    """Return a message for each set of parameters that cannot vary independently without opening a loop.

    `apply` assigns values (P,), which may be traced, to a mechanism that can be closed; x are the values to vary. A message
    names the constraints that close a loop, the parameters that would open it, and the ties that keep it closed.
    """
    redundant = analyse(mechanism).redundant_rows
    if redundant == () or not names:
        return []
    placed = deferred(lambda x: apply(mechanism, x).without_origin)  # traced, since a concrete step may be refused for its sign
    x = np.asarray(x, float)
    steps = DIFFERENCE_STEP * np.where(x != 0.0, np.abs(x), min(_length(placed(x)), 1.0))
    moving = [
        i for i, step in enumerate(np.diag(steps)) if _constraint_bytes(placed(x + step)) != _constraint_bytes(placed(x - step))
    ]
    if not moving:  # all parameters are masses or forces
        return []
    names = [names[i] for i in moving]
    at = np.eye(len(x))[moving]
    loops = RedundantLoops(mechanism, lambda change: placed(x + change @ at), x[moving], steps[moving])
    if redundant and loops.redundant < len(redundant):
        return [
            f"the first guesses of {join_names(names)} open a loop that closes with the scene's own values: it has redundant "
            "constraints, which only certain values satisfy; give such values as first guesses"
        ]
    return loops.problems(names) if loops.redundant else []


def nearest_closable(mechanism: Mechanism, unknowns: Unknowns, seed: int) -> tuple[Analysis, Unknowns]:
    """Return the mechanism's analysis and the unknowns, at the first guess or the nearest guess that can be closed.

    The guesses are samples around the first one.

    Raises:
        AssemblyError: the mechanism cannot be closed with any of the guesses.
    """
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
    """Check that the parameters keep all loops closed.

    The result is stored by the structure of the mechanism, since the numbers do not affect it.

    Raises:
        IdentificationError: some parameters would open a loop.
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
    return float(analyse(mechanism).length)


def _constraint_bytes(mechanism: Mechanism) -> list[bytes]:
    """Return the bytes of all numbers of the joints and drivers."""
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(list(mechanism.constraints.values()))]


class RedundantLoops:
    """Closed positions of a mechanism with redundant rows, and the effect of parameters on these rows.

    `changed` maps changes (P,) of the parameters x to mechanisms; `steps` (P,) are the steps of differences.
    """

    def __init__(self, mechanism: Mechanism, changed: Callable[[np.ndarray], Mechanism], x: np.ndarray, steps: np.ndarray):
        self._rows = lambda change: kinematic_rows(changed(change))
        original = changed(np.zeros(len(x)))
        self.x, rows = x, kinematic_rows(original)
        with np.errstate(all="ignore"):
            positions = rows.sample(np.asarray(original.q0, float).ravel())
        self.redundant = rows.count - positions[0].rank if positions else 0
        if not self.redundant:
            return
        self._drivers = mechanism.driver_names
        self._positions = rows.generic(positions)
        self._names = [name for name, _ in rows.names]
        self._redundant_rows = list(rows.redundant(positions))
        self._measure(rows, steps, _length(original))

    def _measure(self, rows: PositionRows, steps: np.ndarray, length_scale: float):
        """Set the effects of parameters on Psi at all positions, and their parts in the left null space of Psi_q.

        No motion compensates the latter parts. `steps` (P,) are the steps of differences; `length_scale` is the size of rows
        without lever arms.
        """
        evaluated = [rows.at(p.t, p.q) for p in self._positions]
        columns = []
        for step in np.diag(steps):
            ahead, behind = self._rows(step), self._rows(-step)
            moved = [ahead.at(p.t, p.q)[0] - behind.at(p.t, p.q)[0] for p in self._positions]
            columns.append(np.array(moved) / (2 * step.sum()))
        slope = np.stack(columns, -1)  # (positions, rows, P)
        # The natural size of a row is the longest lever arm of its rotations, which is 1 for angular rows.
        arms = np.max([length * np.abs(rows.dense(D[:, 2::3]) / rows.metric[2::3]).max(1) for _, length, D in evaluated], axis=0)
        largest = np.abs(slope / np.where(arms > 0.0, arms, length_scale)[:, None]).max((0, 1))
        by_effect = 1.0 / np.where(largest > 0.0, largest, np.inf)
        magnitude = np.abs(self.x)
        self._size = np.where(magnitude < SMALL_VALUE * by_effect, by_effect, np.minimum(magnitude, by_effect))
        effect = slope / np.array([length for _, length, _ in evaluated])[:, :, None]
        norm = np.sqrt((effect**2).sum((0, 1)) / len(effect))  # over rows; the root mean square over positions
        self._unit = 1.0 / np.where(norm > 0, norm, 1.0)  # change of each parameter whose effect is one
        self._effect = effect * self._unit
        null_spaces = [rows.dense(p.null_space) for p in self._positions]
        self._unclosed = np.concatenate([N.T @ e for N, e in zip(null_spaces, self._effect, strict=True)])
        # A combination of rows for each redundant row: it expresses this row by the others.
        self._circuits = np.array([N @ np.linalg.inv(N[self._redundant_rows]) for N in null_spaces])

    def problems(self, names: Sequence[str]) -> list[str]:
        """Return a message for each set of parameters that cannot vary independently."""
        messages = []
        relations = row_space(self._unclosed, DEPENDENT_PART)
        sets = connected_columns(relations)
        free = sorted(set(range(len(self.x))) - {i for members in sets for i in members})
        if free and not self._closes(np.eye(len(self.x))[free]):
            ties = self._ties(free, np.eye(len(free)))
            for part in connected_columns(row_space(null_space(ties, SMALLEST_COEFFICIENT), SMALLEST_COEFFICIENT)):
                members = [free[i] for i in part]
                inside = [i for i in range(len(ties)) if np.any(ties[i, part])]
                messages.append(self._message(names, members, ties[np.ix_(inside, part)]))
        for members in sets:
            ties = self._ties(members, null_space(self._unclosed[:, members], DEPENDENT_PART))
            messages.append(self._message(names, members, ties))
        return messages

    def _closes(self, directions: np.ndarray) -> bool:
        """Return True if the mechanism closes with the same rank after a step along a combination of all directions."""
        if not len(directions):
            return True
        step = np.random.default_rng(1).uniform(0.5, 1.0, len(directions)) @ directions
        step = step * CLOSING_STEP / np.max(np.abs(step * self._unit) / self._size) * self._unit
        rows = self._rows(step)
        stride = max(1, len(self._positions) // MOST_POSITIONS)
        for p in self._positions[::stride]:
            with np.errstate(all="ignore"):
                closed = rows.close(p.t, p.q)
            if closed is None or closed.rank != p.rank:
                return False
        return True

    def _ties(self, members: Sequence[int], closed: np.ndarray) -> np.ndarray:
        """Return directions (ties, members) in which the parameters `members` may vary together, the simplest first.

        They are combinations of the orthonormal rows `closed`, which keep the loops closed to first order, and are verified by a
        step.
        """
        chosen = np.zeros((0, len(members)))
        for candidate in self._candidates(members, closed):
            size = np.linalg.norm(candidate)
            outside = candidate - closed.T @ (closed @ candidate)
            if np.linalg.norm(outside) > SMALLEST_COEFFICIENT * size:
                continue
            trial = np.vstack([chosen, candidate / size])
            if np.linalg.svd(trial)[1][-1] < SMALLEST_COEFFICIENT:
                continue
            directions = np.zeros((len(trial), len(self.x)))
            directions[:, members] = trial
            if self._closes(directions):
                chosen = trial
            if len(chosen) == len(closed):
                break
        return chosen

    def _candidates(self, members: Sequence[int], closed: np.ndarray) -> Iterator[np.ndarray]:
        """Iterate over candidate ties: each parameter alone; two or all by the same amount or factor; and a basis of `closed`."""
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
        own_names, x = [names[i] for i in members], self.x[members]
        who = join_names(own_names)
        stuck = [name for name, tied in zip(own_names, np.any(ties, axis=0), strict=True) if not tied]
        if len(own_names) == 1:
            return (
                f"{who} cannot vary by itself: {self._loop_text(members)} that only closes for its present value; "
                "keep it fixed, or tie it to the parameters that must vary with it"
            )
        if not len(ties):
            return (
                f"{who} cannot vary, neither independently nor together: {self._loop_text(members)} that only closes for their "
                "present values; keep them fixed"
            )
        condition = ", for ".join(tie_text(own_names, x, u) for u in ties)
        cure = f"tie them, and keep {join_names(stuck)} fixed" if stuck else "tie them, or keep them fixed"
        return f"{who} cannot vary independently: {self._loop_text(members)} that only closes for {condition}; {cure}"

    def _loop_text(self, members: Sequence[int]) -> str:
        """Return a clause that names the constraints of the loop that these parameters would open."""
        opened = np.einsum("srk,srm->skm", self._circuits, self._effect[:, :, members])
        part_of = np.abs(opened).max((0, 2)) > DEPENDENT_PART
        circuits = self._circuits[:, :, part_of if part_of.any() else slice(None)]
        involved = np.abs(circuits).max((0, 2)) > SMALLEST_COEFFICIENT
        constraints = list(dict.fromkeys(name for name, part in zip(self._names, involved, strict=True) if part))
        kind = "constraints" if set(constraints) & set(self._drivers) else "joints"
        return f"{kind} {join_names([quote(name) for name in constraints])} form a loop"


def tie_text(names: Sequence[str], x: np.ndarray, u: np.ndarray) -> str:
    """Return in words how some parameters must vary together; x are their values, and u their changes."""
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
