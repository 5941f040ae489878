"""Motions in closed form with each engine: machine code, diffrax with events in plain form, and WebAssembly."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.integrate.motions.exact_motions import EXACT
from tests.page_host import page_run

TOL = 1e-10


def by_simulate(engine):
    def run(scene, folder):
        found = udk.simulate(
            scene.mechanism, scene.ts, rtol=TOL, atol=TOL, engine=engine, events=scene.events or None, max_events=8
        )
        return found.q[:, 0], [] if found.events is None else found.events.time[: int(found.events.count)]

    return run


def by_page(scene, folder):
    """The motion computed by Node.js with the modules of a page: its engine, and its event loop in JavaScript."""
    found = page_run(scene.mechanism, scene.ts, scene.events, folder, TOL)
    assert found["done"], found["words"]
    return found["q"][:, 0], [t for _, t in found["events"]]


ENGINES = {"native": by_simulate("native"), "jax": by_simulate("jax"), "page": by_page}


CASES = [
    pytest.param(name, engine, marks=() if engine == "native" or name == "thrown" else pytest.mark.slow)
    for name in EXACT
    for engine in ENGINES
]


@pytest.mark.parametrize(("name", "engine"), CASES)
def test_the_motion_is_that_of_the_closed_form(name, engine, tmp_path):
    scene = EXACT[name]
    q, times = ENGINES[engine](scene, tmp_path)
    assert_allclose(q, scene.exact(scene.ts), rtol=0, atol=scene.atol)
    assert_allclose(np.unique(np.round(times, 9)), scene.event_times, rtol=0, atol=1e-8)
