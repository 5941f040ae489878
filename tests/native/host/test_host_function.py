"""Python functions in compiled programs: alone, in batches, in loops, and when they fail."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.fresh_process import python
from udkjax.native.host.host_function import call_host


@dataclass(frozen=True)
class Norms:
    """The norm of each row, times a number common to all."""

    fails: bool = False

    def shapes(self, members):
        return [(members,), (members, 2)]

    def __call__(self, *inputs):
        factor, rows = inputs
        if self.fails:
            raise ValueError("no norm today")
        return [np.linalg.norm(rows, axis=1) * factor[:, 0], np.stack([rows.sum(1), rows.max(1)], axis=1)]


def norm(factor, row, fails=False):
    found, more = call_host(Norms(fails), [jnp.stack([factor])[None], row[None]])
    return found[0], more[0]


def test_one_call_serves_a_batch():
    rows = np.arange(12.0).reshape(2, 3, 2)
    alone, _ = jax.jit(norm)(2.0, rows[0, 0])
    assert alone == 2.0 and norm(2.0, rows[0, 0])[0] == 2.0
    of_rows, both = jax.jit(jax.vmap(jax.vmap(norm, (None, 0)), (0, 0)))(jnp.array([1.0, 3.0]), rows)
    np.testing.assert_allclose(of_rows, np.linalg.norm(rows, axis=-1) * [[1.0], [3.0]])
    np.testing.assert_allclose(both, np.stack([rows.sum(-1), rows.max(-1)], -1))


def test_it_runs_within_loops():
    def step(x, _):
        return x + norm(1.0, jnp.stack([x, x]))[0], x

    end, _ = jax.jit(lambda x: jax.lax.scan(step, x, None, length=5))(1.0)
    assert abs(end - (1 + np.sqrt(2)) ** 5) < 1e-9


def test_an_error_is_that_of_the_program():
    with pytest.raises(Exception, match="no norm today"):
        jax.block_until_ready(jax.jit(lambda x: norm(1.0, x, fails=True))(np.ones(2)))


def test_stored_programs_with_events_are_found_by_later_processes(tmp_path):
    """JAX finds programs by their text, in which functions of Python must have the same names, made in any order."""
    code = """
import jax, udkjax as udk
rod = udk.library.compound_pendulum(angle=1.2)
friction = {"dry": udk.Friction("pin", torque=0.4, law="set-valued")}
mech = udk.Mechanism(rod.bodies, {"pin": next(iter(rod.joints.values()))}, forces=friction)
for lower in ORDER:
    events = None if lower is None else udk.JointLimit("pin", lower=lower, restitution=0.5)
    run = lambda mass: udk.simulate(mech.with_parameters({"body.rod.mass": mass}), [0.0, 1.0], events=events).q[-1, 0, 2]
    print(float(jax.jit(run)(1.0)))
"""
    settings = {"UDKJAX_CACHE": 0, "JAX_COMPILATION_CACHE_DIR": tmp_path, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0}
    found = python(code.replace("ORDER", "(None, 0.2)"), **settings).split()
    programs = {path.name for path in tmp_path.glob("*-cache")}
    assert len(set(found)) == 2 and sum("lambda" in name for name in programs) == 2
    assert python(code.replace("ORDER", "(0.2, None)"), **settings).split() == found[::-1]
    assert {path.name for path in tmp_path.glob("*-cache")} == programs
