"""Caches whose memory is bounded."""

import gc
import weakref

import numpy as np
import pytest

import udkjax as udk
from tests.choices import fast
from udkjax.native import loaded_code
from udkjax.native.module import loading
from udkjax.programs import identity_cache
from udkjax.programs.identity_cache import cached_by_size


@pytest.fixture
def most(monkeypatch):
    monkeypatch.setattr(identity_cache, "_STORED", type(identity_cache._STORED)())
    monkeypatch.setattr(identity_cache, "MOST_BYTES", 100)


def test_the_least_recently_used_results_of_all_functions_are_dropped(most):
    made = []

    def sized(name):
        @cached_by_size(lambda result: result)
        def function(size):
            made.append((name, size))
            return size

        return function

    one, other = sized("one"), sized("other")
    _ = one(40), other(41), one(40), one(42)  # 41 has to go: 40 was used after it
    assert identity_cache.stored_bytes() == 82
    _ = one(40), one(42)
    assert made == [("one", 40), ("other", 41), ("one", 42)]
    other(41)
    assert made[-1] == ("other", 41) and identity_cache.stored_bytes() <= 100
    assert other(1000) == 1000 and identity_cache.stored_bytes() == 1000  # the latest stays, whatever its size
    info = one.cache_info()
    assert (info.hits, info.misses, info.currsize) == (3, 2, 0)
    other.cache_clear()
    assert identity_cache.stored_bytes() == 0


@pytest.mark.slow
def test_machine_code_that_is_dropped_is_unloaded_unless_compiled_programs_call_it(most):
    """XLA keeps the addresses of code that compiled programs call."""

    def run(count):
        bodies = {f"b{k}": udk.Body(1.0, 0.1, [k + 0.5, 0.0]) for k in range(count)}
        udk.simulate(udk.Mechanism(bodies, {"A": udk.Revolute(["ground", "b0"], [[0, 0], [-0.5, 0]])}), np.array([0.0, 0.1]))
        (code,) = (x for x, _ in identity_cache._STORED.values() if isinstance(x, loaded_code.LoadedCode))
        return code

    code = run(1)
    library = weakref.ref(code._optimized.library)
    name = code._optimized._name
    assert loading._LOADED[name] is code._optimized and name not in loading._REGISTERED
    del code
    run(2)
    gc.collect()
    assert library() is None and name not in loading._LOADED
    registered = run(1)
    assert registered.name == name and loading._REGISTERED[name] is registered._optimized


TIMES = np.linspace(0.0, 0.1, 3)
QUESTIONS = {
    "simulate": lambda m: udk.simulate(m, TIMES),
    "inverse dynamics": lambda m: udk.inverse_dynamics(m, TIMES),
    "diffrax": lambda m: udk.simulate(m, TIMES, engine="jax"),
    "kinematics": lambda m: udk.kinematics(m, None, TIMES),
    "equilibrium": udk.equilibrium,
    "reactions": lambda m: udk.reactions(m, udk.simulate(m, TIMES)),
    "power balance": lambda m: udk.power_balance(m, udk.simulate(m, TIMES)),
    "diagnose": udk.diagnose,
    "explain": udk.explain,
}


@pytest.mark.parametrize("name", fast(["simulate"], QUESTIONS))
def test_a_mechanism_that_nobody_uses_is_forgotten(name):
    """Else all that is cached for it, programs of megabytes among them, stays in memory with it."""
    mechanism = udk.library.slider_crank()
    QUESTIONS[name](mechanism)
    kept = weakref.ref(mechanism)
    del mechanism
    gc.collect()
    assert kept() is None
