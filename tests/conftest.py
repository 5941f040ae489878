"""What more than one floor is tested with."""

import json
import os
import shutil
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

# What the tests compile stays out of the user's cache; the processes of one run share theirs.
OWN_CACHE = None if "UDKJAX_CACHE" in os.environ else tempfile.mkdtemp(prefix="udkjax-cache-")
CACHE = os.environ.setdefault("UDKJAX_CACHE", OWN_CACHE or "")
jax.config.update("jax_compilation_cache_dir", f"{CACHE}/jax")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

import udkjax as udk
from udkjax.native import operation
from udkjax.study.cases import Case, Scope, plan
from udkjax.study.drift_law import growth_rate, swing_of
from udkjax.study.record import dataset

DATA = Path(__file__).parent / "data"
SCOPE = Scope(
    "made up",
    tolerances=(1e-8, 1e-6),
    stiff_end=2.0,
    starts=2,
    others=("VODE", "Dopri8"),
    work_tolerances=(1e-6, 1e-8),
    gains_for=("SVD",),
)
INSTANTS = 81
MAPS = 20_000  # pieces of memory; Linux lets a process have 65,530
LOST = {1e-8: 10.0, 1e-6: 13.0}  # s


def pytest_unconfigure():
    if OWN_CACHE:
        shutil.rmtree(OWN_CACHE, ignore_errors=True)


@pytest.fixture(scope="module", autouse=True)
def mapped_memory():
    """Forget compiled programs before there are more than a process may map: XLA maps memory for each, many times."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_text().splitlines()) > MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def data():
    """A file of reference values, by its name."""
    return lambda name: json.loads((DATA / f"{name}.json").read_text())


@pytest.fixture(scope="session")
def compilations():
    """What is compiled while a function runs, or taken from a cache: how long XLA took for each (s), and 0 of our own code."""
    seen: list[float] = []

    def listen(event: str, duration_secs: float, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            seen.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)

    def during(run) -> list[float]:
        seen.clear()
        before = operation.compiled.cache_info().misses
        run()
        return [*seen, *[0.0] * (operation.compiled.cache_info().misses - before)]

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
def study_data():
    """The dataset of a study whose runs are made up: without stabilization the drift grows by its law until `LOST`."""
    mech = udk.library.parallelogram()
    state = udk.assemble(mech)
    rate = growth_rate(swing_of(mech, state.q))
    cases = plan(SCOPE)
    cases += [
        Case("work", method, solver, tol, alpha=3.0, beta=3.0)
        for method, solver, tol in (("SVD", "Adams", 1e-6), ("SVD", "Adams", 1e-8))
    ]
    rows = [made_up(case, number, rate) for number, case in enumerate(cases)]
    settings = {"scope": "made up", "max_steps": 1000, "start": -45.0, "seed": 3, "solver": "Adams"}
    return dataset(mech, state, cases, rows, settings, {"seconds": 61.5, "seconds_compiling": 40.25})


def made_up(case: Case, number: int, rate: float) -> dict:
    """One run; every number of it is another one than that of every other run."""
    ts = np.linspace(0.0, case.end, INSTANTS)
    drifts = case.alpha < 2 and case.group in ("paper", "other integrators", "rank held", "start", "law")
    sigma = 1e-15 * np.exp((rate - case.alpha) * ts) if drifts else np.full(INSTANTS, 1e-15)
    lost = drifts and case.alpha == 0
    error = np.where(ts > LOST[case.tol], 1.0, case.tol) if lost else np.full(INSTANTS, case.tol * (1 + number / 1000))
    fails = case.method == "Varga" and case.group == "paper" and case.alpha == 0 and case.tol == 1e-8
    alive = ts <= (7.3 if fails else case.end)
    history = lambda values: np.where(alive, values, np.nan)  # noqa: E731
    return {
        "time": ts,
        "angle": history(-np.pi / 4 * np.cos(3 * ts)),
        "angle_error": history(error),
        "position_error": history(error / 2),
        "psi2": history((1.1 + number / 100) * sigma**2),
        "psi_dot2": history(sigma**2),
        "energy": history(error / 3),
        "sigma_1": history(3.0 + 0 * ts),
        "sigma_11": history(0.7 + 0 * ts),
        "sigma_12": history(sigma),
        "rank": history(np.where(sigma > (case.rank_tol or 1e-4), 12.0, 11.0)),
        "rank_tol": case.rank_tol or 3e-4,
        "end": 7.3 if fails else case.end,
        "result": "step_limit" if fails else "successful",
        "cpu": 0.0101 * (number + 1),
        "repeats": 3,
        "steps": 1300 + number,
        "accepted": 1200 + number,
        "rejected": 100,
        "right_hand_sides": 15000 + number,
        "projections": 0,
    }
