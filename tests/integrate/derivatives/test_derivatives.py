"""Derivatives of runs and of assembly by JAX's transformations: forward, reverse and higher, without extra arguments."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

import udkjax as udk

TS = np.array([0.0, 1.0, 2.0])
PENDULUM = udk.library.double_pendulum()
LINKAGE = udk.library.parallelogram(np.deg2rad(-50.0))
SECOND = {
    "hessian": jax.hessian,
    "forward over forward": lambda f: jax.jacfwd(jax.jacfwd(f)),
    "reverse over reverse": lambda f: jax.jacrev(jax.grad(f)),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
}


@pytest.fixture(scope="module")
def exact(data):
    return {name: float(x) for name, x in data("seed_fivebar_parallelogram")["sensitivities_rest_minus50"]["2"].items()}


def linkage_at(angle):
    """q and v of the paper's linkage at rest."""
    e = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    links = [jnp.append(jnp.array([x, 0.0]) + e / 2, angle) for x in (0.0, 1.0, 2.0)]
    q = jnp.stack([*links, jnp.append(jnp.array([1.0, 0.0]) + e, 0.0)])
    return udk.State(q, jnp.zeros_like(q))


def of_linkage(x, **choices):
    """Its angle after 2 s as a function of the initial angle and a link's mass. It is redundant, of rank 11."""
    mechanism = LINKAGE.with_parameters({"body.link1.mass": x[1]})
    choices = {"rtol": 1e-10, "atol": 1e-10, "max_steps": 2048, "throw": False} | choices
    return udk.simulate(mechanism, TS, linkage_at(x[0]), **choices).q[-1, 0, 2]


def of_pendulum(x, **choices):
    """The second rod's angle after 2 s as a function of the first rod's initial angle, which assembly uses, and its mass."""
    one = PENDULUM.body_names[0]
    mechanism = PENDULUM.with_parameters({f"body.{one}.mass": x[1], f"body.{one}.angle": x[0]})
    choices = {"rtol": 1e-10, "atol": 1e-10, "max_steps": 2048, "throw": False} | choices
    return udk.simulate(mechanism, TS, **choices).q[-1, 1, 2]


AT = {of_linkage: jnp.array([np.deg2rad(-50.0), 1.0]), of_pendulum: jnp.array([-0.3, 1.2])}
FAST = ((of_linkage, "forward over forward"),)


def differences(f, x, h):
    """First derivatives by differences of eighth order; second ones by differences of first ones."""
    weights = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280]) / h
    found = [
        sum(w * np.asarray(f(x + k * h * d)) for k, w in zip(range(-4, 5), weights, strict=True) if w) for d in np.eye(len(x))
    ]
    return np.stack(found, axis=-1)


@pytest.fixture(scope="module")
def slopes():
    return {f: jax.jit(jax.jacfwd(f)) for f in AT}


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 11])
def test_directions_side_by_side(count):
    """Derivatives along many directions at once equal those along each alone: with outputs, and with empty lanes."""
    names = [n for n in LINKAGE.parameters() if n.endswith(("mass", "inertia", "gravity", "link1.points", "angular_velocity"))]
    values = {n: LINKAGE.parameters()[n] for n in names}
    flat, back = ravel_pytree(values)

    def states(x):
        solution = udk.simulate(LINKAGE.with_parameters(back(x)), TS, linkage_at(-0.9 + 0.1 * x[0]), throw=False)
        return jnp.concatenate([solution.q.ravel(), solution.v.ravel()])

    directions = jnp.asarray(np.random.default_rng(1).standard_normal((count, len(flat))))
    along = partial(jax.jvp, states, (flat,))
    together = jax.jit(jax.vmap(lambda d: along((d,))[1]))(directions)
    alone = jax.jit(lambda d: along((d,))[1])
    for d, found in zip(directions, together, strict=True):
        assert_allclose(found, alone(d), rtol=1e-10, atol=1e-12 * np.abs(found).max())


