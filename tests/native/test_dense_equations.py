"""Runs with the paper's pseudoinverses in machine code equal those of the plain form, and so do their derivatives."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.study.accuracy import pendulum

METHODS = [udk.SVD(), udk.Varga(), udk.Householder(), udk.GramSchmidt(), udk.Greville()]
TIMES = np.linspace(0.0, 2.0, 11)


@pytest.mark.parametrize(
    ("method", "stabilization"),
    [*((m, udk.Projection()) for m in METHODS), (METHODS[0], None), (METHODS[2], udk.Baumgarte(3.0, 3.0))],
    ids=lambda x: type(x).__name__,
)
def test_the_exact_motion_of_a_redundant_linkage(method, stabilization):
    """The angle of its links satisfies 3.05 theta'' = -3.5 g cos(theta), like a pendulum released from rest."""
    start = np.deg2rad(-45)
    run = udk.simulate(
        udk.library.parallelogram(start), TIMES, rtol=1e-10, atol=1e-10, method=method, stabilization=stabilization
    )
    exact = start + pendulum(TIMES, start + np.pi / 2, 0.0, np.sqrt(3.5 * 9.81 / 3.05))
    assert_allclose(run.q[:, 0, 2], exact, rtol=0, atol=2e-8)
    assert int(run.stats["rejected"]) <= 5
    assert (run.settings["engine"], run.settings["method"]) == ("native", type(method).__name__)


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "method"), [("slider_crank", METHODS[0]), ("planetary_gear", METHODS[3])])
def test_other_mechanisms_move_as_by_elimination(scene, method):
    mechanism = getattr(udk.library, scene)()
    times = np.linspace(0.0, 0.5, 4)
    one, two = (udk.simulate(mechanism, times, rtol=1e-10, atol=1e-10, method=m) for m in (method, udk.Auto()))
    assert one.settings["engine"] == "native"
    assert_allclose(one.q, two.q, rtol=0, atol=1e-7 * float(udk.analyse(mechanism).length))


@pytest.mark.slow
@pytest.mark.parametrize("method", [METHODS[1], METHODS[4]], ids=["Varga", "Greville"])
def test_members_of_a_batch_are_single_runs(method):
    linkage = udk.library.parallelogram()
    masses = np.linspace(0.5, 3.0, 11)

    def end(mass):
        return udk.simulate(linkage.with_parameters({"body.link1.mass": mass}), TIMES, method=method).q[-1]

    batch = jax.jit(jax.vmap(end))(masses)
    assert_allclose(batch[::5], [end(m) for m in masses[::5]], rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", [METHODS[1], pytest.param(METHODS[4], marks=pytest.mark.slow)], ids=["Varga", "Greville"])
@pytest.mark.slow
def test_derivatives_are_those_of_elimination(method):
    linkage = udk.library.parallelogram()

    def angle(p, method):
        moved = linkage.with_parameters({"body.link1.mass": p[0], "gravity": p[1:]})
        return udk.simulate(moved, TIMES, method=method, rtol=1e-10, atol=1e-10).q[-1, 0, 2]

    p = np.array([1.2, 0.1, -9.0])
    forward, reverse, reference = (
        derivative(lambda p, m=m: angle(p, m))(p)
        for derivative, m in ((jax.jacfwd, method), (jax.grad, method), (jax.jacfwd, udk.Auto()))
    )
    assert_allclose(forward, reference, rtol=1e-8)
    assert_allclose(reverse, reference, rtol=1e-8)


def test_thresholds_are_data():
    """One program serves all thresholds. With one above all singular values, nothing holds the links, and they fall apart."""
    linkage = udk.library.parallelogram(np.deg2rad(-45))

    def end(rank_tol):
        method = udk.SVD(rank_tol=rank_tol)
        return udk.simulate(linkage, TIMES, method=method, stabilization=None, drift_tol=np.inf, throw=False).q[-1, 0]

    held, free = jax.jit(jax.vmap(end))(np.array([1e-4, 10.0]))
    assert_allclose(held, udk.simulate(linkage, TIMES).q[-1, 0], atol=1e-6)
    start = udk.assemble(linkage).q[0]
    assert_allclose(free, start + np.array([0.0, -9.81 * TIMES[-1] ** 2 / 2, 0.0]), atol=1e-6)
