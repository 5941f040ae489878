"""Expressions with fixed sides are smooth, and equal to the original ones as long as the sides are right."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.expressions import Graph, ScalarProgram, smooth_pieces, trace

FUNCTIONS = {
    "where": lambda x: jnp.where(x > 0.2, x * x, -x),
    "maximum": lambda x: jnp.maximum(x, 0.3) - jnp.minimum(x * x, 0.5),
    "absolute": lambda x: jnp.abs(x - 0.1) + jnp.sign(x),
    "clamp": lambda x: jnp.clip(x, -0.4, 0.7),
    "floor": lambda x: jnp.floor(3 * x) + jnp.ceil(2 * x) + jnp.round(x),
    "remainder": lambda x: x % 0.3 + jax.lax.rem(x, 0.7),
    "part of a period": lambda x: (x - 2.0) % 0.3 + (x - 2.0) // 0.7 + (x - 1.0) % -0.4,
    "truncated": lambda x: jnp.int32(4 * x) * x,
    "wrapped": lambda x: jnp.where((5 * x + jnp.pi) % (2 * jnp.pi) > 2.0, x, 0.0),
    "angle": lambda x: jnp.arctan2(jnp.sin(5 * x), jnp.cos(5 * x)),
    "sorted": lambda x: jnp.sort(jnp.stack([x, 0.1 * jnp.ones(()), x * x]))[1],
    "branch": lambda x: jax.lax.cond(x > 0.2, jnp.sin, jnp.cos, x),
}


def pieces_of(function):
    graph = Graph()
    x = graph.input("x", "q")
    (output,) = trace(function, 0.5)(graph, np.asarray(x, object))
    pieces = smooth_pieces(graph, [output.item()], ["q"])
    program = ScalarProgram(graph, [x, *pieces.sides], [*pieces.outputs, *pieces.renewed, *(w.condition for w in pieces.ways)])
    count = len(pieces.sides)

    def evaluate(x, sides):
        value, *rest = program([float(x), *map(float, sides)])
        return float(value), np.array(rest[:count], float), np.array(rest[count:], float)

    return pieces, evaluate


@pytest.mark.parametrize("name", FUNCTIONS)
def test_held_expressions_are_the_given_ones_until_a_condition_falls(name):
    function, (pieces, evaluate) = FUNCTIONS[name], pieces_of(FUNCTIONS[name])
    free = np.full(len(pieces.sides), np.inf)
    assert len(pieces.sides) > 0 and not pieces.has_opaque
    for x in np.linspace(-1.3, 1.4, 41) + 1e-3:
        value, sides, _ = evaluate(x, free)
        held, again, conditions = evaluate(x, sides)
        assert [value, held] == pytest.approx([float(function(x))] * 2, abs=1e-14)
        np.testing.assert_array_equal(sides, again)
        assert conditions.min() > 0.0
        # Beyond the next kink the piece goes on smoothly, and a condition has fallen.
        ahead = [evaluate(x + h, sides) for h in (0.0, 1e-3, 2e-3, 3e-3)]
        jump = np.abs(np.diff([a[0] for a in ahead], 3)).max()
        assert jump < 1e-6
        renewed = evaluate(x + 3e-3, free)[1]
        assert (renewed == sides).all() or ahead[-1][2].min() < 0.0


@pytest.mark.parametrize("function", [lambda x: jnp.where(x * x + jnp.abs(x) > 0, x, 0.0), lambda x: jnp.where(2.0 > 1.0, x, -x)])
def test_what_cannot_change_its_side_is_no_kink(function):
    assert len(pieces_of(function)[0].sides) <= 1  # that of |x| itself


def test_powers_and_roots_go_on_beyond_the_crossing():
    _, evaluate = pieces_of(lambda x: jnp.maximum(x - 0.2, 0.0) ** 1.5 + jnp.sqrt(jnp.maximum(x - 0.2, 0.0)))
    sides = evaluate(0.5, [np.inf])[1]
    assert evaluate(0.2 - 0.04, sides)[0] == pytest.approx(-(0.04**1.5) - 0.2, rel=1e-12)
