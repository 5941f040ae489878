"""Reactions in all axes and about all points, their uniqueness, and the sharing of forces by compliances."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from udkjax.equations.friction.compliance import sharing
from udkjax.equations.rows.determinacy import scaled_jacobian

G = 9.81


def at(state, t=0.0):
    return SimpleNamespace(ts=jnp.array([t]), q=jnp.asarray(state.q)[None], v=jnp.asarray(state.v)[None])


@pytest.fixture(scope="module")
def linkage():
    return udk.library.parallelogram()


@pytest.mark.parametrize("case", ["rest_-50deg", "rest_+45deg_crosses"])
def test_components_of_the_paper_s_linkage_are_those_of_its_closed_form(linkage, placed, data, case):
    """T and S/3 along and across each link; about a pin there is no torque."""
    cases = data("seed_fivebar_parallelogram")["cases"]
    reference = next(value for name, value in cases.items() if name.startswith(case))["reference"].values()
    states = [placed(float(row["theta"]), float(row["thetad"])) for row in reference]
    run = SimpleNamespace(ts=jnp.zeros(len(states)), q=jnp.stack([q for q, _ in states]), v=jnp.stack([v for _, v in states]))
    found = udk.reactions(linkage, run, frame="body", about="joint")
    expected = np.array([[float(row["N_axial_minnorm"]), float(row["T_tangential"]), 0.0] for row in reference])
    for k in (1, 2, 3):
        assert_allclose(found[f"B{k}"][f"link{k}"], expected, atol=1e-10)
    along_joint = udk.reactions(linkage, run, frame="joint", about="joint")
    assert_allclose(along_joint["B2"]["coupler"], -expected, atol=1e-10)  # in the axes of the link, the last of its bodies


def test_tangential_parts_of_the_paper_s_linkage_are_unique_and_axial_ones_are_not(linkage):
    state = at(udk.assemble(linkage))
    turned = udk.unique_reactions(linkage, state, frame="body", about="joint")
    for k in (1, 2, 3):
        for joint in ("A", "B"):
            assert_array_equal(turned[f"{joint}{k}"][f"link{k}"][0], [False, True, True])
    straight = udk.unique_reactions(linkage, state)
    assert_array_equal(straight["A1"]["link1"][0], [False, False, True])  # its axial force has no arm; the coupler's has
    assert_array_equal(straight["B1"]["coupler"][0], [False, False, False])


def test_uniqueness_is_that_of_a_jacobian_written_by_hand(linkage):
    """The linkage with the self-stress of its closed form, u = (f e, -f e), f = (1, -2, 1); the null vector is by NumPy."""
    theta = 0.3
    mechanism = udk.library.parallelogram(theta)
    e, across = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
    hand = np.zeros((12, 12))
    for k, spot in enumerate((-1.0, 0.0, 1.0)):
        hand[2 * k : 2 * k + 2, 3 * k : 3 * k + 2] = hand[6 + 2 * k : 8 + 2 * k, 3 * k : 3 * k + 2] = np.eye(2)
        hand[2 * k : 2 * k + 2, 3 * k + 2], hand[6 + 2 * k : 8 + 2 * k, 3 * k + 2] = -across / 2, across / 2
        hand[6 + 2 * k : 8 + 2 * k, 9:11], hand[7 + 2 * k, 11] = -np.eye(2), -spot
    assert_allclose(scaled_jacobian(mechanism, 0.0, mechanism.q0), hand, atol=1e-15)  # L is one metre
    assert_allclose(udk.singular_values(mechanism, 0.0, mechanism.q0), np.linalg.svd(hand, compute_uv=False), atol=1e-14)
    stress = np.outer([1.0, -2.0, 1.0], e).ravel() / np.sqrt(12)
    found = udk.uniqueness(mechanism, 0.0, mechanism.q0)
    assert int(found.rank) == 11
    assert_allclose(found.share, np.abs(np.concatenate([stress, -stress])), atol=1e-13)
    level = udk.uniqueness(linkage, 0.0, udk.library.parallelogram(-np.pi / 2).q0)  # hanging: what is horizontal is unique
    assert_array_equal(level.unique, [True, False] * 6)


def test_a_thousand_states_at_once(linkage, placed):
    angles = np.random.default_rng(0).uniform(-3.0, -0.2, 1000)
    q = jax.vmap(lambda s: placed(s, 0.0)[0])(jnp.asarray(angles))
    found = jax.jit(jax.vmap(lambda q: udk.uniqueness(linkage, 0.0, q)))(q)
    assert_array_equal(found.rank, 11)
    assert_allclose(found.share[:, 0], np.abs(np.cos(angles)) / np.sqrt(12), atol=1e-12)


def beam(stiff_at=(-1.0, 0.0, 1.0), torque=2.0):
    """A beam on upright rods, and a rod that holds it sideways."""
    rods = {f"rod{k}": udk.Distance(["ground", "beam"], [[x, -1.0], [x, 0.0]]) for k, x in enumerate(stiff_at)}
    rods["side"] = udk.Distance(["ground", "beam"], [[-3.0, 0.0], [-1.0, 0.0]])
    load = udk.Torque(["ground", "beam"], torque)
    return udk.Mechanism({"beam": udk.Body(3.0, 1.0)}, rods, forces=[load], name="beam")


def hand_split(spots, stiffness, force, torque):
    """Forces of springs that hold a rigid beam: k (u + phi x), with the required sum and moment."""
    spots, stiffness = np.asarray(spots), np.asarray(stiffness)
    matrix = np.array([[stiffness.sum(), stiffness @ spots], [stiffness @ spots, stiffness @ spots**2]])
    lift, turn = np.linalg.solve(matrix, [force, torque])
    return stiffness * (lift + turn * spots)


def supports(mechanism, compliances, **choices):
    found = udk.reactions(mechanism, at(udk.assemble(mechanism)), compliances=compliances, **choices)
    return np.array([found[f"rod{k}"]["beam"][0, 1] for k in range(3)])


@pytest.mark.parametrize("compliance", [(1.0, 1.0, 1.0), (1.0, 2.0, 5.0), (1e-9, 3e-6, 1e-5)])
def test_a_beam_on_three_supports_is_shared_as_springs_share_it(compliance):
    mechanism, spots = beam(), (-1.0, 0.0, 1.0)
    expected = hand_split(spots, 1 / np.array(compliance), 3.0 * G, -2.0)
    found = supports(mechanism, {f"rod{k}": c for k, c in enumerate(compliance)} | {"side": 1e-6})
    assert_allclose(found, expected, rtol=1e-8)


def test_a_joint_without_compliance_is_rigid():
    """Two rigid supports carry the beam as if there were no third support; with three, the least norm decides."""
    found = supports(beam(), {"rod2": 1e-6})
    assert_allclose(found, [2.0, 3.0 * G - 2.0, 0.0], atol=1e-9)
    plain = supports(beam(), None)
    assert_allclose(supports(beam(), {}), plain, atol=1e-12)
    assert_allclose(supports(beam(), dict.fromkeys(("rod0", "rod1", "rod2"), 7e-7)), plain, atol=1e-9)


def test_weights_of_rows_do_not_change_the_split():
    """Two rods side by side share 4 N in the ratio of their stiffnesses."""
    rows, soft = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), jnp.array([1.0, 3.0, 2.0])
    for w in (np.ones(3), np.array([1.0, 5.0, 0.2])):
        share = sharing(jnp.asarray(w[:, None] * rows), soft, jnp.asarray(w))
        assert_allclose(share(jnp.array([2.0, 2.0, 7.0])), [3.0, 1.0, 7.0], rtol=1e-12)


def test_the_split_does_not_depend_on_units():
    """A beam of a micrometre has the same shares."""
    unit = 1e-6
    big, rods = beam(), {}
    for name, joint in big.joints.items():
        rods[name] = udk.Distance(joint.bodies, unit * np.asarray(joint.points))
    small = udk.Mechanism({"beam": udk.Body(3.0, unit**2)}, rods, forces=[udk.Torque(["ground", "beam"], 2.0 * unit)])
    soft = {"rod0": 1e-6, "rod1": 2e-6, "rod2": 7e-6}
    assert_allclose(supports(small, soft), supports(big, soft), rtol=1e-9)
    assert_array_equal(
        [*udk.unique_reactions(small, at(udk.assemble(small)))["rod0"]["beam"][0]],
        [*udk.unique_reactions(big, at(udk.assemble(big)))["rod0"]["beam"][0]],
    )


def test_the_split_has_the_derivatives_of_differences():
    mechanism = beam()
    state = at(udk.assemble(mechanism))

    def first(compliance):
        soft = {"rod0": compliance, "rod1": 2.0, "rod2": 5.0}
        return udk.reactions(mechanism, state, compliances=soft)["rod0"]["beam"][0, 1]

    h = 1e-5
    assert_allclose(jax.grad(first)(1.5), (first(1.5 + h) - first(1.5 - h)) / (2 * h), rtol=1e-8)


def test_axes_and_points_of_a_slider_crank_against_newton_s_laws():
    """In the axes of the guide, the force is only across it; about the joint's own point, a pin has no torque."""
    mechanism = udk.library.slider_crank(0.7)
    state = at(udk.assemble(mechanism))
    a = np.asarray(udk.accelerations(mechanism, 0.0, state.q[0], state.v[0]))
    found = udk.reactions(mechanism, state, frame="joint", about="joint")
    assert_allclose(found["guide"]["slider"][0, 0], 0.0, atol=1e-12)
    assert_allclose(found["P"]["rod"][0, 2], 0.0, atol=1e-12)
    ground = udk.reactions(mechanism, state)
    loads = sum(np.asarray(ground[joint]["rod"][0]) for joint in ("P", "B"))
    mass, inertia = float(mechanism.bodies["rod"].mass), float(mechanism.bodies["rod"].inertia)
    assert_allclose(loads, [mass * a[1, 0], mass * (a[1, 1] + G), inertia * a[1, 2]], atol=1e-10)
    angle = float(state.q[0, 1, 2])
    turned = np.asarray(udk.reactions(mechanism, state, frame="body")["B"]["rod"][0])
    fx, fy, torque = np.asarray(ground["B"]["rod"][0])
    assert_allclose(turned, [np.cos(angle) * fx + np.sin(angle) * fy, np.cos(angle) * fy - np.sin(angle) * fx, torque])
    assert all(np.all(part) for loads in udk.unique_reactions(mechanism, state).values() for part in loads.values())


@pytest.mark.parametrize(
    ("compliances", "message"),
    [({"rod9": 1.0}, 'did you mean "rod'), ({"rod0": -1.0}, "negative"), ({"rod0": [1.0, 2.0]}, "1 numbers")],
)
def test_wrong_compliances_are_refused_by_name(compliances, message):
    mechanism = beam()
    with pytest.raises(ValueError, match=message):
        udk.reactions(mechanism, at(udk.assemble(mechanism)), compliances=compliances)


def test_wrong_axes_are_refused():
    with pytest.raises(ValueError, match='frame must be one of "ground", "body", "joint", not "world"'):
        udk.reactions(beam(), at(udk.assemble(beam())), frame="world")  # pyright: ignore[reportArgumentType]
