"""Loads and accelerations along runs whose events change the scene: Newton's law, with accelerations from differences."""

import pickle
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.integrate.events.event_scenes import BALL, CATCH, CAUGHT, PENDULUM, G, floor

TOL: dict[str, Any] = {"rtol": 1e-11, "atol": 1e-11}
STEP = 1e-4  # s, between the outputs of a difference: its error, of the order of STEP^2, is below 1e-6 of the accelerations


class Case(NamedTuple):
    mechanism: udk.Mechanism
    events: list
    times: tuple[float, ...]  # in the order of the phases
    holds: dict[str, list[bool]]  # at these times


def level(body, coordinate, value):
    return lambda t, at: getattr(at[body], coordinate) - value


TWO = udk.Mechanism(
    {"upper": udk.Body(1.0, 0.1, position=(0.5, 0.0)), "lower": udk.Body(0.7, 0.05, position=(1.5, 0.0))},
    {"A": udk.Revolute(("ground", "upper"), [[0, 0], [-0.5, 0]]), "B": udk.Revolute(("upper", "lower"), [[0.5, 0], [-0.5, 0]])},
)
SLOPE = 0.3  # rad
BOX = udk.Mechanism({"box": udk.Body(2.0, 0.1, position=(-0.02, 0.05), velocity=(0.6, 0.0))})


def rod(sticks):
    """A rod that a motor draws through a guide, with a rider on a pin, a spring, and friction; its joints may stick."""
    law: dict[str, Any] = {"law": "set-valued"} if sticks else {}
    return udk.Mechanism(
        {"rod": udk.Body(1.0, 0.1), "rider": udk.Body(0.4, 0.02, position=(0.0, 0.3))},
        {
            "guide": udk.Prismatic(("ground", "rod"), [[0, 0], [0, 0]], axis=0.0),
            "pin": udk.Revolute(("rod", "rider"), [[0, 0], [0, -0.3]]),
        },
        {"motor": udk.Driver(("ground", "rod"), "x", udk.Polynomial([0.0, 1.0, -0.5]))},
        {
            "rub": udk.Friction("guide", coefficient=0.2, **law),
            "turn": udk.Friction("pin", torque=0.05, **(law or {"velocity": 0.1})),
            "spring": udk.TorsionSpring(("rod", "rider"), 2.0, angle=0.4),
        },
    )


RELEASES = [
    udk.Event(lambda t, at: t - 0.3, udk.Release("motor"), name="coast"),
    udk.Event(lambda t, at: t - 0.5, udk.Release("pin"), name="part"),
]
RELEASED = (0.1, 0.4, 0.6, 0.9), {"motor": [True, False, False, False], "pin": [True, True, False, False]}

CASES = {
    "a ball comes to rest on a floor": Case(
        BALL, [floor(0.3)], (0.2, 0.6, 1.0, 1.5), {"floor.contact": [False, False, True, True]}
    ),
    "a pendulum rests at its limit": Case(
        PENDULUM, [udk.JointLimit("A", lower=-1.0, name="end")], (0.1, 1.0, 1.5), {"end.lower.contact": [False, True, True]}
    ),
    "a box slides and sticks on a slope": Case(
        BOX,
        [udk.Contact("box", through=(0, 0), normal=(np.sin(SLOPE), np.cos(SLOPE)), name="slope", coefficient=0.6)],
        (0.02, 0.15, 0.8),
        {"slope.contact": [False, True, True]},
    ),
    "an elbow is locked, and released": Case(
        TWO,
        [
            udk.Event(level("upper", "angle", -0.6), udk.Lock("B"), name="lock"),
            udk.Event(level("upper", "angle", -1.8), udk.Release("B.lock"), name="unlock"),
        ],
        (0.1, 0.45, 0.9),
        {"B.lock": [False, True, False]},
    ),
    "a ball is caught, and a pin cut": Case(
        CATCH, CAUGHT, (0.05, 0.2, 0.6, 1.0), {"A": [True, True, False, False], "catch": [False, True, True, True]}
    ),
    "a motor and a pin with friction are released": Case(rod(False), RELEASES, *RELEASED),
    "a motor and a pin that may stick are released": Case(rod(True), RELEASES, *RELEASED),
}


