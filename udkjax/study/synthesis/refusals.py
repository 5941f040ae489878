"""Positions of which solutions are not isolated, or are none: refused with the reason and the cure."""

from itertools import combinations

import numpy as np

SAME = 1e-12  # of the extent: places nearer than that are one
# A coupler curve has degree six and passes three times through both isotropic points at infinity: a line meets it in six
# points, a circle in 12 - 6 others, unless it is a part of the curve.
MOST_ON_A_LINE = 6
ON_IT = 1e-10  # of the extent: off a line or circle


def require_nine_points(points: np.ndarray) -> None:
    """Raise `ValueError` unless four-bars through nine points may be isolated solutions."""
    if len(points) != 9:
        cure = "leave out the last one of a closed curve" if len(points) == 10 else "use `design` for fewer or more"
        raise ValueError(f"goal: finitely many four-bars go through nine places; there are {len(points)}: {cure}")
    extent = float(np.max(np.ptp(points, axis=0)))
    for i, j in combinations(range(9), 2):
        if np.max(np.abs(points[i] - points[j])) <= SAME * extent:
            raise ValueError(f"goal: targets {i} and {j} are the same place: eight places leave infinitely many four-bars")
    z = (points - points.mean(axis=0)) / extent
    rows = np.column_stack([np.sum(z**2, axis=1), z, np.ones(9)])
    for columns, what in ((slice(1, 4), "line"), (slice(0, 4), "circle")):
        size = 2 if what == "line" else 3
        for chosen in combinations(range(9), size):
            normal = np.linalg.svd(rows[list(chosen), columns])[2][-1]
            on_it = np.abs(rows[:, columns] @ normal) <= ON_IT
            if np.count_nonzero(on_it) > MOST_ON_A_LINE:
                raise ValueError(
                    f"goal: {np.count_nonzero(on_it)} of the targets are on one {what}: a four-bar's curve meets a {what} in at "
                    f"most {MOST_ON_A_LINE} places, or it is a part of the curve, as of infinitely many: use `design`"
                )


def require_five_poses(poses: np.ndarray) -> None:
    """Raise `ValueError` unless dyads through five poses may be isolated solutions."""
    if len(poses) != 5:
        raise ValueError(f"goal: finitely many four-bars go through five poses; there are {len(poses)}: use `design`")
    extent = float(np.max(np.ptp(poses[:, :2], axis=0))) or 1.0
    for i, j in combinations(range(5), 2):
        off = poses[i] - poses[j]
        turn = abs((off[2] + np.pi) % (2 * np.pi) - np.pi)
        if np.max(np.abs(off[:2])) <= SAME * extent and turn <= SAME:
            raise ValueError(f"goal: targets {i} and {j} are the same pose: four poses leave infinitely many four-bars")
