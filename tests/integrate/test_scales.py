"""A mechanism of a micrometre behaves as one of a kilometre, in milliseconds or seconds, of milligrams or tons."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.choices import fast
from tests.scaling import scaled

SCENES = {
    "parallelogram": udk.library.parallelogram,
    "excavator": udk.library.excavator,
    "slider crank": udk.library.slider_crank,
    "planetary gear": udk.library.planetary_gear,
    "trammel": udk.library.elliptic_trammel,
}
UNITS = [
    (1e-6, 1.0, 1.0),
    (1e-3, 1.0, 1.0),
    (1e3, 1.0, 1.0),
    (1.0, 1e-3, 1.0),
    (1.0, 1.0, 1e-9),
    (1.0, 1.0, 1e6),
    (1e-6, 1e-3, 1e-9),
]
# A change of units by powers of two changes no digit of any number.
BINARY = [(2.0**-20, 1.0, 1.0), (2.0**10, 2.0**-10, 2.0**20), (1.0, 2.0**8, 2.0**-30)]
TS = np.linspace(0.0, 2.0, 21)
TOL = 1e-9
# Rounding errors, which a change of units makes others: of positions, far below the tolerance; of rates there are more, since
# first steps are tiny and second differences of positions over their squares are among what rates are interpolated from.
POSITION, RATE = 1e-10, 10 * TOL


def deviation(mechanism, units, method=None, times=TS):
    """How far the motion in other units is from that in our own: coordinates and velocities, in our own."""
    length, time, _ = units
    run = lambda mech, ts: udk.simulate(mech, ts, rtol=TOL, atol=TOL, method=method)  # noqa: E731
    own, other = run(mechanism, times), run(scaled(mechanism, *units), times * time)
    unit = np.array([length, length, 1.0])
    return np.abs(other.q / unit - own.q).max(), np.abs(other.v * time / unit - own.v).max()


@pytest.mark.parametrize("name", fast(["parallelogram", "slider crank", "planetary gear", "trammel"], SCENES))
def test_the_motion_is_the_same_in_all_units(name):
    for units in UNITS:
        dq, dv = deviation(SCENES[name](), units)
        assert dq < POSITION and dv < RATE, units


@pytest.mark.parametrize("name", fast(["parallelogram", "planetary gear"], SCENES))
def test_to_the_last_digit_where_the_units_are_powers_of_two(name):
    for units in BINARY:
        assert deviation(SCENES[name](), units) == (0.0, 0.0), units


@pytest.mark.parametrize("method", [udk.SVD(), pytest.param(udk.Varga(), marks=pytest.mark.slow)], ids=["SVD", "Varga"])
@pytest.mark.slow
def test_and_by_methods_that_compare_rows_of_metres_with_rows_of_radians(method):
    for units in UNITS[::2]:
        dq, dv = deviation(udk.library.slider_crank(), units, method, TS[:5])
        assert dq < POSITION and dv < RATE, units


@pytest.mark.parametrize("name", [*SCENES, "scissor lift"])
def test_the_analysis_is_the_same_in_all_units(name):
    mechanism = (SCENES | {"scissor lift": udk.library.scissor_lift})[name]()
    own = udk.analyse(mechanism)
    for units in UNITS:
        other = udk.analyse(scaled(mechanism, *units))
        assert (other.redundant, other.rank, other.degrees_of_freedom) == (own.redundant, own.rank, own.degrees_of_freedom)
        assert_allclose([other.length, other.time, other.mass], np.multiply(units, [own.length, own.time, own.mass]), rtol=1e-12)


@pytest.mark.parametrize("units", UNITS)
def test_the_same_is_refused_in_all_units(units):
    """A loop that is one percent out of closure does not close, however small it is; nor does one that an offset breaks."""
    mechanism = scaled(udk.library.parallelogram(), *units)
    point = np.asarray(mechanism.parameters()["joint.B2.points"])
    for off in (0.01, 1e-6):
        opened = mechanism.with_parameters({"joint.B2.points": point + off * units[0] * np.array([[1.0, 0.0], [0.0, 0.0]])})
        with pytest.raises(udk.AssemblyError, match="B2"):
            udk.assemble(opened)
        assert not udk.check(opened).closed
    assert udk.check(mechanism).closed and udk.check(mechanism).redundant == (("B2", 1),)


@pytest.mark.parametrize("radius", [1.0, 1e-7])
def test_a_block_on_a_rail_is_held_however_small_its_radius_of_gyration(radius):
    """One row of a prismatic joint is in metres, the other in radians."""
    block = udk.Mechanism(
        {"block": udk.Body(2.0, 2.0 * radius**2)}, {"rail": udk.Prismatic(["ground", "block"], np.zeros((2, 2)), 0.0)}
    )
    for method in (udk.SVD(), udk.Auto()):
        sol = udk.simulate(block, [0.0, 1.0], method=method)
        assert_allclose(sol.q, 0.0, atol=1e-12)
        assert_allclose(udk.reactions(block, sol, method)["rail"]["block"][-1], [0.0, 2.0 * 9.81, 0.0], atol=1e-9)


def test_reactions_are_the_same_in_all_units():
    mechanism = udk.library.slider_crank()
    own = udk.reactions(mechanism, udk.simulate(mechanism, TS))
    for length, time, mass in UNITS:
        small = scaled(mechanism, length, time, mass)
        other = udk.reactions(small, udk.simulate(small, TS * time))
        force = mass * length / time**2
        for name, bodies in own.items():
            for body, load in bodies.items():
                size = float(jnp.abs(load).max())
                assert_allclose(other[name][body] / (force * np.array([1.0, 1.0, length])), load, rtol=0, atol=1e-8 * (1 + size))


@pytest.mark.parametrize("given", ["one number", pytest.param("the whole mechanism", marks=pytest.mark.slow)])
def test_under_jit_a_call_computes_the_same(given):
    """Within rounding: the programs are compiled apart. (Runs through singular configurations amplify it a thousand times.)"""
    mechanism = udk.library.parallelogram()
    analysis, eager = udk.analyse(mechanism), udk.simulate(mechanism, TS)
    if given == "one number":
        run = lambda mass: udk.simulate(mechanism.with_parameters({"body.coupler.mass": mass}), TS)  # noqa: E731
        found = jax.jit(run)(mechanism.bodies["coupler"].mass)
    else:
        found = jax.jit(lambda mech: udk.simulate(mech, TS, analysis=analysis))(mechanism)
    assert_allclose(found.q, eager.q, rtol=0, atol=1e-10)
    assert int(found.code) == int(eager.code)