def output_times(times):
    """The times, each between two others at the distance STEP, after zero."""
    return np.unique(np.concatenate([[0.0], *(t + STEP * np.array([-1, 0, 1]) for t in times)]))


def excess(mechanism, solution, loads):
    """The largest difference between the rate of momentum and the sum of loads at each of the case's times, by its scale."""
    v, names = np.asarray(solution.v), mechanism.body_names
    mass = np.array([[b.mass, b.mass, b.inertia] for b in mechanism.bodies.values()])
    rate = mass * (v[3::3] - v[1::3]) / (2 * STEP)
    total = mass * np.array([*np.asarray(mechanism.gravity), 0.0]) + 0.0 * rate
    for by_body in loads:
        for body, load in by_body.items():
            total[:, names.index(body)] += np.asarray(load)[2::3]
    return np.abs(rate - total).max(axis=(1, 2)) / (mass.max() * G)


def all_loads(mechanism, solution):
    """The reactions, the friction and the springs of a run, each on bodies."""
    springs = []
    for force in mechanism.forces.values():
        if isinstance(force, udk.TorsionSpring):
            angles = [solution.q[:, mechanism.body_names.index(name), 2] for name in force.bodies]
            torque = -force.stiffness * (angles[1] - angles[0] - force.angle)
            couple = lambda x: jnp.stack([0 * x, 0 * x, x], axis=-1)  # noqa: E731
            springs.append({force.bodies[0]: couple(-torque), force.bodies[1]: couple(torque)})
    return [
        *udk.reactions(mechanism, solution).values(),
        *udk.friction_loads(mechanism, solution).values(),
        *springs,
    ]


QUICK = [name for name in CASES if "stick" not in name]  # set-valued friction takes ten times as long to compile


@pytest.mark.parametrize("name", QUICK)
def test_loads_are_the_rates_of_momentum(name):
    check_loads(CASES[name], powers=True)


def test_loads_of_a_contact_that_sticks_are_the_rates_of_momentum():
    check_loads(CASES["a box slides and sticks on a slope"])


