"""The exercises of the documentation against closed formulas by NumPy: complex numbers, loops of vectors, power."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "exercises.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
MOST_LINES = 15
TOLERANCE: Any = {"rtol": 1e-9, "atol": 1e-9}


@pytest.fixture(scope="module")
def answers():
    """Run a block of the page, after those that it needs; return its variables."""
    names: dict[str, object] = {"print": lambda *_: None}
    exec(BLOCKS[0], names)

    def run(word):
        for block in BLOCKS:
            if re.search(rf"^{word}\b.* = ", block, re.M):
                exec(block, names)
                return names
        raise AssertionError(word)

    return run


def meet(p, q, r, s, side):
    """The point at distances r from p and s from q, on the left (1) or right (-1) of the line from p to q; complex numbers."""
    d = abs(q - p)
    angle = np.arccos((d**2 + r**2 - s**2) / (2 * d * r))
    return p + r * np.exp(1j * (np.angle(q - p) + side * angle))


def test_exercises_are_short():
    assert len(BLOCKS) >= 8 and max(block.count("\n") for block in BLOCKS) <= MOST_LINES


def test_four_bar(answers):
    """By the real parts of the loop of vectors, turned by the angle of either link."""
    found = answers("answer")["answer"].links
    a, b, c, d, t, w = 0.04, 0.12, 0.08, 0.1, np.radians(40), 25.0
    B = meet(a * np.exp(1j * t), d, b, c, 1)
    t3, t4 = np.angle(B - a * np.exp(1j * t)), np.angle(B - d)
    w3 = a * w * np.sin(t4 - t) / (b * np.sin(t3 - t4))
    w4 = a * w * np.sin(t - t3) / (c * np.sin(t4 - t3))
    a3 = (a * w**2 * np.cos(t - t4) + b * w3**2 * np.cos(t3 - t4) - c * w4**2) / (b * np.sin(t4 - t3))
    a4 = (a * w**2 * np.cos(t - t3) + b * w3**2 - c * w4**2 * np.cos(t3 - t4)) / (c * np.sin(t4 - t3))
    assert_allclose(found["coupler"][0], [t3, w3, a3], **TOLERANCE)
    assert_allclose(found["rocker"][0], [t4, w4, a4], **TOLERANCE)


def slider(t, w, r=0.05, length=0.2):
    """Position, velocity and acceleration of a piston, and angle, rate and acceleration of its rod."""
    beta = -np.arcsin(r * np.sin(t) / length)
    rate = -r * w * np.cos(t) / (length * np.cos(beta))
    second = (r * w**2 * np.sin(t) + length * rate**2 * np.sin(beta)) / (length * np.cos(beta))
    x = r * np.cos(t) + length * np.cos(beta)
    v = -r * w * np.sin(t) - length * rate * np.sin(beta)
    a = -r * w**2 * np.cos(t) - length * (second * np.sin(beta) + rate**2 * np.cos(beta))
    return (x, v, a), (beta, rate, second)


def test_slider_crank(answers):
    piston, _ = slider(np.radians(60), 20 * np.pi)
    assert_allclose(answers("piston")["piston"], piston, **TOLERANCE)


def test_torque_is_the_power_of_inertia(answers):
    answers("slider_crank")
    names, r, length, w = answers("torque"), 0.05, 0.2, 20 * np.pi
    for k in (0, 60, 215):
        t = w * names["ts"][k]
        (_, v, a), (beta, rate, second) = slider(t, w)
        pin, arm = r * np.exp(1j * t), length / 2 * np.exp(1j * beta)  # the middle of the rod
        velocity = 1j * w * pin + 1j * rate * arm
        acceleration = -(w**2) * pin + (1j * second - rate**2) * arm
        power = 0.5 * v * a + 0.6 * (velocity.conjugate() * acceleration).real + 0.6 * length**2 / 12 * rate * second
        assert_allclose(names["torque"][k], power / w, **TOLERANCE)


def test_quick_return(answers):
    lever, half = answers("lever")["lever"], np.arcsin(100 / 250)  # the lever is tangent to the circle of the crank
    assert_allclose(lever.extent, 2 * half, **TOLERANCE)
    assert_allclose(lever.time_ratio, (np.pi + 2 * half) / (np.pi - 2 * half), **TOLERANCE)


def test_jansen(answers):
    def at(t):
        P, A = -38 - 7.8j, 15 * np.exp(1j * t)
        B, C = meet(P, A, 41.5, 50, 1), meet(P, A, 39.3, 61.9, -1)
        D = meet(P, B, 40.1, 55.8, 1)
        E = meet(D, C, 39.4, 36.7, -1)
        return meet(E, C, 65.7, 49, -1)

    t, h = np.radians(60), 1e-3
    foot = answers("foot")["foot"]
    assert_allclose(foot[0], [at(t).real, at(t).imag], **TOLERANCE)
    # The derivative of the circles' formulas, by differences of eighth order.
    weights = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
    velocity = sum(weight * at(t + k * h) for k, weight in zip(range(-4, 5), weights, strict=True)) / h
    assert_allclose(foot[1], [velocity.real, velocity.imag], **TOLERANCE)


def test_toggle(answers):
    force = answers("force")["force"]
    assert_allclose(force, 1 / (2 * 0.15 * np.sin(np.radians(5))), **TOLERANCE)  # the slider is at 2 l cos of the angle


def test_cam(answers):
    h, w, x = 0.02, 300 * np.pi / 30 / np.radians(120), 30 / 120
    expected = [0.04 + h * (x - np.sin(2 * np.pi * x) / (2 * np.pi)), h * w * (1 - np.cos(2 * np.pi * x))]
    assert_allclose(answers("follower")["follower"], [*expected, 2 * np.pi * h * w**2 * np.sin(2 * np.pi * x)], **TOLERANCE)


def test_gear_train(answers):
    """By Willis: relative to the arm, the train has the ratio of its teeth."""
    ratios = answers("ratios")["ratios"]
    assert_allclose([ratios["sun"], ratios["planet"]], [1 + 70 / 30, 1 - 70 / 20], **TOLERANCE)
