"""The machine: how many programs it runs side by side, and what a time was measured on."""

import os
import platform
from pathlib import Path

import jax

CHUNKED_PLATFORMS = ("cpu",)  # devices that take a batch in chunks; others take it whole
PIECE_MEMBERS = 64  # of a chunk, on them


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def concurrent_chunks() -> int:
    """Return how many chunks are computed at a time.

    One CPU device runs as many programs side by side as it has cores; several devices share each chunk.
    """
    devices = jax.local_devices()
    return cores() if len(devices) == 1 and devices[0].platform in CHUNKED_PLATFORMS else 1


def machine() -> str:
    """Name the processor, how many of its cores may be used, and the system."""
    return f"{processor()}, {cores()} of {os.cpu_count()} cores, {platform.system()} {platform.release()}"


def processor() -> str:
    """Name the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
