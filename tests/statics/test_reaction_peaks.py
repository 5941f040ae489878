"""Peaks of reactions and their derivatives, envelopes, and the power balance."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk

G = 9.81
TS = np.linspace(0.0, 2.0, 161)


def lowest_load(coupler_mass):
    """The largest force at a ground pivot of the paper's linkage, released at -45 degrees, as it passes the lowest point.

    It is m (L/2) theta'^2 + m g of the link, and a third of the coupler's, along the link, and nothing across it.
    """
    J, P = 3 * (0.1 + 0.25) + coupler_mass, 1.5 + coupler_mass
    square = 2 * G * P / J * (1 - np.cos(np.pi / 4))
    return 0.5 * square + G + coupler_mass * (square + G) / 3


@pytest.fixture(scope="module")
def peak_of():
    """The peaks as a function of the mass of the coupler."""
    linkage = udk.library.parallelogram()

    def peak(mass):
        mechanism = linkage.with_parameters({"body.coupler.mass": mass})
        return udk.reaction_peaks(mechanism, udk.simulate(mechanism, TS, rtol=1e-10, atol=1e-10))

    return peak


@pytest.mark.slow
def test_a_peak_and_its_derivative_through_a_run_are_those_of_the_closed_form(peak_of):
    def force(mass):
        return peak_of(mass)["A1"]["link1"].force

    both = jax.jit(lambda mass: jax.jvp(force, (mass,), (1.0,)))
    value, slope = both(2.0)
    assert_allclose(value, lowest_load(2.0), rtol=1e-6)
    h = 1e-4
    assert_allclose(slope, (lowest_load(2.0 + h) - lowest_load(2.0 - h)) / (2 * h), rtol=1e-5)
    assert_allclose(slope, (both(2.0 + h)[0] - both(2.0 - h)[0]) / (2 * h), rtol=1e-6)  # of what is computed, by differences


def test_the_peak_comes_when_the_linkage_is_lowest(peak_of):
    """A quarter, three quarters ... of its period after the release (the reference has the period)."""
    when = peak_of(2.0)["A1"]["link1"].force_time
    assert min(abs(float(when) - (k + 0.25) * 1.94752692087424428) for k in (0, 0.5)) < 1e-4


def test_envelopes_over_a_batch_of_load_cases(peak_of):
    masses = jnp.array([1.0, 3.0, 2.0])
    found = jax.tree.map(lambda *peaks: jnp.stack(peaks), *map(peak_of, masses))  # as `vmap` returns them
    top = udk.envelope(found)["A2"]["link2"]
    assert int(top.force_case) == 1
    assert_allclose(found["A2"]["link2"].force, [lowest_load(float(m)) for m in masses], rtol=1e-6)
    assert_allclose(top.force, lowest_load(3.0), rtol=1e-6)
    one_by_one = udk.envelope([jax.tree.map(lambda x, k=k: x[k], found) for k in (0, 1)])["A2"]["link2"]
    assert_allclose(one_by_one.force, top.force, rtol=1e-9)
    failed = jax.tree.map(lambda x: x.at[1].set(jnp.nan), found)
    assert int(udk.envelope(failed)["A2"]["link2"].force_case) == 2  # what failed is left out


def uneven(s):
    """Output times from 0 to 1 that are dense in places; every second step is twice as long as the others."""
    s = s + np.where(np.arange(len(s)) % 2, 0.3, 0.0) / len(s)
    return s + (1 - np.cos(2 * np.pi * s)) / (4 * np.pi)


@pytest.mark.parametrize(("times", "rtol"), [(lambda s: s, 1e-8), (uneven, 1e-4)])
def test_root_mean_squares_of_a_turning_rod_are_those_of_integrals(times, rtol):
    """A motor turns a rod evenly. The pivot constantly pulls with m omega^2 l/2, and with m g in addition."""
    rod = udk.Body(2.0, 0.3, [0.5, 0.0], 0.0, [0.0, 3.0], 6.0)
    mechanism = udk.Mechanism(
        {"rod": rod},
        {"pin": udk.Revolute(["ground", "rod"], [[0.0, 0.0], [-0.5, 0.0]])},
        {"motor": udk.Driver(["ground", "rod"], "angle", udk.Polynomial([0.0, 6.0]))},
    )
    turn = 2 * np.pi / 6.0
    ts = turn * times(np.linspace(0.0, 1.0, 401))
    found = udk.reaction_peaks(mechanism, udk.simulate(mechanism, ts, rtol=1e-10, atol=1e-10))
    pull, weight = 2.0 * 36.0 * 0.5, 2.0 * G
    pin, motor = found["pin"]["rod"], found["motor"]["rod"]
    assert_allclose(pin.force, pull + weight, rtol=max(1e-8, rtol / 100))
    assert_allclose(pin.force_time, 0.75 * turn, rtol=1e-6)
    assert_allclose(pin.rms_force, np.hypot(pull, weight), rtol=rtol)
    assert_allclose(motor.torque, weight * 0.5, rtol=rtol)  # the motor lifts the rod; its inertia takes nothing
    assert_allclose(motor.rms_torque, weight * 0.5 / np.sqrt(2), rtol=rtol)
    assert_allclose(pin.torque, 0.0, atol=1e-12)


def test_a_peak_needs_three_times():
    linkage = udk.library.parallelogram()
    with pytest.raises(ValueError, match="at least 3"):
        udk.reaction_peaks(linkage, udk.simulate(linkage, [0.0, 0.1]))


class Lamp(udk.ForceElement):
    """A potential that changes with time: a spring to the origin whose stiffness grows."""

    rate: float

    def potential(self, t, *frames):
        return 0.5 * (1.0 + self.rate * t) * (frames[0].x ** 2 + frames[0].y ** 2)


COUNT = 42  # states in each of the calls below: what is compiled for one serves the next


def still(state, v=None) -> Any:
    """One state, repeated."""
    q, v = np.asarray(state.q), np.asarray(state.v if v is None else v)
    return SimpleNamespace(ts=np.zeros(COUNT), q=np.tile(q, (COUNT, 1, 1)), v=np.tile(v, (COUNT, 1, 1)))


@pytest.fixture(scope="module")
def machine():
    """A driven slider-crank with all kinds of elements that store or dissipate energy."""
    plain = udk.library.slider_crank(0.3, spring=(30.0, 1.5, 0.2))
    forces = {
        **plain.forces,
        "brake": udk.Torque(["ground", "crank"], -0.5),
        "bearing": udk.Friction("P", 0.3, 0.2),
        "wind": udk.Force("rod", [1.0, -2.0], [0.2, 0.1], "body"),
        "lamp": Lamp(["slider"], 2.0),
    }
    return udk.Mechanism(plain.bodies, plain.joints, plain.drivers, forces, plain.gravity)


@pytest.mark.slow
def test_power_is_the_rate_of_energy_and_its_integral_the_energy(machine):
    """It holds to 1e-9 of the largest power at each instant, and integrates to the stored energy by Gauss' quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(COUNT - 2)
    ts = np.concatenate([[0.0], (nodes + 1) / 2, [1.0]])
    solution = udk.simulate(machine, ts, rtol=1e-12, atol=1e-12)
    found = udk.power_balance(machine, solution)
    assert float(found.relative) < 1e-9
    for joint in found.joints.values():
        assert_allclose(joint, 0.0, atol=1e-9)
    total = np.asarray(udk.energy(machine, solution).total)
    # `energy` has no time for the lamp's potential but each output's own.
    assert_allclose(weights @ np.asarray(found.supplied)[1:-1] / 2, total[-1] - total[0], rtol=1e-9)
    assert set(found.forces) == {"spring", "brake", "bearing", "wind", "lamp"} and set(found.drivers) == {"motor"}


def test_powers_of_single_elements_are_force_times_velocity(machine):
    state = udk.assemble(machine)
    q, v = np.asarray(state.q), np.asarray(state.v)
    found = udk.power_balance(machine, still(state))
    omega = v[0, 2]
    assert_allclose(found.forces["brake"], -0.5 * omega)
    assert_allclose(found.forces["bearing"], -0.3 * np.tanh((v[1, 2] - omega) / 0.2) * (v[1, 2] - omega))
    assert_allclose(found.forces["spring"], -0.2 * v[2, 0] ** 2, rtol=1e-12)  # of its damper: the slider moves along the line
    assert_allclose(found.forces["lamp"], q[2, 0] ** 2, rtol=1e-12)  # half of the rate 2 of its stiffness
    torque = udk.reactions(machine, still(state))["motor"]["crank"][0, 2]
    assert_allclose(found.drivers["motor"], torque * omega)


def test_velocities_that_violate_the_constraints_are_seen(machine):
    state = udk.assemble(machine)
    wrong = state.v.at[2, 1].add(0.1)  # the slider leaves its guide
    found = udk.power_balance(machine, still(state, wrong))
    assert float(found.relative) > 1e-3 and abs(float(found.joints["guide"][0])) > 1e-2
