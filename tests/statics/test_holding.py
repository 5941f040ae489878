"""Efforts that hold mechanisms at rest against friction, beside closed forms: an incline, a wedge, a toggle clamp."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.friction import G, pendulum
from tests.statics.holding_closed_forms import CASES
from tests.statics.holding_reference import FreeBodies, random_scene

LAWS: dict[str, dict[str, Any]] = {"smooth": {"law": "smooth"}, "set-valued": {"law": "set-valued"}}


def wedge(angle: float, **friction: Any) -> udk.Mechanism:
    """Return a load of 2 kg on an incline, as on the thread of a screw."""
    return udk.Mechanism(
        {"load": udk.Body(2.0, 0.01, [0.0, 0.0], angle)},
        {"S": udk.Prismatic(["ground", "load"], [[0.0, 0.0], [0.0, 0.0]], angle)},
        forces={"rub": udk.Friction("S", **friction)},
    )


def clamp(sine: float, push: float = 500.0, coefficient: float = 0.1, radius: float = 0.01, length: float = 0.2) -> udk.Mechanism:
    """Return a toggle of two rods without weight, whose knee is `length` times `sine` above the line of its ends.

    A workpiece pushes at its slider.
    """
    c, s = length * np.sqrt(1 - sine**2), length * sine
    angle = np.arcsin(sine)
    return udk.Mechanism(
        {
            "lever": udk.Body(1.0, 0.01, [c / 2, s / 2], angle),
            "rod": udk.Body(1.0, 0.01, [1.5 * c, s / 2], -angle),
            "slider": udk.Body(1.0, 0.01, [2 * c, 0.0]),
        },
        {
            "A": udk.Revolute(["ground", "lever"], [[0.0, 0.0], [-length / 2, 0.0]]),
            "B": udk.Revolute(["lever", "rod"], [[length / 2, 0.0], [-length / 2, 0.0]]),
            "C": udk.Revolute(["rod", "slider"], [[length / 2, 0.0], [0.0, 0.0]]),
            "S": udk.Prismatic(["ground", "slider"], [[0.0, 0.0], [0.0, 0.0]], 0.0),
        },
        forces={"work": udk.Force("slider", [-push, 0.0])}
        | {pin: udk.Friction(pin, coefficient=coefficient, radius=radius, law="set-valued") for pin in "ABC"},
        gravity=[0.0, 0.0],
    )


def test_a_wedge_locks_itself_up_to_the_angle_of_friction():
    """The horizontal force is W tan(angle + phi) to lift, W tan(angle - phi) to lower, with tan(phi) the coefficient.

    Beyond angle + phi = 90 degrees no force lifts the load.
    """
    weight, phi = 2.0 * G, np.arctan(0.3)
    for angle, rests in ((phi - 1e-9, True), (phi + 1e-9, False), (np.pi / 2 - phi + 1e-6, False)):
        found = udk.holding_efforts(wedge(angle, coefficient=0.3), "body.load.x", [0.0])
        lifting = weight * np.tan(angle + phi)
        np.testing.assert_allclose(found.upper, lifting if lifting > 0 else np.inf, rtol=1e-12)
        np.testing.assert_allclose(found.lower, weight * np.tan(angle - phi), atol=1e-12)
        np.testing.assert_allclose(found.without_friction, weight * np.tan(angle), rtol=1e-12)
        assert bool(found.rests[0]) is rests


def cranks(friction: tuple[str, ...] = ("O1",), torque: float = 0.0) -> udk.Mechanism:
    """Return a parallelogram with three cranks of 0.3 m, a redundant row, and friction in some of its pins."""
    up = 0.3 * np.array([np.cos(1.0), np.sin(1.0)])
    feet = [np.array([0.5 * k, 0.0]) for k in range(3)]
    bodies = {f"crank{k}": udk.Body(1.0, 0.01, foot + up / 2, 1.0) for k, foot in enumerate(feet)}
    bodies["bar"] = udk.Body(4.0, 0.4, feet[1] + up)
    joints = {f"O{k}": udk.Revolute(["ground", f"crank{k}"], [foot, [-0.15, 0.0]]) for k, foot in enumerate(feet)}
    joints |= {f"A{k}": udk.Revolute([f"crank{k}", "bar"], [[0.15, 0.0], [0.5 * (k - 1), 0.0]]) for k in range(3)}
    constant = {"torque": torque} if torque else {"coefficient": 0.2, "radius": 0.02}
    forces = {f"rub {pin}": udk.Friction(pin, law="set-valued", **constant) for pin in friction}
    return udk.Mechanism(bodies, joints, forces=forces)


@pytest.mark.parametrize("name", ["wedge with a rubbing floor", "toggle, locked"])
def test_bounds_do_not_depend_on_inertia(name):
    """Closed forms, for light and heavy parts in one batch; the slow test has all of them over six decades."""
    case = CASES[name]
    scene = case.mechanism(np.ones(case.bodies))
    light_and_heavy = 10.0 ** np.linspace(-3, 3, 5)

    def bounds(mass):
        body = scene.body_names[0]
        changed = scene.with_parameters({f"body.{body}.mass": mass, f"body.{body}.inertia": mass})
        found = udk.holding_efforts(changed, case.coordinate, [case.value])
        return found.lower[0], found.upper[0]

    lower, upper = jax.vmap(bounds)(light_and_heavy)
    np.testing.assert_allclose(lower, np.full(5, case.bounds[0]), rtol=1e-11)
    np.testing.assert_allclose(upper, np.full(5, case.bounds[1]), rtol=1e-11)


def reference(free: FreeBodies, sign: float, seed: int, wanted: float) -> float:
    """Return the bound by linear programs, from many more guesses if those of the seed end at a smaller one than `wanted`."""
    found = free.bound(sign, seed)
    return found if wanted <= found + 1e-9 * abs(found) else free.bound(sign, seed, guesses=400)


def compare(seed: int) -> str:
    """Compare a random scene with linear programs over free bodies; return its line of the table."""
    scene, driver = random_scene(seed)
    _, body, coordinate = driver.split(".")
    given = scene.bodies[body].angle if coordinate == "angle" else scene.bodies[body].position[0]
    found = udk.holding_efforts(scene, driver, [float(given)])
    free = FreeBodies(scene, body, coordinate)
    bounds = [float(found.lower[0]), float(found.upper[0])]
    expected = [sign * reference(free, sign, seed, sign * bound) for sign, bound in zip((-1.0, 1.0), bounds, strict=True)]
    scale = max(abs(x) for x in [float(found.without_friction[0]), *expected] if np.isfinite(x))
    np.testing.assert_allclose(bounds, expected, rtol=1e-6, atol=1e-6 * scale, err_msg=f"seed {seed}")
    return f"{seed:6} {free.redundant:9} {len(free.limits):8} {bounds[0]:14.6f} {bounds[1]:14.6f}"


@pytest.mark.parametrize("seed", [1004, 1006, 1178])  # unbounded by preloads; bounded; with a load that turns round on the way
def test_bounds_are_those_of_linear_programs_over_free_bodies(seed):
    compare(seed)


def test_preloads_of_redundant_joints():
    """Three cranks that were pressed together hold any effort; constant torques, and loads of least norm, have bounds."""
    found = udk.holding_efforts(cranks(), "body.crank0.angle", [1.0])
    assert found.by_preload.tolist() == [[True, True]]
    assert float(found.upper[0]) == np.inf and float(found.lower[0]) == -np.inf
    assert "locked by preloads" in str(found) and found.redundant[0] in str(found)
    constant = udk.holding_efforts(cranks(("O1", "A2"), torque=0.5), "body.crank0.angle", [1.0])
    weight = (3 * 1.0 * 0.15 + 4.0 * 0.3) * G * np.cos(1.0)
    np.testing.assert_allclose([constant.lower[0], constant.upper[0]], [weight - 1.0, weight + 1.0], rtol=1e-12)
    assert not constant.by_preload.any()
    least = udk.holding_efforts(cranks(), "body.crank0.angle", [1.0], preload=False)
    assert np.isfinite(least.upper[0]) and not least.by_preload.any()
    for bound, sign in ((least.lower, -1.0), (least.upper, 1.0)):
        # The friction does the rest of the work, and is the coefficient times the radius times the load of least norm.
        excess = float(bound[0]) - float(least.without_friction[0])
        loads = {"hand": udk.Torque(["ground", "crank0"], bound[0]), "pin": udk.Torque(["ground", "crank1"], -excess)}
        still = udk.Mechanism(cranks().bodies, cranks().joints, forces=loads)
        at_rest = udk.assemble(still)
        run = SimpleNamespace(ts=np.zeros(1), q=np.asarray(at_rest.q)[None], v=0 * np.asarray(at_rest.v)[None])
        pressed = np.hypot(*np.asarray(udk.reactions(still, run)["O1"]["crank1"])[0, :2])
        np.testing.assert_allclose(excess, sign * 0.2 * 0.02 * pressed, rtol=1e-9)


def holds_around(*pins: str) -> udk.Mechanism:
    """Return a hanging double pendulum with friction in some pins."""
    rub = {pin: udk.Friction(pin, coefficient=0.2, radius=0.01, law="set-valued") for pin in pins}
    down = -np.pi / 2
    return udk.Mechanism(
        {"a": udk.Body(1.0, 0.1, [0.0, -0.5], down), "b": udk.Body(1.0, 0.1, [0.0, -1.5], down)},
        {
            "A": udk.Revolute(["ground", "a"], [[0.0, 0.0], [-0.5, 0.0]]),
            "B": udk.Revolute(["a", "b"], [[0.5, 0.0], [-0.5, 0.0]]),
        },
        forces=rub,
    )


@pytest.mark.parametrize(("pins", "holds"), [("A", False), ("B", False), ("AB", True)])
def test_friction_holds_a_mechanism_around_an_equilibrium_if_it_resists_every_motion(pins, holds):
    rest = udk.equilibrium(holds_around(*pins))
    assert bool(rest.balanced) and bool(rest.holds_around) is holds
    assert ("it rests in all positions around" in str(rest)) is holds


def test_friction_of_an_unloaded_slide_does_not_hold():
    """A weight on a spring in a vertical guide: its normal force is zero everywhere."""
    scene = udk.Mechanism(
        {"weight": udk.Body(1.0, 0.1, [0.0, -0.1])},
        {"guide": udk.Prismatic(["ground", "weight"], [[0.0, 0.0], [0.0, 0.0]], axis=np.pi / 2)},
        forces={
            "spring": udk.Spring(["ground", "weight"], [[0.0, 0.0], [0.0, 0.0]], 100.0, 0.05),
            "rub": udk.Friction("guide", coefficient=0.3, law="set-valued"),
        },
    )
    rest = udk.equilibrium(scene)
    assert bool(rest.stable) and not rest.holds_around
    assert "does not hold it in positions around" in str(rest)


def test_an_equilibrium_names_the_friction_around_it():
    rest = udk.equilibrium(pendulum(coefficient=0.3, radius=0.1), stable=True)
    assert bool(rest.stable) and rest.left_out == ("rub",) and rest.holds_around
    assert "friction rub, with which it rests in all positions around, see holding_efforts" in str(rest)
    assert udk.equilibrium(udk.library.simple_pendulum()).left_out == ()


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_static_coefficients_count(law):
    weight, phi = 2.0 * G, np.arctan(0.4)
    found = udk.holding_efforts(wedge(0.2, coefficient=0.1, static_coefficient=0.4, **LAWS[law]), "body.load.x", [0.0])
    np.testing.assert_allclose(found.upper, weight * np.tan(0.2 + phi), rtol=1e-12)
    np.testing.assert_allclose(found.lower, weight * np.tan(0.2 - phi), rtol=1e-12)


@pytest.mark.slow
def test_no_force_lifts_a_load_up_a_steep_incline():
    """Beyond angle + phi = 90 degrees a horizontal force presses more than it lifts: the bound is infinite."""
    phi = np.arctan(0.5)
    steep, less = (udk.holding_efforts(wedge(np.pi / 2 - phi + e, coefficient=0.5), "body.load.x", [0.0]) for e in (1e-6, -1e-6))
    assert float(steep.upper[0]) == np.inf
    np.testing.assert_allclose(less.upper, 2.0 * G / np.tan(1e-6), rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("push", [500.0, 5e4])
def test_a_toggle_clamp_locks_itself(push):
    """It holds, however strong the workpiece, where one line passes all three circles of friction: h <= 2 mu r."""
    limit = 2 * 0.1 * 0.01 / 0.2
    for sine, rests in ((limit * (1 - 1e-7), True), (limit * (1 + 1e-7), False)):
        found = udk.holding_efforts(clamp(sine, push), "body.lever.angle", [np.arcsin(sine)])
        assert bool(found.rests[0]) is rests
        still = np.abs(udk.accelerations(clamp(sine, push), 0.0, clamp(sine).q0, clamp(sine).v0)).max() < 1e-6
        assert bool(still) is rests


@pytest.mark.slow
def test_resting_positions_of_a_clamp_and_their_efforts():
    """Over all positions; the bounds of the torque at the lever are those of runs that begin to move."""
    limit = 2 * 0.1 * 0.01 / 0.2
    angles = np.arcsin(limit * np.array([2.5, 1.5, 0.9, 0.5, 0.1]))
    found = udk.holding_efforts(clamp(2.5 * limit), "body.lever.angle", angles)
    assert found.rests.tolist() == [False, False, True, True, True]
    assert "rests without effort" in str(found)
    for k in (0, 3):
        for bound, forwards in ((found.lower, False), (found.upper, True)):
            for share, moves in ((1.0 - 1e-6, False), (1.0 + 1e-6, True)):
                middle = float(found.lower[k] + found.upper[k]) / 2
                torque = udk.Torque(["ground", "lever"], middle + share * (float(bound[k]) - middle))
                base = clamp(float(np.sin(angles[k])))
                loaded = udk.Mechanism(base.bodies, base.joints, forces=dict(base.forces) | {"hand": torque}, gravity=[0.0, 0.0])
                alpha = float(udk.accelerations(loaded, 0.0, loaded.q0, loaded.v0)[0, 2])
                assert alpha == pytest.approx(0.0, abs=1e-7) if not moves else (alpha > 0) is forwards


@pytest.mark.slow
def test_derivatives_and_batches():
    weight = 2.0 * G

    def upper(coefficient):
        changed = wedge(0.2, coefficient=0.3).with_parameters({"force.rub.coefficient": coefficient})
        return udk.holding_efforts(changed, "body.load.x", [0.0]).upper[0]

    slope = weight / np.cos(0.2 + np.arctan(0.3)) ** 2 / (1 + 0.3**2)
    np.testing.assert_allclose(jax.grad(upper)(0.3), slope, rtol=1e-10)
    np.testing.assert_allclose(jax.jacfwd(upper)(0.3), slope, rtol=1e-10)
    coefficients = np.array([0.1, 0.3])
    np.testing.assert_allclose(jax.vmap(upper)(coefficients), weight * np.tan(0.2 + np.arctan(coefficients)), rtol=1e-12)


@pytest.mark.slow
def test_closed_forms_over_six_decades_of_masses():
    lines = [f"{'case':28} {'lower':>14} {'upper':>14} {'largest error':>14}"]
    for name, case in CASES.items():
        errors = []
        for mass in 10.0 ** np.arange(-3, 4):
            masses = np.resize([1.0, 1 / mass, mass, 1.0], case.bodies)
            found = udk.holding_efforts(case.mechanism(masses), case.coordinate, [case.value])
            for bound, exact in zip((found.lower, found.upper), case.bounds, strict=True):
                errors.append(0.0 if float(bound[0]) == exact else abs(float(bound[0]) / exact - 1))
        lines.append(f"{name:28} {case.bounds[0]:14.6f} {case.bounds[1]:14.6f} {max(errors):14.1e}")
        assert max(errors) < 1e-11, name
    print("\n".join(lines))


@pytest.mark.slow
def test_random_scenes_beside_linear_programs():
    """Slider-cranks, four-bars, wedges, six-bars, and redundant ones; `pytest -s` prints the table."""
    print("  seed redundant friction          lower          upper")
    for seed in range(1000, 1300):
        print(compare(seed), flush=True)


@pytest.mark.slow
def test_derivatives_of_bounds_of_a_linkage():
    """By every number of friction, and by a length, against differences."""
    base, driver = random_scene(1001)  # a slider-crank
    names = [name for name in base.parameters() if name.startswith("force.rub") and np.ndim(base.parameters()[name]) == 0]
    names.append("joint.C.points")

    def bounds(changes):
        found = udk.holding_efforts(base.with_parameters(changes), driver, [float(base.bodies["crank"].angle)])
        return jnp.stack([found.lower[0], found.upper[0]])

    values = {name: jnp.asarray(base.parameters()[name], float) for name in names}
    forward, reverse = jax.jit(jax.jacfwd(bounds))(values), jax.jit(jax.jacrev(bounds))(values)
    for name, value in values.items():
        np.testing.assert_allclose(forward[name], reverse[name], rtol=1e-9, atol=1e-9, err_msg=name)
        for index in np.ndindex(np.shape(value)):
            h = 1e-6 * max(abs(float(value[index])), 0.1)
            ends = [bounds(values | {name: value.at[index].add(way * h)}) for way in (1.0, -1.0)]
            np.testing.assert_allclose(forward[name][(slice(None), *index)], (ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-5)
