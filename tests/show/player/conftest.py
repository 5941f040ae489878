from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

import udkjax as udk
from tests.show.player.pages import Pages

OMEGA = 4.0  # rad/s: the crank of the slider-crank turns by OMEGA t
CRANK, ROD = 0.5, 1.5


class Motion(NamedTuple):
    """The attributes of a run that `animate` uses."""

    ts: np.ndarray
    q: np.ndarray
    v: np.ndarray
    cause: str = ""


def slider_crank_run(ts):
    """The motion of the library's driven slider-crank in closed form: q and v of crank, rod and slider."""
    ts = np.asarray(ts, float)
    a, w = OMEGA * ts, OMEGA
    tilt = -np.arcsin(CRANK * np.sin(a) / ROD)
    rate = -CRANK * w * np.cos(a) / (ROD * np.cos(tilt))
    pin, pin_rate = CRANK * np.array([np.cos(a), np.sin(a)]), CRANK * w * np.array([-np.sin(a), np.cos(a)])
    arm, arm_rate = ROD * np.array([np.cos(tilt), np.sin(tilt)]), ROD * rate * np.array([-np.sin(tilt), np.cos(tilt)])
    zero = np.zeros_like(ts)
    q = [(*pin / 2, a), (*(pin + arm / 2), tilt), (*(pin + arm), zero)]
    v = [(*pin_rate / 2, w + zero), (*(pin_rate + arm_rate / 2), rate), (*(pin_rate + arm_rate), zero)]
    return Motion(ts=ts, q=np.moveaxis(np.array(q), -1, 0), v=np.moveaxis(np.array(v), -1, 0))


def pins_at(t):
    """The positions (m) of the pins O, P and B of the slider-crank at time t."""
    x, y = CRANK * np.cos(OMEGA * t), CRANK * np.sin(OMEGA * t)
    return {"O": (0.0, 0.0), "P": (x, y), "B": (x + np.sqrt(ROD**2 - y**2), 0.0)}


@pytest.fixture(scope="session")
def slider_crank():
    return udk.library.slider_crank()


@pytest.fixture(scope="session")
def run():
    return slider_crank_run(np.linspace(0.0, 2.0, 81))


@pytest.fixture(scope="session")
def closed_form():
    return SimpleNamespace(run=slider_crank_run, pins=pins_at)


@pytest.fixture(scope="session")
def animation(slider_crank, run):
    return udk.animate(slider_crank, run, measures={"crank angle (rad)": run.q[:, 0, 2], "speed (m/s)": run.v[:, 2, 0]})


@pytest.fixture(scope="session")
def hostile():
    """A mechanism whose texts are markup and script."""
    names = [
        "</script><script>window.hit=1</script>\u2028a",
        "<img src=x onerror='window.hit=2'>",
        '"><b onmouseover=window.hit=3>',
        "a&amp;'b'",
    ]
    body = udk.Body(1.0, 0.1, (0.5, 0.0))
    joint = udk.Revolute(("ground", names[1]), [(0.0, 0.0), (-0.5, 0.0)])
    mechanism = udk.Mechanism({names[1]: body}, {names[2]: joint, names[3]: joint}, name=names[0])
    return SimpleNamespace(mechanism=mechanism, names=names)


@pytest.fixture(scope="module")
def opened(browser, tmp_path_factory):
    """A function that opens an animation in a browser."""
    return Pages(browser, tmp_path_factory)
