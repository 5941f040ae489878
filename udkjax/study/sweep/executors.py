"""Compute the chunks of a sweep: on this machine's devices or cores, or by the workers of dask.distributed."""

import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, TypeAlias, cast

import jax
import numpy as np

from udkjax.equations.analysis import analyse
from udkjax.extras import OptionalImport
from udkjax.integrate.solution import Result, versions
from udkjax.study.members import concurrent_chunks, cores
from udkjax.study.sweep.groups import RESULT, GroupRun, group_run
from udkjax.study.sweep.plan import Chunk, SweepPlan

if TYPE_CHECKING:
    import distributed

Done: TypeAlias = tuple[Chunk, dict[str, np.ndarray], float]  # a chunk, what it gave, and how long that took (s)
Executor: TypeAlias = Callable[[SweepPlan, Sequence[Chunk]], Generator[Done, None, None]]  # hands over chunks as they are done

CHUNK_RETRIES = 2  # of a chunk that raised: on another worker there may be memory, or room on the disk
TASKS_AHEAD = 2  # tasks for each thread of the cluster, so that none waits for the next; more would only fill the workers' memory
LEAST_TASKS = 16  # tasks, so that a cluster that grows by what is asked of it sees that something is


def run(plan: SweepPlan, chunk: Chunk) -> Done:
    """Compute the members of a chunk: each stored variable (members, ...), with "result". A failing member has a code, and NaN.

    Where a member's numbers made rows independent that the mechanism leaves out as redundant, it is run again without them.
    """
    group = group_run(plan, chunk.group)
    group.compile()  # compiling is not counted
    begun = time.perf_counter()
    found = group.compute(chunk.members)
    if group.redundant and group.varied:
        for rows, which in _other_redundant_rows(group, chunk.members, found[RESULT]).items():
            for name, values in group_run(plan, chunk.group, rows).compute(chunk.members[which]).items():
                found[name][which] = values
    return chunk, found, time.perf_counter() - begun


def _other_redundant_rows(group: GroupRun, members: np.ndarray, result: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """Find members that drifted, although they were projected, as other rows of theirs are redundant: by these rows."""
    found: dict[tuple[int, ...], list[int]] = {}
    for k in np.flatnonzero(result == Result.drift).tolist():
        own = jax.tree.map(lambda x: x[0], group.own(members[k : k + 1]))
        rows = analyse(group.mechanism(group.shared, own, {})).redundant_rows
        if rows is not None and rows != group.redundant:
            found.setdefault(rows, []).append(k)
    return {rows: np.array(which) for rows, which in found.items()}


# --- where chunks are computed


def compute_on_devices(plan: SweepPlan, chunks: Sequence[Chunk]) -> Generator[Done, None, None]:
    """Compute chunks, and hand each over when it is done."""
    waiting, width = deque(chunks), concurrent_chunks()
    with ThreadPoolExecutor(width, thread_name_prefix="sweep") as pool:
        running = set()
        try:
            while waiting or running:
                while waiting and len(running) < width:
                    running.add(pool.submit(run, plan, waiting.popleft()))
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
        finally:
            for future in running:
                future.cancel()


class ClusterError(RuntimeError):
    """A cluster cannot do a sweep."""


def dask_engine(client: "distributed.Client | None" = None) -> Executor:
    """Return the engine on the workers of a `distributed.Client`; without one, the client that was made last.

    Workers may come and go: another one computes what a lost one had not delivered. Each result is handed over when it
    arrives, and stored nowhere else. Raises `ClusterError` where there is no client, where a worker has
    other versions of the packages that decide the results, and where workers die time and again over one chunk.
    """
    with OptionalImport():
        import distributed
    if client is None:
        try:
            client = distributed.default_client()
        except ValueError:
            raise ClusterError(
                "the engine 'dask' needs a client: client=distributed.Client(address), or a Client() made before, whose worker "
                'processes are on this machine (in a script: below `if __name__ == "__main__":`)'
            ) from None

    def engine(plan: SweepPlan, chunks: Sequence[Chunk]) -> Generator[Done, None, None]:
        wanted = _deciding_versions()
        # Not scattered: data that was scattered is gone with the worker that held it, what a task returned is made again.
        shared = client.submit(_same, plan, pure=False)
        waiting, running, results = deque(chunks), {}, distributed.as_completed()

        def fill() -> None:
            room = max(LEAST_TASKS, TASKS_AHEAD * sum(cast("dict[str, int]", client.nthreads()).values())) - len(running)
            for _ in range(min(room, len(waiting))):
                chunk = waiting.popleft()
                future = client.submit(_run, shared, chunk, wanted, pure=False, retries=CHUNK_RETRIES, priority=-chunk.index)
                running[future.key] = chunk, future
                results.add(future)

        try:
            fill()
            for future in results:
                chunk, _ = running[future.key]
                try:
                    done = future.result()
                except distributed.KilledWorker as error:
                    raise ClusterError(
                        f"chunk {chunk.index} ({len(chunk.members)} members) was being computed by several workers that died; "
                        f"they may be short of memory: give them more, or a smaller `memory` to the sweep ({error})"
                    ) from error
                del running[future.key]
                future.release()
                fill()
                yield done
        finally:
            client.cancel([shared, *(future for _, future in running.values())])

    return engine


@contextmanager
def start_client(scheduler: str | None = None) -> Iterator["distributed.Client"]:
    """Start a client of the scheduler at this address; without one, of a process for each core, which end with the client."""
    with OptionalImport():
        import distributed
    cluster = {"n_workers": cores(), "threads_per_worker": 1, "dashboard_address": ":0"}
    with nullcontext(scheduler) if scheduler is not None else distributed.LocalCluster(**cluster) as where:
        try:
            client = distributed.Client(where)
        except (OSError, ValueError) as error:
            raise ClusterError(f"no scheduler of dask answers at {scheduler}: {error}") from error
        with client:
            yield client


def _same(plan: SweepPlan) -> SweepPlan:
    return plan


def _run(plan: SweepPlan, chunk: Chunk, wanted: dict[str, str]) -> Done:
    """Compute a chunk on a worker."""
    if (found := _deciding_versions()) != wanted:
        differing = ", ".join(f"{name} {found[name]} instead of {wanted[name]}" for name in wanted if found[name] != wanted[name])
        raise ClusterError(f"a worker has other versions of what decides the results: {differing}")
    return run(plan, chunk)


def _deciding_versions() -> dict[str, str]:
    return {name: version for name, version in versions().items() if name != "python"}
