"""Accelerations and multipliers, compared with exact solutions, other formulations, and the principles that they satisfy."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.choices import fast
from tests.textbook import terms
from udkjax.equations import constraints, loads, prepare
from udkjax.programs.deferred import deferred

CLASSES = (udk.Auto, udk.SVD, udk.Varga, udk.Greville, udk.Householder, udk.GramSchmidt, udk.Elimination)
METHODS = {cls.__name__: cls() for cls in CLASSES}


# --- the paper's linkage


@deferred
def along(mechanism, q, v, method):
    return jax.vmap(lambda q, v: udk.accelerations(mechanism, 0.0, q, v, method, multipliers=True))(q, v)


IN_LINE = np.array([0.0, 0.0, np.pi, np.pi, 1e-9]), np.array([0.0, 2.0, 0.0, -3.0, 1.0])


@pytest.fixture(scope="module", params=fast(["Auto", "Varga"], METHODS))
def moved(request, linkage, placed, data):
    """The linkage by each method, at generic angles, in line, and where reactions are known."""
    angles = np.concatenate([np.linspace(-3.0, -0.15, 12), np.linspace(0.15, 3.0, 12)])
    known = reference(data, "rest_-50deg")
    states = [[x.ravel() for x in np.meshgrid(angles, [0.0, -1.0, 7.0])], IN_LINE, (known["theta"], known["thetad"])]
    theta, rate = (np.concatenate(x) for x in zip(*states, strict=True))
    q, v = jax.vmap(placed)(theta, rate)
    found = along(linkage, q, v, METHODS[request.param])
    ends = np.cumsum([len(x) for x, _ in states])[:-1]
    parts = zip(*(np.split(np.asarray(x), ends) for x in (theta, rate, *found)), strict=True)
    return request.param, dict(zip(("ordinary", "in line", "known"), parts, strict=True))


def test_the_linkage_moves_as_its_exact_equation_says(moved):
    """3.05 theta'' = -3.5 g cos(theta), at any angular velocity and at any angle except the two where all links are in line."""
    theta, rate, a, _ = moved[1]["ordinary"]
    exact = -3.5 * 9.81 * np.cos(theta) / 3.05
    assert_allclose(a[:, :3, 2], np.stack([exact] * 3, 1), atol=1e-11)
    assert_allclose(a[:, 3, 2], 0.0, atol=1e-11)
    tip = np.stack([-np.sin(theta) * exact - np.cos(theta) * rate**2, np.cos(theta) * exact - np.sin(theta) * rate**2], 1)
    assert_allclose(a[:, 3, :2], tip, atol=1e-11)
    assert_allclose(a[:, 0, :2], tip / 2, atol=1e-11)


def test_in_line_too(moved):
    """The rank is then 10, and the minimum-norm solution follows the parallelogram; Elimination makes no promise."""
    name, found = moved
    if name == "Elimination":
        return
    theta, _, a, _ = found["in line"]
    assert_allclose(a[:, :3, 2], np.stack([-3.5 * 9.81 * np.cos(theta) / 3.05] * 3, 1), atol=1e-10)


@pytest.mark.parametrize("method", [udk.Auto(), udk.SVD(), udk.GramSchmidt()], ids=["Auto", "SVD", "GramSchmidt"])
@pytest.mark.parametrize("ratio", [1.0, 1e4, 1e8, 1e10])
def test_a_light_rod_carries_a_heavy_one(method, ratio):
    """Two equations in the angles from hanging, solved with a determinant whose terms are all positive."""
    s1, s2, w1, w2 = 0.4, -0.7, 1.0, 0.5
    mech = udk.library.double_pendulum((s1, s2), (w1, w2), (1.0, 1.0), (1.0, ratio))
    sin, cos, g = np.sin(s1 - s2), np.cos(s1 - s2), 9.81
    upper, lower, both = 1 / 3, ratio / 3, ratio / 2
    h1 = -both * sin * w2**2 - (0.5 + ratio) * g * np.sin(s1)
    h2 = both * sin * w1**2 - ratio / 2 * g * np.sin(s2)
    determinant = upper * lower + ratio**2 * (1 / 12 + sin**2 / 4)
    exact = [(lower * h1 - both * cos * h2) / determinant, ((upper + ratio) * h2 - both * cos * h1) / determinant]
    a = udk.accelerations(mech, 0.0, mech.q0, mech.v0, method)
    assert_allclose(a[:, 2], exact, rtol=1e-13 * max(ratio, 100.0) ** 0.5)


def reference(data, case):
    rows = data("seed_fivebar_parallelogram")["cases"][case]["reference"].values()
    return {key: np.array([np.asarray(row[key], float) for row in rows]) for key in next(iter(rows))}


@pytest.mark.parametrize("case", ["rest_-50deg", "rest_-45deg", "rest_0deg_collinear", "rest_+45deg_crosses", "up_thd-1_rotates"])
def test_reactions_of_minimum_norm(linkage, placed, data, case):
    known = reference(data, case)
    q, v = jax.vmap(placed)(known["theta"], known["thetad"])
    loads = udk.reactions(linkage, SimpleNamespace(ts=jnp.zeros(len(q)), q=q, v=v))
    for k in "123":
        link = loads["B" + k]["link" + k]
        assert_allclose(link[:, :2], known["coupler_joint_force_on_link"], atol=1e-11)
        assert_allclose(loads["A" + k]["link" + k][:, :2], known["ground_joint_force_on_link"], atol=1e-11)
        assert_allclose(loads["B" + k]["coupler"][:, :2], -link[:, :2], atol=1e-13)
        arm = q[:, 0, :2]  # from the pivot of link 1 to its centre, and from there to the tip
        assert_allclose(link[:, 2], arm[:, 0] * link[:, 1] - arm[:, 1] * link[:, 0], atol=1e-11)


def test_multipliers_are_those_reactions_for_every_method(moved, data):
    """The multiplier lambda of a pin acts on the link, body 2, as -lambda, with M a + Psi_q^T lambda = F; no self-stress."""
    known = reference(data, "rest_-50deg")
    theta, _, a, multipliers = moved[1]["known"]
    assert a.shape[1:] == (4, 3)
    expected = np.concatenate([known["ground_joint_force_on_link"]] * 3 + [known["coupler_joint_force_on_link"]] * 3, 1)
    assert_allclose(-multipliers, expected, atol=1e-11)
    axial = np.stack([f * e for f in (1, -2, 1) for e in (np.cos(theta), np.sin(theta))], 1) / np.sqrt(12)
    assert_allclose(np.sum(multipliers * np.hstack([axial, -axial]), 1), 0.0, atol=1e-12)


# --- principles


def test_a_constraint_said_many_times_changes_nothing(data):
    """Each copy of the pin carries its share."""
    single = udk.library.compound_pendulum()
    pin = single.joints["pin"]
    triple = udk.Mechanism(single.bodies, {f"pin{k}": pin for k in range(3)})
    one, three = (udk.accelerations(m, 0.0, m.q0, m.v0, multipliers=True) for m in (single, triple))
    assert_allclose(three[0], one[0], atol=1e-13)
    assert_allclose(three[1], jnp.tile(one[1] / 3, 3), atol=1e-13)
    known = data("compound_pendulum")["reference"]["0"]
    assert_allclose(-one[1], [float(known["Rx"]), float(known["Ry"])], rtol=1e-13)


# --- stabilization


@pytest.mark.parametrize("method", [METHODS["Auto"], METHODS["SVD"]], ids=["Auto", "SVD"])
def test_baumgarte_feeds_the_violation_back(method):
    """Psi_q a = gamma - 2 alpha Psi_dot - beta^2 Psi away from the manifold, where rows are independent."""
    mech, random = udk.library.four_bar(), np.random.default_rng(5)
    q, v = (x + 0.1 * random.standard_normal(x.shape) for x in (mech.q0, mech.v0))
    t, gains = jnp.array(0.0), udk.Baumgarte(3.0, 7.0)
    a = udk.accelerations(mech, t, q, v, method, gains).ravel()
    psi, A, psi_dot, gamma, *_ = terms(mech, t, q, v)
    assert_allclose(A @ a, gamma - 6.0 * psi_dot - 49.0 * psi, atol=1e-10)
    plain = udk.accelerations(mech, t, q, v, method)
    assert_allclose(udk.accelerations(mech, t, q, v, method, udk.Baumgarte(0.0, 0.0)), plain, atol=1e-11)
    assert jnp.abs(a - plain.ravel()).max() > 0.1


# --- projection


@pytest.fixture(scope="module")
def nearby():
    """States that are closed to about 1e-7."""

    def states(name, count=4):
        mech, random = getattr(udk.library, name)(), np.random.default_rng(6)
        q, v = (np.asarray(x).ravel() + 1e-7 * random.standard_normal((count, x.size)) for x in (mech.q0, mech.v0))
        return mech, jnp.asarray(q), jnp.asarray(v)

    return states


@pytest.mark.parametrize("name", ["parallelogram", "slider_crank"])
def test_projection_is_the_smallest_change(nearby, name):
    mech, qs, vs = nearby(name)
    equations, t = prepare(mech), jnp.array(0.0)

    @deferred
    def project(q, v):
        q, v = equations.project(t, q, v)
        return q, v, *equations.violation(t, q, v), constraints.psi_q(mech, t, q)

    q, v, psi, psi_dot, A = project(qs[0], vs[0])
    assert_allclose(psi, 0.0, atol=1e-15 * 40)
    assert_allclose(psi_dot, 0.0, atol=1e-14 * 40)
    mass = np.asarray(loads.mass(mech))
    _, sigma, vt = np.linalg.svd(A)
    for moved in (q - qs[0], v - vs[0]):
        assert_allclose(vt[np.sum(sigma > 1e-6) :] @ (mass * moved), 0.0, atol=1e-11)


def test_the_tangential_part_is_what_projection_leaves(nearby):
    """Compare small changes of a closed state with the projection itself, which is linear in velocities."""
    mech, (q, *_), (v, *_) = nearby("parallelogram")
    dq, dv = 1e-7 * np.random.default_rng(3).standard_normal((2, len(q)))

    @deferred
    def parts(mech, q, v, dq, dv):
        equations, t = prepare(mech), 0.0
        q, v = equations.project(t, *equations.project(t, q, v))
        left = equations.tangent_part(t, q, v, dq, dv)
        moved = equations.project(t, q + dq, v)[0] - q, equations.project(t, q, v + 1e7 * dv)[1] - v
        return left, moved, equations.tangent_part(t, q, v, *left)

    (left_q, left_v), (moved_q, moved_v), again = parts(mech, q, v, dq, dv)
    assert_allclose(left_q, moved_q, atol=1e-12)
    assert_allclose(1e7 * left_v, moved_v, atol=1e-11)
    assert_allclose(again, (left_q, left_v), atol=1e-18)
    assert jnp.abs(left_q - dq).max() > 1e-8  # something is taken back


# --- few constraints, and more than there seemed


def test_bodies_without_constraints_fall_freely():
    bodies = {"one": udk.Body(2.0, 0.3, [0.1, 0.2], 0.3), "two": udk.Body(1.0, 0.1, [1.0, -0.5], 0.0, [1.0, 2.0], 3.0)}
    forces = [udk.Spring(["one", "two"], [[0.1, 0.0], [0.0, 0.1]], 20.0, 0.5, 0.3), udk.Torque(["ground", "one"], 0.6)]
    mech = udk.Mechanism(bodies, forces=forces)
    assert udk.analyse(mech).redundant_rows == ()

    @deferred
    def by_all(q, v):
        solved = [udk.accelerations(mech, 0.0, q, v, method, multipliers=True) for method in METHODS.values()]
        return solved, loads.force(mech, 0.0, q.ravel(), v.ravel())

    found, force = by_all(mech.q0, mech.v0)
    for a, multipliers in found:
        assert_allclose(a.ravel(), force / loads.mass(mech), atol=1e-13)
        assert multipliers.shape == (0,)
    empty = udk.Mechanism(bodies)
    assert_allclose(udk.accelerations(empty, 0.0, empty.q0, empty.v0), [[0.0, -9.81, 0.0]] * 2, atol=1e-15)
    still = SimpleNamespace(ts=jnp.zeros(1), q=empty.q0[None], v=empty.v0[None])
    assert udk.reactions(empty, still) == {} and udk.violation(empty, still).shape == (1, 0)


def test_a_body_that_nothing_holds_beside_a_linkage(linkage):
    mech = udk.Mechanism({"stray": udk.Body(1.0, 1.0, [5.0, 5.0]), **linkage.bodies}, linkage.joints)
    a = udk.accelerations(mech, 0.0, mech.q0, mech.v0)
    assert_allclose(a[0], [0.0, -9.81, 0.0], atol=1e-13)
    assert_allclose(a[1:], udk.accelerations(linkage, 0.0, linkage.q0, linkage.v0), atol=1e-12)


def changed(mechanism, length):
    """One crank of the linkage with another length: its twelve rows become independent, and it can no longer move."""
    return mechanism.with_parameters({"joint.A3.points[1][0]": -0.5 * length, "joint.B3.points[1][0]": 0.5 * length})


def test_rows_left_out_that_become_independent_count_again(linkage):
    mech = changed(linkage, 1.2)
    other = udk.analyse(linkage)
    assert other.redundant_rows and not udk.analyse(mech).redundant_rows
    state = udk.assemble(mech)
    given = mech, 0.0, state.q, state.v
    a, expected = (udk.accelerations(*given, method, analysis=other) for method in (udk.Auto(), udk.SVD()))
    assert_allclose(a, expected, atol=1e-10)
    assert jnp.abs(a).max() < 1e-9  # it cannot move


def test_also_when_numbers_are_traced(linkage):
    @deferred
    def pair(length):
        mech = changed(linkage, length)
        state = udk.assemble(mech)
        return [udk.accelerations(mech, 0.0, state.q, state.v, method) for method in (udk.Auto(), udk.SVD())]

    for length in (1.2, 1.4):
        a, expected = pair(length)
        assert_allclose(a, expected, atol=1e-10)
        assert jnp.abs(a).max() < 1e-9
    a, expected = pair(1.0)
    assert_allclose(a, expected, atol=1e-10)
    assert jnp.abs(a).max() > 1.0


def test_a_mechanism_made_of_traced_numbers():
    """Its independent rows are unknown, so singular values are used throughout."""

    @jax.jit
    def angular(angle):
        mech = udk.library.parallelogram(angle)
        assert udk.analyse(mech).redundant_rows is None
        return udk.accelerations(mech, 0.0, mech.q0, mech.v0)[0, 2]

    for angle in (-0.9, 0.7):
        assert_allclose(angular(angle), -3.5 * 9.81 * np.cos(angle) / 3.05, atol=1e-11)


# --- derivatives


def test_derivatives_of_accelerations(linkage, placed):
    """d(theta'')/d(theta), the derivative with respect to a mass in the exact equation, and second derivatives."""

    def angular(theta, mass):
        mech = linkage.with_parameters({"body.coupler.mass": mass})
        q, v = placed(theta, 1.3)
        return udk.accelerations(mech, 0.0, q, v, udk.SVD())[1, 2]

    def exact(theta, mass):
        return -(1.5 + mass) * 9.81 * jnp.cos(theta) / (1.05 + mass)

    def derivatives(function, *at):
        return jnp.stack(jax.grad(function, (0, 1))(*at)), jnp.array(jax.hessian(function, (0, 1))(*at))

    at = (jnp.array(-0.8), jnp.array(2.0))
    for found, known in zip(*(deferred(partial(derivatives, f))(*at) for f in (angular, exact)), strict=True):
        assert_allclose(found, known, atol=1e-9)
