"""Properties of friction in all joints: power, both ways to the loads, and what equilibrium leaves open, by convex programs.

With redundant rows equilibrium leaves multipliers N y open. Accelerations are unique if and only if the power of friction, a
convex function of y, is constant, that is, if its least value, a linear program of SciPy, is its largest at the corners of a box.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

import udkjax as udk
from experiments.parts.friction_reference import FAR, Balance, rubs_of, with_friction
from experiments.parts.random_scenes import RandomScene, build, random_scene, state_of
from experiments.parts.reference_equations import evaluate
from experiments.parts.run_properties import PROPERTIES as OF_RUNS
from experiments.parts.run_properties import RUN_BODIES, check_runs
from experiments.parts.state_properties import Programs, growth, solve
from experiments.parts.tally import Property, Tally

PROPERTIES = {
    "friction": Property(
        "With friction in all joints, accelerations and loads by elimination are in equilibrium, with friction written by hand",
        1e-9,
        "the loads settle to 1e-10 of friction, and rounding as without",
    ),
    "friction by substitution": Property(
        "Elimination finds the accelerations that repeated substitution of the loads finds, if no row is redundant",
        1e-9,
        "as above",
    ),
    "friction of redundant joints": Property(
        "With redundant rows elimination finds the accelerations and the loads of least norm that singular values find",
        1e-9,
        "as above",
    ),
    "jams": Property(
        "There are no accelerations only where neither repeated substitution nor SciPy, from many starts, finds loads",
        0.5,
        "a count",
    ),
    "friction power": Property("Friction takes power: the part of its power that is positive", 1e-14, "rounding of one sum"),
    "unique loads": Property("diagnose says which loads of friction are unique, as sampling does", 0.5, "a count"),
    "unique accelerations": Property(
        "diagnose says whether accelerations are unique with friction, as a convex program does", 0.5, "a count"
    ),
    "unique accelerations of samples": Property("diagnose says the same as accelerations of samples do", 0.5, "a count"),
}
WITH = " with friction"
for name in ("engines", "batch", "jit", "closure of a run", "power balance", "work", "forward derivative", "reverse derivative"):
    PROPERTIES[name + WITH] = replace(OF_RUNS[name], claim=f"{OF_RUNS[name].claim}, with friction in all joints")
PROPERTIES["friction power of a run" + WITH] = Property("Friction takes power along a run", 1e-14, "rounding of one sum")
SAME, DIFFERENT = 1e-9, 1e-6  # relative changes of unique quantities, and of others; no verdict in between
# Redundant structures whose accelerations are checked, and mechanisms of these: one of this number, as each is compiled.
REDUNDANT_STRUCTURES, REDUNDANT_MEMBERS = 32, 8
MULTIPLIERS = "a", "safe", "multipliers"  # the outputs of a program
MOST_SHARED = 4  # redundant rows of programs that are unrolled, whose lengths grow as its square
SAMPLES = 4  # of loads that balance each other


def check_friction(tally: Tally, seed: int, structures: Iterable[int], members: int) -> int:
    """Hold accelerations and multipliers with friction against the reference; return the number of mechanisms."""
    count = 0
    for structure in structures:
        first = with_friction(random_scene(seed, structure, 0))
        state, table = state_of(first.table), first.table
        if not rubs_of(table, *state):
            continue
        redundant = bool(Balance(first, evaluate(table, 0.0, *state), []).N.size)
        own = members // REDUNDANT_MEMBERS if redundant else members
        if not own or (redundant and structure % REDUNDANT_STRUCTURES):
            continue
        scenes = [first, *(with_friction(random_scene(seed, structure, k)) for k in range(1, own))]
        q, v = (np.array([x.ravel() for x in states]) for states in zip(*(state_of(s.table) for s in scenes), strict=True))
        if redundant:  # the loads are those of least norm
            found = _by_textbook(scenes, q, v)
            _check_shares(tally, scenes, q, v, found)
        else:
            found = Programs(build(table), (), [scene.table for scene in scenes], [MULTIPLIERS]).run(MULTIPLIERS, q, v)
        for k, scene in enumerate(scenes):
            count += _check_state(tally, scene, *(found[name][k] for name in ("a", "multipliers", "safe")))
    return count


def _by_textbook(scenes: Sequence[RandomScene], q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    """Return a, multipliers and safe of mechanisms, as programs do, by singular values."""
    pairs = []
    for scene, at, motion in zip(scenes, q, v, strict=True):
        state = at.reshape(-1, 3), motion.reshape(-1, 3)
        pairs.append(udk.accelerations(build(scene.table), 0.0, *state, method=udk.pinv.SVD(), multipliers=True))
    found = {"a": [np.ravel(a) for a, _ in pairs], "multipliers": [x for _, x in pairs], "safe": np.ones((len(pairs), 1))}
    return {name: np.array(x) for name, x in found.items()}


def _check_shares(
    tally: Tally, scenes: Sequence[RandomScene], q: np.ndarray, v: np.ndarray, expected: dict[str, np.ndarray]
) -> None:
    """Hold accelerations and multipliers by elimination against those by singular values."""
    analyses = [udk.analyse(build(scene.table)) for scene in scenes]
    rows = analyses[0].redundant_rows
    if not rows or len(rows) > MOST_SHARED or any(x.redundant_rows != rows for x in analyses):
        tally.leave_out("friction shared by many redundant rows, or not by the same ones")
        return
    weights, tables = np.array([x.scales.weights for x in analyses]), [scene.table for scene in scenes]
    found = Programs(build(tables[0]), rows, tables, [MULTIPLIERS], weights).run(MULTIPLIERS, q, v)
    for k, scene in enumerate(scenes):
        solved = solve(scene)
        if not (found["safe"][k, 0] > 0 and solved.is_clear and all(np.isfinite(x["a"][k]).all() for x in (found, expected))):
            tally.leave_out("friction in rows that are nearly redundant")
            continue
        errors = [np.max(abs(found[x][k] - expected[x][k])) / np.max(abs(expected[x][k])) for x in ("a", "multipliers")]
        tally.add("friction of redundant joints", max(errors) / growth(solved), scene.label)


def _check_state(tally: Tally, scene: RandomScene, a: np.ndarray, multipliers: np.ndarray, safe: np.ndarray) -> int:
    solved, (at, speeds) = solve(scene), state_of(scene.table)
    balance = Balance(scene, solved.terms, list(rubs_of(scene.table, at, speeds).values()))
    if not (safe[0] > 0 and solved.is_clear and balance.is_clear):
        tally.leave_out("friction in rows that are nearly redundant")
        return 0
    right = balance.solve(np.zeros(balance.N.shape[1]))
    if not np.all(np.isfinite(a)):
        jams = right is None and not balance.solutions(np.random.default_rng(scene.seed))
        if not jams:  # JAX follows the loads from those without friction
            a = np.asarray(udk.accelerations(build(scene.table), 0.0, at, speeds))
        tally.add("jams", float(not jams and not np.all(np.isfinite(a))), scene.label)
        tally.leave_out("mechanisms that friction jams" if jams else "loads that four rounds of Newton's method do not settle")
        return 0
    tally.add("jams", 0.0, scene.label)
    x, motion = multipliers * balance.row, speeds.ravel()
    size = balance.sizes(x) @ np.array([abs(r.coefficient) * (abs(r.along) @ abs(motion)) for r in balance.rubs])
    tally.add("friction power", max(-balance.power(x, motion), 0.0) / size if size else 0.0, scene.label)
    largest = max(1.0, np.max(abs(a) / solved.unit))
    error = np.max(abs(a - balance.accelerations(x)) / solved.unit) / largest
    closed = np.max(abs(solved.terms.psi_q @ a - solved.terms.gamma) / balance.row) * scene.time**2 / largest
    tally.add("friction", max(error, closed) / growth(solved), scene.label)
    if right is not None and not balance.N.size:
        error = np.max(abs(a - right[0]) / solved.unit) / largest
        tally.add("friction by substitution", error / growth(solved), scene.label)
    return 1


def check_uniqueness(tally: Tally, seed: int, structures: Iterable[int], members: int) -> int:
    """Hold the verdict of `diagnose` against samples of y and a convex program, on redundant mechanisms; return their number."""
    count = 0
    for structure in structures:
        for number in range(members):
            scene = with_friction(random_scene(seed, structure, number))
            at, _ = state_of(scene.table)
            rng = np.random.default_rng([seed, structure, number, 7])
            still = evaluate(scene.table, 0.0, at, 0 * at)
            if not len(still.psi) or not rubs_of(scene.table, at, at):
                break
            balance = Balance(scene, still, [])
            if not balance.is_clear or not balance.N.size:
                continue
            _, sigma, vt = np.linalg.svd(still.psi_q * balance.unit / balance.row[:, None])
            free = vt[int(np.sum(sigma > 1e-6 * sigma[0])) :]
            v = (free.T @ (free @ rng.standard_normal(at.size))) * balance.unit / scene.time
            v[abs(v) < 1e-12 * balance.unit / scene.time] = 0.0
            count += _check_verdict(tally, scene, at, v.reshape(at.shape), rng)
    return count


def _check_verdict(tally: Tally, scene: RandomScene, q: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> int:
    rubs = rubs_of(scene.table, q, v)
    balance = Balance(scene, evaluate(scene.table, 0.0, q, v), list(rubs.values()))
    own = balance.solve(np.zeros(balance.N.shape[1]))
    if own is None:
        tally.leave_out("samples of loads whose friction does not settle")
        return 0
    reach = FAR * (1 + np.linalg.norm(own[1]) / (balance.load * scene.length))
    ys = reach * rng.standard_normal((SAMPLES, balance.N.shape[1]))
    solved = [own, *(x for x in map(balance.solve, ys) if x is not None)]
    if len(solved) <= len(ys):
        tally.leave_out("samples of loads whose friction does not settle")
        return 0
    verdict = udk.diagnose(build(scene.table), udk.State(q, 0 * q), fixes=False, walk=False).friction
    loads, accelerations = np.array([balance.sizes(x) for _, x in solved]), np.array([a for a, _ in solved])
    size = balance.load + np.max(loads)
    for name, change in zip(rubs, np.ptp(loads, axis=0), strict=True):
        _compare(tally, "unique loads", change / size, verdict[name].load, f"{scene.label} {name}")
    is_unique = all(x.accelerations for x in verdict.values())
    least, most = balance.extremes(v.ravel(), solved[0][1], rng)
    _compare(tally, "unique accelerations", (most - least) / (size * scene.length / scene.time), is_unique, scene.label)
    change = np.max(np.ptp(accelerations, axis=0) / balance.unit) * balance.unit[0] * scene.mass / size
    _compare(tally, "unique accelerations of samples", change, is_unique, scene.label)
    return 1


def _compare(tally: Tally, name: str, change: float, is_unique: bool, at: str) -> None:
    if SAME < change < DIFFERENT:
        tally.leave_out(f"{name}: a change that is neither zero nor clear")
    else:
        tally.add(name, float(is_unique != (change <= SAME)), at)


def check_friction_runs(tally: Tally, seed: int, structure: int, members: int, whole: bool) -> int:
    """Check runs with friction in all joints, as `check_runs` does those without; return their number.

    Machine code has no friction of redundant joints: those structures are left out.

    Args:
        tally: The results.
        seed: Seed of all random numbers.
        structure: Number of the structure.
        members: Number of mechanisms of it.
        whole: Whether runs are repeated by diffrax, and differentiated.
    """
    table = with_friction(first := random_scene(seed, structure, 0, bodies=RUN_BODIES)).table
    state = state_of(table)
    if not rubs_of(table, *state) or Balance(first, evaluate(table, 0.0, *state), []).N.size:
        return 0
    own = Tally()
    count = check_runs(own, seed, [structure], members, whole, whole, alter=with_friction)
    own.found = {f"{name}{WITH}": found for name, found in own.found.items()}
    own.left_out = {f"{reason}{WITH}": n for reason, n in own.left_out.items()}
    tally.merge(own)
    return count
