"""Events: times and states compared with closed forms, and jumps with their identities."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# All of these runs have events; wrong arguments are meant.
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

import udkjax as udk
from tests.choices import fast
from tests.integrate.events.event_scenes import BALL, CATCH, CAUGHT, PENDULUM, ROOM, SWING, TS, G, floor
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.states.textbook import prepare
from udkjax.integrate.events.instant.impacts import contact_rows


def bounce(restitution, ts, height=1.0, speed=0.0, inertia=0.1, **more):
    """A ball above the floor, with velocity `speed` upwards."""
    numbers = {"position": [0.0, height], "velocity": [0.0, speed], "inertia": inertia}
    ball = BALL.with_parameters({f"body.ball.{name}": x for name, x in numbers.items()})
    return udk.simulate(ball, ts, events=floor(restitution), max_events=ROOM, throw=False, **more)


def exact_bounces(restitution, count, height=1.0):
    """The times of impacts, and the speeds just before them."""
    v = np.sqrt(2 * G * height) * restitution ** np.arange(1, count + 1)
    first = np.sqrt(2 * height / G)
    return first + np.append(0.0, np.cumsum(2 * v[:-1] / G)), v


def test_ball_bounces_at_its_exact_times():
    sol = bounce(0.95, TS)
    times, speeds = exact_bounces(0.95, 40)
    count = int(sol.events.count)
    assert sol.result == udk.Result.successful and sol.settings["engine"] == "native"
    assert count == np.sum(times < TS[-1]) and sol.events.names[0] == "floor"
    assert np.abs(sol.events.time - times[:count]).max() < 1e-11
    assert np.abs(sol.events.q_before[:, 0, 1]).max() < 1e-12
    assert np.abs(sol.events.v_after[:, 0, 1] - speeds[:count]).max() < 1e-10
    k = np.searchsorted(times, TS) - 1
    d = TS - times[k]
    height = np.where(k < 0, 1 - G / 2 * TS**2, speeds[k] * d - G / 2 * d**2)
    assert np.abs(sol.q[:, 0, 1] - height).max() < 1e-10


def test_endless_bounces_come_to_rest():
    sol = bounce(0.5, TS)
    v = np.sqrt(2 * G)
    assert sol.result == udk.Result.successful
    assert sol.events.counts["floor rests"] == 1 and sol.events.counts["floor lets go"] == 0
    assert abs(float(sol.events.time[-1]) - (v / G + 2 * v / G * 0.5 / (1 - 0.5))) < 1e-4
    assert np.abs(sol.q[-1]).max() < 1e-12 and np.abs(sol.v[-1]).max() < 1e-12


def test_too_many_events_are_a_code():
    sol = bounce(0.9, TS)
    assert sol.result == udk.Result.event_limit and sol.events.count == ROOM
    assert np.isnan(sol.q[-1]).all() and float(sol.time) < 8.0
    with pytest.raises(udk.SimulationError, match="max_events"):
        udk.simulate(BALL, TS, events=floor(0.9), max_events=ROOM)


def test_start_on_an_event():
    down, rest, up, below = (bounce(0.5, TS, h, v) for h, v in ((0.0, -1.0), (0.0, 0.0), (0.0, 1.0), (-0.1, 0.0)))
    assert float(down.events.time[0]) == 0.0 and np.allclose(down.events.v_after[0, 0], [0, 0.5, 0], atol=1e-15)
    assert float(rest.events.time[0]) == 0.0 and rest.events.counts["floor rests"] == 1 and rest.events.count == 1
    assert abs(float(up.events.time[0]) - 2 / G) < 1e-12
    assert below.result == udk.Result.beyond_contact and below.time == 0.0


def test_micrometres_bounce_alike():
    large, small = bounce(0.5, TS), bounce(0.5, TS * 1e-3, 1e-6, inertia=0.1e-12)
    assert small.events.count == large.events.count
    assert np.abs(small.events.time[:8] * 1e3 - large.events.time[:8]).max() < 1e-10


def swing(lower, restitution, ts, rtol=1e-11):
    """The pendulum, released at the height of its pin, with a stop."""
    stop = udk.JointLimit("A", lower=lower, restitution=restitution)
    return udk.simulate(PENDULUM, ts, rtol=rtol, atol=rtol, events=stop, max_events=ROOM)


def test_pendulum_bounces_off_a_stop_as_elliptic_integrals_say():
    e, w = 0.95, np.sqrt(2 * SWING)
    sol = swing(-np.pi / 2, e, TS * 2.4)
    speeds = w * e ** np.arange(1, ROOM)  # after each impact; away and back takes half a period
    times = ellipk(0.5) / np.sqrt(SWING) + np.append(0.0, np.cumsum(2 * ellipk(speeds**2 / (4 * SWING)) / np.sqrt(SWING)))
    count = int(sol.events.count)
    assert count >= 20
    assert np.abs(sol.events.time - times[:count]).max() < 1e-10
    assert np.abs(sol.events.v_after[:, 0, 2] - speeds[:count]).max() < 1e-9
    assert np.abs(sol.events.q_before[:, 0, 2] + np.pi / 2).max() < 1e-12


@pytest.mark.parametrize("depth", [1e-4, 1e-8])
def test_what_touches_hits_and_what_does_not_does_not(depth):
    """A swing to -pi, with a stop just before or after it: between two times of the grid it goes there and back."""
    hit, miss = swing(-np.pi + depth, 1.0, TS / 4), swing(-np.pi - depth, 1.0, TS / 4)
    assert hit.events.count >= 1 and miss.events.count == 0
    half = 2 * ellipk(0.5) / np.sqrt(SWING)
    early = np.sqrt(2 * depth / SWING)  # with the acceleration that it has there
    assert abs(float(hit.events.time[0]) - (half - early)) < 0.01 * early
    assert abs(float(hit.events.q_before[0, 0, 2]) + np.pi - depth) < 1e-12


def test_stop_of_a_redundant_mechanism():
    """The paper's linkage swings as a pendulum, 3.05 theta'' = -3.5 g cos(theta), whichever link has the stop."""
    mech, e, square = udk.library.parallelogram(), 0.8, 3.5 * G / 3.05
    sol = udk.simulate(
        mech, TS / 2, rtol=1e-11, atol=1e-11, events=udk.JointLimit("A2", lower=-np.pi / 2, restitution=e), max_events=ROOM
    )
    k = np.sin(np.pi / 8)  # from rest at -45 degrees
    speeds = 2 * k * np.sqrt(square) * e ** np.arange(1, ROOM)
    away = 2 * ellipk(speeds**2 / (4 * square)) / np.sqrt(square)
    times = ellipk(k**2) / np.sqrt(square) + np.append(0.0, np.cumsum(away))
    count = int(sol.events.count)
    assert count >= 4 and sol.settings["engine"] == "native"
    assert np.abs(sol.events.time - times[:count]).max() < 1e-10
    assert np.abs(sol.events.v_after[:, :3, 2] - speeds[:count, None]).max() < 1e-9
    assert np.abs(udk.violation(mech, sol)).max() < 1e-12


