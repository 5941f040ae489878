"""Runs in the studio's page: another thread computes them, they can be stopped, and they end where a motor cannot go on."""

import time

import numpy as np
import pytest

# A six-bar with a loose link; the motor runs into a dead point after a nineteenth of a turn.
DEAD_POINT = """format = 2
units = {length = "mm", angle = "deg"}
ground = ["A", "E", "G"]
link = [
  {name = "link1", pins = ["A", "B"], density = 7850, width = 10, thickness = 2},
  {name = "link2", pins = ["B", "C", "D"], density = 7850, thickness = 2},
  {name = "link3", pins = ["D", "E"], density = 7850, width = 10, thickness = 2},
  {name = "link4", pins = ["C", "F"], density = 7850, width = 10, thickness = 2},
  {name = "link5", pins = ["F", "G"], density = 7850, width = 10, thickness = 2},
  {name = "link6", pins = ["F", "H"], density = 7850, width = 10, thickness = 2},
]
motor = [{pin = "A", speed = "60 rpm"}]
[pins]
A = [-10, 40]
B = [10, 80]
C = [75, 165]
D = [115, 85]
E = [140, 20]
F = [190, 165]
G = [220, 40]
H = [275, 210]
"""
CAUSE = "the linkage reaches 1.86816 rad, at 0.121119 s (dead point: pins B, D, E in line)"  # as the command line says
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
    assert said.startswith('driver "motor1" asks for 1.99') and said.endswith(CAUSE)
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
    studio.js("studio.motion.pageEngine.scene.duration *= 50")
    studio.js("studio.motion.recompute()")
    studio.page.get_by_role("button", name="stop computing").click()
    studio.until("studio.motion.run.isStopped")
    assert "stopped at" in studio.page.locator(".loops").inner_text()
    assert 0 < studio.js("studio.motion.end / studio.motion.pageEngine.scene.duration") < 1
    assert not studio.page.get_by_role("button", name="stop computing").is_visible()
