"""Machine code that passes the events of joints with set-valued friction does so as the loop of events does."""

# pyright: reportOptionalMemberAccess=false, reportAttributeAccessIssue=false
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import udkjax as udk
from tests.choices import fast
from tests.friction import rubbing
from tests.integrate.events.run.passing import by_the_loop, counted
from udkjax.native.module.layout import MEMBERS_PER_THREAD

TS = np.linspace(0.0, 2.0, 41)
CHAIN, SMALL = (rubbing(udk.library.chain(count, 0.4), 0.15, 0.005, law="set-valued") for count in (5, 3))


class Gate(udk.ForceElement):
    """A torque that jumps where a body points to the left."""

    k: Float[Array, ""]

    def loads(self, t, *frames):
        return [(0.0, 0.0, jnp.where(frames[0].angle < -0.5, self.k, 0.0))]


def pushed() -> udk.Mechanism:
    """Return a chain of joints that stick, under a force that jumps in time, and one that jumps with the state."""
    push = udk.Held([[0.0, 0.0], [0.4, 0.0], [-0.4, 0.0], [0.2, 0.0]], 0.5)
    base = CHAIN.without_origin
    forces = {
        **base.forces,
        "push": udk.Force(base.body_names[-1], push),
        "gate": Gate([base.body_names[1]], k=jnp.asarray(0.02)),
    }
    return udk.Mechanism(base.bodies, base.joints, base.drivers, forces, base.gravity)


TURNS = udk.Event(lambda t, at: at[CHAIN.body_names[0]].omega, udk.Log(), name="turns")
WALL = udk.Event(lambda t, at: at[CHAIN.body_names[-1]].y + 1.0, udk.Impact(0.5), direction=-1, name="wall")


# For each case the number of calls of machine code: all events but those at which joints stick together, or others are due, too.
CASES: dict[str, tuple[udk.Mechanism, dict[str, Any], int]] = {
    "chain": (CHAIN, {}, 1),
    "four-bar": (rubbing(udk.library.four_bar(), 0.15, 0.005, law="set-valued"), {}, 1),
    "slider-crank": (rubbing(udk.library.slider_crank(), 0.3, 0.02, law="set-valued"), {}, 2),
    "excavator": (rubbing(udk.library.excavator(), 0.15, 0.005, law="set-valued"), {}, 1),
    "not projected": (CHAIN, {"stabilization": udk.Baumgarte(5.0, 5.0)}, 17),  # states are projected where a joint sticks
    "Kvaerno5": (CHAIN, {"solver": diffrax.Kvaerno5(), "rtol": 1e-6, "atol": 1e-6}, 1),
    "jumping forces": (pushed(), {}, 1),
    "events": (CHAIN, {"events": [TURNS, WALL]}, 5),
    "few outputs": (CHAIN, {"ts": [0.0, 2.0]}, 1),
}
QUICK = ("four-bar",)  # in the others machine code passes ten times as many events, each by the loop as well


@pytest.mark.parametrize("case", fast(QUICK, CASES))
def test_machine_code_passes_events_as_the_loop_does(case, monkeypatch):
    mechanism, options, most_calls = CASES[case]
    options = {"ts": TS, "rtol": 1e-10, "atol": 1e-10} | options
    run = lambda: udk.simulate(mechanism, **options)  # noqa: E731
    found, calls, _ = counted(run)
    by_the_loop(monkeypatch)
    expected, more_calls, _ = counted(run)
    assert calls <= most_calls and more_calls >= len(np.unique(expected.events.time))
    np.testing.assert_array_equal(found.events.index, expected.events.index)
    np.testing.assert_allclose(found.events.time, expected.events.time, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.q, expected.q, atol=1e-8)
    np.testing.assert_allclose(found.events.v_after, expected.events.v_after, atol=1e-7)


def test_the_record_of_events_is_filled_again_and_again(monkeypatch):
    """A call that has passed as many events as its record has room for ends, and the next goes on."""
    by_the_loop(monkeypatch, passed=1)
    few, calls, _ = counted(lambda: udk.simulate(SMALL, TS))
    assert calls > 5
    monkeypatch.undo()
    many = udk.simulate(SMALL, TS)
    np.testing.assert_array_equal(few.events.index, many.events.index)
    np.testing.assert_allclose(few.q, many.q, atol=1e-8)
    assert few.stats == many.stats


def test_lanes_pass_events_as_single_runs_do():
    scale = np.geomspace(0.05, 3.0, 2 * MEMBERS_PER_THREAD + 5)

    def run(scale):
        forces = [eqx.tree_at(lambda x: x.coefficient, x, scale * x.coefficient) for x in SMALL._forces]
        found = udk.simulate(eqx.tree_at(lambda m: m._forces, SMALL, tuple(forces)), TS, throw=False)
        return found.q, found.v, found.events

    q, v, events = jax.vmap(run)(jnp.asarray(scale))
    assert len(set(events.count.tolist())) > 10
    for k in range(0, len(scale), 8):
        one = run(scale[k])
        count = int(events.count[k])
        np.testing.assert_array_equal(q[k], one[0])
        np.testing.assert_array_equal(v[k], one[1])
        np.testing.assert_array_equal(events.index[k, :count], one[2].index)
        np.testing.assert_array_equal(events.v_after[k, :count], one[2].v_after)


def test_most_steps_and_most_events_hold_for_all_stretches_together():
    few = udk.simulate(SMALL, TS, max_events=5, throw=False)
    assert int(few.events.count) == 5 and few.result.name == "event_limit"
    whole = udk.simulate(SMALL, TS)
    steps = int(whole.stats["steps"]) // 2
    short = udk.simulate(SMALL, TS, max_steps=steps, throw=False)
    assert short.result.name == "step_limit" and int(short.stats["steps"]) <= steps


def test_lanes_equal_single_runs_where_the_loads_of_some_need_further_rounds():
    """A round that one lane needs leaves the loads of the others as they are, and their forces by which joints slip."""
    mechanism = rubbing(udk.library.double_pendulum(), 0.9, 0.1, law="set-valued")
    scale, ts = np.linspace(0.3, 1.7, 17), np.linspace(0.0, 4.0, 5)

    def run(scale):
        forces = [eqx.tree_at(lambda x: x.coefficient, x, scale * x.coefficient) for x in mechanism._forces]
        found = udk.simulate(eqx.tree_at(lambda m: m._forces, mechanism, tuple(forces)), ts, throw=False)
        return found.q, found.v, found.events.count

    found = jax.vmap(run)(jnp.asarray(scale))
    assert len(set(found[2].tolist())) > 4
    for k in range(1, len(scale), 3):
        for lanes, one in zip(found, run(scale[k]), strict=True):
            np.testing.assert_array_equal(lanes[k], one)
