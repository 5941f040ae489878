"""Properties of the equations at a state, by the scalar programs that machine code is made of, run on plain numbers.

Nothing is compiled but the pseudoinverses, once for all mechanisms (`check_methods`), so that thousands take minutes.
"""

import copy
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from experiments.parts.random_scenes import RandomScene, Table, build, random_scene, state_of
from experiments.parts.reference_equations import Terms, evaluate
from experiments.parts.scene_views import can_be_turned, in_units, moved, renamed, with_copies
from experiments.parts.tally import Property, Tally, relative
from udkjax.equations.programs.scene_arrays import SceneArrays
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.programs.unrolled import Unrolled
from udkjax.equations.terms.scene_layout import LoadShares
from udkjax.equations.terms.structure import numbers_as_vector
from udkjax.expressions import ScalarProgram
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.scene.elements.friction import SLIDING_SPEED

SAFE = 1e-12  # pivots relative to their rows above which elimination is trusted here: half of the digits
GAP = 1e-6, 1e-11  # singular values of D relative to the largest: those that count, and those that do not; in between, neither
ORDINARY = 30.0  # the condition number up to which errors are not scaled; beyond it they may grow like its square
ROUNDING = "rounding in some hundred operations"
CONDITION = "rounding, times the square of the condition number of the rows that are eliminated"
PROPERTIES = {
    "Psi": Property("Psi agrees with an independent implementation", 1e-12, ROUNDING),
    "Psi_q": Property("Psi_q, by rules for expressions, agrees with Taylor series in NumPy", 1e-12, ROUNDING),
    "Psi_dot": Property("Psi_dot agrees with Taylor series", 1e-12, ROUNDING),
    "gamma": Property(
        "gamma agrees with Taylor series of second order", 1e-12, f"{ROUNDING}, and differences of squares of rates"
    ),
    "loads": Property("M^(-1) F agrees with loads written by hand", 1e-12, ROUNDING),
    "energy": Property("Kinetic and potential energy agree with formulas written by hand", 1e-12, ROUNDING),
    "large scenes": Property("Psi, Psi_q, Psi_dot, gamma and loads of large scenes, by loops, agree with NumPy", 1e-11, ROUNDING),
    "elimination": Property("Elimination finds the same accelerations as singular values of all rows", 1e-12, "required"),
    "constraints": Property("Accelerations satisfy Psi_q a = gamma", 1e-11, CONDITION),
    "Gauss": Property("a is nearest to a_F in the metric of M: N^T M (a - a_F) = 0 along all free motions N", 1e-11, CONDITION),
    "power": Property("v^T (M a - F) = lambda^T Psi_t: the power of constraints is the power of drivers", 1e-11, CONDITION),
    "reciprocity": Property("An impulse at i moves j as an impulse at j moves i, through all constraints", 1e-11, CONDITION),
    "file": Property(
        "A scene that is written and read has the same numbers and accelerations, bit for bit", 0.5, "a count of bits"
    ),
    "rigid motion": Property(
        "If a scene and its gravity are moved and turned as a whole, its accelerations turn with it",
        1e-9,
        "rounding of positions far from the origin",
    ),
    "units": Property("Other units of length, time and mass only scale accelerations", 1e-11, CONDITION),
    "names": Property("Other names change no bit of the result", 0.5, "a count of bits"),
    "order": Property("Bodies, joints and forces in another order have the same accelerations", 1e-11, CONDITION),
    "copies": Property("Constraints that are given k times change no acceleration", 1e-11, CONDITION),
    **{
        name: Property(f"{name} finds the accelerations of the reference, with any redundancy", tol, because)
        for name, tol, because in (
            ("SVD", 1e-11, "rounding, times the condition number"),
            ("Varga", 1e-11, "rounding, times the condition number"),
            ("Householder", 1e-11, "rounding, times the condition number"),
            ("GramSchmidt", 1e-11, "rounding, times the condition number"),
            (
                "Greville",
                1e-7,
                "rounding, times the square of the condition number of all leading rows",
            ),
            ("NullSpaceQR", 1e-11, "rounding, times the square of the condition number"),
            ("NullSpaceSVD", 1e-11, "rounding, times the square of the condition number"),
            ("Augmented by SVD", 1e-10, "rounding, times the square of the condition number"),
            ("Augmented by LU", 1e-10, "rounding, times the square of the condition number of the rows that are independent"),
        )
    },
}


