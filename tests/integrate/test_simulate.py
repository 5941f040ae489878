"""How a run ends, what it counts, what it returns, and what it compiles."""

import json
import subprocess
import sys

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk

TS = np.linspace(0.0, 1.0, 11)
RESULTS = udk.Result


class Until(udk.ForceElement):
    """A torque that is not a number from some time on."""

    end: float

    def loads(self, t, *frames):
        return [(0.0, 0.0, jnp.where(t < self.end, 0.0, jnp.nan))]


class BlowUp(udk.ForceElement):
    """A force that grows without bound towards some time."""

    end: float

    def loads(self, t, *frames):
        return [(1.0 / (self.end - t) ** 2, 0.0, 0.0)]


@pytest.fixture(scope="module")
def pendulum():
    return udk.library.compound_pendulum()


@pytest.fixture(scope="module")
def motion(pendulum):
    return udk.simulate(pendulum, TS)


def with_force(pendulum, force):
    return udk.Mechanism(pendulum.bodies, pendulum.joints, forces=[force])


def ended(sol, result, time, tol):
    """The run ended so, at about that time, and what lies beyond is not a number."""
    assert sol.result == result
    assert_allclose(sol.time, time, atol=tol)
    reached = np.asarray(sol.ts <= sol.time)
    assert np.isfinite(sol.q[reached]).all() and np.isfinite(sol.v[reached]).all()
    assert np.isnan(sol.q[~reached]).all() and np.isnan(sol.v[~reached]).all()
    assert reached[0]


# --- how it ends


def test_success(motion):
    assert motion.result is RESULTS.successful
    assert motion.time == 1.0
    assert "end time" in motion.cause
    assert motion.q.shape == motion.v.shape == (11, 1, 3)
    assert_allclose(motion.ts, TS)


def test_step_limit(pendulum):
    with pytest.raises(udk.SimulationError, match=r"step limit at t = 0\.\d+ s.*max_steps") as caught:
        udk.simulate(pendulum, TS, max_steps=4)
    ended(caught.value.solution, RESULTS.step_limit, 0.5, 0.4)
    assert caught.value.solution.stats["steps"] == 4
    sol = udk.simulate(pendulum, TS, max_steps=4, throw=False)
    assert_allclose(sol.q, caught.value.solution.q)


def test_a_number_that_is_not_finite(pendulum):
    mech = with_force(pendulum, Until("rod", 0.45))
    sol = udk.simulate(mech, TS, throw=False)
    ended(sol, RESULTS.not_finite, 0.45, 1e-3)
    assert_allclose(sol.q[:5], udk.simulate(with_force(pendulum, Until("rod", 9.0)), TS).q[:5], atol=1e-7)
    with pytest.raises(udk.SimulationError, match="not finite"):
        udk.simulate(mech, TS)


def test_not_finite_from_the_start(pendulum):
    sol = udk.simulate(with_force(pendulum, Until("rod", -1.0)), TS, throw=False)
    assert sol.result == RESULTS.not_finite
    assert sol.time == 0.0
    assert np.isnan(sol.q[1:]).all()


def test_a_step_that_is_too_small():
    mech = udk.Mechanism({"stone": udk.Body(1.0, 1.0)}, forces=[BlowUp("stone", 0.55)])
    sol = udk.simulate(mech, TS, throw=False)
    ended(sol, RESULTS.step_too_small, 0.55, 1e-6)
    with pytest.raises(udk.SimulationError, match=r"step too small at t = 0\.55"):
        udk.simulate(mech, TS)


def test_drift(pendulum):
    """A violation above `drift_tol` ends the solution where it was first seen."""
    sol = udk.simulate(pendulum, TS, rtol=1e-4, atol=1e-4, stabilization=None, drift_tol=1e-6, throw=False)
    psi = np.abs(udk.violation(pendulum, sol)).max(1)
    assert sol.result == RESULTS.drift
    first = int(np.flatnonzero(np.asarray(sol.ts) == float(sol.time))[0])
    assert (psi[:first] <= 1e-6).all() and psi[first] > 1e-6
    assert np.isnan(psi[first + 1 :]).all() and first < 10
    with pytest.raises(udk.SimulationError, match=r"drift at.*stabilize"):
        udk.simulate(pendulum, TS, rtol=1e-4, atol=1e-4, stabilization=None, drift_tol=1e-6)


