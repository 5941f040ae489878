"""Ranking of experiments, compared with differences and well-known properties of pendulums."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.scene.elements.drivers import Sine
from udkjax.study.belief.experiment_design import Candidate, design_experiment
from udkjax.study.identify.records.records import Start

NAMES = ("body.lower.inertia", "force.damper.damping")
CHANNEL, NOISE = "body.lower.angle", 0.01
AMPLITUDE, FREQUENCY = "driver.motor.motion.amplitude", "driver.motor.motion.frequency"
TS = np.linspace(0.0, 4.0, 41)
ANGLES = (0.0, 0.3, 1.0)


def scene(angle: float = 0.0) -> udk.Mechanism:
    """A pendulum with a damped pin, hung on a rod that a motor swings."""
    rods = udk.library.double_pendulum(angles=(0.0, angle))
    motor = udk.Driver(("ground", "upper"), "angle", Sine(0.2, 3.0, offset=-np.pi / 2))
    damper = udk.TorsionSpring(("upper", "lower"), stiffness=0.0, damping=0.1)
    return udk.Mechanism(rods.bodies, rods.joints, {"motor": motor}, {"damper": damper}, rods.gravity)


def released(angle: float) -> Start:
    mech = scene(angle)
    return Start(udk.State(mech.q0, mech.v0))


def prediction(inertia: float, damping: float, angle: float, amplitude: float) -> np.ndarray:
    mech = scene(angle).with_parameters({NAMES[0]: inertia, NAMES[1]: damping, AMPLITUDE: amplitude})
    return np.asarray(udk.simulate(mech, TS, rtol=1e-11, atol=1e-11).q)[:, 1, 2]


@pytest.fixture(scope="module")
def candidates():
    """Released from angles without the motor, and from the middle one with it."""
    still = [Candidate({AMPLITUDE: 0.0}, released(angle), f"{angle:g} rad") for angle in ANGLES]
    return [*still, Candidate({AMPLITUDE: 0.2}, released(ANGLES[1]), "driven")]


@pytest.fixture(scope="module")
def design(candidates):
    return design_experiment(scene(), candidates, NAMES, [CHANNEL], TS, NOISE, pick=2)


@pytest.mark.slow
def test_what_does_not_move_tells_nothing(design):
    assert design.scores[0] == -np.inf and np.all(np.isinf(design.standard_errors[0])) and design.order[-1] == 0


@pytest.mark.slow
def test_the_higher_it_is_released_the_more_it_tells(design):
    assert design.scores[2] > design.scores[1] > design.scores[0]
    assert np.all(design.standard_errors[2] < design.standard_errors[1])


def test_ranking_and_errors_are_those_of_differences(design):
    x = np.array([float(scene().parameters()[name]) for name in NAMES])
    scores, errors = [], []
    for angle, amplitude in ((ANGLES[1], 0.0), (ANGLES[2], 0.0), (ANGLES[1], 0.2)):
        columns = []
        for k in range(2):
            moved = np.exp([[1e-4 * (k == 0), 1e-4 * (k == 1)], [-1e-4 * (k == 0), -1e-4 * (k == 1)]]) * x
            one, two = (prediction(inertia, damping, angle, amplitude) for inertia, damping in moved)
            columns.append((one - two) / 2e-4 / NOISE)
        J = np.stack(columns, axis=1)
        scores.append(np.linalg.slogdet(J.T @ J)[1])
        errors.append(np.sqrt(np.diag(np.linalg.inv(J.T @ J))) * x)
    assert design.scores[1:] == pytest.approx(scores, abs=1e-4)
    assert design.standard_errors[1:] == pytest.approx(np.array(errors), rel=1e-4)
    assert design.order[:3] == tuple(1 + k for k in np.argsort(scores)[::-1])


def test_those_that_are_made_together(design, candidates):
    assert design.chosen[0] == design.best and len(set(design.chosen)) == 2
    information = sum(1.0 / design.together[0] ** 2)
    assert sum(1.0 / design.together[1] ** 2) > information
    assert "driven" in str(design) and str(design).splitlines()[2].strip().startswith(candidates[design.best].name)


@pytest.mark.parametrize("criterion", ["A", "E"])
def test_other_criteria(candidates, criterion):
    found = design_experiment(scene(), candidates, NAMES, [CHANNEL], TS, NOISE, criterion)
    assert found.order[-1] == 0 and found.scores[2] > found.scores[1]
    known = np.argsort(-found.scores)
    assert tuple(known) == found.order


def test_parameters_that_do_not_matter(candidates, design):
    """Nuisance parameters are eliminated: errors stay the same, and the score is that of one parameter."""
    found = design_experiment(scene(), candidates, NAMES, [CHANNEL], TS, NOISE, of=NAMES[:1])
    assert found.names == NAMES[:1]
    assert found.standard_errors[1:, 0] == pytest.approx(design.standard_errors[1:, 0], rel=1e-6)
    inertia = float(scene().parameters()[NAMES[0]])
    assert found.scores[1:] == pytest.approx(-2.0 * np.log(found.standard_errors[1:, 0] / inertia), abs=1e-6)


def test_what_a_prior_tells_counts(candidates):
    known = udk.Parameter(NAMES[0], prior=(1 / 12, 1e-9))
    found = design_experiment(scene(), candidates, [known, NAMES[1]], [CHANNEL], TS, NOISE)
    alone = design_experiment(scene(), candidates, NAMES, [CHANNEL], TS, NOISE)
    assert found.standard_errors[0, 0] == pytest.approx(1e-9, rel=1e-6) and np.isinf(found.standard_errors[0, 1])
    assert np.all(found.standard_errors[1:, 1] <= alone.standard_errors[1:, 1] * (1.0 + 1e-9))


def test_an_estimate_counts_as_made(candidates):
    """Its records add their information: a candidate without information leaves its standard errors unchanged."""
    q = prediction(1 / 12, 0.1, ANGLES[1], 0.0) + NOISE * np.random.default_rng(0).standard_normal(len(TS))
    data = udk.Record(TS, {CHANNEL: q}, NOISE, released(ANGLES[1]), conditions={AMPLITUDE: 0.0})
    estimate = udk.identify(scene(), data, NAMES, progress=False)
    found = design_experiment(scene(), candidates, NAMES, [CHANNEL], TS, NOISE, given=estimate)
    assert found.standard_errors[0] == pytest.approx(estimate.uncertainty.standard_errors, rel=1e-5)
    assert found.standard_errors[1] == pytest.approx(estimate.uncertainty.standard_errors / np.sqrt(2.0), rel=0.02)
    assert found.order[-1] == 0


def test_mistakes_are_told(candidates):
    with pytest.raises(ValueError, match='criterion must be one of "D", "A", "E", not "X"'):
        design_experiment(scene(), candidates, NAMES, [CHANNEL], TS, NOISE, "X")  # pyright: ignore[reportArgumentType]
    with pytest.raises(udk.IdentificationError, match="candidates: the list is empty"):
        design_experiment(scene(), [], NAMES, [CHANNEL], TS, NOISE)
    with pytest.raises(udk.IdentificationError, match=r"candidates\[0\]: must be a Candidate, conditions or a start, not int"):
        design_experiment(scene(), [3], NAMES, [CHANNEL], TS, NOISE)  # pyright: ignore[reportArgumentType]
    with pytest.raises(udk.IdentificationError, match="of: mass is not among the parameters"):
        design_experiment(scene(), candidates, NAMES, [CHANNEL], TS, NOISE, of=["mass"])


# --- by draws from a posterior


@pytest.fixture(scope="module")
def posterior():
    pytest.importorskip("arviz")
    random, values = np.random.default_rng(2), [float(scene().parameters()[name]) for name in NAMES]
    angle = prediction(*values, angle=0.3, amplitude=0.0) + NOISE * random.standard_normal(len(TS))
    data = udk.Record(TS, {CHANNEL: angle}, NOISE, released(0.3), conditions={AMPLITUDE: 0.0})
    problem = udk.inference(scene(0.3), data, NAMES, priors={name: (x, x) for name, x in zip(NAMES, values, strict=True)})
    return udk.sample(problem, chains=4, draws=100, warmup=100, progress=False)


def test_by_draws_the_score_is_the_mean_over_them(posterior, candidates):
    """Against the information at each draw, by differences, added to the inverse of the draws' covariance."""
    found = design_experiment(scene(), candidates[1:3], NAMES, [CHANNEL], TS, NOISE, given=posterior)
    z = posterior.problem.fit_problem.unknowns.z_of(np.stack([posterior.draws[n].ravel() for n in NAMES], axis=1))
    x, h, prior = np.exp(z) * [float(scene().parameters()[n]) for n in NAMES], 1e-5, np.linalg.inv(np.cov(z.T))
    some = np.linspace(0, len(z) - 1, 32).round().astype(int)
    scores, variances = np.zeros((2, 32)), np.zeros((2, 32, 2))
    for j, k in enumerate(some):
        for c, angle in enumerate(ANGLES[1:]):
            more, less = (
                [prediction(*(x[k] * (1 + step * e)), angle=angle, amplitude=0.0) for e in np.eye(2)] for step in (h, -h)
            )
            slope = np.subtract(more, less) / (2 * h * NOISE)
            M = prior + slope @ slope.T
            scores[c, j], variances[c, j] = np.linalg.slogdet(M)[1], np.diag(np.linalg.inv(M)) * x[k] ** 2
    np.testing.assert_allclose(found.scores, scores.mean(1), rtol=1e-4)
    np.testing.assert_allclose(found.standard_errors, np.sqrt(variances.mean(1)), rtol=1e-3)
    assert found.best == 1  # the higher release


def test_draws_of_other_parameters_are_refused(posterior, candidates):
    with pytest.raises(udk.IdentificationError, match="given: is a posterior of body"):
        design_experiment(scene(), candidates[:1], NAMES[:1], [CHANNEL], TS, NOISE, given=posterior)
    bounded = [udk.Parameter(NAMES[0], bounds=(1e-6, 1e-5), guess=5e-6), NAMES[1]]
    with pytest.raises(udk.IdentificationError, match=f"the bounds of {NAMES[0]} exclude draws"):
        design_experiment(scene(), candidates[:1], bounded, [CHANNEL], TS, NOISE, given=posterior)
