"""User-defined pseudoinverses, formulations, stabilizations, integrators and step sizes."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from experiments.parts.atlas_own import BraunGoldfarb, HalfImplicit
from tests.integrate.systems.own_systems import G, pendulum

RATE = np.sqrt(G / 0.6)  # of the conical pendulum 0.6 m below its pivot
START = udk.State([0.8, 0.0, -0.6], [0.0, 0.8 * RATE, 0.0])
TS = np.linspace(0.0, 1.0, 3)
EXACT = np.stack([0.8 * np.cos(RATE * TS), 0.8 * np.sin(RATE * TS), 0 * TS - 0.6], 1)


class BenIsrael(udk.MatrixPseudoinverse):
    """D^+ by Newton's iteration X <- X (2 I - D X), at any rank."""

    def matrix(self, D):
        X = D.T / (jnp.abs(D).sum(0).max() * jnp.abs(D).sum(1).max())
        X = jax.lax.fori_loop(0, 40, lambda _, X: 2 * X - X @ D @ X, X)
        return X @ D @ X  # without rounding errors outside the range, which the iteration doubles


def test_a_pseudoinverse():
    """Penrose's conditions, the rank and the derivative at a matrix of rank two."""
    D = np.random.default_rng(0).normal(size=(4, 2)) @ np.random.default_rng(1).normal(size=(2, 5))
    method = BenIsrael()
    assert_allclose(method(D), np.linalg.pinv(D), atol=1e-10)
    assert int(method.rank(D)) == 2
    b, change = np.arange(4.0), np.random.default_rng(2).normal(size=(4, 5)) @ np.linalg.pinv(D) @ D
    change = D @ np.linalg.pinv(D) @ change  # keeps the rank
    slope = jax.jvp(lambda D: method.solve(D, b).x, (jnp.asarray(D),), (jnp.asarray(change),))[1]
    reference = jax.jvp(lambda D: udk.SVD().solve(D, b).x, (jnp.asarray(D),), (jnp.asarray(change),))[1]
    assert_allclose(slope, reference, atol=1e-9)


def angles(mass, method, **choices: Any):
    """The end of a run of a parallelogram, whose rows are redundant."""
    linkage = udk.library.parallelogram().with_parameters({"body.link1.mass": mass})
    return udk.simulate(linkage, [0.0, 0.3], method=method, rtol=1e-9, atol=1e-9, **choices).q[-1]


def test_a_pseudoinverse_in_machine_code():
    """Redundant rows, in lanes and alone, as with a method of the package."""
    masses = jnp.linspace(1.0, 2.0, 9)
    found = jax.jit(jax.vmap(lambda mass: angles(mass, BenIsrael(), engine="native")))(masses)
    for k in (0, 8):
        assert_allclose(found[k], angles(masses[k], udk.Greville()), atol=1e-8)
    assert_allclose(found[3], angles(masses[3], BenIsrael(), engine="native"), atol=1e-8)


class Decomposed(udk.MatrixPseudoinverse):
    """D^+ by a decomposition of LAPACK, as it is written first."""

    by: str = eqx.field(static=True, default="pinv")

    def matrix(self, D):
        if self.by == "pinv":
            return jnp.linalg.pinv(D)
        if self.by == "lstsq":
            return jnp.linalg.lstsq(D, jnp.eye(len(D)))[0]
        if self.by == "eigh":
            values, vectors = jnp.linalg.eigh(D @ D.T)
            is_large = values > 1e-12 * values[-1]
            return D.T @ (vectors * jnp.where(is_large, 1 / jnp.where(is_large, values, 1.0), 0.0)) @ vectors.T
        Q, R, p = jax.scipy.linalg.qr(D, mode="economic", pivoting=True)
        diagonal = jnp.abs(jnp.diagonal(R))
        used = diagonal > 1e-10 * diagonal[0]
        Z, L = jnp.linalg.qr(jnp.where(used[:, None], R, 0.0).T)
        inverse = jnp.where(used[:, None] & used, jnp.linalg.inv(L.T + jnp.diag(jnp.where(used, 0.0, 1.0))), 0.0)
        return jnp.zeros_like(D.T).at[p].set(Z @ inverse @ Q.T)


