"""Jumps and kinks of forces that depend on the state are located. First and second derivatives pass through them."""

# pyright: reportArgumentType=false, reportOptionalMemberAccess=false
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.special import gamma

import udkjax as udk
from tests.calls import calls_of
from tests.integrate.events.run.passing import by_the_loop, counted
from udkjax.equations.systems.smooth_loads import SmoothLoads
from udkjax.expressions.scalars import scalar_program


class Of(udk.ForceElement):
    """A force along x on a point of unit mass."""

    k: Float[Array, ""]

    def along(self, t, x, v):
        raise NotImplementedError

    def loads(self, t, *frames):
        return [(self.along(t, frames[0].x, frames[0].vx), 0.0, 0.0)]


class Brake(Of):
    def along(self, t, x, v):
        return jnp.where(x > 0.2, -self.k, 0.0)


class Bumper(Of):
    def along(self, t, x, v):
        return -self.k * jnp.maximum(x - 0.2, 0.0)


class Steps(Of):
    def along(self, t, x, v):
        return self.k * jnp.floor(x / 0.2)


class Saw(Of):
    def along(self, t, x, v):
        return -self.k * ((x + 0.13) % 0.3)


class SawFromBelow(Of):
    """It jumps where the remainder, negative before, is zero."""

    def along(self, t, x, v):
        return -self.k * (((x - 0.25) % 0.3) + 0.1 * ((x - 0.35) // 0.3))


class DeadZone(Of):
    def along(self, t, x, v):
        return -self.k * jnp.sign(x - 0.1) * jnp.maximum(jnp.abs(x - 0.1) - 0.05, 0.0)


class Saturated(Of):
    def along(self, t, x, v):
        return jnp.clip(-self.k * (x - 0.2) - 0.3 * v, -0.4, 0.4)


class Wrapped(Of):
    """A comparison with a wrapped angle: it also changes its side where the angle is wrapped."""

    def along(self, t, x, v):
        angle = (10 * x + jnp.pi) % (2 * jnp.pi) - jnp.pi
        return -self.k * (jnp.where(angle > 0.5, angle - 0.5, 0.0) + 0.1 * angle)


class ByTangent(Of):
    def along(self, t, x, v):
        return -self.k * jnp.arctan2(jnp.sin(10 * x), jnp.cos(10 * x))


class Later(Of):
    def along(self, t, x, v):
        return jnp.where(t > 0.3, -self.k, 0.0)


class LaterFurther(Of):
    def along(self, t, x, v):
        return -self.k * jax.lax.cond(t > 0.23 * x + 0.2, lambda: x, lambda: 0.0 * x)


class Sign(Of):
    def along(self, t, x, v):
        return -self.k * jnp.sign(v)


class Hertz(Of):
    """An elastic contact: beyond its end a power of a negative number is no number."""

    def along(self, t, x, v):
        return -self.k * jnp.maximum(x - 0.2, 0.0) ** 1.5


class Wall(udk.ForceElement):
    k: Float[Array, ""]

    def potential(self, t, *frames):
        return 0.5 * self.k * jnp.maximum(frames[0].x - 0.2, 0.0) ** 2


KINDS = (Brake, Bumper, Steps, Saw, SawFromBelow, DeadZone, Saturated, Wrapped, ByTangent, LaterFurther, Wall)
P = np.array([1.0, 2.0])


def point(kind, p):
    zero = 0.0 * p[0]
    body = udk.Body(1.0, 0.1, velocity=jnp.stack([p[0], zero]) if isinstance(p, jax.Array) else np.array([p[0], zero]))
    return udk.Mechanism({"b": body}, forces={"f": kind(["b"], k=p[1])}, gravity=[0, 0])


def run(kind, p, end=0.6, **options):
    return udk.simulate(point(kind, p), [0.0, end], rtol=1e-12, atol=1e-12, **options)


def place(kind, p, **options):
    return run(kind, p, **options).q[-1, 0, 0]


def braked(p):
    return p[0] * 0.6 - 0.5 * p[1] * (0.6 - 0.2 / p[0]) ** 2


def bumped(p):
    return 0.2 + p[0] / jnp.sqrt(p[1]) * jnp.sin(jnp.sqrt(p[1]) * (0.6 - 0.2 / p[0]))


@pytest.mark.parametrize(("kind", "exact"), [(Brake, braked), (Bumper, bumped)])
def test_a_step_ends_at_a_jump_or_a_kink(kind, exact):
    found = run(kind, P)
    assert found.q[-1, 0, 0] == pytest.approx(float(exact(P)), abs=1e-14)
    assert int(found.stats["kinks"]) == 1 and float(found.unlocated) == np.inf
    assert found.settings["kinks"] == "located" and found.events is None


class TurnBrake(udk.ForceElement):
    """A torque that brakes beyond 0.2 rad."""

    k: Float[Array, ""]

    def loads(self, t, *frames):
        return [(0.0, 0.0, jnp.where(frames[0].angle > 0.2, -self.k, 0.0))]


def on_a_pin(name):
    return {name: udk.Revolute(["ground", name], [[0.0, 0.0], [0.0, 0.0]])}


BESIDE = {  # joints whose constants follow from the initial guess
    "gear": on_a_pin("c") | on_a_pin("d") | {"gear": udk.Gear(["c", "d"], [0.1, 0.2])},
    "rack": {"rack": udk.Rack(["ground", "c"], radius=0.2, axis=0.0)},
    "gear and cam": on_a_pin("c")
    | on_a_pin("d")
    | {"gear": udk.Gear(["c", "d"], [0.1, 0.2])}
    | {"cam": udk.Cam(["c", "e"], [[0, 0], [0, 0]], udk.Profile([-1.0, 0.5, 2.0, 4.0], [1.0, 1.1, 1.2, 1.1]))},
}


def wheel(beside):
    """A wheel of 1 kg m^2 that turns freely up to 0.2 rad, in a scene some of whose numbers follow from others."""
    brake = {"f": TurnBrake(["b"], k=jnp.asarray(P[1]))}
    if beside == "drawing":
        link = {"pins": ["O", "A"], "mass": 1.0, "inertia": 0.75}  # 1 kg m^2 about the pin at its end
        drawn = {"pins": {"O": (0, 0), "A": (1, 0)}, "links": {"b": link}, "ground": ["O"], "velocities": {"A": (0, P[0])}}
        return udk.Drawing(**drawn, forces=brake, gravity=[0, 0]).mechanism()
    bodies = {"b": udk.Body(1.0, 1.0, angular_velocity=P[0])} | {
        name: udk.Body(1.0, 0.1, position=[1.0, 0.0] if name == "e" else [0.0, 0.0])
        for name in sorted({x for joint in BESIDE[beside].values() for x in joint.bodies} - {"ground"})
    }
    return udk.Mechanism(bodies, on_a_pin("b") | BESIDE[beside], forces=brake, gravity=[0, 0])


@pytest.mark.parametrize("events", [None, udk.Event(lambda t, frames: t - 0.1, udk.Log())], ids=["alone", "with an event"])
@pytest.mark.parametrize("beside", [*BESIDE, "drawing"])
def test_kinks_are_located_where_numbers_follow_from_others(beside, events):
    mechanism = wheel(beside)
    found = udk.simulate(mechanism, [0.0, 0.6], events=events, rtol=1e-12, atol=1e-12)
    assert float(found.q[-1, 0, 2]) == pytest.approx(float(braked(P)), abs=1e-13)
    assert int(found.stats["kinks"]) == 1


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "jax"])
@pytest.mark.parametrize("beside", [*BESIDE, "drawing"])
def test_derivatives_and_batches_pass_kinks_where_numbers_follow_from_others(beside, engine):
    mechanism = wheel(beside)

    def end(k):
        changed = mechanism.with_parameters({"force.f.k": k})
        return udk.simulate(changed, [0.0, 0.6], rtol=1e-11, atol=1e-11, engine=engine).q[-1, 0, 2]

    wanted = [float(braked([P[0], k])) for k in (1.0, 2.0, 3.0)]
    np.testing.assert_allclose(jax.jit(jax.vmap(end))(jnp.array([1.0, 2.0, 3.0])), wanted, atol=1e-10)
    slope = (wanted[2] - wanted[0]) / 2  # exact: the place is linear in k
    np.testing.assert_allclose([jax.grad(end)(2.0), jax.jacfwd(end)(2.0)], slope, rtol=1e-8)


