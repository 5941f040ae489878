"""Importing the package enables float64 and skips garbage collection at exit, and changes nothing else."""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.fresh_process import python
from udkjax import threads

CONFTEST = str(Path(__file__).with_name("conftest.py"))
SHOW = "import os; print(jax.numpy.result_type(float), jax.config.jax_compilation_cache_dir, os.environ.get('XLA_FLAGS'))"
JAX_FIRST, UDKJAX_FIRST = "import jax, udkjax", "import udkjax, jax"


@pytest.mark.parametrize(
    ("order", "given", "dtype"),
    [
        (JAX_FIRST, {}, "float64"),
        pytest.param(UDKJAX_FIRST, {}, "float64", marks=pytest.mark.slow),
        pytest.param(JAX_FIRST, {"JAX_ENABLE_X64": "0"}, "float32", marks=pytest.mark.slow),
        (UDKJAX_FIRST, {"JAX_ENABLE_X64": "False"}, "float32"),
    ],
)
def test_float64_is_on_unless_the_environment_says_no(tmp_path, order, given, dtype):
    assert python(f"{order}; {SHOW}", HOME=tmp_path, **given) == f"{dtype} None None"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_single_precision():
    """Friction by load settles in float32, up to its rounding errors; runs that locate events are refused."""
    code = """
import numpy as np, udkjax as udk

bar, hinge = udk.Body(1.0, 1 / 12, position=(0.5, 0.0)), udk.Revolute(("ground", "bar"), [[0.0, 0.0], [-0.5, 0.0]])
ts, limit = np.linspace(0.0, 2.0, 5), udk.JointLimit("hinge", lower=-1.0, restitution=0.4)

def run(law, **choices):
    friction = udk.Friction("hinge", coefficient=0.3, radius=0.02, law=law)
    return udk.simulate(udk.Mechanism({"bar": bar}, {"hinge": hinge}, forces={"friction": friction}), ts, **choices)

print(*np.asarray(run("smooth").q[:, 0, 2], float))
for law, choices in (("smooth", {"events": limit}), ("set-valued", {})):
    try:
        run(law, **choices)
    except ValueError as error:
        print("leave JAX_ENABLE_X64 unset" in str(error))
"""
    angles, *refused = python(code, JAX_ENABLE_X64="0").splitlines()
    exact = python(code.split("for law")[0])
    assert_allclose(np.array(angles.split(), float), np.array(exact.split(), float), atol=1e-5)
    assert refused == ["True", "True"]


def test_a_function_that_asks_first_within_a_trace_is_traced_once(tmp_path):
    code = """
import jax
import udkjax as udk

traces = []

@jax.jit
def angle(x):
    traces.append(x)
    return udk.library.parallelogram(angle=x).q0[0, 2]

angle(0.1), angle(0.2)
print(len(traces))
"""
    assert python(code, HOME=tmp_path) == "1"


def test_nothing_of_python_is_changed_and_it_ends_without_looking_for_garbage(tmp_path):
    """Functions registered earlier are called later, and open files are still written."""
    code = """
import atexit, gc, os, sys
before = sys.meta_path[:], gc.isenabled(), gc.get_threshold()
atexit.register(lambda: print(gc.get_freeze_count() > 0))
import udkjax
udkjax.simulate
print(before == (sys.meta_path, gc.isenabled(), gc.get_threshold()))
file = open(os.environ["HOME"] + "/file", "w")
file.write("whole")
"""
    assert python(code, HOME=tmp_path).split() == ["True", "True"]
    assert (tmp_path / "file").read_text() == "whole"


def test_jax_is_missed_as_ever_where_it_is_not_installed(tmp_path):
    code = "import sys, udkjax; sys.path[:] = []\ntry: import jax\nexcept ImportError as e: print(e)"
    assert python(code, HOME=tmp_path) == "No module named 'jax'"


@pytest.mark.parametrize("choice", ["0", "{}/elsewhere"])
def test_the_environment_says_where_machine_code_is_kept(tmp_path, choice):
    code = "import udkjax as udk; udk.simulate(udk.library.compound_pendulum(), [0.0, 0.1])"
    home = tmp_path / "home"
    home.mkdir()
    python(code, HOME=home, UDKJAX_CACHE=choice.format(tmp_path))
    assert list(home.iterdir()) == []
    assert (tmp_path / "elsewhere").exists() == (choice != "0")
    if choice == "0":
        python(code, HOME=home)
        assert list((home / ".cache" / "udkjax").iterdir())


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system knows no affinity")
def test_threads_follow_the_affinity_of_the_process_and_the_setting():
    code = """
import os
from udkjax.threads import cores, thread_count
from udkjax.study.members import concurrent_chunks
first, *rest = os.sched_getaffinity(0)
print(cores() == 1 + len(rest), thread_count() == min(2, cores()))
os.sched_setaffinity(0, {first})
print(cores(), thread_count(), concurrent_chunks())
"""
    assert python(code, UDKJAX_THREADS=2).split() == ["True", "True", "1", "1", "1"]


@pytest.mark.parametrize("text", ["0", "-1", "four", "2.5", "²"])
def test_a_number_of_threads_that_is_none_is_an_error(monkeypatch, text):
    monkeypatch.setenv("UDKJAX_THREADS", text)
    with pytest.raises(ValueError, match=f"UDKJAX_THREADS must be a whole number of threads, 1 or more, not '{text}'"):
        threads.thread_count()


def test_without_a_cache_the_tests_keep_none_either(tmp_path):
    code = f"import jax, runpy; runpy.run_path({CONFTEST!r}); print(jax.config.jax_compilation_cache_dir)"
    assert python(code, HOME=tmp_path, UDKJAX_CACHE="0") == "None"
