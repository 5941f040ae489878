"""All four-bars through nine points or five poses: `python -m benchmarks.complete_design [SETS]`.

The published problem is solved in its own process, without stored machine code and on one core: its times include importing and
compiling. Then known four-bars are searched by nine of their own places, at random crank angles, and by five poses. Finally the
numbers of real solutions of random places are printed.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

CASES = Path(__file__).parents[1] / "tests" / "data" / "path_synthesis.json"
SETS = 10
FOUND_TOL = 1e-6  # fraction of the frame: largest distance between the pins of a found four-bar and of the known one
ALONE = """
import time; begin = time.perf_counter()
from benchmarks.complete_design import drawing, published
import udkjax as udk
found = udk.design_all(drawing(), udk.PathGoal("P", published()["points"]))
print(time.process_time(), time.perf_counter() - begin)
"""


def published() -> dict:
    """Return the published problem and its counts."""
    return json.loads(CASES.read_text())["nine_points"]


def drawing():
    """Return a four-bar; the positions of its pins do not matter."""
    from benchmarks.design import LINKAGE

    return LINKAGE


def known_four_bar(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the joints O, C, A, B (4,) of a random four-bar that can take all J poses (J, 3) of its crank."""
    while True:
        frame, crank, coupler, rocker = rng.uniform(0.5, 3.0, 4)
        angles = np.sort(rng.uniform(0, 2 * np.pi, count))
        A = crank * np.exp(1j * angles)
        reach = np.abs(frame - A)
        cosine = (coupler**2 + reach**2 - rocker**2) / (2 * coupler * reach)
        if np.all(np.abs(cosine) < 0.98):
            turn = (frame - A) / reach * np.exp(1j * np.arccos(cosine))
            P = A + turn * (rng.normal() + 1j * rng.normal())
            return np.array([0, frame, A[0], A[0] + coupler * turn[0]]), np.stack([P.real, P.imag, np.angle(turn)], 1)


def main(sets: int = SETS) -> None:
    """Print times and counts."""
    import udkjax as udk

    environment = os.environ | {"UDKJAX_CACHE": "0"}
    pin = ["taskset", "-c", "0"] if sys.platform == "linux" else []
    ran = subprocess.run([*pin, sys.executable, "-c", ALONE], env=environment, check=True, capture_output=True, text=True)
    cpu, wall = map(float, ran.stdout.split())
    print(f"published problem, a new process on one core: {cpu:.2f} s CPU, {wall:.2f} s wall, importing and compiling included")
    case, goal = published(), udk.PathGoal("P", published()["points"])
    found = udk.design_all(drawing(), goal)
    begin = time.process_time()
    found = udk.design_all(drawing(), goal)
    print(f"    again {time.process_time() - begin:.2f} s CPU; paths {found.paths}, published {case['classes']} classes")
    print(f"    real classes proven {found.classes}, published {case['real_classes']}; without a proof {found.unproven}")
    print(
        f"    four-bars {len(found)}, published {case['real_solutions_with_cognates_and_swaps']}; to {found.radius.max():.1e} m"
    )
    print(
        f"    confirmed by motion {found.confirmed.mean():.2%} of positions; without defect {found.defects.count('none')}",
        flush=True,
    )
    rng = np.random.default_rng(0)
    for count, what in ((9, "nine points"), (5, "five poses")):
        times, hits, whole, classes = [], 0, 0, []
        for _ in range(sets):
            joints, poses = known_four_bar(rng, count)
            begin = time.process_time()
            goal = udk.PathGoal("P", poses[:, :2]) if count == 9 else udk.PoseGoal("coupler", poses, pin="P")
            found = udk.design_all(drawing(), goal)
            times.append(time.process_time() - begin)
            pins = np.array([found.pins[f"pin.{name}"] @ [1, 1j] for name in "OCAB"])
            hits += bool((np.abs(pins - joints[:, None]).max(axis=0) < FOUND_TOL * abs(joints[1])).any())
            whole += count == 5 or found.paths["regular"] == found.paths["tracked"]
            classes.append(found.classes)
        print(f"{what} of {sets} known four-bars: {hits} found, {whole} with all solutions; {np.median(times):.2f} s CPU each")
        print(f"    real ones {min(classes)} to {max(classes)}", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