@pytest.mark.parametrize("f", [of_linkage, pytest.param(of_pendulum, marks=pytest.mark.slow)], ids=lambda f: f.__name__)
def test_first_derivatives(f, slopes):
    """Forward mode, reverse mode and a single direction agree with each other and with differences."""
    x = AT[f]
    forward = slopes[f](x)
    assert_allclose(forward, differences(jax.jit(partial(f, rtol=1e-12, atol=1e-12)), x, 2e-3), rtol=1e-6)
    direction = jnp.array([0.3, -1.0])
    gradient, along = jax.jit(lambda x: (jax.grad(f)(x), jax.jvp(f, (x,), (direction,))[1]))(x)
    assert_allclose(gradient, forward, rtol=1e-9)
    assert_allclose(along, forward @ direction, rtol=1e-9)


def test_first_derivatives_are_those_of_the_exact_solution(exact, slopes):
    assert_allclose(slopes[of_linkage](AT[of_linkage])[0], exact["dtheta_dtheta0"], rtol=1e-8)


@pytest.mark.parametrize(
    ("f", "second"),
    [
        pytest.param(f, second, id=f"{f.__name__}-{name}", marks=[] if (f, name) in FAST else pytest.mark.slow)
        for f in AT
        for name, second in SECOND.items()
    ],
)
def test_second_derivatives(f, second, slopes):
    """They are symmetric in any order of modes, and agree with differences of first derivatives."""
    x = AT[f]
    found = jax.jit(second(f))(x)
    assert_allclose(found, differences(slopes[f], x, 2e-3), rtol=1e-5)
    assert_allclose(found, found.T, rtol=1e-8)


@pytest.mark.slow
def test_a_number_that_a_batch_shares():
    """The gradient of a sum over a batch, and over a batch of batches, is the sum of the gradients."""
    mechanism, rates = udk.library.compound_pendulum(), jnp.linspace(-1.0, 1.0, 4)
    start = udk.assemble(mechanism)

    def angle(gravity, rate):
        state = udk.State(start.q, start.v + rate * jnp.array([0.0, 0.0, 1.0]))
        return udk.simulate(mechanism.with_parameters({"gravity[1]": gravity}), TS, state, throw=False).q[-1, 0, 2]

    def total(gravity):
        return jnp.sum(jax.vmap(jax.vmap(partial(angle, gravity)))(rates.reshape(2, 2)))

    found, each = jax.jit(lambda g: (jax.grad(total)(g), jax.vmap(jax.grad(angle), (None, 0))(g, rates)))(-9.0)
    assert np.abs(each).min() > 1e-3
    assert_allclose(found, each.sum(), rtol=1e-9)


@pytest.mark.slow
def test_both_engines_start_beside_the_manifold_alike():
    """Both project the start. Second derivatives use first ones of both engines, also in directions that open loops."""
    state, opening = linkage_at(-0.8), 1e-4 * np.eye(4, 3)

    def slope(engine):
        run = partial(udk.simulate, LINKAGE, TS, rtol=1e-10, atol=1e-10, drift_tol=1.0, engine=engine)
        there, back = (run(udk.State(state.q + sign * opening, state.v)).q[1:] for sign in (1, -1))
        return (there - back) / 2e-4

    native = slope("native")
    assert_allclose(slope("jax"), native, atol=2e-5 * np.abs(native).max())  # 5e-4 where one of them does not


@pytest.mark.slow
@pytest.mark.parametrize("solver", [udk.BDF(), udk.Verner65()], ids=["BDF", "Verner65"])
def test_other_solvers_have_both_modes(solver, slopes):
    f, x = partial(of_pendulum, solver=solver, rtol=1e-8, atol=1e-8), AT[of_pendulum]
    for mode in (jax.jacfwd, jax.grad):
        assert_allclose(jax.jit(mode(f))(x), slopes[of_pendulum](x), rtol=1e-4)


def assemble(x, mechanism=LINKAGE):
    """The assembled state of a linkage as a function of the first body's guessed angle and the last one's mass."""
    one, *_, last = mechanism.body_names
    mechanism = mechanism.with_parameters({f"body.{one}.angle": x[0], f"body.{last}.mass": x[1]})
    state = udk.assemble(mechanism, throw=False)
    return jnp.sum(jnp.cos(jnp.arange(float(state.q.size))) * (state.q.ravel() + 0.1 * state.v.ravel()))


