"""Sweeps on several devices, in lanes, with changing redundant rows, and with several methods in one program."""

import os
import subprocess
import sys
import time
from dataclasses import replace

import jax
import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.study.sweep.chunks import members_to_compute
from udkjax.study.sweep.executors import other_redundant_rows, run
from udkjax.study.sweep.groups import GroupRun, group_run
from udkjax.study.sweep.plan import Chunk, make_plan

LINKS = ("link1", "link2", "link3")
DEVICES = 8
SCRIPT = """
import sys
import jax, numpy as np, udkjax as udk
from udkjax.study.sweep.chunks import compute_members
from udkjax.study.sweep.executors import compute_on_devices
from udkjax.study.sweep.plan import make_plan
from udkjax.study.sweep.groups import group_run

axes = {"mass": udk.Axis(np.linspace(1.0, 3.0, 20), of="body.rod.mass"), "rtol": np.geomspace(1e-10, 1e-4, 30)}
plan = make_plan(udk.library.compound_pendulum(), axes, [0.0, 3.0])
parts = [{"members": chunk.members, **data} for chunk, data, _ in compute_members(plan, compute_on_devices)]
found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
np.savez(sys.argv[1], **{name: values[np.argsort(found["members"])] for name, values in found.items()})
print(len(group_run(plan, 0).program.devices), len(jax.devices()))
"""


def on(devices: int, file) -> tuple[str, dict]:
    flags = f"--xla_force_host_platform_device_count={devices}"
    words = [sys.executable, "-c", SCRIPT, str(file)]
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    said = subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout
    with np.load(file) as found:
        return said, dict(found)


@pytest.mark.slow
def test_eight_devices_give_what_one_gives_bit_by_bit(tmp_path):
    alone, one = on(1, tmp_path / "one.npz")
    said, many = on(DEVICES, tmp_path / "many.npz")
    assert said.split() == [str(DEVICES)] * 2 and alone.split() == ["1", "1"]
    assert one.keys() == many.keys() and len(one["members"]) == 600
    for name in one:
        assert np.array_equal(one[name], many[name], equal_nan=True), name


@pytest.fixture(scope="module")
def cart():
    """A cart in three guides, two of which are enough if they are parallel, and a bob on it."""
    return udk.Mechanism(
        {"cart": udk.Body(1.0, 0.5), "bob": udk.Body(1.0, 0.1, (0.3, -1.0))},
        {
            "a": udk.Slot((udk.GROUND, "cart"), [(0, 0), (0.5, 0)], axis=0.0),
            "b": udk.Slot((udk.GROUND, "cart"), [(0, 0), (-0.5, 0)], axis=0.0),
            "c": udk.Slot((udk.GROUND, "cart"), [(0, 0), (0, 0)], axis=0.0),
            "pin": udk.Revolute(("cart", "bob"), [(0, 0), (-0.3, 1.0)]),
        },
    )


@pytest.mark.slow
def test_rows_that_become_independent_count_again(cart):
    assert udk.analyse(cart).redundant_rows == (2,)
    ts = [0.0, 0.5, 1.0]
    data = udk.sweep(cart, {"axis": udk.Axis([0.0, 0.3], of="joint.c.axis")}, ts, "states", progress=False)
    for k, axis in enumerate((0.0, 0.3)):
        alone = udk.simulate(cart.with_parameters({"joint.c.axis": axis}), ts)
        assert_allclose(data.q[k], alone.q, rtol=0, atol=1e-12)
    assert np.all(data.result == 0)
    assert abs(data.q.values[0, -1, 0, 0]) > 0.1 and abs(data.q.values[1, -1, 0, 0]) < 1e-12  # the cart moves, and is held


