"""All four-bars through nine points: a parameter homotopy from 1,442 stored classes of solutions, then certificates.

Nine generic points have 8,652 complex solutions, 1,442 classes of six: Roberts's three cognates, each with its dyads in either
order. nine_points.npz has one solution of each class, at random complex displacements (made by experiments/nine_points.py);
each is tracked to the requested displacements.

Source: C. W. Wampler, A. P. Morgan, A. J. Sommese, Complete solution of the nine-point path synthesis problem for four-bar
linkages, J. Mech. Des. 114 (1992).
"""

from functools import cache
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from udkjax.synthesis.complete.balls import LONG_DOUBLE, Ball
from udkjax.synthesis.complete.certificate import Certificate, certify
from udkjax.synthesis.complete.dyads import (
    DISPLACEMENTS,
    JOINT_UNKNOWNS,
    UNKNOWNS,
    Displacements,
    four_bar_system,
    newton_and_tangent,
)
from udkjax.synthesis.complete.four_bars import certainly_different
from udkjax.synthesis.complete.path_tracking import ACCEPTED, INFINITE, LOST, SINGULAR, PathTracker, Precision

CLASS_COUNT = 1442
STARTS_FILE = Path(__file__).with_name("nine_points.npz")
FIRST_PRECISION = Precision(3e-3, 3e-2, 1e-5)
CLOSE_PRECISION = Precision(3e-4, 3e-3, 1e-6)
BENDS = (0.0, 0.6, -0.6)  # detours around parameters at which solutions meet, tried in turn while classes are missing
SAME_CLASS_TOL = 1e-7  # relative difference of pivots below which classes are the same; raised if there are too many classes
# Largest imaginary parts, relative to the largest unknown: of candidates for a proof, and of unproven ends that count as real.
NEARLY_REAL, SURELY_REAL = 1e-4, 1e-8
REFINED_STEP = 1e-8  # largest Newton step at a regular solution, relative to the unknowns, with residuals in long precision
REFINEMENTS = 8  # largest number of Newton steps; each doubles the number of correct digits
SAME_PLACE_TOL = 1e-12  # relative to the extent: places or poses that differ by less are the same
# A coupler curve has degree six and passes three times through both isotropic points at infinity. A line or circle that is
# not part of the curve meets it in six further points at most.
MOST_ON_A_LINE = 6
ON_IT = 1e-10  # distance from a line or circle, relative to the extent, up to which a point lies on it


class Paths(NamedTuple):
    """Numbers of a homotopy's paths by the kind of their ends.

    Attributes:
        tracked: number of paths: one for each class of generic data.
        regular: distinct classes found.
        infinite: paths to four-bars with a joint at infinity.
        singular: paths to solutions that coincide or are not isolated.
        lost: paths that could not be tracked to their end.
    """

    tracked: int
    regular: int
    infinite: int
    singular: int
    lost: int


class OtherEnds(NamedTuple):
    """Ends of paths that are infinite, singular, lost or unproven: joints x, X, r, R, y, Y, s, S (8, K), and the kind of each."""

    joints: np.ndarray
    kinds: tuple[str, ...]


class RealClasses(NamedTuple):
    """A four-bar of each real class, in units of `scale`, relative to the first place.

    Attributes:
        boxes: boxes that contain exactly one solution: joint and crank of both dyads, then cosines minus one and sines of turns.
        paths: outcomes of all paths.
        ends: the other ends of paths, including those that appear to be real without a proof.
        scale: unit (m), a power of two.
    """

    boxes: Certificate
    paths: Paths
    ends: OtherEnds
    scale: float

    @property
    def unproven(self) -> int:
        """The number of classes that appear to be real but are not proven."""
        return self.ends.kinds.count("unproven")


