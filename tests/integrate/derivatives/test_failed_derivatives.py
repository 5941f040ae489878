"""Derivatives of what failed: NaN has the tangent NaN, and a zero cotangent contributes nothing, in every function and mode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.choices import fast
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import defined

LENGTH = "pin.A.length"  # with 0.5 m the loop cannot close
TS = np.linspace(0.0, 0.3, 4)
GOOD, BAD = 0.04, 0.5


def _four_bar():
    pins = {"O": (0, 0), "C": (100, 0), "A": udk.polar("O", 40, 60), "B": udk.circles(("A", "C"), (120, 80), "left")}
    ends = {"crank": ["O", "A"], "coupler": ["A", "B"], "rocker": ["C", "B"]}
    links = {name: {"pins": pair, "mass": 1} for name, pair in ends.items()}
    return udk.Drawing(pins=pins, links=links, ground=["O", "C"], units={"length": "mm", "angle": "deg"}).mechanism()


MECH = _four_bar()
STATE = udk.assemble(MECH)


def long(p):
    return MECH.with_parameters({LENGTH: p})


def heavy(p):
    return MECH.with_parameters({"link.coupler.mass": p})


def flat(tree):
    return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(tree)])


def states(x):
    return flat((x.q, x.v))


@defined
def undefined(p):
    """A state that is NaN where p is too large, as after another run."""
    return udk.State(jnp.where(p > GOOD, jnp.nan, STATE.q * p), jnp.where(p > GOOD, jnp.nan, STATE.v * p))


EVENT = udk.Event(lambda t, at: at["crank"].angle - 100.0, udk.Log())
EVENTS = [udk.Event(lambda t, at, after=after: t - after, udk.Log()) for after in (0.1, 0.2)]
FUNCTIONS = {
    "simulate, loop": lambda p: states(udk.simulate(long(p), TS)),
    "simulate, state open": lambda p: states(udk.simulate(heavy(p), TS, udk.State(STATE.q + 0.3, STATE.v))),
    "simulate, max_steps": lambda p: states(udk.simulate(heavy(p), TS, max_steps=4)),
    "simulate, drift": lambda p: states(udk.simulate(heavy(p), TS, stabilization=None, drift_tol=1e-13)),
    "simulate, state": lambda p: states(udk.simulate(MECH, TS, undefined(p))),
    "step": lambda p: states(udk.step(long(p), STATE, {}, 0.01)),
    "step, state": lambda p: states(udk.step(MECH, undefined(p), {}, 0.01)),
    "assemble": lambda p: states(udk.assemble(long(p))),
    "accelerations": lambda p: udk.accelerations(MECH, 0.0, undefined(p).q, STATE.v),
    "path": lambda p: udk.path(MECH, udk.simulate(heavy(p), TS, max_steps=6), "coupler", (0.01, 0.0)),
    "reactions": lambda p: flat(udk.reactions(MECH, udk.simulate(heavy(p), TS, max_steps=6))),
    "energy": lambda p: flat(udk.energy(heavy(p), udk.simulate(heavy(p), TS, max_steps=6))),
    "violation": lambda p: udk.violation(MECH, udk.simulate(heavy(p), TS, max_steps=6)),
}
SLOW = {
    "kinematics": lambda p: flat([getattr(udk.kinematics(long(p), "body.crank.angle", [1.0, 1.1]), x) for x in "qva"]),
    "kinematics, out of reach": lambda p: states(
        udk.kinematics(MECH.with_parameters({LENGTH: p * GOOD / BAD}), "body.rocker.angle", [1.6, 9.0])
    ),
    "equilibrium": lambda p: flat(udk.equilibrium(long(p)).q),
    "modes": lambda p: udk.modes(long(p)).omega2,
    "simulate, events": lambda p: states(udk.simulate(heavy(p), TS, max_steps=4, events=EVENT)),
    "simulate by diffrax": lambda p: states(udk.simulate(heavy(p), TS, max_steps=4, engine="diffrax")),
}
ALL = fast(FUNCTIONS, [*FUNCTIONS, *SLOW])


def alone(program):
    return lambda f: program(f)(BAD)


def in_batch(program):
    return lambda f: jax.tree.map(lambda x: x[1], program(jax.vmap(f))(jnp.array([GOOD, BAD])))


@pytest.mark.parametrize("name", ALL)
def test_derivatives_of_what_failed_beside_what_did_not(name):
    """Forward and reverse mode agree on all outputs that are defined."""
    check(name, in_batch(deferred))


@pytest.mark.parametrize("name", fast(["simulate, loop", "assemble"], [*FUNCTIONS, *SLOW]))
def test_derivatives_of_what_failed_alone(name):
    check(name, alone(deferred))


@pytest.mark.parametrize("mode", [alone, in_batch])
@pytest.mark.parametrize("name", fast(["simulate, state"], [*FUNCTIONS, *SLOW]))
def test_compiled_derivatives_of_what_failed(name, mode):
    check(name, mode(jax.jit))


def check(name, mode):
    function = (FUNCTIONS | SLOW)[name]

    def everything(p):
        y, dy = jax.jvp(function, (p,), (1.0,))
        y, back = jax.vjp(function, p)
        return y, dy, back(jnp.where(jnp.isnan(y), 0.0, 1.0))[0], back(jnp.ones(y.shape))[0]

    y, dy, masked, whole = map(np.asarray, mode(everything))
    is_lost = np.isnan(y)
    assert is_lost.any() and np.isnan(whole)
    np.testing.assert_array_equal(np.isnan(dy), is_lost)
    size = np.abs(dy[~is_lost]).sum()
    np.testing.assert_allclose(masked, dy[~is_lost].sum(), rtol=1e-7, atol=1e-9 * size)


def test_outputs_before_a_failure_keep_their_derivatives():
    """They are those of a run that ends there, whose outputs are all defined."""

    def slopes(ts, **settings):
        return deferred(jax.value_and_grad(lambda p: jnp.sum(udk.simulate(heavy(p), ts, **settings).q[1] ** 2)))(1.0)

    most = int(udk.simulate(heavy(1.0), TS[:3]).stats["steps"])
    assert np.isnan(udk.simulate(heavy(1.0), TS, max_steps=most, throw=False).q[-1]).all()
    np.testing.assert_allclose(slopes(TS, max_steps=most), slopes(TS[:2]), rtol=1e-6)


@pytest.mark.parametrize("settings", [{"max_steps": 4}, {"max_events": 1, "events": EVENTS}], ids=["steps", "events"])
def test_eager_derivatives_of_a_run_that_fails_raise_its_error(settings):
    """With the same message as the run itself."""
    run = lambda p: udk.simulate(heavy(p), TS, **settings).q[-1, 0, 2]  # noqa: E731
    messages = []
    for call in (run, jax.grad(run), lambda p: jax.jvp(run, (p,), (1.0,))):
        with pytest.raises(udk.SimulationError) as error:
            call(1.0)
        messages.append(str(error.value))
    assert messages[0] == messages[1] == messages[2]
