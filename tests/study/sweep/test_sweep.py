"""Sweeps: each member equals a separate run, failures are data, and only requested variables are stored."""

import json
import pickle
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.study.sweep.chunks import CHUNK_SECONDS, _cut, compute_members, estimate_cost
from udkjax.study.sweep.dataset import NOT_COMPUTED, assemble, bytes_per_member
from udkjax.study.sweep.executors import compute_on_devices, run
from udkjax.study.sweep.groups import group_run
from udkjax.study.sweep.plan import Chunk, make_plan

LINKS = ("link1", "link2", "link3")
TS = np.linspace(0.0, 1.0, 6)
MASSES, TOLERANCES = [1.0, 2.5, 4.0], [1e-3, 1e-7, 1e-11]
STEPS = 15  # too few for the tightest of the tolerances, to the later of the ends


def swing(mechanism, solution):
    return {"highest": jnp.max(solution.q[:, 0, 1]), "path": solution.q[:, 0, :2]}


AXES = {"mass": udk.Axis(MASSES, of="body.rod.mass"), "tol": udk.Axis(TOLERANCES, of=["rtol", "atol"]), "t1": [1.0, 0.5]}


@pytest.fixture(scope="module")
def pendulum():
    return udk.library.compound_pendulum(0.8)


@pytest.fixture(scope="module")
def reference(pendulum):
    return np.asarray(udk.simulate(pendulum, TS, rtol=1e-10, atol=1e-10).q)


@pytest.fixture(scope="module")
def plan(pendulum, reference):
    return make_plan(pendulum, AXES, TS, ["final", "error", "counts", swing], reference=reference, max_steps=STEPS)


@pytest.fixture(scope="module")
def finished(plan):
    return [(chunk.members, data) for chunk, data, _ in compute_members(plan, compute_on_devices)]


@pytest.fixture(scope="module")
def data(plan, finished):
    return assemble(plan, finished)


@pytest.mark.slow
def test_each_member_is_as_by_itself(data, pendulum, reference):
    for i, j, k in ((0, 0, 0), (2, 1, 0), (1, 1, 1)):
        mechanism = pendulum.with_parameters({"body.rod.mass": MASSES[i]})
        solution = udk.simulate(mechanism, TS * AXES["t1"][k], rtol=TOLERANCES[j], atol=TOLERANCES[j])
        member = data.isel(mass=i, tol=j, t1=k)
        assert int(member.result) == 0 and int(member.end_time == AXES["t1"][k])
        assert int(member.steps) == int(solution.stats["steps"]) and int(member.accepted) == int(solution.stats["accepted"])
        # Rounding changes the sizes of steps a little, and with them a small part of the error that the tolerance allows.
        near = partial(assert_allclose, rtol=0, atol=1e-13 + 1e-6 * TOLERANCES[j])
        near(member.q_end, solution.q[-1])
        near(member.v_end, solution.v[-1])
        near(member.swing_path, solution.q[:, 0, :2])
        error = np.abs(solution.q - reference)
        near(member.position_error, error[..., :2].max())
        near(member.angle_error, error[..., 2].max())


def test_what_fails_is_data(data):
    tight = data.sel(tol=1e-11, t1=1.0)
    assert np.all(tight.result == udk.Result.step_limit)
    assert np.all(np.isnan(tight.q_end)) and np.all(tight.steps == STEPS) and np.all(tight.end_time < 1.0)
    assert np.all(np.isfinite(tight.swing_path[:, 0])) and np.all(np.isnan(tight.swing_path[:, -1]))
    assert np.all(data.sel(tol=1e-3).result == 0) and np.all(np.isfinite(data.sel(tol=1e-3).q_end))
    meanings = dict(zip(data.result.attrs["flag_values"], data.result.attrs["flag_meanings"].split(), strict=True))
    assert meanings[1] == "step_limit" and meanings[NOT_COMPUTED] == "not_computed"
    assert "max_steps" in json.loads(data.result.attrs["causes"])["1"]


def test_the_dataset_says_what_it_is(data, pendulum):
    assert data.q_end.dims == ("mass", "tol", "t1", "body", "coordinate")
    assert data.swing_path.dims[:4] == ("mass", "tol", "t1", "time") and data.swing_highest.dims == ("mass", "tol", "t1")
    assert (data.mass.attrs["units"], data.t1.attrs["units"], data.mass.attrs["of"]) == ("kg", "s", "body.rod.mass")
    assert data.time.attrs["units"] == "1"  # runs of other lengths have their own times
    assert data.attrs["setting_max_steps"] == STEPS and udk.loads(data.attrs["scene"]).name == pendulum.name
    assert "position_error" in data and "rank" not in data and "q" not in data