def require_nine_points(points: np.ndarray) -> None:
    """Raise `ValueError` unless there are nine different points, with at most six on a line or circle."""
    if len(points) != 9:
        cure = "leave out the last one of a closed curve" if len(points) == 10 else "use `design` for fewer or more"
        raise ValueError(f"goal: finitely many four-bars go through nine points; there are {len(points)}: {cure}")
    extent = float(np.max(np.ptp(points, axis=0)))
    for i, j in combinations(range(9), 2):
        if np.max(np.abs(points[i] - points[j])) <= SAME_PLACE_TOL * extent:
            raise ValueError(
                f"goal: targets {i} and {j} are the same point: eight points leave infinitely many four-bars; move one"
            )
    z = (points - points.mean(axis=0)) / extent
    rows = np.column_stack([np.sum(z**2, axis=1), z, np.ones(9)])
    for columns, what in ((slice(1, 4), "line"), (slice(0, 4), "circle")):
        size = 2 if what == "line" else 3
        for chosen in combinations(range(9), size):
            normal = np.linalg.svd(rows[list(chosen), columns])[2][-1]
            on_it = np.abs(rows[:, columns] @ normal) <= ON_IT
            if np.count_nonzero(on_it) > MOST_ON_A_LINE:
                raise ValueError(
                    f"goal: {np.count_nonzero(on_it)} of the targets are on one {what}: a coupler curve meets a {what} in at "
                    f"most {MOST_ON_A_LINE} places, or contains it, as infinitely many four-bars do: use `design`"
                )


def find_real_classes(points: np.ndarray) -> RealClasses:
    """Return the real classes of four-bars through nine points (9, 2); raise `ValueError` if they may not be isolated."""
    require_nine_points(points)
    scale = power_of_two_near(points)
    places = np.asarray(points, LONG_DOUBLE) / scale
    d = places[1:] - places[0]
    z, paths, ends = find_classes((d[:, 0] + 1j * d[:, 1]).astype(complex))
    x, conjugates = z[0:JOINT_UNKNOWNS:2], z[1:JOINT_UNKNOWNS:2].conj()
    turn = 1.0 + z[JOINT_UNKNOWNS:]
    unreal = np.max(np.abs(turn - 1.0 / turn.conj()) / np.abs(turn), axis=0)  # turns may be complex even if joints are real
    reality = np.maximum(np.max(np.abs(x - conjugates), axis=0) / (1.0 + np.max(np.abs(z[:JOINT_UNKNOWNS]), axis=0)), unreal)
    near = reality < NEARLY_REAL
    joints, turns = 0.5 * (x + conjugates)[:, near], turn[:, near] / np.abs(turn[:, near]) - 1.0
    u = np.concatenate(
        [np.stack([np.real(joints), np.imag(joints)], 1).reshape(JOINT_UNKNOWNS, -1), np.real(turns), np.imag(turns)]
    )
    exact = Displacements(*(Ball.fractions(places[1:, k : k + 1]) - Ball.fractions(places[:1, k : k + 1]) for k in (0, 1)))
    with np.errstate(over="ignore", invalid="ignore"):  # Newton's method may diverge; the solution is then not proven
        boxes = certify(four_bar_system(displacements(places)), u, four_bar_system(exact))
    keep = np.flatnonzero(boxes.is_proven)
    keep = keep[distinct(isotropic(boxes.middle[:, keep]))]
    proven = keep[certainly_different(boxes.take(keep))]
    unproven = [*np.flatnonzero(~boxes.is_proven & (reality[near] < SURELY_REAL)), *np.setdiff1d(keep, proven)]
    ends = OtherEnds(np.concatenate([ends.joints, isotropic(u[:, unproven])], 1), (*ends.kinds, *["unproven"] * len(unproven)))
    return RealClasses(boxes.take(proven), paths, ends, scale)


