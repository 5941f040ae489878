"""Positions over the range of a driver, compared with closed forms."""

from importlib import import_module

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.choices import fast
from udkjax.positions.following import continuation
from udkjax.positions.following.continuation import Reached
from udkjax.positions.following.curve import NumpyCurve
from udkjax.positions.following.drive import drive
from udkjax.positions.following.march import march, march_at_once
from udkjax.programs.deferred import deferred

TURN = np.linspace(np.pi / 3, np.pi / 3 + 2 * np.pi, 73)
VALUES = np.linspace(1.1, 1.5, 12)  # as many as all tests take that compile something
CRANK_ROCKER = {"lengths": (0.5, 1.2, 0.8), "ground": 1.0}
STUCK = (1.0, 1.5, 1.2, 2.2)  # crank, coupler, rocker, ground: not Grashof's


def rocker_angle(crank, a, b, c, g, branch):
    """The angle of the rocker from the diagonal of the four-bar. Crank, coupler, rocker and ground are a, b, c, g."""
    end = a * np.array([np.cos(crank), np.sin(crank)])
    to_ground = np.array([[g], [0.0]]) - end
    d = np.linalg.norm(to_ground, axis=0)
    inner = np.arccos((d**2 + c**2 - b**2) / (2 * d * c))
    return np.arctan2(-to_ground[1], -to_ground[0]) - branch * inner


@pytest.mark.parametrize("branch", [1, -1])
def test_a_crank_rocker_turns_once_on_each_branch_without_a_flip(branch):
    mech = udk.library.four_bar(np.pi / 3, **CRANK_ROCKER)
    if branch < 0:
        b, c = CRANK_ROCKER["lengths"][1:]
        crank, start = np.pi / 3, 0.5 * np.array([np.cos(np.pi / 3), np.sin(np.pi / 3)])
        angle = rocker_angle(np.array([crank]), 0.5, b, c, 1.0, -1)[0]
        pin = np.array([1.0, 0.0]) + c * np.array([np.cos(angle), np.sin(angle)])
        tilt = np.arctan2(*(pin - start)[::-1])
        mech = mech.with_parameters(
            {
                "body.coupler.position": (start + pin) / 2,
                "body.coupler.angle": tilt,
                "body.rocker.position": (np.array([1.0, 0.0]) + pin) / 2,
                "body.rocker.angle": angle,
            }
        )
    found = udk.kinematics(mech, "body.crank.angle", TURN)
    assert np.all(found.status == Reached.closed)
    assert np.isinf(found.limit)
    exact = rocker_angle(TURN, 0.5, 1.2, 0.8, 1.0, branch)
    difference = np.asarray(found.q[:, 2, 2]) - exact
    np.testing.assert_allclose(np.sin(difference / 2), 0.0, atol=1e-14)
    turned = np.asarray(found.q[-1] - found.q[0])
    np.testing.assert_allclose(turned, [[0, 0, 2 * np.pi], [0, 0, 0], [0, 0, 0]], atol=1e-14)


def test_velocities_and_accelerations_are_the_derivatives_of_positions():
    mech = udk.library.four_bar(np.pi / 3, **CRANK_ROCKER)
    h = 1e-4
    near = udk.kinematics(mech, "body.crank.angle", 1.3 + h * np.array([-1.0, 0.0, 1.0]), rate=2.0, acceleration=3.0)
    q, v, a = (np.asarray(x) for x in (near.q, near.v[1], near.a[1]))
    first, second = (q[2] - q[0]) / (2 * h), (q[2] - 2 * q[1] + q[0]) / h**2
    np.testing.assert_allclose(v, 2.0 * first, atol=1e-7)
    np.testing.assert_allclose(a, 4.0 * second + 3.0 * first, atol=1e-6)


def test_a_linkage_stops_at_its_toggle():
    a, b, c, g = STUCK
    mech = udk.library.four_bar(np.pi / 3, lengths=(a, b, c), ground=g)
    toggle = np.arccos((a**2 + g**2 - (b + c) ** 2) / (2 * a * g))
    values = np.append(np.linspace(np.pi / 3, toggle - 1e-6, 8), [toggle - 1e-13, toggle + 1e-9, toggle + 0.1, 1.0])  # 12
    found = udk.kinematics(mech, "body.crank.angle", values)
    assert [Reached(int(s)) for s in found.status[-5:]] == [Reached.closed, *[found.status[-4]], *[Reached.beyond_limit] * 3]
    assert abs(float(found.limit) - toggle) < 1e-13
    np.testing.assert_allclose(np.sin(found.limit_q[1, 2] - found.limit_q[2, 2]), 0.0, atol=1e-7)  # in line
    assert np.all(np.isnan(found.q[-3:]))
    exact = rocker_angle(values[:8], a, b, c, g, 1)
    np.testing.assert_allclose(np.sin((np.asarray(found.q[:8, 2, 2]) - exact) / 2), 0.0, atol=1e-9)


@pytest.mark.slow
def test_travel_has_two_ends_and_exact_derivatives():
    a, b, c, g = STUCK
    mech = udk.library.four_bar(np.pi / 3, lengths=(a, b, c), ground=g)

    def upper(g):
        return jnp.arccos((a**2 + g**2 - (b + c) ** 2) / (2 * a * g))

    def ends(g):
        found = udk.travel(mech.with_parameters({"joint.D.points[0][0]": g}), "body.crank.angle")
        return jnp.stack([found.lower, found.upper])

    values, slopes = jax.jit(lambda g: jax.jvp(ends, (g,), (1.0,)))(g)
    np.testing.assert_allclose(values, [-upper(g), upper(g)], atol=1e-13)
    np.testing.assert_allclose(slopes, [-jax.grad(upper)(g), jax.grad(upper)(g)], atol=1e-12)
    free = udk.travel(udk.library.four_bar(np.pi / 3, **CRANK_ROCKER), "body.crank.angle")
    assert (float(free.lower), float(free.upper)) == (-np.inf, np.inf)


