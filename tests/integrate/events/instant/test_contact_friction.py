"""Contacts with friction: closed forms of sliding, sticking and impacts, an independent integration, energy, derivatives."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import udkjax as udk
from examples.gallery import woodpecker
from tests.friction import G
from udkjax.complementarity.linear import general_complementary_set
from udkjax.integrate.events.instant.impacts import ContactRows, Contacts, impulses_with_friction
from udkjax.show.player.marks.measure_curves import sticking_spans

TOL: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-10}


def plate(speed: float, feet: tuple[float, ...] = (-0.5, 0.5), height: float = 0.2, above: float = 0.0, **contact: Any) -> Any:
    """Return a plate of 1 kg and 0.1 kg m^2 that moves to the right above a floor, and the contacts of its feet."""
    body = udk.Body(1.0, 0.1, [0.0, height + above], velocity=[speed, 0.0])
    return udk.Mechanism({"plate": body}), [udk.Contact("plate", [x, -height], name=f"foot {x}", **contact) for x in feet]


def rod(angle: float, velocity: tuple[float, float], **contact: Any) -> Any:
    """Return a rod of 1 kg and 1 m whose left end touches a floor, without gravity, and the contact of this end."""
    body = udk.Body(1.0, 1 / 12, [0.0, np.sin(angle) / 2], angle, velocity=velocity)
    return udk.Mechanism({"rod": body}, gravity=[0.0, 0.0]), udk.Contact("rod", [-0.5, 0.0], name="end", **contact)


def impulses_by_routh(angle: float, velocity: tuple[float, float], mu: float, e: float) -> tuple[float, float]:
    """Return the impulses along and normal to the floor on `rod`.

    They grow together: the end slides with the ratio mu, until it sticks; the compression ends where the normal speed is zero.
    """
    x, y = -np.cos(angle) / 2, -np.sin(angle) / 2
    normal, along, mixed = 1 + 12 * x * x, 1 + 12 * y * y, -12 * x * y
    (slip, speed), of_normal, of_slip, end = velocity, 0.0, 0.0, np.inf
    for _ in range(4):
        sticks = abs(slip) < 1e-15
        ratio = np.clip(-mixed / along, -mu, mu) if sticks else -mu * np.sign(slip)
        rates = mixed + ratio * along, normal + ratio * mixed
        steps = [end - of_normal, -speed / rates[1] if end == np.inf else np.inf]
        steps.append(-slip / rates[0] if not sticks and rates[0] * slip < 0 else np.inf)
        step = min(steps)
        slip, speed = slip + step * rates[0], speed + step * rates[1]
        of_normal, of_slip = of_normal + step, of_slip + step * ratio
        if step == steps[0]:
            break
        if step == steps[1]:
            end = (1 + e) * of_normal
        else:
            slip = 0.0
    return of_slip, of_normal


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.3, 0.5])
def test_friction_of_all_rebounds_is_that_of_the_weight(restitution):
    """A body that slides while it bounces until it rests has the normal impulse m g t, and so the speed v0 - mu g t."""
    body = udk.Mechanism({"body": udk.Body(1.0, 0.1, [0.0, 0.3], velocity=[4.0, 0.0])})
    foot = udk.Contact("body", restitution=restitution, coefficient=0.2, name="foot")
    run = udk.simulate(body, [0.0, 1.0, 1.9], events=foot, max_events=300, **TOL)
    np.testing.assert_allclose(run.v[1:, 0], [[4.0 - 0.2 * G * t, 0.0, 0.0] for t in (1.0, 1.9)], atol=1e-9)


@pytest.mark.slow
def test_plate_slides_and_sticks():
    """It decelerates by mu g, on both feet, and stays."""
    mechanism, feet = plate(2.0, coefficient=0.3)
    stop = 2.0 / (0.3 * G)
    solution = udk.simulate(mechanism, [0.0, stop / 2, 100.0], events=feet, **TOL)
    np.testing.assert_allclose(solution.q[:, 0, 0], stop * np.array([0.0, 0.75, 1.0]), atol=1e-11)
    assert solution.settings["engine"] == "native"
    assert solution.sticking["foot -0.5"].tolist() == [False, False, True]
    assert solution.events.of("foot -0.5 sticks") == pytest.approx([stop], abs=1e-11)


@pytest.mark.parametrize("restitution", [0.0, 0.5])
@pytest.mark.parametrize("speed", [-5.0, 5.0])
def test_feet_act_on_each_other_by_their_friction(speed, restitution):
    """Also where their normal impulses do not, at centres of percussion: both feet hit together, and the plate does not turn."""
    floor = {"restitution": restitution, "coefficient": 0.3}
    found = []
    for inertia in (0.01, 0.0100001):  # of a plate of 1 kg with feet 0.1 m beside the centre
        body = udk.Body(1.0, inertia, [0.0, 0.3], velocity=[speed, 0.0])
        feet = [udk.Contact("plate", [x, -0.1], name=f"foot {x}", **floor) for x in (-0.1, 0.1)]
        found.append(udk.simulate(udk.Mechanism({"plate": body}), [0.0, 0.21], events=feet, **TOL).events)
    for events in found:
        fall = np.sqrt(2 * G * 0.2)
        after = [speed - np.sign(speed) * 0.3 * (1 + restitution) * fall, restitution * fall, 0.0]
        np.testing.assert_allclose(events.v_after[0, 0], after, rtol=1e-9, atol=1e-9)


def test_mistakes():
    mechanism, _ = plate(1.0)
    mistakes: list[dict[str, Any]] = [{"coefficient": -0.1}, {"static_coefficient": 0.1}, {"coefficient": 0.1, "at_rest": "stop"}]
    for wrong in mistakes:
        with pytest.raises(ValueError, match="coefficient"):
            udk.simulate(mechanism, [0.0, 1.0], events=udk.Contact("plate", **wrong))


def problem_of_friction(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return M and q of an impact of three contacts, two of them with friction, some with dependent rows."""
    rng = np.random.default_rng(seed)
    n, F, rank = 3, 2, rng.integers(2, 5)
    rows = rng.normal(size=(n + F, rank))
    W, D = rows @ rows.T, np.block([[np.eye(n), np.zeros((n, 2 * F))], [np.zeros((F, n)), np.eye(F), -np.eye(F)]])
    mu = np.hstack([np.diag(rng.uniform(0.1, 1.5, n))[:F], -np.eye(F), -np.eye(F), np.zeros((F, F))])
    M = np.vstack([np.hstack([D.T @ W @ D, np.vstack([np.zeros((n, F)), np.eye(F), np.eye(F)])]), mu])
    return M, np.append(D.T @ rows @ rng.normal(size=rank), np.zeros(F))


