"""Stored variables of a member, and their derivatives."""

import pickle

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.native.loaded_code import FEW_MEMBERS
from udkjax.study.accuracy import exact_coordinates
from udkjax.study.sweep.measures import RANK_NOT_REACHED, guess_label, measures_of

TS = np.linspace(0.0, 1.0, 6)
FOUR_BAR = udk.library.four_bar()


def test_a_measure_goes_by_the_name_that_it_is_given():
    def names(measure):
        return [name for one in measures_of(measure, None, TS, FOUR_BAR) for name in one.labels]

    assert names("final") == ["q_end", "v_end"] and names({"final": "final"}) == ["q_end", "v_end"]
    assert names({"last": "final", "open": "violation"}) == ["last_q_end", "last_v_end", "open"]


def test_only_what_needs_all_output_times_gets_them():
    assert [m.along for m in measures_of(["final", "counts", "violation", lambda m, s: s.q], None, TS, FOUR_BAR)] == [
        False,
        False,
        True,
        True,
    ]


def test_a_users_arrays_are_labelled_by_their_shapes():
    assert guess_label("x", (6, 4, 3), 6, (4, 3)).dims == ("time", "body", "coordinate")
    assert guess_label("x", (6, 2), 6, (4, 3)).dims == ("time", "x_1")
    assert guess_label("x", (4, 3), 6, (4, 3)).dims == ("body", "coordinate")
    assert guess_label("x", (), 6, (4, 3)).dims == ()


def test_arrays_of_a_function_without_a_name_go_by_their_own():
    data = udk.sweep(FOUR_BAR, {"body.crank.mass": [1.0]}, TS[:2], lambda m, s: {"top": jnp.max(s.q[:, 0, 1])}, progress=False)
    assert "top" in data and not [name for name in data if "lambda" in str(name)]


@pytest.mark.parametrize("wrong", [lambda m, s: np.max(np.asarray(s.q)), lambda m, s: s.q if s.q[-1, 0, 0] > 0 else -s.q])
def test_a_measure_that_cannot_be_traced_is_refused_with_the_cure(wrong):
    with pytest.raises(udk.SweepError, match=r'measure "lambda": write it in jax\.numpy'):
        udk.sweep(FOUR_BAR, {"body.crank.mass": [1.0, 2.0]}, TS[:2], wrong, progress=False)


@pytest.mark.slow
def test_channels_are_measures():
    ts = TS[:3] / 10
    axes = {"body.crank.mass": [1.0, 2.0]}
    data = udk.sweep(
        FOUR_BAR, axes, ts, {"pin.C.x": "pin.C.x", "rise": "body.coupler(0.1, 0).vy"}, derivatives=["body.crank.mass"]
    )
    assert (data["pin.C.x"].units, data.rise.units, data.rise.dims) == ("m", "m/s", ("body.crank.mass", "time"))
    runs = [FOUR_BAR.with_parameters({"body.crank.mass": mass}) for mass in (1.0, 2.0)]
    for k, mech in enumerate(runs):
        sol = udk.simulate(mech, ts)
        assert_allclose(data["pin.C.x"][k], udk.path(mech, sol, "C")[:, 0], rtol=0, atol=1e-12)
        assert_allclose(data.rise[k], udk.path(mech, sol, "coupler", [0.1, 0.0], derivative=1)[:, 1], rtol=0, atol=1e-12)
    pickle.dumps(measures_of("pin.C.x", None, ts, FOUR_BAR))
    with pytest.raises(udk.SweepError, match=r'measure "pin.Q.x": no pin named "Q"'):
        udk.sweep(FOUR_BAR, axes, ts, "pin.Q.x")


@pytest.mark.slow
def test_measures_by_name_are_what_one_would_compute():
    linkage = udk.library.parallelogram()
    exact = exact_coordinates(linkage, TS, linkage.q0, linkage.v0)
    assert exact is not None
    axes = {"stabilization": [None, udk.Projection()], "rank_tol": [1e-4, 10.0], "method": [udk.SVD()]}
    data = udk.sweep(
        linkage,
        axes,
        TS,
        ["states", "violation", "energy_drift", "error", "rank"],
        reference=exact,
        rtol=1e-5,
        atol=1e-5,
        progress=False,
    ).isel(pseudoinverse=0)
    for k, stabilization in enumerate(axes["stabilization"]):
        # In lanes, as members of the sweep: a single run rounds otherwise. A step's length follows from the error estimate of the
        # step before, a small difference of rounded numbers, so that steps end 4e-9 earlier or later; where the interpolated
        # output between them is 6e-6 off the constraints, it then differs by 1e-12, and by as much if the start moves by 1e-15.
        choices = {"rtol": 1e-5, "atol": 1e-5, "stabilization": stabilization, "throw": False}
        equal = jax.vmap(lambda tol: udk.simulate(linkage, TS, method=udk.SVD(tol), **choices))(jnp.full(FEW_MEMBERS + 1, 1e-4))  # noqa: B023
        solution = jax.tree.map(lambda x: x[0], equal)
        member, total = data.isel(stabilization=k, rank_tol=0), udk.energy(linkage, solution).total
        assert_allclose(member.q, solution.q, rtol=0, atol=1e-12)
        assert_allclose(member.violation, np.abs(udk.violation(linkage, solution)).max(), rtol=0, atol=1e-14)
        assert_allclose(member.energy_drift, np.abs(total - total[0]).max(), rtol=0, atol=1e-12)
        assert_allclose(member.position_error, np.abs(solution.q - exact)[..., :2].max(), rtol=0, atol=1e-12)
        assert np.all(member["rank"] == 11)
    lost = data.isel(stabilization=0, rank_tol=1)  # no row counts: the bodies fall apart, and that is seen after a few steps
    reached = float(lost.end_time) >= TS
    assert int(lost.result) == udk.Result.drift and not reached[2:].any()
    assert lost["rank"].values.tolist() == np.where(reached, 0, RANK_NOT_REACHED).tolist()


@pytest.mark.slow
def test_derivatives_are_those_of_each_member_by_itself():
    pendulum, names = udk.library.compound_pendulum(0.8), ["gravity[1]", "mass", "t1", "body.rod.inertia"]
    axes = {"mass": udk.Axis([1.0, 2.5], of="body.rod.mass"), "t1": [1.0, 0.5], "rtol": [1e-9]}

    def end(gravity, mass, t1, inertia):
        values = {"body.rod.mass": mass, "gravity[1]": gravity, "body.rod.inertia": inertia}
        adjoint = diffrax.ForwardMode()
        return udk.simulate(pendulum.with_parameters(values), TS[[0, -1]] * t1, rtol=1e-9, adjoint=adjoint, throw=False).q[-1]

    data = udk.sweep(pendulum, axes, TS, "final", derivatives=names, progress=False)
    assert data["d_q_end_d_mass"].dims == data.q_end.dims
    inertia = float(pendulum.bodies["rod"].inertia)
    slopes = jax.jit(jax.jacfwd(lambda x: end(*x)))
    for i, k in ((0, 0), (1, 1)):
        expected = slopes(jnp.array([-9.81, axes["mass"].values[i], axes["t1"][k], inertia]))
        member = data.isel(mass=i, t1=k, rtol=0)
        for column, name in enumerate(names):
            assert_allclose(member[f"d_q_end_d_{name}"], expected[..., column], rtol=0, atol=1e-10)
        assert_allclose(member["d_q_end_d_t1"], member.v_end, rtol=0, atol=1e-6)
