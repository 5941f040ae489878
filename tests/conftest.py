"""Fixtures that tests of several folders share."""

import gc
import importlib
import json
import math
import os
import shutil
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

# What the tests compile stays out of the user's cache. The processes of one run share theirs, and the next run finds it: its keys
# are what was compiled, and by which version. `--cache-clear` empties it.
HAS_OWN_CACHE = "UDKJAX_CACHE" not in os.environ
CACHE = os.environ.setdefault("UDKJAX_CACHE", str(Path(__file__).parents[1] / ".pytest_cache" / "compiled"))
CACHE_SIZE = 2**30  # bytes; a cache that is larger before a run begins anew
# XLA compiles in less than half of the time what it does not optimize; no test is about how fast that runs.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
import udkjax as udk
from tests.quick_code import optimize
from tests.skipped import skipped_for
from udkjax import arrays
from udkjax.folders import is_writable
from udkjax.native import loaded_code
from udkjax.native.code import code_cache

optimize(False)  # but in tests/native
if folder := code_cache.cache_folder():  # what one process has compiled, however small, serves the other
    is_writable(folder)  # creates it for this user alone, before JAX creates it as the umask says
    jax.config.update("jax_compilation_cache_dir", f"{folder}/jax")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

# Tracing makes many small objects that live; Python looks through all of them again and again, a tenth of the time.
gc.collect()
gc.freeze()
gc.set_threshold(20_000, 20, 20)

DATA = Path(__file__).parent / "data"
CHROMIUM = ("/usr/bin/chromium", "/usr/bin/chromium-browser")
MAPS = 20_000  # pieces of memory; Linux lets a process have 65,530


def pytest_configure(config):
    if not HAS_OWN_CACHE or hasattr(config, "workerinput"):  # of a process that another one has started
        return
    size = sum(x.stat().st_size for x in Path(CACHE).rglob("*") if x.is_file())
    if config.getoption("cacheclear", False) or size > CACHE_SIZE:
        shutil.rmtree(CACHE, ignore_errors=True)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter):
    """Say at the very end what was skipped, and what would bring it."""
    result = yield
    lines = skipped_for(terminalreporter.stats.get("skipped", ()))
    if lines:
        terminalreporter.section("skipped")
        for line in lines:
            terminalreporter.write_line(line)
    return result


@pytest.fixture(scope="module", autouse=True)
def mapped_memory():
    """Drop compiled programs before the process reaches its limit of memory maps, of which XLA makes many for each program."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_text().splitlines()) > MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def data():
    """Return a file of reference values by its name."""
    return lambda name: json.loads((DATA / f"{name}.json").read_text())


@pytest.fixture(scope="session")
def compilations():
    """Record the programs compiled, or read from a cache, while a function runs: XLA's time for each (s), 0 for our code."""
    seen: list[float] = []

    def listen(event: str, duration_secs: float, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            seen.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)

    def during(run) -> list[float]:
        seen.clear()
        before = loaded_code.machine_code.cache_info().misses
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(arrays, "_WORTH_A_PROGRAM", math.inf)  # from some call on a program puts arrays on the device
            run()
        return [*seen, *[0.0] * (loaded_code.machine_code.cache_info().misses - before)]

    return during


@pytest.fixture(scope="session")
def placed():
    """q and v (4, 3) of the paper's linkage with its links at `theta` (rad), turning at `rate` (rad/s)."""

    def pose(theta, rate):
        def q(s):
            e = jnp.stack([jnp.cos(s), jnp.sin(s)])
            links = [jnp.append(jnp.array([x, 0.0]) + e / 2, s) for x in (0.0, 1.0, 2.0)]
            return jnp.stack([*links, jnp.append(jnp.array([1.0, 0.0]) + e, 0.0 * s)])

        return jax.jvp(q, (jnp.asarray(theta, float),), (jnp.asarray(rate, float),))

    return pose


@pytest.fixture(scope="session")
def linkage():
    """The paper's linkage."""
    return udk.library.parallelogram()


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium for the tests of a module. While it runs, its thread cannot run another event loop."""
    path = next((path for path in CHROMIUM if Path(path).exists()), None)
    missing = {
        "playwright (sh install.sh --test --browser)": find_spec("playwright") is None,
        "Chromium (apt-get install chromium)": path is None,
    }
    if any(missing.values()):
        pytest.skip(f"a browser is needed: {' and '.join(name for name, is_missing in missing.items() if is_missing)}")
    sync_api = importlib.import_module("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()