def geared_five_bar():
    """The second crank makes half a turn where the first makes a whole one, after which the linkage is another."""
    crank, other, left, right = 0.54296171, 0.21343423, 1.01075881, 0.62295893
    tips = np.array([crank * np.exp(2.179j), 1.0 + other * np.exp(-1.2j)])
    apart = tips[1] - tips[0]
    along = (left**2 - right**2 + abs(apart) ** 2) / (2 * abs(apart))
    knee = tips[0] + apart / abs(apart) * (along + 1j * np.sqrt(left**2 - along**2))
    bars = {"first": (0.0, tips[0]), "second": (1.0, tips[1]), "left": (tips[0], knee), "right": (tips[1], knee)}
    bodies = {
        name: udk.Body(1.0, 0.1, [(a + b).real / 2, (a + b).imag / 2], float(np.angle(b - a))) for name, (a, b) in bars.items()
    }
    half = {name: abs(b - a) / 2 for name, (a, b) in bars.items()}
    pin = lambda a, at, b, end: udk.Revolute([a, b], [at, [end * half[b], 0]])  # noqa: E731
    joints = {
        "O": pin("ground", [0, 0], "first", -1),
        "E": pin("ground", [1, 0], "second", -1),
        "A": pin("first", [half["first"], 0], "left", -1),
        "B": pin("second", [half["second"], 0], "right", -1),
        "P": pin("left", [half["left"], 0], "right", 1),
        "gear": udk.Gear(["first", "second"], [1 / 3, 2 / 3]),
    }
    return udk.Mechanism(bodies, joints)


@pytest.mark.parametrize(
    ("mechanism", "driver", "limits"),
    [
        (udk.library.four_bar, "body.crank.angle", (False, False)),
        (udk.library.four_bar, "body.rocker.angle", (True, True)),
        (geared_five_bar, "body.first.angle", (False, True)),
    ],
)
def test_travel_without_a_limit_is_followed_once_if_a_turn_leads_back(mechanism, driver, limits, monkeypatch):
    found = udk.travel(mechanism(), driver)
    assert tuple(bool(np.isfinite(x)) for x in (found.lower, found.upper)) == limits
    monkeypatch.setattr(import_module("udkjax.positions.following.travel"), "_returns", lambda *given: False)
    both_ways = udk.travel(mechanism(), driver)
    for name in ("lower", "upper", "lower_q", "upper_q", "status"):
        np.testing.assert_allclose(getattr(found, name), getattr(both_ways, name), rtol=1e-12)


@pytest.mark.parametrize("stages", fast([3], [1, 2, 3, 4, 5]))
def test_travel_ends_at_toggles_where_branches_meet(stages):
    """At the top, all bars of a lift are upright, and each may turn to either side. Before, all platforms are level."""
    found = udk.travel(udk.library.scissor_lift(stages, 0.7, length=2.5), "body.platform.y")
    np.testing.assert_allclose([found.lower, found.upper], 2.5 * stages * np.array([-1, 1]), rtol=4e-15)
    np.testing.assert_allclose(np.abs(found.upper_q[: 2 * stages, 2]), np.pi / 2, atol=1e-12)


@pytest.mark.slow
def test_travel_of_traced_lifts_ends_there_too():
    lift = udk.library.scissor_lift(2)
    found = jax.jit(lambda m: udk.travel(lift.with_parameters({"body.platform.mass": m}), "body.platform.y"))(3.0)
    np.testing.assert_allclose([found.lower, found.upper], [-2.0, 2.0], rtol=4e-15)


class Level(udk.Joint):
    """Two origins at one height. It is not a joint of these two bodies alone, since it does not turn with them."""

    def residual(self, t, *frames):
        return [frames[1].y - frames[0].y]


def with_bodies(mech, bodies, joints):
    return udk.Mechanism({**mech.bodies, **bodies}, {**mech.joints, **joints})


def with_hung(kind):
    """The four-bar that stops, with something attached to its coupler or the ground; and a pendulum with a wheel."""
    mech = udk.library.four_bar(np.pi / 3, lengths=STUCK[:3], ground=STUCK[3])
    x, y, _ = np.asarray(mech.q0)[mech.body_names.index("coupler")]
    wheel = lambda on, place: ({"wheel": udk.Body(1.0, 0.1, place, 0.2)}, {"axle": udk.Revolute([on, "wheel"], [place, (0, 0)])})  # noqa: E731
    if kind == "wheel on the ground":
        return with_bodies(mech, *wheel("ground", (0.0, 3.0)))
    rod = {"rod": udk.Body(1.0, 0.1, [x, y - 0.5], 0.0)}
    pin = {"hook": udk.Revolute(["coupler", "rod"], [(0.0, 0.0), (0.0, 0.5)])}
    if kind == "pendulum with a wheel":
        return with_bodies(
            mech,
            {**rod, "wheel": udk.Body(1.0, 0.1, [x, y - 1.0], 0.2)},
            {**pin, "axle": udk.Revolute(["rod", "wheel"], [(0.0, -0.5), (0.0, 0.0)])},
        )
    return with_bodies(mech, {"rod": udk.Body(1.0, 0.1, [x + 0.5, y], 0.0)}, {"level": Level(["coupler", "rod"])})


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wheel on the ground", "pendulum with a wheel"])
def test_what_hangs_on_one_body_limits_no_travel(kind):
    mech, plain = with_hung(kind), udk.library.four_bar(np.pi / 3, lengths=STUCK[:3], ground=STUCK[3])

    def ends(mech):
        found = udk.travel(mech, "body.crank.angle")
        return found, jnp.stack([found.lower, found.upper])

    (found, values), (bare, expected) = ends(mech), ends(plain)
    np.testing.assert_array_max_ulp(values, expected, 4)  # by elimination or by singular values, which differ by rounding
    np.testing.assert_allclose(found.upper_q[:3], bare.upper_q, atol=1e-12)
    assert np.abs(udk.equations.psi(mech, 0.0, found.upper_q)).max() < 1e-12
    assert np.all(np.isfinite(found.lower_q))
    number = "joint.D.points[0][0]"
    slopes = [jax.jvp(lambda g, m=m: ends(m.with_parameters({number: g}))[1], (STUCK[3],), (1.0,))[1] for m in (mech, plain)]
    np.testing.assert_allclose(*slopes, atol=1e-12)
    with pytest.raises(udk.SceneError, match="drive or hold"):  # positions of all do not follow
        udk.kinematics(mech, "body.crank.angle", [1.0])
    free = udk.travel(mech, "body.wheel.angle") if kind == "wheel on the ground" else None
    assert free is None or (float(free.lower), float(free.upper)) == (-np.inf, np.inf)