def test_members_that_drift_are_asked_for_their_own_redundant_rows(cart):
    """The analysis comes before the runs: of three members reported to drift, one has guides that are not parallel."""
    plan = make_plan(cart, {"axis": udk.Axis([0.0, 0.3, 0.0], of="joint.c.axis")}, [0.0, 0.5])
    drifted = np.full(3, udk.Result.drift)
    (rows, which), *others = other_redundant_rows(group_run(plan, 0), np.arange(3), drifted).items()
    assert (rows, which.tolist(), others) == ((), [1], [])
    assert not other_redundant_rows(group_run(plan, 0), np.arange(3), np.full(3, udk.Result.step_limit))


@pytest.mark.slow
def test_guesses_that_open_are_closed_and_what_cannot_be_is_data():
    linkage = udk.library.parallelogram()
    axes = {"angle": udk.Axis([-0.785, -0.6], of="body.link1.angle"), "reach": udk.Axis([0.5, 0.3], of="joint.B3.points[1][0]")}
    data = udk.sweep(linkage, axes, [0.0, 1.0], progress=False)
    assert data.result.values.tolist() == [[0, udk.Result.could_not_assemble]] * 2
    for k, angle in enumerate((-0.785, -0.6)):
        alone = udk.simulate(linkage.with_parameters({"body.link1.angle": angle}), [0.0, 1.0])
        assert_allclose(data.q_end[k, 0], alone.q[-1], rtol=0, atol=1e-10)
    assert np.all(np.isnan(data.q_end[:, 1]))


@pytest.fixture(scope="module")
def spread():
    """Ten seconds of the paper's linkage for various masses, lengths, initial angles and tolerances."""
    axes = {
        "mass": udk.Axis((0.5, 3.0), of="body.coupler.mass"),
        "length": udk.Axis((0.7, 1.3), of=lambda m, x: udk.with_length(m, LINKS, x)),
        "angle": udk.Axis((-0.9, -0.6), of=lambda m, x: udk.with_angle(m, LINKS, x)),
        "tol": udk.Axis(scipy.stats.loguniform(1e-10, 1e-3), of=["rtol", "atol"]),
    }
    return make_plan(udk.library.parallelogram(), axes, [0.0, 10.0], design=udk.Sobol(4096))


@pytest.mark.slow
def test_a_sweep_takes_what_a_plain_batch_takes(spread):
    """Both assemble each member, since the batch is given no states. The limit is twice the time."""
    group, members = group_run(spread, 0), members_to_compute(spread)[0]
    chunks = [Chunk(k, 0, members[at : at + 512], 1.0) for k, at in enumerate(range(0, len(members), 512))]
    numbers = group.own(members)
    mechanisms = jax.jit(jax.vmap(lambda own: group.mechanism(group.shared, own, {})))(numbers)

    @jax.jit
    @jax.vmap
    def plain(mechanism, tol):
        return udk.simulate(mechanism, [0.0, 10.0], rtol=tol, atol=tol, throw=False).q[-1]

    def cpu(function) -> float:
        start = time.process_time()
        jax.block_until_ready(function())
        return time.process_time() - start

    candidates = (lambda: [run(spread, chunk) for chunk in chunks]), (lambda: plain(mechanisms, numbers.axes["tol"]))
    for candidate in candidates:
        candidate()
    # The least of several, in turn: waiting for a thread that another program keeps from its core counts as time of this one.
    # Eight chunks are cut, called and joined in Python: 1.09 to 1.20 times the plain batch on a busy machine.
    times = np.array([[cpu(candidate) for candidate in candidates] for _ in range(9)])
    assert times[:, 0].min() < 1.3 * times[:, 1].min(), times


