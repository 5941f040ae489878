"""Log densities compared with the cost of `identify`, with integrals and with differences."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad

import udkjax as udk
from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum, swing
from udkjax.programs.deferred import deferred
from udkjax.study.identify.density.priors import PriorDensity
from udkjax.study.identify.problem.unknowns import Target, Unknown, Unknowns

SIGMA = 0.01


def record(noise: float | None = SIGMA, ts: np.ndarray = TS, **more) -> udk.Record:
    return udk.Record(ts, {ANGLE: swing(pendulum(), ts)[: len(ts)] + SIGMA * np.cos(97.0 * ts)}, noise, **more)


PARAMETERS = [
    udk.Parameter(NAMES[0], bounds=(0.1, 0.9)),
    udk.Parameter(NAMES[1], prior=(0.25, 0.1)),
    udk.Parameter("force.spring.stiffness", transform="free"),
]


@pytest.fixture(scope="module")
def problem():
    """Unknowns of all kinds: bounded, positive with a prior, free, two of an initial state, and noise of the second record."""
    records = [
        record(),
        udk.Record(TS[:20], {"body.rod.omega": np.cos(TS[:20])}, initial_state=udk.Start(estimate="both")),
    ]
    return udk.inference(pendulum(0.4), records, PARAMETERS, priors={"force.spring.stiffness": lambda x: -jnp.abs(x - 2.0)})


def points(problem, size: float = 0.2, count: int = 3) -> np.ndarray:
    return size * np.random.default_rng(5).standard_normal((count, len(problem.names)))


def test_it_is_the_cost_of_identify_with_priors_jacobian_and_noise(problem):
    least_squares, x = problem.fit_problem, points(problem)
    K = least_squares.K
    found = least_squares.evaluate(x[:, :K], problem.tol).r
    given = found[:, : len(TS)], found[:, len(least_squares.index) :]  # of the first record, and of the prior
    scale = np.exp(x[:, K:]) * problem.factors
    other = found[:, len(TS) : len(least_squares.index)] / scale
    cost = 0.5 * sum(np.sum(part**2, 1) for part in (*given, other))
    values = problem.unknowns.values(x)
    log_jacobian = np.log(np.abs([np.diag(jax.jacfwd(lambda z: problem.unknowns.values(z, jnp))(jnp.asarray(z))) for z in x]))
    expected = -cost - np.abs(values[:, 2] - 2.0) + log_jacobian.sum(1) - np.log(values[:, -1]) - 20 * np.log(scale[:, 0])
    differences = np.asarray(problem.log_densities(x)) - expected
    assert_allclose(differences, differences[0], rtol=0, atol=1e-9 * np.abs(expected).max())
    assert problem.names == (*NAMES, "force.spring.stiffness", *least_squares.all_names[3:], "noise of body.rod.omega")
    assert_allclose(problem.parameters(x)[NAMES[0]], values[:, 0], rtol=1e-14)
    each = deferred(problem.log_likelihoods)(x[0])
    assert_allclose(each.sum() + problem.log_prior(x[0]), problem.log_densities(x[:1])[0], rtol=1e-12)


def test_derivatives_are_those_of_differences_to_second_order(problem):
    exact = udk.inference(
        pendulum(0.4), record(), PARAMETERS[:2], priors={NAMES[0]: lambda x: -((x - 0.4) ** 2)}, tol=1e-12, max_steps=4096
    )
    x, h = np.array([0.1, -0.2]), 1e-5
    slopes = deferred(jax.vmap(jax.grad(exact.log_density)))
    steps = np.concatenate([x + h * np.eye(2), x - h * np.eye(2)])
    values, gradients = np.asarray(exact.log_densities(steps)), np.asarray(slopes(steps))
    gradient = slopes(x[None])[0]
    assert_allclose(gradient, (values[:2] - values[2:]) / (2 * h), rtol=1e-6)
    hessian = deferred(jax.hessian(exact.log_density))(x)
    assert_allclose(hessian, (gradients[:2] - gradients[2:]) / (2 * h), rtol=1e-6)
    forward = deferred(lambda x, d: jax.jvp(exact.log_density, (x,), (d,))[1])(x, np.array([1.0, -2.0]))
    assert_allclose(forward, gradient @ np.array([1.0, -2.0]), rtol=1e-12)


def test_failed_runs_have_no_density_and_no_slope_beside_others_in_lanes(problem):
    x = points(problem)
    x[1, 3] = 1e9  # a velocity of which a run takes more steps than it may
    x[1, 4] = 1e9
    x[2, 2] = np.nan
    both = deferred(jax.vmap(jax.value_and_grad(problem.log_density)))
    values, slopes = map(np.asarray, both(x))
    assert_array_equal(values[1:], -np.inf)
    assert_array_equal(slopes[1:], 0.0)
    alone = deferred(jax.value_and_grad(problem.log_density))(x[0])
    assert_allclose(values[0], alone[0], rtol=1e-12)
    assert_allclose(slopes[0], alone[1], rtol=1e-8, atol=1e-8 * np.abs(slopes[0]).max())
    assert np.abs(slopes[0]).min() > 0.0


@pytest.mark.parametrize(("samples", "members"), [(20, 300), (5000, 1)])
def test_sums_of_many_residuals_are_those_of_numpy(samples, members):
    ts = np.linspace(0.0, 1.0, samples)
    problem = udk.inference(pendulum(0.4), record(None, ts), NAMES[:1])
    x = points(problem, count=members)
    predicted = np.asarray(deferred(jax.vmap(problem.predicted))(x))
    sigma = problem.parameters(x)[f"noise of {ANGLE}"][:, None]
    each = -0.5 * ((predicted - problem.fit_problem.measured) / sigma) ** 2 - np.log(sigma * np.sqrt(2.0 * np.pi))
    prior = np.asarray(jax.vmap(problem.log_prior)(x))
    assert_allclose(problem.log_densities(x), each.sum(1) + prior, rtol=1e-10)
    assert_allclose(deferred(jax.vmap(lambda x: jnp.sum(problem.log_likelihoods(x))))(x), each.sum(1), rtol=1e-10)


def test_other_measured_values_share_programs(problem):
    """Also where the values are traced, and together with derivatives."""
    x, values = points(problem, count=1)[0], problem.fit_problem.measured + 0.01
    other = problem.with_measured(values)
    both = deferred(jax.vmap(lambda y: jax.value_and_grad(problem.with_measured(y).log_density)(x)))
    found, slopes = both(np.stack([problem.fit_problem.measured, values]))
    assert_allclose(found, [problem.log_densities(x[None])[0], other.log_densities(x[None])[0]], rtol=1e-10)
    assert_allclose(slopes[1], deferred(jax.grad(other.log_density))(x), rtol=1e-10)
    assert other.programs is problem.programs and abs(found[1] - found[0]) > 1.0
    count = problem.programs["densities"]._cache_size()
    problem.with_measured(values + 0.01).log_densities(x[None])
    assert problem.programs["densities"]._cache_size() == count
    with pytest.raises(udk.IdentificationError, match="one number for each measured value"):
        problem.with_measured(values[1:])


def test_records_with_different_conditions_go_in_lanes():
    stiff = {"force.spring.stiffness": 5.0}
    both = udk.inference(pendulum(0.4), [record(ts=TS[:9]), record(ts=TS[:9], conditions=stiff)], NAMES[:1])
    each = [udk.inference(m, record(ts=TS[:9]), NAMES[:1]) for m in (pendulum(0.4), pendulum(0.4).with_parameters(stiff))]
    x = points(both)
    parts = [np.asarray(problem.log_densities(x) - jax.vmap(problem.log_prior)(x)) for problem in each]
    assert_allclose(both.log_densities(x) - jax.vmap(both.log_prior)(x), np.sum(parts, axis=0), rtol=1e-6)


def test_steps_are_bounded_by_those_at_the_start(problem):
    runs = np.arange(2)
    taken = problem.fit_problem.predictor(problem.fit_problem.members(np.zeros((1, problem.fit_problem.K)), runs), problem.tol)
    assert problem.max_steps == 20 * taken.steps.max()
    assert udk.inference(pendulum(), record(), NAMES[:1], max_steps=777).max_steps == 777


def unknown(kind: str, mean: float = np.nan, sigma: float = np.nan, low: float = np.nan, high: float = np.nan) -> Unknowns:
    return Unknowns.of([Unknown("a", "kg", Target(), kind, True, 1.5, low, high, 2.0, mean, sigma)])  # pyright: ignore


@pytest.mark.parametrize(
    "given",
    [
        unknown("free", 1.0, 0.3),
        unknown("positive", 1.0, 0.3),
        unknown("positive", 0.1, 0.5),
        unknown("positive", -3.0, 1.0),
        unknown("bounded", 1.0, 0.4, 0.5, 2.0),
        unknown("bounded", 9.0, 1.0, 0.5, 2.0),
        unknown("bounded", low=0.5, high=2.0),
    ],
    ids=str,
)
def test_priors_integrate_to_one(given):
    density = PriorDensity(given, {}, ())
    total = jax.jit(lambda z: jnp.exp(density(given.values(z[None], jnp)) + given.log_dx_dz(z[None], jnp).sum()))
    assert_allclose(quad(lambda z: float(total(z)), -40.0, 40.0, limit=400, points=[0.0])[0], 1.0, rtol=1e-6)
    assert density.proper.all()


def test_transforms_are_the_same_by_numpy_and_jax():
    kinds = Unknowns.of(
        [
            Unknown("p", "", Target(), "positive", True, 1e-6, np.nan, np.nan, 1.0, np.nan, np.nan),
            Unknown("b", "", Target(), "bounded", True, 0.3, -1.0, 1e3, 1.0, np.nan, np.nan),
            Unknown("f", "", Target(), "free", True, -2.0, np.nan, np.nan, 1e4, np.nan, np.nan),
        ]
    )
    for z in (np.zeros(3), np.array([1.0, -2.0, 3.0]), np.full(3, 300.0), np.full(3, -300.0)):
        own = lambda z: kinds.values(z, jnp)  # noqa: E731
        assert_allclose(own(z), kinds.values(z), rtol=1e-14)
        slope = np.diag(jax.jacfwd(own)(z))
        assert_allclose(kinds.dx_dz(z), slope, rtol=1e-12)
        assert np.isfinite(kinds.log_dx_dz(z)).all()
        assert_allclose(jax.jacrev(lambda z: kinds.log_dx_dz(z, jnp).sum())(z) * slope, kinds.d2x_dz2(z), rtol=1e-12)
    assert_allclose(kinds.z_of(kinds.values(np.array([1.0, -2.0, 3.0]))), [1.0, -2.0, 3.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("priors", "text"),
    [
        ({"body.rod.mas": (1.0, 0.1)}, 'no unknown "body.rod.mas"; did you mean'),
        ({NAMES[0]: (1.0, 0.0)}, "must be \\(mean, standard deviation > 0\\)"),
        ({NAMES[0]: "wide"}, "must be \\(mean, standard deviation > 0\\)"),
        ({NAMES[0]: lambda x: jnp.where(x > 9.0, 0.0, -jnp.inf)}, "no density at its start, 0.4"),
        ({NAMES[0]: SimpleNamespace(logpdf=lambda x: float(x))}, "is not a function of JAX"),
    ],
)
def test_wrong_priors_are_named(priors, text):
    with pytest.raises(udk.IdentificationError, match=text):
        udk.inference(pendulum(0.4), record(), NAMES[:1], priors=priors)


def test_priors_by_object_function_and_numbers_are_equal():
    normal = lambda x: -0.5 * ((x - 0.5) / 0.1) ** 2  # noqa: E731
    given = ((0.5, 0.1), normal, SimpleNamespace(log_prob=normal), SimpleNamespace(logpdf=normal))
    problems = [udk.inference(pendulum(0.4), record(), NAMES[:1], priors={NAMES[0]: prior}) for prior in given]
    slopes = [float(jax.grad(problem.log_prior)(np.array([0.3]))[0]) for problem in problems]
    assert_allclose(slopes, slopes[0], rtol=1e-12)
    noise = udk.inference(pendulum(0.4), record(None), NAMES[:1], priors={f"noise of {ANGLE}": (SIGMA, 0.1 * SIGMA)})
    assert noise.unknowns.names[1] == f"noise of {ANGLE}" and noise.prior.proper.tolist() == [False, True]


def test_a_start_that_cannot_run_is_named():
    with pytest.raises(udk.IdentificationError, match="cannot be simulated at the start"):
        udk.inference(pendulum(), record(), NAMES[:1], max_steps=2)