@pytest.mark.parametrize("second", [None, *(pytest.param(f, marks=pytest.mark.slow, id=n) for n, f in SECOND.items())])
def test_derivatives_of_assembly(second):
    x = jnp.array([np.deg2rad(-50.0) + 0.05, 2.0])
    slope = jax.jit(jax.jacfwd(assemble))
    if second is None:
        expected = differences(jax.jit(assemble), x, 1e-3)
        for found in jax.jit(lambda x: (jax.jacfwd(assemble)(x), jax.grad(assemble)(x)))(x):
            assert_allclose(found, expected, rtol=1e-7, atol=1e-9)
        return
    assert_allclose(jax.jit(second(assemble))(x), differences(slope, x, 1e-3), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("opening", [0.0, 0.4], ids=["closed", "open"])
def test_second_derivatives_of_assembly_by_machine_code(opening):
    """A linkage without redundant rows, from a closed guess, and from an open one with steps of limited length."""
    mechanism = udk.library.four_bar()
    angle = mechanism.parameters()[f"body.{mechanism.body_names[0]}.angle"]
    f, x = partial(assemble, mechanism=mechanism), jnp.array([float(angle) + opening, 1.3])
    slope = jax.jit(jax.jacfwd(f))
    found = jax.jit(jax.jacfwd(jax.jacfwd(f)))(x)
    assert_allclose(found, differences(slope, x, 1e-3), rtol=1e-6, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("stabilization", [udk.Projection(), udk.Baumgarte(5.0, 5.0), None], ids=lambda x: type(x).__name__)
def test_second_derivatives_of_outputs_in_a_batch(stabilization):
    """Outputs between steps, with and without projection. Members of a batch equal single runs."""
    mechanism = udk.library.four_bar()
    one, start = mechanism.body_names[0], udk.assemble(mechanism)

    def states(x):
        changed = mechanism.with_parameters({f"body.{one}.mass": x[0], f"body.{one}.inertia": x[1]})
        choices = {"rtol": 1e-10, "atol": 1e-10, "throw": False, "stabilization": stabilization}
        solution = udk.simulate(changed, np.linspace(0.0, 0.5, 4), udk.State(start.q, start.v), **choices)
        return jnp.concatenate([solution.q[:, :, 2].ravel(), solution.v[:, 1, 2]])

    x = jnp.array([1.2, 0.1])
    batch = jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(states))))(x + jnp.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.01]]))
    expected = differences(jax.jit(jax.jacfwd(states)), x, 1e-3)
    assert_allclose(batch[0], expected, atol=1e-6 * np.abs(expected).max())
    assert_allclose(batch[2], jax.jit(jax.jacfwd(jax.jacfwd(states)))(x + jnp.array([0.2, 0.01])), rtol=1e-7, atol=1e-9)


ENDS_EARLY = {
    "step limit": {"max_steps": 20},
    "drift": {"stabilization": None, "drift_tol": 1e-6, "rtol": 1e-4, "atol": 1e-4},
}


@pytest.mark.parametrize("transform", [jax.grad, jax.jacfwd])
@pytest.mark.parametrize("reason", ENDS_EARLY)
def test_outputs_that_are_not_kept_have_no_derivatives(reason, transform):
    """They are NaN, as are their tangents; cotangents that are zero contribute nothing."""
    ts, mechanism = np.linspace(0.0, 4.0, 41), udk.library.parallelogram()

    def rates(mass):
        found = mechanism.with_parameters({"body.coupler.mass": mass})
        return udk.simulate(found, ts, throw=False, **ENDS_EARLY[reason]).v[:, 0, 2]

    kept = np.isfinite(rates(2.0))
    assert 1 < kept.sum() < len(ts)
    total = lambda mass: jnp.sum(jnp.where(kept, rates(mass), 0.0) ** 2)  # noqa: E731
    expected = jax.jacfwd(lambda mass: jnp.sum(rates(mass)[np.flatnonzero(kept)] ** 2))(2.0)
    assert_allclose(transform(total)(2.0), expected, rtol=1e-9)
    assert_allclose(expected, (total(2.0 + 1e-5) - total(2.0 - 1e-5)) / 2e-5, rtol=1e-4)
