"""The widget in JupyterLab, in headless Chromium: it appears, plays, and is controlled by Python."""

import json
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

CELLS = (
    "import sys; sys.path.insert(0, {root!r})\n"
    "import numpy as np, udkjax as udk\n"
    "from tests.show.player.conftest import slider_crank_run\n"
    "run = slider_crank_run(np.linspace(0, 2, 81))\n"
    "widget = udk.animate(udk.library.slider_crank(), run, measures=()).widget()\n"
    "widget",
    "udk.animate(udk.library.slider_crank(), run, measures=())",
    "widget.time = 1.25",
    "widget.time",
    "live = udk.animate(udk.library.slider_crank(), live=['motor.motor.speed'])\nlive.widget()",
    "live",
)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """The address of JupyterLab with a notebook."""
    pytest.importorskip("jupyterlab", reason="jupyterlab is not installed: pip install '.[browser]'")
    pytest.importorskip("anywidget", reason="anywidget is not installed: pip install '.[notebook]'")
    folder = tmp_path_factory.mktemp("lab")
    root = str(Path(__file__).parents[3])
    cells = [
        {
            "cell_type": "code",
            "id": f"c{k}",
            "metadata": {},
            "outputs": [],
            "execution_count": None,
            "source": text.format(root=root),
        }
        for k, text in enumerate(CELLS)
    ]
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    (folder / "motion.ipynb").write_text(json.dumps({"nbformat": 4, "nbformat_minor": 5, "metadata": kernel, "cells": cells}))
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    options = [
        "--no-browser",
        "--allow-root",
        "--IdentityProvider.token=",
        "--ServerApp.disable_check_xsrf=True",
        f"--ServerApp.port={port}",
        "--ServerApp.ip=127.0.0.1",
    ]
    options += [f"--ServerApp.root_dir={folder}"]
    log = (folder / "log").open("w")
    server = subprocess.Popen([sys.executable, "-m", "jupyterlab", *options], cwd=folder, stdout=log, stderr=log)
    address = f"http://127.0.0.1:{port}"
    try:
        for _ in range(120):
            try:
                urllib.request.urlopen(f"{address}/api/status", timeout=2)
                break
            except OSError:
                time.sleep(0.5)
        else:
            pytest.fail(f"JupyterLab did not start: {(folder / 'log').read_text()[-2000:]}")
        yield address
    finally:
        server.terminate()
        server.wait(20)
        log.close()


@pytest.fixture
def notebook(browser, lab):
    """The notebook in a page, and a function that runs one of its cells."""
    page = browser.new_page(viewport={"width": 1200, "height": 1000})
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(f"{lab}/doc/tree/motion.ipynb")
    page.locator(".jp-Notebook").wait_for(timeout=60_000)
    page.get_by_text("| Idle").wait_for(timeout=60_000)  # the kernel is ready

    def run_cell(k):
        page.locator(".jp-Notebook .jp-CodeCell").nth(k).locator(".cm-content").click()
        page.keyboard.press("Control+Enter")

    yield page, run_cell
    assert not [problem for problem in problems if "player" in problem.lower()], problems
    page.close()


def test_the_widget_plays_in_jupyterlab(notebook):
    page, run_cell = notebook
    run_cell(0)
    widget = page.locator(".jp-Notebook .jp-CodeCell").nth(0)
    widget.get_by_role("button", name="play").wait_for(timeout=90_000)
    player = "[...document.querySelectorAll('*')].find(e => e.player).player"
    assert page.evaluate(f"{player}.time") == 0
    widget.get_by_role("button", name="play").click()
    page.wait_for_function(f"{player}.time > 0.1")
    widget.get_by_role("button", name="pause").click()
    run_cell(2)  # Python moves the player
    page.wait_for_function(f"Math.abs({player}.time - 1.25) < 1e-9")
    page.evaluate(f"{player}.seek(0.75)")  # the player reports to Python
    page.wait_for_timeout(500)
    run_cell(3)
    page.get_by_text("0.75", exact=True).wait_for(timeout=20_000)
    run_cell(1)  # an animation shows itself as a page in a frame
    frame = page.locator(".jp-Notebook .jp-CodeCell").nth(1).frame_locator("iframe")
    frame.get_by_role("button", name="play").wait_for(timeout=60_000)


def test_live_players_simulate_without_a_kernel(notebook, lab):
    page, run_cell = notebook
    run_cell(0)
    for k in (4, 5):
        run_cell(k)
    cells = page.locator(".jp-Notebook .jp-CodeCell")
    shown = cells.nth(4), cells.nth(5).frame_locator("iframe")
    for player in shown:
        player.get_by_text("Move a slider").wait_for(timeout=90_000)
    for kernel in json.load(urllib.request.urlopen(f"{lab}/api/kernels")):
        urllib.request.urlopen(urllib.request.Request(f"{lab}/api/kernels/{kernel['id']}", method="DELETE"))
    for player in shown:
        number = player.get_by_role("spinbutton", name="motor speed, number")
        number.fill("2")
        number.press("Enter")
        player.get_by_text("10 s simulated in").wait_for(timeout=20_000)
