"""Comparisons of models with integrals of their densities, by the evidence and by leaving out each value."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.study.belief.test_log_density import SIGMA, record
from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum, swing

Z = np.linspace(-0.5, 0.5, 1001)
NOISY = udk.Record(TS, {ANGLE: swing(pendulum()) + SIGMA * np.random.default_rng(4).standard_normal(len(TS))}, SIGMA)


def damped(prior: tuple[float, float] = (0.25, 0.1)):
    return udk.inference(pendulum(0.375), NOISY, NAMES[1], priors={NAMES[1]: prior})


def fixed(inertia: float = 0.375, damping: float = 0.2):
    """A model whose only number is that of a prior, which no measurement depends on."""
    number = udk.Parameter(idle, guess=1.0)
    return udk.inference(pendulum(inertia, damping), NOISY, number, priors={"idle": (1.0, 0.1)})


def idle(mech, value):
    return mech


@pytest.fixture(scope="module")
def models():
    return {"damped": damped(), "undamped": fixed(damping=0.0), "known": fixed()}


def integral(log_densities) -> np.ndarray:
    """Logarithms of integrals over Z, on the last axis."""
    top = log_densities.max(-1, keepdims=True)
    return top[..., 0] + np.log(np.trapezoid(np.exp(log_densities - top), Z))


def test_evidence_is_the_integral_and_simpler_models_win(models):
    found = udk.compare(models)
    assert found.names == ("known", "damped", "undamped") and found.best == "known"
    by_name = dict(zip(found.names, found.scores, strict=True))
    mode = models["damped"].fit_problem.unknowns.z_of(np.array([0.2]))
    exact = integral(np.asarray(models["damped"].log_densities(mode + Z[:, None])))
    assert abs(by_name["damped"] - exact) < 4 * found.errors[1] + 1e-3
    residuals = NOISY.values[ANGLE] - swing(pendulum())
    known = -0.5 * np.sum((residuals / SIGMA) ** 2) - len(TS) * np.log(SIGMA * np.sqrt(2 * np.pi))
    assert_allclose(by_name["known"], known, atol=1e-2)
    odds = np.exp(np.array([0.0, exact - known]))
    assert_allclose(found.probabilities[:2], odds / odds.sum(), atol=0.01)
    assert found.probabilities[2] < 1e-9 and "undamped" in str(found) and "the best first" in str(found)
    assert udk.compare({"a": models["damped"], "b": models["undamped"]}).message == "a is right with probability 1"


def test_each_value_is_predicted_from_the_others(models):
    pytest.importorskip("arviz")
    found = udk.compare(models, by="loo")
    assert found.names[2] == "undamped" and found.differences[2] < -5 * found.difference_errors[2]
    assert not found.decided and "do not decide" in found.message and np.isnan(found.probabilities).all()
    problem = models["damped"]
    z = problem.fit_problem.unknowns.z_of(np.array([0.2])) + Z[:, None]
    each = np.asarray(jax.jit(jax.vmap(problem.log_likelihoods))(z))
    total = np.asarray(problem.log_densities(z))
    exact = np.sum(integral(total[None]) - integral(total[None] - each.T))
    assert_allclose(found.scores[found.names.index("damped")], exact, atol=0.2)


@pytest.mark.parametrize("by", ["evidence", "loo"])
def test_draws_give_the_same_scores(models, by):
    pytest.importorskip("arviz")
    drawn = udk.sample(models["damped"], chains=4, draws=100, warmup=100, progress=False)
    found = udk.compare({"drawn": drawn, "approximate": models["damped"]}, by=by)
    # For one parameter, a left-out score varies as chi^2 / 2 over the draws: by 0.08 for 400 and 1024 of these.
    assert abs(found.differences[1]) < (0.05 if by == "evidence" else 0.3) and (found.exponents < 0.67).all()


def test_other_records_and_missing_priors_are_named(models):
    with pytest.raises(udk.IdentificationError, match='"b" and "a" are of different measured values'):
        udk.compare({"a": models["damped"], "b": udk.inference(pendulum(), record(), NAMES[:1])})
    free = udk.inference(pendulum(), NOISY, NAMES[:1])
    with pytest.raises(udk.IdentificationError, match=f'evidence of "free" needs a prior or bounds of {NAMES[0]}'):
        udk.compare({"free": free, "known": models["known"]})
    both = udk.compare({"free": free, "again": free})
    assert_allclose(both.differences, 0.0)
    assert not both.decided
    with pytest.raises((TypeError, ValueError), match="at least two"):
        udk.compare({"a": free})


# --- friction laws

SECONDS = np.linspace(0.0, 8.0, 80)
LAWS = {
    "none": {},
    "viscous": {"force.viscous.damping": (0.0, 0.3)},
    "dry": {"force.dry.torque": (0.0, 0.6)},
    "both": {"force.viscous.damping": (0.0, 0.3), "force.dry.torque": (0.0, 0.6)},
}


def swinging(law: str, viscous: float = 0.1, dry: float = 0.2) -> udk.Mechanism:
    """A rod on a pin with one of four laws of friction."""
    rod = udk.library.compound_pendulum(angle=1.2)
    forces = {
        "viscous": udk.TorsionSpring(("ground", "rod"), stiffness=0.0, damping=viscous),
        "dry": udk.Friction("pin", torque=dry, velocity=0.1),
    }
    return udk.Mechanism(rod.bodies, rod.joints, forces={k: f for k, f in forces.items() if law in (k, "both")})


@pytest.mark.slow
def test_the_right_law_of_friction_is_found():
    """Four data sets of each law are compared; all problems share compiled programs."""
    inertia, right = {"body.rod.inertia": (0.375, 0.1)}, 0
    start = udk.Record(SECONDS, {ANGLE: np.zeros(len(SECONDS))}, SIGMA)
    problems = {
        law: udk.inference(swinging(law), start, ["body.rod.inertia", *priors], priors={**inertia, **priors})
        for law, priors in LAWS.items()
    }
    random = np.random.default_rng(1)
    for law in 4 * [*LAWS]:
        y = swing(swinging(law), SECONDS) + SIGMA * random.standard_normal(len(SECONDS))
        found = udk.compare({name: problem.with_measured(y) for name, problem in problems.items()})
        right += found.best == law
        assert (found.exponents < 1.5).all()  # also where both coefficients are zero within their errors
    assert right >= 15
