"""Equilibria and vibration compared with closed forms and with a reduction to one coordinate."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.calls import calls_of
from tests.choices import fast
from udkjax.positions.following.curve import NumpyCurve
from udkjax.statics import linearization
from udkjax.statics.linearization import NumpyLinearizer, TracedLinearizer
from udkjax.statics.resting_forces import forces_table

LENGTHS, GROUND = (1.0, 2.5, 2.0), 2.5
STIFFNESS, FREE_LENGTH = 60.0, 1.2


def test_the_papers_linkage_hanging():
    mech = udk.library.parallelogram(-1.3)
    rest = udk.equilibrium(mech)
    assert bool(rest.stable)
    np.testing.assert_allclose(rest.q[:3, 2], -np.pi / 2, atol=1e-12)
    found = udk.modes(mech, rest.state)
    np.testing.assert_allclose(found.omega2, [3.5 * 9.81 / 3.05], rtol=1e-12)
    np.testing.assert_allclose(np.asarray(found.s.imag), np.sqrt(3.5 * 9.81 / 3.05) * np.array([-1.0, 1.0]), rtol=1e-12)
    shape = np.asarray(found.shapes[0]) / float(found.shapes[0, 0, 2])
    np.testing.assert_allclose(shape, [[0.5, 0, 1], [0.5, 0, 1], [0.5, 0, 1], [1, 0, 0]], atol=1e-10)


LOADED = {
    "linkage": lambda: udk.library.parallelogram(-1.3),
    "free body": lambda: udk.Mechanism({"a": udk.Body(1.0, 0.1, [0.5, 0.1])}, forces=[spring("a")]),
    "double pendulum": lambda: double_pendulum(spring("b"), udk.TorsionSpring(["a", "b"], stiffness=2.0, damping=0.3)),
    "push": lambda: double_pendulum(udk.Force("a", [1.0, 2.0], point=[0.1, 0.2])),
}


def spring(body):
    return udk.Spring(["ground", body], points=[[2.0, 2.0], [0.1, 0.2]], stiffness=30.0, length=1.0, damping=0.5)


def double_pendulum(*forces):
    bodies = {"a": udk.Body(1.0, 0.1, [0.5, 0.1]), "b": udk.Body(2.0, 0.2, [1.5, 0.0])}
    joints = {"A": udk.Revolute(["ground", "a"], [[0, 0], [-0.5, 0]]), "B": udk.Revolute(["a", "b"], [[0.5, 0], [-0.5, 0]])}
    return udk.Mechanism(bodies, joints, forces=list(forces))


@pytest.mark.parametrize("name", [x if x == "linkage" else pytest.param(x, marks=pytest.mark.slow) for x in LOADED])
def test_linearizations_by_numpy_are_those_of_jax(name):
    mech = LOADED[name]()
    analysis = udk.analyse(mech)
    q: Any = np.ravel(udk.assemble(mech).q)
    free = analysis.degrees_of_freedom
    assert free
    given = mech.without_origin, analysis, free
    near, traced = NumpyLinearizer(*given), TracedLinearizer(*given)
    for one, other in ((near.linearize(0.0, q), traced.linearize(0.0, q)), (near.scale(0.0, q), traced.scale(0.0, q))):
        for x, y in zip(_without_basis(one), _without_basis(other), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-12 * max(1.0, np.abs(y).max(initial=0.0)))


def _without_basis(found):
    """Return what does not depend on the choice of the directions N."""
    if not hasattr(found, "directions"):
        return found
    N = np.asarray(found.directions)
    matrices = [N @ np.asarray(x) @ N.T for x in (found.mass, found.damping, found.stiffness)]
    return *matrices, N @ np.asarray(found.force), found.loads, found.multipliers


JACK = """
format = 2
units = {length = "mm", angle = "deg"}
ground = ["A"]
gravity = [0, 0]
pins = {A = [0, 0], B = [80, 60], C = [80, 0], D = [0, 60], E = [120, 60], F = [40, 30], G = [60, 60]}
link = [
    {name = "one", pins = ["A", "F", "B"], width = 10}, {name = "other", pins = ["C", "F", "D"], width = 10},
    {name = "table", pins = ["D", "G", "E"], width = 10}, {name = "foot", pins = ["C"], width = 10},
]
slide = [{name = "floor", link = "foot", direction = [1, 0]}]
slot = [{pin = "B", along = ["D", "E"], on = "table"}]
motor = [{name = "screw", slide = "floor", speed = "1 mm/s"}]
load = [{pin = "G", force = ["0 N", "-900 N"]}]
"""


def test_the_table_of_forces_of_a_jack_without_masses():
    jack = udk.loads(JACK)
    table = forces_table(jack, udk.assemble(jack).q)
    assert table is not None
    forces = {name: cells for name, *cells in table.rows}
    assert forces["screw holds by"][0] == "-1200 N"  # the load over the slope of the arms
    assert forces["D on table"] == ["225 N", "0", "225"] and forces["floor on foot"][2] == "675"  # moments about B, and about A
    heavy = forces_table(jack.with_parameters({"gravity": [0.0, -9.81]}), jack.q0)
    assert heavy is not None and heavy.title.startswith("forces at rest need weights")
    assert forces_table(udk.library.parallelogram(), udk.library.parallelogram().q0) is None  # can move


def test_rest_of_concrete_numbers_is_found_without_a_trace():
    """A trace takes a second in a chain of a hundred links, as long as all of the search."""
    with calls_of(linearization.linearize) as traced:
        assert bool(udk.equilibrium(udk.library.chain(3, angle=0.1)).stable) and not traced


def test_no_step_is_tried_from_a_position_of_rest():
    mech = udk.library.parallelogram(-1.3)
    rest = udk.equilibrium(mech)
    with calls_of(NumpyCurve.correct) as tried:
        again = udk.equilibrium(mech, rest.state)
        assert not tried and bool(again.balanced)
        assert bool(udk.equilibrium(mech).balanced) and tried


def test_the_papers_linkage_standing_is_unstable():
    mech = udk.library.parallelogram(1.4)
    rest = udk.equilibrium(mech)
    assert bool(rest.balanced)
    assert not bool(rest.stable)
    np.testing.assert_allclose(rest.omega2, [-3.5 * 9.81 / 3.05], rtol=1e-12)
    downhill = udk.equilibrium(mech, stable=True)
    np.testing.assert_allclose(np.cos(downhill.q[:3, 2] + np.pi / 2), 1.0, atol=1e-12)


def spring_four_bar(stiffness=STIFFNESS, scale=1.0):
    """A spring along the diagonal from the crank's pin to the rocker's pivot."""
    a, b, c = (scale * x for x in LENGTHS)
    mech = udk.library.four_bar(1.0, lengths=(a, b, c), ground=scale * GROUND, density=1.0 / scale)
    spring = udk.Spring(("ground", "crank"), [(scale * GROUND, 0.0), (a / 2, 0.0)], stiffness, scale * FREE_LENGTH)
    return udk.Mechanism(dict(mech.bodies), dict(mech.joints), {}, {"spring": spring}, mech.gravity)


def spring_rod():
    """A rod on a pin, held up by a spring."""
    return udk.Mechanism(
        {"rod": udk.Body(2.5, 0.3, [0.5, 0.0])},
        {"D": udk.Revolute(("ground", "rod"), [(0.0, 0.0), (-0.5, 0.0)])},
        forces={"spring": udk.Spring(("ground", "rod"), [(0.2, 1.5), (0.4, 0.1)], STIFFNESS, FREE_LENGTH)},
    )


def reduced_pose(s):
    """Middles and angles of the bodies of `spring_four_bar` at the crank's angle s, and the length of its spring."""
    a, b, c = LENGTHS
    end = a * jnp.stack([jnp.cos(s), jnp.sin(s)])
    to = jnp.array([GROUND, 0.0]) - end
    d2 = to @ to
    x = (d2 + b**2 - c**2) / (2 * d2)
    pin = end + x * to + jnp.sqrt(b**2 / d2 - x**2) * jnp.stack([-to[1], to[0]])
    middles = jnp.stack([end / 2, (end + pin) / 2, (jnp.array([GROUND, 0.0]) + pin) / 2])
    angles = jnp.stack([s, jnp.arctan2(pin[1] - end[1], pin[0] - end[0]), jnp.arctan2(pin[1], pin[0] - GROUND)])
    return middles, angles, jnp.sqrt(d2)


