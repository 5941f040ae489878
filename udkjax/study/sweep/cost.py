"""What the members of a sweep cost: chunks of those alike in cost, and what all of it will take.

Where a device takes members side by side, one that is done waits for the slowest of its piece. So members are ordered by the
steps that they will take: a sample is run, and a polynomial in the axes fitted to the logarithm of its steps. The longest come
first: what is left for the end, where devices wait for the last chunk, is short.
"""

import sys
import time
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Float

from udkjax.pinv import Auto, Elimination
from udkjax.study.machine import concurrent_chunks
from udkjax.study.sweep.dataset import bytes_per_member
from udkjax.study.sweep.executors import program, run
from udkjax.study.sweep.plan import Chunk, Group, Plan
from udkjax.study.sweep.program import STEPS, lane_steps

MEMORY = 2**30  # bytes that members in computation take at most, by default
PILOT = 256  # members of a sample: 4 for each coefficient of a polynomial of second degree in nine axes
WORTH = 8  # a sample is run of groups that are so many times as large
SECONDS = 2.0  # of work in a chunk, roughly: what an interruption loses, and how often progress is seen
TURNS, LEAST = 4, 0.05  # chunks for each that computes at a time, so that all have something to do; but none shorter (s)
SHARE = 4  # chunks in memory at a time, and copies of each: of what is stored, of its parts on the device
# Seconds, roughly, of a step of twelve rows: by straight-line code in lanes, and by a dense method.
QUICK, DENSE = 1e-6, 5e-4
STEPS_GUESSED = 300.0
WIDE = 8.0  # an axis of positive values that differ by more than this factor is taken by its logarithm
GROUPS = 3  # whose programs are compiled and tried, at most; the others are taken to be as fast, on average
FEW = 4  # members of a sample where these are computed one after another