@pytest.fixture(scope="module")
def hung():
    """A rod that swings from a pin; the pin is on a line, 1 m from a point above it, if that is not too high."""
    bodies = {"rod": udk.Body(1.0, 0.2, [1.0, -0.5], -0.8, angular_velocity=1.0)}
    joints = {
        "line": udk.Slot(["ground", "rod"], [[0.0, 0.0], [-0.75, 0.0]], axis=0.0),
        "thread": udk.Distance(["ground", "rod"], [[0.0, 0.3], [-0.75, 0.0]], 1.0),
    }
    return udk.Mechanism(bodies, joints, forces={"motor": Until("rod", 99.0)})


def test_what_cannot_be_assembled(hung):
    mech = hung.with_parameters({"joint.thread.points[0][1]": 2.0})
    with pytest.raises(udk.AssemblyError, match=r'"(line|thread)"'):
        udk.simulate(mech, TS)
    sol = udk.simulate(mech, TS, throw=False)
    assert sol.result == RESULTS.could_not_assemble
    assert sol.time == 0.0
    assert np.isfinite(sol.q[0]).all() and np.isnan(sol.q[1:]).all()
    assert sol.stats["steps"] < 100


@pytest.fixture(scope="module")
def pinned_twice(pendulum):
    """The same pin twice; `at` moves the second one along the rod, which can then no longer turn."""
    mech = udk.Mechanism(pendulum.bodies, {"pin": pendulum.joints["pin"], "again": pendulum.joints["pin"]})
    assert udk.analyse(mech).redundant_rows == (2, 3)
    along = np.array([np.cos(float(mech.q0[0, 2])), np.sin(float(mech.q0[0, 2]))])
    return lambda at: mech.with_parameters({"joint.again.points[0]": at * along, "joint.again.points[1][0]": at - 0.75})


def test_rows_that_become_independent_count_again(pinned_twice):
    """It cannot move, and it does not move silently, though the analysis of other numbers is given."""
    stuck, other = pinned_twice(0.4), udk.analyse(pinned_twice(0.0))
    assert udk.analyse(stuck).redundant_rows != other.redundant_rows == (2, 3)
    sol = udk.simulate(stuck, TS, throw=False, analysis=other)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.q, jnp.broadcast_to(stuck.q0, sol.q.shape), atol=1e-9)


def test_and_say_so_where_numbers_are_traced(pinned_twice, motion):
    run = jax.jit(lambda at: udk.simulate(pinned_twice(at), TS))
    assert run(0.4).code == RESULTS.drift
    free = run(0.0)
    assert free.code == RESULTS.successful
    assert_allclose(free.q, motion.q, atol=1e-9)


# --- what goes in


@pytest.mark.parametrize("ts", [0.0, [0.0], [[0.0, 1.0]], [0.0, 1.0, 1.0], [1.0, 0.0]])
def test_output_times_are_checked(pendulum, ts):
    with pytest.raises(ValueError, match="ts must"):
        udk.simulate(pendulum, ts)


def test_it_may_start_at_any_time():
    """The driver's clock is that of ts."""
    mech = udk.library.driven_pendulum()
    ts = np.array([0.7, 0.8, 1.9])
    sol = udk.simulate(mech, ts)
    assert_allclose(sol.q[:, 0, 2], 0.8 * np.sin(3 * ts), atol=1e-12)
    assert_allclose(sol.v[:, 0, 2], 2.4 * np.cos(3 * ts), atol=1e-12)


def test_a_given_state_is_taken_as_it_is(pendulum, motion):
    rest = udk.simulate(pendulum, TS + 5.0, udk.State(motion.q[3], motion.v[3]))
    assert_allclose(rest.q[:8], motion.q[3:], atol=1e-7)
    assert_allclose(rest.q[0], motion.q[3], atol=0)


# --- outputs between the steps


