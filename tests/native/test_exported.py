"""Jitted runs, gradients and batches as bytes: a fresh process with another cache computes the same bits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import udkjax as udk
from tests.fresh_process import python

pytest.importorskip("flatbuffers")
PENDULUM, TS = udk.library.compound_pendulum(), np.linspace(0.0, 0.5, 3)
LOAD = """
import numpy as np
import udkjax as udk
for name in ("run", "gradient", "batch"):
    x = np.load(f"{folder}/{name}.x.npy")
    y = udk.load_exported(open(f"{folder}/{name}", "rb").read())(x)
    print(name, np.array_equal(y, np.load(f"{folder}/{name}.npy")))
"""


def motion(mass):
    return udk.simulate(PENDULUM.with_parameters({"body.rod.mass": mass}), TS, throw=False).q


def test_a_fresh_process_computes_the_same_bits(tmp_path):
    functions = {"run": motion, "gradient": jax.grad(lambda x: jnp.sum(jnp.sin(motion(x)))), "batch": jax.vmap(motion)}
    for name, f in functions.items():
        x = np.linspace(1.0, 2.0, 5) if name == "batch" else np.asarray(1.3)
        data = udk.export_compiled(f, x)
        (tmp_path / name).write_bytes(data)
        y = np.asarray(jax.jit(f)(x))
        assert_array_equal(udk.load_exported(data)(x), y)
        np.save(tmp_path / f"{name}.x.npy", x)
        np.save(tmp_path / f"{name}.npy", y)
    said = python(f"folder = {str(tmp_path)!r}\n{LOAD}", UDKJAX_CACHE=tmp_path / "cache", HOME=tmp_path)
    print(said)  # shown by pytest -s
    assert said.split() == ["run", "True", "gradient", "True", "batch", "True"]


def test_functions_that_call_python_and_other_bytes_are_refused():
    def by_diffrax(mass):
        return udk.simulate(PENDULUM.with_parameters({"body.rod.mass": mass}), TS, throw=False, engine="diffrax").q

    with pytest.raises(ValueError, match=r"cannot be exported: it calls Python: .*machine code"):
        udk.export_compiled(by_diffrax, 1.0)
    joint, state = next(iter(PENDULUM.joints)), udk.assemble(PENDULUM)
    rub = udk.Friction(joint, coefficient=0.2, radius=0.01, law="set-valued")
    sticking = udk.Mechanism(PENDULUM.bodies, PENDULUM.joints, {}, {"rub": rub}, PENDULUM.gravity)
    with pytest.raises(ValueError, match=f'cannot be exported: joints stick \\("{joint}"\\): give their friction law="smooth"$'):
        udk.export_compiled(lambda q: udk.simulate(sticking, TS, udk.State(q, state.v), throw=False).q, np.asarray(state.q))
    with pytest.raises(ValueError, match=r"the bytes that udkjax\.export_compiled returned"):
        udk.load_exported(b"something else")