def cut_chunks(plan: Plan, memory: int = MEMORY) -> list[Chunk]:
    """Cut the members of a plan into chunks of at most `memory` bytes and a few seconds of work, those alike in cost together.

    The same on every machine of a kind: where the cost is not known beforehand, a sample of the members is run.
    """
    found: list[Chunk] = []
    for group in plan.groups:
        own = program(plan, group)
        steps = expected_steps(plan, group)
        order = np.argsort(-steps, kind="stable")
        most = max(1, memory // (SHARE * max(1, bytes_per_member(plan))))
        seconds = steps[order] * _seconds_per_step(plan, group)
        enough = max(LEAST, float(seconds.sum()) / (TURNS * concurrent_chunks()))
        for part in _cut(seconds, own.piece * len(own.devices), most, min(SECONDS, enough)):
            found.append(Chunk(len(found), group.index, group.members[order[part]], float(seconds[part].sum())))
    return found


def _cut(seconds: Float[np.ndarray, "n"], piece: int, most: int, limit: float = SECONDS) -> list[slice]:
    """Cut members into consecutive parts of whole pieces, each of at most `limit` seconds and of at most so many members."""
    most = max(piece, most // piece * piece)
    parts, start = [], 0
    total = np.concatenate([[0.0], np.cumsum(seconds)])
    while start < len(seconds):
        enough = int(np.searchsorted(total, total[start] + limit, side="right")) - 1 - start
        rest = len(seconds) - start
        size = rest if rest <= min(most, enough) else min(most, max(piece, enough // piece * piece), rest)
        parts.append(slice(start, start + size))
        start += size
    return parts


def expected_steps(plan: Plan, group: Group) -> Float[np.ndarray, "n"]:
    """Estimate the steps that the members of a group will take: up to a common factor, where no sample is run."""
    features, own = _features(plan, group), program(plan, group)
    if own.piece == 1 or len(group.members) < WORTH * PILOT or features.shape[1] == 0:
        return _by_rule(plan, group)
    basis = _polynomial(features)
    sample = np.sort(np.random.default_rng(0).choice(len(group.members), PILOT, replace=False))
    first = sample[np.argsort(-_by_rule(plan, group)[sample], kind="stable")]
    steps = own(group.members[first])[STEPS]
    fit = np.linalg.lstsq(basis[first], np.log(np.maximum(steps, 1)), rcond=None)[0]
    return np.exp(basis @ fit)


def _by_rule(plan: Plan, group: Group) -> Float[np.ndarray, "n"]:
    """Estimate steps beforehand: they grow with the length of a run, and slowly with the tightness of its tolerances."""
    places, steps = plan.places(group.members), np.full(len(group.members), STEPS_GUESSED)
    for column in plan.columns:
        if not column.is_choice and not callable(column.of):
            values = column.numbers[places[column.name]]
            if "t1" in column.of:
                steps = steps * values / np.max(values)
            tolerances = len({"rtol", "atol"} & set(column.of))
            steps = steps * np.maximum(values, 1e-300) ** (-tolerances / 16) if tolerances else steps
    return steps


def _features(plan: Plan, group: Group) -> Float[np.ndarray, "n d"]:
    """Return the axes of a group's members, each from -1 to 1: numbers, or their logarithms, and which choices were made."""
    places, found = plan.places(group.members), []
    for column in plan.columns:
        at = places[column.name]
        if column.is_choice:
            found += [np.where(at == k, 1.0, -1.0) for k in group.choices[column.name][1:]]
            continue
        for x in column.numbers[at].reshape(len(at), -1).T:
            low, high = x.min(), x.max()
            if low < high:
                x, low, high = (np.log(x), np.log(low), np.log(high)) if low > 0 and high > WIDE * low else (x, low, high)
                found.append(2 * (x - low) / (high - low) - 1)
    return np.stack(found, axis=1) if found else np.zeros((len(group.members), 0))


def _polynomial(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n terms"]:
    """Return all monomials of the features up to the second degree, or the first where the sample is too small for these."""
    n, d = x.shape
    terms = [np.ones(n), *x.T]
    if (d + 1) * (d + 2) // 2 <= PILOT // 4:
        terms += [x[:, i] * x[:, j] for i, j in combinations_with_replacement(range(d), 2)]
    return np.stack(terms, axis=1)


def _seconds_per_step(plan: Plan, group: Group) -> float:
    """Guess how long a step takes (s): the same on every machine, so that chunks are the same, too."""
    mechanism, method = plan.mechanism_of(group), plan.choice(group, "method")
    rows = max(1, 2 * len(mechanism.constraints)) / 12
    if isinstance(method, Auto | Elimination | None):
        return QUICK * rows
    return DENSE * max(rows, rows**3)


# --- before a sweep is run


@dataclass(frozen=True)
class SweepCost:
    """What a sweep will take in this process, on its devices."""

    members: int
    groups: int  # programs, each compiled once
    tried: int  # of these, of which a sample was run
    chunks: int
    stored: int  # bytes of the dataset, and roughly of the files
    memory: int  # bytes of this process, at most
    compiling: float  # s; less where programs are in the cache
    computing: float  # s


def estimate_cost(plan: Plan, memory: int = MEMORY) -> SweepCost:
    """Run a sample of some groups of a plan, and say what all of it will take.

    A sample takes a few seconds, most of them to compile. A lane waits for the slowest of its sample, but in the sweep members
    alike in cost are together: what was waited for is not counted.
    """
    count = len(plan.groups)
    chosen = [plan.groups[k] for k in np.unique(np.linspace(0, count - 1, min(count, GROUPS)).astype(int))]
    tried = [_measure_group(plan, group) for group in chosen]
    compiling = count * float(np.mean([seconds for seconds, _ in tried]))
    computing = plan.size * float(np.mean([seconds for _, seconds in tried])) / concurrent_chunks()
    stored = plan.size * bytes_per_member(plan)
    used = _resident() + min(memory, stored) + stored
    return SweepCost(plan.size, count, len(tried), len(cut_chunks(plan, memory)), stored, used, compiling, computing)


def _measure_group(plan: Plan, group: Group) -> tuple[float, float]:
    """Measure how long the program of a group takes to compile, and then a member of it (s)."""
    own = program(plan, group)
    size = min(len(group.members), own.piece * len(own.devices) if own.piece > 1 else FEW)
    sample = Chunk(0, group.index, np.random.default_rng(0).choice(group.members, size, replace=False), 0.0)
    first, seconds, found = 0.0, 0.0, {}
    for _ in range(2):
        begun = time.perf_counter()
        found = run(plan, sample)
        first, seconds = seconds, time.perf_counter() - begun
    taken, room = (1, 1) if own.lanes is None else lane_steps(found[STEPS], own.lanes)
    return max(first - seconds, 0.0), seconds * taken / room / size


def _resident() -> int:
    """Return the most memory that this process has used so far, in bytes; 0 where it cannot be known."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