SOLVERS = {
    "Tsit5": diffrax.Tsit5(),
    "Dopri5": diffrax.Dopri5(),
    "Dopri8": diffrax.Dopri8(),
    "Heun": diffrax.Heun(),
    "Kvaerno5": diffrax.Kvaerno5(),
}
FINE = np.sort(np.append(np.linspace(0.0, 1.0, 38), [1 / np.pi, 0.333]))


@pytest.mark.parametrize(
    "solver",
    [pytest.param(s, id=name, marks=pytest.mark.slow if name in ("Dopri5", "Kvaerno5") else ()) for name, s in SOLVERS.items()],
)
def test_outputs_lie_on_the_manifold_with_every_solver(pendulum, motion, solver):
    sol = udk.simulate(pendulum, FINE, rtol=1e-6, atol=1e-6, solver=solver)
    assert jnp.abs(udk.violation(pendulum, sol)).max() < 1e-14
    assert_allclose(sol.v[:, 0, 0], -sol.v[:, 0, 2] * sol.q[:, 0, 1], atol=1e-14)  # the velocity of the centre, by the constraint
    assert_allclose(sol.q[-1], motion.q[-1], atol=1e-4)
    energy = udk.energy(pendulum, sol).total
    assert_allclose(energy, energy[0], atol=2e-3)


@pytest.mark.slow
def test_output_times_do_not_change_the_motion(pendulum, motion):
    """The steps are the solver's own; outputs are read off between them."""
    sol = udk.simulate(pendulum, FINE)
    assert sol.stats["steps"] == motion.stats["steps"]
    assert_allclose(sol.q[-1], motion.q[-1], atol=1e-13)
    few = udk.simulate(pendulum, np.array([0.0, 1.0]))
    assert_allclose(few.q[-1], motion.q[-1], atol=1e-13)


# --- what it counts


class Count:
    def __init__(self):
        self.value = 0

    def add(self):
        self.value += 1


def counted(held):
    """A stone that counts how often its force is asked for; `held` on a circle."""
    count = Count()

    def force(t, q, v):
        jax.debug.callback(count.add)
        return jnp.stack([-q[0], -9.81 + 0.0 * t])

    return udk.ConstrainedSystem(lambda q: jnp.eye(2), force, (lambda t, q: q @ q - 1.0) if held else None), count


@pytest.mark.parametrize(
    ("solver", "held"),
    [
        pytest.param(diffrax.Dopri8(), False, id="Dopri8-free", marks=pytest.mark.slow),
        pytest.param(diffrax.Tsit5(), True, id="Tsit5-projected"),
        pytest.param(diffrax.Tsit5(), False, id="Tsit5-free", marks=pytest.mark.slow),
        *(
            pytest.param(s(), held, marks=pytest.mark.slow)
            for s, held in ((diffrax.Dopri8, True), (diffrax.Heun, True), (diffrax.Heun, False))
        ),
    ],
)
def test_right_hand_sides_are_counted(solver, held):
    """A method that keeps its last stage for the next step takes one fewer, unless the step was projected away from it."""
    system, count = counted(held)
    sol = udk.simulate(system, TS, udk.State(np.array([0.6, 0.8]), np.zeros(2)), rtol=1e-5, atol=1e-5, solver=solver)
    jax.effects_barrier()
    stats = {k: int(v) for k, v in sol.stats.items()}
    assert stats["steps"] == stats["accepted"] + stats["rejected"] > 3
    assert count.value == stats["right_hand_sides"]
    assert stats["projections"] == (stats["steps"] + 2 * (len(TS) - 1) if held else 0)


# --- batches


