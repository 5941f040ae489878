"""The engine's modules as WebAssembly equal the code of this processor without fused multiply-add, to the last bit."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.choices import fast
from tests.wasm_host import Host, run_without_contraction
from udkjax.equations import analyse
from udkjax.integrate import native_engine
from udkjax.native import position_operations, primitive, runs
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


def concrete_call(monkeypatch, module, do):
    """The operation and the inputs of the first call of machine code by `do()` through a module of the package."""
    seen = []

    def call(operation, inputs, times):
        seen.append((operation, inputs, times))
        return primitive.call_concrete(operation, inputs, times)

    monkeypatch.setattr(module, "call_concrete", call)
    do()
    return seen[0]


@pytest.mark.parametrize("name", fast(["parallelogram"], udk.library.__all__))
def test_a_run(monkeypatch, name):
    mechanism, ts = getattr(udk.library, name)(), TIMES * SPANS.get(name, 1.0)
    found = []
    operation, inputs, times = concrete_call(
        monkeypatch, native_engine, lambda: found.append(udk.simulate(mechanism, ts, engine="native"))
    )
    wasm, native = both(operation, inputs, times)
    for x, y in zip(wasm, native, strict=True):
        assert_array_equal(x, y)
    # And the motion itself is that of the engine on this processor, within what the tolerance leaves open.
    length = float(analyse(mechanism).length)
    assert_allclose(wasm[0][0, 1:-1], np.asarray(found[0].q).reshape(len(TIMES), -1)[1:-1], rtol=0, atol=1e-6 * max(length, 1.0))


@pytest.mark.slow
@pytest.mark.parametrize("name", fast(["slider_crank"], udk.library.__all__))
def test_a_run_up_to_where_a_condition_crosses_zero(monkeypatch, name):
    mechanism, ts = getattr(udk.library, name)(), TIMES * SPANS.get(name, 1.0)
    body, path = mechanism.body_names[0], np.asarray(udk.simulate(mechanism, ts).q)[:, 0]
    k = int(np.argmax(np.ptp(path, axis=0)))
    middle, coordinate = float(path[:, k].min() + path[:, k].max()) / 2, ("x", "y", "angle")[k]
    event = udk.Event(lambda t, at: getattr(at[body], coordinate) - middle, udk.Stop())
    seen, call_members = [], primitive.call_members

    def call(*inputs, operation, times):
        seen.append((operation, inputs, times))
        return call_members(*inputs, operation=operation, times=times)

    monkeypatch.setattr(primitive, "call_members", call)
    events = udk.simulate(mechanism, ts, events=[event]).events
    operation, inputs, times = [x for x in seen if isinstance(x[0], runs.RunWatched)][-1]
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
def test_a_scene_that_runs_by_loops(monkeypatch):
    mechanism, found = udk.library.n_four_bar(14), []
    times = np.linspace(0.0, 0.2, 5)
    operation, inputs, count = concrete_call(
        monkeypatch, native_engine, lambda: found.append(udk.simulate(mechanism, times, engine="native"))
    )
    assert not operation.code.is_small
    wasm, native = both(operation, inputs, count)
    for x, y in zip(wasm, native, strict=True):
        assert_array_equal(x, y)
    assert_allclose(wasm[0][0, 1:-1], np.asarray(found[0].q).reshape(len(times), -1)[1:-1], rtol=0, atol=1e-6)


def test_marching(monkeypatch):
    seen, of_one = [], primitive.MemberCalls.of_one

    def call(calls, *inputs, times):
        seen.append((calls._operation, inputs, times))
        return of_one(calls, *inputs, times=times)

    monkeypatch.setattr(primitive.MemberCalls, "of_one", call)
    udk.kinematics(udk.library.slider_crank(), "motor", np.linspace(0.0, 1.0, 21))
    operation, inputs, times = seen[0]
    assert isinstance(operation, position_operations.March)
    wasm, native = both(operation, inputs, times)
    for x, y in zip(wasm, native, strict=True):
        assert_array_equal(x, y)
    assert np.all(np.isfinite(wasm[0]))


@pytest.mark.slow
def test_forward_tangents(monkeypatch):
    mechanism = udk.library.parallelogram()
    run, inputs, times = concrete_call(monkeypatch, native_engine, lambda: udk.simulate(mechanism, TIMES))
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
