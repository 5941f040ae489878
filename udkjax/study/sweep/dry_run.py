"""What a sweep will take, before it is run: members, chunks, memory, and time from a sample of its members."""

import sys
import time
from dataclasses import dataclass

import numpy as np

from udkjax.study.machine import concurrent_chunks
from udkjax.study.sweep.chunk import bytes_per_member, program, run
from udkjax.study.sweep.cutting import MEMORY, cut_chunks, lane_steps
from udkjax.study.sweep.member import STEPS
from udkjax.study.sweep.plan import Chunk, Group, Plan

GROUPS = 3  # whose programs are compiled and tried, at most; the others are taken to be as fast, on average
FEW = 4  # members of a sample where these are computed one after another


@dataclass(frozen=True)
class SweepCost:
    """What a sweep will take in this process, on its devices."""

    members: int
    groups: int  # programs, each compiled once
    tried: int  # of these, of which a sample was run
    chunks: int
    kept: int  # bytes of the dataset, and roughly of the files
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
    kept = plan.size * bytes_per_member(plan)
    used = _resident() + min(memory, kept) + kept
    return SweepCost(plan.size, count, len(tried), len(cut_chunks(plan, memory)), kept, used, compiling, computing)


def _measure_group(plan: Plan, group: Group) -> tuple[float, float]:
    """How long the program of a group takes to compile, and then a member of it (s)."""
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
    """The most memory that this process has used so far, in bytes; 0 where it cannot be known."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
