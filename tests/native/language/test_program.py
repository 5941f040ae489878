"""Programs as machine code compute the same as JAX, also for non-finite numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from numpy.testing import assert_allclose, assert_array_equal

from tests.calls import calls_of
from udkjax.expressions import Graph, ScalarProgram, cotangents, tangents, trace
from udkjax.expressions.scalars import scalar_program
from udkjax.native.language.ir import Function
from udkjax.native.language.program import UnsupportedError, Writer, write

SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 2.0, 1e-9, -1e-9, 1e-300, 700.0, -700.0, 1e200, np.inf, -np.inf, np.nan])
RNG = np.random.default_rng(0)
ORDINARY = np.concatenate([RNG.uniform(-4.0, 4.0, 60), 10.0 ** RNG.uniform(-12, 2, 30), -(10.0 ** RNG.uniform(-12, 2, 30))])


def _whole(k):
    return -k + 2 * jnp.abs(k) - 3 * jnp.sign(k) * jnp.clip(k, -2, 5) - jnp.maximum(k, 3)


ONE = {
    "abs": jnp.abs,
    "neg": lambda x: -x,
    "sqrt": jnp.sqrt,
    "rsqrt": lax.rsqrt,
    "square": lax.square,
    "exp": jnp.exp,
    "exp2": lax.exp2,
    "log": jnp.log,
    "log1p": jnp.log1p,
    "expm1": jnp.expm1,
    "logistic": jax.nn.sigmoid,
    "tanh": jnp.tanh,
    "tan": jnp.tan,
    "sinh": jnp.sinh,
    "cosh": jnp.cosh,
    "asin": jnp.arcsin,
    "acos": jnp.arccos,
    "atan": jnp.arctan,
    "floor": jnp.floor,
    "ceil": jnp.ceil,
    "sign": jnp.sign,
    "cube": lambda x: x**3,
    "seventh": lambda x: x**7,
    "inverse": lambda x: x**-1,
    "inverse square": lambda x: x**-2,
    "clamp": lambda x: lax.clamp(-0.5, x, 0.7),
    "is_finite": jnp.isfinite,
    "select": lambda x: jnp.where(x > 0.0, x, -2.0 * x),
    "of conditions": lambda x: (x > 0.0) & ~(x > 1.0) | (x == -1.0) ^ (x != x),
    "condition as number": lambda x: jnp.where(x > 0, 1, 0) + 2.0 * (x > 1.0),
    "relu": jax.nn.relu,
    "asinh": jnp.arcsinh,
    "acosh": jnp.arccosh,
    "atanh": jnp.arctanh,
    "cbrt": jnp.cbrt,
    "erf": jax.scipy.special.erf,
    "erfc": jax.scipy.special.erfc,
    "log2": jnp.log2,
    "round": jnp.round,
    "turns": lambda x: jnp.clip(x, -50.0, 50.0) % 0.7,
    "floored": lambda x: jnp.clip(x, -50.0, 50.0) // 0.7,
    "saw": lambda x: (jnp.clip(x, -50.0, 50.0) + jnp.pi) % (2 * jnp.pi) - jnp.pi,
    "branch": lambda x: lax.cond(x > 0.3, jnp.exp, lambda x: x * x, jnp.clip(x, -2.0, 2.0)),
    "switch": lambda x: lax.switch(jnp.int32(x), [lambda x: x, lambda x: -x, lambda x: x * x], jnp.clip(x, -2.0, 2.0)),
    "sorted": lambda x: jnp.sort(jnp.stack([x, 0.5 * jnp.ones(()), -2.0 * x]))[1],
    "table": lambda x: jnp.interp(x, jnp.array([-1.0, 0.0, 0.7]), jnp.array([2.0, -1.0, 5.0])),
    "whole": lambda x: _whole(jnp.int32(jnp.clip(2.0 * x, -50.0, 50.0))) * x,
    "truncated": lambda x: 0.5 * (jnp.int32(jnp.clip(x, -50.0, 50.0)) + 1) * x,
    "greatest": lambda x: jnp.max(jnp.stack([x, 0.1 * jnp.ones(()), x * x])),
    "softplus": jax.nn.softplus,
}
TWO = {
    "add": jnp.add,
    "sub": jnp.subtract,
    "mul": jnp.multiply,
    "div": jnp.divide,
    "max": jnp.maximum,
    "min": jnp.minimum,
    "rem": lambda x, y: lax.rem(jnp.clip(x, -1e6, 1e6), jnp.where(jnp.abs(y) < 1e-8, 0.0, y)),
    "copysign": jnp.copysign,
    "atan2": jnp.arctan2,
    "lt": jnp.less,
    "le": jnp.less_equal,
    "gt": jnp.greater,
    "ge": jnp.greater_equal,
    "eq": jnp.equal,
    "ne": jnp.not_equal,
    "hypot": lambda x, y: jnp.sqrt(x * x + y * y),
    "clamp between": lambda x, y: lax.clamp(lax.min(x, y), x + y, lax.max(x, y)),
}
# XLA's own are off by so many units in the last place.
ULPS = dict.fromkeys(("sinh", "cosh", "erfc", "atanh"), 300) | dict.fromkeys(
    ("tan", "tanh", "softplus", "log1p", "expm1", "exp2"), 40
)


def same(found, expected, ulps=4):
    expected = np.asarray(expected, float)
    assert_array_equal(np.isnan(found), np.isnan(expected))
    known = ~np.isnan(expected)
    assert_array_equal(np.isinf(found), np.isinf(expected))
    assert_allclose(found[known], expected[known], rtol=ulps * 2.3e-16, atol=1e-307)


@pytest.mark.parametrize("name", ONE)
def test_a_function_of_one_number_is_that_of_jax(on_machine, width, name):
    x = np.concatenate([SPECIAL, ORDINARY])
    found = on_machine(ONE[name], width, 0.0)(x)[0]
    same(found, jax.vmap(ONE[name])(x), ULPS.get(name, 4))


@pytest.mark.parametrize("name", TWO)
def test_a_function_of_two_numbers_is_that_of_jax(on_machine, width, name):
    x, y = (np.concatenate([z.ravel(), rest]) for z, rest in zip(np.meshgrid(SPECIAL, SPECIAL), (ORDINARY, ORDINARY[::-1])))
    same(on_machine(TWO[name], width, 0.0, 0.0)(x, y)[0], jax.vmap(TWO[name])(x, y))


def test_powers_of_positive_numbers(on_machine, width):
    x, y = 10.0 ** RNG.uniform(-3, 3, 50), RNG.uniform(-3, 3, 50)
    same(on_machine(jnp.power, width, 1.0, 1.0)(x, y)[0], x**y, 8)


def test_sine_and_cosine_are_right_to_the_last_digit_in_many_turns(on_machine, width):
    near = np.add.outer(np.array([-41, -3, -2, -1, 0, 1, 2, 3, 4, 7, 60_000]) * np.pi / 2, [0.0, 1e-9, -1e-3]).ravel()
    x = np.concatenate([RNG.uniform(-1e5, 1e5, 400), RNG.uniform(-7, 7, 400), near, [0.0, 1e-200]])
    sine, cosine = on_machine(lambda x: (jnp.sin(x), jnp.cos(x)), width, 0.0)(x)
    exact = np.sin(x.astype(np.longdouble)), np.cos(x.astype(np.longdouble))
    for found, expected in ((sine, exact[0]), (cosine, exact[1])):
        assert np.max(np.abs(found - expected) / np.spacing(np.abs(expected.astype(float)))) < 1.5


def test_sine_and_cosine_of_what_is_not_finite_are_no_numbers(on_machine, width):
    assert np.all(np.isnan(on_machine(lambda x: (jnp.sin(x), jnp.cos(x)), width, 0.0)(np.array([np.inf, -np.inf, np.nan]))))


def test_sine_and_cosine_hold_for_as_many_turns_as_a_machine_makes_in_years(on_machine, width):
    x = 10.0 ** np.linspace(5, 9, 200)
    sine, cosine = on_machine(lambda x: (jnp.sin(x), jnp.cos(x)), width, 0.0)(x)
    assert_allclose(sine, np.sin(x), atol=1e-15)
    assert_allclose(cosine, np.cos(x), atol=1e-15)


def test_whole_inputs_and_conditions_are_taken_from_numbers(on_machine, width):
    found = on_machine(lambda k, c: jnp.where(c, k, 7) * 0.5, width, 3, True)([3.0, 3.0, -2.0], [1.0, 0.0, 1.0])
    assert_array_equal(found[0], [1.5, 3.5, -1.0])


def test_unused_inputs_and_constant_outputs(on_machine, width):
    found = on_machine(lambda x, y: (y, -y, jnp.asarray(2.5), y * 0.0 + 1.0), width, 0.0, 0.0)([1.0, np.nan], [3.0, 4.0])
    assert_array_equal(found, [[3.0, 4.0], [-3.0, -4.0], [2.5, 2.5], [1.0, 1.0]])


def test_derivatives_of_expressions_are_programs_too(on_machine, width):
    f = lambda x: jnp.arctan(x) * jnp.sin(3.0 * x) + jnp.sqrt(1.0 + x * x) * jnp.exp(-x)  # noqa: E731
    x = np.linspace(-2, 2, 17)
    for derived in (jax.grad(f), jax.grad(jax.grad(f))):
        assert_allclose(on_machine(derived, width, 0.0)(x)[0], jax.vmap(derived)(x), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: lax.erf_inv(x),
        jax.scipy.special.gammaln,
        lambda x: lax.while_loop(lambda a: a < 3.0, lambda a: a + x, x),
        jax.lax.digamma,
    ],
)
def test_what_there_is_no_instruction_for_is_said(on_machine, function):
    with pytest.raises(UnsupportedError):
        on_machine(function, 1, 0.5)


def program_of(function):
    graph = Graph()
    given = np.empty((), object)
    given[()] = x = graph.input("x", "state", np.dtype(float))
    return ScalarProgram(graph, [x], list(trace(function, 0.5)(graph, given)[0].flat))


def test_a_check_writes_no_arithmetic():
    f = Function("check", [], 1)
    Writer(f, program_of(lambda x: x * (x + 2.0) / (1.0 - x * x))).check()
    assert "  %" not in f.text()
    Writer(f, program_of(lambda x: jnp.where(x > 0.0, jnp.sin(x), lax.sqrt(-x)) * x)).check()
    assert "  %" in f.text()
    with pytest.raises(UnsupportedError, match="erf_inv"):
        Writer(f, program_of(lambda x: 3.0 * lax.erf_inv(-x) + x)).check()


def test_numpy_computes_what_machine_code_computes():
    """XLA calls runs that are made of both, and JAX may wait for the thread that runs them."""
    for name, function in ONE.items():
        program = program_of(function)
        with calls_of(scalar_program._evaluate_by_jax) as by_jax:
            found = program.by_numpy([ORDINARY])[0]
        right = jax.vmap(function)(ORDINARY)
        assert by_jax == []
        assert_allclose(found, np.asarray(right, float), rtol=1e-11, atol=1e-300, err_msg=name)


SLOPED = {name: f for name, f in ONE.items() if name not in ("is_finite", "of conditions")} | {
    "pow": lambda x: jnp.power(1.0 + x * x, 0.5 * x),
    "atan2": lambda x: jnp.arctan2(x, 1.0 - x),
    "max": lambda x: jnp.maximum(x, x * x) + jnp.minimum(2.0 * x, 1.0),
    "clamp between": lambda x: lax.clamp(x - 1.0, x * x, x + 1.0),
}


@pytest.mark.parametrize("name", SLOPED)
def test_whatever_has_an_instruction_has_derivatives_that_have_one(code, name):
    """Derivatives are taken from the graph, not by JAX; a run without a rule for an operation would have none."""
    graph = Graph()
    x = graph.input("x", "state", np.dtype(float))
    given = np.empty((), object)
    given[()] = x
    (output,) = trace(SLOPED[name], 0.5)(graph, given)[0].flat
    derivatives = [*tangents(graph, [output], {x: graph.constant(1.0)}), *cotangents(graph, [output], [graph.constant(1.0)], [x])]
    places = [("x", 0)], [("y", 0), ("y", 1)]
    run, points = (
        code(write(ScalarProgram(graph, [x], derivatives), "program", 1, ("x", "y"), *places)),
        np.array([-0.6, 0.3, 0.8]),
    )
    for point in points:
        found = np.zeros(2)
        run(np.array([point]), found)
        assert_allclose(found, np.full(2, jax.grad(lambda x: SLOPED[name](x) * 1.0)(point)), rtol=1e-12, atol=1e-14)


def test_a_long_program_is_a_chain_of_functions(code, width):
    """Its pieces pass numbers of one lane and of all, also of more than the function has, and write over inputs at last only."""
    graph, rng = Graph(), np.random.default_rng(0)

    def long(x, y, c):
        values = [x, y, c]
        for k in range(150):
            a, b = values[-1 - k % 7 % len(values)], values[int(rng.integers(len(values)))]
            number = (
                jnp.exp(-a * a) if k % 40 == 0 else jnp.where(b > a, 0.3 * a - b, a / (b * b + 2.0)) if k % 3 else c * c - 0.1 * k
            )
            values.append(number)
        whole = jnp.where(x > y, 3, -2)
        return x - sum(values[3::2]), sum(values[4::2]) * whole, jnp.where(values[5] > values[9], values[3], y)

    scalars = [graph.input((name, 0), name) for name in "xyc"]
    arrays = [np.array(s, object) for s in scalars]
    outputs = [s for o in trace(long, 0.5, 0.25, 0.75)(graph, *arrays) for s in o.flat]
    program = ScalarProgram(graph, scalars, outputs)
    f = write(
        program,
        "program",
        1,
        ("x", "c"),
        [("x", 0), ("x", 1), ("c", 0)],
        [("x", 0), ("x", 1), ("x", 2)],
        lanes={"x": width},
        longest=100,
    )
    assert len([name for name in f.evaluated if name.startswith(f.name)]) > 3
    x, c = np.append(rng.uniform(0.5, 1.5, 2 * width), np.zeros(width)), np.array([0.7])
    exact = program.by_numpy([x[:width], x[width : 2 * width], np.full(width, c[0])])
    code(f)(x, c)
    assert_allclose(x.reshape(3, width), exact, rtol=1e-12)
