"""Motions with strong friction, which go on while the equations allow them: light screws, and linkages with redundant rows."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import udkjax as udk
from tests.screws import GUIDES, Law, accelerations, numbers_of, random_screw, screw

SPAN = 1e-2
# A nut of 981 N, a thread of 3.64 degrees and a coefficient of 0.15: of less than 0.54 kg, the screw cannot be lowered at rest.
LIGHT = {"angle": np.deg2rad(3.64), "turn": 0.0, "guide": 0.0, "thread": 0.15}


def lifted(mass: float) -> dict[str, float]:
    """Return a screw that is pushed by 10 N more than it takes to lift the nut."""
    return LIGHT | {"mass": mass, "push": 981.0 * np.tan(LIGHT["angle"] + np.arctan(LIGHT["thread"])) + 10.0}


def speeds_of_screws(law: Law, screws: list[dict[str, float]], speeds: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the last speeds and the codes of runs of screws, and their accelerations at the start."""
    scene = screw(law)

    def run(numbers: dict[str, Any], speed: Any) -> tuple[Any, ...]:
        mechanism, zero = scene.with_parameters(numbers), 0.0 * speed
        v = jnp.stack([jnp.stack([speed, zero, zero]), jnp.stack([zero, -speed * jnp.tan(numbers["joint.thread.axis"]), zero])])
        q = jnp.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]) + zero
        end = udk.simulate(mechanism, [0.0, SPAN], udk.State(q, v), throw=False)
        return end.v[-1, 0, 0], end.code, udk.accelerations(mechanism, 0.0, q, v)[0, 0]

    return tuple(map(np.asarray, jax.jit(jax.vmap(run))(numbers_of(screws), speeds)))


def check_screws(law: Law, count: int) -> None:
    random = np.random.default_rng(0)
    screws = [random_screw(random) for _ in range(count)]
    speeds = 10.0 * np.sign(random.uniform(-1, 1, count))
    ends, codes, found = speeds_of_screws(law, screws, speeds)
    jammed = 0
    for x, speed, end, code, a in zip(screws, speeds, ends, codes, found, strict=True):
        known = accelerations(np.sign(speed), **x)
        assert len(known) <= 1
        if not known:  # Painleve's paradox
            assert np.isnan(a) and code != udk.Result.successful
            jammed += 1
            continue
        assert abs(a - known[0]) <= 1e-8 * abs(known[0])
        if speed * (speed + SPAN * known[0]) > 0:  # it does not stop
            assert code == udk.Result.successful
            assert abs(end - speed - SPAN * known[0]) <= 1e-9 * (abs(speed) + SPAN * abs(known[0]))
    assert 0.1 * count < jammed < 0.5 * count


def test_screws_and_wedges_slide_where_the_equations_have_a_solution():
    check_screws("smooth", 24)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["smooth", "set-valued"])
def test_three_hundred_screws_and_wedges(law):
    check_screws(law, 300)


@pytest.mark.parametrize("law", ["smooth", "set-valued"])
def test_a_light_screw_lifts_its_nut_from_rest(law):
    for mass in (0.5, 0.05):
        x = lifted(mass)
        (a,) = accelerations(1.0, **x)
        run = udk.simulate(screw(law, **x), [0.0, 0.1])
        # The smooth law has less friction until it slides by a few millimetres a second.
        assert abs(float(run.q[-1, 0, 0]) - a * 0.005) <= (1e-10 if law == "set-valued" else 5e-5)


def test_members_of_a_batch_of_light_screws_are_single_runs():
    masses = np.array([0.5, 2.0, 0.05])
    scene = screw("smooth", speed=1.0, **lifted(1.0))

    def end(mass: Any) -> Any:
        return udk.simulate(scene.with_parameters({"body.screw.mass": mass}), [0.0, 0.1]).v[-1, 0, 0]

    @jax.jit
    def all_of_it(masses: Any) -> tuple[Any, ...]:
        return jax.vmap(end)(masses), jax.vmap(jax.grad(end))(masses), jax.vmap(jax.jacfwd(end))(masses)

    together, backward, forward = map(np.asarray, all_of_it(masses))
    np.testing.assert_array_equal(together, [float(end(mass)) for mass in masses])
    a = np.array([accelerations(1.0, **lifted(mass))[0] for mass in masses])
    for slope in (backward, forward):
        np.testing.assert_allclose(slope, -(a**2) / 10.0 * 0.1, rtol=1e-7)  # a = 10 N / (mass + ...)


