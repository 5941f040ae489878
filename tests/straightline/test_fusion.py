"""A program as one fusion: the same numbers as with barriers, wherever it is, and never where XLA cannot take it."""

import os

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.equations.programs import prepare
from udkjax.equations.rank_policy import REFUSE
from udkjax.straightline import Loop, fusion

TRIED = jax.__version_info__[:2] in fusion.KNOWN
ONLY_WHERE_TRIED = pytest.mark.skipif(not TRIED, reason="fusions were not tried with this version of JAX")


@pytest.fixture(scope="module")
def linkage():
    return udk.library.parallelogram()


def looped(mechanism, loop):
    """States after three evaluations that each wait for the one before, in a loop of which XLA does not know how long it is."""
    equations = prepare(mechanism).with_policy(REFUSE).within(loop)

    def run(q, v):
        def again(_, state):
            q, v = state
            a = equations.accelerations(0.0, q, v)
            q, v = equations.project(0.0, q + 1e-3 * v, v + 1e-3 * a)
            left = equations.tangential(0.0, q, v, a, v)
            return q, v + 1e-9 * left.dq

        return jax.lax.fori_loop(0, jnp.where(jnp.sum(q * q) > 0.0, 3, 2), again, (q, v))

    return run, mechanism.q0.ravel(), mechanism.v0.ravel() + jnp.linspace(0.1, 0.3, mechanism.q0.size)


def fusions(text):
    """How many fusions a lowered program holds that XLA did not make."""
    return text.count("mhlo.fusion")


def simulated(mechanism, ts, **choices):
    run = jax.jit(lambda mass: udk.simulate(mechanism.with_parameters({"body.link1.mass": mass}), ts, throw=False, **choices).q)
    return run.lower(1.0).as_text(), lambda: run(1.0)


