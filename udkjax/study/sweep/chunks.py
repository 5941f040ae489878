"""Chunks of a sweep: members of a group that together take a few seconds, as estimated from a first chunk of the group.

Members are sorted by their expected number of steps, the largest first; devices then wait only briefly for the last chunk.
"""

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from udkjax.study.members import concurrent_chunks
from udkjax.study.sweep.dataset import bytes_per_member
from udkjax.study.sweep.executors import Done, Executor, run
from udkjax.study.sweep.groups import group_run
from udkjax.study.sweep.plan import Chunk, SweepPlan

DEFAULT_MEMORY = 2**30  # default limit of the memory of members in computation (bytes)
CHUNK_COPIES = 4  # number of copies of a chunk's stored variables in memory during its computation
CHUNK_SECONDS = 2.0  # approximate work in a chunk (s); limits the loss by interruptions, and the time between reports
CHUNKS_FOR_EACH = 4  # number of chunks per device or core, to keep all of them busy to the end
SHORTEST_CHUNK = 0.05  # least work in a chunk (s); the overhead is a few hundredths of it
MOST_TRIED_GROUPS = 3  # number of groups timed to estimate a cost; the others are assumed to be as fast on average
# The number of steps grows approximately as this power of 1 / rtol, and of 1 / atol, for methods of 8th order.
TOLERANCE_POWER = 1 / 16


def compute_members(
    plan: SweepPlan,
    engine: Executor,
    done: Int[np.ndarray, "n"] | Sequence[int] = (),
    memory: int = DEFAULT_MEMORY,
    expect: Callable[[Sequence[Chunk]], None] = lambda chunks: None,
) -> Iterator[Done]:
    """Compute the members that are not done, and yield each finished chunk with its data and duration.

    First, some pieces of each group are computed, then chunks whose size follows from the duration of these. `expect` is called
    with the chunks that follow the first ones, with `work` in seconds.
    """
    orders = members_to_compute(plan, done)
    measured = []
    for chunk, data, seconds in engine(plan, firsts := first_chunks(plan, orders)):
        measured.append((chunk, seconds))
        yield chunk, data, seconds
    computed = np.concatenate([np.zeros(0, int), *(chunk.members for chunk in firsts)])
    remaining = {index: members[~np.isin(members, computed)] for index, members in orders.items()}
    if chunks := cut_chunks(plan, remaining, measured, memory):
        expect(chunks)
        yield from engine(plan, chunks)


def members_to_compute(plan: SweepPlan, done: Int[np.ndarray, "n"] | Sequence[int] = ()) -> dict[int, np.ndarray]:
    """Return the unfinished members of each group, the longest runs first; finished groups are omitted."""
    by_group = {}
    for group in plan.groups:
        members = group.members[~np.isin(group.members, done)]
        if len(members):
            by_group[group.index] = members[np.argsort(-expected_steps(plan, members), kind="stable")]
    return by_group


