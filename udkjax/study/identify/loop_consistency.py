"""Parameters that may vary: those that keep the loops of an overconstrained mechanism closed.

Redundant rows of Psi are consistent for certain values of the parameters only: three cranks carry one coupler only if they are
equally long. With N the left null space of Psi_q at a closed position, a change dp of parameters keeps it closed to first order
if and only if

    N^T (dPsi/dp) dp = 0        with dPsi/dp at fixed q.

This must hold at all positions, and it is not sufficient: cranks of l + d, l and l - d satisfy it, and violate the constraints to
second order. So a change that is consistent to first order is verified by a finite step: the mechanism must close with the same
rank. Everything is NumPy on the programs of the rows; without redundant rows there is nothing to do.
"""

import dataclasses
from collections.abc import Callable, Hashable, Iterator, Sequence

import jax
import numpy as np
from jaxtyping import Array

from udkjax.annotations import Numbers
from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.redundancy import GENERIC_TOL, PositionRows, choose_redundant_rows, dense, kinematic_rows, sample_positions
from udkjax.equations.scales import concrete_scales
from udkjax.pinv.row_spaces import SMALLEST_COEFFICIENT, connected_columns, echelon, null_space, row_space
from udkjax.positions.assembly import close, require_closed
from udkjax.programs.deferred import deferred
from udkjax.scene.checks import SceneError
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.records import IdentificationError
from udkjax.study.identify.unknowns import Unknowns, apply_values, sample_guesses
from udkjax.study.report import ratio
from udkjax.wording import join_names, quote

# Part of a parameter's effect on Psi along N that counts as zero. Differences at positions that are closed to 1e-11 leave 5e-12;
# a parameter that opens a loop has a tenth or more.
DEPENDENT_PART = 1e-6
DIFFERENCE_STEP = 1e-5  # relative to a parameter's value: the step of the central differences
# Relative to a parameter's size (its value, or less if that changes a row by more than the row's own size): the step after which
# a mechanism must close again. A loop that opens to second order does so by 1e-4 of the size, ten million times the tolerance of
# closing (`position_closure.CLOSED_TOL`).
CLOSING_STEP = 1e-2
SMALL_VALUE = 1e-5  # relative to the size by effect: smaller values, such as coordinates, count as zero
MOST_POSITIONS = 4  # positions that are closed again
NEARBY_GUESSES = 64  # guesses to try if the first cannot be closed
MOST_STORED = 256  # stored structures of mechanisms whose parameters keep all loops closed
SAME_CHANGE = 1e-3  # relative difference of changes that count as equal or proportional
SAME_VALUE = 1e-9  # relative difference of values that count as equal
_consistent: set[Hashable] = set()


def loop_problems(
    mechanism: Mechanism, apply: Callable[[Mechanism, Array], Mechanism], x: Numbers, names: Sequence[str]
) -> list[str]:
    """Return a message for each set of parameters that cannot vary independently without opening a loop.

    `apply` assigns values (P,), which may be traced, to a mechanism that closes; x are the values to vary. A message names the
    constraints that close a loop, the parameters that would open it, and the ties that keep it closed.
    """
    redundant = analyse(mechanism).redundant_rows
    if redundant == () or not names:
        return []
    placed = deferred(lambda x: apply(mechanism, x).without_origin)  # traced, so that no difference step is refused for its sign
    x = np.asarray(x, float)
    steps = DIFFERENCE_STEP * np.where(x != 0.0, np.abs(x), min(_length(placed(x)), 1.0))
    moving = [
        i for i, step in enumerate(np.diag(steps)) if _constraint_bytes(placed(x + step)) != _constraint_bytes(placed(x - step))
    ]
    if not moving:  # all of them are masses or forces
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
    """Return the analysis of the mechanism at its first guess, or at the nearest that can be closed, and the unknowns there."""
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

    The result is stored by the structure of the mechanism, since it does not depend on its numbers.

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
    return float(concrete_scales(mechanism).length)


def _constraint_bytes(mechanism: Mechanism) -> list[bytes]:
    """Return the bytes of all numbers of the joints and drivers."""
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(list(mechanism.constraints.values()))]