def table(t, at):
    """The height of the ball above a shaking table."""
    return at["ball"].y - 0.1 * jnp.sin(15.0 * t)


def test_a_contact_lets_go_where_it_would_have_to_pull():
    """A shaking table throws the ball when its acceleration is -g, and catches it again."""
    ball = BALL.with_parameters({"body.ball.position": [0.0, 0.0], "body.ball.velocity": [0.0, 1.5]})
    events = [
        udk.Event(table, udk.Impact(0.0), name="table"),
        udk.Event(lambda t, at: at["ball"].vy, udk.Log(), direction=-1, name="top"),
        udk.Event(lambda t, at: t - 0.5, udk.Stop(), name="end"),
    ]
    sol = udk.simulate(ball, TS[:5], events=events, max_events=8)
    names = [sol.events.names[k] for k in sol.events.index]
    thrown = np.arcsin(G / (0.1 * 15**2)) / 15
    v = 1.5 * np.cos(15 * thrown)
    assert names[:3] == ["table rests", "table lets go", "top"] and names[-1] == "end" and names[3] == "table"
    assert float(sol.events.time[0]) == 0.0
    assert abs(float(sol.events.time[1]) - thrown) < 1e-9
    assert np.abs(sol.events.v_after[1, 0] - np.array([0, v, 0])).max() < 1e-9
    assert abs(float(sol.events.of("top")[0]) - (thrown + v / G)) < 1e-9
    assert sol.result == udk.Result.event_stop and abs(float(sol.time) - 0.5) < 1e-15
    t = float(sol.events.of("table")[0])
    assert abs(0.1 * np.sin(15 * thrown) + v * (t - thrown) - G / 2 * (t - thrown) ** 2 - 0.1 * np.sin(15 * t)) < 1e-9
    assert np.isnan(sol.q[3:]).all() and np.isfinite(sol.q[:3]).all()


