"""Speeds of pins and transmission angles below a motion, also those that a live page computes again."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.show.player.conftest import CRANK, OMEGA, Motion
from tests.show.player.pages import PLAYER
from udkjax.show.player.marks.measure_curves import measures_of


def test_speeds_and_transmission_angles_are_those_of_closed_forms(slider_crank, run):
    speeds = {m.name: m.values for m in measures_of(slider_crank, run, ["speed"], "")}
    assert_allclose(speeds["speed of P"], CRANK * OMEGA, rtol=1e-12)
    assert_allclose(speeds["speed of B"], np.abs(run.v[:, 2, 0]), rtol=1e-9, atol=1e-12)
    four_bar = udk.library.four_bar()
    still: Any = Motion(np.zeros(1), np.asarray(four_bar.q0)[None], np.zeros((1, 3, 3)))
    angle = np.degrees(np.asarray(udk.transmission_angle(four_bar, still, "C"))[0])
    found = {m.name: m for m in measures_of(four_bar, still, ["transmission"], "")}["transmission angle at C"]
    assert_allclose(found.values, min(angle, 180 - angle), rtol=1e-12)
    assert found.unit == "°" and [anchor[0] for anchor in found.anchors] == [1, 1, 2]


@pytest.mark.slow
def test_a_live_page_measures_pins_of_the_new_motion(opened):
    links = {"crank": ["O", "A"], "coupler": ["A", "B"], "rocker": ["C", "B"]}
    four_bar = udk.Drawing(
        pins={"O": (0, 0), "C": (100, 0), "A": udk.polar("O", 40, 60), "B": udk.circles(("A", "C"), (120, 80), "left")},
        links={name: {"pins": pins, "mass": 1} for name, pins in links.items()},
        ground=["O", "C"],
        motors={"motor": {"pin": "O", "speed": "60 rpm"}},
        units={"length": "mm", "angle": "deg"},
    ).mechanism()
    ts, given = np.linspace(0.0, 1.0, 41), {"pin.A.length": 0.03, "pin.B.length[0]": 0.11}
    other = four_bar.with_parameters(given)
    expected = measures_of(other, udk.simulate(other, ts), ["speed", "transmission"], "")
    assert [m.name for m in expected] == ["speed of A", "speed of B", "transmission angle at B"]
    with opened(udk.animate(four_bar, udk.simulate(four_bar, ts), live=list(given))) as page:
        names = page.evaluate(f"{PLAYER}.live.runs[0].run.measures.map(m => m.name)")
        assert names[:4] == ["torque of motor", "transmission angle at B", "speed of A", "speed of B"]
        page.evaluate(f"{PLAYER}.live.change({given})")
        for m in expected:
            values = f"[...{PLAYER}.live.runs[0].run.measures.find(m => m.name === '{m.name}').values]"
            assert_allclose(page.evaluate(values), m.values, rtol=1e-6, atol=1e-7)
        page.evaluate(f"{PLAYER}.live.reset()")
        speed = page.evaluate(f"[...{PLAYER}.live.runs[0].run.measures.find(m => m.name === 'speed of A').values]")
        assert_allclose(speed, 0.04 * 2 * np.pi, rtol=1e-6)
