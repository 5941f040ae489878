"""Accelerations and projections by machine code equal the textbook's, for each method, element and stabilization."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests import elements
from udkjax.equations import prepare
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.laws.formulations import Formulation
from udkjax.integrate.compiled_mechanism import compile_mechanism
from udkjax.integrate.native_engine import mark_rows
from udkjax.integrate.native_equations import ConcreteRates, native_equations
from udkjax.integrate.projection import Projection
from udkjax.native.loaded_code import FEW_MEMBERS
from udkjax.programs.deferred import deferred

METHODS = [udk.Auto(), udk.Elimination(), udk.SVD(), udk.Varga(), udk.Householder(), udk.GramSchmidt(), udk.Greville()]
FORMULATIONS = [udk.NullSpaceQR(), udk.NullSpaceSVD(), udk.Augmented(udk.SVD())]
TIMES = np.linspace(0.0, 1.0, 6)


def both(mechanism, chosen, stabilization=Projection()):
    """The equations by machine code, for a pseudoinverse or a formulation, and by the textbook."""
    analysis = udk.analyse(mechanism)
    method, formulation = (udk.Auto(), chosen) if isinstance(chosen, Formulation) else (chosen, None)
    compiled = compile_mechanism(mechanism.without_origin, analysis, method, stabilization, formulation, udk.BDF())
    q, v, scales = mechanism.q0.ravel(), mechanism.v0.ravel(), analysis.scales
    marks = mark_rows(compiled, jnp.zeros(()), q, v, scales.length, jnp.maximum(scales.rate, 1.0))
    assert compiled.plan.evaluation is not None
    return native_equations(compiled, marks), compiled.textbook


@deferred
def terms(equations, t, q, v):
    """Weighted D and b, a_F, and M^(-1/2), from the textbook."""
    mechanism, w = equations.mechanism, equations.scales.weights
    return (
        uk.D(mechanism, t, q, w),
        uk.b(mechanism, t, q, v, equations.baumgarte, w),
        uk.a_F(mechanism, t, q, v),
        uk.inverse_sqrt_mass(mechanism),
    )


@deferred
def evaluate(equations, t, q, v, dq, dv):
    return equations.accelerations(t, q, v), equations.tangent_part(t, q, v, dq, dv)


def agree(mechanism, chosen, stabilization=Projection(), closed=False, atol=1e-12):
    """Compare with a_F + M^(-1/2) D^+ b, with D^+ by NumPy, at a state near the guess that need not be closed."""
    random = np.random.default_rng(3)
    state = udk.assemble(mechanism) if closed else udk.State(mechanism.q0, mechanism.v0)
    q, v = (x.ravel() + (0 if closed else 0.1) * random.standard_normal(x.size) for x in (state.q, state.v))
    t, (dq, dv) = jnp.asarray(0.3), random.standard_normal((2, len(q)))
    systems = [both(mechanism, method, stabilization) for method in chosen]
    D, b, free, root = (np.asarray(x) for x in terms(systems[0][1], t, q, v))
    plus = np.linalg.pinv(D, rcond=1e-4)
    for method, (native, _) in zip(chosen, systems, strict=True):
        formulated = isinstance(method, Formulation)  # which changes accelerations alone
        a, tangent = (native.accelerations(t, q, v), ()) if formulated else evaluate(native, t, q, v, dq, dv)
        expected = free + root * (plus @ b)
        if isinstance(method, udk.Augmented) and method.method is None and np.linalg.matrix_rank(D, 1e-8) < len(D):
            assert np.isnan(a).all()  # LU demands independent rows
            continue
        assert_allclose(a, expected, rtol=0, atol=atol * max(1.0, np.abs(expected).max()), err_msg=str(method))
        for found, x in zip(tangent, (dq, dv), strict=not formulated):
            assert_allclose(
                found, x - root * (plus @ (D @ (x / root))), rtol=0, atol=atol * max(1.0, np.abs(x).max()), err_msg=str(method)
            )


@pytest.mark.parametrize("names", ["prismatic slot distance", "weld gear", "inner_gear rack cam"])
@pytest.mark.parametrize(
    "chosen", [METHODS[:1], pytest.param([*METHODS, *FORMULATIONS, udk.Augmented()], marks=pytest.mark.slow)], ids=["Auto", "all"]
)
def test_joints(names, chosen):
    """With elimination; other methods use the same terms."""
    joints = {k: elements.JOINTS[k] for k in ("revolute", *(name.replace("_", " ") for name in names.split()))}
    agree(udk.Mechanism(elements.BODIES, joints), chosen)


@pytest.mark.parametrize("kind", ["drivers", "forces"])
@pytest.mark.parametrize("stabilization", [Projection(), udk.Baumgarte(3.0, 7.0)], ids=["none", "Baumgarte"])
def test_drivers_and_forces(kind, stabilization):
    joints = {"revolute": elements.JOINTS["revolute"]}
    drivers = {k: elements.DRIVERS[k] for k in ("turn", "lift")}
    moved = udk.Mechanism(elements.BODIES, joints, drivers=drivers)
    loaded = udk.Mechanism(elements.BODIES, joints, forces=elements.FORCES)
    chosen = [METHODS[0], METHODS[4]] if stabilization == Projection() else [udk.NullSpaceQR(), udk.Augmented()]
    agree(moved if kind == "drivers" else loaded, chosen, stabilization)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [-0.7, np.pi / 2])
def test_redundant_rows(angle):
    agree(udk.library.parallelogram(angle=angle, angular_velocity=0.7), METHODS + FORMULATIONS, closed=True)


@pytest.mark.slow
def test_what_is_no_number_does_not_last():
    """A state with a NaN velocity, followed in the same lane by a valid one: with several lanes, or a single one."""
    mechanism, t = udk.library.four_bar(), jnp.zeros(())
    state = udk.assemble(mechanism)
    q, v = state.q.ravel(), state.v.ravel()
    for chosen in (*METHODS[2:], *FORMULATIONS, udk.Augmented()):
        native, _ = both(mechanism, chosen)
        expected = native.accelerations(t, q, v)
        for members in (FEW_MEMBERS, 5 * FEW_MEMBERS):
            missing = np.arange(members) < members // 2
            vs = jnp.where(missing[:, None], jnp.nan, v)
            a = np.asarray(jax.vmap(lambda v, e=native: e.accelerations(t, q, v))(vs))
            assert np.isnan(a[missing]).all(), chosen
            later = a[~missing]
            assert_allclose(later, jnp.broadcast_to(expected, later.shape), rtol=1e-12, atol=1e-12, err_msg=str(chosen))


def test_a_singular_configuration():
    """All links are in line: the rank falls by one, and a is the least-norm solution. Elimination has half the digits there."""
    chosen = [m for m in METHODS if not isinstance(m, udk.Elimination)] + FORMULATIONS
    agree(udk.library.parallelogram(angle=0.0, angular_velocity=0.7), chosen, closed=True, atol=1e-11)


@pytest.mark.parametrize("method", [udk.Auto(), udk.Varga()], ids=["Auto", "Varga"])
def test_projection(method):
    """It satisfies all constraints by the smallest change in the mass metric, which is orthogonal to admissible motions."""
    mechanism = udk.library.parallelogram(angle=-0.7, angular_velocity=0.7)
    native, plain = both(mechanism, method)
    state = udk.assemble(mechanism)
    q0, v0 = state.q.ravel() + 1e-5 * np.sin(np.arange(12)), state.v.ravel() + 1e-5 * np.cos(np.arange(12))
    q, v = native.project(jnp.zeros(()), q0, v0)
    psi, psi_dot = plain.violation(jnp.zeros(()), q, v)
    assert_allclose(psi, 0, atol=1e-14)
    assert_allclose(psi_dot, 0, atol=1e-14)
    D, _, _, root = (np.asarray(x) for x in terms(plain, jnp.zeros(()), q, v))
    for change in (q - q0, v - v0):
        x = change / root
        assert np.linalg.norm(x - np.linalg.pinv(D, rcond=1e-4) @ (D @ x)) < 1e-3 * np.linalg.norm(x)


@pytest.mark.slow
def test_batches_and_derivatives():
    mechanism = udk.library.parallelogram(angle=-0.7, angular_velocity=0.7)
    native, plain = both(mechanism, udk.Householder())
    state = udk.assemble(mechanism)
    q, v, t = state.q.ravel(), state.v.ravel(), jnp.zeros(())
    vs = jnp.linspace(-1.0, 1.0, 11)[:, None] * v
    ours, theirs = (lambda v, e=e: e.accelerations(t, q, v) for e in (native, plain))
    assert_allclose(jax.vmap(ours)(vs), deferred(jax.vmap(theirs))(vs), atol=1e-12)
    expected = deferred(jax.jacfwd(theirs))(v)
    assert_allclose(jax.jacfwd(ours)(v), expected, atol=1e-12)
    assert_allclose(jax.jacrev(ours)(v), expected, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [udk.Adams(), udk.BDF()])
def test_runs_of_other_solvers_take_the_steps_of_the_plain_form(solver):
    mechanism = udk.library.compound_pendulum()
    one, two = (udk.simulate(mechanism, TIMES, rtol=1e-6, atol=1e-6, solver=solver, engine=e) for e in ("auto", "jax"))
    assert abs(int(one.stats["accepted"]) - int(two.stats["accepted"])) <= 2
    assert_allclose(one.q, two.q, rtol=0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [udk.Augmented(), udk.NullSpaceSVD()], ids=["LU", "SVD"])
def test_lanes_and_derivatives_of_runs_by_a_formulation(formulation):
    """Members of a batch equal single runs. Derivatives in both modes are those of the Udwadia-Kalaba equation."""
    mechanism = udk.library.four_bar()

    def end(mass, formulation):
        moved = mechanism.with_parameters({"body.coupler.mass": mass})
        return udk.simulate(moved, TIMES, rtol=1e-10, atol=1e-10, formulation=formulation).q[-1, 1, 2]

    masses = jnp.array([0.7, 1.0, 1.9])
    expected = jax.vmap(jax.value_and_grad(lambda m: end(m, None)))(masses)
    found = jax.vmap(jax.value_and_grad(lambda m: end(m, formulation)))(masses)
    assert_allclose(found, expected, rtol=1e-7)
    assert_allclose(jax.jvp(lambda m: end(m, formulation), (masses[2],), (1.0,)), np.asarray(expected)[:, 2], rtol=1e-7)
    assert_allclose(end(masses[0], formulation), found[0][0], rtol=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_run_through_an_adjoint():
    def end(mass):
        moved = udk.library.four_bar().with_parameters({"body.coupler.mass": mass})
        return udk.simulate(moved, TIMES[:3], adjoint=diffrax.RecursiveCheckpointAdjoint()).q[-1, 0, 2]

    reference = jax.grad(
        lambda m: udk.simulate(udk.library.four_bar().with_parameters({"body.coupler.mass": m}), TIMES[:3]).q[-1, 0, 2]
    )
    assert_allclose(jax.grad(end)(1.3), reference(1.3), rtol=1e-6)


@pytest.mark.parametrize("number, own", [(0, udk.SVD), (3, udk.Householder)])
def test_rates_of_concrete_numbers_are_those_of_the_textbook(number, own):
    """For integrators outside of JAX: (v, a) off the manifold, with gains, at one state after another."""
    linkage, method, gains = udk.library.parallelogram(), udk.OneOf.absolute(0.1, number=number), udk.Baumgarte(3.0, 5.0)
    rates, textbook = (
        ConcreteRates(linkage, method, gains),
        eqx.filter_jit(prepare(linkage, own.absolute(0.1), gains).accelerations),
    )
    random, y0 = np.random.default_rng(1), np.concatenate([linkage.q0.ravel(), linkage.v0.ravel()])
    for t in (0.0, 0.4):
        y = y0 + 1e-3 * random.standard_normal(y0.size)
        assert_allclose(rates(t, y), [*y[12:], *textbook(t, jnp.asarray(y[:12]), jnp.asarray(y[12:]))], rtol=0, atol=1e-11)


def test_rates_without_machine_code_are_refused():
    with pytest.raises(ValueError, match="no machine code for Mine"):
        ConcreteRates(udk.library.parallelogram(), type("Mine", (udk.SVD,), {})())


def test_machine_code_evaluates_the_equations_that_diffrax_integrates():
    """With `engine="jax"` no machine code is used, so that results can be compared."""
    mechanism = udk.library.parallelogram()
    analysis = udk.analyse(mechanism)
    for engine, is_native in (("diffrax", True), ("jax", False)):
        plan = compile_mechanism(mechanism, analysis, udk.Auto(), udk.Projection(), engine=engine).plan
        assert plan.operation is None and (plan.evaluation is not None) is is_native