def test_what_does_not_move_along_is_not_carried():
    with pytest.raises(udk.SceneError, match="drive or hold"):
        udk.travel(with_hung("level"), "body.crank.angle")


def test_peaucellier_draws_a_straight_line():
    mech = udk.library.peaucellier()
    found = udk.kinematics(mech, "body.crank.angle", np.linspace(np.pi / 6, -1.5, 40))
    assert np.all(found.reached)
    path = found.path("AD", (0.5 * mech.joints["D"].points[0][0] * 2, 0.0))
    x = np.asarray(path[:, 0])
    np.testing.assert_allclose(x, x[0], atol=1e-12)
    assert np.ptp(path[:, 1]) > 0.5


@pytest.mark.parametrize("scale", [1e-6, 1e3])
def test_size_does_not_matter(scale):
    a, b, c, g = (scale * x for x in STUCK)
    mech = udk.library.four_bar(np.pi / 3, lengths=(a, b, c), ground=g)
    values = np.append(VALUES[:11], 2.0)
    found = udk.kinematics(mech, "body.crank.angle", values)
    assert [int(s) for s in found.status] == [*[Reached.closed] * 11, Reached.beyond_limit]
    assert abs(float(found.limit) - np.arccos((a**2 + g**2 - (b + c) ** 2) / (2 * a * g))) < 1e-12
    exact = rocker_angle(values[:11], a, b, c, g, 1)
    np.testing.assert_allclose(np.sin((np.asarray(found.q[:11, 2, 2]) - exact) / 2), 0.0, atol=1e-13)


REDUNDANT = {
    "parallelogram": (lambda: udk.library.parallelogram(-0.8), "body.link1.angle", -0.8, 5.1),
    "two-four-bar": (lambda: udk.library.n_four_bar(2), "body.link0.angle", np.pi / 2, -3.0),
    "scissor lift": (lambda: udk.library.scissor_lift(2), "body.platform.y", 1.0, 0.4),
}


@pytest.mark.parametrize("name", fast(["parallelogram"], REDUNDANT))
def test_redundant_linkages_keep_their_branch_where_branches_meet(name):
    make, driver, first, last = REDUNDANT[name]
    values = np.linspace(first, last, 30)
    found = udk.kinematics(make(), driver, values)
    assert np.all(found.status == Reached.closed)
    q = np.asarray(found.q)
    if name == "scissor lift":
        np.testing.assert_allclose(q[:, :4, 2], np.arcsin(values / 2)[:, None] * [1, -1, 1, -1], atol=1e-12)
        return
    links = [k for k, body in enumerate(found.bodies) if "link" in body]
    np.testing.assert_allclose(q[:, links, 2], np.broadcast_to(values[:, None], (30, len(links))), atol=1e-9)
    np.testing.assert_allclose(np.asarray(found.v)[:, links, 2], 1.0, atol=1e-6)


@pytest.mark.parametrize("beside", fast([0.0, -1e-9, 1e-3], [0.0, 1e-12, -1e-9, 1e-7, -1e-5, 1e-3, -1e-2]))
def test_the_branch_goes_on_where_branches_meet(beside):
    """Positions, velocities, accelerations and efforts, at the value itself and at any distance from it."""
    values = np.linspace(-0.8, 5.1, 30)
    values[19] = np.pi + beside
    mech = udk.library.parallelogram(-0.8)
    found = udk.kinematics(mech, "body.link1.angle", values)
    assert list(np.flatnonzero(found.status)) == [19] * (abs(beside) < 1e-4)
    assert np.all(found.reached) and set(found.status.tolist()) <= {Reached.closed, Reached.singular}
    links = [k for k, body in enumerate(found.bodies) if "link" in body]
    angles = np.broadcast_to(values[:, None], (30, len(links)))
    np.testing.assert_allclose(found.q[:, links, 2], angles, atol=1e-12)
    np.testing.assert_allclose(found.v[:, links, 2], 1.0, atol=1e-10)
    np.testing.assert_allclose(found.a[:, :, 2], 0.0, atol=1e-8)
    needed = udk.inverse_dynamics(mech, values, found, ["body.link1.angle"])
    rise = sum(body.mass * 9.81 * found.v[:, k, 1] for k, body in enumerate(mech.bodies.values()))  # at a constant kinetic energy
    assert np.all(needed.determined)
    np.testing.assert_allclose(needed.efforts["body.link1.angle"], rise, atol=1e-7)


def slider_crank_of_equal_lengths(r):
    """When the crank is upright, the slider is at its pivot and may stay there: x = 2 r cos(s), or 0."""
    angle, tip = 0.4, r * np.array([np.cos(0.4), np.sin(0.4)])
    at = lambda position, angle: udk.Body(1.0, 0.1 * r**2, position, angle)  # noqa: E731
    bodies = {"crank": at(tip / 2, angle), "rod": at(tip * [1.5, 0.5], -angle), "slider": at([2 * tip[0], 0.0], 0.0)}
    joints = {
        "O": udk.Revolute(["ground", "crank"], [[0.0, 0.0], [-r / 2, 0.0]]),
        "P": udk.Revolute(["crank", "rod"], [[r / 2, 0.0], [-r / 2, 0.0]]),
        "B": udk.Revolute(["rod", "slider"], [[r / 2, 0.0], [0.0, 0.0]]),
        "guide": udk.Prismatic(["ground", "slider"], [[0.0, 0.0], [0.0, 0.0]], axis=0.0),
    }
    return udk.Mechanism(bodies, joints)