class RedundantLoops:
    """Closed positions of a mechanism with redundant rows, and the effect of parameters on these rows.

    `changed` maps changes (P,) of the parameters, whose values are x, to mechanisms; `steps` (P,) are the difference steps.
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
        self._positions = [p for p in found if p.smallest > GENERIC_TOL] or found
        self._names = [name for name, _ in rows.names]
        self._redundant_rows = list(choose_redundant_rows(rows, found))
        self._measure(rows, steps, _length(original))

    def _measure(self, rows: PositionRows, steps: np.ndarray, length_scale: float):
        """Differentiate Psi by each parameter, and project on the left null space, which no motion can compensate."""
        at = [rows.at(p.t, p.q) for p in self._positions]
        columns = []
        for step in np.diag(steps):
            ahead, behind = self._rows(step), self._rows(-step)
            moved = [ahead.at(p.t, p.q)[0] - behind.at(p.t, p.q)[0] for p in self._positions]
            columns.append(np.array(moved) / (2 * step.sum()))
        slope = np.stack(columns, -1)  # (positions, rows, P)
        # The natural size of a row is the longest arm by which it rotates a body, which is 1 for angular rows.
        arms = np.max([length * np.abs(dense(D[:, 2::3]) / rows.metric[2::3]).max(1) for _, length, D in at], axis=0)
        most = np.abs(slope / np.where(arms > 0.0, arms, length_scale)[:, None]).max((0, 1))
        by_effect = 1.0 / np.where(most > 0.0, most, np.inf)
        own = np.abs(self.x)
        self._size = np.where(own < SMALL_VALUE * by_effect, by_effect, np.minimum(own, by_effect))
        effect = slope / np.array([length for _, length, _ in at])[:, :, None]
        total = np.sqrt((effect**2).sum((0, 1)) / len(effect))
        self._unit = 1.0 / np.where(total > 0, total, 1.0)  # change of each parameter that has an effect of one
        self._effect = effect * self._unit
        null_spaces = [dense(p.null_space) for p in self._positions]
        self._unclosed = np.concatenate([N.T @ e for N, e in zip(null_spaces, self._effect, strict=True)])
        # One combination of rows for each redundant row, which expresses it by the others.
        self._circuits = np.array([N @ np.linalg.inv(N[self._redundant_rows]) for N in null_spaces])

    def problems(self, names: Sequence[str]) -> list[str]:
        """Return a message for each set of parameters that cannot vary independently."""
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
        """Return True if the mechanism closes with the same rank after a step along a combination of all directions."""
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
        """Return directions (ties, members) in which parameters may vary, simplest first, of those `closed` to first order."""
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
        """Iterate over candidate ties: each parameter, two or all by the same amount or factor, and others that are `closed`."""
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
                f"{who} cannot vary by itself: {self._loop_text(members)} that only closes for its present value; "
                "keep it fixed, or tie it to the parameters that must vary with it"
            )
        if not len(ties):
            return (
                f"{who} cannot vary, neither independently nor together: {self._loop_text(members)} that only closes for their "
                "present values; keep them fixed"
            )
        condition = ", for ".join(tie_text(own, x, u) for u in ties)
        cure = f"tie them, and keep {join_names(stuck)} fixed" if stuck else "tie them, or keep them fixed"
        return f"{who} cannot vary independently: {self._loop_text(members)} that only closes for {condition}; {cure}"

    def _loop_text(self, members: Sequence[int]) -> str:
        """Name the constraints of the loop that these parameters would open."""
        opened = np.einsum("srk,srm->skm", self._circuits, self._effect[:, :, members])
        part_of = np.abs(opened).max((0, 2)) > DEPENDENT_PART
        circuits = self._circuits[:, :, part_of if part_of.any() else slice(None)]
        involved = np.abs(circuits).max((0, 2)) > SMALLEST_COEFFICIENT
        constraints = list(dict.fromkeys(name for name, part in zip(self._names, involved, strict=True) if part))
        kind = "constraints" if set(constraints) & set(self._drivers) else "joints"
        return f"{kind} {join_names([quote(name) for name in constraints])} form a loop"


def tie_text(names: Sequence[str], x: np.ndarray, u: np.ndarray) -> str:
    """Return the relation in words between parameters with values x and changes u."""
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