@pytest.mark.parametrize("by", ["pinv", "lstsq", "eigh", "qr"])
def test_decompositions_of_lapack_in_machine_code(by):
    """Redundant rows, in lanes and alone: the memory of both is that of one text."""
    masses = jnp.array([1.0, 1.5, 2.0])
    found = jax.jit(jax.vmap(lambda mass: angles(mass, Decomposed(by=by), engine="native")))(masses)
    assert_allclose(found[1], angles(masses[1], udk.Greville()), atol=1e-8)
    assert_allclose(found[1], angles(masses[1], Decomposed(by=by), engine="native"), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev, lambda of: jax.jacfwd(jax.jacfwd(of))])
def test_derivatives_of_a_pseudoinverse_in_machine_code(derivative):
    own, other = (derivative(lambda mass, method=method: angles(mass, method))(1.2) for method in (BenIsrael(), udk.Greville()))
    assert_allclose(own, other, rtol=1e-5, atol=1e-7)


def test_a_pseudoinverse_as_one_of_several():
    """In lanes with another method, and for the matrix of a formulation."""
    run = lambda number: angles(1.2, udk.OneOf(methods=(BenIsrael(), udk.SVD()), number=number), engine="native")  # noqa: E731
    own, other = jax.jit(jax.vmap(run))(jnp.arange(2.0))
    assert_allclose(own, other, atol=1e-8)
    linkage = udk.library.parallelogram()
    runs = [udk.simulate(linkage, [0.0, 0.3], formulation=udk.Augmented(method)) for method in (BenIsrael(), udk.SVD())]
    assert_allclose(runs[0].q, runs[1].q, atol=1e-8)
    assert runs[0].settings["engine"] == "native"


class Together(udk.PointwiseFormulation):
    """`Augmented`, written by hand."""

    def solve(self, M, F, A, c):
        matrix = jnp.block([[M, A.T], [A, jnp.zeros((len(A), len(A)))]])
        return jnp.linalg.solve(matrix, jnp.concatenate([F, c]))[: len(F)]


class Penalty(udk.PointwiseFormulation):
    """Stiff springs instead of constraints; the common stiffness of all, and a number for each row."""

    stiffness: Any
    weights: Any

    def solve(self, M, F, A, c):
        spring = A.T * (self.stiffness * self.weights[: len(A)])
        return jnp.linalg.solve(M + spring @ A, F + spring @ c)


class AlongNullSpace(udk.NullSpaceQR):
    """Derived from a formulation of the package, but with accelerations of its own."""

    def solve(self, M, F, A, c):
        return Together().solve(M, F, A, c)


def corners(mass, formulation, **choices: Any):
    """The end of a run of a four-bar."""
    linkage = udk.library.four_bar()
    linkage = linkage.with_parameters({f"body.{linkage.body_names[0]}.mass": mass})
    return udk.simulate(linkage, [0.0, 0.5], formulation=formulation, rtol=1e-9, atol=1e-9, **choices).q[-1]


def test_a_formulation_in_machine_code():
    """In lanes and alone, as the formulation of the package that it copies."""
    masses = jnp.linspace(1.0, 2.0, 9)
    found = jax.jit(jax.vmap(lambda mass: corners(mass, Together(), engine="native")))(masses)
    for k in (0, 8):
        assert_allclose(found[k], corners(masses[k], udk.Augmented()), atol=1e-10)
    assert_allclose(found[3], corners(masses[3], Together(), engine="native"), atol=1e-10)
    assert_allclose(found[3], corners(masses[3], AlongNullSpace(), engine="native"), atol=1e-10)


