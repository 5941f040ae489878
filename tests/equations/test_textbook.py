"""The textbook against what must hold of it, and the programs against the textbook, in every scene of the library.

Every type of joint, driver and force element is held against it in test_scene_programs.py.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.choices import fast
from tests.run_programs import dense, evaluate_programs
from udkjax.equations import constraints, loads, prepare
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.terms.structure import numbers_as_vector
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.programs.deferred import deferred

SVD = udk.SVD(1e-9)
T0 = jnp.array(0.3)


# Pins, slides, wheels and a driver, and redundant rows; each type of element: test_scene_programs.py.
CHOSEN = "driven_pendulum", "slider_crank", "parallelogram", "planetary_gear"


def scene(name):
    return getattr(udk.library, name)()


@pytest.fixture(scope="module", params=fast(CHOSEN, udk.library.__all__))
def moved(request):
    """A scene, and a state off its manifold."""
    mech = scene(request.param)
    random = np.random.default_rng(3)
    q, v = (jnp.asarray(np.ravel(x) + 0.03 * random.standard_normal(np.size(x))) for x in (mech.q0, mech.v0))
    return mech, q, v


@deferred
def _textbook(mech, t, q, v, method, baumgarte, w):
    names = {"psi": constraints.psi(mech, t, q), "psi_q": constraints.psi_q(mech, t, q)}
    names |= {"psi_dot": constraints.psi_dot(mech, t, q, v), "gamma": constraints.gamma(mech, t, q, v)}
    names |= {"M": loads.mass(mech), "F": loads.force(mech, t, q, v)}
    names |= {"T": loads.kinetic_energy(mech, v), "V": loads.potential_energy(mech, t, q, v)}
    names["a"] = uk.accelerations(mech, t, q, v, method, baumgarte, w)
    names["lambda"] = uk.multipliers(mech, t, q, v, method, baumgarte, w)
    return names


def textbook(mech, q, v, method=SVD, gains=(0.0, 0.0), w=None, t=T0):
    """All terms, by one program for each scene: rows of weight one, and gains of zero, are what they are by default."""
    w = np.ones(len(constraints.row_names(mech))) if w is None else w
    return _textbook(mech.without_origin, t, q, v, method, udk.Baumgarte(*gains), w)


def close_to(found, expected, rtol):
    assert_allclose(found, expected, rtol=0, atol=rtol * (1.0 + np.abs(expected).max(initial=0.0)))


# --- the textbook itself


def test_accelerations_and_multipliers_solve_the_equations_of_motion(moved):
    """M a + Psi_q^T lambda = F; and Psi_q a is gamma as far as it can be: what is left is orthogonal to the columns of D.

    Hence Gauss's principle: of all accelerations that the constraints allow it is nearest to the free ones, in the metric of M.
    """
    mech, q, v = moved
    x = textbook(mech, q, v)
    size = 1.0 + np.abs(x["psi_q"]).max(initial=0.0) * np.abs(x["lambda"]).max(initial=0.0)
    assert_allclose(x["M"] * x["a"] + x["psi_q"].T @ x["lambda"], x["F"], rtol=0, atol=1e-10 * size)
    left, D = x["psi_q"] @ x["a"] - x["gamma"], x["psi_q"] / np.sqrt(x["M"])
    assert_allclose(D.T @ left, 0.0, atol=1e-9 * size)


def test_rates_are_derivatives_along_a_motion(moved):
    """Psi_dot and gamma against differences of Psi along q + v s + a s^2 / 2: Psi_ddot = Psi_q a - gamma."""
    mech, q, v = moved
    a = jnp.cos(jnp.arange(q.size))
    psi = deferred(lambda s: constraints.psi(mech, T0 + s, q + v * s + a * s**2 / 2))
    x, h = textbook(mech, q, v), 1e-3
    samples = np.array([psi(k * h) for k in range(-3, 4)])
    close_to(np.array([-1, 9, -45, 0, 45, -9, 1]) @ samples / (60 * h), x["psi_dot"], 1e-9)
    close_to(np.array([2, -27, 270, -490, 270, -27, 2]) @ samples / (180 * h**2), x["psi_q"] @ a - x["gamma"], 1e-7)


def test_the_power_balance(moved):
    """d(T + V)/dt along a motion that the constraints allow: the power of stated loads, of drivers, and of V itself in time."""
    mech, q, v = moved

    @deferred
    def balance(q, v):
        A = constraints.psi_q(mech, T0, q)
        v = v - uk.pseudoinverse(SVD, A) @ constraints.psi_dot(mech, T0, q, v)
        a, multipliers = (f(mech, T0, q, v, SVD) for f in (uk.accelerations, uk.multipliers))
        energy = lambda t, q, v: loads.kinetic_energy(mech, v) + loads.potential_energy(mech, t, q, v)  # noqa: E731
        rate = jax.jvp(energy, (T0, q, v), (jnp.ones(()), v, a))[1]
        psi_t = jax.jvp(lambda t: constraints.psi(mech, t, q), (T0,), (jnp.ones(()),))[1]
        V_t = jax.grad(lambda t: loads.potential_energy(mech, t, q, v))(T0)
        power = v @ loads.element_loads(mech, T0, q, v) + multipliers @ psi_t + V_t
        return rate, power, jnp.abs(v) @ jnp.abs(loads.force(mech, T0, q, v)) + jnp.abs(psi_t).sum()

    rate, power, size = balance(q, v)
    assert_allclose(rate, power, rtol=0, atol=1e-9 * (1.0 + float(size)))


def test_a_duplicated_constraint_changes_nothing(closed):
    """Neither accelerations, nor what projection does, nor what the joint and its copy do to the bodies together."""
    mech = udk.library.parallelogram()
    twice = udk.Mechanism(mech.bodies, {**mech.joints, "copy": mech.joints["A1"]})
    q, v = closed(mech)
    once, again = (textbook(m, q, v, t=jnp.array(0.0)) for m in (mech, twice))
    close_to(again["a"], once["a"], 1e-11)
    close_to(again["psi_q"].T @ again["lambda"], once["psi_q"].T @ once["lambda"], 1e-11)
    off = q + 1e-4 * jnp.cos(jnp.arange(q.size))
    project = deferred(lambda m: jnp.concatenate(uk.project(m, 0.0, off, v, SVD, steps=4)))
    projected, alone = (project(m.without_origin) for m in (twice, mech))
    close_to(projected, alone, 1e-7)  # where redundant rows disagree, copies count twice


def test_the_linkage_of_the_paper(placed):
    """3.05 theta'' = -3.5 g cos(theta), of rank 11 of 12."""
    mech = udk.library.parallelogram()
    for angle in (-0.8, 0.4, 2.0):
        q, v = (x.ravel() for x in placed(angle, 1.3))
        assert_allclose(textbook(mech, q, v)["a"][2], -3.5 * 9.81 * np.cos(angle) / 3.05, rtol=1e-12)


def test_weights_change_no_solution_of_consistent_rows_and_zero_leaves_one_out():
    mech = udk.library.parallelogram(-0.8)
    q, v = mech.q0.ravel(), mech.v0.ravel()
    plain = textbook(mech, q, v)
    w = jnp.linspace(0.1, 10.0, 12)
    weighted = textbook(mech, q, v, w=w)
    assert_allclose(weighted["a"], plain["a"], atol=1e-12)
    close_to(weighted["psi_q"].T @ weighted["lambda"], plain["psi_q"].T @ plain["lambda"], 1e-12)
    without = textbook(mech, q, v, w=w.at[11].set(0.0))
    assert_allclose(without["a"], plain["a"], atol=1e-11)
    assert without["lambda"][11] == 0.0 and np.abs(plain["lambda"][11]) > 1.0


@pytest.mark.parametrize("symbol", [uk.accelerations, uk.multipliers])
def test_an_equation_computes_psi_q_and_the_loads_once(symbol):
    """Programs of derivatives have copies of each, and take as long to compile as they have operations."""
    mech = udk.library.four_bar()
    program = jax.make_jaxpr(lambda q, v: symbol(mech, 0.0, q, v, SVD))(mech.q0.ravel(), mech.v0.ravel())
    called = [equation.params.get("name") for equation in program.eqns]
    assert [called.count(name) for name in ("psi_q", "force", "gamma")] == [1, 1, 1]


@pytest.mark.parametrize("name", ["parallelogram", "slider_crank"])
def test_projection_returns_to_the_manifold_and_leaves_what_is_tangent_to_it(name):
    mech = scene(name)
    q, v = (x.ravel() + 1e-4 * jnp.sin(1.0 + jnp.arange(x.size)) for x in (mech.q0, mech.v0))
    q1, v1 = deferred(lambda q, v: uk.project(mech, T0, q, v, SVD, steps=8))(q, v)
    psi, psi_dot = deferred(lambda q, v: (constraints.psi(mech, T0, q), constraints.psi_dot(mech, T0, q, v)))(q1, v1)
    assert np.abs(psi).max() < 1e-13 and np.abs(psi_dot).max() < 1e-13
    tangent = deferred(lambda change: uk.tangent_part(mech, T0, q1, change, SVD))
    part, psi_q = tangent(q), deferred(lambda q: constraints.psi_q(mech, T0, q))(q1)
    assert_allclose(psi_q @ part, 0.0, atol=1e-12)
    assert_allclose(tangent(part), part, atol=1e-12)
    assert_allclose(part @ (loads.mass(mech) * (q - part)), 0.0, atol=1e-12)  # in the metric of M the rest is orthogonal


def test_coordinates_may_be_flat_or_by_body():
    mech = udk.library.slider_crank()

    @deferred
    def evaluate(q, v):
        of_q = [f(mech, T0, q) for f in (constraints.psi, constraints.psi_q)]
        return of_q + [f(mech, T0, q, v) for f in (constraints.psi_dot, constraints.gamma, loads.force, loads.potential_energy)]

    q, v = mech.q0 + 0.1, mech.v0 + 0.2
    for one, other in zip(evaluate(q, v), evaluate(q.ravel(), v.ravel()), strict=True):
        assert_allclose(one, other, rtol=0)


def test_row_names_are_those_of_the_analysis(moved):
    assert tuple(constraints.row_names(moved[0])) == udk.analyse(moved[0]).row_names


# --- what else there is, against it


@pytest.mark.parametrize("policy", RankPolicy)
def test_programs_are_the_textbook(moved, policy):
    """Terms and accelerations; on the rows that are kept, since off the manifold the others disagree."""
    mech, q, v = moved
    analysis = udk.analyse(mech)
    redundant = analysis.redundant_rows or ()
    programs = scene_programs(mech, redundant, True, policy)
    leaves, n = mech.at(T0).numbers, q.size
    numbers = [*map(float, numbers_as_vector(leaves)), 2.0, 3.0, 1e-14, 1e-14]
    asked = [("a", "safe"), ("terms", "psi_q", "psi", "psi_dot")]
    found = evaluate_programs(programs, asked, numbers, float(T0), q, v)
    (free, b), psi, psi_dot = np.split(found["terms"], [n]), found["psi"], found["psi_dot"]
    psi_q = dense(programs, found["psi_q"])
    terms = {"psi": psi, "psi_q": psi_q, "psi_dot": psi_dot, "gamma": b + psi_q @ free + 4.0 * psi_dot + 9.0 * psi}
    terms["F"] = free * np.asarray(loads.mass(mech))
    kept = np.ones(len(analysis.row_names))
    kept[list(redundant)] = 0.0
    expected = textbook(mech, q, v, udk.SVD(1e-11), (2.0, 3.0), analysis.scales.weights * kept)
    for name, array in terms.items():
        close_to(array, expected[name], 1e-11)
    close_to(found["a"], expected["a"], 1e-8)


METHODS = {"Elimination": udk.Elimination(1e-6), "Varga": udk.Varga(1e-6), "Auto": udk.Auto(1e-6)}
PAIRS = [("parallelogram", "Elimination"), ("planetary_gear", "Varga"), ("driven_pendulum", "Auto")]
MORE = [(name, key) for name in udk.library.__all__ for key in METHODS if (name, key) not in PAIRS]


@pytest.mark.parametrize(("name", "key"), [*PAIRS, *(pytest.param(*x, marks=pytest.mark.slow) for x in MORE)])
def test_every_pseudoinverse_gives_what_singular_values_give(name, key):
    """Accelerations and multipliers of minimum norm, of all rows, weighted; where rows that are redundant agree."""
    mech, method = scene(name), METHODS[key]
    v = mech.v0.ravel() + 0.03 * jnp.sin(jnp.arange(mech.v0.size))
    analysis, q = udk.analyse(mech), udk.assemble(mech, T0).q.ravel()

    @deferred
    def both(m, q, v):
        q, v = uk.project(m, T0, q, v, udk.SVD(1e-6), steps=3)
        given = m, T0, q, v, udk.SVD(1e-6), None, analysis.scales.weights
        equations = prepare(m, method, analysis=analysis)
        found = equations.accelerations(T0, q, v), equations.multipliers(T0, q, v)
        return found, (uk.accelerations(*given), uk.multipliers(*given))

    for found, expected in zip(*both(mech.without_origin, q, v), strict=True):
        close_to(found, expected, 1e-9)
