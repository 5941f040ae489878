"""Jumps and kinks of the forces of a user-defined system are located, as in a mechanism."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import udkjax as udk
from tests.integrate.events.law.test_kinks import KINDS, P, bumped, place

START = np.array([0.0, 0.0, 0.0])


class AsSystem(eqx.Module):
    """The body of the tests of mechanisms as a system, with a row that says nothing new: y = 0."""

    kind: type = eqx.field(static=True)
    k: jax.Array

    def mass(self, q):
        return jnp.diag(jnp.array([1.0, 1.0, 0.1]))

    def force(self, t, q, v):
        if self.kind.potential is not udk.ForceElement.potential:
            return jnp.zeros(3)
        element = self.kind(["b"], k=self.k)
        return jnp.zeros(3).at[0].set(element.along(t, q[0], v[0]))

    def potential(self, t, q):
        if self.kind.potential is udk.ForceElement.potential:
            return 0.0 * q[0]
        return self.kind(["b"], k=self.k).potential(t, SimpleNamespace(x=q[0]))

    def rows(self, t, q):
        return q[1:2]


def run(kind, p, end=0.6, **options):
    whole = AsSystem(kind, jnp.asarray(p[1]))
    system = udk.ConstrainedSystem(whole.mass, whole.force, whole.rows, potential=whole.potential)
    start = udk.State(START, jnp.stack([p[0], 0.0, 0.0]) if isinstance(p, jax.Array) else np.array([p[0], 0.0, 0.0]))
    return udk.simulate(system, [0.0, end], start, rtol=1e-12, atol=1e-12, **options)


@pytest.mark.parametrize("kind", [KINDS[1], *(pytest.param(x, marks=pytest.mark.slow) for x in KINDS if x is not KINDS[1])])
def test_a_system_meets_the_kinks_of_a_mechanism(kind):
    found = run(kind, P)
    assert float(found.q[-1, 0]) == pytest.approx(float(place(kind, P)), abs=1e-12)
    assert found.settings["kinks"] == "located" and found.events is None
    assert int(found.stats["kinks"]) > 0 and float(found.unlocated) == np.inf


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "jax"])
def test_derivatives_pass_through_kinks_of_a_system(engine):
    slope = jax.grad(lambda p: run(KINDS[1], p, engine=engine).q[-1, 0])(jnp.asarray(P))
    np.testing.assert_allclose(slope, jax.grad(bumped)(jnp.asarray(P)), rtol=1e-9)


@pytest.mark.slow
def test_second_derivatives_pass_through_kinks_of_a_system():
    found = jax.hessian(lambda p: run(KINDS[1], p).q[-1, 0])(jnp.asarray(P))
    np.testing.assert_allclose(found, jax.hessian(bumped)(jnp.asarray(P)), atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_are_those_of_differences(kind):
    h = 1e-5
    differences = [(float(run(kind, P + h * e).q[-1, 0]) - float(run(kind, P - h * e).q[-1, 0])) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(jax.jacfwd(lambda p: run(kind, p).q[-1, 0])(jnp.asarray(P)), differences, atol=1e-9)


@pytest.mark.slow
def test_members_of_a_batch_have_kinks_of_their_own():
    steps = KINDS[2]
    ps = jnp.stack([jnp.array([v, 2.0]) for v in (0.2, 0.5, 1.0, 1.5)])
    found = jax.vmap(lambda p: (lambda s: (s.q[-1, 0], s.stats["kinks"]))(run(steps, p)))(ps)
    singles = [run(steps, np.asarray(p)) for p in ps]
    np.testing.assert_allclose(found[0], [s.q[-1, 0] for s in singles], atol=1e-13)
    assert found[1].tolist() == [int(s.stats["kinks"]) for s in singles]


def push(k, height, speed):
    """The force of a floor at a height of 0.1: a spring and a damper that does not pull."""
    return jnp.where(height < 0.1, jnp.maximum(-k * (height - 0.1) - 2.0 * speed, 0.0), 0.0)


def bounced(k):
    """A point of 2 kg on a circle in space about (0, 1, 0), let go beside its centre, meets the floor again and again."""
    system = udk.ConstrainedSystem(
        lambda q: 2.0 * jnp.eye(3),
        lambda t, q, v: jnp.stack([0.0, push(k, q[1], v[1]) - 2.0 * 9.81, 0.0]),
        lambda t, q: jnp.stack([q[0] ** 2 + (q[1] - 1.0) ** 2 + q[2] ** 2 - 1.0, q[2] - 0.5 * q[0]]),
    )
    start = udk.State(np.array([1.0, np.sqrt(1.25), 0.5]) / np.sqrt(1.25), np.zeros(3))
    return udk.simulate(system, [0.0, 3.0], start, rtol=1e-11, atol=1e-11)


def height_by_angle(k):
    """The height at the end by the angle below the horizontal, where SciPy ends its steps at the kinks."""

    def load(y):
        return -k * (0.9 - np.sin(y[0])) + 2.0 * np.cos(y[0]) * y[1]

    def free(t, y):
        return [y[1], np.cos(y[0]) * 9.81]

    def touching(t, y):
        return [y[1], np.cos(y[0]) * (9.81 - load(y) / 2.0)]

    def meets(t, y):
        return 0.9 - np.sin(y[0])

    def leaves(t, y):
        return load(y)

    meets.terminal = leaves.terminal = True
    meets.direction = leaves.direction = -1
    t, y, pieces = 0.0, [0.0, 0.0], ((free, meets), (touching, leaves))
    while t < 3.0:
        slope, event = pieces[0]
        part = solve_ivp(slope, (t, 3.0), y, "DOP853", events=event, rtol=1e-12, atol=1e-12)
        t, y, pieces = part.t[-1], part.y[:, -1], pieces[::-1]
    return 1.0 - np.sin(y[0])


@pytest.mark.slow
def test_a_constrained_point_bounces():
    found = bounced(jnp.array(3e3))
    assert int(found.stats["kinks"]) >= 8
    assert float(found.q[-1, 1]) == pytest.approx(height_by_angle(3e3), abs=1e-8)
    slope = jax.grad(lambda k: bounced(k).q[-1, 1])(jnp.array(3e3))
    assert float(slope) == pytest.approx((height_by_angle(3e3 + 1) - height_by_angle(3e3 - 1)) / 2, rel=1e-4)


def test_what_is_not_located_is_told():
    """Kinks of M and of constraints are named; a force that chatters is left to the steps."""
    start = udk.State(np.array([0.1, 0.0]), np.array([1.0, 0.0]))
    heavier = udk.ConstrainedSystem(lambda q: jnp.diag(jnp.array([1.0, 1.0]) + jnp.maximum(q[0] - 0.2, 0.0)))
    found = udk.simulate(heavier, [0.0, 0.3], start)
    assert found.settings["kinks"] == 'not located in "mass"' and found.unlocated is None


def test_a_force_without_value_beyond_its_kink():
    """The force is that of Hertz's contact for small depths, and no number for negative ones: the run succeeds anyway."""

    def contact(t, q, v):
        return 1e4 * jnp.arccos(1.0 - jnp.maximum(-q, 0.0)) ** 3

    system = udk.ConstrainedSystem(lambda q: jnp.eye(1), contact)
    run = udk.simulate(system, [0.0, 0.5, 1.0], udk.State(np.array([0.4]), np.array([-1.0])), rtol=1e-9, atol=1e-9)
    assert run.result.is_success and 0.4 < float(run.unlocated) < 0.5  # it is located where the contact begins, not where it ends
    assert float(run.v[-1, 0]) == pytest.approx(1.0, abs=1e-7)


@pytest.mark.slow
def test_a_force_that_chatters_is_told():
    rubbed = udk.ConstrainedSystem(lambda q: jnp.eye(1), lambda t, q, v: -jnp.sign(v))
    found = udk.simulate(rubbed, [0.0, 1.0], udk.State(np.array([0.0]), np.array([0.3])), throw=False)
    assert float(found.unlocated) == pytest.approx(0.3, abs=1e-9)
    assert not found.result.is_success


@pytest.mark.slow
def test_kinks_stay_apart_from_events_of_a_system():
    late = udk.Event(lambda t, q, v: q[0] - 0.3, udk.Log(), name="late")
    found = run(KINDS[0], P, events=[late])
    assert found.events.names[:1] == ("late",) and int(found.events.count) == 1
    assert float(found.events.time[0]) == pytest.approx(0.2 + (1 - np.sqrt(0.6)) / 2, abs=1e-13)
    assert int(found.stats["kinks"]) == 1
