"""Constraints that events switch on and off: limits of all joints of a machine, joints that come and go, contacts at rest."""

# pyright: reportOptionalMemberAccess=false

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.integrate.events.event_scenes import PENDULUM
from udkjax.equations.rows.analysis import analyse
from udkjax.integrate.events.law.event import expand_events
from udkjax.integrate.events.law.phases import phases_of

COUNT = 6


def row_of_pendulums(count):
    """Pendulums side by side, each with a lower and an upper limit."""
    bodies = {f"b{i}": udk.Body(1.0, 0.1, [i + 0.5, 0]) for i in range(count)}
    joints = {f"p{i}": udk.Revolute(["ground", f"b{i}"], [[i, 0], [-0.5, 0]]) for i in range(count)}
    limits = [udk.JointLimit(f"p{i}", lower=-0.3 - 0.1 * i, upper=1.0, restitution=0.3) for i in range(count)]
    return udk.Mechanism(bodies, joints), limits


@pytest.mark.slow
def test_six_joints_have_ranges():
    """All pendulums come to rest at their lower limits; each agrees with itself alone."""
    mechanism, limits = row_of_pendulums(COUNT)
    ts = np.linspace(0, 2, 5)
    sol = udk.simulate(mechanism, ts, events=limits, rtol=1e-10, atol=1e-10, max_events=200)
    for i in (0, COUNT - 1):
        alone, _ = row_of_pendulums(1)
        one = udk.simulate(alone, ts, events=[udk.JointLimit("p0", -0.3 - 0.1 * i, 1.0, 0.3)], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(sol.q[:, i, 2], one.q[:, 0, 2], atol=1e-8)
    lowest = [-0.3 - 0.1 * i for i in range(COUNT)]
    np.testing.assert_allclose(sol.q[-1, :, 2], lowest, atol=1e-9)
    assert all(sol.events.counts[f"p{i}.lower rests"] == 1 for i in range(COUNT))


def test_sets_of_constraints_share_their_equations():
    """However many contacts may be held, a run has two mechanisms; contacts on other bodies share their programs."""
    mechanism, limits = row_of_pendulums(COUNT)
    phases = phases_of(mechanism, expand_events(limits, mechanism), analyse(mechanism))
    assert len(phases.mechanisms) == 2 and len(phases.switches.names) == 2 * COUNT
    contacts = [phases.mechanisms[1].joints[f"p{i}.lower.contact"] for i in range(COUNT)]
    assert len({(c.labels, jax.tree.structure(c.condition)) for c in contacts}) == 1
    free = phases_of(mechanism, expand_events([udk.Event(lambda t, at: at["b0"].angle)], mechanism), analyse(mechanism))
    assert len(free.mechanisms) == 1


@pytest.mark.slow
def test_members_of_a_batch_hold_different_contacts():
    mechanism, limits = row_of_pendulums(3)
    ts = np.linspace(0, 0.7, 3)

    def angles(masses):
        heavier = mechanism.with_parameters({f"body.b{i}.inertia": 0.1 + masses[i] for i in range(3)})
        return udk.simulate(heavier, ts, events=limits, max_events=60).q[-1, :, 2]

    given = np.array([[0.0, 0.0, 0.0], [0.0, 0.4, 0.0], [0.5, 0.0, 0.9]])
    together = jax.jit(jax.vmap(angles))(given)
    for one, masses in zip(together, given, strict=True):
        np.testing.assert_allclose(one, angles(masses), atol=1e-9)
    slopes = jax.jit(jax.jacfwd(angles))(given[2])
    differences = np.stack([(angles(given[2] + h) - angles(given[2] - h)) / 2e-5 for h in 1e-5 * np.eye(3)], 1)
    np.testing.assert_allclose(slopes, differences, atol=1e-6)


@pytest.mark.parametrize("engine", ["native", pytest.param("diffrax", marks=pytest.mark.slow)])
def test_a_joint_comes_and_goes_under_one_name(engine):
    """A disc on a straight path turns once about each of three pins; its angular momentum about them is conserved."""
    disc = udk.Mechanism({"disc": udk.Body(1.0, 0.5, position=(0.0, 0.0), velocity=(1.0, 0.0))}, gravity=(0, 0))
    omega = 0.5 / (0.5 + 0.25)  # about a pin: m v r = (I + m r^2) omega
    turn, events = 2 * np.pi / omega, []  # s, about a pin or free
    for i in range(3):
        pin = udk.Revolute(("ground", "disc"), [[1.0 + np.pi * i, 0.5], [0.0, 0.5]])
        at_pin, at_end = (lambda t, at, k=k: t - 1.0 - k * turn for k in (2 * i, 2 * i + 1))
        actions = (at_pin, udk.Attach(pin, "pin"), f"on{i}"), (at_end, udk.Release("pin"), f"off{i}")
        events += [udk.Event(condition, action, name=name) for condition, action, name in actions]
    sol = udk.simulate(disc, np.linspace(0, 1 + 6 * turn, 7), events=events, engine=engine, rtol=1e-10, atol=1e-10)
    assert [sol.events.names[int(k)] for k in sol.events.index][:5] == ["on0", "off0", "on1", "off1", "on2"]
    for v in (sol.events.v_after[0, 0], sol.v[-1, 0]):
        np.testing.assert_allclose(v, [0.5 * omega, 0.0, omega], atol=1e-8)
    np.testing.assert_allclose(sol.q[-1, 0], [1 + 3 * np.pi, 0.0, 12 * np.pi], atol=1e-7)


def test_a_joint_of_the_scene_is_attached_again():
    """A pendulum falls free for a moment, and is caught where it is; its friction acts while it has its joint."""
    friction = udk.Mechanism(PENDULUM.bodies, PENDULUM.joints, forces={"f": udk.Friction("A", torque=0.2, velocity=0.1)})
    open_at = udk.Event(lambda t, at: at["link"].angle + 0.5, udk.Release("A"), name="opens")
    again = udk.Event(lambda t, at: t - 0.4, udk.Attach(udk.Weld(("ground", "link"), [[0, 0], [0, 0]]), "A"), name="again")
    free = udk.simulate(friction, [0.0, 0.3, 0.4], events=[open_at])
    turned = np.asarray(free.v)[1:, 0, 2]
    assert abs(turned[0] - turned[1]) < 1e-12  # nothing slows the free link down
    place = np.asarray(free.q)[-1, 0]
    weld = udk.Weld(("ground", "link"), [place[:2], [0, 0]])
    again = udk.Event(lambda t, at: t - 0.4, udk.Attach(weld, "A"), name="again")
    caught = udk.simulate(friction, [0.0, 0.4, 0.6], events=[open_at, again])
    np.testing.assert_allclose(caught.q[-1, 0], place, atol=1e-9)
    with pytest.raises(ValueError, match="is in the scene already; attach the joint under another name, or release"):
        udk.simulate(PENDULUM, [0.0, 0.4], events=[again])


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("restitution", [0.0, 0.8])
def test_the_condition_of_a_contact_stops_a_run(first, restitution):
    """Whichever is listed first, an event of the condition of a contact happens as the contact closes, once for each impact."""
    ball = udk.Mechanism({"ball": udk.Body(1.0, 0.1, position=[0.0, 1.0])})
    floor, ends = udk.Contact("ball", restitution=restitution, name="floor"), np.linspace(0, 1.5, 4)
    stop, log = (udk.Event(lambda t, at: at["ball"].y, action, name="zero") for action in (udk.Stop(), udk.Log()))
    stopped = udk.simulate(ball, ends, events=[floor, stop][:: 1 - 2 * first])
    assert stopped.result == udk.Result.event_stop and abs(stopped.time - np.sqrt(2 / 9.81)) < 1e-9
    logged = udk.simulate(ball, ends, events=[floor, log][:: 1 - 2 * first])
    assert logged.events.counts["zero"] == logged.events.counts["floor"] == (2 if restitution else 1)


def rocking_box(corners, angle, spin, restitution, stiffness=15.0):
    """A box, held by a spring, above a floor that its corners hit."""
    body = udk.Body(1.0, (1.0 + 0.36) / 12, position=(0, 1.2), angle=angle, velocity=(0.4, 0), angular_velocity=spin)
    spring = udk.Spring(("ground", "box"), [[-1.0, 1.5], [-0.5, 0.3]], stiffness=stiffness, length=0.7)
    points = [(-0.5, -0.3), (0.5, -0.3), (0.5, 0.3), (-0.5, 0.3)][:corners]
    feet = [udk.Contact("box", point=x, restitution=restitution, name=f"foot{k}") for k, x in enumerate(points)]
    return udk.Mechanism({"box": body}, forces=[spring]), feet


def test_feet_that_take_turns_come_to_rest():
    """A box that rocks from one foot to the other loses its energy in infinitely many steps, in finite time."""
    for corners, angle, spin, restitution in ((4, -1.346, -1.784, 0.0), (4, 2.184, -0.395, 0.3), (2, 0.9, -1.0, 0.5)):
        mechanism, feet = rocking_box(corners, angle, spin, restitution, 1e-3)
        sol = udk.simulate(mechanism, np.linspace(0, 4, 5), events=feet, max_events=400)
        y, turn = np.asarray(sol.q)[-1, 0, 1:]
        flat = np.round(turn / (np.pi / 2))
        assert abs(turn - flat * np.pi / 2) < 1e-8 and abs(y - (0.3 if flat % 2 == 0 else 0.5)) < 1e-8
        np.testing.assert_allclose(np.asarray(sol.v)[-1, 0, 1:], 0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("corners", "angle", "spin", "restitution"), [(2, 0.3, 0.5, 0.3), (4, -1.346, -1.784, 0.0)])
def test_derivatives_pass_through_rest_after_rocking(corners, angle, spin, restitution):
    def end(x):
        mechanism, feet = rocking_box(corners, x[0], x[1], restitution)
        sol = udk.simulate(mechanism, np.linspace(0, 2, 3), events=feet, max_events=300, rtol=1e-10, atol=1e-10)
        return jnp.concatenate([sol.q[-1].ravel(), sol.v[-1].ravel()])

    x, h = np.array([angle, spin]), 1e-5
    differences = np.stack([(end(x + d) - end(x - d)) / (2 * h) for d in h * np.eye(2)], axis=1)
    np.testing.assert_allclose(jax.jacfwd(end)(x), differences, atol=1e-5)