def test_lemke_solves_problems_of_friction():
    for M, q in map(problem_of_friction, range(8)):
        passive, is_solved = general_complementary_set(M, q, np.ones(len(q), bool), np)
        x = np.zeros(len(q))
        x[passive] = np.linalg.solve(M[np.ix_(passive, passive)], -q[passive])
        y, size = M @ x + q, np.max(abs(q))
        assert is_solved and np.min(x) >= -1e-12 and np.min(y) >= -1e-11 * size and np.max(abs(x * y)) <= 1e-10 * size


def test_lemke_tells_where_there_is_no_solution():
    """y = -x - 1 is never positive, whatever else takes part."""
    for xp in (np, jnp):
        _, is_solved = general_complementary_set(xp.asarray(np.diag([-1.0, 1.0])), xp.array([-1.0, -1.0]), np.ones(2, bool), xp)
        assert not is_solved


def impact_with_friction(rng: np.random.Generator, has_one_restitution: bool) -> tuple[float, float]:
    """Return the relative change of the energy in a random impact, and how far its impulses are beyond the cones of friction.

    Up to four contacts, some of them twice, some without friction, act on up to six coordinates.
    """
    N, n = rng.integers(1, 5), rng.integers(2, 7)
    U = rng.normal(size=(2 * N, n)) * 10 ** rng.uniform(-1, 1, size=(2 * N, 1))
    if N > 1 and rng.random() < 0.3:
        U[1], U[N + 1] = U[0], U[N]
    before, none = rng.normal(size=n), np.zeros(N)
    rate = U @ before
    is_contact, closed = np.arange(2 * N) < N, np.append(rate[:N] <= 0, none > 0)
    e = np.append(np.full(N, rng.uniform()) if has_one_restitution else rng.uniform(size=N), none)
    mu = rng.uniform(0, 1.5, N) * rng.integers(0, 2, N)
    tangents = np.append(np.arange(N) + N, np.full(N, -1))
    contacts = Contacts(is_contact, is_contact, ~is_contact, tangents, e, np.append(mu, none), np.array(1.0))
    rows = ContactRows(U @ U.T, U, np.full(2 * N, True))
    found = impulses_with_friction(contacts, rows, rate, e, closed, np.zeros(2 * N), np)
    after, (normal, along) = before + found.impulse @ U, np.split(found.impulse, 2)
    assert not found.remaining and np.all(found.impulse[~np.append(closed[:N], closed[:N])] == 0)
    beyond = max(np.max(np.abs(along) - mu * normal), np.max(-normal)) / max(np.max(np.abs(found.impulse)), 1e-300)
    return (after @ after - before @ before) / (before @ before), beyond


