"""Mechanisms with changed lengths and initial angles equal those built that way, and their guesses stay closed."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.positions.assembling.assembly import close

LINKS = ("link1", "link2", "link3")


def same(one, two, atol=1e-15):
    ours, theirs = one.parameters(), two.parameters()
    assert ours.keys() == theirs.keys()
    for name in ours:
        assert_allclose(ours[name], theirs[name], rtol=0, atol=atol, err_msg=name)


def test_a_parallelogram_of_another_length_is_the_one_that_is_built_so():
    same(udk.with_length(udk.library.parallelogram(), LINKS, 1.3), udk.library.parallelogram(length=1.3))


def test_a_parallelogram_at_another_angle_is_the_one_that_is_built_so():
    turned = udk.with_angle(udk.library.parallelogram(angular_velocity=0.2), LINKS, 0.4, 0.7)
    same(turned, udk.library.parallelogram(0.4, 0.7))


def test_the_length_and_angle_that_it_has_change_nothing():
    four_bar = udk.library.four_bar(angular_velocity=1.0)
    same(udk.with_length(four_bar, "coupler", 2.5), four_bar, atol=1e-14)
    same(udk.with_angle(four_bar, "crank", float(four_bar.bodies["crank"].angle)), four_bar, atol=0)


def test_a_rod_keeps_its_mass_per_metre():
    before = udk.library.four_bar(lengths=(1.0, 2.5, 2.0))
    after = udk.with_length(before, "rocker", 2.2, as_rod=True)
    built = udk.library.four_bar(lengths=(1.0, 2.5, 2.2)).bodies["rocker"]
    assert_allclose([after.bodies["rocker"].mass, after.bodies["rocker"].inertia], [built.mass, built.inertia], rtol=1e-14)
    assert_allclose(udk.with_length(before, "rocker", 2.2).bodies["rocker"].mass, before.bodies["rocker"].mass, rtol=0)


def test_a_loop_that_opens_is_closed_by_assembly():
    longer = udk.with_length(udk.library.four_bar(), "coupler", 2.7)
    state, points = udk.assemble(longer), longer.joints["B"].points[1]
    crank, coupler = longer.bodies["crank"], 1
    assert_allclose(np.linalg.norm(np.asarray(longer.joints["C"].points[0]) - points), 2.7, rtol=1e-15)
    assert np.abs(close(longer).psi).max() < 1e-12
    assert abs(float(state.q[0, 2] - crank.angle)) < 0.3 and abs(float(state.q[coupler, 0])) < 3


def test_bodies_that_no_pin_joins_to_the_ground_follow_their_own_first():
    cart = udk.Mechanism(
        {"cart": udk.Body(1.0, 0.5), "bob": udk.Body(1.0, 0.1, (0.0, -1.0))},
        {
            "guide": udk.Prismatic((udk.GROUND, "cart"), [(0.0, 0.0), (0.0, 0.0)], axis=0.0),
            "pin": udk.Revolute(("cart", "bob"), [(0.0, 0.0), (0.0, 1.0)]),
        },
    )
    turned = udk.with_angle(cart, "bob", np.pi / 2)
    assert_allclose(turned.q0, [[0.0, 0.0, 0.0], [1.0, 0.0, np.pi / 2]], atol=1e-15)


def test_the_derivative_of_a_reshaped_guess_is_that_of_one_built_so():
    linkage = udk.library.parallelogram()

    @jax.jit
    @jax.jacfwd
    def slopes(x):
        reshaped = udk.with_angle(udk.with_length(linkage, LINKS, x), LINKS, 0.3 * x)
        return reshaped.q0, udk.library.parallelogram(0.3 * x, length=x).q0

    assert_allclose(*slopes(1.2), atol=1e-14)


def test_what_has_no_length_or_name_is_refused():
    pendulum = udk.library.compound_pendulum()
    (body,) = pendulum.body_names
    with pytest.raises(udk.SceneError, match=f'body "{body}" has no length: it is attached at fewer than two points'):
        udk.with_length(pendulum, body, 2.0)
    with pytest.raises(udk.SceneError, match='no body named "lnik1"; did you mean "link1"'):
        udk.with_angle(udk.library.parallelogram(), "lnik1", 0.0)