@jax.jit
def reduction(s):
    """V' and V'' of one coordinate, the crank's angle, and its inertia J."""
    m = jnp.array(LENGTHS)

    def V(s):
        middles, _, d = reduced_pose(s)
        return 9.81 * m @ middles[:, 1] + STIFFNESS * (d - FREE_LENGTH) ** 2 / 2

    middles, angles, _ = jax.jacfwd(reduced_pose)(s)
    return jax.grad(V)(s), jax.hessian(V)(s), m @ jnp.sum(middles**2, 1) + (m**3 / 12) @ angles**2


def reduced(s):
    """Equilibrium and omega^2 = V''/J in closed form, where V' = 0."""
    for _ in range(20):
        slope, bend, _ = reduction(s)
        s = s - slope / bend
    _, bend, J = reduction(s)
    return float(s), float(bend / J)


def test_a_four_bar_with_a_diagonal_spring_against_its_reduction():
    mech = spring_four_bar()
    rest = udk.equilibrium(mech)
    s, omega2 = reduced(float(rest.q[0, 2]))
    assert abs(float(rest.q[0, 2]) - s) < 1e-12
    np.testing.assert_allclose(rest.omega2, [omega2], rtol=1e-11)
    np.testing.assert_allclose(udk.modes(mech, rest.state).omega2, [omega2], rtol=1e-11)