@pytest.mark.slow
@pytest.mark.parametrize("r", [1e-6, 1.0, 1e3])
def test_a_slider_passes_the_pivot_of_its_crank(r):
    mech = slider_crank_of_equal_lengths(r)
    batch = jax.jit(jax.vmap(lambda values: udk.kinematics(mech, "body.crank.angle", values)))
    for first in (0.5, np.pi / 2):  # also where it starts in such a position
        values = np.array([[first, np.pi / 2 + beside, 2.5] for beside in (0.0, 1e-9, 1e-5, 1e-2)])
        found = batch(values)
        assert np.all(Reached.has_position(found.status)) and found.status[0, 1] == Reached.singular
        for x, exact, atol in (
            (found.q, np.cos, 1e-12),
            (found.v, lambda s: -np.sin(s), 1e-10),
            (found.a, lambda s: -np.cos(s), 1e-8),
        ):
            np.testing.assert_allclose(x[:, 0:, 2, 0] / r, 2 * exact(values), atol=atol)


def parallelogram_of_one_loop():
    """Two cranks of 1 m, coupler and ground of 2 m: on the branch the coupler's centre is at (cos(s) + 1, sin(s))."""
    c, d = 0.5 * np.cos(0.5), 0.5 * np.sin(0.5)
    places = {"crank": ([c, d], 0.5), "coupler": ([2 * c + 1.0, 2 * d], 0.0), "rocker": ([2.0 + c, d], 0.5)}
    joints = {
        "A": udk.Revolute(["ground", "crank"], [[0.0, 0.0], [-0.5, 0.0]]),
        "B": udk.Revolute(["crank", "coupler"], [[0.5, 0.0], [-1.0, 0.0]]),
        "C": udk.Revolute(["coupler", "rocker"], [[1.0, 0.0], [0.5, 0.0]]),
        "D": udk.Revolute(["ground", "rocker"], [[2.0, 0.0], [-0.5, 0.0]]),
    }
    return udk.Mechanism({name: udk.Body(1.0, 0.1, *place) for name, place in places.items()}, joints)


SAME = {"A": (1, -0.5), "B": (0, 0.5), "C": (1, 0.5), "D": (1, -0.5)}  # the pins of both cranks, halves of their lengths
VALUES_ACROSS = np.array([0.5, 2.0, np.pi, 4.0])
COS, SIN, ZERO = np.cos(VALUES_ACROSS), np.sin(VALUES_ACROSS), np.zeros(4)
MEETING = {  # numbers that change, and what that changes of the coupler's x and y, q, q' and q''; None: the branches part
    "both cranks": (
        lambda x: {f"joint.{n}.points[{k}][0]": r * (1 + x) for n, (k, r) in SAME.items()},
        [[COS, SIN], [-SIN, COS], [-COS, -SIN]],
    ),
    "one crank": (lambda x: {"joint.B.points[0][0]": 0.5 + x}, None),
    "pins of the coupler": (
        lambda x: {"joint.B.points[1][1]": x, "joint.C.points[0][1]": x},
        [[ZERO, ZERO - 1], [ZERO, ZERO], [ZERO, ZERO]],
    ),
    "mass": (lambda x: {"body.crank.mass": 1.0 + x}, np.zeros((3, 2, 4))),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MEETING)
def test_where_branches_meet_derivatives_are_right_or_not_numbers(name):
    """They are finite if the change keeps the branches together; in reverse mode, if each number by itself does."""
    numbers, exact = MEETING[name]
    mech = parallelogram_of_one_loop()

    def f(x):
        found = udk.kinematics(mech.with_parameters(numbers(x)), "body.crank.angle", VALUES_ACROSS)
        return jnp.stack([found.q[:, 1], found.v[:, 1], found.a[:, 1]])

    forward, reverse = (np.asarray(jax.jit(jac(f))(0.0)) for jac in (jax.jacfwd, jax.jacrev))
    crossing = np.arange(4) == 2
    assert np.array_equal(np.isnan(forward).any((0, 2)), crossing & (exact is None))
    assert np.array_equal(np.isnan(reverse).any((0, 2)), crossing & (name in ("one crank", "both cranks")))
    np.testing.assert_allclose(reverse, np.where(np.isnan(reverse), np.nan, forward), atol=1e-12)
    if exact is not None:
        np.testing.assert_allclose(forward[..., :2], np.moveaxis(exact, 1, 2), atol=1e-9)
        np.testing.assert_allclose(forward[..., 2], 0.0, atol=1e-9)


@pytest.mark.slow
def test_where_branches_meet_derivatives_by_the_value_go_to_the_third_of_q():
    mech = parallelogram_of_one_loop()

    def f(s):
        found = udk.kinematics(mech, "body.crank.angle", jnp.array([0.5, 2.0, s]))
        return jnp.stack([found.q[2, 1], found.v[2, 1], found.a[2, 1]])

    first, second = jax.jit(jax.jacfwd(f))(np.pi), jax.jit(jax.jacfwd(jax.jacfwd(f)))(np.pi)
    np.testing.assert_allclose(first, [[0, -1, 0], [1, 0, 0], [0, 1, 0]], atol=1e-9)
    np.testing.assert_allclose(second[:2], [[1, 0, 0], [0, 1, 0]], atol=1e-9)
    assert np.isnan(second[2]).all()


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9, 1e-12])
def test_branches_that_come_close_and_do_not_meet_are_no_crossing(gap):
    """The ground is longer than the coupler: the crank reaches a toggle before pi, and cannot go beyond."""
    mech = udk.library.four_bar(0.5, lengths=(1.0, 2.0, 1.0), ground=2.0 + gap)
    found = udk.kinematics(mech, "body.crank.angle", [0.5, 2.0, np.pi, 4.0])
    assert found.status[:2].tolist() == [0, 0]
    assert not np.any(found.reached[2:]) and np.all(np.isnan(found.q[2:]))