def test_two_light_screws_do_not_hide_each_other():
    """Two loads of the wrong sign restore the sign of the determinant."""
    one = screw("smooth", **lifted(0.5)).without_origin
    bodies, joints, forces = dict(one.bodies), dict(one.joints), dict(one.forces)
    other = screw("smooth", **lifted(0.05)).without_origin
    names = {"screw": "screw2", "nut": "nut2"}
    for name, body in other.bodies.items():
        bodies[names[name]] = body
    for name, joint in other.joints.items():
        kind = udk.Slot if name == "thread" else udk.Prismatic
        joints[f"{name}2"] = kind([names.get(x, x) for x in joint.frame_names], joint.points, axis=joint.axis)
    forces["push2"] = udk.Force("screw2", other.forces["push"].vector)
    forces |= {f"rub2 {x}": udk.Friction(f"{x}2", coefficient=LIGHT[x], law="smooth") for x in GUIDES}
    both = udk.Mechanism(bodies, joints, forces=forces, gravity=[0.0, -9.81])
    v = np.zeros((4, 3))
    v[0, 0], v[2, 0] = 1.0, 1.0
    v[1, 1], v[3, 1] = np.tan(LIGHT["angle"]), np.tan(LIGHT["angle"])
    state = udk.State(udk.assemble(both).q, v)
    end = udk.simulate(both, [0.0, 0.1], state)
    for k, mass in ((0, 0.5), (2, 0.05)):
        (a,) = accelerations(1.0, **lifted(mass))
        assert abs(float(end.v[-1, k, 0]) - 1.0 - 0.1 * a) < 1e-9


def test_a_jam_names_its_joint():
    x = LIGHT | {"mass": 0.05, "push": 0.0}
    assert not accelerations(-1.0, **x)
    run = udk.simulate(screw("set-valued", speed=-1.0, **x), [0.0, 0.1], throw=False)
    assert run.result != udk.Result.successful and 'friction jams joint "thread"' in run.cause


# --- redundant rows

CRANK, PITCH, ROD, BAR, ARM = 0.3, 0.5, 1.0, 4.0, 0.2 * 0.02  # lengths (m), masses (kg), coefficient times radius (m)


def parallelogram(law: str) -> udk.Mechanism:
    """Return a bar on three equal cranks, with friction in all six pins."""
    pins = {f"O{i}": (i * PITCH, 0.0) for i in range(3)} | {f"A{i}": (i * PITCH + CRANK, 0.0) for i in range(3)}
    links: dict[str, Any] = {f"crank{i}": {"pins": [f"O{i}", f"A{i}"], "mass": ROD} for i in range(3)}
    links["bar"] = {"pins": ["A0", "A1", "A2"], "mass": BAR, "width": 0.02}
    friction = [{"pin": pin, "coefficient": 0.2, "radius": 0.02, "law": law} for pin in pins]
    return udk.Drawing(pins, links, ["O0", "O1", "O2"], friction=friction, gravity=[0.0, -9.81]).mechanism()


