"""Random gestures on drawings with motors: the page always answers, and undo restores everything."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.studio.gestures import RandomGestures

TEMPLATES = ("crank_rocker", "quick_return", "toggle_press", "cam_follower", "six_bar", "jansen_leg")
GESTURES = 170  # on each of them
SEEDS, EACH = 10, 100  # a thousand gestures on a six-bar whose motor runs into a dead point
TOO_LONG = "504 (Gateway Timeout)"  # the server gives up a diagnosis that takes too long, and the page says so
FRAME = 0.2  # s of processor time: the longest for which the page may be busy
DRAGS = {"crank_rocker": "a four-bar", "quick_return": "Whitworth's quick return", "six_bar": "a six-bar"}
MOVES = 60  # of a drag
AT_SIXTY = 1 / 60  # s: processor time of the page's thread for a frame, painting included
SCRIPT = 0.006  # s: of that, by programs
SOON = 0.1  # s: from an event of the pointer to its drawing, of nine in ten


@pytest.mark.slow
@pytest.mark.parametrize("template", TEMPLATES)
def test_random_gestures_are_answered_and_undone(studio, template):
    studio.js(f"studio.files.openTemplate({json.dumps(template)})")
    gesticulate(studio, template, TEMPLATES.index(template), GESTURES)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(len(TEMPLATES), len(TEMPLATES) + SEEDS))
def test_gestures_on_a_motor_that_runs_into_a_dead_point(studio, seed):
    studio.open("dead_point.toml", (Path(__file__).parent / "dead_point.toml").read_text())
    gesticulate(studio, "dead point", seed, EACH)


@pytest.mark.slow
@pytest.mark.parametrize("template", DRAGS)
def test_drags_follow_at_sixty_frames_a_second_beside_the_answers(studio, template):
    """Times are those of the processor, so that they hold on a busy machine, too."""
    studio.js(f"studio.files.openTemplate({json.dumps(template)})")
    studio.settle()
    studio.until("studio.motion.run?.count > 1 && studio.answers.element.querySelectorAll('dt').length > 0")
    assert studio.page.locator(".answers dt").first.is_visible()
    moving = studio.js("Object.keys(studio.document.pins).filter(name => !studio.document.ground.includes(name))")
    x, y = studio.pin(moving[-1])
    studio.watch()
    studio.page.mouse.move(x, y)
    studio.page.mouse.down()
    before = studio.processor_time()
    for k in range(1, MOVES + 1):
        studio.page.mouse.move(x + 0.4 * k, y + 6 * np.sin(k / 6))
        studio.page.wait_for_timeout(10)
    task, script = np.subtract(studio.processor_time(), before) / studio.js("watched.frames")
    studio.page.mouse.up()
    answers = studio.watched()[0]
    frame = f"{1e3 * task:.1f} ms a frame, {1e3 * script:.1f} of it by programs"
    print(f"{DRAGS[template]}: {frame}; drawn after {1e3 * np.median(answers):.1f} ms")
    assert task < AT_SIXTY and script < SCRIPT
    assert np.quantile(answers, 0.9) < SOON


def gesticulate(studio, name, seed, count):
    """Make random gestures on the drawing that is opened; each must be answered in time, and all are undone and redone."""
    studio.until("studio.motion.pageEngine !== null")
    studio.settle()
    studio.watch()
    first, gestures = studio.js("studio.state"), RandomGestures(studio, seed)
    longest: list[tuple[float, str]] = []
    moves = 0
    for k in range(count):
        studio.js("watched.longest = 0")
        before, _ = studio.processor_time()
        done = gestures()
        studio.problems[:] = [said for said in studio.problems if TOO_LONG not in said]
        assert studio.problems == [], (k, done, studio.problems)
        moves += studio.js("Boolean(studio.motion.pageEngine) && studio.motion.run?.count > 1")
        # On a busy machine a task lasts longer than it needs: no task needs more than the gesture.
        longest.append((min(studio.watched()[1], studio.processor_time()[0] - before), f"{k}: {done}"))
    print(f"{name}: moved after {moves} of {count} gestures; longest tasks of the page (s):", sorted(longest)[-5:])
    assert moves > 0
    slow = [one for one in longest if one[0] > FRAME]
    studio.page.keyboard.press("Escape")
    studio.page.keyboard.press("Escape")
    studio.js("(() => { while (studio.history.canRedo) studio.redo(); })()")
    last = studio.document
    studio.js("(() => { while (studio.history.canUndo) studio.undo(); })()")
    assert studio.js("studio.state") == first
    studio.js("(() => { while (studio.history.canRedo) studio.redo(); })()")
    assert studio.document == last
    assert not slow, slow
