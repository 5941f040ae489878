"""Events of random scenes, many at nearly the same times: the same at a loose and at a tight tolerance."""

# pyright: reportOptionalMemberAccess=false
# All of these runs have events.

from typing import Any

import numpy as np
import pytest

import udkjax as udk
from experiments.parts.random_scenes import build, random_scene, state_of
from tests.integrate.events.event_scenes import Level

COORDINATES = ("x", "y", "angle", "vx", "vy", "omega")


# Scenes in which events were lost, counted twice or never located, because others happen within 1e-9 of their time.
@pytest.mark.slow
@pytest.mark.parametrize("scene", [2, 8, 22, 24, 25, 34, 36, 72])
def test_events_are_the_same_at_a_loose_and_at_a_tight_tolerance(scene):
    scene, rng = random_scene(23, scene, 0, bodies=(2, 5)), np.random.default_rng(scene)
    mechanism, (q, v), end = build(scene.table), state_of(scene.table), 6 * float(scene.time)
    given: dict[str, Any] = {"state": udk.State(q, v), "throw": False}
    motion = udk.simulate(mechanism, np.linspace(0.0, end, 41), rtol=1e-9, atol=1e-9, **given)
    y, events = np.concatenate([motion.q, motion.v], axis=2), []
    for i, body in enumerate(mechanism.body_names):
        for k, coordinate in enumerate(COORDINATES):
            if np.ptp(y[:, i, k]) > 1e-6:
                events.append(
                    udk.Event(Level(y[rng.integers(5, 38), i, k], body, coordinate), udk.Log(), name=f"{body} {coordinate}")
                )
    loose, tight = (
        udk.simulate(mechanism, [0.0, end], events=events, rtol=tol, atol=tol, max_events=400, max_steps=20_000, **given)
        for tol in (1e-7, 1e-11)
    )
    assert loose.result == tight.result == udk.Result.successful
    for event in events:
        np.testing.assert_allclose(loose.events.of(event.name), tight.events.of(event.name), rtol=0, atol=1e-5 * end)
    # The state at an event is that where its condition is zero, but for ten times the loose tolerance.
    for k, before_q, before_v in zip(loose.events.index, loose.events.q_before, loose.events.v_before, strict=True):
        level = events[int(k)].condition
        i, c = mechanism.body_names.index(level.body), COORDINATES.index(level.coordinate)
        off = np.concatenate([before_q, before_v], axis=1)[i, c] - float(level.level)
        assert abs(off) < 1e-6 * np.ptp(y[:, i, c])
