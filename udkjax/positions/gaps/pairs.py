"""Pairs of links that can hit each other: those of one layer that no joint connects."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import join_names, quote, suggestion

LinkPair = tuple[str, str]


def joined_pairs(mechanism: Mechanism) -> dict[LinkPair, str]:
    """Return the pairs of links that share a joint, each with the joint's name."""
    found: dict[LinkPair, str] = {}
    for name, joint in mechanism.joints.items():
        if getattr(joint, "points", None) is not None:
            for one, other in combinations(joint.bodies, 2):
                found[one, other] = found[other, one] = name
    return found


def pairs_to_check(
    mechanism: Mechanism,
    layers: Mapping[str, Any] | None,
    pairs: Sequence[Sequence[str]] | None,
    shapes: Mapping[str, Any] | None,
) -> list[LinkPair]:
    """Return the pairs of links whose gaps are asked for; raise a `SceneError` that names unknown links and layers that clash."""
    names = [*mechanism.body_names, *([GROUND] if GROUND in (shapes or {}) else [])]
    joined = joined_pairs(mechanism)
    if pairs is not None:
        _require(mechanism, _mistakes_in_pairs(mechanism, pairs, layers, shapes))
        return [(one, other) for one, other in pairs]
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