@pytest.mark.parametrize("count", [60, pytest.param(1000, marks=pytest.mark.slow)])
def test_energy_never_grows_in_impacts(count):
    """With one restitution, and with different ones; the impulses are in the cones of friction."""
    rng = np.random.default_rng(count)
    change, beyond = np.array([impact_with_friction(rng, bool(k % 2)) for k in range(count)]).T
    assert change.max() <= 1e-14 and beyond.max() < 1e-11


@pytest.mark.parametrize("xp", [np, jnp])
def test_rounding_errors_of_speeds_are_no_impact(xp):
    """Contacts that are held in few freedoms, with speeds of 1e-28 in ratios that no motion has: no impulses, nothing blocked."""
    rng, unsolved = np.random.default_rng(7), 0
    for N, n in rng.integers((2, 1), (4, 3), size=(40 if xp is np else 1, 2)):
        U = rng.normal(size=(2 * N, n))
        is_contact, tangents = np.arange(2 * N) < N, np.append(np.arange(N) + N, np.full(N, -1))
        mu = np.append(rng.uniform(0.1, 1.5, N), np.zeros(N))
        contacts = Contacts(is_contact, is_contact, ~is_contact, tangents, np.zeros(2 * N), mu, np.array(1.0))
        rows = ContactRows(xp.asarray(U @ U.T), xp.asarray(U), xp.full(2 * N, True))
        rate, closed = xp.asarray(1e-28 * rng.normal(size=2 * N)), is_contact
        given = contacts, rows, rate, np.zeros(2 * N), closed
        found = impulses_with_friction(*given, xp.full(2 * N, 1e-12), xp)
        assert not found.remaining and not np.any(found.impulse)
        if xp is np:
            unsolved += np.isnan(impulses_with_friction(*given, np.zeros(2 * N), np).impulse).any()
    assert unsolved or xp is not np  # as impacts they would have no solution


@pytest.mark.slow
def test_both_forms_of_lemke_agree():
    for M, q in map(problem_of_friction, range(3)):
        all_ = np.ones(q.shape, bool)
        forms = general_complementary_set(jnp.asarray(M), jnp.asarray(q), all_), general_complementary_set(M, q, all_, np)
        assert all(np.array_equal(x, y) for x, y in zip(*forms, strict=True))


@pytest.mark.slow
def test_plate_on_an_incline():
    """It holds up to the static coefficient; then it slides with g (sin - mu cos)."""
    angle = 0.3
    normal, along = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    for static, rests in ((0.32, True), (0.30, False)):
        mechanism = udk.Mechanism({"plate": udk.Body(2.0, 0.3, 0.1 * normal, angle)})
        feet = [
            udk.Contact("plate", [x, -0.1], normal=normal, coefficient=0.2, static_coefficient=static, name=f"foot {x}")
            for x in (-0.5, 0.5)
        ]
        solution = udk.simulate(mechanism, [0.0, 1.0, 1000.0] if rests else [0.0, 1.0], events=feet, **TOL)
        fall = np.asarray(solution.q[:, 0, :2]) @ along
        expected = 0.0 if rests else -G * (np.sin(angle) - 0.2 * np.cos(angle)) / 2
        np.testing.assert_allclose(fall[1:], expected, atol=1e-9)


