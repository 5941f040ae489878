"""Runs whose contacts rub in impacts of one freedom: rods on pins, slanted guides, four-bars and gears, in both engines."""

# pyright: reportOptionalMemberAccess=false
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk

TOL: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-10}


def rod(angle: Any, speed: float = -1.0) -> udk.Mechanism:
    """Return a rod of 1 m on a pin, without gravity."""
    c, s = np.cos(angle), np.sin(angle)
    body = udk.Body(1.0, 0.1, [c / 2, s / 2], angle, velocity=[-s / 2 * speed, c / 2 * speed], angular_velocity=speed)
    return udk.Mechanism({"moves": body}, {"pin": udk.Revolute(["ground", "moves"], [[0, 0], [-0.5, 0]])}, gravity=[0, 0])


def slider() -> udk.Mechanism:
    """Return a slider in a slanted guide."""
    body = udk.Body(2.0, 0.3, velocity=[np.cos(0.4), np.sin(0.4)])
    return udk.Mechanism({"moves": body}, {"guide": udk.Prismatic(["ground", "moves"], [[0, 0], [0, 0]], 0.4)}, gravity=[0, 0])


def gears() -> udk.Mechanism:
    """Return two wheels of which the second turns half as fast."""
    bodies = {
        "first": udk.Body(1.0, 0.1, angular_velocity=2.0),
        "moves": udk.Body(2.0, 0.5, [3.0, 0.0], angular_velocity=-1.0),
    }
    joints = {
        "A": udk.Revolute(["ground", "first"], [[0, 0], [0, 0]]),
        "B": udk.Revolute(["ground", "moves"], [[3, 0], [0, 0]]),
        "teeth": udk.Gear(["first", "moves"], [1.0, 2.0]),
    }
    return udk.Mechanism(bodies, joints, gravity=[0, 0])


def four_bar() -> udk.Mechanism:
    """Return a four-bar whose coupler moves."""
    return udk.Drawing(
        pins={"A": [0, 0], "B": [0, 50], "C": [150, 100], "D": [150, 0]},
        links={
            "crank": {"pins": ["A", "B"], "mass": 0.1},
            "moves": {"pins": ["B", "C"], "mass": 0.2},
            "rocker": {"pins": ["C", "D"], "mass": 0.2},
        },
        ground=["A", "D"],
        velocities={"B": ["-0.5 m/s", "0 m/s"]},
        gravity=[0, 0],
        units={"length": "mm"},
    ).mechanism()


MAKERS = {"rod": lambda: rod(0.3), "slider": slider, "gears": gears, "four-bar": four_bar}


@cache
def motion(kind: str) -> tuple[udk.Mechanism, float, np.ndarray, np.ndarray, int]:
    """Return a mechanism, a span, its motion in it without contacts, and the index of the body that will hit."""
    mechanism = MAKERS[kind]()
    length = 0.05 if kind == "four-bar" else 1.0
    free = udk.simulate(mechanism, np.linspace(0.0, 0.2 * (1 if kind == "four-bar" else 4), 41), **TOL)
    return mechanism, length, np.asarray(free.q), np.asarray(free.v), mechanism.body_names.index("moves")


