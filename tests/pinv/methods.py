"""The list of methods: a new method is one line, and is used in every test."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import pytest

from udkjax.pinv import SVD, Auto, Elimination, GramSchmidt, Greville, Householder, OneOf, Pseudoinverse, Varga


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
    Entry("OneOf", partial(OneOf, number=3)),
]


def entries(*chosen: str) -> list:
    """All entries as parameters. Those not chosen are marked as slow."""
    return [pytest.param(e, id=e.name, marks=[] if e.name in chosen else pytest.mark.slow) for e in METHODS]
