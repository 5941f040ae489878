"""The other formulations agree with the Udwadia-Kalaba equation where it is regular, and differ as documented elsewhere."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.equations import equations_of
from udkjax.equations.laws.formulations import solve_regular
from udkjax.programs.deferred import deferred

LU = udk.Augmented()
ROBUST = {
    "Augmented, SVD": udk.Augmented(udk.SVD()),
    "NullSpaceQR": udk.NullSpaceQR(),
    "NullSpaceSVD": udk.NullSpaceSVD(),
    "CoordinatePartitioning": udk.CoordinatePartitioning(),
}
ALL = {"Augmented": LU, **ROBUST}


def but_slow(names):
    return [pytest.param(name, marks=pytest.mark.slow) for name in names.split()]


# In the fast tests: the driven double pendulum below.
REGULAR = but_slow("slider_crank driven_pendulum simple_pendulum compound_pendulum double_pendulum four_bar elliptic_trammel")
REDUNDANT = but_slow("parallelogram n_four_bar scissor_lift peaucellier planetary_gear")
T0 = jnp.array(0.0)


def mechanism(name):
    return getattr(udk.library, name)()


@deferred  # all of them in one program, which evaluates what they share once
def all_of(mech, t, q, v, formulations, baumgarte=None):
    """Accelerations by the Udwadia-Kalaba equation and by each formulation."""
    solve = lambda f: equations_of(mech, udk.SVD(), baumgarte, f).accelerations(t, q, v)  # noqa: E731
    return solve(None), {name: solve(f) for name, f in formulations.items()}


def agree(reference, found, tol=1e-10):
    for name, a in found.items():
        assert_allclose(a, reference, rtol=0, atol=tol * max(1.0, float(jnp.abs(reference).max())), err_msg=name)


# --- the same function


@pytest.mark.parametrize("name", REGULAR)
def test_regular_mechanisms(name, closed):
    """Including driven ones."""
    mech = mechanism(name)
    q, v = closed(mech)
    agree(*all_of(mech, T0, q, v, ALL))


def test_off_the_manifold_and_with_gains(closed):
    """All of them have Baumgarte's terms on the right-hand side, except partitioning, which closes each state."""
    mech = mechanism("compound_pendulum")
    q, v = closed(mech)
    shift = jnp.asarray(np.random.default_rng(1).standard_normal((2, len(q)))) * 1e-2
    solved = {k: f for k, f in ALL.items() if k != "CoordinatePartitioning"}
    reference, found = all_of(mech, jnp.array(0.3), q + shift[0], v + shift[1], solved, udk.Baumgarte(3.0, 4.0))
    agree(reference, found)
    without, _ = all_of(mech, jnp.array(0.3), q + shift[0], v + shift[1], {})
    assert jnp.abs(reference - without).max() > 1e-2


@pytest.mark.parametrize("name", REDUNDANT)
def test_redundant_mechanisms(name, closed):
    mech = mechanism(name)
    q, v = closed(mech)
    agree(*all_of(mech, T0, q, v, ROBUST))


def driven(forces):
    """A double pendulum, its upper rod driven and its lower one free."""
    bare = udk.library.double_pendulum(angles=(np.pi / 2, 0.3))
    return udk.Mechanism(
        bare.bodies, bare.joints, {"motor": udk.Driver(("ground", "upper"), "angle", udk.Sine(0.8, 3.0))}, forces
    )


SPRING = {"spring": udk.Spring(["ground", "lower"], [[0.3, 0.5], [0.1, 0.0]], stiffness=40.0, length=0.2, damping=3.0)}


@pytest.mark.slow
def test_a_driver_and_force_elements(kkt, closed):
    """Compared with the KKT equations in plain form."""
    mech = driven(SPRING)
    q, v = closed(mech)
    reference, found = all_of(mech, T0, q, v, ALL)
    agree(reference, found)
    assert_allclose(reference, kkt(mech, T0, q, v)[0], atol=1e-9 * np.abs(reference).max())
    assert np.abs(reference - kkt(driven(None), T0, q, v)[0]).max() > 1.0


def test_without_constraints():
    stone = udk.Mechanism({"stone": udk.Body(2.0, 0.1, [0.0, 1.0], 0.3)})
    reference, found = all_of(stone, T0, stone.q0.ravel(), stone.v0.ravel(), ALL)
    assert_allclose(reference, [0.0, -9.81, 0.0])
    agree(reference, found)


