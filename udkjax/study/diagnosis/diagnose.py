"""`diagnose`: mobility, redundancy, singularities and unique forces of a mechanism, and its rank along a trajectory."""

from typing import Annotated, Any, cast, overload

import numpy as np

from udkjax.argument_types import HISTORY, NOT_NEGATIVE, POSITIVE
from udkjax.equations import determinacy
from udkjax.equations.rows.analysis import hold_pins
from udkjax.equations.rows.position_closure import is_closed
from udkjax.equations.states.quantities import equations_of
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.pinv import SVD
from udkjax.positions.assembling.assembly import Closure, State, close, require_closed
from udkjax.positions.assembling.channels import StateHistory
from udkjax.positions.following.drive import with_halted_drivers
from udkjax.positions.following.kinematics import Kinematics
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.elements.joints import Revolute, Weld
from udkjax.scene.mechanism import Mechanism
from udkjax.study.diagnosis.clearance import clearance
from udkjax.study.diagnosis.configuration import Configuration, JointForces, RankedPositions
from udkjax.study.diagnosis.dependence import Dependency, dependencies_at
from udkjax.study.diagnosis.diagnosis import Diagnosis
from udkjax.study.diagnosis.fix_search import FixSearch
from udkjax.study.diagnosis.fixes import Fix, Redundancy, fix_of_held_pin
from udkjax.study.diagnosis.joint_friction import joint_friction
from udkjax.study.diagnosis.second_order import branches
from udkjax.study.diagnosis.system_diagnosis import SystemDiagnosis, diagnose_system
from udkjax.study.diagnosis.timeline import timeline

MOST_FIXES = 64  # largest number of fixes of a cure, which are applied in sequence


@overload
def diagnose(mechanism: Mechanism, state: State | None = None, *arguments: Any, **settings: Any) -> Diagnosis: ...


@overload
def diagnose(mechanism: ConstrainedSystem, state: State | None = None, *arguments: Any, **settings: Any) -> SystemDiagnosis: ...


@checked
@concrete_only(instead="uniqueness and singular_values, which are pure")
def diagnose(
    mechanism: Mechanism | ConstrainedSystem,
    state: State | None = None,
    solution: Annotated[StateHistory, HISTORY] | None = None,
    t: float = 0.0,
    rank_tol: Annotated[float, NOT_NEGATIVE] = determinacy.STATIC_RANK_TOL,
    time_tol: Annotated[float, POSITIVE] | None = None,
    fixes: bool = True,
    walk: bool = True,
) -> Diagnosis | SystemDiagnosis:
    """Find dependent constraints, changes that make them independent, and configurations where the rank changes.

    The rank is that of the scaled Jacobian J of Psi: lengths are divided by the characteristic length, angles are in radians, and
    rows are scaled; a mechanism of a micrometre therefore gets the same diagnosis as one of a kilometre.

    Args:
        mechanism: mechanism with concrete numbers, or a `ConstrainedSystem`, whose rows are Psi_q and phi_v, not scaled.
        state: the configuration, closed first; by default the initial guess, or the start of `solution`.
        solution: a trajectory, for the `timeline`; a `Kinematics` over values of a driver has one over these.
        t: time (s) of the configuration, for drivers.
        rank_tol: singular values of J up to this fraction of the largest count as zero.
        time_tol: half-width of the brackets around times of rank changes (s); by default 1e-9 of the characteristic time.
        fixes: whether to search for changes that remove redundancy, and verify them.
        walk: whether to follow a mechanism with one degree of freedom, or a driven one, along its path to the next rank change.

    Returns:
        The `Diagnosis`, which prints as text; of a `ConstrainedSystem` a `SystemDiagnosis`, without fixes and paths.

    Raises:
        AssemblyError: the configuration cannot be closed.
        ValueError: numbers of the mechanism are traced.
    """
    if state is None and solution is not None:
        state, t = State(solution.q[0], solution.v[0]), float(solution.ts[0])
        if isinstance(solution, Kinematics) and solution.values_of is not None:  # not times
            mechanism, t = with_halted_drivers(cast(Mechanism, mechanism), 0.0, state.q), 0.0
    if isinstance(mechanism, ConstrainedSystem):
        return diagnose_system(mechanism, state, float(t), rank_tol, solution, time_tol)
    closure = close(mechanism, t, state)
    require_closed(mechanism, _at_rest(closure))  # the diagnosis does not depend on velocities
    q = np.asarray(closure.state.q, float)
    positions = RankedPositions(mechanism, rank_tol)
    rows = positions.rows
    current, holding = positions.at(float(t), q.ravel()), hold_pins(mechanism)
    held = () if holding is None else holding.pins
    neighbours = positions.around(current)
    if holding is not None:  # only with their angles held do positions lie on the motion
        of_held = RankedPositions(holding.mechanism, rank_tol)
        neighbours = [positions.at(c.t, c.q) for c in of_held.around(of_held.at(current.t, current.q))]
    generic_rank = max([current.rank, *(c.rank for c in neighbours)])
    generic = [c for c in [current, *neighbours] if c.rank == generic_rank]
    owners = [name for name, _ in rows.names]
    permanent, momentary = dependencies_at(attached_bodies(mechanism), current, generic, owners)
    if not neighbours and current.freedom:  # moves to first order only: rows are dependent here
        permanent, momentary = [], [*permanent, *momentary]
    search = FixSearch(mechanism, positions, generic if fixes and not held else [], owners, positions.row_unit)
    redundancies = _with_fixes(search, permanent)
    for k, r in enumerate(redundancies if held else []):
        pins = [pin for pin in held if pin.name in r.constraints]
        joints = [(pin.name, pin.prismatic(mechanism, current.q)) for pin in pins if fixes]
        changes = [fix_of_held_pin(mechanism, positions, current, *x) for x in joints]
        redundancies[k] = r._replace(fixes=tuple(x for x in changes if x), held=tuple(pin.name for pin in pins))
    redundancies += [Redundancy(d.constraints, d.redundancy, False, ()) for d in momentary]
    loose = current.left / positions.row_unit[:, None]  # multipliers in equilibrium without loads
    of_joints = [k for k, name in enumerate(owners) if name in mechanism.joints]
    return Diagnosis(
        mechanism=mechanism,
        t=float(t),
        q=q,
        coordinates=rows.size,
        rows=rows.count,
        rank=current.rank,
        ordinary_rank=generic_rank,
        joint_rank=positions.rank_of_rows(current, of_joints),
        joint_rows=len(of_joints),
        can_move=bool(neighbours),
        redundancies=tuple(redundancies),
        cure=_cure(search, redundancies, positions, generic),
        branches=tuple(branches(mechanism, positions, current)),
        forces=_forces(mechanism, current, owners),
        singular_values=current.sigma,
        clearance=clearance(positions, current, generic_rank, walk),
        timeline=None if solution is None else timeline(mechanism, solution, rank_tol, time_tol),
        held=tuple(pin.name for pin in held),
        friction=joint_friction(
            equations_of(mechanism, SVD()), current.t, current.q, loose * np.asarray(rows.scales.rows)[:, None]
        ),
    )


