"""Block structures to eliminate, and symmetric positive definite matrices that have them."""

from itertools import combinations

import numpy as np


def four_bars(loops):
    """Return the joints of an N-four-bar: N + 1 cranks on the ground, N couplers, by the bodies that each joint meets."""
    cranks = loops + 1
    joints = [(i,) for i in range(cranks)]
    for k in range(loops):
        joints += [(k, cranks + k), (k + 1, cranks + k)]
    return joints


def touching(joints):
    """Return the sizes and pairs of the blocks of revolute joints."""
    on = {}
    for j, bodies in enumerate(joints):
        for body in bodies:
            on.setdefault(body, []).append(j)
    pairs = {pair for group in on.values() for pair in combinations(group, 2)}
    return [2] * len(joints), sorted(pairs)


def chain(n):
    return [2] * n, [(i, i + 1) for i in range(n - 1)]


def grid(n):
    across = [(n * i + j, n * i + j + 1) for i in range(n) for j in range(n - 1)]
    return [1] * n**2, across + [(n * i + j, n * i + j + n) for i in range(n - 1) for j in range(n)]


def tree(n, seed=0):
    random = np.random.default_rng(seed)
    return [1 + i % 3 for i in range(n)], [(int(random.integers(i)), i) for i in range(1, n)]


def star(n):
    return [2] * n, [(i, n // 2) for i in range(n) if i != n // 2]


def clique(n):
    return [2] * n, list(combinations(range(n), 2))


def parts(*structures):
    """Structures side by side."""
    sizes, pairs = [], []
    for more_sizes, more in structures:
        pairs += [(len(sizes) + i, len(sizes) + j) for i, j in more]
        sizes += more_sizes
    return sizes, pairs


def matrix(sizes, pairs, seed=0):
    """Return diagonal and coupling blocks of D D^T, with three columns to each block and to each pair; NaN where padded."""
    random = np.random.default_rng(seed)
    width = max(sizes, default=0)
    own = [random.normal(size=(n, 3)) for n in sizes]
    diagonal = np.full((len(sizes), width, width), np.nan)
    coupling = np.full((len(pairs), width, width), np.nan)
    for i, n in enumerate(sizes):
        diagonal[i, :n, :n] = own[i] @ own[i].T
    for k, (i, j) in enumerate(pairs):
        m, n = sizes[i], sizes[j]
        one, other = random.normal(size=(m, 3)), random.normal(size=(n, 3))
        diagonal[i, :m, :m] += one @ one.T
        diagonal[j, :n, :n] += other @ other.T
        coupling[k, :m, :n] = one @ other.T
    return diagonal, coupling


def dense(sizes, pairs, diagonal, coupling):
    """Return the matrix, and the places of its rows in (blocks, width), flattened."""
    first, width = np.cumsum([0, *sizes]), max(sizes, default=0)
    S = np.zeros((first[-1], first[-1]))
    for i, n in enumerate(sizes):
        S[first[i] : first[i + 1], first[i] : first[i + 1]] = diagonal[i, :n, :n]
    for k, (i, j) in enumerate(pairs):
        block = coupling[k, : sizes[i], : sizes[j]]
        S[first[i] : first[i + 1], first[j] : first[j + 1]] = block
        S[first[j] : first[j + 1], first[i] : first[i + 1]] = block.T
    places = [i * width + r for i, n in enumerate(sizes) for r in range(n)]
    return S, np.array(places, int)
