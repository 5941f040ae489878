"""Compute a chunk of a plan."""

import numpy as np

from udkjax.study.sweep.plan import Chunk, Plan


def run(plan: Plan, chunk: Chunk) -> dict[str, np.ndarray]:
    """Compute the members of a chunk: each kept variable (members, ...), with "result". A failing member has a code, and NaN."""
    raise NotImplementedError