class Solved(NamedTuple):
    """A state: the reference's terms, its accelerations by singular values, the free motions, the condition number."""

    terms: Terms
    a: np.ndarray
    unit: np.ndarray  # of accelerations
    weights: np.ndarray  # of the rows, which make them comparable
    free: np.ndarray  # (n, k) in units of M^(-1/2)
    condition: float
    is_clear: bool


def solve(scene: RandomScene, terms: Terms | None = None) -> Solved:
    """Return the accelerations of the reference at the state of a scene."""
    q, v = state_of(scene.table)
    terms = evaluate(scene.table, 0.0, q, v) if terms is None else terms
    unit = np.tile([scene.length, scene.length, 1.0], len(q))
    root, free = 1 / np.sqrt(terms.mass), terms.force / terms.mass
    if not len(terms.psi):
        return Solved(terms, free, unit / scene.time**2, np.ones(0), np.eye(len(root)), 1.0, True)
    size = np.max(abs(terms.psi_q * unit), axis=1)
    weights = 1 / size
    D = weights[:, None] * terms.psi_q * root * math.sqrt(scene.mass) * scene.length
    u, sigma, vt = np.linalg.svd(D)
    rank = int(np.sum(sigma > GAP[0] * sigma[0]))
    b = weights * (terms.gamma - terms.psi_q @ free)
    x = vt[:rank].T @ (u[:, :rank].T @ b / sigma[:rank])
    a = free + root * x * math.sqrt(scene.mass) * scene.length
    clear = bool(np.all(sigma[rank:] <= GAP[1] * sigma[0]))
    return Solved(terms, a, unit / scene.time**2, weights, vt[rank:].T, float(sigma[0] / sigma[rank - 1]), clear)


def growth(solved: Solved, power: int = 2, without: Sequence[int] = ()) -> float:
    """Return the amplification of rounding errors relative to a generic state; `without` the rows that elimination leaves out."""
    condition = solved.condition
    if without:
        rows = (
            np.delete(solved.terms.psi_q, without, 0) * solved.weights[np.delete(np.arange(len(solved.weights)), without), None]
        )
        sigma = np.linalg.svd(rows / np.sqrt(solved.terms.mass), compute_uv=False)
        condition = max(condition, float(sigma[0] / sigma[-1])) if len(sigma) else condition
    return max(1.0, condition / ORDINARY) ** power


# The outputs of the programs of `Programs`.
ACCELERATIONS = "a", "safe", "unsettled"
TANGENT_PART = "dq1", "dv1", "distance"
TERMS = "terms with friction", "psi_q", "psi", "psi_dot"


