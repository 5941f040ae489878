"""Friction in the player: rings around joints that stick, and the power of friction."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.friction import rubbing
from tests.show.player.pages import PLAYER, until
from udkjax.show.player.marks.measure_curves import measures_of
from udkjax.show.player.pictures import svg


def pendulum(**friction):
    return udk.Mechanism(
        {"rod": udk.Body(1.0, 0.1, position=[0.5, 0.0])},
        {"pin": udk.Revolute(["ground", "rod"], [[0, 0], [-0.5, 0]])},
        forces={"rub": udk.Friction("pin", torque=0.5, coefficient=0.2, radius=0.05, **friction)},
    )


STICKY = pendulum(law="set-valued")


def rings(picture):
    return picture.count('class="sticking"')


def test_a_ring_is_around_a_joint_while_it_sticks():
    ts, hangs = np.arange(4.0), np.tile([0.0, -0.5, -np.pi / 2], (4, 1, 1))
    events = SimpleNamespace(names=["pin sticks"], time=np.array([0.25]), index=np.array([0]), of=lambda name: np.array([0.25]))
    motion: Any = SimpleNamespace(ts=ts, q=hangs, v=0 * hangs, events=events, sticking={"pin": ts % 3 > 0})
    shown = udk.animate(STICKY, motion, measures=())
    assert shown.data["runs"][0]["sticking"] == [{"name": "pin", "at": [0, -0.5, 0.0], "spans": [[0.25, 3.0]]}]
    assert [len(shown.sticking(t)[0]) for t in (0.0, 0.3, 2.9)] == [0, 1, 1]
    assert [rings(svg(shown, t)) for t in (0.0, 0.3)] == [0, 1]


@pytest.mark.slow
def test_a_run_that_sticks_is_shown_with_its_rings_and_the_power_of_friction(opened):
    ts = np.linspace(0.0, 8.0, 161)
    run = udk.simulate(STICKY, ts)
    assert run.events is not None
    stopped = float(run.events.of("pin sticks")[-1])
    shown = udk.animate(STICKY, run)
    assert shown.data["runs"][0]["sticking"][0]["spans"] == [[stopped, 8.0]]
    assert [rings(svg(shown, t)) for t in (stopped - 0.01, stopped + 0.01)] == [0, 1]
    (power,) = measures_of(STICKY, run, ["friction"], "")
    assert power.unit == "W" and power.name in [m["name"] for m in shown.data["runs"][0]["measures"]]
    assert_allclose(power.values, udk.power_balance(STICKY, run).forces["rub"], atol=1e-12)
    with opened(shown) as page:
        page.evaluate(f"{PLAYER}.seek({stopped + 0.5})")
        assert page.locator(".happened").text_content() == "pin sticks"
        page.evaluate(f"{PLAYER}.seek({stopped - 0.5})")
        assert "pin sticks" not in (page.locator(".happened").text_content() or "")


@pytest.mark.slow
def test_a_live_page_computes_the_power_of_friction_again(opened):
    mechanism, ts = pendulum(velocity=0.1), np.linspace(0.0, 2.0, 41)
    given = {"force.rub.coefficient": 0.6, "force.rub.torque": 0.1}
    other = mechanism.with_parameters(given)
    run = udk.simulate(other, ts)
    with opened(udk.animate(mechanism, udk.simulate(mechanism, ts), live=list(given))) as page:
        page.evaluate(f"{PLAYER}.live.change({given})")
        found = f"{PLAYER}.live.runs[0].run.measures.find(m => m.name === 'power of friction').values"
        assert_allclose(page.evaluate(f"[...{found}]"), udk.power_balance(other, run).forces["rub"], atol=1e-5)


@pytest.mark.slow
def test_a_live_page_shows_where_joints_stick_with_other_numbers(opened):
    ts, given = np.linspace(0.0, 8.0, 161), {"force.rub.torque": 0.8}
    other = STICKY.with_parameters(given)
    run = udk.simulate(other, ts)
    (expected,) = udk.animate(other, run).data["runs"][0]["sticking"]
    with opened(udk.animate(STICKY, udk.simulate(STICKY, ts), live=list(given))) as page:
        shown = f"{PLAYER}.live.runs[0].run"
        first = page.evaluate(f"{shown}.sticking[0].spans")
        page.evaluate(f"{PLAYER}.live.change({given})")
        assert_allclose(page.evaluate(f"{shown}.sticking[0].spans"), expected["spans"], atol=1e-6)
        assert_allclose(page.evaluate(f"[...{shown}.q]"), np.ravel(run.q), atol=1e-7)
        page.locator(".panel canvas").press("Backspace")
        assert page.evaluate(f"{shown}.sticking[0].spans") == first


@pytest.mark.slow
def test_a_live_page_of_a_redundant_lift_with_friction(opened):
    """Redundant rows share the loads that its friction depends on."""
    lift, ts, given = rubbing(udk.library.scissor_lift()), np.linspace(0.0, 0.3, 31), {"gravity[1]": -6.0}
    other = lift.with_parameters(given)
    run = udk.simulate(other, ts)
    frictions = [name for name, force in lift.forces.items() if isinstance(force, udk.Friction)]
    with opened(udk.animate(lift, udk.simulate(lift, ts), live=list(given))) as page:
        page.evaluate(f"{PLAYER}.live.change({given})")
        shown = f"{PLAYER}.live.runs[0].run"
        until(page, f"{shown}.ts.length === {len(ts)}")
        assert_allclose(page.evaluate(f"[...{shown}.q]"), np.ravel(run.q), atol=1e-7)
        power = page.evaluate(f"[...{shown}.measures.find(m => m.name === 'power of friction').values]")
        balance = udk.power_balance(other, run).forces
        assert_allclose(power, sum(np.asarray(balance[name]) for name in frictions), rtol=1e-5, atol=1e-5)
