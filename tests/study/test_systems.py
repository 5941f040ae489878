"""Studies of user-defined systems: sweeps, diagnosis and identification, against exact motions."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from experiments.parts.closed_chains import bennett, bricard
from tests.integrate.systems.own_systems import G, disc
from udkjax.scene.tables.checks import SceneError
from udkjax.study.sweep.dimensions import SweepError

TS = np.linspace(0.0, 1.0, 5)


class Pendulum(eqx.Module):
    """A spatial pendulum whose guess is a conical motion at half of its length below the pivot."""

    weight: jax.Array
    length: jax.Array

    def mass(self, q):
        return self.weight * jnp.eye(3)

    def on_sphere(self, t, q):
        return {"rod": q @ q - self.length**2}

    def height(self, t, q):
        return self.weight * G * q[2]

    def system(self, q0=None, v0=None):
        return udk.ConstrainedSystem(self.mass, constraint=self.on_sphere, potential=self.height, q0=q0, v0=v0)


LENGTHS = np.array([1.0, 1.2, 1.5])


def conical(length, ts, depth=0.6):
    """Coordinates of the conical pendulum that is `depth` times its length below its pivot."""
    radius, rate = length * np.sqrt(1 - depth**2), np.sqrt(G / (depth * length))
    return np.stack([radius * np.cos(rate * ts), radius * np.sin(rate * ts), np.full_like(ts, -depth * length)], 1)


def start(length, depth=0.6):
    radius, rate = length * np.sqrt(1 - depth**2), np.sqrt(G / (depth * length))
    return [radius, 0.0, -depth * length], [0.0, radius * rate, 0.0]


PENDULUM = Pendulum(jnp.array(2.0), jnp.array(1.0)).system(*start(1.0))


def test_numbers_have_names():
    """Fields of the module, shared by three functions, and the guess; entries of arrays; mistakes with their cure."""
    assert list(PENDULUM.parameters()) == ["weight", "length", "q0", "v0"]
    changed = PENDULUM.with_parameters({"length": 1.5, "q0[2]": -0.7})
    assert_allclose(changed.parameters()["q0"], [0.8, 0.0, -0.7])
    constraint: Any = changed.constraint
    assert_allclose(constraint(0.0, jnp.zeros(3))["rod"], -2.25)
    with pytest.raises(SceneError, match='no parameter "lenght"; did you mean "length"'):
        PENDULUM.with_parameters({"lenght": 1.0})
    number: Any = 2.0
    plain = Pendulum(number, jnp.array(1.0)).system()
    with pytest.raises(SceneError, match="it is a Python number"):
        plain.with_parameters({"weight": 1.0})


def test_numbers_of_different_modules():
    """Equal fields of different modules get the name of their function."""

    class Spring(eqx.Module):
        length: jax.Array

        def __call__(self, t, q, v):
            return -(q - self.length)

    rod = Pendulum(jnp.array(2.0), jnp.array(1.0))
    system = udk.ConstrainedSystem(rod.mass, Spring(jnp.array(0.3)), rod.on_sphere)
    assert list(system.parameters()) == ["weight", "mass.length", "force.length"]


def test_the_guess_is_assembled():
    """A longer rod moves the guess along the radius; a run begins there, and so does its derivative."""
    longer = PENDULUM.with_parameters({"length": 2.0})
    assert_allclose(udk.assemble(longer).q, [1.6, 0.0, -1.2], atol=1e-14)
    assert_allclose(udk.simulate(longer, TS).q[0], [1.6, 0.0, -1.2], atol=1e-14)
    with pytest.raises(ValueError, match="no initial guess"):
        udk.simulate(udk.ConstrainedSystem(PENDULUM.mass), TS)


def sweep_of_lengths(measures, **settings):
    """Sweep lengths, each with its conical motion, tolerances and methods."""

    def exact(system, ts):
        length = jnp.sqrt(system.q0 @ system.q0)
        rate, radius = jnp.sqrt(G / (0.6 * length)), 0.8 * length
        return jnp.stack([radius * jnp.cos(rate * ts), radius * jnp.sin(rate * ts), -0.6 * length + 0 * ts], 1)

    def of_length(system, length):
        scale = length / jnp.linalg.norm(system.q0)
        return system.with_parameters({"length": length, "q0": system.q0 * scale, "v0": system.v0 * jnp.sqrt(scale)})

    axes = {
        "length": udk.Axis(LENGTHS, of=of_length),
        "rtol": [1e-6, 1e-10],
        "method": [udk.SVD(), udk.Greville(), udk.Elimination()],
    }
    return udk.sweep(PENDULUM, axes, TS, measures, reference=exact, atol=1e-10, **settings)


def test_sweep_of_numbers_methods_and_tolerances():
    """Every member is the exact conical motion of its length, up to its tolerance."""
    data = sweep_of_lengths(["final", "error"])
    assert data.sizes["coordinate"] == 3
    assert (data.result == 0).all()
    assert float(data.error.sel(rtol=1e-10).max()) < 1e-8
    assert float(data.error.sel(rtol=1e-6).max()) < 1e-4
    for length in LENGTHS:
        assert_allclose(data.q_end.sel(length=length, rtol=1e-10), np.tile(conical(length, TS[-1:])[0], (3, 1)), atol=1e-8)


@pytest.mark.slow
def test_sweep_with_ranks_and_derivatives():
    """The derivative of the end by the length, against the exact motion."""
    data = sweep_of_lengths(["final", "error", "rank"], derivatives=["length"])
    assert (data["rank"] == 1).all()
    for length in LENGTHS:
        slope = (conical(length + 1e-6, TS[-1:]) - conical(length - 1e-6, TS[-1:]))[0] / 2e-6
        assert_allclose(data.d_q_end_d_length.sel(length=length, rtol=1e-10), np.tile(slope, (3, 1)), atol=1e-6)


@pytest.mark.slow
def test_sweep_of_gains_states_and_systems(tmp_path):
    """Gains make a drift decay; states are an axis, and so are systems; a finished sweep is read back from its folder."""
    q, v = (np.array(x) for x in start(1.0))
    off = udk.State(1.01 * q, v)
    drift = {"state": off, "drift_tol": 1.0}
    data = udk.sweep(PENDULUM, {"alpha": [5.0, 10.0]}, TS, ["violation", "states", "q[2]"], out=tmp_path, **drift)
    gap, first = np.sum(np.square(data.q.values), 2) - 1.0, 1.01**2 - 1.0
    assert_allclose(gap[0], first * (1 + 5 * TS) * np.exp(-5 * TS), atol=1e-7)
    slow, fast = -10 + np.sqrt(75), -10 - np.sqrt(75)
    assert_allclose(gap[1], first * (fast * np.exp(slow * TS) - slow * np.exp(fast * TS)) / (fast - slow), atol=1e-7)
    assert_allclose(data["q[2]"], data.q[..., 2])
    again = udk.sweep(PENDULUM, {"alpha": [5.0, 10.0]}, TS, ["violation", "states", "q[2]"], out=tmp_path, **drift)
    assert_allclose(again.q, data.q)
    heavier = PENDULUM.with_parameters({"weight": 3.0})
    states = [udk.State(*start(1.0)), udk.State(*start(1.0, 0.8))]
    data = udk.sweep(PENDULUM, {"mechanism": [PENDULUM, heavier], "state": states}, TS, "states", rtol=1e-10, atol=1e-10)
    assert_allclose(data.q[0], data.q[1], atol=1e-9)
    assert_allclose(data.q[0, 1], conical(1.0, TS, 0.8), atol=1e-8)


def test_mistakes_of_a_sweep():
    without = udk.ConstrainedSystem(PENDULUM.mass, constraint=PENDULUM.constraint, potential=PENDULUM.potential)
    with pytest.raises(SweepError) as error:
        udk.sweep(without, {"lenght": [1.0, 2.0]}, TS)
    assert any("state=State(q, v)" in text for text in error.value.problems)
    assert any('did you mean "length"' in text for text in error.value.problems)


@pytest.mark.slow
def test_diagnosis_of_overconstrained_chains():
    """Bennett's four-bar has 14 rows of rank 11, Bricard's six-bar 24 of 23: one freedom each."""
    for system, rank in ((bennett(), 11), (bricard(), 23)):
        assert system.q0 is not None and system.v0 is not None
        found = udk.diagnose(system, udk.State(system.q0, system.v0))
        assert found.rank == found.ordinary_rank == rank
        assert found.degrees_of_freedom == 1
        assert found.can_move
        rows = len(found.rows)
        assert sum(r.count for r in found.redundancies) == len(found.redundant) == rows - rank
        assert all(label.startswith("constraint[") for label in found.rows)


def test_diagnosis_of_rolling():
    """A rolling disc has five independent coordinates and three independent velocities, and unique multipliers."""
    state = udk.State([0.0, 0.0, 0.0, 0.2, 0.0], [0.8, 0.0, 0.0, 0.3, 2.0])
    found = udk.diagnose(disc(), state)
    assert (found.position_freedoms, found.degrees_of_freedom) == (5, 3)
    assert found.redundancies == ()
    assert found.unique == {"velocity_constraint[0]": True, "velocity_constraint[1]": True}


def test_diagnosis_names_rows():
    """A row that repeats another has the name that the user gave it; where both vanish, the rank is lower than nearby."""

    def crossing(t, q):
        gap = q[0] ** 2 - q[1] ** 2
        return {"first": gap, "again": gap}

    system = udk.ConstrainedSystem(lambda q: jnp.eye(2), constraint=crossing)
    found = udk.diagnose(system, udk.State([0.5, 0.5], [0.0, 0.0]))
    assert found.redundancies[0].rows == ("first", "again")
    assert found.redundant == ("again",)
    assert not any(found.unique.values())
    at_crossing = udk.diagnose(system, udk.State([0.0, 0.0], [0.0, 0.0]))
    assert at_crossing.is_singular
    assert (at_crossing.rank, at_crossing.ordinary_rank) == (0, 1)
    assert "first, again: 1 redundant row everywhere" in str(at_crossing)


def measured(length, ts=np.linspace(0.0, 2.0, 41)):
    """The measured coordinates of a conical pendulum, as columns of a table."""
    return {"time": ts, **{f"q[{k}]": x for k, x in enumerate(conical(length, ts).T)}}


@pytest.mark.slow
def test_identification_from_coordinates():
    """The length of a pendulum from its exact motion; its mass has no effect, which the estimate says."""
    guess = PENDULUM.with_parameters({"length": 1.1, "q0": start(1.0)[0]})
    known = {key: measured(1.0)[key] for key in ("time", "q[0]", "q[2]")}
    found = udk.identify(guess, known, ["length", "weight"], initial_state="both", n_starts=0)
    assert_allclose(found.parameters["length"], 1.0, atol=1e-7)
    assert found.uncertainty.dead == ("weight",)
    assert (
        set(found.initial_state_values) == {"start: q[0]", "start: q[1]", "start: v[0]", "start: v[1]"}
        or len(found.initial_state_values) == 4
    )
    assert_allclose(found.initial_states[0].q, start(1.0)[0], atol=1e-7)
    assert_allclose(udk.simulate(found.mechanism, [0.0, 2.0]).q[-1], conical(1.0, np.array([2.0]))[0], atol=1e-6)


@pytest.mark.slow
def test_identification_from_an_output():
    """From an own output, the distance from a point, with noise: the length within its standard error."""
    camera = np.array([2.0, 0.5, 0.3])
    distance = udk.Quantity("distance", lambda system, motion: jnp.linalg.norm(motion.q - camera, axis=1), "m")
    ts = np.linspace(0.0, 2.0, 81)
    exact = np.linalg.norm(conical(1.0, ts) - camera, axis=1)
    noisy = exact + 1e-3 * np.random.default_rng(0).normal(size=81)
    record = udk.Record(ts, {distance: noisy}, initial_state=udk.State(*start(1.0)))
    found = udk.identify(PENDULUM.with_parameters({"length": 1.02}), record, ["length"], initial_state="velocity")
    assert abs(found.parameters["length"] - 1.0) < 4 * found.standard_errors["length"] < 0.01
    assert "system: 1 parameter from 81 numbers" in str(found)


def test_mistakes_of_an_identification():
    """A system without a guess, an unknown channel and an unknown parameter."""
    without = udk.ConstrainedSystem(PENDULUM.mass, constraint=PENDULUM.constraint, potential=PENDULUM.potential)
    with pytest.raises(udk.IdentificationError, match="needs q0 and v0"):
        udk.identify(without, measured(1.0), ["length"])
    with pytest.raises(udk.IdentificationError) as error:
        udk.identify(PENDULUM, {"time": [0.0, 1.0], "q[3]": [0.0, 1.0]}, ["long"])
    assert any("there are 3 coordinates" in text for text in error.value.problems)
    assert any("long" in text for text in error.value.problems)
