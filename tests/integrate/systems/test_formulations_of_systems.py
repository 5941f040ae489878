"""Other formulations of a user-defined system by machine code: the same motion, with any mass matrix and redundant rows."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.integrate.systems.own_systems import G, disc, pendulum

TS = np.linspace(0.0, 1.0, 5)
FORMULATIONS = {
    "Augmented": udk.Augmented(),
    "Augmented, SVD": udk.Augmented(udk.SVD()),
    "NullSpaceQR": udk.NullSpaceQR(),
    "NullSpaceSVD": udk.NullSpaceSVD(),
}
START = udk.State(np.array([0.6, 0.0, -0.8, 0.3]), np.array([0.0, 1.5, 0.0, 0.4]))


def system(copies=1, coupling=0.3, rolls=True):
    """A point on a sphere with a fourth coordinate, by a full M of q; a row of velocities ties it to the second."""

    def mass(q):
        M = jnp.diag(jnp.array([2.0, 1.5, 1.0, 0.7]))
        return M + coupling * jnp.cos(q[3]) * (jnp.ones((4, 4)) - jnp.eye(4)) if coupling else M

    return udk.ConstrainedSystem(
        mass,
        lambda t, q, v: jnp.array([0.0, 0.2, -9.81, 0.5]) - 0.1 * v,
        lambda t, q: jnp.tile(q[:3] @ q[:3] - 1.0, copies),
        (lambda t, q, v: v[3] - 0.3 * v[1] * jnp.cos(q[0]) - 0.4 + 0.45 * jnp.cos(0.6)) if rolls else None,
    )


def run(found, formulation=None, engine: Any = "native", **choices):
    return udk.simulate(found, TS, START, rtol=1e-10, atol=1e-10, formulation=formulation, engine=engine, **choices)


def test_a_full_mass_matrix():
    found = run(system(), FORMULATIONS["NullSpaceQR"])
    assert found.settings["engine"] == "native" and found.settings["formulation"] == "NullSpaceQR"
    assert_allclose(found.q, run(system()).q, rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMULATIONS)
@pytest.mark.parametrize(("copies", "coupling", "rolls"), [(1, 0.0, True), (1, 0.3, False), (2, 0.3, True)])
def test_both_engines_and_the_equation_of_udwadia_and_kalaba(name, copies, coupling, rolls):
    """Also with a row that is given twice, which LU refuses at once."""
    found, formulation = system(copies, coupling, rolls), FORMULATIONS[name]
    if name == "Augmented" and copies > 1:
        for engine in ("native", "jax"):
            assert run(found, formulation, engine, throw=False).result == udk.Result.not_finite
        return
    one, other, reference = run(found, formulation), run(found, formulation, "jax"), run(found)
    assert_allclose(one.q, other.q, rtol=0, atol=1e-9)
    assert_allclose(one.q, reference.q, rtol=0, atol=1e-8)
    assert_allclose(one.v, reference.v, rtol=0, atol=1e-7)


def test_a_spatial_pendulum_by_independent_coordinates():
    """Its row holds at all outputs, and its energy stays."""
    start = udk.State(START.q[:3], START.v[:3])
    found = udk.simulate(pendulum(), TS, start, formulation=udk.CoordinatePartitioning(), stabilization=None)
    assert found.settings["engine"] == "native"
    assert_allclose(np.sum(np.square(found.q), 1), 1.0, rtol=1e-15)
    assert_allclose(udk.energy(pendulum(), found).total, 2.0 * (1.5**2 / 2 - 0.8 * G), rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("copies", "rolls"), [(1, False), (2, True)])
def test_partitions_of_coordinates_and_velocities(copies, rolls):
    """A nonholonomic row makes a velocity dependent, but no coordinate; all rows hold at each stage."""
    found = system(copies, rolls=rolls)
    reference = run(found)
    for engine in ("native", "jax")[:copies]:
        partitioned = run(found, udk.CoordinatePartitioning(), engine, stabilization=None)
        assert_allclose(partitioned.q, reference.q, rtol=0, atol=1e-8)
        assert_allclose(partitioned.v, reference.v, rtol=0, atol=1e-7)
        assert_allclose(udk.violation(found, partitioned), 0.0, atol=1e-14)


def test_implicit_methods_integrate_all_coordinates():
    with pytest.raises(ValueError, match="partitions coordinates with explicit methods only, and Kvaerno5 is implicit"):
        run(system(), udk.CoordinatePartitioning(), solver=diffrax.Kvaerno5())


@pytest.mark.slow
def test_a_rolling_disc_by_independent_velocities():
    """Only rows of velocities: all coordinates are integrated, and three of five velocities."""
    start = udk.State(np.array([0.0, 0.0, 0.0, 0.3, 0.0]), np.array([0.8, 0.0, 1.0, 0.0, 2.0 - np.sin(0.3)]))
    runs = [
        udk.simulate(disc(), TS, start, rtol=1e-10, atol=1e-10, formulation=formulation)
        for formulation in (None, udk.CoordinatePartitioning())
    ]
    assert_allclose(runs[1].q, runs[0].q, rtol=0, atol=1e-8)
    assert_allclose(runs[1].v, runs[0].v, rtol=0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [*FORMULATIONS.values(), udk.CoordinatePartitioning()], ids=str)
def test_derivatives_and_members(formulation):
    def end(a, formulation):
        found = system()
        return run(udk.ConstrainedSystem(lambda q: a * found.mass(q), found.force, found.constraint), formulation).q[-1]

    a = jnp.array([0.9, 1.2])
    members = jax.vmap(lambda a: end(a, formulation))(a)
    assert_allclose(members, [end(x, None) for x in np.asarray(a)], rtol=0, atol=1e-8)
    for derivative in (jax.jacfwd, jax.jacrev):
        assert_allclose(derivative(end)(a[0], formulation), derivative(end)(a[0], None), rtol=0, atol=1e-7)


@pytest.mark.slow
def test_values_with_derivatives_are_those_without():
    """Derivatives of a run by partitions are those of another run, but its values are its own."""

    def end(pull):
        found = system()
        pulled = udk.ConstrainedSystem(found.mass, lambda t, q, v: pull * jnp.array([0.0, 0.2, -9.81, 0.5]), found.constraint)
        return udk.simulate(pulled, TS, START, rtol=1e-5, atol=1e-5, formulation=udk.CoordinatePartitioning()).q[-1, 0]

    alone = float(end(1.0))
    assert float(jax.value_and_grad(end)(1.0)[0]) == float(jax.jvp(end, (1.0,), (1.0,))[0]) == alone
