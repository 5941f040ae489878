"""Searches for the mechanisms of curves, by the public function and by BFGS, and independent checks of the results."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

import udkjax as udk
from udkjax.synthesis.curves.curve_designs import CurveDesign
from udkjax.synthesis.curves.curve_search import CurveSearch
from udkjax.synthesis.curves.descent import Task, evaluate
from udkjax.synthesis.curves.dyads import Topology
from udkjax.synthesis.curves.matching import find_starts
from udkjax.synthesis.curves.mechanisms_for import DEFAULT_SIZE, DEFAULT_TRANSMISSION, curve_limits
from udkjax.synthesis.curves.targets import WantedCurve

BARS = (4, 6, 8, 10, 12)
MOST_RESULTS = 12  # designs of a search: with each number of bars
PATH, SEGMENTS = 240, 60  # numbers in the data of a curve
LONG = 600.0  # CPU time that no search takes (s)
TIMES = 40  # progress reports of a search
SAME = 1e-9  # largest distance of pins before and after a turn, relative to the size
STARTS, STEPS = 300, 100  # of BFGS: random linkages, and steps with each of two blurs
Result = dict[str, Any]


def stored(folder: Path | None, name: str, compute: Callable[[], Result]) -> Result:
    """Return a result from a folder; compute and write it if it is not there. Without a folder, compute it."""
    file = None if folder is None else folder / f"{name}.json"
    if file is not None and file.exists():
        return json.loads(file.read_text(encoding="utf-8"))
    result = compute()
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part")
        part.write_text(json.dumps(result), encoding="utf-8")
        part.replace(file)
    return result


def search(curve: np.ndarray, rounds: int, seed: int = 0, **options: Any) -> Result:
    """Return what `udk.mechanisms_for` finds within some rounds, by default or with options, and checks of the best design."""
    reports: list[tuple[float, float]] = []
    begun = time.process_time()

    def note(progress: Any) -> None:
        _, said, error = progress.message.rpartition("error ")
        if said:
            reports.append((time.process_time() - begun, float(error)))

    given: dict[str, Any] = {
        "seconds": LONG,
        "rounds": rounds,
        "seed": seed,
        "results": MOST_RESULTS,
        "progress": note,
        **options,
    }
    found = udk.mechanisms_for(curve, **given)
    spent, best = time.process_time() - begun, min(found, key=lambda one: one.error)
    errors = [min((one.error for one in found if one.bars <= bars), default=np.inf) for bars in BARS]
    reports = [*reports[-TIMES + 1 :], (spent, best.error)]
    path = best.curve[np.linspace(0, len(best.curve) - 1, PATH).astype(int)]
    outcome = {"error": errors, "bars": best.bars, "seconds": spent, "rounds": found.rounds, "reports": reports}
    return outcome | check(best, curve) | {"path": path.tolist(), "links": _links(best)}


def check(design: CurveDesign, curve: np.ndarray) -> Result:
    """Follow a mechanism over 720 positions of a turn by `udk.kinematics`; return what must hold, and the CPU time of it.

    `turned`: all positions are reached, and the last one is the first. `open`: largest gap of a loop, relative to coordinates.
    `size`: relative to the limit. `off`: largest distance of the pin from the returned curve while it draws, in extents of the
    wanted curve: another branch would draw another one.
    """
    wanted, mechanism, ts = WantedCurve(curve), design.mechanism, np.arange(721) / 720  # at 60 rpm
    begun = time.process_time()
    motion = udk.kinematics(mechanism, None, ts)
    spent = time.process_time() - begun
    gap = np.abs(udk.violation(mechanism, motion)).max()
    pins = {pin: np.asarray(udk.path(mechanism, motion, pin)) for pin in design.pins}
    middle = np.array([wanted.middle.real, wanted.middle.imag])
    size = max(float(np.linalg.norm(path - middle, axis=1).max()) for path in pins.values())
    back = max(float(np.abs(path[-1] - path[0]).max()) for path in pins.values())
    drawn = pins[design.pin][2 * np.pi * ts <= np.ptp(design.values)]
    return {
        "turned": bool(np.all(motion.reached) and back < SAME * size),
        "open": float(gap / (size + np.linalg.norm(middle))),
        "size": size / (DEFAULT_SIZE * wanted.extent),
        "off": float(cKDTree(design.curve).query(drawn)[0].max() / wanted.extent),
        "following": spent,
    }


def _links(design: CurveDesign) -> list[list[list[float]]]:
    """Return segments from the first pin of each link to its others, as drawn (m)."""
    pins = {name: np.asarray(place).tolist() for name, place in design.pins.items()}
    links = design.drawing.links.values() if isinstance(design.drawing, udk.Drawing) else ()
    return [[pins[link.pins[0]], pins[name]] for link in links for name in link.pins[1:]][:SEGMENTS]


def by_bfgs(curve: np.ndarray, seconds: float, bars: int, seed: int) -> Result:
    """Return the least error of random linkages that BFGS improves one after another for CPU seconds."""
    wanted = WantedCurve(curve)
    one_by_one = CurveSearch(wanted, curve_limits(wanted, None, DEFAULT_TRANSMISSION), bars, seed)
    begun, best, dyads = time.process_time(), np.inf, (bars - 2) // 2
    starts, topology = find_starts(wanted, one_by_one.limits, dyads, STARTS, STARTS, np.random.default_rng(seed))
    low, high = (
        bound[0] for bound in one_by_one.limits.bounds(topology, wanted.is_whole)
    )  # the same for all: all joints are pins

    def loss(y: np.ndarray, topology: Topology, task: Task, blur: float) -> tuple[float, np.ndarray]:
        value, _, _, _, slope = evaluate(np.clip(y, low, high)[None], topology, task, blur)
        return float(value[0]), slope[0]

    for k in range(len(starts)):
        one, x = topology.take(slice(k, k + 1)), starts[k]
        for blur, weight in ((0.05, 10.0), (0.01, 100.0)):
            given = (one, one_by_one.coarse.weighed(weight), blur)
            x = np.clip(minimize(loss, x, given, jac=True, method="BFGS", options={"maxiter": STEPS}).x, low, high)
        found = one_by_one.verified(x, one)
        best = best if found is None else min(best, found.error)
        if time.process_time() - begun > seconds:
            break
    return {"error": best, "seconds": time.process_time() - begun}
