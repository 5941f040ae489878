"""Live pages: size of the engine of each scene of the library, time to make it, speed of solving and drawing.

A run of 401 states in headless Chromium is compared with the same run by the engine on this processor, in the same minute. For
120 moves of a slider, one per frame of the screen, the time from the move to the picture, the CPU time of the page's thread and
the frame rate are measured.
"""

import json
import statistics
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

import udkjax as udk
from udkjax.integrate import native_engine

CHROMIUM = ("/usr/bin/chromium", "/usr/bin/chromium-browser")
SPANS = {"andrews_squeezer": 0.03}  # s; all other scenes
SPAN = 20.0
RUNS, WARM, MOVES = 30, 20, 120
PLAYER = "document.getElementById('player').player"
RUN_IN_PAGE = """async runs => {
  const {live} = PLAYER, times = [];
  await live.ready;
  const {engine, values, first} = live.runs[0], state = engine.close(values, {t: first.ts[0]});
  for (let k = 0; k < runs + 10; k++) {
    const start = performance.now();
    engine.run(values, state, first.ts);
    if (k >= 10) times.push(performance.now() - start);
  }
  return times.sort((a, b) => a - b)[times.length >> 1];
}""".replace("PLAYER", PLAYER)
# The page's code is compiled during its first run, before anyone moves a slider.
MOVE_IN_PAGE = """async ([warm, moves]) => {
  const {live} = PLAYER, delays = [], median = x => [...x].sort((a, b) => a - b)[x.length >> 1];
  const {range, slider: {value, low, high}} = live.panel.rows[0], frame = () => new Promise(done => requestAnimationFrame(done));
  let start = await frame(), last = start;
  for (let k = 0; k < warm + moves; k++) {
    if (k === warm) start = last;
    range.value = value + 0.05 * (high - low) * Math.sin(k / 9);
    const moved = performance.now();
    range.dispatchEvent(new Event("input"));
    last = await frame();
    await new Promise(done => setTimeout(done));
    if (k >= warm) delays.push(performance.now() - moved);
  }
  return {picture_ms: median(delays), worst_picture_ms: Math.max(...delays), frames_per_s: 1000 * moves / (last - start)};
}""".replace("PLAYER", PLAYER)


def busy_seconds(client: Any) -> float:
    """Return the CPU time (s) of the main thread of a page."""
    metrics = client.send("Performance.getMetrics")["metrics"]
    return next(metric["value"] for metric in metrics if metric["name"] == "TaskDuration")


def made(name: str, folder: Path) -> tuple[dict[str, Any], Path, Any]:
    """Return the size and time of making the page of a scene, the page, and a run by the engine on this processor."""
    mechanism, seen = getattr(udk.library, name)(), []
    run = native_engine.call_concrete

    def counted(operation: Any, inputs: Any, times: int) -> Any:
        seen.append(lambda: run(operation, inputs, times))
        return run(operation, inputs, times)

    native_engine.call_concrete = counted
    try:
        solution = udk.simulate(mechanism, np.linspace(0.0, SPANS.get(name, SPAN), 401), throw=False)
    finally:
        native_engine.call_concrete = run
    start = time.perf_counter()
    animation = udk.animate(mechanism, solution, live=True)
    seconds = time.perf_counter() - start
    page = animation.save(folder / f"{name}.html")
    modules = animation.data["live"]["engines"][0]["modules"]
    size = {"module_bytes": modules["run"]["bytes"], "page_bytes": page.stat().st_size, "seconds": seconds}
    return {"name": name, **size}, page, seen[0]


def native_ms(run: Any) -> float:
    """Return the median time (ms) of a run by the engine on this processor."""
    times = []
    for _ in range(RUNS):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Measure, print a line for each scene, and write the figures."""
    try:
        sync_playwright = import_module("playwright.sync_api").sync_playwright
    except ImportError:
        print("    playwright is not installed: sizes alone")
        sync_playwright = None
    path = next((path for path in CHROMIUM if Path(path).exists()), None)
    rows = []
    names = ["simple_pendulum"] if smoke else sorted(udk.library.__all__)
    with tempfile.TemporaryDirectory() as folder:
        pages = [made(name, Path(folder)) for name in names]
        if sync_playwright is None or path is None:
            rows = [row for row, _, _ in pages]
        else:
            with sync_playwright() as tools:
                browser = tools.chromium.launch(executable_path=path, args=["--no-sandbox"])
                for row, file, run in pages:
                    page = browser.new_page(viewport={"width": 1280, "height": 800})
                    page.goto(file.as_uri())
                    page.wait_for_timeout(500)  # wait for its engine
                    client = page.context.new_cdp_session(page)
                    client.send("Performance.enable", {"timeDomain": "threadTicks"})
                    runs, warm, moves = (3, 1, 5) if smoke else (RUNS, WARM, MOVES)
                    run_ms = page.evaluate(RUN_IN_PAGE, runs)
                    before = busy_seconds(client)
                    pictures = page.evaluate(MOVE_IN_PAGE, [warm, moves])
                    busy_ms = 1e3 * (busy_seconds(client) - before) / (warm + moves)
                    page.close()
                    rows.append(row | {"run_ms": run_ms, "native_ms": native_ms(run), "busy_ms": busy_ms} | pictures)
                    show(rows[-1])
                browser.close()
    return rows


def show(row: dict[str, Any]) -> None:
    """Print the figures of a scene."""
    sizes = f"run {row['module_bytes'] / 1e3:.0f} kB, page {row['page_bytes'] / 1e3:.0f} kB, made in {row['seconds']:.1f} s"
    runs = f"run {row['run_ms']:.2f} ms, native {row['native_ms']:.2f} ms"
    pictures = f"a move {row['busy_ms']:.1f} ms of CPU time, to the picture {row['picture_ms']:.0f} ms, at worst "
    pictures += f"{row['worst_picture_ms']:.0f}; {row['frames_per_s']:.0f} frames a second"
    print(f"    {row['name']:20} {sizes}; {runs}; {pictures}")


if __name__ == "__main__":
    print(json.dumps(main()))