def held_up(length):
    """A body whose weight is balanced by two forces: all loads vanish up to rounding."""
    weight = 0.1 * length**3 * 9.81
    forces = {"one": udk.Force("b", [0.0, weight / 3]), "two": udk.Force("b", [0.0, weight * (2 / 3)])}
    return udk.Mechanism({"b": udk.Body(0.1 * length**3, 0.1 * length**5)}, {}, {}, forces)


def see_saw(length):
    """Two bodies that balance about a pin in any position."""
    at = length * np.array([np.cos(0.3), np.sin(0.3)])
    bodies = {"a": udk.Body(1.0, 0.1 * length**2, at, 0.3), "b": udk.Body(3.0, 0.1 * length**2, -at / 3, 0.3)}
    points = [(length / 3, 0.0), (-length, 0.0)]
    joints = {
        "pin": udk.Revolute(["ground", "a"], [(0.0, 0.0), (-length, 0.0)]),
        "weld": udk.Weld(["b", "a"], [points[0], points[1]]),
    }
    return udk.Mechanism(bodies, joints)


@pytest.mark.parametrize("stable", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("scene", [held_up, see_saw])
def test_rest_where_all_loads_vanish_is_indifferent(scene, stable):
    """The remainder is compared with the scale of forces, not with itself. Rounding errors move nothing."""
    for length in (1e-6, 1e3):
        mech = scene(length)
        rest = udk.equilibrium(mech, stable=stable)
        assert bool(rest.balanced) and float(rest.residual) < 1e-14
        assert rest.kind == "indifferent" and not bool(rest.stable)
        np.testing.assert_allclose(rest.q, mech.q0, rtol=1e-9, atol=1e-9 * length)
    pushed = udk.Mechanism(mech.bodies, mech.joints, {}, {"push": udk.Torque(["ground", "b"], 1e-6 * 9.81 * length**4)})
    assert not bool(udk.equilibrium(pushed).balanced)


@pytest.mark.slow
def test_a_scene_without_a_degree_of_freedom_rests_where_its_drivers_hold_it():
    mech = udk.library.slider_crank()
    rest, found = udk.equilibrium(mech, t=0.1), udk.modes(mech, t=0.1)
    assert bool(rest.stable) and rest.omega2.shape == (0,) and rest.kind == "stable"
    np.testing.assert_allclose(rest.q, udk.assemble(mech, 0.1).q, atol=1e-12)
    assert found.omega2.shape == found.s.shape == (0,) and found.shapes.shape == (0, 3, 3)
    slope = jax.jit(jax.jacfwd(lambda t: udk.equilibrium(mech, t=t).q))(0.1)
    step = 1e-5
    np.testing.assert_allclose(
        slope, (udk.assemble(mech, 0.1 + step).q - udk.assemble(mech, 0.1 - step).q) / (2 * step), atol=1e-7
    )


@pytest.mark.slow
def test_equilibria_from_many_starts():
    """On one assembly branch the reduction finds them, too."""
    mech = spring_four_bar()
    found = udk.equilibria(mech, starts=6, seed=1)
    assert bool(found[0].stable)
    upper = [e for e in found if np.sin(float(e.q[1, 2] - e.q[2, 2])) < 0]
    for e in upper:
        s, omega2 = reduced(float(e.q[0, 2]))
        assert abs(np.sin((float(e.q[0, 2]) - s) / 2)) < 1e-11
        np.testing.assert_allclose(e.omega2, [omega2], rtol=1e-9)
    assert {bool(e.stable) for e in upper} == {True, False}  # along a closed curve there are as many of either
    assert len(upper) % 2 == 0


def test_size_does_not_matter():
    """Scaled by 1e-6, with the same masses and stiffness times length: angles and, with g scaled too, frequencies are alike."""
    rest, small = udk.equilibrium(spring_four_bar()), spring_four_bar(scale=1e-6)
    small = small.with_parameters({"gravity": 1e-6 * np.array([0.0, -9.81])})
    found = udk.equilibrium(small)
    assert bool(found.balanced)
    np.testing.assert_allclose(found.q[:, 2], rest.q[:, 2], atol=1e-11)
    np.testing.assert_allclose(found.omega2, rest.omega2, rtol=1e-10)


def test_damped_modes_are_those_of_the_quadratic_problem():
    """A disc on a torsion spring with a damper: s = -zeta omega +- i omega sqrt(1 - zeta^2)."""
    k, c, inertia = 5.0, 0.3, 0.2
    mech = udk.Mechanism(
        {"disc": udk.Body(1.0, inertia)},
        {"pin": udk.Revolute(("ground", "disc"), [(0.0, 0.0), (0.0, 0.0)])},
        forces=[udk.TorsionSpring(("ground", "disc"), k, damping=c)],
    )
    found = udk.modes(mech)
    zeta = c / (2 * np.sqrt(k * inertia))
    exact = np.sqrt(k / inertia) * np.array([-zeta - 1j * np.sqrt(1 - zeta**2), -zeta + 1j * np.sqrt(1 - zeta**2)])
    np.testing.assert_allclose(found.s, exact, rtol=1e-12)
    np.testing.assert_allclose(found.damping, zeta, rtol=1e-12)


def test_modes_of_a_double_pendulum():
    mech = udk.library.double_pendulum()
    rest = udk.equilibrium(mech, stable=True)
    found = udk.modes(mech, rest.state)
    for k in range(2):  # the shapes are orthogonal in M and K: here by energy, T = omega^2 V'' along the shape
        M = np.asarray(udk.equations.mass(mech)).reshape(-1, 3)
        assert abs(float(np.sum(M * np.asarray(found.shapes[k]) ** 2)) - 1.0) < 1e-12
    assert abs(float(np.sum(M * np.asarray(found.shapes[0]) * np.asarray(found.shapes[1])))) < 1e-12
    assert np.all(np.asarray(found.omega2) > 0)


VIBRATING = {"rod": (spring_rod, "rod", 0.0), "four-bar": (spring_four_bar, "coupler", GROUND)}


@pytest.mark.slow
@pytest.mark.parametrize("name", fast(["rod"], VIBRATING))
def test_frequencies_have_exact_derivatives(name):
    """Derivatives through the moving equilibrium agree with differences."""
    make, body, place = VIBRATING[name]
    mech = make()

    def frequency(x):
        changed = mech.with_parameters({"force.spring.stiffness": x[0], f"body.{body}.mass": x[1], "joint.D.points[0][0]": x[2]})
        rest = udk.equilibrium(changed)
        found = udk.modes(changed, rest.state)
        return jnp.stack([found.frequencies[0], found.s[1].imag])

    x, h = jnp.array([STIFFNESS, 2.5, place]), 1e-5
    for d in np.eye(3):
        slope = jax.jvp(frequency, (x,), (d,))[1]
        np.testing.assert_allclose(slope, (frequency(x + h * d) - frequency(x - h * d)) / (2 * h), rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_a_batch_of_equilibria_has_a_code_for_each_member():
    mech = spring_four_bar()
    stiffness = np.linspace(1.0, 100.0, 1000)
    found = jax.jit(jax.vmap(lambda k: udk.equilibrium(mech.with_parameters({"force.spring.stiffness": k}))))(stiffness)
    assert found.balanced.shape == (1000,)
    assert np.all(np.asarray(found.residual)[np.asarray(found.balanced)] <= 1e-9)
    assert float(np.mean(found.balanced)) > 0.9


@pytest.mark.parametrize("by", [lambda f: f, pytest.param(jax.jit, marks=pytest.mark.slow)], ids=["numpy", "jax"])
@pytest.mark.parametrize("stiffness", [10.0, 50.0])
def test_where_unbalanced_loads_have_a_minimum_the_search_goes_on_downhill(by, stiffness):
    """There they do not vanish, and no step of Newton's method reduces them: at the inflections of the potential energy."""
    bare = udk.library.four_bar()
    spring = udk.TorsionSpring(["ground", "crank"], stiffness)
    mech = udk.Mechanism(bare.bodies, bare.joints, forces={"spring": spring})
    analysis = udk.analyse(mech)
    rest = by(lambda k: udk.equilibrium(mech.with_parameters({"force.spring.stiffness": k}), analysis=analysis))(stiffness)
    assert rest.stable
    turned = udk.kinematics(mech, "body.crank.angle", float(rest.q[0, 2]) + np.array([-1e-3, 0.0, 1e-3]))
    low, least, high = np.asarray(udk.energy(mech, turned).potential)
    assert abs(high - low) < 1e-6 * (high + low - 2 * least) / 1e-3  # the minimum is in the middle


def test_a_long_chain_comes_to_rest_in_a_few_steps():
    """Its end moves by many lengths of a link while all links turn by 0.1 rad."""
    with calls_of(NumpyLinearizer.linearize) as positions:
        found = udk.equilibrium(udk.library.chain(30, angle=0.1))
    assert found.stable
    assert len(positions) < 10


def weight_on_a_slide() -> udk.Mechanism:
    """Return a slider-crank with a vertical slide, whose slider carries a weight, from its upper side."""
    c, s = 0.5 * np.cos(1.2), 0.5 * np.sin(1.2)
    return udk.Mechanism(
        {"crank": udk.Body(1.0, 0.02, [c / 2, s / 2], 1.2), "rod": udk.Body(1.0, 0.02, [c / 2, 1.5 * s], np.pi - 1.2)},
        {
            "A": udk.Revolute(["ground", "crank"], [[0.0, 0.0], [-0.25, 0.0]]),
            "B": udk.Revolute(["crank", "rod"], [[0.25, 0.0], [-0.25, 0.0]]),
            "S": udk.Slot(["ground", "rod"], [[0.0, 0.0], [0.25, 0.0]], np.pi / 2),
        },
    )


def test_several_starts_find_stable_equilibria_as_one_start_downhill_does():
    """The nearest equilibrium, searched from every start, may be unstable everywhere; the lowest one is always found."""
    scene = weight_on_a_slide()
    lowest = udk.equilibrium(scene, stable=True)
    assert bool(lowest.stable)
    found = udk.equilibria(scene, starts=2)
    assert any(bool(e.stable) and np.allclose(e.q[:, :2], lowest.q[:, :2], atol=1e-6) for e in found)
