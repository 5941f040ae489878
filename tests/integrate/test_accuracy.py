"""Trajectories compared with exact solutions, with the default settings."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomlkit
from numpy.testing import assert_allclose
from scipy.optimize import root_scalar

import udkjax as udk
from udkjax.study.accuracy import exact_coordinates

TS = np.linspace(0.0, 20.0, 401)
COARSE = np.linspace(0.0, 20.0, 41)


def error(mech, sol):
    return np.nanmax(np.abs(exact(mech, sol.ts, sol.q[0], sol.v[0]) - sol.q))


def exact(mech, ts, q, v):
    found = exact_coordinates(mech, ts, q, v)
    assert found is not None
    return found


# --- the paper's linkage for 20 s


STARTS = {  # angle, angular velocity, bound: the last four cross singular configurations
    "-45": (-45, 0.0, 5e-9),
    "-50": (-50, 0.0, 5e-9),
    "+45": (45, 0.0, 5e-7),
    "+60": (60, 0.0, 5e-7),
    "in line at rest": (0, 0.0, 5e-7),
    "up, turning": (90, -1.0, 5e-7),
}


@pytest.mark.parametrize(("angle", "rate", "bound"), STARTS.values(), ids=STARTS)
def test_linkage(angle, rate, bound):
    """All coordinates are right at all times, and all joints are closed."""
    mech = udk.library.parallelogram(np.deg2rad(angle), rate)
    sol = udk.simulate(mech, TS, rtol=1e-9, atol=1e-9)
    assert sol.result == udk.Result.successful
    assert error(mech, sol) <= bound
    # At an angle of 1e-5 from the singular configuration, the row left out is closed to rounding over that angle.
    assert jnp.abs(udk.violation(mech, sol)).max() <= 1e-10
    energy = udk.energy(mech, sol).total
    assert_allclose(energy, energy[0], atol=20 * bound)


def test_an_ordinary_run_has_no_step_rejected():
    """With a more ambitious step size one step in ten is rejected, and a run of the same accuracy takes 15 % more."""
    mech = udk.library.parallelogram(np.deg2rad(-45))
    sol = udk.simulate(mech, TS, rtol=1e-9, atol=1e-9)
    assert error(mech, sol) <= 3e-10
    assert sol.stats["rejected"] < 0.01 * sol.stats["steps"]


@pytest.mark.parametrize("scene", ["four_bar", "scissor_lift", "double_pendulum"])
def test_steps_that_would_be_rejected_are_foreseen(scene):
    """Otherwise 0.18 (the pendulum) to 0.28 (the lift) of the steps are rejected."""
    sol = udk.simulate(getattr(udk.library, scene)(), np.linspace(0.0, 10.0, 201), rtol=3e-8, atol=3e-8)
    assert sol.stats["rejected"] < 0.18 * sol.stats["steps"]


@pytest.fixture(scope="module")
def undisturbed():
    """Number of steps of a run that meets no singular configuration, by tolerance."""
    mech, known = udk.library.parallelogram(np.deg2rad(-45)), {}

    def steps(tol):
        if tol not in known:
            known[tol] = int(udk.simulate(mech, TS, rtol=tol, atol=tol).stats["steps"])
        return known[tol]

    return steps


@pytest.mark.parametrize("angle", [45, 60])
def test_singular_configurations_cost_few_steps(angle, undisturbed):
    """The run is compared with one that meets none.

    Without taking into account what projection takes back it needs four times as many steps. If steps do not know where the
    next singular configuration is, a third of them is rejected.
    """
    mech = udk.library.parallelogram(np.deg2rad(angle))
    for tol in (1e-11, 3e-12, 1e-12):
        sol = udk.simulate(mech, TS, rtol=tol, atol=tol)
        assert error(mech, sol) <= 200 * tol
        assert sol.stats["steps"] < 1.75 * undisturbed(tol) and sol.stats["rejected"] < 0.12 * sol.stats["steps"]
        assert sol.stats["right_hand_sides"] < 13.5 * sol.stats["steps"]  # hardly one was taken again with care


@pytest.mark.parametrize("angle", [-0.01, 0.0, 0.01, 0.3])
def test_runs_may_turn_back_in_singular_configurations(angle, undisturbed):
    """Also just before or after one. If shorter steps were tried first nearby, runs would take 6 to 90 times as many."""
    mech = udk.library.parallelogram(np.deg2rad(angle))
    sol = udk.simulate(mech, TS, rtol=1e-12, atol=1e-12)
    assert error(mech, sol) <= 200e-12
    assert sol.stats["steps"] < 3.6 * undisturbed(1e-12)  # 1.5 to 3, by rounding
    assert sol.stats["rejected"] < 0.35 * sol.stats["steps"]
    assert sol.stats["right_hand_sides"] < 22 * sol.stats["steps"]


@pytest.mark.parametrize("tol", [1e-9, 3e-10, 1e-10])
def test_crossing_keeps_energy_where_no_row_is_redundant_before_and_after(tol):
    """The error is below 1e-5 J. If rows below 1e-4 of the largest singular value are redundant, it is mostly 1e-4 to 6e-4 J."""
    for angle in (60, 60.001, 60.002):
        mech = udk.library.peaucellier(np.deg2rad(angle), 3.0)
        energy = udk.energy(mech, udk.simulate(mech, np.linspace(0.0, 10.0, 101), rtol=tol, atol=tol)).total
        assert_allclose(energy, energy[0], atol=2e-5)


def free_scissor_lift(stages: int, angle: float, scale: float = 1.0) -> udk.Mechanism:
    """Return a scissor lift without redundant rows: it collapses and, where its links are vertical, loses up to three ranks."""
    width, height = scale * np.cos(angle), scale * np.sin(angle)
    left = ["foot", *(f"left{i}" for i in range(1, stages)), "head"]
    right = ["slide", *(f"right{i}" for i in range(1, stages)), "top"]
    pins = {name: (0.0, i * height) for i, name in enumerate(left)} | {name: (width, i * height) for i, name in enumerate(right)}
    pins |= {f"middle{i}": (0.5 * width, (i + 0.5) * height) for i in range(stages)} | {"end": (1.2 * scale, stages * height)}
    links = [(f"rising{i}", [left[i], f"middle{i}", right[i + 1]]) for i in range(stages)]
    links += [(f"falling{i}", [left[i + 1], f"middle{i}", right[i]]) for i in range(stages)]
    drawing: dict[str, Any] = {
        "format": 2,
        "gravity": [0.0, -9.81 * scale],
        "ground": ["foot"],
        "pins": {name: [float(x) for x in place] for name, place in pins.items()},
        "link": [{"name": name, "pins": on, "width": 0.0, "mass": 1.0} for name, on in links]
        + [{"name": "platform", "pins": ["head", "end"], "mass": 5.0}],
        "slot": [
            {"name": "rail", "pin": "slide", "direction": 0.0, "on": "ground"},
            {"name": "bed", "pin": "top", "along": ["head", "end"], "on": "platform"},
        ],
    }
    return udk.loads(tomlkit.dumps(drawing))


@pytest.mark.parametrize(("stages", "scale"), [(1, 1.0), (2, 1e-6), pytest.param(2, 1e3, marks=pytest.mark.slow), (3, 1.0)])
def test_crossing_with_several_small_singular_values_keeps_energy(stages, scale):
    """Up to a thousandth of it is lost if nodes of steps meet the configurations, or independent rows are left out for longer."""
    for angle in (0.52, 0.524, 0.55):
        mech = free_scissor_lift(stages, angle, scale)
        for tol in (1e-6, 1e-8, 1e-9, 1e-10, 1e-12):
            sol = udk.simulate(mech, np.linspace(0.0, 0.85, 18), rtol=tol, atol=tol)
            energy = udk.energy(mech, sol)
            assert np.ptp(energy.total) < 100 * tol * np.max(energy.kinetic), (angle, tol)
            assert sol.stats["steps"] < 140  # by ever shorter steps, 300 and more at 1e-10


def test_outputs_beside_singular_configurations():
    """Accelerations at the end of a nearby step are inaccurate; interpolation would spread the error over the next step."""
    mech = udk.library.parallelogram(np.deg2rad(60))
    for tol in np.geomspace(3e-9, 3e-10, 12):
        energy = udk.energy(mech, udk.simulate(mech, TS, rtol=tol, atol=tol)).total
        assert np.abs(energy - energy[0]).max() < 1e3 * tol


@pytest.mark.parametrize("tol", [1e-6, 1e-9, 1e-11])
def test_outputs_in_singular_configurations(tol):
    """They are as exact as others. Rows that rounding errors have made useless once changed velocities, some by 0.2 rad/s."""
    mech = udk.library.parallelogram(np.deg2rad(60))
    angle = lambda ts: exact(mech, np.append(0.0, ts), mech.q0, mech.v0)[1:, 0, 2]  # noqa: E731
    crossing = root_scalar(lambda t: angle(t)[0], bracket=(0.4, 0.7), xtol=1e-15).root
    apart = np.logspace(-13, -2, 45)
    ts = np.concatenate([[0.0], crossing - apart[::-1], [crossing], crossing + apart, [1.0]])
    sol = udk.simulate(mech, ts, rtol=tol, atol=tol)
    assert error(mech, sol) < 10 * tol
    rate = -np.sqrt(2 * 3.5 * 9.81 / 3.05 * (np.sin(np.deg2rad(60)) - np.sin(angle(ts))).clip(0))
    assert_allclose(sol.v[:, :3, 2], np.repeat(rate[:, None], 3, axis=1), atol=max(50 * tol, 1e-6))
    assert np.abs(udk.violation(mech, sol)).max() < max(tol, 1e-9)  # rows that are dropped stay as they were interpolated


@pytest.mark.slow
def test_many_starts_cross_singular_configurations(linkage, placed):
    """A single start may be lucky: 64 starts within 5 degrees of each of three angles, all of which cross."""

    @jax.jit
    def runs(angles, tol):
        def run(angle):
            state, explicit = udk.State(*placed(angle, 0.0)), diffrax.Dopri8()  # the default also measures whether it is stiff
            sol = udk.simulate(linkage, COARSE, state, rtol=tol, atol=tol, solver=explicit)
            with_care = (sol.stats["right_hand_sides"] - 1 - 13 * sol.stats["steps"]) / 14  # and 14 more where it is taken again
            return sol.q, sol.v, sol.code, with_care

        return jax.lax.map(run, angles)

    degrees = np.concatenate([np.linspace(c - 5, c + 5, 64) for c in (60, 45, 0)])
    for tol, largest, median in ((1e-9, 2e-6, 2e-7), (1e-10, 2e-7, 2e-8)):
        q, v, code, with_care = (np.asarray(x) for x in runs(jnp.deg2rad(degrees), tol))
        assert (code == udk.Result.successful).all()
        errors = np.array([np.abs(exact(linkage, COARSE, a[0], b[0]) - a).max() for a, b in zip(q, v, strict=True)])
        assert errors.max() < largest, degrees[errors.argmax()]
        assert np.median(errors) < median
        # Each takes as long as fifty others. Some that come to rest in a singular configuration need them: those about 0.
        assert with_care[:128].sum() <= 10, with_care


# --- what stabilization is worth


@pytest.fixture(scope="module")
def unstable(linkage):
    """Run the linkage from -50 degrees with these settings; return the solution, its error and its violation."""

    def run(method, stabilization, angle=-50):
        mech = udk.library.parallelogram(np.deg2rad(angle))
        sol = udk.simulate(mech, COARSE, rtol=1e-9, atol=1e-9, method=method, stabilization=stabilization, throw=False)
        return sol, error(mech, sol), udk.violation(mech, sol)

    return run


def test_truncated_and_not_stabilized_it_drifts(unstable):
    """Redundancy makes the drift unstable: at 1.59/s, rounding errors become large after 16 to 20 s."""
    sol, _, psi = unstable(udk.SVD(), None)
    size = np.abs(psi).max(axis=1)
    assert sol.result != udk.Result.successful or np.nanmax(size) > 1e-5
    assert size[4] < 1e-8  # at 2 s
    growing = (size > 3e-8) & (size < 3e-5) & (COARSE > 8)  # above the errors of integration, below the threshold of the rank
    rate = np.polyfit(COARSE[growing], np.log(size[growing]), 1)[0]
    assert growing.sum() > 5 and 1.3 < rate < 1.9


def test_a_fixed_choice_of_rows_does_not(unstable):
    sol, wrong, psi = unstable(udk.Elimination(), None)
    assert sol.result == udk.Result.successful
    assert wrong < 1e-7
    assert np.abs(psi).max() < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("gain", [2.0, 5.0])
def test_small_gains_hold_it(unstable, gain):
    """Gains of 2 to 5 exceed the growth rate of the drift."""
    sol, wrong, psi = unstable(udk.SVD(), udk.Baumgarte(gain, gain))
    assert sol.result == udk.Result.successful
    assert wrong < 1e-7
    assert np.abs(psi).max() < 1e-7


# --- the IFToMM benchmark A02, which crosses twice a turn


@pytest.mark.parametrize("n", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_n_four_bar(data, table, n):
    known = data("iftomm_A02_n_four_bar")["cases"][f"N={n}"]
    ts, row = table({"0": {"B0x": 0, "B0y": 1, "B0vx": 1, "B0vy": 0}, **known["reference"]}, (0, 0.5, 1, 2, 4, 5, 10))
    mech = udk.library.n_four_bar(n)
    sol = udk.simulate(mech, ts, rtol=1e-9, atol=1e-9)
    k = mech.body_names.index("coupler0")  # B0 is its left end; couplers do not turn
    assert_allclose(sol.q[:, k, 0] - 0.5, row["B0x"], atol=1e-6)
    assert_allclose(sol.q[:, k, 1], row["B0y"], atol=1e-6)
    assert_allclose(sol.v[:, k, 0], row["B0vx"], atol=1e-5)
    assert_allclose(sol.q[:, k:, 2], 0.0, atol=1e-6)
    assert jnp.abs(udk.violation(mech, sol)).max() <= 1e-11


# --- one body, and machines that a driver moves: rtol = atol = 1e-10, error 1e-8


def run(mech, ts):
    sol = udk.simulate(mech, ts, rtol=1e-10, atol=1e-10)
    return sol, udk.reactions(mech, sol)


def test_simple_pendulum(data, table):
    """IFToMM A01. The rod's multiplier is its force."""
    ts, row = table(data("iftomm_A01_simple_pendulum")["reference_exact"], (0.5, 1, 2, 5, 10, 20))
    sol, loads = run(udk.library.simple_pendulum(), np.append(0.0, ts))
    assert_allclose(sol.q[1:, 0, :2], np.stack([row["x"], row["y"]], 1), atol=1e-8)
    pull = -loads["rod"]["bob"][1:, :2]  # along the rod, towards the pivot
    assert_allclose(jnp.sum(pull * sol.q[1:, 0, :2], 1), row["rod_tension"], atol=2e-7)
    assert_allclose(sol.q[:, 0, 2], 0.0, atol=1e-14)


