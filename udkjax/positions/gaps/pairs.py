"""Pairs of links that can hit each other: those of one layer that no joint or pin connects."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import join_names, quote, suggestion

LinkPair = tuple[str, str]
# Relative to the largest coordinate of a pin: two revolutes of a body nearer than this are at one place, up to rounding.
SAME_PIN_TOL = 1e-9


def joined_pairs(mechanism: Mechanism) -> dict[LinkPair, str]:
    """Return the name of a joint by each pair of links that share this joint or a pin, in both orders; numbers are concrete.

    Two revolutes at the same place of a third link, or of the ground, are one pin of all their links.
    """
    found: dict[LinkPair, str] = {}
    for name, joint in mechanism.joints.items():
        if getattr(joint, "points", None) is not None:
            for one, other in combinations(joint.bodies, 2):
                found[one, other] = found[other, one] = name
    pins: dict[str, list[tuple[np.ndarray, str, str]]] = {}  # of each body: place, other body and name of a revolute
    for name, joint in mechanism.joints.items():
        if isinstance(joint, Revolute):
            for k, body in enumerate(joint.bodies):
                pins.setdefault(body, []).append((np.asarray(joint.points)[k], joint.bodies[1 - k], name))
    size = max((float(np.abs(place).max()) for at in pins.values() for place, _, _ in at), default=0.0)
    for at in pins.values():
        for (place, one, name), (there, other, _) in combinations(at, 2):
            if one != other and np.hypot(*(place - there)) <= SAME_PIN_TOL * size:
                found.setdefault((one, other), name)
                found.setdefault((other, one), name)
    return found


def pairs_to_check(
    mechanism: Mechanism,
    layers: Mapping[str, Any] | None,
    pairs: Sequence[Sequence[str]] | None,
    shapes: Mapping[str, Any] | None,
) -> list[LinkPair]:
    """Return the pairs of links that the arguments `layers`, `pairs` and `shapes` of `gaps` select.

    Raises a `SceneError` that names unknown links, and links of one layer that share a joint.
    """
    names = [*mechanism.body_names, *([GROUND] if GROUND in (shapes or {}) else [])]
    if pairs is not None:
        _require(mechanism, _mistakes_in_pairs(mechanism, pairs, layers, shapes))
        return [(one, other) for one, other in pairs]
    joined = joined_pairs(mechanism)
    if layers is None:
        found = [pair for pair in combinations(names, 2) if pair not in joined]
        cure = "each two of its links share a joint; name pairs, pairs=[(one, other)]"
    else:
        unknown = [f"layers: no link named {quote(n)}{suggestion(n, names)}" for n in layers if n not in names]
        missing = [name for name in names if name not in layers]
        if missing:
            unknown.append(f"layers: no layer for {join_names(missing)}; give one to each link")
        _require(mechanism, unknown)
        found = [pair for pair in combinations(names, 2) if layers[pair[0]] == layers[pair[1]]]
        _require(
            mechanism,
            [
                f"layers: {quote(a)} and {quote(b)} share {quote(joined[a, b])} and are both in layer {layers[a]!r}: "
                "give them different layers; udk.layers finds the fewest"
                for a, b in found
                if (a, b) in joined
            ],
        )
        cure = "no two links are in one layer"
    _require(mechanism, [] if found else [f"there are no pairs of links that could hit each other: {cure}"])
    return found


def _mistakes_in_pairs(
    mechanism: Mechanism, pairs: Sequence[Sequence[str]], layers: object, shapes: Mapping[str, Any] | None
) -> list[str]:
    names, found = (*mechanism.body_names, GROUND), []
    if layers is not None:
        found.append("pairs and layers are both given: leave out one of them")
    if not len(pairs):
        found.append("pairs is empty: name at least one pair, pairs=[(one, other)]")
    for pair in pairs:
        if pair[0] == pair[1]:
            found.append(f"pairs: {pair!r} is one link twice; name two")
            continue
        found += [f"pairs: no link named {quote(n)}{suggestion(n, names)}" for n in pair if n not in names]
        if GROUND in pair and GROUND not in (shapes or {}):
            found.append('pairs: the ground has no outline; give its corners, shapes={"ground": [[x, y], ...]}')
    return found


def _require(mechanism: Mechanism, problems: list[str]) -> None:
    if problems:
        raise SceneError(list(dict.fromkeys(problems)), mechanism.name)