def test_catch_and_release():
    """Angular momentum about the pin at the catch, energy until the release, and free flight after it."""
    ts = np.linspace(0.0, 1.0, 11)
    sol = udk.simulate(CATCH, ts, events=CAUGHT, rtol=1e-11, atol=1e-11, max_events=4)
    caught, cut = (float(t) for t in sol.events.time)
    assert [sol.events.names[k] for k in sol.events.index] == ["caught", "cut"] and abs(caught - 1 / 6) < 1e-12
    inertia, moment = 0.1 + 0.25 + 0.05 + 0.5, 0.5 * 6.0 * 1.0
    w = float(sol.events.v_after[0, 0, 2])
    assert abs(w - moment / inertia) < 1e-11 and abs(float(sol.events.v_after[0, 1, 2]) - w) < 1e-11
    fallen = (1.0 * 0.5 + 0.5 * 1.0) * G * (1 - np.sin(np.pi / 3))
    w_cut = np.sqrt(w**2 - 2 * fallen / inertia)
    assert np.abs(sol.events.v_before[1, :, 2] - w_cut).max() < 1e-9
    q, v, d = sol.events.q_after[1], sol.events.v_after[1], 1.0 - cut
    masses = np.array([1.0, 0.5])[:, None] / 1.5
    centre, velocity = (masses * q[:, :2]).sum(0), (masses * v[:, :2]).sum(0)
    end = centre + velocity * d + np.array([0, -G / 2]) * d**2
    assert np.abs((masses * sol.q[-1, :, :2]).sum(0) - end).max() < 1e-10
    assert np.abs(sol.q[-1, :, 2] - (q[:, 2] + w_cut * d)).max() < 1e-9
    along = 0.5 * np.array([np.cos(sol.q[-1, 0, 2]), np.sin(sol.q[-1, 0, 2])])
    assert np.abs(sol.q[-1, 1, :2] - sol.q[-1, 0, :2] - along).max() < 1e-12


def test_two_at_one_instant():
    """A ball in a corner hits both walls at once and leaves both. Meanwhile two bodies are locked to each other."""
    mech = udk.Mechanism(
        {
            "ball": udk.Body(1.0, 0.1, position=(1.0, 1.0), velocity=(-1.0, -1.0)),
            "arm": udk.Body(1.0, 0.1, position=(5.5, 0.0), velocity=(0.0, 0.25), angular_velocity=0.5),
        },
        {"pin": udk.Revolute(("ground", "arm"), [[5.0, 0], [-0.5, 0]])},
        gravity=(0, 0),
    )
    events = [
        udk.Contact("ball", restitution=0.5, name="floor", at_rest="stop"),
        udk.Contact("ball", normal=(3, 0), restitution=0.25, name="wall", at_rest="stop"),
        udk.Event(lambda t, at: at["arm"].angle - 1.0, udk.Lock("pin"), name="lock"),
    ]
    sol = udk.simulate(mech, TS, events=events, max_events=4)
    assert np.abs(sol.events.time - np.array([1.0, 1.0, 2.0])).max() < 1e-11
    assert sorted(np.asarray(sol.events.index[:2])) == [0, 1]
    assert np.abs(sol.q[-1] - np.array([[0.25 * 7, 0.5 * 7, 0], [5 + 0.5 * np.cos(1), 0.5 * np.sin(1), 1]])).max() < 1e-10
    assert np.abs(sol.v[-1, 1]).max() < 1e-12


