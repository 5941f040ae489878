"""Nine points have 1,442 classes of four-bars: monodromy finds all of them from any one of them, with any seed.

A complex four-bar drawn at random passes through the points of certain displacements. If these displacements are moved around a
triangle, the four-bar returns as another solution for the original displacements. Each loop doubles the number of known classes
until no more are found, since the monodromy group of this problem is transitive. Loops are random, so a class that does not
appear in three full loops in a row is unlikely to exist; the count agrees with that of Wampler, Morgan and Sommese (1992), who
used another method.

Claim: all seeds end with 1,442 classes. Followed to the same displacements, these classes are the same for all seeds, and the
same as those that the package stores as its starts. Both cognates of each class solve the equations, and Newton's method leaves
them in their class. For nine points drawn at random, dozens of classes are real.

`python -m experiments nine_points --set write=1` writes the package's file again, from the first seed.
"""

import numpy as np
import xarray
from matplotlib.figure import Figure

from experiments.common import described, panels, tracked
from experiments.parts.nine_point_monodromy import check, complex_numbers, loops, random_four_bar
from udkjax.show.plots import COLOURS
from udkjax.synthesis.complete.dyads import DISPLACEMENTS, JOINT_UNKNOWNS
from udkjax.synthesis.complete.nine_points import (
    CLASS_COUNT,
    CLOSE_PRECISION,
    STARTS_FILE,
    distinct,
    find_real_classes,
    start_solutions,
    tracker,
)
from udkjax.synthesis.complete.path_tracking import ACCEPTED

SEEDS = 3
SETS = 60  # of nine points, each coordinate normal
LOOPS = 30
PLACES = 30  # displacements, of which those are stored where the largest unknown is smallest
SMOKE = 40  # classes that a small run is content with
MATCH = 1e-6  # relative: keys of a class


def study(smoke: bool, seed: int = 1, write: int = 0) -> xarray.Dataset:
    """Classes after each loop of each seed, how many of them are those that are stored, and real classes of random points."""
    seeds = range(seed, seed + (1 if smoke else SEEDS))
    known = np.full((len(seeds), LOOPS), np.nan)
    off, failed, stored = (np.zeros(len(seeds)) for _ in range(3))
    for k, number in enumerate(tracked(seeds, "nine_points")):
        rng = np.random.default_rng(number)
        z, parameters = random_four_bar(rng)
        for n, more in enumerate(loops(rng, z, parameters, most=SMOKE if smoke else CLASS_COUNT + 1)):
            z, known[k, n:] = more, more.shape[1]
        found = check(z, parameters)
        off[k], failed[k], stored[k] = found["keys"], found["failed"], in_common(z, parameters)
        if write and k == 0:
            write_starts(rng, z, parameters)
    rng = np.random.default_rng(seed)
    sets = [rng.normal(size=(9, 2)) for _ in range(2 if smoke else SETS)]
    found = [find_real_classes(points) for points in tracked(sets, "random points")]
    data = xarray.Dataset(
        {
            "known": (("seed", "loop"), known, {"long_name": "classes known after each loop"}),
            "off": ("seed", off, {"long_name": "largest relative difference of keys within a class"}),
            "failed": ("seed", failed, {"long_name": "cognates at which Newton's method ends above 1e-12"}),
            "stored": ("seed", stored, {"long_name": "classes among those that are stored"}),
            "real_classes": ("set", [one.boxes.middle.shape[1] for one in found], {"long_name": "real classes, proven"}),
            "unproven": ("set", [one.unproven for one in found], {"long_name": "classes that appear to be real, unproven"}),
            "regular": ("set", [one.paths.regular for one in found], {"long_name": "distinct regular solutions"}),
        },
        coords={"seed": list(seeds)},
    )
    settings = {"precision": list(CLOSE_PRECISION), "loops": LOOPS, "places": PLACES}
    return described(data, "two dyads (x, a) and (y, b) of one link in nine positions, in isotropic coordinates", settings, seed)


def in_common(z: np.ndarray, parameters: np.ndarray) -> int:
    """Return how many solutions are stored ones, once they are followed to the displacements of those."""
    starts, displacements = start_solutions()
    ends = tracker()(z, parameters, displacements, CLOSE_PRECISION)
    moved = ends.z[:, ends.status == ACCEPTED]
    moved = moved[:, distinct(moved)]
    both = np.concatenate([starts, moved], axis=1)
    return both.shape[1] - len(distinct(both, most=np.inf))


def write_starts(rng: np.random.Generator, z: np.ndarray, parameters: np.ndarray) -> None:
    """Write the file of starts, at the best of some random displacements."""
    best, size = None, np.inf
    for _ in range(PLACES):
        place = complex_numbers(rng, 2 * DISPLACEMENTS)
        ends = tracker()(z, parameters, place, CLOSE_PRECISION)
        if (ends.status == ACCEPTED).all() and len(distinct(ends.z)) == CLASS_COUNT and np.abs(ends.z).max() < size:
            best, size = (ends.z[:JOINT_UNKNOWNS], place), np.abs(ends.z).max()
    if best is None:
        raise RuntimeError("no displacements were reached by all solutions: take another seed")
    np.savez(STARTS_FILE, joints=best[0], displacements=best[1])


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """The count is the same for all seeds, cognates are solutions, and so are the stored ones."""
    last = data.known[:, -1]
    full = CLASS_COUNT if not data.attrs["smoke"] else SMOKE
    return {
        "all seeds find the classes": bool((last == full).all() if not data.attrs["smoke"] else (last >= full).all()),
        "known classes nearly double in the first loops": bool((data.known[:, 3] >= 8).all()),
        "cognates are in the class that Newton's method keeps": bool(
            (data.off < MATCH).all() and (data.failed < 0.01 * 2 * last).all()
        ),
        "they are those that are stored": bool((data.stored == last).all()),
        "random points have all solutions": bool((data.regular == CLASS_COUNT).mean() >= 0.9 and (data.unproven == 0).all()),
        "some of them are real": bool((data.real_classes >= 1).all()),
    }


def headline(data: xarray.Dataset) -> str:
    """The count, after how many loops, and how many classes are real."""
    known, real = data.known.values.astype(int), data.real_classes.values
    taken = (known < known[:, -1:]).sum(axis=1) + 1
    return (
        f"{', '.join(map(str, known[:, -1]))} classes after {taken.min()} to {taken.max()} loops; "
        f"{int(data.stored.min())} are stored; {len(real)} random sets have {int(real.min())} to {int(real.max())} real classes, "
        f"median {np.median(real):g}; all {CLASS_COUNT} were found for {int((data.regular == CLASS_COUNT).sum())} sets"
    )


def figure(data: xarray.Dataset) -> Figure:
    """Draw how classes are found, and how many are real."""
    figure, ((left, right),) = panels(1, 2, 9.0, 3.6)
    for row, seed in enumerate(data.seed.values):
        left.semilogy(1 + np.arange(data.sizes["loop"]), data.known[row], "o-", ms=3, color=COLOURS[row], label=f"seed {seed}")
    left.axhline(CLASS_COUNT, color="0.5", lw=0.8)
    left.set(xlabel="loop", ylabel="classes known", title="Monodromy from one four-bar")
    left.legend(fontsize="small", frameon=False)
    right.hist(data.real_classes, bins=20, color=COLOURS[0])
    right.set(xlabel="real classes", ylabel="sets of nine random points", title="How many four-bars are real")
    return figure
