"""Pictures of draws: the drawn numbers, not pixels."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.testing import assert_allclose

import udkjax as udk
from tests.study.belief.test_log_density import record
from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum, swing
from udkjax.show.posterior_figures import draw_prediction, prediction_figure

pytest.importorskip("arviz")


@pytest.fixture(scope="module")
def drawn():
    estimate = udk.identify(pendulum(0.4), record(), NAMES, n_starts=0, progress=False)
    return estimate, udk.sample(estimate, chains=4, draws=100, warmup=50, progress=False)


def test_the_corner_has_draws_and_ellipses(drawn):
    estimate, posterior = drawn
    figure = udk.plot_posterior(posterior, estimate)
    pair = figure.axes[2]
    points = np.asarray(pair.collections[0].get_offsets())
    half, most = (np.asarray(line.get_xydata()) for line in pair.get_lines())
    assert_allclose(points, np.stack([posterior.draws[name].ravel() for name in NAMES], axis=1))
    assert_allclose(half[:-1], estimate.ellipse(*NAMES, 0.5))
    assert_allclose(most[:-1], estimate.ellipse(*NAMES, 0.95))
    assert pair.get_xlabel() == f"{NAMES[0]}\n(kg m2)" and pair.get_ylabel() == f"{NAMES[1]}\n(N m s/rad)"
    curve = np.asarray(figure.axes[0].get_lines()[0].get_xydata())
    assert_allclose(curve[np.argmax(curve[:, 1]), 0], estimate.values[0], rtol=0.01)
    one = udk.plot_posterior(posterior, names=[NAMES[1]])
    assert len(one.axes) == 1 and not one.axes[0].get_lines()
    with pytest.raises(udk.IdentificationError, match=r'no draws of "body.rod.inerti"; did you mean'):
        udk.plot_posterior(posterior, names=["body.rod.inerti"])


def test_predictions_cover_the_measurements(drawn):
    _, posterior = drawn
    (interval,) = posterior.prediction_intervals(draws=200)
    low, middle, high = interval[ANGLE]
    assert_allclose(middle, swing(pendulum()), atol=0.01)
    assert_allclose((high - low).mean(), 2 * 1.88 * 0.01, rtol=0.1)
    axes = draw_prediction(Figure().subplots(), posterior, ANGLE)
    assert_allclose(np.asarray(axes.get_lines()[1].get_xydata()), np.stack([TS, record().values[ANGLE]], axis=1))
    assert axes.get_ylabel() == f"{ANGLE} (rad)" and len(prediction_figure(posterior).axes) == 1
