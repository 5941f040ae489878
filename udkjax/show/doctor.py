"""Facts about this machine and its environment, ready to paste into a bug report."""

import os
import platform
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.devices import default_devices, host_device
from udkjax.extras import EXTRAS
from udkjax.folders import is_writable, refusal
from udkjax.integrate import Solution, simulate
from udkjax.integrate.solution import versions
from udkjax.native.code.code_cache import cache_folder, cached_files
from udkjax.native.code.processor import lanes
from udkjax.scene.library import double_pendulum
from udkjax.study.members import processor
from udkjax.threads import cores, thread_count

FLAG_PREFIXES = ("JAX_", "UDKJAX_", "XLA_", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS")


def facts(run: Callable[..., Solution] = simulate) -> dict[str, Any]:
    """Return versions, devices, precision, engine, cache and advice, by names that scripts can rely on.

    `run` is the function that `engine_here` tries.
    """
    folder, sizes = cache_folder(), [size for _, size, _ in cached_files()]
    engine, reason = engine_here(run)
    return {
        "versions": versions(),
        "missing_extras": sorted({extra for package, extra in EXTRAS.items() if find_spec(package) is None}),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "processor": processor(),
        "cores": cores(),
        "cores_of_machine": os.cpu_count(),
        "threads": thread_count(),
        "devices": [f"{device} ({device.device_kind})" for device in jax.devices()],
        "precision": f"{jnp.result_type(float)}",
        "engine": engine,
        "engine_reason": reason,
        "lanes": lanes(),
        "cache": None if folder is None else str(folder),
        "cache_refused": None if folder is None else refusal(folder),
        "cached_programs": len(sizes),
        "cached_bytes": sum(sizes),
        "environment": {key: value for key, value in sorted(os.environ.items()) if key.startswith(FLAG_PREFIXES)},
        "advice": list(_advice(engine, reason)),
    }


def engine_here(run: Callable[..., Solution] = simulate) -> tuple[str, str]:
    """Run a small simulation by the function `run`; return its engine, "native", "diffrax", "jax" or "none", and the reason.

    The engine is "none" if the simulation fails.
    """
    try:
        solution = run(double_pendulum(), np.array([0.0, 0.1]))
    except Exception as error:
        return "none", f"a small simulation fails: {type(error).__name__}: {error}"
    engine, _, reason = solution.settings["engine"].partition(": ")
    return engine, reason or "by default; models that cannot be compiled are run by diffrax, see `Solution.settings`"


def summary(facts_by_name: dict[str, Any]) -> str:
    """Return the result of `facts` as a table of text, followed by the advice."""
    cached = f"{facts_by_name['cached_programs']} in {facts_by_name['cache']}, {facts_by_name['cached_bytes'] / 2**20:.1f} MiB"
    if facts_by_name["cache"] is None:
        cached = "nothing, because " + (
            "UDKJAX_CACHE=0 is set" if os.environ.get("UDKJAX_CACHE") == "0" else "there is no home folder"
        )
    elif facts_by_name["cache_refused"]:
        cached = f"nothing in {facts_by_name['cache']}, because {facts_by_name['cache_refused']}"
    lines = {
        **facts_by_name["versions"],
        "missing extras": ", ".join(facts_by_name["missing_extras"]) or "none",
        "system": facts_by_name["system"],
        "processor": facts_by_name["processor"],
        "cores": f"{facts_by_name['cores']} of {facts_by_name['cores_of_machine']}",
        "threads": f"{facts_by_name['threads']} (a limit can be set by UDKJAX_THREADS)",
        "devices": ", ".join(facts_by_name["devices"]),
        "precision": facts_by_name["precision"],
        "engine": f"{facts_by_name['engine']}: {facts_by_name['engine_reason']}",
        "machine code": f"{facts_by_name['lanes']} lanes (UDKJAX_LANES sets 1, 2, 4 or 8); cached: {cached}",
        "environment": ", ".join(f"{key}={value}" for key, value in facts_by_name["environment"].items()) or "-",
    }
    width = max(map(len, lines))
    advice = [f"! {line}" for line in facts_by_name["advice"]] or ["no problems found"]
    return "\n".join([f"{key:<{width}}  {value}" for key, value in lines.items()] + advice)


def _advice(engine: str, reason: str) -> Iterator[str]:
    if jnp.result_type(float) != jnp.float64:
        yield "float64 is off, so loops close only to single precision: unset JAX_ENABLE_X64, or set it to 1"
    if engine != "native":
        yield f"machine code is not used here ({reason}): simulations take up to a hundred times as long"
    kind = default_devices()[0].platform
    if kind != "cpu" and host_device() is None:
        yield f"small programs run on the {kind}, which is slow: JAX_PLATFORMS must name the cpu, too, as in cuda,cpu"
    folder = cache_folder()
    if os.environ.get("UDKJAX_CACHE") != "0" and (folder is None or not is_writable(folder)):
        location = "without a home folder" if folder is None else f"in {folder}"
        yield f"machine code cannot be stored {location}, and is compiled in each process: set UDKJAX_CACHE to a folder"
    elif folder is not None and (refused := refusal(folder)):
        yield (
            f"machine code in {folder} is neither executed nor stored, because {refused}: "
            f"run chmod go-w {folder}, or set UDKJAX_CACHE to a folder of your own"
        )
