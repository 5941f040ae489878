"""Computation of the chunks of a sweep: on this machine's devices or cores, or by the workers of dask.distributed."""

import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, TypeAlias, cast

import jax
import numpy as np

from udkjax.equations.rows.analysis import analysis_of
from udkjax.extras import OptionalImport
from udkjax.integrate.solution import Result, versions
from udkjax.study.members import concurrent_chunks
from udkjax.study.sweep.groups import RESULT, STEPS, GroupRun, group_run
from udkjax.study.sweep.plan import Chunk, SweepPlan
from udkjax.threads import thread_count

if TYPE_CHECKING:
    import distributed

Done: TypeAlias = tuple[Chunk, dict[str, np.ndarray], float]  # a chunk, its stored variables, and its duration (s)
Executor: TypeAlias = Callable[[SweepPlan, Sequence[Chunk]], Generator[Done, None, None]]  # yields chunks as they finish

CHUNK_RETRIES = 2  # number of retries after an error: another worker may have enough memory, or space on the disk
TASKS_AHEAD = 2  # number of tasks per thread of the cluster, to keep all threads busy; more would only fill the workers' memory
LEAST_TASKS = 16  # least number of tasks, for an adaptive cluster to start workers


def run(plan: SweepPlan, chunk: Chunk) -> Done:
    """Compute the stored variables (members, ...) of a chunk. Failed members have their code in "result", and NaN elsewhere.

    If other rows are redundant for the numbers of a member than for the group's mechanism, the member is run again with these
    rows.
    """
    group = group_run(plan, chunk.group)
    group.compile()  # the duration does not include compiling
    begun = time.perf_counter()
    stored = group.compute(chunk.members)
    if group.redundant and group.varied:
        for rows, which in other_redundant_rows(group, chunk.members, stored[RESULT]).items():
            for name, values in group_run(plan, chunk.group, rows).compute(chunk.members[which]).items():
                stored[name][which] = values
    seconds, steps = time.perf_counter() - begun, stored[STEPS].astype(float)
    share = steps / steps.sum() if steps.any() else np.full(len(steps), 1 / len(steps))
    return chunk, stored | dict.fromkeys(group.seconds, seconds * share), seconds


def other_redundant_rows(group: GroupRun, members: np.ndarray, result: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """Return the indices in `members` of members that drifted because their redundant rows differ from the group's.

    The result maps the members' own redundant rows to these indices.
    """
    by_rows: dict[tuple[int, ...], list[int]] = {}
    for k in np.flatnonzero(result == Result.drift).tolist():
        inputs = jax.tree.map(lambda x: x[0], group.own(members[k : k + 1]))
        analysis = analysis_of(group.mechanism(group.shared, inputs, {}))
        rows = None if analysis is None else analysis.redundant_rows
        if rows is not None and rows != group.redundant:
            by_rows.setdefault(rows, []).append(k)
    return {rows: np.array(which) for rows, which in by_rows.items()}


# --- executors


def compute_on_devices(plan: SweepPlan, chunks: Sequence[Chunk]) -> Generator[Done, None, None]:
    """Compute chunks, and yield each one when it is finished."""
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
    """A cluster cannot compute a sweep."""


def dask_engine(client: "distributed.Client | None" = None) -> Executor:
    """Return the executor on the workers of a `distributed.Client`, by default the most recent client.

    Workers may come and go; unfinished chunks of a lost worker are computed by another. Each result is yielded when it arrives,
    and removed from the cluster.

    Raises:
        ClusterError: there is no client, a worker has other versions of packages that affect results, or a chunk killed several
            workers.
    """
    with OptionalImport():
        import distributed
    if client is None:
        try:
            client = distributed.default_client()
        except ValueError:
            raise ClusterError(
                "the engine 'dask' needs a client: client=distributed.Client(address), or create a Client() first for workers on "
                'this machine (in a script: below `if __name__ == "__main__":`)'
            ) from None

    def engine(plan: SweepPlan, chunks: Sequence[Chunk]) -> Generator[Done, None, None]:
        wanted = _deciding_versions()
        # A task, not scattered data: scattered data is lost with its worker, while the result of a task is computed again.
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
                        f"several workers died while computing chunk {chunk.index} ({len(chunk.members)} members), perhaps for "
                        f"lack of memory: give them more, or give the sweep a smaller `memory` ({error})"
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
    """Return a context with a client of the scheduler at an address; by default of new worker processes, one per thread.

    The client, and new workers, end with the context.

    Raises:
        ClusterError: no scheduler answers at the address.
    """
    with OptionalImport():
        import distributed
    cluster = {"n_workers": thread_count(), "threads_per_worker": 1, "dashboard_address": ":0"}
    with nullcontext(scheduler) if scheduler is not None else distributed.LocalCluster(**cluster) as where:
        try:
            client = distributed.Client(where)
        except (OSError, ValueError) as error:
            raise ClusterError(f"no dask scheduler answers at {scheduler}: {error}") from error
        with client:
            yield client


def _same(plan: SweepPlan) -> SweepPlan:
    return plan


def _run(plan: SweepPlan, chunk: Chunk, wanted: dict[str, str]) -> Done:
    if (found := _deciding_versions()) != wanted:
        differing = ", ".join(f"{name} {found[name]} instead of {wanted[name]}" for name in wanted if found[name] != wanted[name])
        raise ClusterError(f"a worker has other versions of packages that determine the results: {differing}")
    return run(plan, chunk)


def _deciding_versions() -> dict[str, str]:
    return {name: version for name, version in versions().items() if name != "python"}