def find_classes(d: np.ndarray) -> tuple[np.ndarray, Paths, OtherEnds]:
    """Return distinct regular solutions (16, M), one of each class, counts of paths, and other ends.

    Args:
        d: displacements (8,) of order one, complex.
    """
    target = np.concatenate([d, d.conj()])
    start, parameters = start_solutions()
    follow = tracker()

    def take(which: np.ndarray, precision: Precision, bend: float) -> tuple[np.ndarray, np.ndarray]:
        ends = follow(start[:, which], parameters, target, precision, bend)
        return _refined(ends.z, ends.status, target)

    all_paths = np.arange(start.shape[1])
    z, status = take(all_paths, FIRST_PRECISION, BENDS[0])
    unsettled = np.flatnonzero((status != ACCEPTED) | repeated(z, status == ACCEPTED))
    if len(unsettled):
        z[:, unsettled], status[unsettled] = take(unsettled, CLOSE_PRECISION, BENDS[0])
    classes = _merged(z[:, status == ACCEPTED])
    for bend in BENDS[1:]:
        if classes.shape[1] == CLASS_COUNT or not len(unsettled):
            break
        more, status_of_more = take(all_paths, CLOSE_PRECISION, bend)
        known, classes = classes.shape[1], _merged(classes, more[:, status_of_more == ACCEPTED])
        if classes.shape[1] == known:
            break
    missing, ends = CLASS_COUNT - classes.shape[1], {}
    for code, name in ((INFINITE, "infinite"), (SINGULAR, "singular"), (LOST, "lost")):
        ends[name] = np.flatnonzero(status == code)[: missing - sum(map(len, ends.values()))]
    infinite, singular = len(ends["infinite"]), len(ends["singular"])
    paths = Paths(CLASS_COUNT, classes.shape[1], infinite, singular, missing - infinite - singular)
    which = np.concatenate(list(ends.values()))
    return classes, paths, OtherEnds(z[:JOINT_UNKNOWNS, which], tuple(name for name, indices in ends.items() for _ in indices))


@cache
def tracker() -> PathTracker:
    """Return the compiled path tracker of four-bars through nine points."""
    return PathTracker(newton_and_tangent(), UNKNOWNS)


@cache
def start_solutions() -> tuple[np.ndarray, np.ndarray]:
    """Return the stored solutions (16, 1442) and their displacements (16,)."""
    with np.load(STARTS_FILE) as file:
        joints, parameters = file["joints"], file["displacements"]
    z, converged = tracker().polish(np.concatenate([joints, turns_of(joints, parameters)]), parameters)
    if not converged.all():
        raise RuntimeError(
            f"{STARTS_FILE} is damaged: {np.count_nonzero(~converged)} of its solutions do not converge; reinstall udkjax"
        )
    return z, parameters