def attached_bodies(mechanism: Mechanism) -> dict[str, tuple[str, ...]]:
    """Return the bodies of each constraint of a mechanism."""
    return {name: mechanism.frames_of(element) for name, element in mechanism.constraints.items()}


def _with_fixes(search: FixSearch, sets: list[Dependency]) -> list[Redundancy]:
    """Return the `Redundancy` of each permanently dependent set, with the fixes that help in all generic positions."""
    return [Redundancy(x.constraints, x.redundancy, True, tuple(search.fixes_of(x))) for x in sets]


def _cure(
    search: FixSearch, found: list[Redundancy], positions: RankedPositions, generic: list[Configuration]
) -> tuple[Fix, ...]:
    """Return the best fixes in sequence, each determined after applying the previous one, until nothing is redundant.

    The sequence is empty if nothing is redundant, or if the fixes found do not remove all redundancy.
    """
    done: list[Fix] = []
    of_first = [r.fixes[0] for r in found if r.permanent and r.fixes]
    best = max(of_first, key=lambda fix: (fix.removes, fix.conditioning), default=None)
    after = None if best is None else search.after(best) or _search_after(best, positions, generic)
    while best is not None and after is not None:
        done.append(best)
        left = dependencies_at(attached_bodies(best.mechanism), after.at[0], after.at, after.owners)[0]
        if not left or len(done) == MOST_FIXES:
            return tuple(done)
        best, after = after.best(left) or (None, None)
    return ()


def _search_after(fix: Fix, positions: RankedPositions, generic: list[Configuration]) -> FixSearch:
    """Return a search for further fixes in the mechanism after `fix`, which makes a held pin a prismatic joint.

    `FixSearch.after` does not know the fixes of held pins.
    """
    ranked = RankedPositions(fix.mechanism, positions.rank_tol)
    owners = [name for name, _ in ranked.rows.names]
    return FixSearch(fix.mechanism, ranked, [ranked.at(c.t, c.q) for c in generic], owners, ranked.row_unit)


def _forces(mechanism: Mechanism, here: Configuration, owners: list[str]) -> dict[str, JointForces]:
    """Return the `JointForces` of each constraint, by name: uniqueness of its multipliers in the configuration `here`.

    `owners` is the constraint of each row of J.
    """
    forces = {}
    for name, element in mechanism.constraints.items():
        indices = [k for k, owner in enumerate(owners) if owner == name]
        N = here.left[indices]
        share = np.linalg.norm(N, axis=1)
        direction = None
        if isinstance(element, Revolute | Weld):
            direction = determinacy.unique_direction(N[:2])
        forces[name] = JointForces(tuple((share <= determinacy.UNIQUE_TOL).tolist()), tuple(share.tolist()), direction)
    return forces


def _at_rest(closure: Closure) -> Closure:
    """Return a closure without velocity errors, whose `is_closed` depends on its positions alone."""
    psi, q, v = np.asarray(closure.psi), np.ravel(closure.state.q), np.ravel(closure.state.v)
    shut = is_closed(closure.scales, q, v, psi, np.zeros_like(psi), np)
    return closure._replace(psi_dot=0.0 * closure.psi_dot, is_closed=shut)