class Ball(eqx.Module):
    """A point mass on a sphere, in coordinates with a full mass matrix; the constraint is given `copies` times."""

    copies: int = eqx.field(static=True, default=1)

    def system(self):
        mass = jnp.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 3.0]])
        gravity = jnp.array([0.0, 0.0, -9.81])
        return udk.ConstrainedSystem(
            lambda q: mass * (1 + q[0] ** 2),
            lambda t, q, v: gravity - 0.1 * v,
            lambda t, q: jnp.tile(q @ q - 1.0 - 0.1 * jnp.sin(t), self.copies),
            lambda t, q, v: v[:1] - 0.2 * v[1:2],
        )


def test_systems_of_the_users_own():
    """With one constraint by plain LU, and with three copies of it by the formulations that can handle copies."""
    q, v = jnp.array([0.6, 0.1, -0.8]), jnp.array([0.2, 1.0, 0.3])
    for copies, formulations in ((1, {"Augmented": LU}), (3, ROBUST)):
        agree(*all_of(Ball(copies).system(), T0, q, v, formulations))


def test_what_partitioning_refuses():
    with pytest.raises(ValueError, match="takes no Baumgarte stabilization"):
        equations_of(mechanism("four_bar"), None, udk.Baumgarte(), udk.CoordinatePartitioning())


# --- redundant rows, and singular configurations: the paper's linkage


def test_a_pivot_of_plain_LU_that_is_a_rounding_error_counts_as_zero(linkage, placed):
    """Rank 23 of 24. A body as light as rounding, which nothing constrains, has a pivot as small that is right."""
    q, v = (x.ravel() for x in placed(-0.8, 1.3))

    @deferred
    def factorized(q, v):
        M, _, A, _ = equations_of(linkage, udk.SVD()).matrices(T0, q, v)
        matrix = jnp.block([[M, A.T], [A, jnp.zeros((12, 12))]])
        return matrix, jax.scipy.linalg.lu(matrix)[2]

    matrix, upper = factorized(q, v)
    assert np.linalg.matrix_rank(matrix) == 23
    pivots = np.sort(np.abs(np.diag(upper)))
    assert pivots[0] < 1e-14 < 1e-2 < pivots[1]
    assert not np.any(np.isfinite(solve_regular(matrix, jnp.ones(24))))
    light = jnp.diag(jnp.array([1.0, 1e-20]))
    assert_allclose(solve_regular(light, jnp.ones(2)), [1.0, 1e20])


def test_and_by_nothing_where_a_joint_is_given_twice():
    """The pivot is then exactly zero. The other formulations recognize the copy."""
    single = mechanism("compound_pendulum")
    double = udk.Mechanism(single.bodies, {"pin": single.joints["pin"], "again": single.joints["pin"]})
    q, v = single.q0.ravel(), jnp.array([0.3, 0.1, 0.0])
    v = deferred(lambda q, v: equations_of(single, udk.SVD()).project(T0, q, v)[1])(q, v)
    reference, found = all_of(double, T0, q, v, ALL)
    assert not np.any(np.isfinite(found.pop("Augmented")))
    agree(reference, found)
    assert_allclose(reference, all_of(single, T0, q, v, {})[0], atol=1e-12)


def test_in_line(linkage, placed):
    """All links in line, turning: the rank is 10, and the accelerations are still those of the parallelogram."""
    q, v = (x.ravel() for x in placed(0.0, 1.3))
    reference, found = all_of(linkage, T0, q, v, ROBUST)
    assert_allclose(reference[2:9:3], -3.5 * 9.81 / 3.05, atol=1e-9)
    agree(reference, found)


# --- derivatives


