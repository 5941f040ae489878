"""Places where an expression jumps or has a kink, and the smooth expressions between them.

Comparisons, |x|, signs, maxima, rounding and remainders are smooth except where an argument g crosses zero or a whole number.
Each such g has a *side*, a number: 1 or -1, the sign of g; or the whole number below it. With its sides held, an expression is
smooth, and continues smoothly beyond the crossing. A side that is not finite leaves the operation as it was.
The side of the remainder of x by y is the whole number below x / y, from which the sign of the remainder on its piece follows.
The remainder is zero at the ends of the piece. Since `jnp.mod` and `//` compare it with zero, the result of this comparison is
held, too: at these ends they would otherwise take another branch.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jax import lax

from udkjax.expressions.scalars.graph import Graph, Node, Scalar
from udkjax.expressions.scalars.selection import absolute, apply, both, floor, where

SIDE = "side"  # the group of the sides among the inputs of a graph
ZERO_TOL = 1e-12  # relative to its terms, g is zero below this
_OPAQUE_PRIMITIVES = ("while", "cond", "scan")
_GREATER, _LESS = ("gt", "ge"), ("lt", "le")
_ONE_SIGNED = (*_GREATER, *_LESS, "max", "min", "abs", "sign")  # without a kink if the sign of their difference is known


_KINKED = (*_ONE_SIGNED, *_OPAQUE_PRIMITIVES, "clamp", "atan2", "floor", "ceil", "round", "rem")


class Leaving(NamedTuple):
    """A way to leave a smooth piece: `condition` falls through zero, and a side becomes `factor` times itself plus `shift`.

    `side` is the index of that side.
    """

    condition: Scalar
    side: int
    factor: float
    shift: float


class Pieces(NamedTuple):
    """Smooth expressions: copies of others in which each comparison is held on one side (-1, 1; or an integer part)."""

    outputs: list[Scalar]
    sides: list[Scalar]  # inputs of the copies, the held side of each comparison
    ways: list[Leaving]  # conditions under which a comparison changes its side
    renewed: list[Scalar]  # the sides at a state, for comparisons whose sides are unknown or depend on others
    has_opaque: bool  # True if an opaque loop or branch, whose kinks are unknown, depends on inputs of the groups `moving`


def smooth_pieces(graph: Graph, outputs: Sequence[Scalar], moving: Collection[str]) -> Pieces:
    """Return copies of expressions in which the sides of comparisons that depend on inputs of the groups `moving` are held."""
    held = _Held(graph, moving)
    smooth = held.hold(outputs)
    renewal = _Renewed(graph, moving)
    renewal.hold(outputs)
    nodes = [graph.nodes[i] for i in graph.dependencies([s.index for s in outputs])]
    opaque = any(n.kind == "call" and n.detail.primitive.name in _OPAQUE_PRIMITIVES and n.depends & set(moving) for n in nodes)
    return Pieces(smooth, held.sides, held.ways, renewal.new_sides, opaque)


def may_have_kinks(graph: Graph, outputs: Sequence[Scalar]) -> bool:
    """Return True if expressions contain operations that may have jumps or kinks, as functions of any input."""
    nodes = (graph.nodes[i] for i in graph.dependencies([s.index for s in outputs]))
    return any(n.kind in ("apply", "call") and n.detail.primitive.name in _KINKED for n in nodes)


def has_kinks(graph: Graph, outputs: Sequence[Scalar], moving: Collection[str]) -> bool:
    """Return True if expressions have jumps or kinks as functions of inputs of the groups `moving`, or may have some."""
    pieces = smooth_pieces(graph, outputs, moving)
    return pieces.has_opaque or len(pieces.sides) > 0


class _Held:
    """Copies of expressions with held sides, which `hold` makes; the sides are new inputs of the graph."""

    def __init__(self, graph: Graph, moving: Collection[str]):
        self.graph, self.moving = graph, frozenset(moving)
        self.sides: list[Scalar] = []
        self.ways: list[Leaving] = []
        self.is_nested: list[bool] = []
        self._known: dict[tuple[str, int], tuple[Scalar, int]] = {}  # the side of each g, and the sign with which it was added
        self._remainders: dict[
            int, tuple[Scalar, Scalar]
        ] = {}  # by the index of the copy of x mod y: the integer part of x / y, and y

    def hold(self, outputs: Sequence[Scalar]) -> list[Scalar]:
        graph, copies = self.graph, {}

        def copied(a: Scalar) -> Scalar:
            return copies[a.index] if a.sign > 0 else -copies[a.index]

        for index in graph.dependencies([s.index for s in outputs]):
            node = graph.nodes[index]
            arguments = [copied(a) for a in node.arguments]
            held = self._operation(node, arguments) if node.kind == "apply" and node.depends & self.moving else None
            unchanged = all(a == b for a, b in zip(arguments, node.arguments, strict=True))
            same = Scalar(graph, index) if unchanged else self._again(node, arguments)
            copies[index] = same if held is None else held
        return [copied(s) for s in outputs]

    def _again(self, node: Node, a: Sequence[Scalar]) -> Scalar:
        """Return a node with held arguments: powers and roots of negative numbers continue as odd functions beyond a crossing."""
        graph = self.graph
        if node.kind != "sqrt" and not (node.kind == "apply" and node.detail.primitive.name == "pow"):
            return graph.again(node, a)
        size = graph.again(node, [absolute(a[0]), *a[1:]])
        return where(_compare(lax.lt_p, a[0], 0.0), -size, size)

    def _operation(self, node: Node, a: Sequence[Scalar]) -> Scalar | None:
        """Return the operation of a node on copied arguments `a`, with its side held; None if it has no side."""
        name, dtype = node.detail.primitive.name, a[0].node.dtype
        if not np.issubdtype(dtype, np.floating):
            return None
        if name in _ONE_SIGNED and _keeps_sign(*node.arguments):
            return None
        plain = self.graph.again(node, a)
        match name:
            case _ if name in (*_GREATER, *_LESS):
                side = self._sign(a[0], a[1])
                return side and self._either(side, plain, _compare(lax.gt_p if name in _GREATER else lax.lt_p, side, 0.0))
            case "abs" | "sign":
                side = self._sign(a[0], None)
                return side and self._either(side, plain, side * a[0] if name == "abs" else side)
            case "max" | "min":
                return self._extreme(name, plain, *a)
            case "clamp":
                inner = self._extreme("max", apply(lax.max_p, dtype, a[1], a[0]), a[1], a[0])
                inner = apply(lax.max_p, dtype, a[1], a[0]) if inner is None else inner
                outer = apply(lax.min_p, dtype, inner, a[2])
                held = self._extreme("min", outer, inner, a[2])
                return outer if held is None else held
            case "atan2":  # beyond its cut, which is where y = 0 and x < 0, by the angle of the opposite direction
                y, x = a
                side = self._sign(y, None)
                if side is None:
                    return None
                opposite = side * np.pi + self.graph.again(node, [-y, -x])
                return self._either(side, plain, where(_compare(lax.gt_p, x, 0.0), plain, opposite))
            case "floor" | "ceil":
                u = a[0] if name == "floor" else -a[0]
                n = self._whole(u)
                return n and self._either(n, plain, n if name == "floor" else -n)
            case "round":
                n = self._whole(a[0] + 0.5)
                return n and self._either(n, plain, n)
            case "rem":
                n = self._whole(a[0] / a[1])
                held = n and self._either(n, plain, a[0] - a[1] * _towards_zero(n))
                if n is not None and held is not None:
                    self._remainders[held.index] = n, a[1]
                return held
            case "ne" | "eq" if a[1].is_zero and a[0].index in self._remainders:
                return self._either(self._remainders[a[0].index][0], plain, self.graph.constant(name == "ne", bool))
            case "convert_element_type" if np.issubdtype(node.dtype, np.integer):
                n = self._whole(a[0])
                return n and self._either(n, plain, self.graph.again(node, [_towards_zero(n)]))
        return None

    def _extreme(self, name: str, plain: Scalar, a: Scalar, b: Scalar) -> Scalar | None:
        side = self._sign(a, b)
        return side and self._either(side, plain, where(_compare(lax.gt_p if name == "max" else lax.lt_p, side, 0.0), a, b))

    def _sign(self, a: Scalar, b: Scalar | None) -> Scalar | None:
        """Return the side of a - b, or of a; None if it depends on no input in the groups `moving`."""
        g = a if b is None else a - b
        if not g.node.depends & self.moving:
            return None
        if g.index in self._remainders:
            return self._sign_of_remainder(g.sign, *self._remainders[g.index])
        key = SIDE, g.index
        if key not in self._known:
            size = absolute(a) if b is None else absolute(a) + absolute(b)
            actual = where(_compare(lax.gt_p, g, 0.0), self.graph.constant(1.0), self.graph.constant(-1.0))
            side = self._new_side(g, actual, _compare(lax.le_p, absolute(g) - size * ZERO_TOL, 0.0))
            self._known[key] = side, g.sign
            self._leave(side, side * g, -1.0, 0.0)
        side, sign = self._known[key]
        return side if sign == g.sign else -side

    def _sign_of_remainder(self, sign: int, n: Scalar, y: Scalar) -> Scalar:
        of_y = self._sign(y, None)
        of_y = apply(lax.sign_p, y.node.dtype, y) if of_y is None else of_y
        side = where(_compare(lax.ge_p, n, 0.0), of_y, -of_y)
        return where(apply(lax.is_finite_p, bool, n), side if sign > 0 else -side, n)

    def _whole(self, u: Scalar) -> Scalar | None:
        """Return the side of u, the largest integer that is at most u; None if u depends on no input in the groups `moving`."""
        if not u.node.depends & self.moving:
            return None
        key = f"whole {u.sign}", u.index
        if key not in self._known:
            distance = absolute(u - floor(u + 0.5))
            side = self._new_side(u, floor(u), _compare(lax.le_p, distance - (absolute(u) + 1.0) * ZERO_TOL, 0.0))
            self._known[key] = side, 1
            self._leave(side, u - side, 1.0, -1.0)
            self._leave(side, side + 1.0 - u, 1.0, 1.0)
        return self._known[key][0]

    def _leave(self, side: Scalar, condition: Scalar, factor: float, shift: float) -> None:
        """Add a way to leave a piece by the newest side, when `condition` falls through zero; never if the side is not held."""
        held = self._either(side, self.graph.constant(1.0), condition)
        self.ways.append(Leaving(held, len(self.sides) - 1, factor, shift))

    def _new_side(self, g: Scalar, actual: Scalar, is_near: Scalar) -> Scalar:
        """Return a new input for the side of g.

        A subclass may also use `actual`, the side at the state, and `is_near`: the condition that g is near a change of its side.
        """
        side = self.graph.input(len(self.sides), SIDE)
        self.is_nested.append(SIDE in g.node.depends)
        self.sides.append(side)
        return side

    def _either(self, side: Scalar, plain: Scalar, held: Scalar) -> Scalar:
        return where(apply(lax.is_finite_p, bool, side), held, plain)


class _Renewed(_Held):
    """Copies of expressions whose sides follow from the state; `new_sides` are these sides."""

    def __init__(self, graph: Graph, moving: Collection[str]):
        super().__init__(graph, moving)
        self.new_sides: list[Scalar] = []

    def _new_side(self, g: Scalar, actual: Scalar, is_near: Scalar) -> Scalar:
        """Return the side of g at the state; a known side stays if g depends on no other side, or is near a change."""
        given = super()._new_side(g, actual, is_near)
        is_known = apply(lax.is_finite_p, bool, given)
        stays = both(is_known, is_near) if self.is_nested[-1] else is_known
        self.new_sides.append(where(stays, given, actual))
        return self.new_sides[-1]


def _compare(primitive, a: Scalar, b: float) -> Scalar:
    return apply(primitive, bool, a, a.graph.constant(b))


def _towards_zero(n: Scalar) -> Scalar:
    """Return the one of n and n + 1 that is nearer to zero, where n is the held integer part of a number."""
    return where(_compare(lax.lt_p, n, 0.0), n + 1.0, n)


def _keeps_sign(a: Scalar, b: Scalar | None = None) -> bool:
    g = a if b is None else a - b
    return is_never_negative(g) or is_never_negative(-g)


def is_never_negative(s: Scalar) -> bool:
    """Return True if the form of an expression shows that it is never negative, as of a square; False may mean unknown."""
    node = s.node
    if node.kind == "constant":
        return s.constant >= 0
    if s.sign < 0:
        return False
    if node.kind == "mul" and node.arguments[0] == node.arguments[1]:
        return True
    if node.kind in ("add", "mul", "div"):
        return all(map(is_never_negative, node.arguments))
    return node.kind == "sqrt" or (
        node.kind == "apply" and node.detail.primitive.name in ("abs", "exp", "square", "cosh", "logistic")
    )
