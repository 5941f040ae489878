"""Chunks of a sweep on this machine: on all devices that JAX has, or on all cores of the one that it has."""

import time
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait

import jax
import numpy as np

from udkjax.study.machine import CHUNKED, cores
from udkjax.study.sweep.chunk import run
from udkjax.study.sweep.plan import Chunk, Plan

Done = tuple[Chunk, dict[str, np.ndarray], float]  # a chunk, what it gave, and how long it took (s)


def workers() -> int:
    """How many chunks are computed at a time.

    One CPU device runs as many programs side by side as it has cores; several devices share each chunk.
    """
    devices = jax.local_devices()
    return cores() if len(devices) == 1 and devices[0].platform in CHUNKED else 1


def devices(plan: Plan, chunks: Sequence[Chunk]) -> Generator[Done, None, None]:
    """Compute chunks, and hand each over when it is done."""
    waiting, width = deque(chunks), workers()
    with ThreadPoolExecutor(width, thread_name_prefix="sweep") as pool:
        running = set()
        try:
            while waiting or running:
                while waiting and len(running) < width:
                    running.add(pool.submit(_timed, plan, waiting.popleft()))
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
        finally:
            for future in running:
                future.cancel()


def _timed(plan: Plan, chunk: Chunk) -> Done:
    begun = time.perf_counter()
    data = run(plan, chunk)
    return chunk, data, time.perf_counter() - begun