def test_accelerations_of_a_linkage_with_short_links_are_accurate():
    """Singular values of its rows are small, down to 0.002, over two fifths of the turn, but no branches meet."""
    places = np.array([(-0.384, -0.615), (2.655, -6.006), (1.725, -4.571), (7.098, -3.319), (6.681, -1.764), (7.529, -3.569)])
    pins = dict(zip("OABCDEF", [*places, (6.56, -2.027)], strict=True))
    z = {name: complex(*place) for name, place in pins.items()}
    links = {"crank": "OA", "coupler": "ACD", "rocker": "BEC", "link": "DF", "last": "EF"}
    drawn = {name: udk.Link(list(of), mass=1.0, **({"width": 0.1} if len(of) == 2 else {})) for name, of in links.items()}
    linkage = udk.Drawing(pins, drawn, ground=["O", "B"], motors={"motor": {"pin": "O", "speed": 1.0}}).mechanism()

    def meeting(p, q, names):
        P, Q, R = (z[a] for a in names)
        way, r, side = q - p, abs(R - P), np.sign(np.imag(np.conj(Q - P) * (R - P)))
        square = jnp.real(way * jnp.conj(way))
        a = 0.5 + 0.5 * (r**2 - abs(R - Q) ** 2) / square
        return p + way * (a + side * 1j * jnp.sqrt(r**2 / square - a**2))

    def angle_of_link(turn):
        a = z["O"] + (z["A"] - z["O"]) * jnp.exp(1j * turn)
        c = meeting(a, z["B"], "ABC")
        d = a + (c - a) / (z["C"] - z["A"]) * (z["D"] - z["A"])
        e = z["B"] + (c - z["B"]) / (z["C"] - z["B"]) * (z["E"] - z["B"])
        return jnp.angle((meeting(d, e, "DEF") - d) / (z["F"] - z["D"]))

    turns = np.append(0.0, np.linspace(2.9, 3.4, 51))
    found = udk.kinematics(linkage, None, turns)
    exact = jax.jit(jax.vmap(jax.grad(jax.grad(angle_of_link))))(turns)
    np.testing.assert_allclose(found.a[:, list(linkage.bodies).index("link"), 2], exact, rtol=1e-9, atol=1e-9)


def test_where_velocities_do_not_follow_they_are_no_numbers():
    a, b, c, g = STUCK
    mech = udk.library.four_bar(np.pi / 3, lengths=(a, b, c), ground=g)
    toggle = np.arccos((a**2 + g**2 - (b + c) ** 2) / (2 * a * g))
    values = np.append(np.linspace(np.pi / 3, toggle - 1e-6, 8), [toggle - 1e-9, toggle, toggle + 1e-9, 2.0])  # 12
    found = udk.kinematics(mech, "body.crank.angle", values)
    assert int(found.status[9]) == Reached.not_determined and found.reached[9]
    assert np.all(np.isfinite(found.q[9])) and np.all(np.isnan(found.v[9])) and np.all(np.isnan(found.a[9]))
    needed = udk.inverse_dynamics(mech, values, found, ["body.crank.angle"])
    assert needed.determined.tolist() == np.isfinite(np.asarray(found.v)[:, 0, 0]).tolist()
    with pytest.raises(ValueError, match="not determined at"):
        udk.feed_forward(mech, needed)


def hung():
    """A rod whose pin is on a line, 1 m from a point above it."""
    pin = [-0.75, 0.0]
    joints = {
        "line": udk.Slot(["ground", "rod"], [[0.0, 0.0], pin], axis=0.0),
        "D": udk.Distance(["ground", "rod"], [[0.0, 0.3], pin], 1.0),
    }
    return udk.Mechanism({"rod": udk.Body(1.0, 0.2, [1.4, -0.5], -0.8)}, joints)


DIFFERENTIATED = {
    "hung rod": (hung, "joint.D.length", "body.rod.x", VALUES + 0.2, 0),
    "crank-rocker": (
        lambda: udk.library.four_bar(np.pi / 3, **CRANK_ROCKER),
        "joint.D.points[0][0]",
        "body.crank.angle",
        VALUES,
        2,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DIFFERENTIATED)
@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_of_positions_by_numbers_of_the_scene(name, order):
    """Derivatives of a batch, compared with differences of its members."""
    make, number, driver, values, body = DIFFERENTIATED[name]
    mech = make()

    def f(g):
        found = udk.kinematics(mech.with_parameters({number: g}), driver, values)
        return jnp.stack([found.q[1, body, 2], found.v[1, body, 2], found.a[1, body, 2]])

    g, h = f if order == 1 else lambda g: jax.jvp(f, (g,), (1.0,))[1], 1e-5
    members = jax.jit(jax.vmap(jax.jacrev(lambda x: (g(x),) * 2, has_aux=True)))
    with jax.debug_nans(True):
        (slope, *_), (_, ahead, behind) = members(jnp.array([1.0, 1.0 + h, 1.0 - h]))
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * h), atol=1e-8 if order == 1 else 1e-7)


def test_transmission_angle_and_mechanical_advantage():
    mech = udk.library.four_bar(np.pi / 3, **CRANK_ROCKER)
    found = udk.kinematics(mech, "body.crank.angle", TURN[:20])
    d2 = 0.5**2 + 1.0 - 2 * 0.5 * np.cos(TURN[:20])
    np.testing.assert_allclose(
        np.cos(udk.transmission_angle(mech, found, "C")), (1.2**2 + 0.8**2 - d2) / (2 * 1.2 * 0.8), atol=1e-12
    )
    advantage = udk.mechanical_advantage(mech, found, "body.rocker.angle")
    np.testing.assert_allclose(advantage, 1 / np.asarray(found.v[:, 2, 2]), rtol=1e-12)
    with pytest.raises(udk.SceneError, match="other pins"):
        udk.transmission_angle(mech, found, "A")


@pytest.mark.slow
def test_the_workspace_of_two_links_is_a_ring():
    mech = udk.library.double_pendulum()
    one, two = mech.body_names
    pin = mech.joints[list(mech.joints)[1]].points
    arm = float(2 * np.linalg.norm(pin[1]))
    first, second = np.linspace(-1.0, 1.0, 5), np.linspace(-2.0, 2.0, 7)
    base = np.asarray(mech.q0[:, 2])
    tip = -np.asarray(pin[1])
    found = udk.workspace(mech, {f"body.{one}.angle": base[0] + first, f"body.{two}.angle": base[1] + second}, two, tip)
    assert np.all(found.reached)
    foot = next(iter(mech.joints.values())).points
    radius = np.linalg.norm(np.asarray(found.points) - np.asarray(foot[0]), axis=-1)
    length = float(np.linalg.norm(np.asarray(pin[0]) - np.asarray(foot[1])))
    angle = (base[1] + second)[None, :] - (base[0] + first)[:, None]
    np.testing.assert_allclose(radius, np.sqrt(length**2 + arm**2 + 2 * length * arm * np.cos(angle)), atol=1e-12)