@pytest.mark.slow
def test_plate_tips_over_its_front_foot():
    """Friction beyond half the width over the height lifts the other foot at once; the front foot slides on."""
    mechanism, feet = plate(3.0, (-0.1, 0.1), 0.3, coefficient=0.6)
    ts = np.linspace(0.0, 0.2, 5)

    def rate(_, y):
        _, angle, speed, omega = y
        s, c = np.sin(angle), np.cos(angle)
        x0, y0 = c * 0.1 + s * 0.3, s * 0.1 - c * 0.3  # of the foot relative to the centre
        A = np.array([[1.0, 0.0, 0.0, 0.6], [0.0, 1.0, 0.0, -1.0], [0.0, 0.0, 0.1, -(x0 + 0.6 * y0)], [0.0, 1.0, x0, 0.0]])
        a = np.linalg.solve(A, [0.0, -G, 0.0, omega**2 * y0])
        assert a[3] > 0
        return [speed, omega, a[0], a[2]]

    expected = solve_ivp(rate, (0.0, 0.2), [0.0, 0.0, 3.0, 0.0], "DOP853", ts, rtol=1e-12, atol=1e-12).y
    solution = udk.simulate(mechanism, ts, events=feet, **TOL)
    np.testing.assert_allclose(solution.q[:, 0, [0, 2]], expected[:2].T, atol=1e-9)


@pytest.mark.slow
def test_point_is_thrown_on_a_floor():
    """Each bounce takes mu (1 + e) times the normal speed from the sliding speed, as long as there is as much."""
    mu, e, speed, fall = 0.1, 0.5, 3.0, np.sqrt(2 * G * 0.5)
    mechanism, feet = plate(speed, (0.0,), 0.0, 0.5, coefficient=mu, restitution=e)
    hits, x, t = [], 0.0, fall / G
    for _ in range(4):
        x += speed * (t if not hits else 2 * fall / G)
        speed -= mu * (1 + e) * fall
        fall *= e
        hits.append((x, speed))
    solution = udk.simulate(mechanism, [0.0, 1.0], events=feet, max_events=200, **TOL)
    after = np.stack([solution.events.q_after[:4, 0, 0], solution.events.v_after[:4, 0, 0]], axis=1)
    np.testing.assert_allclose(after, hits, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("angle", "slip", "mu", "e"),
    [
        (0.5, 0.0, 0.1, 0.5),
        (0.9, 0.0, 0.6, 0.5),
        (0.5, 1.0, 0.1, 0.3),
        (0.7, -0.3, 0.5, 0.8),
        (0.5, 0.5, 2.0, 0.5),
        (1.2, -1.0, 0.3, 1.0),
    ],
)
def test_rod_falls_on_a_floor(angle, slip, mu, e):
    """Its impulses are Routh's: it slides on, sticks in the compression, or sticks from the beginning."""
    mechanism, contact = rod(angle, (slip, -1.0), coefficient=mu, restitution=e)
    solution = udk.simulate(mechanism, [0.0, 1e-6], events=contact)
    along, normal = impulses_by_routh(angle, (slip, -1.0), mu, e)
    turn = 12 * (-np.cos(angle) / 2 * normal + np.sin(angle) / 2 * along)
    before = np.array([slip, -1.0, 0.0])
    np.testing.assert_allclose(solution.v[-1, 0] - before, [along, normal, turn], atol=1e-12)
    assert udk.energy(mechanism, solution).total[-1] <= 0.5 * (slip**2 + 1) + 1e-15


@pytest.mark.slow
@pytest.mark.parametrize(("mu", "result"), [(2.5, udk.Result.painleve_paradox), (1.0, udk.Result.successful)])
def test_painleve_paradox_is_named(mu, result):
    """A rod that is pushed on a floor, at 1 rad: the more it presses, the more friction turns it, from 1.375 on."""
    angle = 1.0
    critical = (1 + 3 * np.cos(angle) ** 2) / (3 * np.cos(angle) * np.sin(angle))
    assert (mu > critical) == (result == udk.Result.painleve_paradox)
    mechanism = udk.Mechanism({"rod": udk.Body(1.0, 1 / 12, [0.0, np.sin(angle) / 2], angle, velocity=[-2.0, 0.0])})
    contact = udk.Contact("rod", [-0.5, 0.0], coefficient=mu)
    solution = udk.simulate(mechanism, [0.0, 0.05], events=contact, throw=False)
    assert solution.result == result
    assert ("Painleve" in solution.cause) == (mu > critical)


