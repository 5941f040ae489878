"""Programs that another process finds without tracing: the same results, others for other structures, and what is not kept."""

import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.integrate import explicit
from udkjax.kept import Kept, _UnknownError, _words
from udkjax.scene.fields import number

TRACED = []
MECHANISM = udk.library.parallelogram()


def swing(mechanism, x, factor):
    """Of the arrays of a mechanism, and numbers beside them."""
    TRACED.append(1)
    named = {"numbers": x * factor, "factor": factor, "also": (None, "as it is")}
    return named, mechanism.gravity + x.sum(), x


def singular_values(x):
    TRACED.append(1)
    return jnp.linalg.svd(x, compute_uv=False)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A cache of its own, which JAX has been using from the start."""
    monkeypatch.setattr("udkjax.kept._folder", lambda: tmp_path)
    del TRACED[:]
    return tmp_path


def once_more(function=swing):
    """What another process has: nothing at hand."""
    return Kept(function)


def traced(call):
    """How often the function was traced for a call, and what came out."""
    before = len(TRACED)
    found = call()
    return len(TRACED) - before, found


def test_what_is_found_gives_the_same(folder):
    x = jnp.arange(3.0)
    times, made = traced(lambda: once_more()(MECHANISM, x, 2.0))
    assert times == 1
    (file,) = folder.iterdir()
    assert file.name.startswith("udkjax-")
    times, found = traced(lambda: once_more()(MECHANISM, x, 2.0))
    assert times == 0
    assert jax.tree.structure(found) == jax.tree.structure(made)
    jax.tree.map(np.testing.assert_array_equal, found, made)
    assert found[0]["also"] == (None, "as it is")
    np.testing.assert_allclose(found[0]["numbers"], [0.0, 2.0, 4.0], rtol=1e-15)


def test_other_numbers_take_the_same_program_and_other_structures_another():
    x, kept = jnp.arange(3.0), once_more()
    kept(MECHANISM, x, 2.0)
    other = MECHANISM.with_parameters({"gravity": [1.0, -3.0]})
    again = once_more()
    times, (named, total, _) = traced(lambda: again(other, x + 1.0, 2.0))
    assert times == 0
    np.testing.assert_allclose(named["numbers"], [2.0, 4.0, 6.0], rtol=1e-15)
    np.testing.assert_allclose(total, [7.0, 3.0], rtol=1e-15)
    arguments = {
        "another shape": (MECHANISM, jnp.arange(4.0), 2.0),
        "another type": (MECHANISM, jnp.arange(3), 2.0),
        "another known number": (MECHANISM, x, 3.0),
        "of another type": (MECHANISM, x, 2),
        "another mechanism": (udk.library.four_bar(), x, 2.0),
        "an array": (MECHANISM, x, number(2.0)),
        "of a weak type": (MECHANISM, x, jnp.asarray(2.0)),
    }
    counts = {name: traced(lambda a=a: again(*a))[0] for name, a in arguments.items()}
    weak = jnp.asarray(2.0).weak_type != number(2.0).weak_type
    assert counts == {name: int(weak or name != "of a weak type") for name in arguments}
    assert {name: traced(lambda a=a: again(*a))[0] for name, a in arguments.items()} == dict.fromkeys(arguments, 0)


def test_what_is_traced_or_looked_at_is_left_to_jax(folder):
    x = jnp.arange(3.0)

    def first(x):
        return once_more()(MECHANISM, x, 2.0)[0]["numbers"]

    np.testing.assert_allclose(jax.jit(first)(x), 2 * x)
    np.testing.assert_allclose(jax.vmap(first)(jnp.ones((2, 3))), 2.0)
    np.testing.assert_allclose(jax.jacfwd(first)(x), 2 * np.eye(3))
    jax.make_jaxpr(lambda: first(x))()  # all numbers are known, but it is the program of somebody else
    with jax.debug_nans(True):
        first(x)
    assert not [*folder.iterdir()]


def test_what_calls_a_library_is_not_kept(folder):
    x = jnp.diag(jnp.arange(3.0))
    for _ in range(2):
        times, found = traced(lambda: once_more(singular_values)(x))
        assert times == 1
        np.testing.assert_allclose(found, [2.0, 1.0, 0.0], atol=1e-15)
    assert not [f for f in folder.iterdir() if f.name.startswith("udkjax")]


def test_what_a_user_has_changed_or_written_is_not_kept(folder, monkeypatch):
    x = jnp.arange(3.0)

    class Mine(SimpleNamespace):
        pass

    for unknown in (Mine(), lambda: 1.0, np.sin, object()):
        with pytest.raises(_UnknownError):
            list(_words((1.0, {"name": unknown})))
    for changed, name in ((explicit, "SAFETY"), (udk.Mechanism, "with_parameters")):
        kept = once_more()
        with monkeypatch.context() as patch:
            patch.setattr(changed, name, None)
            kept(MECHANISM, x, 2.0)
        assert not [*folder.iterdir()]
    with monkeypatch.context() as patch:
        patch.setattr("os.path.exists", lambda path: False)  # who cannot see the package does not know which one it is
        once_more()(MECHANISM, x, 2.0)
    assert not [*folder.iterdir()]
    once_more()(MECHANISM, x, 2.0)
    assert [*folder.iterdir()]


def test_arrays_are_told_by_their_numbers_only_where_these_are_known_to_the_program():
    one, two = np.zeros(3), np.ones(3)
    assert [*_words(one)] == [*_words(two)]
    assert [*_words(one, known=True)] != [*_words(two, known=True)]
    with pytest.raises(_UnknownError):
        list(_words(jnp.ones(3), known=True))


@pytest.mark.parametrize("harm", [lambda data: data[:100], lambda data: data[:-1] + b"?", lambda data: b""])
def test_a_file_that_is_not_whole_is_made_again(folder, harm):
    x = jnp.arange(3.0)
    once_more()(MECHANISM, x, 2.0)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(harm(whole))
    assert traced(lambda: once_more()(MECHANISM, x, 2.0))[0] == 1
    assert traced(lambda: once_more()(MECHANISM, x, 2.0))[0] == 0


def test_where_nothing_can_be_written_it_runs(tmp_path, monkeypatch):
    nowhere = tmp_path / "file"
    nowhere.write_text("no folder")
    monkeypatch.setattr("udkjax.kept._folder", lambda: nowhere)
    np.testing.assert_allclose(once_more()(MECHANISM, jnp.arange(3.0), 2.0)[0]["numbers"], [0.0, 2.0, 4.0])


SECOND = """
import sys
import jax, numpy as np
import udkjax as udk
mechanism = udk.load(sys.argv[1])
compiled = []
jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: compiled.append(event))
for mass in (2.0, 3.0):
    solution = udk.simulate(mechanism.with_parameters({"body.coupler.mass": mass}), np.linspace(0.0, 1.0, 3))
print(sum("backend_compile" in event for event in compiled), np.asarray(solution.q[-1, 0]).tolist())
"""


def test_a_second_process_simulates_without_compiling(tmp_path):
    scene = tmp_path / "scene.toml"
    udk.save(udk.library.parallelogram(), scene)
    environment = {name: text for name, text in os.environ.items() if not name.startswith("JAX_COMPILATION_CACHE")}
    environment["UDKJAX_COMPILATION_CACHE"] = str(tmp_path / "cache")
    run = [sys.executable, "-c", SECOND, str(scene)]
    first, second = (subprocess.run(run, env=environment, capture_output=True, text=True, check=True).stdout for _ in range(2))
    assert first.partition(" ")[0] != "0"
    assert second.partition(" ")[0] == "0"
    assert first.partition(" ")[2] == second.partition(" ")[2]
