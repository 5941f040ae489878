"""What this machine and this environment are, ready to paste into a bug report."""

import os
import platform
import sys
from pathlib import Path

import jax
import jax.numpy as jnp

from udkjax.environment import programs_in
from udkjax.integrate.solution import versions
from udkjax.study.machine import cores

FLAGS = ("JAX_", "UDKJAX_", "XLA_", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS")
FAST_PYTHON = (3, 12)
OLDER_JAX = "what machine code does not serve takes longer"  # README says it, too


def doctor() -> str:
    """Describe versions, devices, precision and cores, and what could be better."""
    lines = {
        **versions(),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "cores": f"{cores()} of {os.cpu_count()}",
        "devices": ", ".join(f"{device} ({device.device_kind})" for device in jax.devices()),
        "precision": f"{jnp.result_type(float)}",
        "compiled programs": _cache(),
        "environment": ", ".join(f"{key}={value}" for key, value in sorted(os.environ.items()) if key.startswith(FLAGS)) or "-",
    }
    width = max(map(len, lines))
    advice = [f"! {line}" for line in _advice()] or ["nothing to complain about"]
    return "\n".join([f"{key:<{width}}  {value}" for key, value in lines.items()] + advice)


def _cache() -> str:
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if not folder or not jax.config.jax_enable_compilation_cache:  # pyright: ignore[reportAttributeAccessIssue]
        return "not kept"
    sizes = [size for _, size, _ in programs_in(Path(folder))]
    return f"{len(sizes)} kept in {folder}, {sum(sizes) / 2**20:.0f} MiB"


def _advice():
    if sys.version_info < FAST_PYTHON:
        yield (
            f"Python {platform.python_version()} cannot have jax 0.12; with an older one {OLDER_JAX}: "
            "install Python 3.12 or newer, remove .venv and run install.sh again"
        )
    elif jax.__version_info__ < (0, 12):
        yield f"with jax {jax.__version__}, older than 0.12, {OLDER_JAX}: pip install --upgrade jax"
    if jnp.result_type(float) != jnp.float64:
        yield "float64 is off, so that loops close to single precision only: unset JAX_ENABLE_X64, or set it to 1"