@pytest.mark.slow
def test_loads_of_joints_that_stick_and_are_released_are_the_rates_of_momentum():
    check_loads(CASES["a motor and a pin that may stick are released"], powers=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_loads_of_runs_by_diffrax_are_the_rates_of_momentum(name):
    check_loads(CASES[name], engine="diffrax", powers=True)


def check_loads(case, engine: Any = "native", powers=False):
    solution = udk.simulate(case.mechanism, output_times(case.times), events=case.events, engine=engine, **TOL)
    assert {key: list(np.asarray(x)[2::3]) for key, x in solution.holds.items()} == case.holds
    assert excess(case.mechanism, solution, all_loads(case.mechanism, solution)).max() < 1e-5
    assert float(jnp.abs(udk.violation(case.mechanism, solution)).max(initial=0.0)) < 1e-9
    if not powers:
        return
    for body in case.mechanism.body_names:
        a = udk.path(case.mechanism, solution, body, derivative=2)[2::3]
        v = udk.path(case.mechanism, solution, body, derivative=1)
        np.testing.assert_allclose(a, (v[3::3] - v[1::3]) / (2 * STEP), atol=1e-5 * G)
    assert float(udk.power_balance(case.mechanism, solution).relative) < 1e-9


def loads_by_case(mechanism, case, scale):
    """Reactions, accelerations and powers of a run with another mass of the first body."""
    name = f"body.{mechanism.body_names[0]}.mass"
    heavier = mechanism.with_parameters({name: scale * mechanism.parameters()[name]})
    solution = udk.simulate(heavier, output_times(case.times), events=case.events, throw=False, **TOL)
    loads = [udk.reactions(heavier, solution), udk.friction_loads(heavier, solution)]
    a = [udk.path(heavier, solution, body, derivative=2) for body in mechanism.body_names]
    return solution, loads, a, udk.power_balance(heavier, solution).relative


def test_compiled_and_batched_runs_tell_the_same():
    check_idioms(CASES["a ball is caught, and a pin cut"])


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_compiled_and_batched_runs_of_all_kinds_tell_the_same(name):
    check_idioms(CASES[name])


def check_idioms(case):
    scales = jnp.array([1.0, 1.3, 1.6])
    by_lane = jax.jit(jax.vmap(lambda scale: loads_by_case(case.mechanism, case, scale)[1:]))(scales)
    by_jit, *_ = jax.jit(lambda scale: loads_by_case(case.mechanism, case, scale))(scales[1])
    assert type(by_jit) is udk.Solution and set(by_jit.holds) == set(case.holds)
    for k, scale in enumerate(scales):
        eager = loads_by_case(case.mechanism, case, float(scale))
        for one, other in zip(jax.tree.leaves(eager[1:]), jax.tree.leaves(by_lane), strict=True):
            np.testing.assert_allclose(one, other[k], atol=1e-6 * G)
        for one, other in zip(eager[0].holds.values(), by_jit.holds.values() if k == 1 else (), strict=k == 1):
            np.testing.assert_array_equal(one, other)


def test_sweeps_measure_the_constraints_that_hold(tmp_path):
    """Functions of a run may read its events and contacts, also where rows are stored."""
    case = CASES["a ball comes to rest on a floor"]

    def on_floor(mechanism, solution):
        load = udk.reactions(mechanism, solution)["floor.contact"]["ball"][:, 1]
        return {"load": load, "holds": solution.holds["floor.contact"], "count": solution.events.count}

    times, masses = output_times(case.times), np.array([1.0, 2.0])
    axes, measures = {"body.ball.mass": masses}, {"of": on_floor, "ay": "body.ball.ay", "rank": "rank"}
    for out in (None, tmp_path / "rows", tmp_path / "rows"):
        data = udk.sweep(case.mechanism, axes, times, measures, events=case.events, out=out)
        rests = np.repeat(case.holds["floor.contact"], 3)
        np.testing.assert_array_equal(data["of_holds"][:, 1:], [rests, rests])
        np.testing.assert_allclose(data["of_load"][:, 1:], masses[:, None] * G * rests, atol=1e-9)
        np.testing.assert_allclose(data["ay"][:, 1:], -G * ~np.array([rests, rests]), atol=1e-9)
        np.testing.assert_array_equal(data["rank"][:, 1:], [rests, rests])


def test_derivatives_of_loads_after_an_event():
    """The load of a ball at rest is its weight; its derivative by the mass is G, and that of its acceleration zero."""
    case = CASES["a ball comes to rest on a floor"]

    def loads(mass):
        ball = case.mechanism.with_parameters({"body.ball.mass": mass})
        solution = udk.simulate(ball, output_times(case.times), events=case.events)
        a = udk.path(ball, solution, "ball", derivative=2)
        return jnp.stack([udk.reactions(ball, solution)["floor.contact"]["ball"][:, 1], a[:, 1]])[:, 2::3]

    rests = np.array(case.holds["floor.contact"])
    for slopes in (jax.jacfwd(loads)(1.5), jax.jacrev(loads)(1.5)):
        np.testing.assert_allclose(slopes, [G * rests, 0 * rests], atol=1e-9)


def test_an_attached_joint_takes_the_name_of_another():
    """It has its own numbers from the state at its event, and the name of the released joint."""
    rod = udk.Mechanism({"rod": udk.Body(1.0, 0.1)}, {"hold": udk.Weld(("ground", "rod"), [[0.5, 0], [0.5, 0]])})
    events = [
        udk.Event(lambda t, at: t - 0.2, udk.Release("hold"), name="fall"),
        udk.Event(lambda t, at: t - 0.6, udk.Attach(udk.Distance(("ground", "rod"), [[0, 1], [-0.2, 0]]), "hold")),
    ]
    solution = udk.simulate(rod, output_times((0.1, 0.4, 0.8)), events=events, **TOL)
    assert solution.holds["hold"][2::3].tolist() == [True, False, True]
    assert list(udk.reactions(rod, solution)) == ["hold"]
    assert excess(rod, solution, all_loads(rod, solution)).max() < 1e-5


def test_runs_keep_their_changes_in_files(tmp_path):
    """A pickled run is itself; without its functions, or in a dataset, it knows loads only while nothing is added."""
    pytest.importorskip("h5netcdf")
    from udkjax.show.player.run_files import read_run

    case = CASES["a ball comes to rest on a floor"]
    solution = udk.simulate(case.mechanism, output_times(case.times), events=case.events)
    again, loads = pickle.loads(pickle.dumps(solution)), udk.reactions(case.mechanism, solution)
    for one, other in zip(jax.tree.leaves(loads), jax.tree.leaves(udk.reactions(case.mechanism, again)), strict=True):
        np.testing.assert_array_equal(one, other)
    own = udk.Event(lambda t, at: at["ball"].y, udk.Impact(0.3), name="floor")
    of_lambda = udk.simulate(case.mechanism, output_times(case.times), events=own)
    np.testing.assert_allclose(udk.path(case.mechanism, of_lambda, "ball", derivative=2)[2::3, 1], [-G, -G, 0, 0], atol=1e-9)
    solution.to_xarray(case.mechanism).to_netcdf(tmp_path / "run.nc", engine="h5netcdf")
    for other in (pickle.loads(pickle.dumps(of_lambda)), read_run(tmp_path / "run.nc")):
        a = udk.path(case.mechanism, other, "ball", derivative=2)[2::3, 1]
        np.testing.assert_allclose(a, [-G, -G, np.nan, np.nan], atol=1e-9)
        assert np.isnan(udk.power_balance(case.mechanism, other).kinetic[-1])


def test_files_of_older_versions_tell_no_loads(tmp_path):
    """They do not tell what events have changed. Files of runs without events do."""
    pytest.importorskip("h5netcdf")
    from udkjax.show.player.run_files import read_run

    for k, events in enumerate(([floor(0.3)], None)):
        data = udk.simulate(BALL, [0.0, 0.1, 1.5], events=events).to_xarray(BALL)
        data = data.drop_vars(["holds", "constraint"], errors="ignore")
        del data.attrs["constraints_of_the_scene"]
        data.to_netcdf(tmp_path / f"{k}.nc", engine="h5netcdf")
        a = udk.path(BALL, read_run(tmp_path / f"{k}.nc"), "ball", derivative=2)[:, 1]
        np.testing.assert_allclose(a, 3 * [np.nan if events else -G])


def test_selected_times_need_selected_changes():
    solution = udk.simulate(BALL, [0.0, 0.5, 1.0], events=[floor(0.3)])
    with pytest.raises(ValueError, match="scene_changes"):
        udk.reactions(BALL, eqx.tree_at(lambda x: (x.ts, x.q, x.v), solution, (solution.ts[1:], solution.q[1:], solution.v[1:])))


def test_a_timeline_refuses_released_constraints():
    case = CASES["an elbow is locked, and released"]
    locked = udk.simulate(case.mechanism, np.linspace(0, 0.5, 6), events=case.events)
    timeline = udk.diagnose(case.mechanism, solution=locked, fixes=False).timeline
    assert timeline is not None and timeline.rank.tolist() == [4] * 6
    case = CASES["a ball is caught, and a pin cut"]
    cut = udk.simulate(case.mechanism, output_times(case.times), events=case.events)
    with pytest.raises(ValueError, match='release "A"'):
        udk.diagnose(case.mechanism, solution=cut, fixes=False)


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_joint_that_would_have_to_stop_a_driver_cannot_be_attached(engine):
    """If only later positions showed it, runs would end as `drift` after the event, or as `missing_rank`."""
    mech, ts = udk.library.driven_pendulum(0.8, 3.0), np.linspace(0.0, 1.0, 5)
    rods = {"along the rod": [(0.0, 0.0), (0.5, 0.0)], "beside the pin": [(0.0, 0.3), (0.5, 0.0)]}
    actions = {name: udk.Attach(udk.Distance(("ground", "rod"), points), "link") for name, points in rods.items()}
    cases = (udk.Lock("pin"), False), (actions["along the rod"], True), (actions["beside the pin"], False)
    for action, is_possible in cases if engine == "native" else cases[:1]:
        event = udk.Event(lambda t, at: t - 0.3, action, direction=1, name="event")
        sol = udk.simulate(mech, ts, events=[event], engine=engine, throw=False)
        assert sol.result == (udk.Result.successful if is_possible else udk.Result.event_impossible)
        assert abs(sol.time - (1.0 if is_possible else 0.3)) < 1e-9


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
@pytest.mark.parametrize("order", ["ABCD", "DCBA"])
def test_a_lock_that_would_have_to_stop_a_driver_is_impossible_whichever_row_is_left_out(order, engine):
    """Elimination leaves out the row of the lock or that of the driver, by the order of joints; velocities violate it then."""
    bodies = {
        "crank": udk.Body(1.0, 0.02, (0.1, 0.0), 0.0),
        "coupler": udk.Body(1.0, 0.02, (0.4, 0.2), np.pi / 4),
        "rocker": udk.Body(1.0, 0.02, (0.6, 0.2), np.pi / 2),
    }
    half = 0.2 * 2**0.5
    joints = {
        "A": udk.Revolute(("ground", "crank"), [(0.0, 0.0), (-0.1, 0.0)]),
        "B": udk.Revolute(("crank", "coupler"), [(0.1, 0.0), (-half, 0.0)]),
        "C": udk.Revolute(("coupler", "rocker"), [(half, 0.0), (0.0, 0.2)]),
        "D": udk.Revolute(("rocker", "ground"), [(0.0, -0.2), (0.6, 0.0)]),
    }
    motor = udk.Driver(("ground", "crank"), "angle", udk.Polynomial((0.0, 3.0)))
    mech = udk.Mechanism(bodies, {name: joints[name] for name in order}, {"motor": motor})
    for pin in "BCD" if engine == "native" else order[1]:
        event = udk.Event(lambda t, at: t - 0.1, udk.Lock(pin), direction=1, name="lock")
        sol = udk.simulate(mech, [0.0, 0.2], udk.assemble(mech), events=[event], engine=engine, throw=False)
        assert (sol.result, round(float(sol.time), 9)) == (udk.Result.event_impossible, 0.1), pin


# The plain form leaves out rows whose distance from dependence is below 1e-3 (`BRANCH_TOL`), and refuses to attach such a joint.
SLANTS = {"native": [0.1, 1e-2, 1e-3], "diffrax": [0.1, 1e-2, 2e-3]}


@pytest.mark.parametrize(
    ("engine", "slant"),
    [pytest.param(x, s, marks=[pytest.mark.slow] * (x == "diffrax")) for x, slants in SLANTS.items() for s in slants],
)
def test_a_joint_that_stops_its_own_condition_is_attached_once(slant, engine):
    """A rod between parallel cranks stops them, with a singular value that is as small as the rod is nearly parallel to them.

    The condition stays at zero, and rounding, which this value amplifies, must not count as its passing zero again.
    """
    mechanism = udk.library.parallelogram()
    rod = udk.Distance(("link1", "link2"), [[0.3, 0.2], [0.3 + slant, 0.2]])
    for time in (0.3, 1.2):
        angle = float(udk.simulate(mechanism, [0.0, time]).q[-1, 0, 2])
        event = udk.Event(lambda t, at, angle=angle: at["link1"].angle - angle, udk.Attach(rod, "rod"), name="attach")
        for tol in (1e-6, 1e-8, 1e-11):
            found = udk.simulate(mechanism, [0.0, 2.0], rtol=tol, atol=tol, events=[event], engine=engine)
            assert found.events is not None and found.events.count == 1
            np.testing.assert_allclose(found.events.v_after[0], 0.0, atol=1e-14)
            np.testing.assert_allclose(found.q[-1], found.events.q_after[0], atol=1e-11)