class Programs:
    """The programs of mechanisms of one structure with their numbers in, run by NumPy on all of them at once."""

    def __init__(
        self,
        mechanism: udk.Mechanism,
        redundant: Sequence[int],
        tables: Sequence[Table] = (),
        asked: Sequence[tuple[str, ...]] = (ACCELERATIONS, TANGENT_PART, TERMS),
        weights: np.ndarray | None = None,
    ):
        """Evaluators by programs of one mechanism, or of `tables` of its structure, whose numbers replace its own.

        With `weights` (members, rows) redundant rows share the loads of joints with friction.
        """
        sharing = LoadShares.NONE if weights is None else LoadShares.KNOWN
        programs = scene_programs(mechanism, tuple(redundant), False, RankPolicy.REFUSE, sharing=sharing)
        self._unrolled = Unrolled(programs, asked)
        self.entries, (self.rows, self.coordinates) = programs.psi_q_entries, (programs.row_count, programs.coordinate_count)
        own = np.concatenate([np.ravel(x) for x in mechanism.numbers])
        rows = _at_start(mechanism.without_origin, numbers_of(mechanism, tables) if tables else own[None])
        numbers = np.hstack([rows, *([] if weights is None else [weights]), np.tile([0.0, SAFE], (len(rows), 1))])
        self._constants = _run(self._unrolled.prologue, numbers)

    def run(self, outputs: tuple[str, ...], q: np.ndarray, v: np.ndarray, dv: np.ndarray | float = 0.0) -> dict[str, np.ndarray]:
        """Return the results (members, ...) of a program at q and v (members, n), t = 0, by array."""
        given = {"constants": self._constants, "t": np.zeros((len(q), 1)), "q": q, "v": v, "dq": 0.0 * q, "dv": dv + 0.0 * v}
        program, inputs, places = self._unrolled.program(*outputs)
        unused = np.zeros(len(q))  # loads of friction that other programs begin with
        values = _run(program, np.stack([given[x][:, k] if x in given else unused for x, k in inputs], 1))
        return {x: values[:, [i for i, (y, _) in enumerate(places) if y == x]] for x in dict.fromkeys(y for y, _ in places)}

    def accelerations(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """a (members, n) by elimination, and whether each is safe."""
        found = self.run(ACCELERATIONS, q, v)
        return found["a"], found["safe"][:, 0] > 0

    def impulse_response(self, q: np.ndarray, v: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return the part of a change of the velocities that the constraints allow."""
        return self.run(TANGENT_PART, q, v, change)["dv1"]

    def terms(self, q: np.ndarray, v: np.ndarray) -> list[dict[str, np.ndarray]]:
        """Psi, Psi_q, Psi_dot, b and a_F of each member."""
        found = self.run(TERMS, q, v)
        row, column, place, factor = self.entries
        psi_q = np.zeros((len(q), self.rows, self.coordinates))
        if len(row):
            psi_q[:, row, column] = found["psi_q"][:, place] * factor
        free, b = np.split(found["terms"], [self.coordinates], axis=1)
        rows = {x: found.get(x, np.zeros((len(q), 0))) for x in ("psi", "psi_dot")}
        return [{"psi_q": psi_q[k], "free": free[k], "b": b[k]} | {x: rows[x][k] for x in rows} for k in range(len(q))]


def names_of(mechanism: udk.Mechanism) -> list[str]:
    """Return the names of all numbers of a mechanism in their order, also of those that follow from others."""
    name_of = {id(value): name for name, value in mechanism.parameters().items()}
    name_of |= {id(j.constant): f"joint.{n}.constant" for n, j in mechanism.joints.items() if hasattr(j, "constant")}
    return [name_of[id(leaf)] for leaf in mechanism.numbers]


def _at_start(mechanism: udk.Mechanism, rows: np.ndarray) -> np.ndarray:
    """Return the numbers that programs take at t = 0, of all numbers of mechanisms of one structure (members, ...)."""
    if not mechanism.samples:
        return rows
    leaves, form = jax.tree.flatten(mechanism)
    ends = np.cumsum([np.size(x) for x in leaves])[:-1]
    members = ([x.reshape(np.shape(y)) for x, y in zip(np.split(row, ends), leaves, strict=True)] for row in rows)
    return np.array([np.concatenate([np.ravel(x) for x in jax.tree.unflatten(form, m).at(0.0).numbers]) for m in members])


def numbers_of(mechanism: udk.Mechanism, tables: Sequence[Table]) -> np.ndarray:
    """Return the numbers of tables in the order in which a mechanism of their structure has them: a hundred times sooner than
    mechanisms are made of them."""
    names, found = names_of(mechanism), []
    for table in tables:
        entries = {f"{s}.{e['name']}": e for s in ("body", "joint", "driver", "force") for e in table[s]}
        frames = {"ground": (0.0, 0.0, 0.0)} | {b["name"]: (*b["position"], b["angle"]) for b in table["body"]}
        found.append(np.concatenate([np.ravel(_number(table, entries, frames, name)) for name in names]))
    return np.array(found)


def _number(table: Table, entries: dict[str, Table], frames: dict[str, Any], name: str) -> Any:
    if name == "gravity":
        return table["gravity"]
    section, owner, *path = name.split(".")
    entry: Any = entries[f"{section}.{owner}"]
    if path[0] in entry:
        for key in path:
            entry = entry[key]
        return entry
    if entry["type"] == "friction":  # which leaves out what has a default
        return SLIDING_SPEED
    # Numbers left to the guess.
    if section == "driver":
        return np.zeros((2, 2))
    (x1, y1, a1), (x2, y2, a2) = one, two = [frames[b] for b in entry["bodies"]]
    match entry["type"], path[0]:
        case "distance", _:
            (px, py), (qx, qy) = (
                (x + np.cos(a) * p[0] - np.sin(a) * p[1], y + np.sin(a) * p[0] + np.cos(a) * p[1])
                for (x, y, a), p in zip((one, two), entry["points"], strict=True)
            )
            return np.hypot(qx - px, qy - py)
        case "gear", _:
            r1, r2 = entry["radii"][0], entry["radii"][1] * (-1.0 if entry["internal"] else 1.0)
            carrier = frames[entry.get("carrier", "ground")][2]
            return r1 * (a1 - carrier) + r2 * (a2 - carrier)
        case "rack", _:
            along = a1 + entry["axis"]
            return np.cos(along) * (x2 - x1) + np.sin(along) * (y2 - y1) + entry["radius"] * (a2 - a1)
        case _, "angle":
            return a2 - a1
    raise KeyError(name)


def _run(program: ScalarProgram, values: np.ndarray) -> np.ndarray:
    typed = [column.astype(s.node.dtype) for column, s in zip(values.T, program.inputs, strict=True)]  # some are conditions
    if len(values) == 1:
        return np.array([program([column[0].item() for column in typed])], float)
    return np.array(program.by_numpy(typed), float).reshape(-1, len(values)).T


def states_of(scenes: Sequence[RandomScene]) -> tuple[np.ndarray, np.ndarray]:
    """Return q and v (members, n)."""
    states = [state_of(scene.table) for scene in scenes]
    return np.array([q.ravel() for q, _ in states]), np.array([v.ravel() for _, v in states])


def accelerate(scene: RandomScene, mechanism: udk.Mechanism, redundant: Sequence[int]) -> tuple[np.ndarray, bool]:
    """Return a (n,) of one mechanism by elimination, and whether it is safe."""
    a, safe = Programs(mechanism, redundant).accelerations(*states_of([scene]))
    return a[0], bool(safe[0])


def check_terms(tally: Tally, scene: RandomScene, solved: Solved, found: dict[str, np.ndarray]) -> None:
    """Hold the terms of the programs against those of the reference."""
    (q, v), terms, at = state_of(scene.table), solved.terms, scene.label
    length, rate = np.tile([scene.length, scene.length, 1.0], len(q)), 1 / scene.time
    free = found["free"]
    speed = max(1.0, np.max(abs(v.ravel() / (length * rate))))
    if len(terms.psi):
        w, psi_q = solved.weights, found["psi_q"]
        reach = max(1.0, np.max(abs(q[:, :2])) / scene.length)
        tally.add("Psi", np.max(abs(w * (found["psi"] - terms.psi))) / reach, at)
        tally.add("Psi_q", np.max(abs(w[:, None] * (psi_q - terms.psi_q) * length)) / reach, at)
        tally.add("Psi_dot", np.max(abs(w * (found["psi_dot"] - terms.psi_dot))) / (rate * speed * reach), at)
        size = rate**2 * max(speed**2 * reach, np.max(abs(free / (length * rate**2))), np.max(abs(w * terms.gamma)) / rate**2)
        tally.add("gamma", np.max(abs(w * (found["b"] + psi_q @ free - terms.gamma))) / size, at)
    tally.add("loads", relative(free, terms.force / terms.mass, length * rate**2, 1.0), at)


def check_energy(tally: Tally, scene: RandomScene, mechanism: udk.Mechanism, terms: Terms) -> None:
    """Hold the kinetic and the potential energy of one mechanism of a structure against those of the reference."""
    q, v = state_of(scene.table)
    found = udk.equations.kinetic_energy(mechanism, v), udk.equations.potential_energy(mechanism, 0.0, q, v)
    right = np.array([0.5 * terms.mass @ v.ravel() ** 2, terms.potential])
    tally.add("energy", relative(np.array(found, float), right, scene.mass * (scene.length / scene.time) ** 2, 1.0), scene.label)


def check_accelerations(tally: Tally, scene: RandomScene, solved: Solved, a: np.ndarray, grown: float) -> None:
    """Hold accelerations by elimination against singular values, and against the identities of mechanics."""
    (_, v), terms, at, unit = state_of(scene.table), solved.terms, scene.label, solved.unit
    free, u = terms.force / terms.mass, solved.unit * scene.time**2
    size = max(np.max(abs(free / unit)), np.max(abs(solved.a / unit)), 1e-3)
    tally.add("elimination", np.max(abs(a - solved.a) / unit) / size / grown, at)
    mass = terms.mass / scene.mass * u**2 / scene.length**2
    tally.add("Gauss", np.max(abs(solved.free.T @ (np.sqrt(mass) * (a - free) / unit)), initial=0.0) / size / grown, at)
    if not len(terms.psi):
        return
    left, asked = (solved.weights * x * scene.time**2 for x in (terms.psi_q @ a - terms.gamma, terms.gamma))
    tally.add("constraints", np.max(abs(left)) / max(size, np.max(abs(asked))) / grown, at)
    force, velocity = terms.mass * a - terms.force, v.ravel()
    rows = solved.weights[:, None] * terms.psi_q * u
    multipliers = np.linalg.lstsq(rows.T, -force * u, rcond=1e-8)[0] * solved.weights
    psi_t = terms.psi_dot - terms.psi_q @ velocity
    largest = np.sum(abs(velocity * force)) + np.sum(abs(multipliers * psi_t)) + np.sum(abs(velocity * terms.mass * free))
    largest += scene.mass * scene.length**2 / scene.time**3
    tally.add("power", abs(velocity @ force - multipliers @ psi_t) / largest / grown, at)


def check_reciprocity(
    tally: Tally, scenes: Sequence[RandomScene], programs: Programs, solved: Sequence[Solved], grown: Sequence[float], rng: Any
) -> None:
    """Give two impulses in turn; compare what each does along the other."""
    q, v = states_of(scenes)
    u = np.array([s.unit * scene.time**2 for scene, s in zip(scenes, solved, strict=True)])
    mass = np.array([s.terms.mass for s in solved])
    unit = np.array([[scene.mass * scene.length**2] for scene in scenes])
    i, j = rng.standard_normal((2, *q.shape)) / u  # impulses that do as much work in every coordinate
    moved_i, moved_j = (programs.impulse_response(q, v, unit * impulse / mass) for impulse in (i, j))
    free = np.sqrt(np.sum(i**2 / mass, 1) * np.sum(j**2 / mass, 1)) * unit[:, 0]
    for scene, error, by in zip(scenes, abs(np.sum(i * moved_j - j * moved_i, 1)) / free, grown, strict=True):
        tally.add("reciprocity", error / by, scene.label)


def check_file(tally: Tally, scene: RandomScene, mechanism: udk.Mechanism, redundant: Sequence[int]) -> None:
    """Write a scene and read it; compare all numbers, and the accelerations, bit by bit."""
    again = udk.loads(udk.dumps(mechanism))
    old, new = jax.tree.leaves(mechanism), jax.tree.leaves(again)
    differ = sum(np.asarray(a).tobytes() != np.asarray(b).tobytes() for a, b in zip(old, new, strict=True))
    one, two = (accelerate(scene, m, redundant)[0] for m in (mechanism, again))
    tally.add("file", float(differ + (one.tobytes() != two.tobytes())), scene.label)


def check_structures(
    tally: Tally, scene: RandomScene, redundant: Sequence[int], solved: Solved, a: np.ndarray, rng: np.random.Generator
) -> None:
    """Names, orders and copies, which change the structure of a scene: its programs are made anew."""
    (q, _), grown = state_of(scene.table), growth(solved, without=redundant)
    names = {e["name"]: f"n {k} ü" for k, e in enumerate(x for s in ("body", "joint", "driver", "force") for x in scene.table[s])}
    found, _ = accelerate(scene, build(renamed(scene.table, names.__getitem__)), redundant)
    tally.add("names", float(found.tobytes() != a.tobytes()), scene.label)

    table = copy.deepcopy(scene.table)
    place = rng.permutation(len(table["body"]))
    for section in ("body", "joint", "driver", "force"):
        mixed = place if section == "body" else rng.permutation(len(table[section]))
        table[section] = [table[section][k] for k in mixed]
    for name, changed in (("order", table), ("copies", with_copies(scene.table, rng))):
        mechanism = build(changed)
        rows = udk.analyse(mechanism).redundant_rows
        if rows is None:
            tally.leave_out("analyse finds no redundant rows")
            continue
        where = place if name == "order" else np.arange(len(q))
        found, safe = accelerate(scene._replace(table=changed), mechanism, rows)
        if safe:
            right = a.reshape(-1, 3)[where].ravel()
            other = growth(solve(scene._replace(table=changed)), without=rows)  # which rows are left out may differ
            tally.add(name, relative(found, right, solved.unit, 1.0) / max(grown, other), scene.label)
        else:
            tally.leave_out("elimination says that it is not safe")


# --- pseudoinverses and formulations, in batches of one shape

ROWS, COORDINATES = 40, 60  # of the padded systems: rows of zeros, and coordinates that nothing holds, change nothing
BATCH = 25
METHODS = ("SVD", "Varga", "Householder", "GramSchmidt", "Greville")
RANK_TOL = 1e-7  # between the singular values that count here and those that do not


@eqx.filter_jit
def _by_all(D: Any, b: Any, M: Any, F: Any, A: Any, c: Any, independent: Any) -> dict[str, Any]:
    found = {name: jax.vmap(lambda D, b, m=getattr(udk, name)(RANK_TOL): m.solve(D, b).x)(D, b) for name in METHODS}
    formulations = {
        "NullSpaceQR": udk.NullSpaceQR(RANK_TOL),
        "NullSpaceSVD": udk.NullSpaceSVD(RANK_TOL),
        "Augmented by SVD": udk.Augmented(udk.SVD(1e-12)),
    }
    found["Augmented by LU"] = jax.vmap(udk.Augmented().solve)(M, F, *independent)
    return found | {name: jax.vmap(f.solve)(M, F, A, c) for name, f in formulations.items()}


def check_methods(tally: Tally, cases: Sequence[tuple[RandomScene, Solved, Sequence[int]]]) -> None:
    """Solve many states, each with its redundant rows, by all pseudoinverses and formulations, and compare with the reference."""
    cases = [case for case in cases if len(case[1].terms.psi) <= ROWS and case[1].condition < 1e3]
    for first in range(0, len(cases), BATCH):
        part = cases[first : first + BATCH]
        D, A = np.zeros((2, BATCH, ROWS, COORDINATES))
        b, c, c_independent = np.zeros((3, BATCH, ROWS))
        independent = np.tile(np.eye(ROWS, COORDINATES, COORDINATES - ROWS), (BATCH, 1, 1))  # of coordinates that nothing moves
        M, F = np.tile(np.eye(COORDINATES), (BATCH, 1, 1)), np.zeros((BATCH, COORDINATES))
        for k, (scene, s, redundant) in enumerate(part):
            m, n = s.terms.psi_q.shape
            u = s.unit * scene.time**2
            mass = s.terms.mass * u**2 / (scene.mass * scene.length**2)
            rows = s.weights[:, None] * s.terms.psi_q * u
            free = s.terms.force / s.terms.mass / s.unit
            A[k, :m, :n], c[k, :m] = rows, s.weights * s.terms.gamma * scene.time**2
            D[k, :m, :n], b[k, :m] = rows / np.sqrt(mass), c[k, :m] - rows @ free
            M[k, range(n), range(n)], F[k, :n] = mass, mass * free
            kept = np.delete(np.arange(m), list(redundant))
            independent[k, : len(kept)], c_independent[k, : len(kept)] = A[k, kept], c[k, kept]
        given = jax.tree.map(jnp.asarray, (D, b, M, F, A, c, (independent, c_independent)))
        for name, x in _by_all(*given).items():
            for k, (scene, s, redundant) in enumerate(part):
                right, free = s.a / s.unit, s.terms.force / s.terms.mass / s.unit
                mass = s.terms.mass * (s.unit * scene.time**2) ** 2 / (scene.mass * scene.length**2)
                found = np.asarray(x[k])[: len(right)]
                found = free + found / np.sqrt(mass) if name in METHODS else found
                power = 1 if name in METHODS[:4] else 2
                size = max(np.max(abs(free)), np.max(abs(right)), 1e-3)
                without = redundant if name == "Augmented by LU" else ()
                tally.add(name, np.max(abs(found - right)) / size / growth(s, power, without), scene.label)


def check_states(tally: Tally, seed: int, structures: Iterable[int], members: int, other_structures: bool = True) -> int:
    """Check all properties of states on some mechanisms of each structure.

    Args:
        tally: What it adds to.
        seed: Of the series.
        structures: Their numbers.
        members: Mechanisms of each structure, at least two.
        other_structures: Whether to check what needs programs of other structures.

    Returns:
        How many mechanisms there were.
    """
    count, cases = 0, []
    for structure in structures:
        rng = np.random.default_rng([seed, structure, 2])
        drawn = [random_scene(seed, structure, number) for number in range(members)]
        count += members
        both = [(scene, s) for scene, s in zip(drawn, map(solve, drawn), strict=True) if s.is_clear]
        tally.leave_out("singular up to rounding, or nearly", members - len(both))
        redundant = udk.analyse(build(both[0][0].table)).redundant_rows if both else None
        if redundant is None:
            tally.leave_out("closed positions nearby are not found, or all are singular", len(both))
            continue
        cases += [(*case, redundant) for case in _check_structure(tally, both, redundant, rng, other_structures)[::4]]
    check_methods(tally, cases)
    return count


def _check_structure(
    tally: Tally, both: Sequence[tuple[RandomScene, Solved]], redundant: Sequence[int], rng: Any, other_structures: bool
) -> Sequence[tuple[RandomScene, Solved]]:
    scenes, solved = [scene for scene, _ in both], [s for _, s in both]
    grown = [growth(s, without=redundant) for s in solved]
    mechanism = build(scenes[0].table)
    programs, (q, v) = Programs(mechanism, redundant, [scene.table for scene in scenes]), states_of(scenes)
    terms = programs.terms(q, v)
    check_energy(tally, scenes[0], mechanism, solved[0].terms)
    a, safe = programs.accelerations(q, v)
    check_reciprocity(tally, scenes, programs, solved, grown, rng)
    tally.leave_out("elimination says that it is not safe", int(np.sum(~safe)))
    for k, (scene, s) in enumerate(both):
        check_terms(tally, scene, s, terms[k])
        if safe[k]:
            check_accelerations(tally, scene, s, a[k], grown[k])

    # Half of the mechanisms are turned and moved, the other half, or all that cannot be turned, get other units.
    can_turn, others, back = can_be_turned(scenes[0].table), [], []
    tally.leave_out(
        "tied to the axes or the origin of the ground, so that the scene cannot be turned", 0 if can_turn else len(both)
    )
    for k, scene in enumerate(scenes):
        if can_turn and k % 2 == 0:
            c, d = np.cos(turn := rng.uniform(-3.0, 3.0)), np.sin(turn)
            others.append(moved(scene, turn, scene.length * rng.uniform(-3.0, 3.0, 2)))
            back.append(np.kron(np.eye(a.shape[1] // 3), [[c, d, 0.0], [-d, c, 0.0], [0.0, 0.0, 1.0]]))
        else:
            L, T, M = 10.0 ** rng.uniform(-3.0, 3.0, 3)
            others.append(in_units(scene, L, T, M))
            back.append(np.diag(np.tile([1 / L, 1 / L, 1.0], a.shape[1] // 3)) * T**2)
    found, is_safe = Programs(mechanism, redundant, [scene.table for scene in others]).accelerations(*states_of(others))
    for k in np.flatnonzero(safe & is_safe):
        name = "rigid motion" if can_turn and k % 2 == 0 else "units"
        tally.add(name, relative(back[k] @ found[k], a[k], solved[k].unit, 1.0) / grown[k], scenes[k].label)
    if other_structures and safe[0]:
        check_file(tally, scenes[0], mechanism, redundant)
        check_structures(tally, scenes[0], redundant, solved[0], accelerate(scenes[0], mechanism, redundant)[0], rng)
    return both


def check_large(tally: Tally, seed: int, structures: Iterable[int]) -> int:
    """Hold the loops of large scenes, run by NumPy, against the reference; return how many scenes there were."""
    count = 0
    for structure in structures:
        scene = random_scene(seed, structure, 0, bodies=(22, 40))
        mechanism, solved = build(scene.table), solve(scene)
        q, v = (x.ravel() for x in state_of(scene.table))
        programs, terms, at = scene_programs(mechanism), solved.terms, scene.label
        numbers = np.asarray(numbers_as_vector(mechanism.at(0.0).numbers))
        row, column, *_ = programs.psi_q_entries
        arrays = SceneArrays(programs, numbers, np)
        (psi, rate, values), (free, b) = arrays.geometry(0.0, q, v), arrays.loads(0.0, q, v)
        psi_q = np.zeros_like(terms.psi_q)
        np.add.at(psi_q, (row, column), values)
        found = {"psi": psi, "psi_q": psi_q, "psi_dot": rate, "gamma": b + psi_q @ free, "free": free}
        w, length = solved.weights, np.tile([scene.length, scene.length, 1.0], len(q) // 3)
        speed, reach = (max(1.0, np.max(abs(x / length))) for x in (v * scene.time, q))
        size = max(speed**2 * reach, *(np.max(abs(x)) * scene.time**2 for x in (free / length, w * terms.gamma)))
        right = {"psi": terms.psi, "psi_q": terms.psi_q, "psi_dot": terms.psi_dot, "gamma": terms.gamma}
        for name, unit in (("psi", reach), ("psi_dot", reach * speed / scene.time), ("gamma", size / scene.time**2)):
            tally.add("large scenes", np.max(abs(w * (found[name] - right[name]))) / unit, at)
        tally.add("large scenes", np.max(abs(w[:, None] * (psi_q - terms.psi_q) * length)) / reach, at)
        tally.add("large scenes", relative(free, terms.force / terms.mass, length / scene.time**2, 1.0), at)
        count += 1
    return count
