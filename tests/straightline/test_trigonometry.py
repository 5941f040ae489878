"""Sine and cosine together, against exact values."""

import math
from fractions import Fraction
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.straightline.trigonometry import sincos

BITS = 1400  # of pi: angles of 1e308 take 1024 of them before the point
GUARD = 200
RANDOM = np.random.default_rng(0)
FORMS = {
    "vector": jax.jit(sincos),
    "scalars": jax.jit(lambda x: jax.lax.map(sincos, x)),
    "vmap": jax.jit(jax.vmap(sincos)),
    "operation by operation": sincos,
}


@cache
def pi() -> Fraction:
    """By Machin's formula."""

    def arctan_of_inverse(n: int) -> int:
        total = term = (1 << BITS) // n
        k = 1
        while term:
            term, k = -term // n**2, k + 2
            total += term // k
        return total

    return Fraction(16 * arctan_of_inverse(5) - 4 * arctan_of_inverse(239), 1 << BITS)


def exact(x: float) -> tuple[Fraction, Fraction]:
    """Sine and cosine of a floating-point number to some fifty digits."""
    turns = round(Fraction(x) / (pi() / 2))
    r = Fraction(x) - turns * (pi() / 2)
    z = int(r * r * (1 << GUARD))

    def series(k: int) -> Fraction:
        """1 - z / k (k+1) (1 - z / (k+2) (k+3) (1 - ...))."""
        total = term = 1 << GUARD
        while abs(term) > 1:
            term, k = -(term * z >> GUARD) // (k * (k + 1)), k + 2
            total += term
        return Fraction(total, 1 << GUARD)

    s, c = r * series(2), series(1)
    return ((s, c), (c, -s), (-s, -c), (-c, s))[turns % 4]


def ulps(found: np.ndarray, values: list[Fraction]) -> np.ndarray:
    unit = [np.spacing(np.abs(found.dtype.type(float(v)))) for v in values]
    return np.array(
        [abs(Fraction(float(f)) - v) / Fraction(float(u)) for f, v, u in zip(found, values, unit, strict=True)], float
    )


def ordinary_angles() -> np.ndarray:
    """Angles of every magnitude below 1e6, and what lies next to the multiples of a right angle and halfway between them."""
    turns = [*range(-200, 200), *RANDOM.integers(-636_000, 636_000, 400)]
    right = np.array([float(int(k) * pi() / 2) for k in turns])
    every = [RANDOM.uniform(-1.0, 1.0, 60) * 10.0**k for k in range(-30, 7)]
    return np.concatenate([*every, right, np.nextafter(right, np.inf), np.nextafter(right, -np.inf), right + np.pi / 4, [1e-300]])


@pytest.fixture(scope="module")
def angles():
    x = ordinary_angles()
    return x, *(list(v) for v in zip(*map(exact, x.tolist()), strict=True))


def test_the_reference_itself():
    assert float(pi()) == np.pi
    assert [float(v) for v in exact(1e22)] == [-0.8522008497671888, 0.523214785395139]  # as every correct library has them
    assert float(exact(1.0)[0] ** 2 + exact(1.0)[1] ** 2) == 1.0


@pytest.mark.parametrize("form", FORMS)
def test_the_pair_is_accurate_to_two_ulps(angles, form):
    x, *values = angles
    for found, value in zip(FORMS[form](jnp.asarray(x)), values, strict=True):
        assert ulps(np.asarray(found), value).max() < 2.0


def test_single_precision():
    x = np.concatenate([RANDOM.uniform(-1.0, 1.0, 60).astype(np.float32) * np.float32(10.0**k) for k in range(-10, 7)])
    values = zip(*map(exact, x.tolist()), strict=True)
    for found, value in zip(jax.jit(sincos)(jnp.asarray(x)), values, strict=True):
        assert found.dtype == np.float32
        assert ulps(np.asarray(found), list(value)).max() < 2.0


@pytest.mark.parametrize("size", [1e7, 1e9, 1e12, 1e15])
@pytest.mark.parametrize("form", FORMS)
def test_large_angles_are_off_by_no_more_than_their_own_last_place(form, size):
    x = RANDOM.uniform(-size, size, 200)
    s, c = map(np.asarray, FORMS[form](jnp.asarray(x)))
    error = [
        math.hypot(*(float(Fraction(float(f)) - v) for f, v in zip(found, exact(a), strict=True))) for *found, a in zip(s, c, x)
    ]
    assert np.all(np.array(error) < 4e-16 + np.spacing(np.abs(x)))


def test_the_largest_angles_still_give_a_sine_and_a_cosine():
    s, c = sincos(jnp.asarray(RANDOM.uniform(-1.0, 1.0, 500) * 10.0 ** RANDOM.uniform(15.0, 308.0, 500)))
    np.testing.assert_allclose(s**2 + c**2, 1.0, atol=1e-12)


def test_zero_and_what_is_not_a_number():
    s, c = sincos(jnp.array([0.0, -0.0, jnp.inf, -jnp.inf, jnp.nan]))
    np.testing.assert_array_equal(s, [0.0, 0.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(c, [1.0, 1.0, np.nan, np.nan, np.nan])


def test_whole_numbers_are_angles_too():
    np.testing.assert_allclose(sincos(3), (np.sin(3.0), np.cos(3.0)), rtol=1e-15)


@pytest.mark.parametrize(
    "derivative", [jax.grad, jax.jacfwd, jax.hessian, lambda f: jax.grad(jax.grad(jax.grad(f)))], ids=["1", "1 fwd", "2", "3"]
)
def test_derivatives_of_every_order(derivative):
    ours, theirs = lambda x: sincos(x)[0] * sincos(2.0 * x)[1], lambda x: jnp.sin(x) * jnp.cos(2.0 * x)
    for x in (0.0, 0.7, -40.0):
        np.testing.assert_allclose(derivative(ours)(x), derivative(theirs)(x), rtol=1e-13, atol=1e-14)


def test_each_platform_has_its_own_form():
    """On the CPU arithmetic, elsewhere what XLA has."""
    text = {p: jax.jit(sincos).trace(1.0).lower(lowering_platforms=(p,)).as_text() for p in ("cpu", "cuda")}
    assert "stablehlo.sine" not in text["cpu"] and "stablehlo.cosine" not in text["cpu"]
    assert text["cuda"].count("stablehlo.sine") == text["cuda"].count("stablehlo.cosine") == 1
    assert "optimization_barrier" not in text["cuda"]
