"""The register of methods, where a new one is one line and meets every test; and matrices with exactly known pseudoinverses."""

import json
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from udkjax.pinv import SVD, Auto, Elimination, GramSchmidt, Greville, Householder, Pseudoinverse, Varga


class Entry(NamedTuple):
    name: str
    make: Callable[..., Pseudoinverse]
    power: int = 1  # the error is of the order of eps cond^power
    own_threshold: bool = False  # decides the rank as well as it can by its default only


METHODS = [
    Entry("SVD", SVD),
    Entry("Varga", Varga),
    Entry("Householder", Householder),
    Entry("GramSchmidt", GramSchmidt),
    Entry("GramSchmidt once", partial(GramSchmidt, twice=False), power=2),
    Entry("Greville", Greville, power=2, own_threshold=True),
    Entry("Elimination", Elimination, power=2, own_threshold=True),
    Entry("Auto", Auto),
]


class Exact(NamedTuple):
    name: str
    a: np.ndarray
    plus: np.ndarray
    rank: int
    cond: float  # over the nonzero singular values


def _read() -> list[Exact]:
    def floats(rows):
        return np.array([[float(Fraction(x)) for x in row] for row in rows])

    path = Path(__file__).parents[1] / "data" / "pinv_test_matrices.json"
    entries = json.loads(path.read_text()).items()
    return [Exact(k, floats(e["A"]), floats(e["pinv"]), e["rank"], float(e["cond_eff"])) for k, e in entries]


@pytest.fixture(scope="session")
def exact() -> list[Exact]:
    return _read()


@pytest.fixture(scope="session", params=METHODS, ids=lambda entry: entry.name)
def entry(request) -> Entry:
    return request.param
