"""A mechanism of a micrometre behaves like one of a kilometre, in milliseconds or seconds, in milligrams or tons."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import ellipk

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
    """The difference, in SI units, between the motions in other units and in SI units."""
    length, time, _ = units
    run = lambda mech, ts: udk.simulate(mech, ts, rtol=TOL, atol=TOL, method=method)  # noqa: E731
    own, other = run(mechanism, times), run(scaled(mechanism, *units), times * time)
    unit = np.array([length, length, 1.0])
    return np.abs(other.q / unit - own.q).max(), np.abs(other.v * time / unit - own.v).max()


@pytest.mark.parametrize("name", fast(["parallelogram", "trammel"], SCENES))
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
    """A loop that misses closure by one percent does not close at any scale, nor does one broken by an offset."""
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
    """Results agree up to rounding, since programs differ. (Runs through singular configurations magnify it a thousandfold.)"""
    mechanism = udk.library.parallelogram()
    analysis, eager = udk.analyse(mechanism), udk.simulate(mechanism, TS)
    if given == "one number":
        run = lambda mass: udk.simulate(mechanism.with_parameters({"body.coupler.mass": mass}), TS)  # noqa: E731
        found = jax.jit(run)(mechanism.bodies["coupler"].mass)
    else:
        found = jax.jit(lambda mech: udk.simulate(mech, TS, analysis=analysis))(mechanism)
    assert_allclose(found.q, eager.q, rtol=0, atol=1e-10)
    assert int(found.code) == int(eager.code)


# Coordinates that are zero, zero but for rounding, or small: no step, scale or tolerance is relative to them alone.
SMALL = [0.0, 5e-324, 1e-300, 1e-100, 1e-30, 1e-17, 3e-16, 1e-12, 1e-8, -1e-17, -1e-9]


ENGINES = ["native", pytest.param("jax", marks=pytest.mark.slow)]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("tol", [(1e-8, 1e-8), (1e-10, 0.0), (0.0, 1e-8)], ids=["both", "relative", "absolute"])
def test_a_body_at_rest_at_the_origin_but_for_rounding_falls(engine, tol):
    y0 = np.array([(y, v) for y in SMALL for v in SMALL])
    body = udk.Mechanism({"b": udk.Body(2.0, 0.1)})

    def fall(y, v):
        state = udk.State([[y, y, v]], [[v, v, y]])
        return (s := udk.simulate(body, [0.0, 1.0], state, *tol, engine=engine)).code, s.q[-1, 0]

    code, q = jax.jit(jax.vmap(fall))(*y0.T)
    assert (code == udk.Result.successful).all()
    np.testing.assert_allclose(q[:, 1], y0.sum(1) - 9.81 / 2, rtol=1e-7)
    np.testing.assert_allclose(q[:, ::2], y0 @ np.array([[1, 1], [1, 1]]), atol=2e-8)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_slider_at_the_origin_follows_its_driver(engine):
    """sin(pi/2) - 1 and cos(pi/2) are zero up to rounding."""

    motion = udk.Sine(amplitude=1.0, frequency=4.0, phase=np.pi / 2, offset=-1.0)
    guide = udk.Prismatic(["ground", "p"], [[0, 0], [0, 0]], np.pi / 2)
    slide = udk.Mechanism({"p": udk.Body(1.0, 1.0)}, {"s": guide}, {"d": udk.Driver(["ground", "p"], "y", motion)})

    def driven(x):
        s = udk.simulate(slide, [0.0, 1.0, 2.0], udk.State([[x, x, x]], [[x, 0.0, x]]), engine=engine)
        return s.code, s.q[-1, 0, 1]

    code, y = jax.jit(jax.vmap(driven))(np.array([x for x in SMALL if abs(x) < 1e-15]))
    assert (code == udk.Result.successful).all()
    np.testing.assert_allclose(y, np.cos(8.0) - 1, rtol=1e-9)


@pytest.mark.parametrize("x", [0.0, 5e-324, 1e-17, -3e-16])
def test_arms_and_rows_of_rounding_are_none(x):
    """Pins in centres of mass, and a row that nothing changes at the guess, have the same scales as exact zeros."""

    class Parabola(udk.Joint):
        def residual(self, t, *frames):
            return [frames[1].y ** 2]

    bodies = {"a": udk.Body(1.0, 0.1, position=[x, x]), "b": udk.Body(1.0, 0.1, position=[x, x])}
    pins = {"p": udk.Revolute(["ground", "a"], [[0, 0], [x, 0]]), "r": udk.Revolute(["a", "b"], [[0, x], [0, 0]])}
    found = udk.analyse(udk.Mechanism(bodies, {**pins, "own": Parabola(["ground", "b"])})).scales
    length = np.sqrt(0.1)  # the radius of gyration: there is no arm
    assert_allclose([found.length, found.arm], length, rtol=1e-12)
    assert_allclose(found.rows, length, rtol=1e-12)


@pytest.mark.parametrize("inertia", [1e-10, 1e-16])
def test_a_point_mass_swings(inertia):
    """With little resistance to turning, the row along the rod has a size of only sqrt(I / m l^2) of the largest."""
    start, omega = 0.7, np.sqrt(9.81)
    place = [np.sin(start), -np.cos(start)]
    bob = udk.Mechanism(
        {"bob": udk.Body(1.0, inertia, place, start)}, {"O": udk.Revolute(["ground", "bob"], [[0.0, 0.0], [0.0, 1.0]])}
    )
    half_period = 2 * ellipk(np.sin(start / 2) ** 2) / omega
    assert_allclose(udk.simulate(bob, [0.0, half_period]).q[-1, 0, 2], -start, rtol=1e-6)
    below = udk.State([[0.0, -1.0, 0.0]], [[0.0, 0.0, 0.0]])
    assert_allclose(udk.modes(bob, below).frequencies, omega, rtol=1e-9)