@pytest.mark.slow
def test_derivatives_pass_through_a_jump():
    """Forward derivatives with respect to the initial velocity, the size of the jump and the end."""
    p = jnp.array([*P, 0.6])

    def end(p):
        return udk.simulate(point(Brake, p), jnp.stack([0.0 * p[2], p[2]]), rtol=1e-12, atol=1e-12).q[-1, 0, 0]

    exact = jax.jacfwd(lambda p: p[0] * p[2] - 0.5 * p[1] * (p[2] - 0.2 / p[0]) ** 2)(p)
    np.testing.assert_allclose(jax.jacfwd(end)(p), exact, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "jax"])
def test_derivatives_of_both_engines_in_reverse(engine):
    slope = jax.grad(lambda p: place(Brake, p, engine=engine))(jnp.asarray(P))
    np.testing.assert_allclose(slope, jax.grad(braked)(jnp.asarray(P)), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "exact"), [(Brake, braked), (Bumper, bumped)])
def test_second_derivatives_pass_through_jumps_and_kinks(kind, exact):
    found = jax.hessian(lambda p: place(kind, p))(jnp.asarray(P))
    np.testing.assert_allclose(found, jax.hessian(exact)(jnp.asarray(P)), atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_are_those_of_differences(kind):
    h = 1e-5
    differences = [(float(place(kind, P + h * e)) - float(place(kind, P - h * e))) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(jax.jacfwd(lambda p: place(kind, p))(jnp.asarray(P)), differences, atol=1e-9)


def test_the_end_of_a_power_is_located():
    """A body that has struck an elastic wall leaves it with the speed with which it came, after a time by quadrature."""
    found = run(Hertz, P, 4.0)
    depth = (2.5 * P[0] ** 2 / (2 * P[1])) ** 0.4
    contact = 2 * depth / P[0] * np.sqrt(np.pi) * gamma(1.4) / gamma(0.9)  # 2 int dx / sqrt(v^2 - 4 k x^2.5 / 5)
    assert found.settings["kinks"] == "located" and int(found.stats["kinks"]) == 2
    assert found.v[-1, 0, 0] == pytest.approx(-P[0], rel=1e-11)
    assert found.q[-1, 0, 0] == pytest.approx(0.2 - P[0] * (4.0 - 0.2 / P[0] - contact), abs=1e-10)
    slopes = jax.grad(lambda p: place(Hertz, p, end=4.0))(jnp.asarray(P))
    exact = jax.grad(lambda p: -p[0] * 4.0 + p[0] * contact * (p[0] / P[0]) ** -0.2 * (p[1] / P[1]) ** -0.4)(jnp.asarray(P))
    np.testing.assert_allclose(slopes, exact, rtol=1e-7)  # the slope of x^1.5 has no bounded slope itself


def test_no_operation_within_a_run_waits_for_jax():
    """A run with kinks is a function that XLA calls: JAX may wait for the thread that runs it."""
    with calls_of(scalar_program._evaluate_by_jax) as by_jax:
        for kind in KINDS:
            element = kind(["b"], k=np.array(2.0))
            renewal = SmoothLoads.of_element(element, ["b"], False).renewal
            assert len(renewal.by_numpy([np.full(3, 0.3)] * len(renewal.inputs))) == len(renewal.outputs) > 0
    assert by_jax == []


@pytest.mark.slow
def test_members_of_a_batch_have_kinks_of_their_own():
    ps = jnp.stack([jnp.array([v, 2.0]) for v in (0.2, 0.5, 1.0, 1.5)])
    found = jax.vmap(lambda p: (lambda s: (s.q[-1, 0, 0], s.stats["kinks"]))(run(Steps, p)))(ps)
    singles = [run(Steps, np.asarray(p)) for p in ps]
    np.testing.assert_allclose(found[0], [s.q[-1, 0, 0] for s in singles], atol=1e-13)
    assert found[1].tolist() == [int(s.stats["kinks"]) for s in singles]


def test_a_run_may_begin_at_a_kink():
    class FromZero(Of):
        def along(self, t, x, v):
            return -self.k * jnp.maximum(x, 0.0)

    assert place(FromZero, np.array([1.0, 4.0])) == pytest.approx(np.sin(1.2) / 2, abs=1e-13)
    assert place(FromZero, np.array([-1.0, 4.0])) == pytest.approx(-0.6, abs=1e-13)


def test_events_of_the_user_stay_apart_from_kinks():
    late = udk.Event(lambda t, at: at["b"].x - 0.3, udk.Log(), name="late")
    found = run(Brake, P, events=[late])
    assert found.events.names[:1] == ("late",) and int(found.events.count) == 1
    assert float(found.events.time[0]) == pytest.approx(0.2 + (1 - np.sqrt(0.6)) / 2, abs=1e-13)
    assert int(found.stats["kinks"]) == 1


class Stop(udk.ForceElement):
    """An elastic stop, and a torque that jumps where another one has its kink."""

    k: Float[Array, ""]

    def loads(self, t, *frames):
        angle, rate = frames[0].angle, frames[0].omega
        jump = jnp.where(angle > -1.0, jnp.where(rate > 0.5, -0.3, 0.2), 0.1 * jnp.floor(3 * angle))
        return [(0.0, 0.0, self.k * jnp.maximum(-1.2 - angle, 0.0) + jump)]


def swinging(k=1e4, **more):
    pendulum = udk.library.double_pendulum(**more)
    return udk.Mechanism(pendulum.bodies, pendulum.joints, forces={"stop": Stop(["upper"], k=k)}, gravity=pendulum.gravity)


CASES = {
    "default": {},
    "Kvaerno5": {"solver": diffrax.Kvaerno5()},
    "not projected": {"stabilization": udk.Baumgarte(5.0, 5.0)},
    "few outputs": {"ts": [0.0, 3.0]},
    "events": {"events": [udk.Event(lambda t, at: at["lower"].omega, udk.Log(), name="turns")]},
    "impacts": {"events": [udk.Event(lambda t, at: at["lower"].angle + 2.0, udk.Impact(0.5), direction=-1, name="hit")]},
}

QUICK = ("default", "events")


@pytest.mark.parametrize("case", [x if x in QUICK else pytest.param(x, marks=pytest.mark.slow) for x in CASES])
def test_machine_code_passes_kinks_as_the_loop_of_events_does(case, monkeypatch):
    options = {"ts": np.linspace(0.0, 3.0, 301), "rtol": 1e-8, "atol": 1e-8} | CASES[case]
    run = lambda: udk.simulate(swinging(), **options)  # noqa: E731
    found, calls, most = counted(run)
    by_the_loop(monkeypatch)
    expected, more_calls, _ = counted(run)
    kinks, events = int(expected.stats["kinks"]), 0 if expected.events is None else int(expected.events.count)
    assert more_calls > kinks / 2 > 10 and most > 10 and calls <= kinks / most + events + 7  # some kinks are simultaneous
    # To the bit where multiplications are fused with additions; elsewhere the two round in other places.
    for one, other in ((found.q, expected.q), (found.v, expected.v)):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=0.1 * options["rtol"] * np.abs(other).max())
    assert found.stats["kinks"] == kinks and abs(found.stats["steps"] - expected.stats["steps"]) <= 2
    if expected.events is not None:
        np.testing.assert_allclose(found.events.time, expected.events.time, rtol=0.0, atol=0.1 * options["rtol"])


@pytest.mark.slow
def test_members_pass_kinks_of_their_own(monkeypatch):
    ts, ks = np.linspace(0.0, 2.0, 5), np.geomspace(1e2, 1e5, 6)
    run = lambda k: udk.simulate(swinging(k), ts, rtol=1e-8, atol=1e-8)  # noqa: E731
    found = jax.vmap(run)(jnp.asarray(ks))
    assert len(set(found.stats["kinks"].tolist())) > 2
    by_the_loop(monkeypatch)
    for k, q, kinks in zip(ks, found.q, found.stats["kinks"], strict=True):
        expected = run(k)
        np.testing.assert_allclose(q, expected.q, atol=1e-11)
        assert kinks == expected.stats["kinks"]


def test_what_rests_where_its_force_jumps_is_told():
    """At rest, dry friction changes its sign endlessly. After some number of jumps they are no longer located."""
    found = run(Sign, np.array([0.3, 1.0]), throw=False)
    assert float(found.unlocated) == pytest.approx(0.3, abs=1e-9)
    assert not found.result.is_success


def test_kinks_in_time_are_held_unless_a_force_has_breakpoints():
    """Breakpoints are all times at which anything happens: then only the state may cross a kink."""
    later, brake = (kind(["b"], k=jnp.array(1.0)) for kind in (Later, Brake))
    counts = [[SmoothLoads.of_element(x, ["b"], breaks).count for x in (later, brake)] for breaks in (False, True)]
    assert counts == [[1, 1], [0, 1]]


def test_forces_whose_kinks_are_not_located_are_told():
    import diffrax

    found = run(Brake, P, adjoint=diffrax.DirectAdjoint())
    assert found.settings["kinks"] == "not located with a diffrax adjoint" and found.unlocated is None


def test_a_scene_without_kinks_has_none():
    spring = udk.Spring(["ground", "b"], [[0, 0], [0, 0]], 1.0, damping=0.1, length=0.1)
    found = udk.simulate(udk.Mechanism({"b": udk.Body(1.0, 0.1, position=[1.0, 0.0])}, forces={"s": spring}), [0.0, 0.1])
    assert "kinks" not in found.settings and "kinks" not in found.stats and found.unlocated is None


class Ripples(udk.ForceElement):
    """A force -100 |sin(400 x)| (N) with a kink each 8 mm."""

    def loads(self, t, *frames):
        return [(-100.0 * jnp.abs(jnp.sin(400.0 * frames[0].x)), 0.0, 0.0)]


def test_sides_that_are_not_held_any_more_stay_free_after_an_event():
    """After 256 kinks the force is evaluated as it is, before and after the rebound from a wall; energy tells its work."""

    def energy(x, v):
        whole = np.floor(400.0 * x / np.pi)
        return v**2 / 2 + 0.25 * (2 * whole + 1 - np.cos(400.0 * x - np.pi * whole))

    block = {"block": udk.Body(1.0, 0.1, velocity=[20.0, 0.0])}
    guide = {"guide": udk.Prismatic(("ground", "block"), [[0, 0], [0, 0]], axis=0.0)}
    wall = udk.Contact("block", through=[2.1, 0.0], normal=[-1.0, 0.0], restitution=0.9, name="wall")
    scene = udk.Mechanism(block, guide, forces={"ripples": Ripples(["block"])}, gravity=[0.0, 0.0])
    run = udk.simulate(scene, [0.0, 0.2], events=wall)
    (hit,) = run.events.of("wall")
    assert run.unlocated is not None and run.unlocated < hit < 0.19
    after = energy(run.events.q_after[0, 0, 0], run.events.v_after[0, 0, 0])
    assert abs(energy(run.q[-1, 0, 0], run.v[-1, 0, 0]) - after) < 1e-3  # as steps do not end at kinks any more