def thrown(x: Any, ts: Any, places: tuple[float, ...] = (-0.5, 0.5), **choices: Any) -> udk.Solution:
    """Return the run of a tilted plate that falls on a floor: its speed, coefficient and restitution are x."""
    mechanism, _ = plate(2.0, height=0.2, above=0.5)
    numbers = {"body.plate.velocity": jnp.stack([x[0], 0.0 * x[0]]), "body.plate.angle": jnp.asarray(0.3)}
    _, feet = plate(0.0, places, coefficient=x[1], static_coefficient=1.2 * x[1], restitution=x[2])
    return udk.simulate(mechanism.with_parameters(numbers), ts, events=feet, max_events=400, **TOL, **choices)


@pytest.mark.slow
def test_lanes_equal_single_runs():
    """Thrown plates tumble, bounce and stick, each at its own times."""
    xs = jnp.stack([jnp.linspace(1, 3, 5), jnp.linspace(0.05, 0.9, 5), jnp.linspace(0.1, 0.6, 5)], 1)

    def motion(x):
        solution = thrown(x, np.linspace(0.0, 2.0, 21))
        return solution.q[:, 0], solution.sticking["foot -0.5"]

    lanes = jax.vmap(motion)(xs)
    for k, x in enumerate(xs):
        q, sticks = motion(x)
        np.testing.assert_allclose(lanes[0][k], q, atol=1e-12)
        np.testing.assert_array_equal(lanes[1][k], sticks)


@pytest.mark.slow
def test_energy_falls_until_the_plate_sticks():
    for x in ([2.0, 0.3, 0.5], [3.0, 0.8, 0.3], [1.0, 0.1, 0.6]):
        solution = thrown(x, np.linspace(0.0, 6.0, 301))
        mechanism, _ = plate(0.0)
        assert np.max(np.diff(udk.energy(mechanism, solution).total)) < 1e-8
        assert all(bool(sticks[-1]) for sticks in solution.sticking.values())
        assert np.max(np.abs(solution.v[-1])) < 1e-10


@pytest.mark.slow
def test_both_engines_agree():
    ts = np.linspace(0.0, 1.5, 7)
    native, plain = (thrown([2.0, 0.3, 0.4], ts, engine=engine) for engine in ("native", "jax"))
    np.testing.assert_allclose(native.q, plain.q, atol=1e-7)
    assert native.events.counts == plain.events.counts


@pytest.mark.slow
def test_derivatives_pass_through_sliding_and_sticking():
    """A point slides v^2 / (2 mu g) until it sticks."""

    def way(x):
        mechanism, _ = plate(2.0, (0.0,), 0.0)
        _, feet = plate(2.0, (0.0,), 0.0, coefficient=x[1])
        numbers = {"body.plate.velocity": jnp.stack([x[0], 0.0 * x[0]])}
        return udk.simulate(mechanism.with_parameters(numbers), [0.0, 3.0], events=feet, **TOL).q[-1, 0, 0]

    closed = [2.0 / (0.3 * G), -(2.0**2) / (2 * 0.3**2 * G)]
    np.testing.assert_allclose(jax.grad(way)(jnp.array([2.0, 0.3])), closed, rtol=1e-9)
    np.testing.assert_allclose(jax.jacfwd(way)(jnp.array([2.0, 0.3])), closed, rtol=1e-9)


@pytest.mark.slow
def test_derivatives_pass_through_impacts_with_friction():
    """Against differences, after the foot of a tilted plate has hit the floor twice."""
    place = lambda x: thrown(x, [0.0, 0.6], (-0.5,)).q[-1, 0]  # noqa: E731
    at = jnp.array([2.0, 0.3, 0.4])
    assert thrown(at, [0.0, 0.6], (-0.5,)).events.count >= 2
    forward = jax.jacfwd(place)(at)
    np.testing.assert_allclose(jax.jacrev(place)(at), forward, rtol=1e-9, atol=1e-11)
    differences = [(place(at + step) - place(at - step)) / 2e-6 for step in 1e-6 * np.eye(3)]
    np.testing.assert_allclose(forward, np.stack(differences, axis=1), rtol=1e-6, atol=1e-7)


