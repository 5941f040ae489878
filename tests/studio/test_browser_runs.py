"""Runs in the studio's page: another thread computes them, they can be stopped, and they end where a motor cannot go on."""

import time
from pathlib import Path

import numpy as np
import pytest

DEAD_POINT = (Path(__file__).parent / "dead_point.toml").read_text()
CAUSE = "the linkage reaches 107.038 deg, at 0.121119 s (dead point: pins B, D, E in line)"  # as the command line says
ANSWER = 0.1  # s: a page that answers later feels slow
BUSY = 5.0  # factor by which a busy machine may delay single answers


@pytest.mark.slow
def test_a_motor_that_runs_into_a_dead_point_stops_there_and_the_page_answers_meanwhile(studio):
    studio.watch()
    studio.open("dead_point.toml", DEAD_POINT)
    studio.until("studio.motion.pageEngine !== null")
    start = time.perf_counter()
    x, y = studio.pin("H")
    studio.page.mouse.move(x, y)
    studio.page.mouse.down()
    for k in range(60):
        studio.page.mouse.move(x + 20 * np.sin(k / 5), y + k / 3)
    studio.page.mouse.up()
    studio.page.keyboard.press("Control+z")
    studio.until("studio.motion.run?.done === false")
    stopped = time.perf_counter() - start
    studio.settle()
    said = studio.page.locator(".loops").inner_text()
    assert said.startswith('motor "motor1" asks for 114.') and said.endswith(CAUSE)
    answers, longest = studio.watched()
    print(f"stopped after {stopped:.1f} s; median answer {np.median(answers):.3f} s, longest task {longest:.3f} s")
    assert len(answers) > 20 and np.median(answers) < ANSWER
    assert max(answers) < BUSY * ANSWER and longest < BUSY * ANSWER
    assert studio.js("studio.motion.end") == pytest.approx(0.12)


@pytest.mark.slow
def test_a_long_run_is_stopped_by_a_button(studio):
    studio.js("studio.files.openTemplate('chain')")
    studio.until("studio.motion.pageEngine !== null")
    studio.settle()
    studio.js("studio.motion.pageEngine.scene.duration *= 5000")
    # By itself, a run ends after as many steps as take less time than the button waits.
    more = "const data = [...studio.sync.engines.values()].at(-1).engine; data.settings.max_steps *= 100;"
    studio.js(f"(() => {{ {more} studio.motion.pageEngine.runner.worker.postMessage({{data}}); }})()")
    studio.js("studio.motion.recompute()")
    studio.page.get_by_role("button", name="stop computing").click()
    studio.until("studio.motion.run.isStopped")
    assert "stopped at" in studio.page.locator(".loops").inner_text()
    assert 0 < studio.js("studio.motion.end / studio.motion.pageEngine.scene.duration") < 1
    assert not studio.page.get_by_role("button", name="stop computing").is_visible()


@pytest.mark.slow
def test_slow_diagnoses_of_outdated_drawings_are_left_out(studio):
    """A browser has six connections to a server: diagnoses that wait for each other must not keep the motion waiting."""
    pending, asked, is_held = [], [], [True]

    def hold(route):
        asked.append(route.request.post_data_json)
        if is_held[0]:
            pending.append(route)
        else:
            route.continue_()

    studio.page.route("**/api/diagnose", hold)
    studio.js("studio.files.openTemplate('crank_rocker')")
    studio.until("studio.motion.run?.count > 1")
    for k in range(8):
        studio.js(f"studio.commit({{...studio.document, name: 'drawing {k}'}})")
        studio.until("studio.motion.run?.count > 1")
        studio.page.wait_for_timeout(450)  # until this drawing would be diagnosed
    assert len(pending) == 1
    is_held[0] = False
    pending[0].continue_()
    studio.settle()
    assert "drawing 7" not in asked[0]["text"] and all("drawing 7" in one["text"] for one in asked[1:])
    assert "1 degree of freedom" in studio.findings
    assert studio.js("studio.answers.text").count("drawing 7") == 1
