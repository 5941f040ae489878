"""First derivatives of the programs: those of the textbook, from the factors at hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax import GROUND
from udkjax.equations.implicit_derivative import acceleration_derivative, projection_derivative
from udkjax.equations.scene_programs import elimination_programs
from udkjax.equations.structure import numbers_as_scalars
from udkjax.equations.textbook import TextbookEquations, prepare
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
    """Along all numbers of the scene, t, q and v, where it is closed. Reverse mode is the transpose: w (J d) = (w J) d."""
    mechanism = driven() if scene == "driven" else getattr(udk.library, scene)()
    random, t = np.random.default_rng(1), 0.3
    state = udk.assemble(mechanism, t)
    q, v = (np.asarray(x).ravel() for x in (state.q, state.v))
    analysis, gains = udk.analyse(mechanism), udk.Baumgarte(2.0, 3.0)
    leaves, tree = jax.tree.flatten(mechanism.without_origin)
    dleaves = [random.standard_normal(np.shape(x)) * 0.1 for x in leaves]
    dt, dq, dv = 0.7, random.standard_normal(q.size), random.standard_normal(v.size)
    programs = elimination_programs(mechanism, analysis.redundant_rows or (), True, RankPolicy.REFUSE)

    @jax.jit
    def by_jax(leaves, dleaves):
        numbers = lambda leaves: [*numbers_as_scalars(leaves), 2.0, 3.0, 1e-14, 1e-14]  # noqa: E731
        constants = lambda leaves: jnp.stack([jnp.asarray(c) for c in programs.prologue(numbers(leaves))])  # noqa: E731

        def expected(leaves, t, q, v):
            mech = tree.unflatten(leaves)
            kept = np.ones(len(analysis.row_names))
            kept[list(analysis.redundant_rows or ())] = 0.0
            equations = prepare(mech, udk.SVD(1e-11), gains, analysis)
            w = equations.scales.weights * kept
            scales: Any = _Weighted(w)
            equations = TextbookEquations(mechanism=mech, method=equations.method, baumgarte=gains, scales=scales, redundant=())
            found = equations.accelerations(t, q, v) if name == "accelerations" else equations.correct(t, q, v)
            return jnp.concatenate(found) if isinstance(found, tuple) else found

        at, along = (leaves, t, q, v), (dleaves, dt, dq, dv)
        return jax.jvp(constants, (leaves,), (dleaves,)), jax.jvp(expected, at, along)[1]

    (constants, dconstants), expected = by_jax([jnp.asarray(x, float) for x in leaves], dleaves)
    make = acceleration_derivative if name == "accelerations" else projection_derivative
    derivative = make(programs, (*[True] * len(constants), True, True, True))
    given = [*map(float, constants), t, *q.tolist(), *v.tolist()]
    stored = derivative.evaluation(given)[len(derivative.evaluation.outputs) - len(derivative.stored) :]
    dots = [*map(float, dconstants), dt, *dq.tolist(), *dv.tolist()]
    found = np.array(derivative.forward([*given, *stored, *dots]))
    assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * float(1 + np.abs(expected).max()))
    weights = random.standard_normal(len(found))
    back = np.array(derivative.reverse([*given, *stored, *weights.tolist()]))
    terms = np.abs(weights) @ np.abs(found)
    assert_allclose(back @ dots, weights @ found, rtol=0, atol=1e-10 * float(terms))


class _Weighted:
    """Scales of which only the weights are asked for."""

    def __init__(self, weights):
        self.weights = weights


def test_a_driver_that_is_not_differentiated_changes_nothing():
    programs = elimination_programs(driven(), (), False, RankPolicy.REFUSE)
    still, moving = (
        acceleration_derivative(programs, (*[False] * len(programs.constants), t, True, True)) for t in (False, True)
    )
    assert len(moving.inputs) == len(still.inputs) + 1
    assert len(moving.forward.order) > len(still.forward.order)