def near_the_line(angle: float, omega: float) -> udk.State:
    """Return the state of `parallelogram` at an angle of its cranks (rad)."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    q = [[*(CRANK / 2 * along + [i * PITCH, 0.0]), angle] for i in range(3)] + [[*(CRANK * along + [PITCH, 0.0]), 0.0]]
    v = [[*(CRANK / 2 * omega * across), omega] for _ in range(3)] + [[*(CRANK * omega * across), 0.0]]
    return udk.State(np.array(q), np.array(v))


def acceleration_of_cranks(angle: float, omega: float, bar_inertia: float) -> float:
    """Return the angular acceleration of the cranks with loads of least norm, by a damped fixed-point iteration."""
    c, s, half = np.cos(angle), np.sin(angle), CRANK / 2
    masses = np.array([ROD, ROD, ROD * CRANK**2 / 12] * 3 + [BAR, BAR, bar_inertia])
    J, gamma = np.zeros((12, 12)), np.tile([-half * c * omega**2, -half * s * omega**2], 6)
    for i in range(3):
        J[2 * i, [3 * i, 3 * i + 2]], J[2 * i + 1, [3 * i + 1, 3 * i + 2]] = (1, half * s), (1, -half * c)
        J[6 + 2 * i, [3 * i, 3 * i + 2, 9]] = -1, half * s, 1
        J[7 + 2 * i, [3 * i + 1, 3 * i + 2, 10, 11]] = -1, -half * c, 1, (i - 1) * PITCH
    weights, loads = np.zeros(12), np.zeros(12)
    weights[1::3] = -9.81 * masses[1::3]
    D, of_loads = np.linalg.pinv(J * masses**-0.5, 1e-11), np.linalg.pinv(J.T, 1e-11)
    for _ in range(500):
        drag = ARM * np.sign(omega) * np.hypot(*loads.reshape(6, 2).T)
        force = weights.copy()
        force[2:9:3] -= drag[:3] + drag[3:]
        force[11] += drag[3:].sum()
        a = force / masses + masses**-0.5 * (D @ (gamma - J @ (force / masses)))
        new = of_loads @ (masses * a - force)
        if np.abs(new - loads).max() < 1e-11 * np.abs(new).max():
            break
        loads = (loads + new) / 2
    return a[2]


@pytest.mark.parametrize("law", ["smooth", "set-valued"])
def test_a_redundant_linkage_goes_on_while_its_loads_of_least_norm_exist(law):
    scene = parallelogram(law)
    inertia, start = float(scene.bodies["bar"].inertia), [np.deg2rad(3.0), -7.2]
    ts = np.linspace(0.0, 5.5e-3, 4)
    rate = lambda _, y: [y[1], acceleration_of_cranks(y[0], y[1], inertia)]  # noqa: E731
    known = solve_ivp(rate, (ts[0], ts[-1]), start, "RK45", ts, rtol=1e-7, atol=1e-9).y
    run = udk.simulate(scene, ts, near_the_line(*start))
    assert np.rad2deg(known[0, -1]) < 0.75
    np.testing.assert_allclose(run.q[:, 0, 2], known[0], atol=2e-7)
    np.testing.assert_allclose(run.v[:, 0, 2], known[1], atol=2e-5)


# --- loads that vanish at rest


@pytest.mark.parametrize("tol", [1e-4, 1e-6])
def test_a_joint_whose_load_vanishes_with_its_speed_comes_to_rest(tol):
    """A body on a pin at its edge with a damper, thrown without gravity: the load m R (omega^4 + omega'^2)^(1/2) ends with it."""

    def scene(damping: float) -> udk.Mechanism:
        body = udk.Body(1.0, 0.1, position=[0.2, 0.0], velocity=[0.0, 0.6], angular_velocity=3.0)
        forces = {
            "damper": udk.TorsionSpring(["ground", "body"], stiffness=0.0, damping=damping),
            "rub": udk.Friction("P", coefficient=0.1, radius=0.05, law="set-valued"),
        }
        joints = {"P": udk.Revolute(["ground", "body"], [[0.0, 0.0], [-0.2, 0.0]])}
        return udk.Mechanism({"body": body}, joints, forces=forces, gravity=[0.0, 0.0])

    for damping in (1e2, 1e3, 1e4, 1e6):
        run = udk.simulate(scene(damping), [0.0, 1.0], rtol=tol, atol=tol)
        assert run.events is not None and int(run.events.count) <= 1 and int(run.stats["steps"]) < 100
        assert abs(float(run.v[-1, 0, 2])) < 10 * tol
