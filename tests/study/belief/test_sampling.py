"""Draws compared with integrals and with another sampler; continued after an interruption to the same numbers."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.study.belief.test_log_density import record
from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum, swing
from udkjax.study.belief.chains import ChainCoordinates, Tuning, settled, tuned
from udkjax.study.identify.density.laplace import weigh
from udkjax.study.sweep.store import StoreError

pytest.importorskip("arviz")
FEW: dict[str, Any] = {"chains": 4, "draws": 200, "warmup": 100, "progress": False}


def idle(mech, value):
    return mech


@pytest.fixture(scope="module")
def problem():
    """One parameter of a pendulum, and one that only a normal prior determines."""
    parameters = [NAMES[0], udk.Parameter(idle, guess=1.0, transform="free")]
    return udk.inference(pendulum(0.38), record(), parameters, priors={NAMES[0]: (0.4, 0.05), "idle": (2.0, 0.3)})


@pytest.fixture(scope="module")
def posterior(problem):
    return udk.sample(problem, **FEW)


def quadrature(problem) -> tuple[float, float]:
    """Mean and deviation of the first parameter, which is independent of the second."""
    mode = problem.fit_problem.unknowns.z_of(np.array([0.4, 2.0]))
    z = mode + np.stack([np.linspace(-0.4, 0.4, 2001), np.zeros(2001)], axis=1)
    densities = np.asarray(problem.log_densities(z))
    weights = np.exp(densities - densities.max())
    values = problem.unknowns.values(z)[:, 0]
    mean = np.average(values, weights=weights)
    return mean, np.sqrt(np.average((values - mean) ** 2, weights=weights))


def test_moments_are_those_of_integrals(problem, posterior):
    assert posterior.x.shape == (4, 200, 2) and posterior.names == (NAMES[0], "idle")
    for (mean, deviation), name in ((quadrature(problem), NAMES[0]), ((2.0, 0.3), "idle")):
        row = posterior.summary()[name]
        assert row.bulk > 100 and row.rhat < 1.05
        assert abs(row.mean - mean) < 5.0 * deviation / np.sqrt(row.bulk)
        assert_allclose(row.deviation, deviation, rtol=5.0 / np.sqrt(2.0 * row.bulk))
        assert_allclose((row.low, row.high), np.quantile(posterior.draws[name], (0.03, 0.97)))
    assert_allclose(posterior.log_density, [np.asarray(problem.log_densities(x)) for x in posterior.x], rtol=1e-9)
    assert 0.6 < posterior.acceptance.mean() < 0.95


def test_it_prints_its_rows_and_goes_to_arviz(problem, posterior):
    text = str(posterior)
    assert "4 chains of 200 draws" in text and "94 % interval" in text and "idle" in text and "R-hat" in text
    data = posterior.to_arviz()
    assert data["posterior"]["idle"].dims == ("chain", "draw") and data["posterior"][NAMES[0]].attrs["units"] == "kg m2"
    assert_array_equal(data["sample_stats"]["diverging"], posterior.divergent)
    total = data["log_likelihood"]["y"].values.sum(-1)[1, 3] + float(problem.log_prior(posterior.x[1, 3]))
    assert_allclose(total, posterior.log_density[1, 3], rtol=1e-9)
    spread = (data["posterior_predictive"]["y"] - data["observed_data"]["y"]).std(("chain", "draw"))
    assert_allclose(spread.mean(), 0.01, rtol=0.2)


def stop_after(count: int):
    def stop(state):
        if state.done >= count:
            raise KeyboardInterrupt

    return stop


def test_it_continues_from_its_folder_to_the_same_numbers(problem, posterior, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        udk.sample(problem, **{**FEW, "progress": stop_after(50)}, out=tmp_path)
    part = udk.sample(problem, **{**FEW, "progress": stop_after(175)}, out=tmp_path)
    assert part.x.shape[1] == 75 and "interrupted after 75 of 200 draws" in part.message
    next((tmp_path / "chunks").glob("000002-*")).unlink()
    whole = udk.sample(problem, **FEW, out=tmp_path)
    for name in ("x", "log_density", "acceptance", "steps"):
        assert_array_equal(getattr(whole, name), getattr(posterior, name))
    assert_array_equal(part.x, posterior.x[:, :75])
    fewer = udk.sample(problem, **{**FEW, "draws": 60}, out=tmp_path)
    assert_array_equal(fewer.x, posterior.x[:, :60])


def test_a_folder_of_another_posterior_is_refused(problem, tmp_path):
    udk.sample(problem, chains=2, draws=1, warmup=25, out=tmp_path, progress=False)
    with pytest.raises(StoreError, match=r"(?s)contains another posterior.*seed: was 0, is now 1"):
        udk.sample(problem, chains=2, draws=1, warmup=25, seed=1, out=tmp_path, progress=False)
    other = udk.inference(pendulum(0.38), record(), NAMES[:1], priors={NAMES[0]: lambda x: -((x - 0.4) ** 2)})
    with pytest.raises(StoreError, match=r"(?s)unknowns\.idle.* is now missing"):
        udk.sample(other, chains=2, draws=1, warmup=25, out=tmp_path, progress=False)


def test_an_estimate_gives_its_posterior():
    estimate = udk.identify(pendulum(0.4), record(None), NAMES[:1], n_starts=0)
    found = udk.sample(estimate, **FEW)
    row = found.summary()[NAMES[0]]
    assert abs(row.mean - estimate.values[0]) < estimate.uncertainty.standard_errors[0]
    assert_allclose(row.deviation, estimate.uncertainty.standard_errors[0], rtol=0.25)


@pytest.mark.slow
def test_numpyro_draws_from_the_same_density(problem, posterior):
    infer = pytest.importorskip("numpyro.infer")
    kernel = infer.NUTS(potential_fn=lambda x: -problem.log_density(x))
    runs = infer.MCMC(kernel, num_warmup=200, num_samples=400, progress_bar=False)
    runs.run(jax.random.key(0), init_params=jnp.asarray(problem.start))
    for name, values in problem.parameters(runs.get_samples()).items():
        row, values = posterior.summary()[name], np.asarray(values)
        assert abs(row.mean - values.mean()) < 5.0 * row.deviation * np.sqrt(1.0 / row.bulk + 1.0 / 100)
        assert_allclose(row.deviation, values.std(), rtol=0.3)


# --- runs that fail, friction, events


def test_runs_that_fail_are_rejected():
    """No run takes the steps of a pendulum with less than about 0.4 kg m2: half of the proposals fail."""
    steps = udk.inference(pendulum(0.4), record(), NAMES[:1]).max_steps // 20
    free = udk.inference(pendulum(0.4), record(0.1), NAMES[:1], max_steps=steps)
    found = udk.sample(free, **{**FEW, "draws": 100})
    assert found.failed.any() and not (found.failed & found.divergent).any()
    assert np.isfinite(found.log_density).all() and np.ptp(found.x, axis=1).min() > 0.0
    assert "of the proposals have no density" in found.message


def sticking() -> udk.Mechanism:
    mech = pendulum(0.4)
    return udk.Mechanism(
        mech.bodies, mech.joints, forces={**mech.forces, "dry": udk.Friction("pin", torque=0.3, law="set-valued")}
    )


TIMES = np.linspace(0.0, 1.5, 30)
LIMIT: dict[str, Any] = {"events": udk.JointLimit("pin", lower=-1.5, restitution=0.6)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["events", "friction"])
def test_friction_and_events(kind):
    mech, name, settings = (sticking(), "force.dry.torque", {}) if kind == "friction" else (pendulum(0.4), NAMES[0], LIMIT)
    angle = np.asarray(udk.simulate(mech, TIMES, **settings).q)[:, 0, 2] + 0.01 * np.cos(97.0 * TIMES)
    truth = float(mech.parameters()[name])
    data = udk.Record(TIMES, {"body.rod.angle": angle}, 0.01)
    found = udk.sample(udk.inference(mech.with_parameters({name: 1.03 * truth}), data, [name], **settings), **FEW)
    row = found.summary()[name]
    assert row.rhat < 1.05 and abs(row.mean - truth) < 4.0 * row.deviation < 0.4 * truth


# --- wrong input


def test_unknowns_that_nothing_determines_are_named():
    parameters = [NAMES[0], udk.Parameter(idle, guess=1.0)]
    with pytest.raises(udk.IdentificationError, match="neither the records nor a prior determine idle: give"):
        udk.sample(udk.inference(pendulum(0.4), record(), parameters))


def test_records_without_noise_need_a_given_one():
    exact = udk.Record(TS, {ANGLE: swing(pendulum())})
    with pytest.raises(
        udk.IdentificationError, match=r"the records fit to rounding, as simulated ones do: give .*, noise=\.\.\."
    ):
        udk.sample(udk.inference(pendulum(), exact, NAMES[:1]))


def test_a_prior_may_end_between_start_and_optimum():
    prior = {NAMES[0]: lambda x: jnp.where(x > 0.39, 0.0, -jnp.inf)}
    found = udk.sample(udk.inference(pendulum(0.4), record(0.3), NAMES[:1], priors=prior), **FEW)
    assert 0.39 < found.draws[NAMES[0]].min() < 0.395 and found.failed.any() and np.isfinite(found.log_density).all()


def test_bounds_that_exclude_the_optimum_hold():
    parameter = udk.Parameter(NAMES[0], bounds=(0.42, 0.6), guess=0.5)
    found = udk.sample(udk.inference(pendulum(0.5), record(0.2), parameter), **FEW)
    assert 0.42 < found.draws[NAMES[0]].min() < 0.425 and found.draws[NAMES[0]].max() < 0.6


def narrow(low: float, high: float):
    """A density that is zero except near the start, between two values."""
    prior = {NAMES[0]: lambda x: jnp.where((x > low) & (x < high), 0.0, -jnp.inf)}
    return udk.inference(pendulum(0.4), record(1.0), NAMES[:1], priors=prior)


def test_a_density_that_is_zero_almost_everywhere_is_refused():
    with pytest.raises(udk.IdentificationError, match="zero at all 255 vectors drawn around its mode: give a prior or bounds"):
        udk.sample(narrow(0.4 - 1e-9, 0.4 + 1e-9), **FEW)


def test_chains_that_never_move_are_refused(monkeypatch, problem):
    from udkjax.study.belief import sampling

    def stuck(all_fail: bool):
        def compute(coordinates, root, randomness, state):
            D, C = 25, len(state.position)
            kept = state._replace(logdensity=np.full(C, -np.inf if all_fail else 0.0))
            found = {"position": np.tile(state.position, (D, 1, 1)), "acceptance": np.zeros((D, C))}
            return kept, found

        return lambda problem: compute

    for all_fail, text in ((True, "density is zero wherever the 25 first proposals"), (False, "no chain accepted any proposal")):
        monkeypatch.setattr(sampling, "compile_draws", stuck(all_fail))
        with pytest.raises(udk.IdentificationError, match=text):
            udk.sample(problem, **FEW)


def test_a_mode_without_density_is_named():
    """No run takes as few steps as allowed with a thousandth of the inertia."""
    steps = udk.inference(pendulum(0.6), record(), NAMES[:1]).max_steps // 20
    free = udk.inference(pendulum(0.6), record(), NAMES[:1], max_steps=steps)
    with pytest.raises(udk.IdentificationError, match="zero at its mode, where a run fails: give a prior or bounds"):
        weigh(free, np.array([-7.0]), np.eye(1))


def test_wrong_arguments_are_named(problem):
    with pytest.raises((TypeError, ValueError), match="chains"):
        udk.sample(problem, chains=0)
    with pytest.raises((TypeError, ValueError), match="density"):
        udk.sample(pendulum())  # pyright: ignore[reportArgumentType]


# --- coordinates and tuning


def test_coordinates_are_ratios_that_stay_positive():
    these = ChainCoordinates(np.array([0.3, -1.0, 2.0]), np.array([True, False, True]))
    for w in (np.array([1.0, 0.5, 0.05]), np.array([2.0, -3.0, -5.0]), np.array([40.0, 0.0, -1e4])):
        x = these.x(w)
        assert_allclose(np.asarray(these.x(w, jnp)), x, rtol=1e-12)
        slopes = jax.jacfwd(lambda w: these.x(w, jnp))(w)
        if w[2] > -50.0:
            assert_allclose(these.log_slope(w), np.linalg.slogdet(slopes)[1], rtol=1e-10)
            assert_allclose(these.w(x), w, rtol=1e-9)
        assert np.isfinite(these.log_slope(w)) and np.isfinite(jax.grad(these.log_slope)(w)).all()
    assert_allclose(np.exp(these.x(np.array([1.5, 0.0, 0.7])) - these.mode), [1.5, 1.0, 0.7], rtol=1e-3)


def test_the_step_finds_the_acceptance():
    from scipy.special import ndtr

    random, chunks = np.random.default_rng(3), []
    first = Tuning(0.3, np.eye(2))
    true = np.array([[4.0, 1.0], [1.0, 2.0]])
    for _ in range(12):
        step = tuned(first, chunks).step
        acceptance = np.full((25, 4), 2.0 * ndtr(-0.3 * step**2))
        chunks.append({"acceptance": acceptance, "position": random.multivariate_normal(np.zeros(2), true, (25, 4))})
    end = settled(first, chunks)
    assert_allclose(2.0 * ndtr(-0.3 * end.step**2), 0.8, rtol=0.01)
    assert_allclose(end.covariance, true, rtol=0.3)