def softly(stiffness, engine="native"):
    """The end of a run by penalties, which is not projected."""
    return corners(1.0, Penalty(stiffness, jnp.arange(1.0, 21.0)), engine=engine, stabilization=None)


def test_numbers_of_a_formulation_in_machine_code():
    """They differ between members, which share the code; a stiffer penalty is closer to the constraints."""
    found = jax.jit(jax.vmap(softly))(jnp.array([1e4, 1e6]))
    errors = np.abs(found - corners(1.0, None)).max(axis=(1, 2))
    assert errors[1] < 0.1 * errors[0]


@pytest.mark.slow
def test_an_inexact_formulation_is_the_same_in_machine_code():
    assert_allclose(softly(jnp.array(1e4)), softly(jnp.array(1e4), engine="jax"), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev, lambda of: jax.jacfwd(jax.jacfwd(of))])
def test_derivatives_of_a_formulation_in_machine_code(derivative):
    own, other = (derivative(lambda mass, f=f: corners(mass, f))(1.2) for f in (Together(), udk.Augmented()))
    assert_allclose(own, other, rtol=1e-9, atol=1e-9)


class BySchurVectors(udk.PointwiseFormulation):
    power: Any = None

    def solve(self, M, F, A, c):
        return jax.scipy.linalg.schur(M)[1] @ F


class OfWrongShape(udk.PointwiseFormulation):
    def solve(self, M, F, A, c):
        return c


@pytest.mark.parametrize(
    ("formulation", "reason"),
    [
        (BySchurVectors(), "the operation schur of the formulation BySchurVectors"),
        (BySchurVectors(np.arange(2)), "arrays of type int64 of the formulation BySchurVectors"),
        (OfWrongShape(), "the formulation OfWrongShape"),
    ],
)
def test_a_formulation_without_machine_code(formulation, reason):
    with pytest.raises(ValueError, match=reason):
        corners(1.0, formulation, engine="native")


def test_a_formulation_of_a_system_whose_masses_couple():
    """It receives M itself, and not the coordinates in which M is diagonal."""
    mass = jnp.array([[2.0, 1.0], [1.0, 3.0]])
    system = udk.ConstrainedSystem(lambda q: mass, force=lambda t, q, v: -q, constraint=lambda t, q: q @ q - 2.0)
    runs = [udk.simulate(system, TS, udk.State([1.0, 1.0], [-0.5, 0.5]), formulation=f) for f in (Together(), None)]
    assert "a mass matrix that is not diagonal" in runs[0].settings["engine"]
    assert_allclose(runs[0].q, runs[1].q, atol=1e-6)


class OfSchurForm(udk.MatrixPseudoinverse):
    def matrix(self, D):
        T, Z = jax.scipy.linalg.schur(D @ D.T)
        return D.T @ Z @ jnp.linalg.pinv(jnp.diag(jnp.diagonal(T))) @ Z.T


class WithArray(BenIsrael):
    scale: Any = None


class OfOneShape(udk.MatrixPseudoinverse):
    def matrix(self, D):
        return jnp.linalg.pinv(D) @ jnp.eye(12)


@pytest.mark.parametrize(
    ("method", "reason"),
    [
        (OfSchurForm(), "the operation schur of the pseudoinverse OfSchurForm"),
        (WithArray(scale=jnp.array(2.0)), "arrays other than rank_tol of the pseudoinverse WithArray"),
        (OfOneShape(), "OfOneShape"),
    ],
)
def test_a_pseudoinverse_without_machine_code(method, reason):
    with pytest.raises(ValueError, match=reason):
        angles(1.0, method, engine="native")


class ThreeTimes(udk.PointwiseFormulation):
    """Accelerations by block elimination, for independent rows."""

    def solve(self, M, F, A, c):
        mobility = jnp.linalg.solve(M, A.T)
        free = jnp.linalg.solve(M, F)
        return free + mobility @ jnp.linalg.solve(A @ mobility, c - A @ free)