def test_the_violation_along_values_is_that_of_the_driven_mechanism():
    """Values are not times, at which a driver would be elsewhere; other drivers hold their values."""
    crank, values = udk.library.slider_crank(0.3, 4.0), np.linspace(0.3, 6.5, 9)
    arm = dict(zip("ab", two_motors().drivers, strict=True))
    cases = [
        (crank, udk.kinematics(crank, "motor", values)),
        (crank, udk.kinematics(crank, None, values)),
        (udk.library.four_bar(), udk.kinematics(udk.library.four_bar(), "body.crank.angle", values)),
        (two_motors(), udk.kinematics(two_motors(), arm["a"], [0.1, 0.5, 0.9], held={arm["b"]: 0.7})),
    ]
    for mech, motion in cases:
        assert np.abs(udk.violation(mech, motion)).max() < 1e-12
        off = eqx.tree_at(
            lambda m: m.q, motion, motion.q.at[1:].add(1e-3 * np.arange(motion.q[1:].size).reshape(motion.q[1:].shape))
        )
        assert np.abs(udk.violation(mech, off)).max() > 1e-4
    traced = deferred(lambda a: udk.violation(crank, udk.kinematics(crank, "motor", a + values)))(jnp.asarray(0.1))
    assert np.abs(traced).max() < 1e-12


def two_motors():
    """Two links in a chain, each turned by a motor of its own whose speed is not constant."""
    bodies = {"upper": udk.Body(1.0, 0.1, (0.5, 0.0)), "lower": udk.Body(1.0, 0.1, (1.5, 0.0))}
    joints = {
        "A": udk.Revolute(("ground", "upper"), ((0, 0), (-0.5, 0))),
        "B": udk.Revolute(("upper", "lower"), ((0.5, 0), (-0.5, 0))),
    }
    motion = udk.Polynomial((0.0, 0.0, 3.0))
    drivers = {
        name: udk.Driver(joint.bodies, "angle", motion) for name, joint in zip(("first", "second"), joints.values(), strict=True)
    }
    return udk.Mechanism(bodies, joints, drivers)


def test_what_cannot_be_driven_is_refused():
    mech = udk.library.four_bar()
    with pytest.raises(udk.SceneError, match='did you mean "crank"'):
        udk.kinematics(mech, "body.crnk.angle", [1.0])
    with pytest.raises(udk.SceneError, match="cannot be driven"):
        udk.kinematics(mech, "body.crank.omega", [1.0])
    with pytest.raises(udk.SceneError, match="held is given with driver=None"):
        udk.kinematics(udk.library.slider_crank(0.3, 4.0), None, [0.0, 1.0], held={"motor": 1.0})
    with pytest.raises(udk.SceneError, match="driver is None: name one of the drivers"):
        udk.travel(udk.library.slider_crank(0.3, 4.0), None)
    for of in (lambda f: f, jax.jit, jax.grad):  # known, traced, differentiated
        with pytest.raises(udk.SceneError, match="the scene has no driver: name a coordinate that drives it"):
            of(lambda a: jnp.sum(udk.kinematics(udk.library.four_bar(a), None, [0.0, 1.0]).q))(1.0)
    with pytest.raises(udk.SceneError, match="keeps 1 degree of freedom"):
        udk.kinematics(udk.library.double_pendulum(), f"body.{udk.library.double_pendulum().body_names[0]}.angle", [1.0])


@pytest.mark.parametrize(("given", "said"), [((np.zeros(3), np.zeros(3)), "ndarray, ndarray"), ((), "nothing")])
def test_the_value_of_a_coordinate_takes_frames(given, said):
    crank = udk.Coordinate(["ground", "crank"], "angle")
    with pytest.raises(TypeError, match=f'a udk.Frame of each of "ground", "crank", not {said}'):
        crank.value(*given)


ASK = {
    "kinematics": lambda mech, driver: udk.kinematics(mech, driver, [1.0]),
    "travel": udk.travel,
    "branches": lambda mech, driver: udk.branches(mech, driver, 1.0),
    "coupler_curve": lambda mech, driver: udk.coupler_curve(mech, driver, np.ones(1), "rod"),
    "workspace": lambda mech, driver: udk.workspace(mech, {driver: np.ones(1), "body.rod.angle": np.ones(1)}, "rod"),
}


@pytest.mark.parametrize("name", ASK)
def test_a_coordinate_that_a_driver_holds_is_refused_by_the_drivers_name(name):
    with pytest.raises(udk.SceneError, match=r'body\.slider\.x is held by (driver "motor"|"body\.rod\.angle")'):
        ASK[name](udk.library.slider_crank(0.3, 4.0), "body.slider.x")


def test_what_is_held_and_what_joints_hold_is_refused():
    mech = udk.library.four_bar()
    with pytest.raises(udk.SceneError, match=r'rocker\.angle is held by "body\.crank\.angle", which `held` gives'):
        udk.kinematics(mech, "body.rocker.angle", [1.0], held={"body.crank.angle": 1.0})
    fixed = udk.Mechanism({"a": udk.Body(1.0, 1.0)}, {"W": udk.Weld(["ground", "a"], [[0.0, 0.0], [0.0, 0.0]])})
    with pytest.raises(udk.SceneError, match="the joints leave it no motion"):
        udk.travel(fixed, "body.a.angle")
    free = udk.library.parallelogram(0.0)  # flat: there the angle depends on the joints, and nowhere else
    assert drive(free, "body.link1.angle").name


def coupler_pin(a, b, c, d, angle, sign):
    """The pin of coupler and rocker of a four-bar, on one of two branches, as an intersection of two circles."""
    A, C = a * np.stack([np.cos(angle), np.sin(angle)], -1), np.array([d, 0.0])
    D = np.linalg.norm(A - C, axis=-1)
    along, across = (A - C) / D[:, None], np.stack([C[1] - A[:, 1], A[:, 0] - C[0]], -1) / D[:, None]
    x = (D**2 + c**2 - b**2) / (2 * D)
    return C + x[:, None] * along + sign * np.sqrt(c**2 - x**2)[:, None] * across