def test_a_batch_with_members_that_fail(hung):
    """One cannot be closed, one gets a number that is not finite; the others are what they are alone, and nothing throws."""

    def run(height, end, mass):
        values = {"joint.thread.points[0][1]": height, "force.motor.end": end, "body.rod.mass": mass}
        return udk.simulate(hung.with_parameters(values), TS)

    members = jnp.array([[0.3, 99.0, 1.0], [2.0, 99.0, 1.0], [0.5, 99.0, 1.0], [0.3, 0.35, 1.0], [0.3, 99.0, 4.0]])
    batch = jax.jit(jax.vmap(run))(*members.T)
    assert list(batch.result) == [RESULTS.successful, RESULTS.could_not_assemble, RESULTS.successful, RESULTS.not_finite, 0]
    assert batch.q.shape == (5, 11, 1, 3) and batch.stats["steps"].shape == (5,)
    single = eqx.filter_jit(run)
    for k in (0, 2, 4):
        alone = single(*members[k])
        assert_allclose(batch.q[k], alone.q, atol=1e-11)
        assert batch.stats["steps"][k] == alone.stats["steps"]
    assert np.isnan(batch.q[1, 1:]).all() and np.isnan(batch.q[3, 4:]).all()
    assert_allclose(batch.q[3, :4], batch.q[0, :4], atol=1e-7)
    assert jnp.abs(batch.q[4, -1] - batch.q[0, -1]).max() > 1e-3


def test_a_batch_of_mechanisms(pendulum):
    """`eqx.filter_vmap` over whole mechanisms, tolerances and times."""
    masses, tols = jnp.array([1.0, 2.0, 3.0]), jnp.array([1e-4, 1e-6, 1e-9])
    mechs = eqx.filter_vmap(lambda m: pendulum.with_parameters({"body.rod.mass": m}))(masses)
    batch = eqx.filter_vmap(lambda m, tol: udk.simulate(m, TS, rtol=tol, atol=tol))(mechs, tols)
    assert (batch.result == 0).all()
    assert (np.diff(batch.stats["steps"]) > 0).all()
    assert_allclose(batch.rtol, tols)
    # a heavier rod of the same inertia: a physical pendulum of its own frequency
    early = batch.q[:, 1, 0, 2] - batch.q[:, 0, 0, 2]
    acceleration = -9.81 * 0.75 * masses * np.sin(np.pi / 3) / (0.375 + 0.5625 * masses)
    assert_allclose(early, acceleration * 0.005, rtol=0.02)


@pytest.mark.parametrize("tol", [1e-4, 1e-3])
def test_an_output_beside_a_singular_configuration_is_closed(tol):
    """At 0.55 s the links are 2e-5 rad from being in line, where elimination leaves a row open by up to the tolerance."""
    found = udk.simulate(udk.library.parallelogram(np.pi / 3), [0.0, 0.55, 1.0], rtol=tol, atol=tol, throw=False)
    assert abs(float(found.q[1, 0, 2])) < 1e-4 and found.settings["engine"] == "native"
    assert found.result == udk.Result.successful
    assert np.max(np.abs(udk.violation(udk.library.parallelogram(), found))) < 1e-9


# --- what is compiled


def test_one_compilation_serves_all_numbers(compilations, hung):
    def first():
        udk.simulate(hung, TS[:7], method=udk.Auto(1e-4), stabilization=udk.Baumgarte(1.0, 1.0))

    def others():
        changed = {"body.rod.mass": 7.0, "joint.thread.length": 1.2, "gravity": [1.0, -3.0], "body.rod.angle": 0.4}
        mech = hung.with_parameters(changed)
        method, gains = udk.Auto(rank_tol=1e-3, branch_tol=1e-5), udk.Baumgarte(0.5, 0.1)
        udk.simulate(mech, 2.0 * TS[:7] + 1.0, rtol=1e-5, atol=1e-3, method=method, stabilization=gains, drift_tol=0.5)

    first()
    assert compilations(others) == []


# --- what comes out


def test_progress_is_printed(pendulum, capfd):
    udk.simulate(pendulum, np.array([0.0, 0.5, 1.0]), progress=True)
    jax.effects_barrier()
    assert "100" in capfd.readouterr().out