def test_derivatives_where_an_impact_ends_all_sliding():
    """Against differences: the lock of a foot that sticks at once, or of a joint that hits its limit, is at its place there."""
    rough = udk.Mechanism({"rod": udk.Body(1.0, 0.03, [0.0, 0.5], 0.9, velocity=[0.4, 0.0])})
    foot = udk.Contact("rod", [-0.3, 0.0], coefficient=0.9, name="foot")
    rail = {"rail": udk.Prismatic(["ground", "block"], [[0.0, 0.0], [0.0, 0.0]], axis=0.0)}
    rub = {"rub": udk.Friction("rail", coefficient=0.1, law="set-valued")}
    block = udk.Mechanism({"block": udk.Body(1.0, 0.1, velocity=[2.0, 0.0])}, rail, forces=rub)

    def fallen(height):
        started = rough.with_parameters({"body.rod.position": jnp.stack([0 * height, height])})
        return udk.simulate(started, [0.0, 0.25, 0.4], events=foot, rtol=1e-10, atol=1e-10)

    def stopped(limit):
        return udk.simulate(block, [0.0, 0.3, 0.6], events=udk.JointLimit("rail", upper=limit), rtol=1e-10, atol=1e-10)

    for run, joint in ((fallen, "foot"), (stopped, "rail")):
        end = lambda x, run=run: run(x).q[1:].ravel()  # noqa: E731
        x, h = jnp.asarray(0.5), 1e-5
        assert run(x).sticking[joint][1]
        change = (end(x + h) - end(x - h)) / (2 * h)
        assert np.abs(change).max() > 0.9
        np.testing.assert_allclose(jax.jvp(end, (x,), (1.0,))[1], change, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_beside_joints_that_stick_and_answers_about_the_run():
    """A wall stops a sledge whose brake sticks to it; reactions and powers of a run with contacts that stick can be asked for."""
    mechanism = udk.Mechanism(
        {"sledge": udk.Body(1.0, 0.1, velocity=[1.0, 0.0]), "brake": udk.Body(0.5, 0.1, velocity=[1.0, 0.0])},
        {
            "rail": udk.Prismatic(["ground", "sledge"], [[0.0, 0.0], [0.0, 0.0]], 0.0),
            "S": udk.Prismatic(["sledge", "brake"], [[0.0, 0.0], [0.0, 0.0]], 0.0),
        },
        forces={"rub": udk.Friction("S", coefficient=0.5, law="set-valued")},
    )
    walls = [udk.Contact("sledge", through=[0.2, 0.0], normal=[-1.0, 0.0], restitution=0.5, name=name) for name in ("one", "two")]
    solution = udk.simulate(mechanism, [0.0, 0.19, 0.6], events=walls, **TOL)
    assert solution.sticking["S"].tolist() == [True, True, True]
    assert solution.events.counts["one"] == 1
    resting, feet = plate(0.0, coefficient=0.3)
    still: Any = udk.simulate(resting, [0.0, 1.0], events=feet)
    found = udk.reactions(resting, still)
    assert set(found) == {"foot -0.5.contact", "foot 0.5.contact"}
    for x in (-0.5, 0.5):  # each foot bears half of the weight
        half = 9.81 / 2
        np.testing.assert_allclose(found[f"foot {x}.contact"]["plate"], 2 * [[0.0, half, x * half]], atol=1e-9)
    assert udk.power_balance(resting, still).kinetic.shape == (2,)
    assert sticking_spans(resting, still) == []


PARTS = 1000  # of an impact


def woodpecker_by_time_stepping(end: float, dt: float) -> np.ndarray:
    """Return height and angles of the gallery's woodpecker at the end, by Moreau's time stepping, of order one.

    The laws of Coulomb and Poisson hold for the impulses of whole steps or, in a step in which a contact closes, of each of many
    parts: first those of a compression, which ends all approaches in proportion, then those of an expansion, at least the
    restitution times the normal ones. They are found by projections in turn.
    """
    arm, neck, bore, half = (1e-3 * x for x in (woodpecker.ARM, woodpecker.NECK, woodpecker.BORE, woodpecker.HALF))
    (m, j), (mass, inertia), (back, up) = woodpecker.RING, woodpecker.BIRD, 1e-3 * np.array(woodpecker.BEAK)
    q = np.array([0.0, woodpecker.TILT[0], woodpecker.SWING[0]])
    v = np.array([woodpecker.FALL, woodpecker.TILT[1], woodpecker.SWING[1]])
    restitution, closed = np.array([woodpecker.RESTITUTION, 0.0, 0.0]), np.zeros(0, int)

    def impulses(v, inverse, lines, least, target):
        found, changes = np.stack([least, 0.0 * least], 1), np.einsum("ij,jkc->ikc", inverse, lines)
        v = v + np.einsum("ikc,kc->i", changes, found)
        for _ in range(500):
            before = found.copy()
            for k in range(len(least)):
                for c in range(2):
                    w, unit = lines[:, k, c], changes[:, k, c]
                    new = found[k, c] - (w @ v - (target[k] if c == 0 else 0.0)) / (w @ unit)
                    bound = woodpecker.FRICTION * found[k, 0]
                    new = max(least[k], new) if c == 0 else min(max(new, -bound), bound)
                    v, found[k, c] = v + unit * (new - found[k, c]), new
            if np.max(np.abs(found - before)) < 1e-16:
                break
        return found[:, 0], v

    for _ in range(round(end / dt)):
        q = q + dt / 2 * v
        (sa, sb), (ca, cb), (_, wa, wb) = np.sin(q[1:]), np.cos(q[1:]), v
        jacobian = np.array([[0.0, -arm * sa, -neck * sb], [1.0, arm * ca, neck * cb]])
        towards = np.array([-arm * ca * wa**2 - neck * cb * wb**2, -arm * sa * wa**2 - neck * sb * wb**2])
        inverse = np.linalg.inv(mass * jacobian.T @ jacobian + np.diag([m, j, inertia]))
        turn = woodpecker.SPRING * (q[2] - q[1])
        v = v + dt * inverse @ (mass * jacobian.T @ (np.array([0.0, -G]) - towards) + np.array([-m * G, turn, -turn]))
        x = [arm * ca + (neck + back) * cb - up * sb, bore * ca + half * sa, bore * ca - half * sa]
        y_rates = [
            [1.0, arm * ca, (neck + back) * cb - up * sb],
            [1.0, bore * ca + half * sa, 0.0],
            [1.0, bore * ca - half * sa, 0.0],
        ]
        x_rates = [
            [0.0, -arm * sa, -(neck + back) * sb - up * cb],
            [0.0, -bore * sa + half * ca, 0.0],
            [0.0, -bore * sa - half * ca, 0.0],
        ]
        before, closed = closed, np.flatnonzero(np.array(x) <= 1e-3 * woodpecker.POLE)
        if len(closed):
            lines = np.stack([np.array(x_rates)[closed].T, np.array(y_rates)[closed].T], -1)
            approach, normal = np.minimum(lines[:, :, 0].T @ v, 0.0), np.zeros(len(closed))
            parts = 1 if np.isin(closed, before).all() else PARTS
            for k in range(parts):
                found, v = impulses(v, inverse, lines, np.zeros(len(closed)), approach * (1 - (k + 1) / parts))
                normal = normal + found
            least = restitution[closed] * normal / parts
            for _ in range(parts * np.any(least > 0)):
                v = impulses(v, inverse, lines, least, np.zeros(len(closed)))[1]
        q = q + dt / 2 * v
    return q


@pytest.mark.slow
def test_a_woodpecker_descends_as_by_time_stepping():
    """For two pecks, at which its ring locks, sticks, slips and comes free."""
    mechanism, contacts = woodpecker.toy()
    last = udk.simulate(mechanism, [0.0, 0.3], events=contacts, max_events=100, **TOL).q[-1]
    found = np.array([last[0, 1], last[0, 2], last[1, 2]])
    errors = [np.abs(woodpecker_by_time_stepping(0.3, dt) - found) for dt in (2e-5, 5e-6)]
    assert np.all(errors[1] < [6e-5, 4e-4, 4e-3])
    assert np.linalg.norm(errors[1]) < 0.5 * np.linalg.norm(errors[0])
