"""What this machine and this environment are, ready to paste into a bug report."""

import os
import platform

import jax
import jax.numpy as jnp

from udkjax.integrate.solution import versions
from udkjax.native import machine
from udkjax.study.machine import cores

FLAGS = ("JAX_", "UDKJAX_", "XLA_", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS")


def doctor() -> str:
    """Describe versions, devices, precision and cores, and what could be better."""
    lines = {
        **versions(),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "cores": f"{cores()} of {os.cpu_count()}",
        "devices": ", ".join(f"{device} ({device.device_kind})" for device in jax.devices()),
        "precision": f"{jnp.result_type(float)}",
        "engine": f"machine code, {machine.lanes()} lanes; diffrax where a run needs it",
        "machine code": _cache(),
        "environment": ", ".join(f"{key}={value}" for key, value in sorted(os.environ.items()) if key.startswith(FLAGS)) or "-",
    }
    width = max(map(len, lines))
    advice = [f"! {line}" for line in _advice()] or ["nothing to complain about"]
    return "\n".join([f"{key:<{width}}  {value}" for key, value in lines.items()] + advice)


def _cache() -> str:
    sizes, folder = [size for _, size, _ in machine.kept()], machine.cache_folder()
    return "not kept" if folder is None else f"{len(sizes)} kept in {folder}, {sum(sizes) / 2**20:.1f} MiB"


def _advice():
    if jnp.result_type(float) != jnp.float64:
        yield "float64 is off, so that loops close to single precision only: unset JAX_ENABLE_X64, or set it to 1"
