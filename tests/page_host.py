"""Motions computed by Node.js with the modules of a page: its engine and its event loop in JavaScript, without a browser."""

import json
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import udkjax as udk
from udkjax.integrate.portable import portable_engine
from udkjax.show.player.page import module


def page_run(
    mechanism: udk.Mechanism,
    ts: np.ndarray,
    events: Sequence[Any],
    folder: Path,
    tol: float,
    changed: Mapping[str, float] | None = None,
    steps: int = 0,
) -> dict[str, Any]:
    """Return a run of the page's engine, with changed numbers, and its measures; the events by name, with their times.

    With `steps` it is computed in parts of so many steps. Skips the test where Node.js is missing.
    """
    if (node := shutil.which("node")) is None:
        pytest.skip("node is not installed")
    engine = portable_engine(mechanism, list(changed or ()), rtol=tol, atol=tol, events=events)
    assert not engine.data["why"], engine.data["why"]
    script = f"""
        const engine = await loadEngine({json.dumps(engine.data)}), times = Float64Array.from({json.dumps(ts.tolist())});
        const values = {json.dumps(list(changed.values()) if changed else None)}, state = engine.close(values);
        const parts = new PartRun(engine, values, state, times);
        let count = 0;
        if ({steps}) do count += 1; while (parts.goOn({steps}));
        const found = count ? {{...parts.run, done: parts.done, words: parts.words}} : engine.run(values, state, times);
        const measures = engine.measure(values, found, true, true), list = x => x && [...x];
        console.log(JSON.stringify({{q: list(found.q), v: list(found.v), done: found.done, words: found.words, count: found.count,
            events: found.events.map(e => [engine.data.events.names[e.index], e.t]), kinetic: list(measures.kinetic),
            parts: count, friction: list(measures.friction), forces: list(measures.forces),
            efforts: Object.entries(measures.efforts).map(([k, x]) => [k, list(x)])}}));
    """
    (folder / "script.mjs").write_text(module() + script, encoding="utf-8")
    done = subprocess.run([node, folder / "script.mjs"], capture_output=True, text=True)
    assert not done.returncode, done.stderr
    found = json.loads(done.stdout)
    shape = (len(ts), *mechanism.state_shape())
    return found | {name: np.array(found[name], float).reshape(shape) for name in ("q", "v")}