def turns_of(joints: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the turns f (8, M) of four-bars with given joints; the dyads' equations are linear in 1 + f and 1 / (1 + f)."""
    d, D = parameters[:DISPLACEMENTS, None], parameters[DISPLACEMENTS:, None]
    rows = []
    for x, X, r, R in (joints[:4], joints[4:]):
        a, A = x - r, X - R
        rows.append((x * (D - A), X * (d - a), a * D + A * d - d * D - x * A - X * a))
    (u, v, w), (p, q, s) = rows
    return (w * q - v * s) / (u * q - v * p) - 1.0


def displacements(places: np.ndarray) -> Displacements:
    """Return displacements from the first of J + 1 places, as balls; the places are exact, their differences are rounded."""
    moved = Ball.of(places[1:]) - Ball.of(places[:1])
    return Displacements(moved.part(np.s_[:, :1]), moved.part(np.s_[:, 1:]))


def power_of_two_near(points: np.ndarray) -> float:
    """Return the power of two closest to the size of a set of points; division by a power of two is exact."""
    spread = points - points.mean(axis=0)
    return 2.0 ** np.round(np.log2(np.sqrt(np.mean(np.sum(spread**2, axis=1)))))


def isotropic(u: np.ndarray) -> np.ndarray:
    """Return x, X, r, R, y, Y, s, S (8, M) from real coordinates."""
    z = (u[0:JOINT_UNKNOWNS:2] + 1j * u[1:JOINT_UNKNOWNS:2]).astype(complex)
    return np.stack([z, z.conj()], 1).reshape(JOINT_UNKNOWNS, -1)


# --- equal classes


def class_keys(z: np.ndarray) -> np.ndarray:
    """Return invariants (4, M) of the six solutions of a class: symmetric functions of the pivots a, b, c of all cognates."""
    x, X, r, R, y, Y, s, S = z[:JOINT_UNKNOWNS]
    a, A, b, B = x - r, X - R, y - s, Y - S
    with np.errstate(all="ignore"):  # ends that are not solutions overflow
        c, C = a - (b - a) * x / (y - x), A - (B - A) * X / (Y - X)
        return np.stack([a + b + c, A + B + C, a * b + b * c + c * a, a * A + b * B + c * C])


def repeated(z: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Return a mask (M,) of the solutions whose class occurs more than once among those that the mask `which` selects."""
    mask, places = np.zeros(z.shape[1], bool), np.flatnonzero(which)
    mask[places[np.unique(_pairs(z[:, places]))]] = True
    return mask


def distinct(z: np.ndarray, most: float = CLASS_COUNT) -> np.ndarray:
    """Return the indices of the first solution of each class; the tolerance is raised until there are at most `most` classes."""
    alike = SAME_CLASS_TOL
    while True:
        keep = np.ones(z.shape[1], bool)
        for i, j in _pairs(z, alike):
            keep[j] &= not keep[i]
        if np.count_nonzero(keep) <= most:
            return np.flatnonzero(keep)
        alike *= 10.0


def _pairs(z: np.ndarray, alike: float = SAME_CLASS_TOL) -> np.ndarray:
    """Return pairs i < j of solutions of the same class, sorted."""
    if not z.shape[1]:
        return np.zeros((0, 2), int)
    keys = class_keys(z)
    with np.errstate(all="ignore"):
        size = np.maximum(np.abs(keys), 1e-300)
        keys = keys / size * np.log1p(size)  # absolute differences of large keys become relative ones
    table = np.concatenate([np.real(keys), np.imag(keys)]).T
    pairs = KDTree(np.where(np.isfinite(table), table, 0.0)).query_pairs(alike, output_type="ndarray")
    return pairs[np.lexsort(pairs.T[::-1])]


def _merged(*sets: np.ndarray) -> np.ndarray:
    z = np.concatenate(sets, axis=1)
    return z[:, distinct(z)]


# --- ends of paths


def _refined(z: np.ndarray, status: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ends of paths (16, M) and their status; ends not accepted are refined in long precision, and accepted if regular."""
    status, z = status.copy(), z.copy()
    open_ends = np.flatnonzero((status != ACCEPTED) & np.isfinite(z).all(axis=0))
    if not len(open_ends):
        return z, status
    w, p = z[:, open_ends].astype(np.clongdouble), target.astype(np.clongdouble)
    size = np.full(len(open_ends), np.inf)
    for _ in range(REFINEMENTS):
        columns = np.maximum(np.abs(w), 1e-3).astype(float)
        slopes = _jacobian(w.astype(complex), target) * columns.T[:, None, :]
        singular = ~(np.linalg.slogdet(np.where(np.isfinite(slopes), slopes, 0.0))[1] > -np.inf)
        slopes[singular] = np.eye(UNKNOWNS)
        step = np.linalg.solve(slopes, _residuals(w, p).T.astype(complex)[..., None])[..., 0].T
        size = np.where(singular, np.inf, np.max(np.abs(step), axis=0))
        w = w - np.where(np.isfinite(step), step, 0.0) * columns
    good = size < REFINED_STEP
    z[:, open_ends[good]], status[open_ends[good]] = w[:, good], ACCEPTED
    return z, status


def _residuals(z: np.ndarray, p: np.ndarray) -> np.ndarray:
    f, d, D = z[JOINT_UNKNOWNS:], p[:DISPLACEMENTS, None], p[DISPLACEMENTS:, None]
    F, residuals = -f / (1 + f), []
    for x, X, r, R in (z[:4], z[4:JOINT_UNKNOWNS]):
        e, E = d + f * x, D + F * X
        residuals.append(e * (E + R) + E * r)
    return np.concatenate(residuals)


def _jacobian(z: np.ndarray, p: np.ndarray) -> np.ndarray:
    f, d, D = z[JOINT_UNKNOWNS:], p[:DISPLACEMENTS, None], p[DISPLACEMENTS:, None]
    F, places = -f / (1 + f), np.arange(DISPLACEMENTS)
    jacobian = np.zeros((z.shape[1], UNKNOWNS, UNKNOWNS), complex)
    for k, first in ((0, 0), (4, DISPLACEMENTS)):
        x, X, r, R = z[k : k + 4]
        e, E = d + f * x, D + F * X
        for column, slope in enumerate((f * (E + R), F * (e + r), E, e)):
            jacobian[:, first : first + DISPLACEMENTS, k + column] = slope.T
        jacobian[:, first + places, JOINT_UNKNOWNS + places] = (x * (E + R) - X * (e + r) / (1 + f) ** 2).T
    return jacobian