def test_a_dataset(pendulum, motion):
    data = motion.to_xarray(pendulum)
    assert data["q"].dims == data["v"].dims == ("time", "body", "coordinate")
    assert_allclose(data["q"].sel(body="rod", coordinate="angle"), motion.q[:, 0, 2])
    assert list(data["coordinate"].values) == ["x", "y", "angle"]
    assert data["time"].attrs["units"] == "s" and data["q"].attrs["units"] == "m, m, rad"
    assert data.attrs["result"] == "successful" and data.attrs["end_time"] == 1.0
    assert data.attrs["stats_steps"] == int(motion.stats["steps"])
    assert data.attrs["setting_rtol"] == 1e-8
    assert data.attrs["setting_solver"] == "Dopri8" and data.attrs["setting_method"] == "Auto"
    assert data.attrs["setting_stabilization"] == "Projection"
    assert data.attrs["version_jax"] == jax.__version__
    assert json.loads(data.attrs["parameters"])["body.rod.mass"] == 2.0
    again = udk.loads(data.attrs["scene"])
    assert_allclose(udk.simulate(again, TS).q, motion.q, atol=1e-12)
    assert "scene" not in motion.to_xarray().attrs


def test_a_dataset_of_a_failure_and_of_own_classes(pendulum):
    mech = with_force(pendulum, Until("rod", 0.45))
    data = udk.simulate(mech, TS, throw=False).to_xarray(mech)
    assert data.attrs["result"] == "not_finite" and "0.4" in data.attrs["cause"]
    assert data.attrs["scene"].startswith("# ")


def test_a_file_that_anyone_can_read(pendulum, motion, tmp_path):
    path = tmp_path / "run.nc"
    motion.to_xarray(pendulum).to_netcdf(path, engine="h5netcdf")
    program = f"""if True:
        import sys, xarray
        with xarray.open_dataset({str(path)!r}, engine="h5netcdf") as data:
            print(float(data.q.sel(body="rod", coordinate="x")[-1]), data.attrs["result"], data.attrs["stats_steps"])
        assert not any(name.split(".")[0] in ("udkjax", "jax") for name in sys.modules)
    """
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path, env={})
    x, result, steps = found.stdout.split()
    assert (float(x), result, int(steps)) == (float(motion.q[-1, 0, 0]), "successful", int(motion.stats["steps"]))


def test_a_batch_says_how_each_ended(pendulum):
    codes = jnp.array([0, 3])
    sol = udk.simulate(pendulum, TS)
    many = eqx.tree_at(lambda s: s.code, sol, codes)
    assert_allclose(many.result, codes)


def test_a_mechanism_made_within_a_traced_function():
    """Of a traced mass it is as fast as any other; traced geometry works, and says what it costs."""
    ts = np.linspace(0.0, 0.5, 3)

    def angle(mass, length):
        rod = udk.Body(mass, 0.1, jnp.stack([0.5 * length, 0.0 * length]) if isinstance(length, jax.Array) else [0.5 * length, 0])
        pin = udk.Revolute(["ground", "rod"], [[0, 0], [-0.5, 0]])
        solution = udk.simulate(udk.Mechanism({"rod": rod}, {"pin": pin}), ts, throw=False)
        return solution.q[-1, 0, 2], solution.settings["engine"]

    engines = []

    def traced(*values):
        value, engine = angle(*values)
        engines.append(engine)
        return value

    expected = angle(2.0, 1.0)[0]
    assert_allclose(jax.jit(lambda m: traced(m, 1.0))(2.0), expected, atol=1e-12)
    with pytest.warns(UserWarning, match="with_parameters"):
        assert_allclose(jax.jit(lambda x: traced(2.0, x))(1.0), expected, atol=1e-6)
    assert engines[0] == "native" and engines[1].startswith("diffrax")


def test_a_short_last_step_leaves_outputs_as_exact():
    """A free body moves on a line: outputs of a step before one that is a thousandth as long, or less, had other velocities."""
    body, ts = udk.Mechanism({"b": udk.Body(1.0, 0.1)}, gravity=[0, 0]), np.linspace(0.625, 0.63, 9)
    state = udk.State(np.array([[0.625, 0, 0]]), np.array([[1.000004, 0, 0]]))
    for rest in (1e-1, 1e-3, 1e-6):
        sol = udk.simulate(body, ts, state, dt0=(ts[-1] - ts[0]) * (1 - rest))
        assert_allclose(sol.v[:, 0, 0], 1.000004, rtol=1e-13)