def test_compound_pendulum(data, table):
    ts, row = table(data("compound_pendulum")["reference"])
    sol, loads = run(udk.library.compound_pendulum(), ts)
    assert_allclose(sol.q[:, 0, 2] + np.pi / 2, row["phi"], atol=1e-8)
    assert_allclose(sol.v[:, 0, 2], row["phid"], atol=5e-8)
    assert_allclose(loads["pin"]["rod"][:, :2], np.stack([row["Rx"], row["Ry"]], 1), atol=1e-6)


def test_elliptic_trammel(data, table):
    ts, row = table(data("elliptic_trammel")["reference"])
    sol, loads = run(udk.library.elliptic_trammel(), ts)
    turn = np.angle(np.exp(1j * (-sol.q[:, 0, 2] - row["theta"])))
    assert_allclose(turn, 0.0, atol=1e-8)
    assert_allclose(sol.q[:, 0, :2], np.stack([row["xc"], row["yc"]], 1), atol=1e-8)
    assert_allclose(loads["A"]["rod"][:, 0], row["H_at_A"], atol=1e-6)
    assert_allclose(loads["B"]["rod"][:, 1], row["V_at_B"], atol=1e-6)


def test_driven_pendulum(data, table):
    """No degree of freedom is left: the driver sets the motion, and the torque is that of inverse dynamics."""
    ts, row = table(data("driven_pendulum_rheonomic")["reference"])
    sol, loads = run(udk.library.driven_pendulum(), ts)
    assert_allclose(sol.q[:, 0, 2], row["theta"], atol=1e-12)
    assert_allclose(sol.v[:, 0, 2], row["thetad"], atol=1e-12)
    assert_allclose(loads["motor"]["rod"][:, 2], row["torque"], atol=1e-10)
    assert_allclose(loads["motor"]["rod"][:, :2], 0.0, atol=1e-12)
    assert_allclose(loads["pin"]["rod"][:, :2], np.stack([row["Rx"], row["Ry"]], 1), atol=1e-10)


def test_slider_crank(data, table):
    ts, row = table(data("slider_crank_constant_speed")["reference"])
    sol, loads = run(udk.library.slider_crank(), ts)
    assert_allclose(sol.q[:, 0, 2], row["theta"], atol=1e-11)
    assert_allclose(sol.q[:, 1, 2], row["phi"], atol=1e-11)
    assert_allclose(sol.q[:, 2, 0], row["x"], atol=1e-11)
    assert_allclose(sol.v[:, 2, 0], row["xd"], atol=1e-11)
    assert_allclose(loads["motor"]["crank"][:, 2], row["torque"], atol=1e-9)
    assert_allclose(loads["guide"]["slider"][:, 1], row["guide_N"], atol=1e-9)
    assert_allclose(loads["P"]["rod"][:, :2], np.stack([row["Px_on_rod"], row["Py_on_rod"]], 1), atol=1e-9)
    assert_allclose(loads["O"]["crank"][:, :2], np.stack([row["Ox"], row["Oy"]], 1), atol=1e-9)
