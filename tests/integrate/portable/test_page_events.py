"""Runs with events on a page, by machine code and the loop of all runs as WebAssembly, are those of Python."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from benchmarks.friction import with_friction
from examples.gallery import woodpecker
from tests.friction import rubbing
from tests.integrate.events.event_scenes import BALL, CATCH, CAUGHT, PENDULUM, floor
from tests.page_host import page_run
from udkjax.integrate.portable import portable_engine
from udkjax.show.player.marks.measure_curves import reaction_arrows

TOL = 1e-10


class Scene(NamedTuple):
    make: Callable[[], tuple[udk.Mechanism, list[Any]]]
    end: float
    changed: dict[str, float]


def box(**contact: Any) -> tuple[udk.Mechanism, list[Any]]:
    """A box that falls, turned, on its two lower corners."""
    mechanism = udk.Mechanism({"box": udk.Body(1.0, 0.1, (0.0, 0.6), 0.2)})
    return mechanism, [udk.Contact("box", [x, -0.2], name=name, **contact) for x, name in ((-0.5, "left"), (0.5, "right"))]


def balls() -> tuple[udk.Mechanism, list[Any]]:
    """Two balls that come to rest beside each other."""
    mechanism = udk.Mechanism({name: udk.Body(1.0, 0.1, (0.0, y)) for name, y in (("one", 1.0), ("two", 2.0))})
    return mechanism, [udk.Contact(name, name=name) for name in mechanism.body_names]


def locked() -> tuple[udk.Mechanism, list[Any]]:
    mechanism = udk.library.double_pendulum()
    joint = list(mechanism.joints)[1]
    lock = udk.Event(lambda t, at: t - 0.5, udk.Lock(joint), name="lock")
    return mechanism, [lock, udk.Event(lambda t, at: t - 1.1, udk.Release(f"{joint}.lock"), name="unlock")]


def sticking(name: str) -> Callable[[], tuple[udk.Mechanism, list[Any]]]:
    return lambda: (with_friction(getattr(udk.library, name)(), law="set-valued"), [])


GRAVITY = {"gravity[1]": -6.0}
SCENES = {
    "catch": Scene(lambda: (CATCH, CAUGHT), 1.5, {}),
    "rebounds": Scene(lambda: (BALL, [floor(0.6)]), 2.0, GRAVITY),
    "limits": Scene(lambda: (PENDULUM, [udk.JointLimit("A", -2.0, 1.0, restitution=0.5)]), 2.0, GRAVITY),
    "locked": Scene(locked, 1.6, GRAVITY),
    "balls": Scene(balls, 1.5, GRAVITY),
    "two corners": Scene(lambda: box(restitution=0.7), 1.0, GRAVITY),
    # With other numbers, small rebounds would be measured by the scales of the first ones.
    "two rough corners": Scene(lambda: box(restitution=0.3, coefficient=0.4), 1.5, {}),
    "corners that stop at once": Scene(lambda: box(coefficient=2.0), 1.5, GRAVITY),
    "rough ball": Scene(lambda: (BALL, [floor(0.4, coefficient=0.2)]), 2.0, GRAVITY),
    "slider-crank that rubs": Scene(sticking("slider_crank"), 1.0, {"driver.motor.motion.coefficients[1]": 3.0}),
    "pendulum that sticks": Scene(sticking("double_pendulum"), 2.0, GRAVITY),
    "four-bar that sticks": Scene(sticking("four_bar"), 1.5, GRAVITY),
    "redundant": Scene(lambda: (rubbing(udk.library.parallelogram()), []), 1.0, GRAVITY),
    "scissor lift": Scene(lambda: (rubbing(udk.library.scissor_lift()), []), 0.3, GRAVITY),
}
FAST = ("catch", "balls")


@pytest.mark.parametrize("name", [n if n in FAST else pytest.param(n, marks=pytest.mark.slow) for n in SCENES])
def test_a_run_of_a_page_is_that_of_python(tmp_path, name):
    """States, events, energy, torques and the power of friction, with other numbers than those of the page."""
    scene = SCENES[name]
    (mechanism, events), ts = scene.make(), np.linspace(0.0, scene.end, 31)
    found = page_run(mechanism, ts, events, tmp_path, TOL, scene.changed)
    other = mechanism.with_parameters(scene.changed)
    run = udk.simulate(other, ts, events=events or None, rtol=TOL, atol=TOL)
    assert found["done"], found["words"]
    assert_allclose(found["q"], run.q, rtol=0, atol=2e-9)
    assert_allclose(found["v"], run.v, rtol=0, atol=2e-8)
    listed = [] if run.events is None else [(run.events.names[k], float(t)) for k, t in zip(run.events.index, run.events.time)]
    assert [n for n, _ in found["events"]] == [n for n, _ in listed]
    assert_allclose([t for _, t in found["events"]], [t for _, t in listed], rtol=0, atol=1e-9)
    assert listed or not events
    assert_allclose(found["kinetic"], udk.energy(other, run).kinetic, rtol=1e-7, atol=1e-7)
    balance = udk.power_balance(other, run)
    for driver, effort in found["efforts"]:
        assert_allclose(effort, udk.efforts(other, run)[driver], rtol=1e-6, atol=1e-6)
    if name in ("limits", "slider-crank that rubs", "pendulum that sticks"):
        _, forces, unique = reaction_arrows(other, run)
        assert all(unique)
        assert_allclose(np.reshape(found["forces"], forces.shape), forces, rtol=0, atol=1e-6 * np.abs(forces).max())
    rubs = [force for force, x in mechanism.forces.items() if isinstance(x, udk.Friction)]
    if rubs and not events:
        assert_allclose(found["friction"], sum(np.asarray(balance.forces[x]) for x in rubs), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", ["balls", pytest.param("woodpecker", marks=pytest.mark.slow)])
def test_a_run_in_parts_is_the_whole_run(tmp_path, name):
    """A part is over after some steps, or after some events, which take longer than steps."""
    (mechanism, events), ts = woodpecker.toy() if name == "woodpecker" else balls(), np.linspace(0.0, 1.2, 31)
    whole = page_run(mechanism, ts, events, tmp_path, TOL)
    parts = page_run(mechanism, ts, events, tmp_path, TOL, steps=50)
    assert parts["done"] and parts["parts"] > (10 if name == "woodpecker" else 1)
    assert [n for n, _ in parts["events"]] == [n for n, _ in whole["events"]]
    assert_allclose([t for _, t in parts["events"]], [t for _, t in whole["events"]], rtol=0, atol=1e-9)
    assert_allclose(parts["q"], whole["q"], rtol=0, atol=1e-8)
    assert_allclose(parts["kinetic"], whole["kinetic"], rtol=1e-6, atol=1e-9)


def test_a_page_says_why_a_motion_ends(tmp_path):
    """The last state is that at the event; a beginning beyond a contact is told."""
    stop = udk.Event(lambda t, at: at["ball"].y - 0.5, udk.Stop(), name="halfway")
    found = page_run(BALL, np.linspace(0.0, 2.0, 5), [stop], tmp_path, TOL)
    assert found["words"] == "stopped by halfway" and found["q"][found["count"] - 1, 0, 1] == pytest.approx(0.5, abs=1e-9)
    lies = udk.Contact("ball", at_rest="stop", name="floor")
    found = page_run(BALL, np.linspace(0.0, 2.0, 5), [lies], tmp_path, TOL)
    assert found["words"] == "floor has come to rest"
    deep = udk.Mechanism({"ball": udk.Body(1.0, 0.1, position=(0.0, -1.0))})
    found = page_run(deep, np.linspace(0.0, 2.0, 5), [floor(0.5)], tmp_path, TOL)
    assert found["words"] == "it begins beyond a contact"


def test_loads_that_redundant_rows_share_in_several_phases_are_refused():
    mechanism = with_friction(udk.library.parallelogram(), law="set-valued")
    assert "rows that may be redundant share these" in portable_engine(mechanism).data["why"]