@pytest.mark.slow
def test_mechanisms_with_other_bodies_states_and_formulations_beside_each_other():
    one, two = udk.library.compound_pendulum(), udk.library.double_pendulum()
    mechanisms = [one, two, udk.library.compound_pendulum(0.3)]
    data = udk.sweep(one, {"mechanism": mechanisms, "max_steps": [5, 1000]}, [0.0, 1.0], progress=False)
    assert data.body.values.tolist() == ["rod", "upper", "lower"]
    assert data.result.values.tolist() == [[udk.Result.step_limit, 0]] * 3
    for k, bodies in enumerate((["rod"], ["upper", "lower"], ["rod"])):
        member = data.q_end.isel(mechanism=k).sel(max_steps=1000)
        assert_allclose(member.sel(body=bodies), udk.simulate(mechanisms[k], [0.0, 1.0]).q[-1], rtol=0, atol=1e-12)
        assert np.isfinite(member).sum() == 3 * len(bodies)

    states = [udk.assemble(mechanism) for mechanism in (one, udk.library.compound_pendulum(0.5))]
    axes = {"state": states, "formulation": [None, udk.Augmented()]}
    data = udk.sweep(one, axes, [0.0, 1.0], progress=False)
    for k, state in enumerate(states):
        for found in data.q_end[k]:
            assert_allclose(found, udk.simulate(one, [0.0, 1.0], state).q[-1], rtol=0, atol=1e-10)


def test_methods_gains_tolerances_and_thresholds_are_one_program(compilations):
    """Five pseudoinverses in one program, with all other numbers varied as well: each member equals a separate run."""
    linkage, ts = udk.library.parallelogram(), np.linspace(0.0, 0.5, 3)
    methods = [udk.SVD(1e-3), udk.Varga(1e-3), udk.Greville(1e-3), udk.Householder(1e-3), udk.GramSchmidt(1e-3)]
    axes = {
        "method": methods,
        "gain": udk.Axis([2.0, 5.0], of=["alpha", "beta"]),
        "tol": udk.Axis([1e-6, 1e-9], of=["rtol", "atol"]),
        "threshold": udk.Axis([1e-4, 1e-2], of="rank_tol"),
    }
    found = []
    count = compilations(lambda: found.append(udk.sweep(linkage, axes, ts, progress=False)))
    assert len(count) <= 4, count  # XLA's program and ours; closing the linkage has one of each
    data = found[0]
    assert data.method.values.tolist() == ["SVD", "Varga", "Greville", "Householder", "GramSchmidt"]
    assert np.all(data.result == 0)
    for k, method in enumerate(methods):
        alone = udk.simulate(linkage, ts, None, 1e-9, 1e-9, replace(method, rank_tol=1e-2), udk.Baumgarte(5.0, 5.0))
        member = data.isel({"pseudoinverse": k, "gain": 1, "tol": 1, "threshold": 1})
        assert_allclose(member.q_end, alone.q[-1], rtol=0, atol=1e-9)
        assert int(member.steps) == int(alone.stats["steps"])


def test_a_program_is_traced_once(linkage):
    """Its shapes and its executable come from one trace: a measure is called once for each."""
    traced = []
    axes = {"tol": udk.Zipped({"rtol": [1e-4, 1e-6], "atol": [1e-4, 1e-6]})}
    udk.sweep(
        linkage, axes, np.linspace(0, 0.1, 2), {"end": lambda mechanism, run: traced.append(1) or run.q[-1, 0, 0]}, progress=False
    )
    assert len(traced) == 1


@pytest.mark.parametrize("mechanism", [udk.library.peaucellier(), udk.library.planetary_gear()], ids=["drawing", "gears"])
def test_elements_of_a_fixed_mechanism_are_not_computed_by_the_program(mechanism):
    """Its program is that of the elements alone, in which nothing follows from a drawing."""
    plan = make_plan(mechanism, {"rtol": [1e-4, 1e-6]}, [0.0, 0.1], "final")
    plain = make_plan(mechanism.without_origin, {"rtol": [1e-4, 1e-6]}, [0.0, 0.1], "final")
    sizes = []
    for each in (plan, plain):
        group = GroupRun(each, 0)
        sizes.append(len(group.program._trace(group.shared, group.own(group.members[:1])).jaxpr.eqns))
    assert sizes[0] == sizes[1]