def test_settings_name_the_axes_that_replace_their_numbers(pendulum):
    axes = {"gain": udk.Axis([2.0, 5.0], of="alpha"), "rank_tol": [1e-8]}
    plan = make_plan(pendulum, axes, TS, stabilization=udk.Baumgarte(7.0, 9.0), method=udk.SVD())
    attributes = assemble(plan, []).attrs
    assert attributes["setting_stabilization"] == "Baumgarte(alpha=axis gain, beta=9)"
    assert attributes["setting_method"].startswith("SVD(rank_tol=axis rank_tol")


def test_what_is_not_finished_is_marked(plan, finished):
    members, values = finished[0]
    part = assemble(plan, [(members[:4], {name: array[:4] for name, array in values.items()})])
    assert np.sum(part.result.values == NOT_COMPUTED) == plan.size - 4
    assert np.isnan(part.q_end.values[part.result.values == NOT_COMPUTED]).all()


def test_other_values_take_the_same_program(pendulum, compilations):
    """Only other values of the axes share a program; other output times, for example, are other constants."""
    ends = lambda masses, ts: udk.sweep(pendulum, {"body.rod.mass": masses}, ts, progress=False).q_end.values  # noqa: E731
    ends([1.0, 2.0], TS)
    found = []
    assert compilations(lambda: found.append(ends([3.0, 5.0], TS))) == []
    members = [pendulum.with_parameters({"body.rod.mass": mass}) for mass in (3.0, 5.0)]
    assert_allclose(found[0], [udk.simulate(member, TS).q[-1] for member in members], rtol=0, atol=1e-12)
    assert_allclose(ends([3.0, 5.0], 0.5 * TS), [udk.simulate(member, 0.5 * TS).q[-1] for member in members], rtol=0, atol=1e-12)


def test_copies_of_a_plan_share_its_program(plan, finished, compilations):
    copy = pickle.loads(pickle.dumps(plan))
    chunk = Chunk(0, 0, finished[0][0], 1.0)
    again = {}
    assert compilations(lambda: again.update(run(copy, chunk)[1])) == []
    for name, values in finished[0][1].items():
        assert np.array_equal(again[name], values, equal_nan=True)


def test_a_member_does_not_depend_on_its_neighbours(plan, finished):
    members, values = finished[0]
    order = np.random.default_rng(0).permutation(len(members))
    other = group_run(plan, 0).compute(members[order])
    assert_allclose(other["q_end"], values["q_end"][order], rtol=0, atol=1e-14)
    assert np.array_equal(other["steps"], values["steps"][order])


def test_chunks_are_cut_by_work_and_by_memory():
    parts = _cut(np.full(1000, CHUNK_SECONDS / 100), 8, 10_000)
    assert {part.stop - part.start for part in parts[:-1]} == {96} and parts[-1].stop == 1000
    assert [part.stop - part.start for part in _cut(np.full(100, CHUNK_SECONDS), 8, 16)] == [8] * 12 + [4]
    assert {part.stop - part.start for part in _cut(np.zeros(64), 8, 17)} == {16}
    assert _cut(np.zeros(23), 8, 100) == [slice(0, 23)]


@pytest.mark.parametrize(("pace", "memory", "fewest"), [(1e-9, 2**30, 1), (100.0, 2**30, 2), (1e-9, 1, 2)])
def test_members_that_are_not_done_are_computed_once(pendulum, pace, memory, fewest):
    """This holds for any duration of the first sweep, and for any members that it has finished."""
    axes = {"body.rod.mass": np.linspace(1.0, 2.0, 300), "t1": [0.1, 0.2]}
    plan, expected, done = make_plan(pendulum, axes, [0.0, 1.0]), [], np.arange(7, 70)

    def engine(plan, chunks):
        for chunk in chunks:
            yield chunk, {}, pace * chunk.work

    chunks = [chunk for chunk, _, _ in compute_members(plan, engine, done, memory, expected.extend)]
    assert np.sort(np.concatenate([chunk.members for chunk in chunks])).tolist() == [*range(7), *range(70, plan.size)]
    assert [chunk.index for chunk in chunks] == list(range(len(chunks)))
    assert chunks[-len(expected) :] == expected and len(expected) >= fewest
    later = np.concatenate([chunk.members for chunk in expected]) % 2  # whether it runs to the later end
    assert np.all(np.diff(later) <= 0) and later[0] == 1 and later[-1] == 0


@pytest.mark.slow
def test_what_a_sweep_will_take_is_measured_of_a_piece_of_some_groups(pendulum):
    plan = make_plan(pendulum, {"max_steps": [100, 1000, 10_000], "body.rod.mass": MASSES}, [0.0, 0.1])
    found = estimate_cost(plan)
    assert (found.members, found.groups, found.tried) == (9, 3, 3) and found.chunks >= 3
    assert found.stored == 9 * bytes_per_member(plan) and found.memory > found.stored
    assert found.compiling > 0.0 and 0.0 < found.computing < found.compiling
