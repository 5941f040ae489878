"""`diagnose` says where friction depends on loads that equilibrium does not determine."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from experiments.parts.random_scenes import build, random_scene
from tests.friction import rubbing
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.friction.rubbing import rubbing_names, settle, single_rubbing_loads
from udkjax.equations.rows.determinacy import left_null_space
from udkjax.equations.states.textbook import prepare

pytestmark = pytest.mark.slow

SAMPLED = 10.0  # size of sampled loads that balance each other, relative to the largest load of the motion


def verdict(mechanism: udk.Mechanism) -> tuple[dict[str, tuple[bool, bool]], str]:
    """Return the marks of each friction, of its load and of the accelerations that it causes, and the text of the diagnosis."""
    diagnosis = udk.diagnose(mechanism, fixes=False, walk=False)
    return {name: (x.load, x.accelerations) for name, x in diagnosis.friction.items()}, str(diagnosis)


def slider(joints: Mapping[str, udk.Joint], friction: udk.Friction, **bodies: udk.Body) -> udk.Mechanism:
    """Return a sliding body with further joints and bodies."""
    guide = udk.Prismatic(["ground", "slider"], [[0, 0], [0, 0]], axis=0.0)
    return udk.Mechanism({"slider": udk.Body(1.0, 0.1), **bodies}, {"S": guide, **joints}, forces={"rub": friction})


def test_parallelogram_is_not_unique():
    """The loads in its pins are shared by redundant constraints, and with them its accelerations."""
    found, text = verdict(rubbing(udk.library.parallelogram()))
    assert not any(x for marks in found.values() for x in marks)
    assert "not unique, nor are the accelerations" in text


def test_four_bar_is_unique():
    found, text = verdict(rubbing(udk.library.four_bar()))
    assert all(x for marks in found.values() for x in marks)
    assert "all loads are unique" in text


def test_only_the_components_that_rub_count():
    """A second joint shares the torque of a slide, whose friction depends on its normal force alone, unless it has edges."""
    joints = {"held": udk.Angle(["ground", "slider"])}
    assert verdict(slider(joints, udk.Friction("S", coefficient=0.1)))[0] == {"S": (True, True)}
    assert verdict(slider(joints, udk.Friction("S", coefficient=0.1, length=0.2)))[0] == {"S": (False, False)}


def test_loads_of_opposite_sides_count():
    """Two guides share a normal force. Where both push to the same side, their sum is constant, but nothing keeps them there."""
    second = udk.Prismatic(["ground", "slider"], [[0, 0], [0.1, 0]], axis=0.0)
    plain = slider({"S2": second}, udk.Friction("S", coefficient=0.1))
    both = udk.Mechanism(plain.bodies, plain.joints, forces={**plain.forces, "rub2": udk.Friction("S2", coefficient=0.1)})
    assert verdict(both)[0] == {"S": (False, False), "S2": (False, False)}


def test_loads_that_answer_to_loose_friction_are_loose():
    """A pendulum on a slider whose friction is not unique: neither are its accelerations, nor the load in its pin."""
    joints = {"held": udk.Angle(["ground", "slider"]), "A": udk.Revolute(["slider", "bob"], [[0, 0], [0, 0.3]])}
    mechanism = slider(joints, udk.Friction("S", coefficient=0.1, length=0.2), bob=udk.Body(1.0, 0.1, [0, -0.3]))
    more = {**mechanism.forces, "rub2": udk.Friction("A", coefficient=0.1, radius=0.01)}
    found, text = verdict(udk.Mechanism(mechanism.bodies, mechanism.joints, forces=more))
    assert found == {"S": (False, False), "A": (False, False)}
    assert "the loads of S, A are not unique, nor are the accelerations" in text


def test_a_joint_that_cannot_slide_moves_nothing():
    """A frame with a brace of too much: its pins have loads that are not unique, and do not turn."""
    pins = {"A": [0, 0], "B": [0, 1], "C": [1, 1], "D": [1, 0]}
    bars = {"a": "AB", "b": "BC", "c": "CD", "d": "AC", "e": "BD"}
    links = {name: {"pins": list(ends), "mass": 1.0} for name, ends in bars.items()}
    rubs = {"A": ["ground", "a"], "D": ["ground", "c"]}
    friction = [{"pin": pin, "of": of, "coefficient": 0.1, "radius": 0.01} for pin, of in rubs.items()]
    mechanism = udk.Drawing(pins=pins, links=links, ground=["A", "D"], friction=friction).mechanism()
    found, text = verdict(mechanism)
    assert all(accelerations for _, accelerations in found.values())
    assert not all(load for load, _ in found.values())
    assert "but the accelerations are" in text


def test_verdicts_agree_with_loads_that_equilibrium_allows():
    """Two guides share a carriage, which a closed chain of pins and a slide follows.

    As long as both press to the same side, the sum of their friction is constant, and nothing answers to it: samples must reach
    loads that are clamped between the guides, several times those of the motion.
    """
    scene = random_scene(1, 7, 6, forces=False)
    speed = 1e-3 * scene.length / scene.time
    mechanism = rubbing(build(scene.table), 0.2, 0.03 * scene.length, speed=speed)
    rubs = {name: force for name, force in mechanism.forces.items() if name.startswith("rub ")}
    mechanism = udk.Mechanism(mechanism.bodies, mechanism.joints, forces=rubs, gravity=mechanism.gravity)
    found, _ = verdict(mechanism)
    spread = spreads(mechanism)
    assert {name: bool(x < 1e-9) for name, x in spread.items()} == {name: load for name, (load, _) in found.items()}
    assert all(x < 1e-9 or x > 1e-4 for x in spread.values())


def spreads(mechanism: udk.Mechanism, samples: int = 6) -> dict[str, float]:
    """Return how much the friction of each joint varies, relative to its largest value, over multipliers that balance it."""
    analysis, equations = udk.analyse(mechanism), prepare(mechanism, udk.SVD())
    scales, q = equations.scales, mechanism.q0.ravel()
    N = left_null_space(mechanism, 0.0, q, analysis).basis
    unit, draw = scales.coordinates(q.size), np.random.default_rng(0)
    v = equations.tangent_part(0.0, q, q, q, jnp.asarray(draw.normal(size=q.size)) * unit * scales.rate).dv
    D, root = uk.D(mechanism, 0.0, q, scales.weights), uk.inverse_sqrt_mass(mechanism)
    plus, b = uk.pseudoinverse(equations.method, D), uk.b(mechanism, 0.0, q, v, None, scales.weights)

    def drags(y: jax.Array) -> jax.Array:
        def balance(friction: jax.Array) -> jax.Array:
            least = -scales.weights * (plus.T @ (plus @ (b - D @ (root * friction))))
            return least + N @ y / scales.rows

        multipliers = settle(balance, mechanism, jnp.asarray(0.0), q, v)
        found = single_rubbing_loads(mechanism, 0.0, q, v, multipliers)
        return jnp.stack([jnp.linalg.norm(x * unit) for x in found.values()])

    size = jnp.max(jnp.abs(uk.multipliers(mechanism, 0.0, q, v, equations.method, None, scales.weights) * scales.rows))
    sizes = np.asarray(jax.jit(jax.vmap(drags))(SAMPLED * size * jnp.asarray(draw.normal(size=(samples, len(N))))))
    assert np.isfinite(sizes).all()
    return dict(zip(rubbing_names(mechanism), np.ptp(sizes, axis=0) / sizes.max(0), strict=True))
