"""A mechanism is an argument like any other: traced, stacked or made from traced numbers, it runs like a known one."""

import warnings
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.choices import fast
from tests.scaling import scaled
from udkjax.equations.rows.analysis import analyse
from udkjax.integrate.compiled_mechanism import compile_concrete
from udkjax.integrate.native_engine import mark_rows
from udkjax.integrate.prepare import AUTO
from udkjax.integrate.projection import Projection
from udkjax.native import loaded_code
from udkjax.native.run import row_marks

TIMES = np.linspace(0.0, 2.0, 9)
REDUNDANT = ("parallelogram", "planetary_gear", "scissor_lift", "peaucellier", "slider_crank", "n_four_bar")


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def marks(mechanism):
    """The independent rows that a run finds, and the usual number of independent rows."""
    analysis = analyse(mechanism)
    compiled = compile_concrete(mechanism, replace(analysis, redundant_rows=None), AUTO, Projection())
    state, scales = udk.assemble(mechanism), analysis.scales
    q, v = np.asarray(state.q).ravel(), np.asarray(state.v).ravel()
    rate = np.asarray(scales.rate) if float(scales.rate) > 0 else np.ones(())
    return mark_rows(compiled, np.zeros(()), q, v, np.asarray(scales.length), rate, np), analysis.rank


@pytest.mark.parametrize("name", fast(["scissor_lift", "peaucellier"], REDUNDANT))
def test_rows_that_depend_on_others_are_found_at_run_time(name):
    found, rank = marks(getattr(udk.library, name)())
    assert set(found) <= {0.0, 1.0}
    assert found.sum() == rank


@pytest.mark.parametrize("velocity", [2.0, -0.3])
def test_also_from_a_singular_configuration_that_is_passed(velocity):
    found, rank = marks(udk.library.parallelogram(angle=0.0, angular_velocity=velocity))
    assert found.sum() == rank == 11


@pytest.mark.parametrize("angle", [-row_marks.STEP_ASIDE.length, 0.0003])
def test_also_if_the_step_leads_to_a_singular_configuration_or_begins_near_one(angle):
    found, rank = marks(udk.library.parallelogram(angle=angle))
    assert found.sum() == rank == 11


def test_at_rest_where_branches_meet_no_row_is_left_out():
    found, _ = marks(udk.library.parallelogram(angle=0.0))
    assert_array_equal(found, np.ones(12))


@pytest.fixture(params=[0.003, pytest.param(0.3, marks=pytest.mark.slow)])
def other_step(request, monkeypatch):
    """Multiply and divide the size of the trial step to the side by ten."""

    def forget():
        loaded_code.generate.cache_clear()
        loaded_code.machine_code.cache_clear()

    forget()
    monkeypatch.setattr(row_marks, "STEP_ASIDE", row_marks.STEP_ASIDE._replace(length=request.param))
    yield
    forget()


def test_marks_do_not_depend_on_how_far_the_step_aside_goes(other_step):
    del other_step
    for name in ("parallelogram", "planetary_gear"):
        found, rank = marks(getattr(udk.library, name)())
        assert found.sum() == rank
    assert_array_equal(marks(udk.library.parallelogram(angle=0.0))[0], np.ones(12))