@pytest.mark.parametrize(("gap", "count", "lengths"), [(1e-3, 13, (2.5, 2.0)), (1e-4, 25, (1.5, 2.2)), (1e-5, 61, (2.5, 2.0))])
def test_a_motion_stays_on_its_branch_where_another_comes_close(gap, count, lengths):
    """Between two values the transmission angle falls to 2.4, 0.8 and 0.24 degrees."""
    b, c = lengths
    d = b + c - 1.0 - gap
    mech = udk.library.four_bar(angle=1.0, lengths=(1.0, b, c), ground=d)
    for turn in (2 * np.pi, -2 * np.pi):
        angle = np.linspace(1.0, 1.0 + turn, count)
        found = np.asarray(udk.kinematics(mech, "body.crank.angle", angle).path("coupler", (b / 2, 0.0)))
        exact = [coupler_pin(1.0, b, c, d, angle, sign) for sign in (1, -1)]
        assert min(np.max(np.abs(found - x)) for x in exact) < 1e-9


@pytest.mark.slow
def test_a_traced_motion_stays_on_its_branch_and_has_derivatives():
    """A batch in reverse mode, of a position, a velocity and an acceleration together, compared with differences."""
    gaps, angle = np.array([1e-3, 1e-4, 1e-5]), np.linspace(1.0, 1.0 + 2 * np.pi, 25)

    def motion(gap, values=angle):
        mech = udk.library.four_bar(angle=1.0, lengths=(1.0, 2.5, 2.0), ground=3.5 - gap)
        found = udk.kinematics(mech, "body.crank.angle", values)
        return found.q[1, 2, 2] + 2 * found.v[1, 2, 2] - 3 * found.a[1, 2, 2], found.path("coupler", (1.25, 0.0))

    with jax.debug_nans(True):
        slopes, paths = jax.jit(jax.vmap(jax.grad(motion, has_aux=True)))(gaps)
    h = 1e-5
    for gap, slope, path in zip(gaps, slopes, np.asarray(paths), strict=True):
        exact = [coupler_pin(1.0, 2.5, 2.0, 3.5 - gap, angle, sign) for sign in (1, -1)]
        assert min(np.max(np.abs(path - x)) for x in exact) < 1e-9
        ahead, behind = (motion(gap + step, angle[:2])[0] for step in (h, -h))
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * h), atol=1e-8)


@pytest.mark.parametrize(
    ("name", "numbers", "driver"),
    [
        ("four_bar", {"angle": 1.0}, "body.crank.angle"),
        ("slider_crank", {}, "motor"),
        ("parallelogram", {}, "body.link1.angle"),  # with a redundant row
        ("peaucellier", {}, "body.crank.angle"),
        ("n_four_bar", {"n": 12, "angle": 1.0}, "body.link0.angle"),  # large, with redundant rows
    ],
)
def test_the_side_is_the_sign_of_the_determinant_of_independent_rows(name, numbers, driver):
    """It does not depend on the pivots of elimination, in one lane or several."""
    mech = getattr(udk.library, name)(**numbers)
    driven = drive(mech, driver)
    q = udk.assemble(mech).q.ravel()
    start, curve = driven.value(q), NumpyCurve.of(driven)
    values = float(start) + np.linspace(0.05, 0.5, 4)

    def exact(q, s):
        E = curve.slopes(np.append(q, s) / curve.units)
        return np.linalg.slogdet(E[list(curve.independent), :-1])[0]

    one = march_at_once(driven.mechanism, driven.analysis, driven.unit, start, q, values)
    assert one.trusted == len(values)
    assert one.first_side == exact(q, start)
    assert one.side.tolist() == [exact(*at) for at in zip(one.q, values, strict=True)]
    lanes = jax.vmap(lambda end: march(driven.mechanism, driven.analysis, driven.unit, start, q, end))(
        values + 0.01 * np.arange(5)[:, None]
    )
    assert np.all(np.asarray(lanes.side) == one.side[0]) and np.all(np.asarray(lanes.first_side) == one.first_side)


SPACINGS = {  # values of one turn or of a travel: from half a degree to half a turn
    "four_bar": ({}, "body.crank.angle", 2 * np.pi, (720, 24, 9, 2)),
    "slider_crank": ({}, "motor", 2 * np.pi, (720, 24, 9, 2)),
    "peaucellier": ({}, "body.crank.angle", -1.5, (24, 2)),
    "elliptic_trammel": ({}, "body.rod.angle", 2 * np.pi, (24, 2)),
}


