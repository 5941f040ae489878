"""The cost of an event, by the parts of the program in which its time is spent, beside the same run without events."""

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import udkjax as udk
from benchmarks.common import cpu_seconds, in_turn
from benchmarks.friction import with_friction

PACKAGE = str(Path(udk.__file__).parent) + "/"
# The part that a function belongs to, by the beginning of its file's path; of several that fit the first counts.
PARTS = {
    "conditions": ("integrate/events/instant/system", "integrate/events/instant/listing", "integrate/events/law/crossings"),
    "changes": tuple(f"integrate/events/instant/{x}" for x in ("impacts", "jumps", "changes", "closing", "hops", "sticking"))
    + ("complementarity",),
    "loop": ("integrate/events",),
    "machine code": ("native",),
    "call": ("",),
}
OUTSIDE, TICK = "outside", 1e-4  # s between looks at the running function
ROUNDS, AT_LEAST = 7, 0.1  # s


def bouncing_box(count: int) -> tuple[udk.Mechanism, list[Any]]:
    """Return a box that falls on its feet, without friction."""
    mech = udk.Mechanism({"box": udk.Body(1.0, 0.1, (0.0, 0.6), 0.2)}, gravity=(0.0, -9.81))
    feet = np.linspace(-0.5, 0.5, count)
    return mech, [udk.Contact("box", [x, -0.2], restitution=0.7, name=f"foot {k}") for k, x in enumerate(feet)]


def limited_pendulum() -> tuple[udk.Mechanism, list[Any]]:
    """Return a pendulum that bounces off a limit of its joint."""
    mech = udk.library.compound_pendulum()
    return mech, [udk.Event(lambda t, at: at["rod"].angle + 1.8, udk.Impact(0.9), name="limit")]


def rubbing(make: Callable[[], udk.Mechanism]) -> tuple[udk.Mechanism, list[Any]]:
    """Return a mechanism with set-valued friction in its joints: it sticks at each reversal."""
    return with_friction(make(), law="set-valued"), []


SCENES: dict[str, tuple[Callable[[], tuple[udk.Mechanism, list[Any]]], float]] = {
    "a limit": (limited_pendulum, 10.0),
    "one foot": (partial(bouncing_box, 1), 3.0),
    "two feet": (partial(bouncing_box, 2), 1.2),
    "joints that stick": (partial(rubbing, udk.library.four_bar), 2.0),
}


def part_of(frame: Any) -> str:
    """Return the part of the innermost function of the package on a stack."""
    while frame is not None:
        file = frame.f_code.co_filename
        if file.startswith(PACKAGE):
            place = file[len(PACKAGE) :]
            return next(part for part, starts in PARTS.items() if place.startswith(starts))
        frame = frame.f_back
    return OUTSIDE


@contextmanager
def looking(counts: Counter[str]):
    """Count the parts in which this thread is, at each tick."""
    own, ended, before = threading.get_ident(), threading.Event(), sys.getswitchinterval()

    def look():
        while not ended.is_set():
            time.sleep(TICK)
            counts[part_of(sys._current_frames()[own])] += 1

    sys.setswitchinterval(TICK / 2)
    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        sys.setswitchinterval(before)


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print the time of each run with its events and without them, and the shares of its parts."""
    rounds, at_least, looks = (1, 0.0, 0.05) if smoke else (ROUNDS, AT_LEAST, 3.0)
    print(f"{'':20} {'events':>6} {'ms a run':>9} {'without':>8} {'us each':>8}   " + " ".join(f"{x:>12}" for x in PARTS))
    rows = []
    for name, (make, end) in list(SCENES.items())[: 1 if smoke else None]:
        mech, events = make()
        free = udk.Mechanism(mech.bodies, mech.joints, mech.drivers, gravity=mech.gravity) if mech.joints else mech
        ts = np.linspace(0.0, end, 11)
        run = partial(udk.simulate, mech, ts, events=events or None)
        found = run()
        assert found.events is not None, name
        count = int(found.events.count)
        assert count > 3, name
        runs = {"with": run, "without": partial(udk.simulate, free, ts)}
        for x in runs.values():
            x()
        times = in_turn({x: partial(cpu_seconds, r, at_least) for x, r in runs.items()}, rounds)
        best = {x: 1e3 * min(t) for x, t in times.items()}
        counts: Counter[str] = Counter()
        with looking(counts):
            until = time.perf_counter() + looks
            while time.perf_counter() < until:
                run()
        total = sum(counts[x] for x in PARTS) or 1
        row = {"name": name, "events": count, "ms": best["with"], "ms_without": best["without"]}
        row["us_each"] = 1e3 * (best["with"] - best["without"]) / count
        row |= {f"share of {x}": counts[x] / total for x in PARTS}
        rows.append(row)
        print(
            f"{name:20} {count:6} {row['ms']:9.3f} {row['ms_without']:8.3f} {row['us_each']:8.1f}   "
            + " ".join(f"{1e3 * row['ms'] * counts[x] / total / count:9.1f} us" for x in PARTS)
        )
    return rows
