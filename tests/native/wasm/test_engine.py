"""The engine's modules as WebAssembly equal the code of this processor without fused multiply-add, to the last bit."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.calls import calls_of
from tests.choices import fast
from tests.wasm_host import Host, run_without_contraction
from udkjax.equations import analyse
from udkjax.native import loaded_code, position_operations, runs
from udkjax.native.wasm import wasm_module
from udkjax.positions.assembling import native_closing

TIMES = np.linspace(0.0, 2.0, 41)
SPANS = {"andrews_squeezer": 0.015}  # of it, for what moves in milliseconds


def both(operation, inputs, times):
    """The outputs of an operation as WebAssembly, and as code of this processor without fused multiply-add."""
    made, inputs = wasm_module(operation), [np.ascontiguousarray(x, float) for x in inputs]
    shapes = operation.shapes(inputs, times)
    host = Host(made.linked.code, made.linked.data_end)
    return host.run(made.module, inputs, shapes), run_without_contraction(made.module, inputs, shapes)


def first_call(run):
    """The result of a run, and the operation and the inputs of its machine code."""
    with calls_of(loaded_code.call_concrete) as calls:
        found = run()
    given = next(call.arguments for call in calls if isinstance(call.arguments["operation"], runs.RunStates))
    return found, (given["operation"], given["inputs"], given["times"])


@pytest.mark.parametrize("name", fast(["parallelogram"], udk.library.__all__))
def test_a_run(name):
    mechanism, ts = getattr(udk.library, name)(), TIMES * SPANS.get(name, 1.0)
    found, (operation, inputs, times) = first_call(lambda: udk.simulate(mechanism, ts, engine="native"))
    wasm, native = both(operation, inputs, times)
    for x, y in zip(wasm, native, strict=True):
        assert_array_equal(x, y)
    # And the motion itself is that of the engine on this processor, within what the tolerance leaves open.
    length = float(analyse(mechanism).length)
    assert_allclose(wasm[0][0, 1:-1], np.asarray(found.q).reshape(len(TIMES), -1)[1:-1], rtol=0, atol=1e-6 * max(length, 1.0))


@pytest.mark.slow
@pytest.mark.parametrize("name", fast(["slider_crank"], udk.library.__all__))
def test_a_run_up_to_where_a_condition_crosses_zero(name):
    mechanism, ts = getattr(udk.library, name)(), TIMES * SPANS.get(name, 1.0)
    body, path = mechanism.body_names[0], np.asarray(udk.simulate(mechanism, ts).q)[:, 0]
    k = int(np.argmax(np.ptp(path, axis=0)))
    middle, coordinate = float(path[:, k].min() + path[:, k].max()) / 2, ("x", "y", "angle")[k]
    event = udk.Event(lambda t, at: getattr(at[body], coordinate) - middle, udk.Stop())
    with calls_of(loaded_code.call_members) as calls:
        events = udk.simulate(mechanism, ts, events=[event]).events
    given = [call.arguments for call in calls if isinstance(call.arguments["operation"], runs.RunWatched)][-1]
    operation, inputs, times = given["operation"], given["inputs"], given["times"]
    wasm, native = both(operation, inputs, times)
    for x, y in zip(wasm, native, strict=True):
        assert_array_equal(x, y)
    assert events is not None
    crossing, t = wasm[-1][0], float(events.time[0])
    assert crossing[0] == 0.0 and crossing[1] == pytest.approx(t, rel=1e-7)  # rounding, and what the tolerance makes of it
    assert crossing[4 + k] == pytest.approx(middle, abs=1e-9)  # behind three numbers and one side: q


@pytest.mark.parametrize("name", fast(["parallelogram"], udk.library.__all__))
def test_closing(name):
    mechanism = getattr(udk.library, name)()
    analysis = analyse(mechanism)
    rng = np.random.default_rng(0)
    q = np.asarray(mechanism.q0).ravel() + 0.02 * float(analysis.length) * rng.standard_normal(3 * len(mechanism.bodies))
    inputs = native_closing._inputs(mechanism.at(0.0), analysis.scales, 0.0, q, np.asarray(mechanism.v0).ravel(), np)
    (state, residuals, rank), native = both(native_closing._close(mechanism), inputs, 2)
    for x, y in zip((state, residuals, rank), native, strict=True):
        assert_array_equal(x, y)
    assert rank[0, 0] == analysis.rank
    assert np.all(np.abs(residuals[0, : residuals.shape[1] // 2]) <= 1e-9 * np.asarray(analysis.scales.rows))


@pytest.mark.slow
def test_a_scene_that_runs_by_loops():
    mechanism, times = udk.library.n_four_bar(14), np.linspace(0.0, 0.2, 5)
    found, (operation, inputs, count) = first_call(lambda: udk.simulate(mechanism, times, engine="native"))
    assert not operation.code.is_small
    wasm, native = both(operation, inputs, count)
    for x, y in zip(wasm, native, strict=True):
        assert_array_equal(x, y)
    assert_allclose(wasm[0][0, 1:-1], np.asarray(found.q).reshape(len(times), -1)[1:-1], rtol=0, atol=1e-6)


def test_marching():
    with calls_of(loaded_code.MemberCalls.of_one) as calls:
        udk.kinematics(udk.library.slider_crank(), "motor", np.linspace(0.0, 1.0, 21))
    given = calls[0].arguments
    operation, inputs, times = given["self"]._operation, given["inputs"], given["times"]
    assert isinstance(operation, position_operations.March)
    wasm, native = both(operation, inputs, times)
    for x, y in zip(wasm, native, strict=True):
        assert_array_equal(x, y)
    assert np.all(np.isfinite(wasm[0]))


@pytest.mark.slow
def test_forward_tangents():
    mechanism = udk.library.parallelogram()
    _, (run, inputs, times) = first_call(lambda: udk.simulate(mechanism, TIMES))
    n, count = run.code.coordinate_count, run.code.number_count
    operation = run.with_tangents((True,) * count)
    along = np.zeros((1, 1, count))
    along[0, 0, 1] = 1.0  # of gravity, along y
    wasm, native = both(operation, [*inputs, along, np.zeros((1, 1, n)), np.zeros((1, 1, n))], times)
    for x, y in zip(wasm, native, strict=True):
        assert_array_equal(x, y)
    # The derivative of the motion by gravity against a difference of runs.
    h = 1e-4
    values = [mechanism.with_parameters({"gravity[1]": -9.81 + s * h}) for s in (1, -1)]
    one, two = (np.asarray(udk.simulate(m, TIMES, rtol=1e-11, atol=1e-11).q).reshape(times, -1) for m in values)
    assert_allclose(wasm[4][0, 0, 1:-1, :n], ((one - two) / (2 * h))[1:-1], rtol=0, atol=1e-6)