def first_chunks(plan: SweepPlan, orders: Mapping[int, np.ndarray]) -> list[Chunk]:
    """Return chunks of one piece each, as many as can be computed concurrently, to measure the speed of each group."""
    chunks: list[Chunk] = []
    for index, members in orders.items():
        piece = group_run(plan, index).program.size
        size = min(len(members), piece * -(-concurrent_chunks() // len(orders)))
        chosen = members[np.linspace(0, len(members) - 1, size).round().astype(int)]
        chunks += [
            _chunk(plan, len(chunks) + k, index, chosen[start : start + piece]) for k, start in enumerate(range(0, size, piece))
        ]
    return chunks


def cut_chunks(
    plan: SweepPlan, orders: Mapping[int, np.ndarray], measured: Sequence[tuple[Chunk, float]], memory: int = DEFAULT_MEMORY
) -> list[Chunk]:
    """Cut the members of each group, in order, into chunks of a few seconds of work and at most `memory` bytes.

    `measured` are finished chunks with their duration (s); groups without a finished chunk are assumed to be as fast as the
    others.
    """
    largest = max(1, memory // (CHUNK_COPIES * max(1, bytes_per_member(plan))))
    pace = {index: [seconds / chunk.work for chunk, seconds in measured if chunk.group == index] for index in orders}
    usual = float(np.mean([seconds / chunk.work for chunk, seconds in measured])) if measured else 0.0
    seconds = {k: expected_steps(plan, members) * (np.mean(pace[k]) if pace[k] else usual) for k, members in orders.items()}
    share = sum(float(times.sum()) for times in seconds.values()) / (CHUNKS_FOR_EACH * concurrent_chunks())
    chunks: list[Chunk] = []
    for index, members in orders.items():
        for selection in _cut(
            seconds[index], group_run(plan, index).program.size, largest, min(CHUNK_SECONDS, max(SHORTEST_CHUNK, share))
        ):
            chunks.append(Chunk(len(measured) + len(chunks), index, members[selection], float(seconds[index][selection].sum())))
    return chunks


def _cut(seconds: Float[np.ndarray, "n"], piece: int, most: int, limit: float = CHUNK_SECONDS) -> list[slice]:
    """Return consecutive slices of members, each of whole pieces, at most `limit` seconds and at most `most` members."""
    most = max(piece, most // piece * piece)
    parts, start = [], 0
    total = np.concatenate([[0.0], np.cumsum(seconds)])
    while start < len(seconds):
        enough = int(np.searchsorted(total, total[start] + limit, side="right")) - 1 - start
        left = len(seconds) - start
        size = left if left <= min(most, enough) else min(most, max(piece, enough // piece * piece), left)
        parts.append(slice(start, start + size))
        start += size
    return parts


def _chunk(plan: SweepPlan, index: int, group: int, members: np.ndarray) -> Chunk:
    return Chunk(index, group, members, float(expected_steps(plan, members).sum()))


def expected_steps(plan: SweepPlan, members: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Estimate the number of steps of members, up to a common factor, from the duration of their runs and their tolerances."""
    places, steps = plan.places(members), np.ones(len(members))
    for column in plan.columns:
        if not column.is_choice and not callable(column.of):
            values = np.maximum(column.numbers, np.finfo(float).tiny)
            if "t1" in column.of:
                steps = steps * (values / values.max())[places[column.name]]
            if tolerances := len({"rtol", "atol"} & set(column.of)):
                steps = steps * ((values / values.max()) ** (-tolerances * TOLERANCE_POWER))[places[column.name]]
    return steps


# --- before a sweep is run


@dataclass(frozen=True)
class SweepCost:
    """The cost of a sweep in this process, on its devices."""

    members: int
    groups: int  # number of programs, each compiled once
    tried: int  # number of groups of which a first chunk was run
    chunks: int
    stored: int  # bytes of the dataset, and approximately of the files
    memory: int  # peak memory of this process (bytes)
    compiling: float  # time of compiling (s); less if programs are in the cache
    computing: float  # time of computing (s)


def estimate_cost(plan: SweepPlan, memory: int = DEFAULT_MEMORY) -> SweepCost:
    """Estimate the cost of a plan by compiling and running a piece of some of its groups."""
    orders, compiling, measured = members_to_compute(plan), [], []
    count = len(plan.groups)
    for k in np.unique(np.linspace(0, count - 1, min(count, MOST_TRIED_GROUPS)).astype(int)).tolist():
        begun = time.perf_counter()
        group_run(plan, k).compile()
        compiling.append(time.perf_counter() - begun)
        chunk, _, seconds = run(plan, first_chunks(plan, {k: orders[k]})[0])
        measured.append((chunk, seconds))
    chunks = cut_chunks(plan, orders, measured, memory)
    stored = plan.size * bytes_per_member(plan)
    used = _resident() + min(memory, stored) + stored
    computing = sum(chunk.work for chunk in chunks) / concurrent_chunks()
    all_compiling = count * float(np.mean(compiling))
    return SweepCost(plan.size, count, len(measured), len(chunks), stored, used, all_compiling, computing)


def _resident() -> int:
    """Return the peak memory of this process so far (bytes); 0 if it is unknown."""
    try:
        import resource
    except ImportError:  # not available on Windows
        return 0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