def test_a_jitted_function_of_a_mechanism_is_machine_code():
    traces = []

    @jax.jit
    def run(mechanism):
        traces.append(mechanism)
        return udk.simulate(mechanism, TIMES)

    for mechanism in (udk.library.parallelogram(), udk.library.parallelogram(angle=-0.3, coupler_mass=1.0)):
        found, known = run(mechanism), udk.simulate(mechanism, TIMES)
        assert found.settings["engine"] == "native"
        assert_allclose(found.q, known.q, rtol=0, atol=1e-10)
        assert int(found.stats["accepted"]) == int(known.stats["accepted"])
    assert len(traces) == 1
    filtered = eqx.filter_jit(udk.simulate)(udk.library.parallelogram(), TIMES)
    assert_allclose(filtered.q, udk.simulate(udk.library.parallelogram(), TIMES).q, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_traced_numbers_mean_scales_of_their_own():
    """A mechanism a thousand times as long and heavy takes the same steps as a known one, under jit and in a batch."""
    linkage = udk.library.parallelogram(angle=-0.3)
    sizes = [linkage, scaled(linkage, length=1e3, mass=1e3)]
    known = [udk.simulate(mechanism, TIMES) for mechanism in sizes]
    run = lambda values: udk.simulate(linkage.with_parameters(values), TIMES)  # noqa: E731
    numbers = [mechanism.parameters() for mechanism in sizes]
    batch = jax.jit(jax.vmap(run))(jax.tree.map(lambda *x: np.stack(x), *numbers))
    for k, found in enumerate(
        [jax.tree.map(lambda x: x[0], batch), jax.jit(run)(numbers[1]), jax.tree.map(lambda x: x[1], batch)]
    ):
        other = known[min(k, 1)]
        assert {name: int(x) for name, x in found.stats.items()} == {name: int(x) for name, x in other.stats.items()}
        assert_allclose(found.q, other.q, rtol=0, atol=1e-11 * np.abs(other.q).max())


@pytest.mark.slow
def test_batches_of_mechanisms_stacked_or_made_of_traced_numbers():
    angles = np.linspace(-1.2, 1.3, 11)  # some pass singular configurations
    make = lambda angle: udk.library.parallelogram(angle=angle)  # noqa: E731
    made = jax.jit(jax.vmap(lambda angle: udk.simulate(make(angle), TIMES).q))(angles)
    stacked = jax.jit(jax.vmap(lambda m: udk.simulate(m, TIMES).q))(jax.vmap(make)(angles))
    assert_array_equal(made, stacked)
    for k in (0, 5, 10):
        assert_allclose(made[k], udk.simulate(make(float(angles[k])), TIMES).q, rtol=0, atol=1e-7)


@pytest.mark.parametrize("start", [0.0, np.deg2rad(45)])
def test_singular_configurations_at_rest_and_passed(start):
    found = jax.jit(lambda a: udk.simulate(udk.library.parallelogram(angle=a), TIMES, rtol=1e-9, atol=1e-9))(start)
    known = udk.simulate(udk.library.parallelogram(angle=start), TIMES, rtol=1e-9, atol=1e-9)
    assert found.settings["engine"] == "native"
    assert_allclose(found.q, known.q, rtol=0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_by_the_geometry(derivative):
    """With respect to the initial angle, compared with the exact motion of a pendulum, and so with differences of runs."""
    end = lambda a: udk.simulate(udk.library.parallelogram(angle=a), TIMES[:5], rtol=1e-11, atol=1e-11).q[-1, 0, 2]  # noqa: E731
    h = 1e-4
    difference = (end(-0.5 + h) - end(-0.5 - h)) / (2 * h)
    assert_allclose(jax.jit(derivative(end))(-0.5), difference, rtol=1e-6)


def test_a_row_that_numbers_make_independent_is_not_left_out():
    """If one crank is slightly longer, the three cannot turn together: the linkage is stiff, traced or known."""
    linkage = udk.library.parallelogram()
    points = linkage.parameters()["joint.B2.points"] + np.array([[0.0, 0.0], [0.05, 0.02]])
    longer = linkage.with_parameters({"joint.B2.points": points})
    traced = jax.jit(lambda m: udk.simulate(m, TIMES, throw=False))(longer)
    known = udk.simulate(udk.Mechanism(longer.bodies, longer.joints), TIMES, throw=False)
    assert int(traced.code) == int(known.code)
    assert_allclose(traced.q, known.q, atol=1e-8)


@pytest.mark.slow
def test_events_in_a_traced_mechanism():
    event = udk.Event(lambda t, frames: frames["link1"].angle + np.pi / 2, udk.Stop())

    def time(mechanism):
        events = udk.simulate(mechanism, TIMES, events=event).events
        assert events is not None
        return events.time[0]

    linkage = udk.library.parallelogram()
    assert_allclose(jax.jit(time)(linkage), time(linkage), rtol=1e-9)
