"""Batches of runs by machine code: each member equals its run alone, and its run by diffrax."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.calls import calls_of
from udkjax.equations.programs.unrolled import Unrolled
from udkjax.native import loaded_code, runs

TS = np.linspace(0.0, 2.0, 21)
MEMBERS = 70  # no multiple of what a vector holds


def last(mechanism, **choices):
    """The run as a function of the mass of the rod, the initial rate and the tolerance."""
    name = mechanism.body_names[0]

    def run(inertia, rate, tol):
        changed = mechanism.with_parameters({f"body.{name}.inertia": inertia})
        state = udk.assemble(changed)
        v = jnp.asarray(state.v) * 0.0
        q = jnp.asarray(state.q)
        arm = q[:, :2]  # it hangs at the origin
        v = jnp.concatenate([rate * jnp.stack([-arm[:, 1], arm[:, 0]], 1), jnp.full((1, 1), rate)], 1) + v
        return udk.simulate(changed, TS, udk.State(q, v), rtol=tol, atol=tol, throw=False, **choices)

    return run


def members(size):
    along = np.linspace(0.0, 1.0, size)
    return 0.05 + 0.1 * along, -1.0 + 2.0 * along, 10.0 ** (-5 - 4 * along)


def test_members_are_what_they_are_alone(pendulum):
    alone, batch = jax.jit(last(pendulum)), jax.jit(jax.vmap(last(pendulum)))(*members(MEMBERS))
    for k in (0, 1, 33, MEMBERS - 1):
        one = alone(*(x[k] for x in members(MEMBERS)))
        assert_allclose(batch.q[k], one.q, rtol=0, atol=1e-12)
        assert_allclose(batch.v[k], one.v, rtol=0, atol=1e-10)  # rounding: a tenth of the tightest tolerance
        assert {name: int(x[k]) for name, x in batch.stats.items()} == {name: int(x) for name, x in one.stats.items()}
    assert np.all(np.asarray(batch.result) == udk.Result.successful)
    assert len(np.unique(np.asarray(batch.stats["steps"]))) > 5  # each takes steps of its own


def test_outputs_of_a_batch_are_kept_once(pendulum):
    """Other results are kept for one chunk at a time, and velocities only if they are used."""
    ts = np.linspace(0.0, 2.0, 801)

    def outputs(rate):
        return udk.simulate(pendulum, ts, udk.State(pendulum.q0, rate * pendulum.v0)).q[:, 0]

    memory: Any = jax.jit(jax.vmap(outputs)).lower(jnp.ones(1024)).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 1.5 * memory.output_size_in_bytes


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Tsit5(), udk.Verner65()], ids=str)
def test_the_same_motion_as_by_diffrax(pendulum, solver):
    ours = udk.simulate(pendulum, TS, solver=solver)
    theirs = udk.simulate(pendulum, TS, solver=solver, adjoint=diffrax.DirectAdjoint(), max_steps=4096)
    assert_allclose(ours.q[-1], theirs.q[-1], rtol=0, atol=2e-7)
    steps = int(theirs.stats["steps"])
    assert abs(int(ours.stats["steps"]) - steps) <= 2 + 0.1 * steps  # the same step size control, but that ours foresees failures
    assert int(ours.stats["right_hand_sides"]) <= int(theirs.stats["right_hand_sides"]) + 30


def test_outputs_are_as_exact_as_steps(pendulum):
    """Positions and velocities between steps are compared with a run of much smaller steps."""
    fine = np.linspace(0.0, 2.0, 301)
    coarse = udk.simulate(pendulum, fine, rtol=1e-9, atol=1e-9)
    exact = udk.simulate(pendulum, fine, rtol=1e-13, atol=1e-13)
    error = np.abs(np.asarray(coarse.q - exact.q)).max(axis=(1, 2))
    rates = np.abs(np.asarray(coarse.v - exact.v)).max(axis=(1, 2))
    assert int(coarse.stats["accepted"]) < 60
    assert error.max() < 1e-9 and rates.max() < 1e-8


@pytest.mark.slow
def test_one_direction_for_all_members(pendulum):
    """Values are batched, but the direction is not."""
    ts = jnp.linspace(0.0, 1.0, 5)

    def angle(inertia):
        placed = pendulum.with_parameters({"body.rod.inertia": inertia})
        return udk.simulate(placed, ts, adjoint=diffrax.ForwardMode()).q[-1, 0, 2]

    inertias = jnp.linspace(0.3, 0.5, 3)
    both = jax.jit(jax.vmap(lambda x: jax.jvp(angle, (x,), (1.0,))))
    _, slopes = both(inertias)
    ahead, behind = (both(inertias + h)[0] for h in (1e-4, -1e-4))
    assert_allclose(slopes, (ahead - behind) / 2e-4, rtol=1e-4)


@pytest.mark.slow
def test_only_what_the_parameters_touch_is_differentiated():
    """A link's mass appears in few constants of a linkage. Only these are differentiated."""
    linkage = udk.library.parallelogram(np.deg2rad(-45))

    def angle(mass):
        changed = linkage.with_parameters({"body.link1.mass": mass})
        return udk.simulate(changed, jnp.linspace(0.0, 1.0, 3), adjoint=diffrax.ForwardMode()).q[-1, 0, 2]

    with calls_of(loaded_code.select_code) as found:
        jax.jit(jax.jacfwd(angle)).lower(1.0)
    (run,) = (x for x in (call.arguments["operation"] for call in found) if isinstance(x, runs.RunTangents))
    assert sum(run.active) == 1 and len(run.active) > 30
    unrolled = Unrolled(run.code, [], [("a",)], run.active)
    assert 1 <= len(unrolled.moving) <= 8 < len(run.code.constants)
