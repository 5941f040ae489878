"""The four-bar of `mechanisms` in pylinkage's compiled solver, a separate program: prints its time and the position of the pin.

    python benchmarks/pylinkage_positions.py CRANK COUPLER ROCKER GROUND START STEPS

It is separate because pylinkage's compiler (numba) may need another version of llvmlite than udkjax. The linkage turns once.
"""

import json
import math
import sys
import time

import numpy as np
from pylinkage.solver import simulate  # pyright: ignore[reportMissingImports]
from pylinkage.solver.types import JOINT_CRANK, JOINT_REVOLUTE, JOINT_STATIC  # pyright: ignore[reportMissingImports]

crank, coupler, rocker, ground, start, steps = map(float, sys.argv[1:])
count = int(steps)
end = np.array([crank * math.cos(start), crank * math.sin(start)])
to = np.array([ground, 0.0]) - end
square = to @ to
x = (square + coupler**2 - rocker**2) / (2 * square)
pin = end + x * to + math.sqrt(coupler**2 / square - x**2) * np.array([-to[1], to[0]])
positions = np.array([[0.0, 0.0], [ground, 0.0], end, pin])
arguments = (
    np.array([crank, 2 * math.pi / count, coupler, rocker]),
    np.array([JOINT_STATIC, JOINT_STATIC, JOINT_CRANK, JOINT_REVOLUTE], np.int32),
    np.array([[-1, -1, -1], [-1, -1, -1], [0, -1, -1], [2, 1, -1]], np.int32),
    np.array([0, 0, 0, 2], np.int32),
    np.array([2, 3], np.int32),
)


def turn() -> np.ndarray:
    """Return the position of the pin (steps, 2) after each step."""
    return simulate(positions.copy(), *arguments, count, 1.0)[:, 3]


path, times = turn(), []
for _ in range(5):
    repeats, begin = 0, time.process_time()
    while time.process_time() - begin < 0.2:
        turn()
        repeats += 1
    times.append((time.process_time() - begin) / (repeats * count))
print(json.dumps({"seconds": float(np.median(times)), "pin": path.tolist()}))