def point_motion(q: np.ndarray, v: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return place and velocity of a point of a body."""
    c, s = np.cos(q[2]), np.sin(q[2])
    arm = np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])
    return q[:2] + arm, v[:2] + v[2] * np.array([-arm[1], arm[0]])


def lines(kind: str, count: int, seed: int) -> tuple[udk.Mechanism, np.ndarray, tuple[np.ndarray, ...]]:
    """Return a mechanism, a point of it, and lines that this point will hit, with coefficients and restitutions."""
    mechanism, length, q, v, body = motion(kind)
    rng, found = np.random.default_rng(seed), []
    point = length * np.array([0.5, 0.3])
    start, _ = point_motion(q[0, body], v[0, body], point)
    while len(found) < count:
        k, angle = rng.integers(5, 40), rng.uniform(0, 2 * np.pi)
        place, speed = point_motion(q[k, body], v[k, body], point)
        normal = np.array([np.cos(angle), np.sin(angle)])
        if normal @ speed < -0.02 * np.linalg.norm(speed) and normal @ (start - place) > 1e-3 * length:
            found.append((place, normal, rng.uniform(0, 1.5), rng.uniform(0.1, 1)))
    return mechanism, point, tuple(np.array(x) for x in zip(*found, strict=True))


@pytest.mark.parametrize(
    ("kind", "count"),
    [("rod", 8), ("four-bar", 8), *[pytest.param(kind, 250, marks=pytest.mark.slow) for kind in MAKERS]],
)
def test_impacts_of_one_freedom(kind, count):
    """All velocities are reversed by e (1 - mu |k|) / (1 + mu |k|), and vanish where the contact wedges."""
    mechanism, point, given = lines(kind, count, count)
    span = 0.2 if kind == "four-bar" else 0.8

    def hit(through, normal, mu, e):
        contact = udk.Contact("moves", point, through, normal, coefficient=mu, restitution=e)
        events = udk.simulate(mechanism, [0.0, span], events=contact, max_events=4, throw=False, **TOL).events
        return events.count, events.q_before[0], events.v_before[0], events.v_after[0]

    body, wedges = mechanism.body_names.index("moves"), 0
    for (_, normal, mu, e), n, q, v, after in zip(zip(*given, strict=True), *map(np.asarray, jax.vmap(hit)(*given)), strict=True):
        assert n > 0
        _, speed = point_motion(q[body], v[body], point)
        x = mu * abs((normal[1] * speed[0] - normal[0] * speed[1]) / (normal @ speed))
        rebound, wedges = -e * max(0.0, (1 - x) / (1 + x)), wedges + (x >= 1)
        np.testing.assert_allclose(after, rebound * v, rtol=0, atol=1e-9 * np.max(np.abs(v)))
    assert wedges > 0


def rebound(angle: float, mu: Any = 0.3, e: Any = 0.7, **choices: Any) -> Any:
    """Return the angular velocity of a rod after its tip has hit a floor at an angle."""
    floor = udk.Contact("moves", [0.5, 0.0], [0.0, np.sin(angle)], restitution=e, coefficient=mu)
    return udk.simulate(rod(angle + 0.3), [0.0, 0.5], events=floor, **choices).v[-1, 0, 2]


def test_rebound_is_continuous_and_needs_no_tolerance():
    """At the angle -0.5 it is 0.7 (1 - 0.3 tan 0.5) / (1 + 0.3 tan 0.5)."""
    x = 0.3 * np.tan(0.5)
    found = [float(rebound(-0.5 + k, rtol=tol, atol=tol)) for k, tol in ((0, 1e-6), (0, 1e-9), (1e-6, 1e-8), (3e-6, 1e-8))]
    np.testing.assert_allclose(found, 0.7 * (1 - x) / (1 + x), atol=1e-5)
    assert found[1] == pytest.approx(0.7 * (1 - x) / (1 + x), abs=1e-8)
    assert float(rebound(-1.3, mu=0.5)) == pytest.approx(0.0, abs=1e-9)  # 0.5 tan 1.3 = 1.8: it wedges


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "diffrax"])
def test_derivatives_of_a_rebound_in_one_freedom(engine):
    """Forward and reverse, by the coefficient and the restitution, as in closed form."""
    given, k = jnp.array([0.3, 0.7]), np.tan(0.5)
    run = lambda x: rebound(-0.5, x[0], x[1], engine=engine, **TOL)  # noqa: E731
    closed = lambda x: x[1] * (1 - x[0] * k) / (1 + x[0] * k)  # noqa: E731
    assert float(run(given)) == pytest.approx(float(closed(given)), abs=1e-9)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(run)(given), derivative(closed)(given), atol=1e-8)


@pytest.mark.slow
def test_four_bar_ends_alike_at_all_tolerances():
    """After several impacts with friction of its coupler."""
    mechanism, point, given = lines("four-bar", 1, 3)
    contact = udk.Contact("moves", point, given[0][0], given[1][0], coefficient=0.2, restitution=0.7)
    moving = mechanism.with_parameters({"gravity": jnp.array([0.0, -9.81])})
    ends = [udk.simulate(moving, [0.0, 1.0], events=contact, rtol=tol, atol=tol, max_events=200) for tol in (1e-7, 1e-8, 1e-10)]
    assert ends[0].events.count > 1
    np.testing.assert_allclose([x.q[-1] for x in ends[:2]], np.stack([ends[2].q[-1]] * 2), atol=1e-4)


def test_two_contacts_on_one_freedom():
    """A rod of two tips hits two floors at once; both carry the same part of its momentum."""
    mechanism = rod(0.3)
    floors = [
        udk.Contact("moves", [x - 0.5, 0.0], restitution=e, coefficient=0.0, name=name)
        for x, e, name in ((1.0, 0.2, "outer"), (0.5, 0.8, "inner"))
    ]
    after = float(udk.simulate(mechanism, [0.0, 0.5], events=floors, **TOL).v[-1, 0, 2])
    assert after == pytest.approx(0.5, abs=1e-8)


@pytest.mark.parametrize(("speed", "mu"), [(4.0, 0.5), (4.0, 1.5), (-4.0, 1.5)])
def test_tip_of_a_rod_on_a_driven_carriage(speed, mu):
    """It slides on and rebounds with e; pushed, it jams from mu |k| = 1 on, since friction would have to stop the driver."""
    angle, turn, e = -0.8, -0.3, 0.6
    c, s = np.cos(angle) / 2, np.sin(angle) / 2
    bodies = {
        "carriage": udk.Body(1.0, 0.1, velocity=[speed, 0.0]),
        "rod": udk.Body(1.0, 0.1, [c, s], angle, velocity=[speed - s * turn, c * turn], angular_velocity=turn),
    }
    joints = {
        "rail": udk.Prismatic(["ground", "carriage"], [[0, 0], [0, 0]], 0.0),
        "pin": udk.Revolute(["carriage", "rod"], [[0, 0], [-0.5, 0]]),
    }
    motor = udk.Driver(["ground", "carriage"], "x", udk.Polynomial([0.0, speed]), [[0, 0], [0, 0]])
    mechanism = udk.Mechanism(bodies, joints, {"motor": motor}, gravity=[0, 0])
    floor = udk.Contact("rod", [0.5, 0.0], [0.0, np.sin(-1.0)], restitution=e, coefficient=mu)
    run = udk.simulate(mechanism, [0.0, 0.8], events=floor, throw=False, **TOL)
    if speed > 0 and mu * np.tan(1.0) > 1:
        assert run.result == udk.Result.event_impossible
    else:
        assert float(run.v[-1, 1, 2]) == pytest.approx(-e * turn, abs=1e-9)


def test_plate_lands_on_two_feet():
    """It hops from foot to foot until both rest, whatever the coefficient."""
    unit = np.sqrt(9.81)
    velocity, turn = [-0.3189 * unit, -0.3959 * unit], -0.7586 * unit
    plate = udk.Mechanism({"plate": udk.Body(1.0, 0.2566, [0.0, 1.2849], -0.1371, velocity=velocity, angular_velocity=turn)})
    for mu in (0.3, 0.45, 0.5):
        feet = [
            udk.Contact("plate", [x, -0.2], restitution=e, coefficient=mu, name=name)
            for x, e, name in ((-0.5, 0.144083, "left"), (0.5, 0.089157, "right"))
        ]
        run = udk.simulate(plate, [0.0, 3 / unit], events=feet, max_events=200)
        assert np.max(np.abs(run.v[-1, 0, 1:])) < 1e-9
