"""First derivatives of the programs: those of the textbook, from the factors at hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.programs import run
from udkjax import GROUND
from udkjax.equations.differentiable_programs import FORWARD, REVERSE
from udkjax.equations.scene_arrays import constants_of
from udkjax.equations.scene_programs import scene_programs
from udkjax.equations.structure import numbers_as_vector
from udkjax.equations.textbook import TextbookEquations, prepare
from udkjax.equations.written_out import WrittenOut
from udkjax.pinv.rank_policy import RankPolicy


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


SCENES = "double_pendulum elliptic_trammel parallelogram peaucellier planetary_gear scissor_lift slider_crank".split()


@pytest.mark.parametrize("scene", ["driven", "slider_crank", *(pytest.param(s, marks=pytest.mark.slow) for s in SCENES[:-1])])
@pytest.mark.parametrize("name", ["accelerations", "projection"])
def test_they_are_those_of_the_textbook(scene, name):
    """Along all numbers of the scene, q and v, where it is closed. Reverse mode is the transpose: w (J d) = (w J) d."""
    mechanism = driven() if scene == "driven" else getattr(udk.library, scene)()
    random, t = np.random.default_rng(1), 0.3
    state = udk.assemble(mechanism, t)
    q, v = (np.asarray(x).ravel() for x in (state.q, state.v))
    analysis, gains = udk.analyse(mechanism), udk.Baumgarte(2.0, 3.0)
    leaves, tree = jax.tree.flatten(mechanism.without_origin)
    dleaves = [random.standard_normal(np.shape(x)) * 0.1 for x in leaves]
    dq, dv = random.standard_normal((2, q.size))
    programs = scene_programs(mechanism, analysis.redundant_rows or (), True, RankPolicy.FALL_BACK)

    @jax.jit
    def by_jax(leaves, dleaves):
        gains_and_thresholds = jnp.array([2.0, 3.0])

        def constants(leaves):
            return constants_of(programs, jnp.concatenate([numbers_as_vector(leaves), gains_and_thresholds]), jnp)

        def expected(leaves, q, v):
            mech = tree.unflatten(leaves)
            kept = np.ones(len(analysis.row_names))
            kept[list(analysis.redundant_rows or ())] = 0.0
            equations = prepare(mech, udk.SVD(1e-11), gains, analysis)
            w = equations.scales.weights * kept
            scales: Any = _Weighted(w)
            equations = TextbookEquations(mechanism=mech, method=equations.method, baumgarte=gains, scales=scales, redundant=())
            found = equations.accelerations(t, q, v) if name == "accelerations" else equations.correct(t, q, v)
            return jnp.concatenate(found) if isinstance(found, tuple) else found

        return jax.jvp(constants, (leaves,), (dleaves,))[1], jax.jvp(expected, (leaves, q, v), (dleaves, dq, dv))[1]

    dconstants, expected = by_jax([jnp.asarray(x, float) for x in leaves], dleaves)
    numbers = [*map(float, numbers_as_vector(leaves)), 2.0, 3.0, 1e-14, 1e-14]
    active = [True] * (programs.number_count - 2) + [False] * 2
    results = ["a"] if name == "accelerations" else ["q1", "v1"]

    def differentiated(mode, seeds):
        written_out = WrittenOut(programs, [], [name], active, mode)
        evaluation, derivative = written_out.derivative(name)
        given = {"constants": np.array(written_out.prologue(numbers)), "t": np.array([t]), "q": q, "v": v}
        moving = np.asarray(dconstants)[list(written_out.moving)]
        return moving, run(derivative, given | {"stored": run(evaluation, given)["stored"]} | seeds(moving))

    moving, found = differentiated(FORWARD, lambda moving: {"d_constants": moving, "d_q": dq, "d_v": dv})
    found = np.concatenate([found[f"d_{x}"] for x in results])
    assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * float(1 + np.abs(expected).max()))
    weights = random.standard_normal(len(found))
    _, back = differentiated(
        REVERSE, lambda _: {f"bar_{x}": weights[k * q.size : (k + 1) * q.size] for k, x in enumerate(results)}
    )
    total = back["bar_constants"] @ moving + back["bar_q"] @ dq + back["bar_v"] @ dv
    assert_allclose(total, weights @ found, rtol=0, atol=1e-10 * float(np.abs(weights) @ np.abs(found)))


class _Weighted:
    """Scales of which only the weights are asked for."""

    def __init__(self, weights):
        self.weights = weights