@pytest.mark.slow
@pytest.mark.parametrize("name", ["CoordinatePartitioning", "Augmented", "NullSpaceQR", "NullSpaceSVD"])
def test_derivatives(name, closed):
    """With respect to time, state, masses and loads, forward and reverse, compared with differences; and second derivatives."""
    mech, formulation = driven(SPRING), ALL[name]
    q, v = closed(mech)

    def f(x):
        varied = mech.with_parameters({"gravity": x[:2], "body.lower.mass": x[2], "force.spring.stiffness": x[3]})
        return equations_of(varied, udk.Auto(), None, formulation).accelerations(x[4], q + x[5] * v, v + x[6])

    x, h = jnp.array([0.3, -9.0, 1.3, 35.0, 0.1, 0.0, 0.0]), 1e-5
    direction = jnp.asarray(np.random.default_rng(2).standard_normal(len(x)))
    weights = jnp.cos(jnp.arange(6.0))

    @deferred
    def taylor(s):
        slope = lambda s: jax.jvp(lambda s: f(x + s * direction), (s,), (jnp.ones(()),))  # noqa: E731
        return jax.jvp(slope, (s,), (jnp.ones(()),))

    ((_, forward), (_, second)), ahead, behind = (taylor(jnp.array(s)) for s in (0.0, h, -h))
    for found, a, b in zip((forward, second), ahead[0], behind[0], strict=True):
        assert_allclose(found, (a - b) / (2 * h), rtol=0, atol=1e-6 * float(jnp.abs(found).max()))
    assert_allclose(deferred(jax.grad(lambda x: weights @ f(x)))(x) @ direction, weights @ forward, rtol=1e-9)


# --- completion of a partitioned state


def partitioned(mechanism, t, q, v):
    """The equations with the partition chosen at a state, and the mask of independent coordinates."""
    equations = equations_of(mechanism, None, None, udk.CoordinatePartitioning())
    held = deferred(lambda e, t, q, v: e.fix_partition(t, q, v))(equations, t, q, v)
    assert held.independent is not None
    independent, of_velocities = jnp.split(held.independent, 2)
    assert (independent == of_velocities).all()
    return held, independent


@deferred
def project_state(equations, q, v):
    return equations.project(T0, q, v)


def test_the_dependent_follow_from_the_independent(linkage, placed):
    """Dependent coordinates are moved by up to 0.05: Newton's method restores them; independent ones do not change."""
    q, v = (x.ravel() for x in placed(-0.8, 1.3))
    held, independent = partitioned(linkage, T0, q, v)
    assert int(independent.sum()) == 1
    off = jnp.where(independent, 0.0, 0.05 * jnp.cos(jnp.arange(12.0)))
    closed, rate = project_state(held, q + off, v + 10 * off)
    assert_allclose(closed, q, atol=1e-13)
    assert_allclose(rate, v, atol=1e-12)
    assert (closed == q)[independent].all() and (rate == v)[independent].all()


def test_a_guess_too_far_away_is_not_a_number(linkage, placed):
    q, v = (x.ravel() for x in placed(-0.8, 1.3))
    held, independent = partitioned(linkage, T0, q, v)
    off = jnp.where(independent, 0.0, 0.4 * jnp.cos(jnp.arange(12.0)))
    rates = deferred(lambda e, q, v: jnp.concatenate(e.rates(T0, q, v)))
    assert np.isnan(rates(held, q + off, v)).any()
    assert np.isfinite(rates(held, q + 0.1 * off, v)).all()


def test_completion_has_derivatives(linkage, placed):
    """Along the independent coordinate the derivative is that of the parallelogram; along dependent ones it is zero."""
    angle = jnp.array(-0.8)
    pose = lambda s: jnp.concatenate([x.ravel() for x in placed(s, 1.3)])  # noqa: E731
    y = pose(angle)
    held, independent = partitioned(linkage, T0, *jnp.split(y, 2))
    project = lambda y: jnp.concatenate(held.project(T0, *jnp.split(y, 2)))  # noqa: E731
    jacobian, backward = deferred(lambda y: (jax.jacfwd(project)(y), jax.jacrev(project)(y)))(y)
    along = jax.jvp(pose, (angle,), (jnp.ones(()),))[1]
    assert_allclose(jacobian @ along, along, atol=1e-11)
    dependent = jnp.tile(~independent, 2)
    assert_allclose(jacobian[:, dependent], 0.0, atol=1e-11)
    assert_allclose(backward, jacobian, atol=1e-11)


def test_partitioning_keeps_the_rod_of_a_point_mass():
    bob = udk.Mechanism(
        {"bob": udk.Body(1.0, 1e-12, [0.6, -0.8], np.arcsin(0.6))},
        {"O": udk.Revolute(["ground", "bob"], [[0.0, 0.0], [0.0, 1.0]])},
    )
    a = udk.accelerations(bob, 0.0, bob.q0, bob.v0, formulation=udk.CoordinatePartitioning())
    assert_allclose(a[0], -9.81 * 0.6 * np.array([0.8, 0.6, 1.0]), rtol=1e-6)
