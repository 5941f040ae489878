"""A body that many joints meet, without the clique that it makes of them.

All joints of one body are coupled in S = D D^T: k of them fill a dense block, and eliminating it takes of the order of k^3
operations. Cut the body into p copies instead, each with the mass M / p and a few of the joints, and weld the copies to each
other in a row. The mechanism is the same, and now every copy couples only its own joints and two welds: the work is of the
order of k (matrix stretching: J. F. Grcar, Sandia report SAND90-8723 (1990); of a dense column: R. J. Vanderbei, Linear
Algebra Appl. 152, 105 (1991)). In terms of D, with columns scaled by M^(-1/2):

    a joint's block at a copy is sqrt(p) times its block at the body;   a weld's rows are [I, -I] at its two copies.

Where S is nonsingular so is the stretched S~, and S~^-1, restricted to the joints, is S^-1: solve with zeros for the welds. The
diagonal of S~ is up to p times that of S, so a pivot, compared with it, looks up to p times smaller.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from udkjax.pinv.dissection import components

# A body of more joints is cut. k revolute joints fill a front of 2k rows, some (2k)^3 / 3 multiply-adds; k/2 copies with their
# welds take about 250 k, on a few levels more. One factorization and solution, on one core: 16 joints 26 us whole, 5 us cut; 100
# joints 7,400 and 15 us.
MANY = 8
# Joints to a copy, beside its two welds. More widen the fronts, fewer lengthen the row of welds.
SHARED = 2


class Stretched(NamedTuple):
    """Blocks of rows on copies of the blocks of columns that many of them meet."""

    meets: list[tuple[int, ...]]  # of every block of rows, the copies in place of its blocks of columns; the welds come last
    welds: int
    original: np.ndarray  # (copies,): of every copy, its block of columns
    scale: np.ndarray  # (copies,): what D is multiplied with there, the square root of the number of copies


def stretch(meets: Sequence[Sequence[int]], many: float = MANY) -> Stretched:
    """Cut into copies every block of columns that more than `many` blocks of rows meet.

    `meets` are, of every block of rows, the blocks of columns in which it has entries, each once.
    """
    on: dict[int, list[int]] = {}
    for i, columns in enumerate(meets):
        for k in columns:
            on.setdefault(k, []).append(i)
    place = _along(meets, on, many)
    original, copies, welds = [], {}, []
    at: dict[tuple[int, int], int] = {}
    for k in range(1 + max(on, default=-1)):
        rows = sorted(on.get(k, ()), key=lambda i: place[i])
        shares = [rows[s : s + SHARED] for s in range(0, len(rows), SHARED)] if len(rows) > many else [rows]
        first = len(original)
        copies[k] = len(shares)
        original += [k] * len(shares)
        at.update({(i, k): first + c for c, share in enumerate(shares) for i in share})
        welds += pairwise(range(first, len(original)))
    stretched = [tuple(at[i, k] for k in columns) for i, columns in enumerate(meets)]
    return Stretched(stretched + welds, len(welds), np.array(original, int), np.sqrt([copies[k] for k in original]))


def _along(meets: Sequence[Sequence[int]], on: dict[int, list[int]], many: float) -> list[int]:
    """Return places of the blocks of rows in an order in which those that are near without the many-jointed bodies are near.

    Two such bodies, the rails of a ladder, then share out their joints alike, and fronts stay narrow.
    """
    near = [[j for k in columns if len(on[k]) <= many for j in on[k] if j != i] for i, columns in enumerate(meets)]
    place = [0] * len(meets)
    for n, i in enumerate(i for part in components(near, range(len(meets))) for i in part):
        place[i] = n
    return place
