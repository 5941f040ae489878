"""Derivatives of the fast form: those of the plain form, from the factors at hand, and nothing that is not asked for."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax import GROUND
from udkjax.equations import prepare
from udkjax.equations.rank_policy import REFUSE, drop_dependent
from udkjax.straightline import Loop

ELIMINATION = udk.Elimination()
BAUMGARTE = udk.Baumgarte(2.0, 3.0)


def driven():
    """A crank that a motor turns, with a spring, a damper and a torque on what follows."""
    linkage = udk.library.four_bar()
    one, two, *_ = linkage.body_names
    motor = udk.Driver((GROUND, one), "angle", udk.Sine(0.4, 2.0))
    forces = {
        "spring": udk.Spring((GROUND, two), [[0.0, 1.0], [0.1, 0.2]], 20.0, 0.5, 0.3),
        "torque": udk.Torque((GROUND, two), 0.6),
    }
    return udk.Mechanism(dict(linkage.bodies), dict(linkage.joints), {"motor": motor}, forces, linkage.gravity)


SCENES = "double_pendulum elliptic_trammel peaucellier planetary_gear scissor_lift slider_crank".split()


def inner(a, b):
    """The inner product of two trees."""
    return sum(jax.tree.leaves(jax.tree.map(lambda x, y: jnp.sum(x * y), a, b)))


@pytest.mark.parametrize(
    ("scene", "method", "baumgarte"),
    [
        ("driven", ELIMINATION, BAUMGARTE),
        pytest.param("parallelogram", udk.Auto(), None, marks=pytest.mark.slow),
        *(pytest.param(scene, udk.Auto(), BAUMGARTE, marks=pytest.mark.slow) for scene in SCENES),
    ],
    ids=lambda x: x if isinstance(x, str) else type(x).__name__,
)
def test_first_derivatives_are_those_of_the_plain_form(scene, method, baumgarte):
    """Along all numbers of the scene, t, q and v: of accelerations anywhere, of the projection where it is closed.

    Reverse mode is the transpose of that: w (J d) = (w J) d.
    """
    mechanism = driven() if scene == "driven" else getattr(udk.library, scene)()
    analysis, random = udk.analyse(mechanism), np.random.default_rng(1)
    q, v = (x.ravel() + 0.05 * random.standard_normal(x.size) for x in (mechanism.q0, mechanism.v0))
    inputs = (mechanism, jnp.array(0.3), q, v)
    dots = jax.tree.map(lambda x: jnp.asarray(random.standard_normal(np.shape(x))), inputs)

    def of(form):
        made = partial(prepare, method=method, baumgarte=baumgarte, large=False, analysis=analysis)
        return lambda mechanism, t, q, v: form(made(mechanism).with_policy(REFUSE), t, q, v)

    def both(fast, plain, at, weights):
        fast, plain = of(fast), of(plain)
        return jax.jvp(fast, at, dots), jax.jvp(plain, at, dots), jax.vjp(fast, *at)[1](weights)

    def project(equations, t, q, v):
        return equations.project(t, q, v)

    @jax.jit
    def derivatives(mechanism, t, q, v):
        close = lambda _, state: of(project)(mechanism, t, *state)  # noqa: E731
        closed = (mechanism, t, *jax.lax.fori_loop(0, 6, close, (q, v)))
        here, weights = (mechanism, t, q, v), (jnp.cos(jnp.arange(q.size)), jnp.sin(jnp.arange(q.size)))
        a = both(lambda e, *s: e.accelerations(*s), lambda e, *s: e.plain.accelerations(*s), here, weights[0])
        return (*a, weights[0]), (*both(project, lambda e, *s: e.plain.correct(*s), closed, weights), weights)

    for fast, plain, back, weights in derivatives(*inputs):
        size = max(float(jnp.abs(x).max()) for x in jax.tree.leaves(plain))
        for f, p in zip(jax.tree.leaves(fast), jax.tree.leaves(plain), strict=True):
            np.testing.assert_allclose(f, p, rtol=1e-10, atol=1e-10 * size)
        terms = inner(jax.tree.map(jnp.abs, weights), jax.tree.map(jnp.abs, fast[1]))
        np.testing.assert_allclose(inner(back, dots), inner(weights, fast[1]), rtol=0, atol=1e-11 * terms)


@pytest.mark.parametrize(
    ("scene", "order"),
    [("double_pendulum", 1), *(pytest.param(*x, marks=pytest.mark.slow) for x in (("driven", 1), ("parallelogram", 2)))],
)
def test_the_end_of_a_step_is_a_projection_and_the_accelerations_there(scene, order):
    """In value, and in derivatives along all numbers of the scene, t, q and v; with the error that projection leaves, or without.

    The error has no derivative.
    """
    mechanism = driven() if scene == "driven" else getattr(udk.library, scene)()
    random, analysis = np.random.default_rng(1), udk.analyse(mechanism)
    q, v = (x.ravel() + 1e-7 * random.standard_normal(x.size) for x in (mechanism.q0, mechanism.v0))
    inputs = (mechanism, jnp.array(0.3), q, v)
    dots = jax.tree.map(lambda x: jnp.asarray(random.standard_normal(np.shape(x))), inputs)

    error = 1e-7 * random.standard_normal((2, q.size))

    def ended(equations, t, q, v):
        arrived = equations.arrived(t, q, v)
        *finished, left = equations.finished(t, q, v, *error)
        return *arrived, *finished, *left

    def one_after_another(equations, t, q, v):
        q, v = equations.project(t, q, v)
        found = q, v, equations.accelerations(t, q, v)
        left = jax.lax.stop_gradient(equations.with_policy(drop_dependent())).tangential(
            t, *jax.lax.stop_gradient((q, v)), *error
        )
        return *found, *found, *left

    def derivatives(form, mechanism, t, q, v):
        def function(mechanism, t, q, v):
            return form(prepare(mechanism, udk.Auto(), large=False, analysis=analysis).with_policy(REFUSE), t, q, v)

        def along(*at):
            return jax.jvp(function, at, dots)

        weights = *(jnp.cos(k + jnp.arange(q.size)) for k in range(8)), jnp.ones(())
        at = mechanism, t, q, v
        return along(*at) if order == 1 else jax.jvp(along, at, dots), inner(jax.vjp(function, *at)[1](weights), dots)

    def closed(mechanism, t, q, v):
        close = lambda _, state: prepare(mechanism, udk.Auto(), large=False, analysis=analysis).project(t, *state)  # noqa: E731
        q, v = jax.lax.fori_loop(0, 6, close, (q, v))
        return mechanism, t, q + 1e-9 * jnp.cos(jnp.arange(q.size)), v + 1e-9

    at = jax.jit(closed)(*inputs)
    found, expected = (jax.tree.leaves(jax.jit(derivatives, static_argnums=0)(f, *at)) for f in (ended, one_after_another))
    size = max(float(jnp.abs(x).max()) for x in expected)
    assert len(found) == len(expected) == 18 * order + 1 and size > 1.0
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10 * size)


def test_the_end_of_a_step_takes_two_eliminations(linkage):
    """Projection, whose last Newton step finds nothing to do, accelerations and the error by themselves would take four."""

    def operations(*names):
        return sum(n for name in names for n in prepare(linkage).code.program(name).count().values())

    apart = operations("nearer", "nearer", "accelerations", "tangential")
    assert operations("closer", "finish") <= 0.65 * apart
    assert operations("closer", "arrival", "tangential") <= 0.75 * apart


@pytest.fixture(scope="module")
def linkage():
    return udk.library.parallelogram()


def test_a_state_that_elimination_cannot_solve_spoils_no_derivative(linkage, placed):
    """In line the rank drops: no number, which the caller replaces, and a derivative that nothing times it leaves zero."""
    equations = prepare(linkage, udk.Auto()).with_policy(REFUSE)
    q, v = (x.ravel() for x in placed(0.0, 1.0))

    def chosen(q, v):
        a = equations.accelerations(0.0, q, v)
        projected = jnp.concatenate([*equations.project(0.0, q, v), *equations.arrived(0.0, q, v)])
        found = jnp.concatenate([a, projected])
        return jnp.where(jnp.all(jnp.isfinite(found)), found, 2.0 * jnp.tile(q, 6)), (a, projected)

    @jax.jit
    def both(q, v):
        _, back, spoilt = jax.vjp(chosen, q, v, has_aux=True)
        return spoilt, back(jnp.ones(72)), jax.jvp(chosen, (q, v), (v, q), has_aux=True)[1]

    (a, projected), (of_q, of_v), tangent = both(q, v)
    assert jnp.all(jnp.isnan(a)) and jnp.all(jnp.isnan(projected))
    np.testing.assert_allclose(of_q, 12.0, rtol=1e-15)
    np.testing.assert_allclose(of_v, 0.0, atol=1e-15)
    np.testing.assert_allclose(tangent, 2.0 * jnp.tile(v, 6), rtol=1e-15)


def test_batches_of_states_and_of_directions(linkage, placed):
    """In any nesting, forward and reverse, the same numbers."""
    equations = prepare(linkage, udk.Auto()).with_policy(REFUSE)
    q, v = (x.reshape(-1, 12) for x in jax.vmap(placed)(jnp.array([-0.7, 0.4, 1.9]), jnp.array([1.0, -2.0, 0.5])))
    a = lambda q, v: equations.accelerations(0.0, q, v)  # noqa: E731

    @jax.jit
    def derivatives(q, v):
        outside = jax.jacfwd(lambda z: jax.vmap(a)(q + z[0], v + z[1]))(jnp.zeros((2, 12)))
        return jnp.moveaxis(outside, 2, 0), *(jnp.stack(jax.vmap(mode(a, (0, 1)))(q, v)) for mode in (jax.jacfwd, jax.jacrev))

    outside, forward, reverse = derivatives(q, v)
    np.testing.assert_allclose(forward, outside, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-11)


def test_a_gradient_in_a_loop_keeps_few_numbers(linkage):
    """What a step of a scan hands to its reverse pass: less than the accelerations have operations, a vector or a number each."""
    equations = prepare(linkage, udk.Elimination())

    def end(q, v):
        step = lambda s, _: ((s[0] + 1e-3 * s[1], s[1] + 1e-3 * equations.accelerations(0.0, *s)), None)  # noqa: E731
        return jnp.sum(jax.lax.scan(step, (q, v), None, length=7)[0][0])

    back = jax.make_jaxpr(lambda q, v: jax.vjp(end, q, v)[1](1.0))(linkage.q0.ravel(), linkage.v0.ravel())
    scans = [e for e in back.jaxpr.eqns if e.primitive.name == "scan"]
    assert len(scans) == 2
    kept = [x.aval.shape for x in scans[0].outvars if x.aval.shape[:1] == (7,)]  # pyright: ignore[reportAttributeAccessIssue]
    assert 0 < len(kept) <= 100
    assert sum(int(np.prod(shape[1:])) for shape in kept) <= 150


def test_in_a_loop_value_and_directions_are_found_by_one_program():
    """With the numbers of the parts, along few directions and many, for accelerations and projection."""
    mechanism = udk.library.double_pendulum()
    q, v = (0.01 * jnp.sin(jnp.arange(x.size)) + x.ravel() for x in (mechanism.q0, mechanism.v0))
    directions = jnp.asarray(np.random.default_rng(2).standard_normal((6, 1 + 2 * q.size)))

    def changes(loop):
        def state(gravity, q, v):
            equations = prepare(mechanism.with_parameters({"gravity": jnp.array([0.0, -gravity])}), ELIMINATION).with_policy(
                REFUSE
            )
            equations = equations if loop is None else equations.within(loop)

            def once(c):
                q, v = equations.project(0.3, *c[1:3])
                return c[0] + 1, q, v, equations.accelerations(0.3, q, v)

            return jax.lax.while_loop(lambda c: c[0] < 2, once, (0, q, v, q))[1:]

        def along(d):
            return jax.jvp(state, (jnp.array(9.81), q, v), (d[0], d[1 : 1 + q.size], d[1 + q.size :]))

        return [jax.vmap(along)(directions[:size]) for size in (1, 3, 4, 6)]

    parts, at_once = (jax.tree.leaves(jax.jit(lambda loop=loop: changes(loop))()) for loop in (None, Loop()))
    size = max(float(jnp.abs(x).max()) for x in parts)
    assert min(float(jnp.abs(x).max()) for x in parts) > 1e-2
    for one, other in zip(at_once, parts, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-11 * size)


def test_value_and_directions_at_once_hand_nothing_on(linkage):
    """A program for both has the operations of its parts, none twice."""
    code = prepare(linkage).code
    moving = tuple(k in (0, len(code.constants) + 1, len(code.constants) + 2) for k in range(len(code.constants) + 3))
    derivative = code.derivative("accelerations", moving)
    assert derivative.few("accelerations") == 3
    value, forward = derivative.evaluation("accelerations"), derivative.forward
    for directions in (1, 3):
        both = derivative.along("accelerations", directions)
        assert sum(both.count().values()) <= sum(value.count().values()) + directions * sum(forward.count().values())
        assert len(both.outputs) == len(code.outputs["accelerations"]) + directions * len(forward.outputs)
