"""Matrices with exactly known pseudoinverses."""

import json
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Exact(NamedTuple):
    name: str
    a: np.ndarray
    plus: np.ndarray
    rank: int
    cond: float  # over the nonzero singular values


def read_exact() -> list[Exact]:
    def floats(rows):
        return np.array([[float(Fraction(x)) for x in row] for row in rows])

    path = Path(__file__).parents[1] / "data" / "pinv_test_matrices.json"
    entries = json.loads(path.read_text()).items()
    return [Exact(k, floats(e["A"]), floats(e["pinv"]), e["rank"], float(e["cond_eff"])) for k, e in entries]
