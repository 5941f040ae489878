"""Closing a batch: each member as by itself, whether its guess is closed, open, or cannot be closed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.integrate.assembly import close
from udkjax.integrate.settled import _redundant, close_all


def stacked(mechanisms):
    return jax.tree.map(lambda *x: jnp.stack(x), *mechanisms)


@pytest.mark.slow
def test_each_member_is_closed_as_by_itself():
    closed = udk.library.parallelogram(0.4, 0.3)
    mechanisms = [
        closed,
        closed.with_parameters({"body.link1.angle": 0.5}),
        closed.with_parameters({"body.coupler.mass": 3.0, "body.coupler.velocity": [0.0, 0.1]}),
        closed.with_parameters({"joint.B3.points[1]": [0.4, 0.0]}),  # no longer redundant
        closed.with_parameters({"joint.A1.points[0]": [-9.0, 0.0]}),  # cannot be closed
    ]
    found = jax.jit(close_all)(stacked(mechanisms))
    assert [bool(jax.tree.map(lambda x, k=k: x[k], found).is_closed) for k in range(5)] == [True, True, True, False, False]
    for k, mechanism in enumerate(mechanisms[:3]):
        alone = close(mechanism)
        assert_allclose(found.state.q[k], alone.state.q, rtol=0, atol=1e-12)
        assert_allclose(found.state.v[k], alone.state.v, rtol=0, atol=1e-12)
        assert int(found.rank[k]) == 11


@pytest.mark.slow
def test_tangents_are_those_of_a_closed_state():
    closed = udk.library.parallelogram(0.4, 0.3)
    names = ("body.link1.angle", "joint.B1.points[1][0]", "body.link2.angular_velocity")

    def states(by):
        values = {name: at + x for name, at, x in zip(names, (0.4, 0.5, 0.3), by, strict=True)}
        mechanism = closed.with_parameters(values)
        batch = close_all(jax.tree.map(lambda x: x[None], mechanism)).state
        return batch.q[0], batch.v[0]

    def alone(by):
        values = {name: at + x for name, at, x in zip(names, (0.4, 0.5, 0.3), by, strict=True)}
        state = udk.assemble(closed.with_parameters(values), throw=False)
        return state.q, state.v

    ours, theirs = jax.jit(lambda x: (jax.jacfwd(states)(x), jax.jacfwd(alone)(x)))(jnp.zeros(3))
    for index in (0, 2):  # by the other, the loop opens: there are no closed states nearby
        for one, two in zip(ours, theirs, strict=True):
            assert_allclose(one[..., index], two[..., index], atol=1e-9)


def test_rows_are_redundant_where_they_lie_in_the_span_of_the_others():
    D = np.array([[1.0, 2.0, 0.0, 1.0], [0.0, 1.0, 1.0, 0.0], [2.0, 5.0, 1.0, 2.0]])
    assert _redundant(jnp.asarray(D[:2]), jnp.asarray(D[2:]), 1e-4)
    D[2, 3] += 1e-2
    assert not _redundant(jnp.asarray(D[:2]), jnp.asarray(D[2:]), 1e-4)
    D[1] = D[0]
    assert not _redundant(jnp.asarray(D[:2]), jnp.asarray(D[2:]), 1e-4)