@ONLY_WHERE_TRIED
@pytest.mark.parametrize("scene", ["parallelogram", "double_pendulum", "slider_crank", "chain"])
def test_the_numbers_are_those_of_the_programs_with_barriers(scene):
    mechanism = udk.library.chain(4) if scene == "chain" else getattr(udk.library, scene)()
    run, *state = looped(mechanism, Loop())
    barred, *_ = looped(mechanism, None)
    assert fusions(jax.jit(run).lower(*state).as_text()) == 3
    assert fusions(jax.jit(barred).lower(*state).as_text()) == 0
    for found, expected in zip(jax.jit(run)(*state), jax.jit(barred)(*state), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@ONLY_WHERE_TRIED
def test_a_fusion_is_one_pass_over_its_operations(linkage):
    """None is repeated, and what it hands over are its results alone."""

    def cost(loop):
        run, *state = looped(linkage, loop)
        found = jax.jit(run).lower(*state).compile().cost_analysis()
        assert found
        return found

    fused, barred = cost(Loop()), cost(None)
    assert fused["flops"] <= barred["flops"]
    assert fused["bytes accessed"] < 0.7 * barred["bytes accessed"]


@pytest.mark.parametrize("scene", ["parallelogram", "driven_pendulum", "slider_crank", "chain"])
@pytest.mark.parametrize("axes", [(None, 0), (0, 0), (1, -1)], ids=["velocities", "states", "along the last axis"])
def test_batches_take_fusions_of_vectors(scene, axes):
    mechanism = udk.library.chain(4) if scene == "chain" else getattr(udk.library, scene)()
    run, *state = looped(mechanism, Loop(batch=True))
    barred, *_ = looped(mechanism, None)
    scales = 1.0 + 1e-3 * np.arange(5)
    state = [x if axis is None else np.stack([k * x for k in scales], axis) for x, axis in zip(state, axes, strict=True)]
    both = [jax.jit(jax.vmap(f, axes)) for f in (run, barred)]
    assert [fusions(f.lower(*state).as_text()) > 0 for f in both] == [TRIED, False]
    for found, expected in zip(*(f(*state) for f in both), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_batches_of_batches_and_of_single_runs_and_a_compiler_that_was_not_told_take_the_program_as_it_is(linkage, monkeypatch):
    run, q, v = looped(linkage, Loop(batch=True))
    barred, *_ = looped(linkage, None)
    several = jnp.stack([jnp.stack([v, 2 * v, 3 * v])] * 2)
    twice = jax.jit(jax.vmap(jax.vmap(run, (None, 0)), (None, 0)))
    assert fusions(twice.lower(q, several).as_text()) == 0
    for found, expected in zip(twice(q, several), jax.vmap(jax.vmap(barred, (None, 0)), (None, 0))(q, several), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    single, *_ = looped(linkage, Loop())
    assert fusions(jax.jit(jax.vmap(single, (None, 0))).lower(q, several[0]).as_text()) == 0
    monkeypatch.setenv("XLA_FLAGS", "")
    assert fusions(jax.jit(jax.vmap(run, (None, 0))).lower(q, several[0]).as_text()) == 0


def test_a_batch_of_few_operations_and_many_results_is_no_fusion():
    """The loop would look longer at where its arrays are than it takes."""

    def fused(results, steps, size):
        jaxpr = jax.make_jaxpr(lambda x: [x * k + sum([x] * steps) for k in range(results)])(1.0)
        return fusion.Parts(jaxpr, ((),), (size is not None,), size).is_one_fusion

    assert fused(60, 1, None) and fused(2, 50, 64)
    assert not fused(60, 1, 64)


@pytest.mark.parametrize("batch", [False, True])
def test_derivatives_take_the_program_as_it_is(linkage, batch):
    loop = Loop(batch)
    run, q, v = looped(linkage, loop)
    barred, *_ = looped(linkage, None)
    for found, e in zip(jax.jvp(run, (q, v), (v, v))[1], jax.jvp(barred, (q, v), (v, v))[1], strict=True):
        np.testing.assert_allclose(found, e, rtol=1e-11, atol=1e-11)
    assert loop.whole != batch


@pytest.mark.parametrize(
    "choices",
    [{"method": udk.SVD()}, {"method": udk.Varga()}, {"formulation": udk.Augmented()}, {"solver": diffrax.Kvaerno5()}],
    ids=["SVD", "Varga", "augmented", "implicit"],
)
def test_what_is_no_straight_line_code_is_left_alone(linkage, choices):
    assert fusions(simulated(linkage, jnp.linspace(0.0, 0.05, 3), **choices)[0]) == 0


@pytest.mark.parametrize("flag", [f"--xla_{flag}=1" for flag in fusion.FLAGS])
def test_flags_that_take_loops_apart_forbid_it(monkeypatch, linkage, flag):
    run, *state = looped(linkage, Loop())
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ.get('XLA_FLAGS', '')} {flag}")
    assert fusions(jax.jit(run).lower(*state).as_text()) == 0


def test_a_user_who_turns_optimization_off_gets_none(linkage):
    run, *state = looped(linkage, Loop())
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        assert fusions(jax.jit(run).lower(*state).as_text()) == 0
    finally:
        jax.config.update("jax_disable_most_optimizations", False)


def test_operations_of_a_library_and_arrays_are_no_fusion():
    """Only what XLA makes arithmetic of, number by number, and not all of too much."""

    def parts(function, n=2):
        return fusion.Parts(jax.make_jaxpr(function)(*[jax.ShapeDtypeStruct((), float)] * n), ((),) * n)

    assert parts(lambda x, y: [x * y + 1.0, x]).is_one_fusion
    assert not parts(lambda x, y: [x, y]).is_one_fusion
    assert not parts(lambda x, y: [jax.scipy.special.gammaln(x) * y]).is_one_fusion
    assert not parts(lambda x, y: [jnp.stack([x, y])[0] * 2.0]).is_one_fusion
    assert not parts(lambda x, y: [jax.lax.cond(x > y, lambda: x, lambda: y)]).is_one_fusion
    assert not parts(lambda x, y: [sum([x * k for k in range(fusion.LARGEST)], y)]).is_one_fusion


@pytest.mark.parametrize(
    ("function", "whole"),
    [
        (lambda x, y: [x * y], True),
        (lambda x, y: [x, y], True),
        (lambda x, y: [jax.scipy.special.gammaln(x) * y], False),
        (lambda x, y: [jnp.linalg.solve(jnp.array([[x, y], [y, 3.0]]), jnp.ones(2))[0]], False),
    ],
    ids=["arithmetic", "nothing", "a function of a library", "LAPACK"],
)
def test_what_else_is_in_a_loop_forbids_all_fusions_in_it(function, whole):
    loop, numbers = Loop(), [jax.ShapeDtypeStruct((), float)] * 2
    simple, other = (fusion.together(jax.make_jaxpr(f)(*numbers), [(), ()]) for f in (lambda x, y: [x + y * y], function))

    def run(x):
        def again(x):
            return simple(loop, x, 1.0)[0] + sum(other(loop, x, 2.0))

        return jax.lax.while_loop(lambda x: x < 100.0, again, x)

    lowered = jax.jit(run).lower(1.0)
    assert loop.whole == whole
    assert (fusions(lowered.as_text()) > 0) == (TRIED and whole)
    lowered.compile()  # which would end the process


@ONLY_WHERE_TRIED
def test_large_reductions_do_not_take_a_loop_apart():
    """XLA would make calls of a library of them, which no function of a loop can hold."""
    simple = fusion.together(jax.make_jaxpr(lambda x, y: [x + y * y])(1.0, 1.0), [(), ()])

    def run(x, many):
        loop = Loop(batch=True)

        def again(state):
            x, many = state
            largest = jnp.max(jnp.abs(many), axis=0)
            return jax.vmap(lambda x, y: simple(loop, x, y)[0])(x, largest), many + x

        return jax.lax.while_loop(lambda state: jnp.any(state[0] < 100.0), again, (x, many))

    lowered = jax.jit(run).lower(np.linspace(1.0, 2.0, 64), np.ones((100, 64)))
    assert fusions(lowered.as_text()) > 0
    assert "xla_cpu_small_call" in (lowered.compile().as_text() or "")