@pytest.mark.slow
def test_pendulums_of_a_batch_have_events_of_their_own():
    speeds, ts = np.linspace(-6.0, 6.0, 200), np.linspace(0.0, 4.0, 5)
    stops = [
        udk.JointLimit("A", lower=-2.0, restitution=0.5, at_rest="stop"),
        udk.Event(lambda t, at: at["link"].angle - 1.0, udk.Stop(), name="turned"),
    ]

    def run(speed):
        numbers = {"body.link.velocity": jnp.stack([0 * speed, speed / 2]), "body.link.angular_velocity": speed}
        return udk.simulate(PENDULUM.with_parameters(numbers), ts, events=stops, max_events=8)

    batch = jax.jit(jax.vmap(run))
    all_of_them = batch(speeds)
    codes, counts = np.asarray(all_of_them.code), np.asarray(all_of_them.events.count)
    assert set(codes) == {udk.Result.successful, udk.Result.event_stop} and len(set(counts)) >= 2
    # Beside other members each is what it is beside these: three of them again, as often as a batch has members.
    chosen = np.resize([0, 50, 199], len(speeds))
    again = batch(speeds[chosen])
    for name in ("code", "q", "v", "time"):
        assert np.array_equal(getattr(again, name), np.asarray(getattr(all_of_them, name))[chosen], equal_nan=True), name
    assert np.array_equal(again.events.time, np.asarray(all_of_them.events.time)[chosen], equal_nan=True)
    for k in chosen[:3]:
        assert np.isinf(all_of_them.events.time[k, counts[k] :]).all()
    # Energy and an elliptic integral determine where members turn over.
    fast = np.flatnonzero(codes == udk.Result.event_stop)
    assert np.abs(all_of_them.events.q_before[fast, counts[fast] - 1, 0, 2] - 1.0).max() < 1e-11


@pytest.mark.parametrize("name", fast(["parallelogram"], ["parallelogram", "four_bar", "n_four_bar"]))
def test_jump_keeps_constraints_and_energy(name):
    """This includes redundant mechanisms: the jump is D^+ of the constraints' rows and the contact's row."""
    mech = getattr(udk.library, name)()
    q, n, e = udk.assemble(mech).q.ravel(), len(mech.body_names) * 3, 0.6
    normal = jnp.zeros(n).at[2].set(1.0)

    @jax.jit
    def hit():
        equations = prepare(mech, udk.SVD())
        _, v = equations.project(0.0, q, jnp.arange(1.0, n + 1))
        D, root = uk.D(mech, 0.0, q, equations.weights), uk.inverse_sqrt_mass(mech)
        appended = jnp.concatenate([D, (root * normal)[None]])
        by_plus = root * (udk.SVD(1e-4)(appended) @ jnp.zeros(len(appended)).at[-1].set(-(1 + e) * (normal @ v)))
        null = jnp.eye(n) - udk.SVD(1e-4)(D) @ D
        effective = (root * normal) @ null @ (root * normal)
        return contact_rows(equations, 0.0, q, normal[None]), v, D, root, by_plus, effective

    found, *arrays = hit()
    v, D, root, by_plus, effective = (np.asarray(x) for x in arrays)
    rate, mass = v[2], 1 / root**2
    dv = -(1 + e) * rate * np.asarray(found.directions[0] / found.W[0, 0])
    assert found.free.all()
    assert np.abs(dv - by_plus).max() < 1e-10
    assert np.abs(D @ (dv / root)).max() < 1e-10 * np.abs(dv / root).max()
    assert abs(v[2] + dv[2] + e * rate) < 1e-11 * abs(rate)
    lost = (mass @ (v + dv) ** 2 - mass @ v**2) / 2
    assert abs(lost + (1 - e**2) / 2 * rate**2 / effective) < 1e-10 * abs(lost)


def test_an_impact_that_the_constraints_block_says_so():
    equations = prepare(PENDULUM, udk.SVD())
    along = jnp.array([[1.0, 0.0, 0.0]])  # the pin takes it
    assert not jax.jit(contact_rows)(equations, 0.0, PENDULUM.q0.ravel(), along).free.any()


@pytest.mark.slow
def test_both_engines_find_the_same():
    ts = TS[:9]
    found = [bounce(0.8, ts, engine=engine) for engine in ("native", "jax")]
    assert [sol.settings["engine"] for sol in found] == ["native", "jax: it was asked for"]
    assert np.abs(found[0].events.time - found[1].events.time).max() < 1e-10
    assert np.abs(found[0].q - found[1].q).max() < 1e-9


def test_only_contacts_are_listed_to_rest():
    """Other events cannot rest, and have no count of it."""
    ball = udk.Mechanism({"ball": udk.Body(1.0, 0.1, (0.0, 1.0))})
    half = udk.Event(lambda t, at: at["ball"].y - 0.5, udk.Log(), name="half")
    found = udk.simulate(ball, [0.0, 1.0], events=[half, udk.Contact("ball")]).events
    floor = "ball on ground"
    assert {name: int(n) for name, n in found.counts.items()} == {"half": 1, floor: 1, f"{floor} lets go": 0, f"{floor} rests": 1}
    with pytest.raises(ValueError, match="half rests"):
        found.of("half rests")
