"""How steps come past singular configurations: where the next one is expected, and which step has its nodes far from it."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from udkjax.integrate.crossing import ahead, around, far, passed
from udkjax.integrate.tableau import method_of
from udkjax.native.steps import LONGEST, SHORTEST

METHODS = {"Dopri8": None, "Tsit5": diffrax.Tsit5(), "Dopri5": diffrax.Dopri5(), "Bosh3": diffrax.Bosh3(), "Heun": diffrax.Heun()}


@pytest.fixture(params=METHODS.values(), ids=list(METHODS))
def method(request):
    return method_of(request.param)


def test_the_time_that_is_left():
    """Exact for a distance that is a line, close for a parabola; nothing where it grows, stays, or is not known."""
    times = jnp.array([0.3, 0.5, 0.6])

    def left(distance):
        return ahead(tuple(times), tuple(jnp.asarray(d) for d in distance))

    assert_allclose(left((0.8 - times) * (2.0 + 0.3 * times)), 0.2, rtol=2e-2)
    assert_allclose(left(3.0 * (0.8 - times)), 0.2, rtol=1e-14)
    for distance in (2.0 + times, 0.0 * times + 1.0, jnp.array([jnp.inf, jnp.inf, 0.4]), jnp.full(3, jnp.inf), times + jnp.nan):
        assert not (left(distance) > 0.0) or jnp.isinf(left(distance))


def test_steps_begin_far_away_where_rounding_errors_allow_and_elimination_too():
    """However short: those that begin where no pivot is trusted would be tried ever shorter."""
    distances = jnp.array([1e-4, 1.2e-3, 2e-3, 1e-2, 0.1, jnp.inf])
    assert_allclose(far(distances, jnp.array(0.03), jnp.array(2e-9)), [False, False, False, True, True, True])
    assert_allclose(far(distances, jnp.array(1e-9), jnp.array(2e-9)), [False, False, True, True, True, True])
    assert not far(jnp.array(jnp.nan), jnp.array(0.03), jnp.array(2e-9))


@pytest.mark.parametrize(
    "left, after, expected",
    [
        (0.7, 0.12, True),  # enough of 0.3, which a line leads to expect
        (0.7, 0.01, False),  # too close to be where it is expected: it may as well be still ahead
        (0.9, 0.03, False),  # expected too late
        (-0.1, 0.4, False),  # none ahead
        (jnp.nan, 0.4, False),
        (0.7, jnp.nan, False),
        (0.7, jnp.inf, True),
    ],
)
def test_a_configuration_is_passed_where_its_distance_says_so_too(left, after, expected):
    assert passed(*map(jnp.asarray, (left, 1.0, 0.7, after))) == expected


def test_fractions_of_a_step_far_from_all_nodes(method):
    nodes = np.unique(method.nodes)
    for fraction in method.clearings:
        near = np.abs(nodes - fraction).min()
        assert near >= 0.08 and np.sum(np.isclose(np.abs(nodes - fraction), near)) == 2  # in the middle of a gap
    assert method.clearings[0] <= method.clearings[1]


@pytest.mark.parametrize("enough", [True, False])
def test_another_step_is_shorter_and_has_its_nodes_elsewhere(method, enough):
    """Or its end is before, and the next one, of the length of the first, has its nodes elsewhere. Else it is what is given."""
    low, _ = method.clearings
    step, taken = 0.7, 0
    for share in np.linspace(-0.2, 2.0, 221):
        left = share * step
        found = float(around(method, jnp.array(left), jnp.array(step), jnp.array(enough), jnp.array(0.8 * step)))
        if found == 0.8 * step:
            continue
        taken += 1
        assert SHORTEST * step < found < LONGEST * step and low * SHORTEST < share < 1.0 + low
        if found < left:
            assert enough
            assert_allclose(left - found, low * step)
        else:
            assert np.abs(method.nodes * found - left).min() >= 0.1 * low * found
    assert taken >= (20 if method.stages > 4 else 5)
    assert around(method, jnp.array(jnp.nan), jnp.array(step), jnp.array(enough), jnp.array(0.5)) == 0.5
