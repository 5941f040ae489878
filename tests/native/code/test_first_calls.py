"""First calls of an operation use quickly compiled code: its results, and when optimized code takes its place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import udkjax as udk
from tests.calls import calls_of
from tests.choices import needs_deferred
from udkjax.native import loaded_code
from udkjax.native.code import machine

TS = np.linspace(0.0, 1.0, 11)


@pytest.fixture
def calls(monkeypatch, tmp_path):
    """Calls by quickly compiled code: the code, its inputs, the shapes of its outputs, and its results."""
    monkeypatch.setenv("UDKJAX_CACHE", str(tmp_path))
    monkeypatch.setattr(machine, "_compiler", lambda: str(tmp_path))  # whose code nobody has loaded
    loaded_code.machine_code.cache_clear()
    with calls_of(loaded_code.LoadedCode._call_quickly) as made:
        yield made
    loaded_code.machine_code.cache_clear()


def crank(length, method=None):
    mechanism = udk.library.four_bar().with_parameters({"body.coupler.mass": length})
    return udk.simulate(mechanism, TS, method=method or udk.Auto()).q


@pytest.mark.parametrize(
    "run",
    [
        lambda: crank(1.0),
        lambda: crank(1.0, udk.Householder()),
        pytest.param(lambda: jax.vmap(crank)(jnp.linspace(0.5, 1.5, 5)), marks=needs_deferred),
        pytest.param(lambda: jax.grad(lambda x: crank(x)[-1, 0, 2])(1.0), marks=pytest.mark.slow),
        pytest.param(lambda: jax.jacfwd(crank)(1.0), marks=pytest.mark.slow),
    ],
    ids=["one", "Householder", "lanes", "reverse", "forward"],
)
def test_both_codes_round_alike(calls, run):
    run()
    assert calls
    for _, given, found in list(calls):
        for a, b in zip(found, given["self"].prepare(given["inputs"], given["shapes"])(), strict=True):
            assert_array_equal(a, b)


def test_a_run_of_many_steps_is_of_optimized_code(calls, monkeypatch):
    monkeypatch.setattr(loaded_code, "QUICK_STEPS", 10)
    found = udk.simulate(udk.library.four_bar(), TS)
    assert calls[-1].result is None and calls[-1].arguments["self"]._optimized.library.is_optimized
    assert found.result == udk.Result.successful and found.stats["steps"] > 10


def test_a_limit_of_the_user_stays_one(calls):
    mechanism = udk.library.four_bar()
    assert udk.simulate(mechanism, TS, max_steps=5, throw=False).result == udk.Result.step_limit
    assert all(call.result is not None for call in calls)


def test_what_is_called_often_is_optimized(calls, monkeypatch):
    monkeypatch.setattr(loaded_code, "QUICK_SECONDS_OF_LINE", 1e-12)  # of which the first call takes more
    mechanism = udk.library.four_bar()
    first = udk.simulate(mechanism, TS)
    count = len(calls)
    second = udk.simulate(mechanism, TS)
    assert count == len(calls) > 0
    assert_array_equal(first.q, second.q)


def test_optimized_code_on_disk_is_taken(calls):
    text = "define void @run(ptr %x) {\n  ret void\n}\ndefine void @call_frame(ptr %x) {\n  ret void\n}\n"
    assert not machine.library(text, ["run"], machine.QUICK_LEVEL).is_optimized
    machine.library(text, ["run"])
    assert machine.library(text, ["run"], machine.QUICK_LEVEL).is_optimized