class Radial(udk.Stabilization):
    """Scales positions to the sphere, and removes the radial velocity: for the pendulum alone."""

    length: jax.Array

    def end_of_step(self, at):
        q = self.length * at.q / jnp.linalg.norm(at.q)
        return q, at.v - q * (q @ at.v) / self.length**2


def run(**choices: Any) -> udk.Solution:
    settings: Any = {"rtol": 1e-7, "atol": 1e-7} | choices
    return udk.simulate(pendulum(), TS, START, **settings)


CONSTANT = {"stepsize_controller": diffrax.ConstantStepSize()}


@pytest.mark.parametrize(
    ("choices", "error", "gap"),
    [
        pytest.param({"stabilization": BraunGoldfarb()}, 1e-6, 1e-6, id="rates"),
        pytest.param({"stabilization": Radial(jnp.array(1.0))}, 1e-5, 1e-6, id="end of step", marks=pytest.mark.slow),
        pytest.param({"method": BenIsrael()}, 1e-6, 1e-14, id="pseudoinverse", marks=pytest.mark.slow),
        pytest.param({"formulation": ThreeTimes()}, 1e-6, 1e-14, id="formulation", marks=pytest.mark.slow),
        pytest.param({"solver": diffrax.Dopri5(), "dt0": 0.01, **CONSTANT}, 1e-8, 1e-14, id="constant", marks=pytest.mark.slow),
        pytest.param(
            {"stepsize_controller": diffrax.PIDController(1e-8, 1e-8)}, 1e-6, 1e-14, id="controller", marks=pytest.mark.slow
        ),
    ],
)
def test_runs(choices, error, gap):
    """The exact conical motion, and the length of the rod."""
    found = run(**choices)
    assert found.settings["engine"].startswith("native" if {*choices} & {"method", "formulation", "stabilization"} else "diffrax")
    assert_allclose(found.q, EXACT, atol=error)
    assert_allclose(udk.violation(pendulum(), found), 0.0, atol=gap)


@pytest.mark.slow
def test_an_integrator_of_first_order():
    errors = [np.abs(run(solver=HalfImplicit(), dt0=h, **CONSTANT).q - EXACT).max() for h in (4e-3, 2e-3)]
    assert_allclose(errors[0] / errors[1], 2.0, rtol=0.05)


@pytest.mark.slow
def test_derivatives_and_batches_of_a_stabilization():
    """By a number of the stabilization, against differences, and in a batch; a mechanism takes it as well."""
    ends = lambda length: run(stabilization=Radial(length), stepsize_controller=diffrax.ConstantStepSize(), dt0=0.02).q[-1]  # noqa: E731
    slope, h = jax.jit(jax.jacfwd(ends))(1.0), 1e-5
    assert_allclose(slope, (ends(jnp.array(1.0 + h)) - ends(jnp.array(1.0 - h))) / (2 * h), atol=1e-6)
    assert_allclose(jax.jit(jax.vmap(ends))(jnp.array([0.99, 1.0]))[1], ends(jnp.array(1.0)), atol=1e-12)
    linkage = udk.library.parallelogram()
    stabilized = udk.simulate(linkage, TS, stabilization=BraunGoldfarb())
    assert_allclose(stabilized.q, udk.simulate(linkage, TS).q, atol=1e-6)


def test_mistakes():
    with pytest.raises(ValueError, match="constant steps need their length"):
        run(**CONSTANT)
    with pytest.raises(ValueError, match="constant steps, stepsize_controller"):
        run(solver=HalfImplicit())
    stop = udk.Event(lambda t, q, v: q[0], udk.Stop())
    with pytest.raises(ValueError, match="not a stabilization of your own"):
        run(stabilization=BraunGoldfarb(), events=stop)
    assert eqx.is_array(Radial(jnp.array(1.0)).length)