@pytest.mark.parametrize("name", SPACINGS)
def test_values_far_apart_are_reached_by_machine_code_on_the_same_branch(name):
    """The steps between them cost microseconds; those of the continuation that follows a lost position, a thousand times more."""
    numbers, driver, far, counts = SPACINGS[name]
    mech = getattr(udk.library, name)(**numbers)
    driven, q = drive(mech, driver), udk.assemble(mech).q.ravel()
    given, start = (driven.mechanism, driven.analysis, driven.unit), float(driven.value(q))
    fine = march_at_once(*given, start, q, start + far * np.arange(1, 721) / 720)
    assert fine.trusted == 720
    for count in counts:
        values, every = start + far * np.arange(1, count + 1) / count, slice(720 // count - 1, None, 720 // count)
        one = march_at_once(*given, start, q, values)
        lanes = jax.vmap(lambda x, values=values: march(*given, start, q, values + x))(np.zeros(3))
        assert one.trusted == count and np.all(lanes.trusted == count)
        for x in ("q", "dq", "ddq", "side"):
            tol = 1e-9 * np.max(np.abs(getattr(fine, x)))
            np.testing.assert_allclose(getattr(one, x), getattr(fine, x)[every], rtol=0, atol=tol)
            np.testing.assert_allclose(getattr(lanes, x)[1], getattr(one, x), rtol=0, atol=tol)


def test_values_far_apart_end_at_the_same_toggle_with_the_same_derivatives():
    """Beyond 180 degrees of the values in one step, the toggle of a linkage that does not turn is located as by small steps."""
    mech = udk.library.four_bar(np.pi / 3, lengths=STUCK[:3], ground=STUCK[3])

    def limit(k, count):
        pin = mech.parameters()["pin.C"]
        found = udk.kinematics(mech.with_parameters({"pin.C": k * pin}), "body.crank.angle", np.linspace(1.1, 1.1 + np.pi, count))
        return found.limit, found.status[-1], found.q[0, 1, 2]

    coarse, fine = (deferred(jax.jacfwd(lambda k, n=n: limit(k, n)[::2])) for n in (2, 12))
    one = jnp.asarray(1.0)
    for values, expected in zip((limit(1.0, 2), coarse(one)), (limit(1.0, 12), fine(one)), strict=True):
        np.testing.assert_allclose(values, expected, rtol=1e-10)
    assert limit(1.0, 2)[1] == Reached.beyond_limit


def test_a_value_that_no_steps_reach_ends_the_march():
    """Not a number, infinite, or so far that the number of steps is bounded."""
    mech = udk.library.four_bar()
    driven, q = drive(mech, "body.crank.angle"), udk.assemble(mech).q.ravel()
    start = float(driven.value(q))
    for far in (np.nan, np.inf, 1e7):
        found = march_at_once(driven.mechanism, driven.analysis, driven.unit, start, q, np.array([start + 0.1, far, start]))
        assert found.trusted == 1


def test_a_value_of_the_guess_is_reached_near_a_toggle():
    """There a rounding error of the residual moves the position by many times its size."""
    for height in (1e-1, 1e-2, 1e-3, 1e-5):
        c, angle = 0.2 * np.sqrt(1 - height**2), np.arcsin(height)
        scene = udk.Mechanism(
            {
                "lever": udk.Body(1.0, 0.01, [c / 2, 0.1 * height], angle),
                "rod": udk.Body(1.0, 0.01, [1.5 * c, 0.1 * height], -angle),
                "slider": udk.Body(1.0, 0.01, [2 * c, 0.0]),
            },
            {
                "A": udk.Revolute(["ground", "lever"], [[0.0, 0.0], [-0.1, 0.0]]),
                "B": udk.Revolute(["lever", "rod"], [[0.1, 0.0], [-0.1, 0.0]]),
                "C": udk.Revolute(["rod", "slider"], [[0.1, 0.0], [0.0, 0.0]]),
                "S": udk.Prismatic(["ground", "slider"], [[0.0, 0.0], [0.0, 0.0]], 0.0),
            },
        )
        found = udk.kinematics(scene, "body.slider.x", [2 * c])
        np.testing.assert_allclose(found.q[0, 0, 2], angle, rtol=1e-9 / height)


def test_each_value_adds_to_the_steps_that_continuation_may_take(monkeypatch):
    """Many values in one call are reached as the same values one by one."""
    monkeypatch.setattr(continuation, "MAX_TRIALS", 10)
    mech = udk.library.four_bar()
    driven, q = drive(mech, "body.crank.angle"), np.ravel(udk.assemble(mech).q)
    start = float(driven.value(q))
    values = start + np.linspace(0.05, 1.5, 30)
    points = continuation.follow(NumpyCurve.of(driven), np.asarray(start), q, values, continuation.no_points(30, len(q), np), 0)
    assert np.all(points.status == Reached.closed)


@pytest.mark.parametrize("ground", [2.0, 2.002], ids=["branches meet", "toggle where branches nearly meet"])
def test_dense_values_are_followed_as_few_are(ground):
    """Steps that are short beside the distance from dependent rows are corrected once, and keep their side of branches."""
    joints = {
        "A": udk.Revolute(["ground", "crank"], [[0, 0], [-0.5, 0]]),
        "B": udk.Revolute(["crank", "coupler"], [[0.5, 0], [-1, 0]]),
        "C": udk.Revolute(["coupler", "rocker"], [[1, 0], [0.5, 0]]),
        "D": udk.Revolute(["ground", "rocker"], [[ground, 0], [-0.5, 0]]),
    }
    at = np.array([np.cos(1.0), np.sin(1.0)])
    bodies = {
        "crank": udk.Body(1.0, 0.1, 0.5 * at, 1.0),
        "coupler": udk.Body(1.0, 0.1, at + [1, 0], 0.0),
        "rocker": udk.Body(1.0, 0.1, 0.5 * at + [2, 0], 1.0),
    }
    scene = udk.Mechanism(bodies, joints)
    dense = udk.kinematics(scene, "body.crank.angle", np.linspace(1.0, 8.0, 1401))
    few = udk.kinematics(scene, "body.crank.angle", np.linspace(1.0, 8.0, 15))
    assert np.array_equal(dense.status[::100], few.status)
    for name in ("q", "v", "a"):
        np.testing.assert_allclose(getattr(dense, name)[::100], getattr(few, name), rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(dense.limit, few.limit, rtol=1e-12)
    assert np.isinf(few.limit) == (ground == 2.0)
    driven, q = drive(scene, "body.crank.angle"), scene.q0.ravel()
    found = march_at_once(driven.mechanism, driven.analysis, driven.unit, 1.0, q, np.linspace(2.5, 3.6, 7))
    assert found.trusted < 7 or set(found.side.tolist()) == {1.0, -1.0}  # it changes where branches meet, in a long step
    assert (found.trusted == 7) == (ground == 2.0)


def test_what_needs_the_only_driver_says_which_there_are():
    mech = udk.library.double_pendulum()
    with pytest.raises(udk.SceneError, match=r"driver: the scene has no driver; name a coordinate, such as body\.upper\.angle"):
        udk.gaps(mech)
    motors = {
        name: udk.Driver(("ground", body), "angle", udk.Polynomial([0.0]))
        for name, body in (("motor", "upper"), ("servo", "lower"))
    }
    with pytest.raises(udk.SceneError, match="driver: the scene has 2 drivers; name one of motor, servo"):
        udk.gaps(udk.Mechanism(mech.bodies, mech.joints, motors))
