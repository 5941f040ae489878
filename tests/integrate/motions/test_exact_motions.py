"""Motions in closed form with each engine: machine code, diffrax with events in plain form, and WebAssembly."""

import json
import shutil
import subprocess

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.integrate.motions.exact_motions import EXACT
from udkjax.integrate.portable import portable_engine
from udkjax.show.player.page import module

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
    if (node := shutil.which("node")) is None:
        pytest.skip("node is not installed")
    engine = portable_engine(scene.mechanism, rtol=TOL, atol=TOL, events=scene.events)
    script = f"""
        const engine = await loadEngine({json.dumps(engine.data)}), times = Float64Array.from({json.dumps(scene.ts.tolist())});
        const found = engine.run(null, engine.close(), times);
        console.log(JSON.stringify({{q: [...found.q], done: found.done, words: found.words, times: found.events.map(e => e.t)}}));
    """
    (folder / "script.mjs").write_text(module() + script, encoding="utf-8")
    done = subprocess.run([node, folder / "script.mjs"], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert found["done"], found["words"]
    return np.reshape(found["q"], (len(scene.ts), 3)), found["times"]


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
