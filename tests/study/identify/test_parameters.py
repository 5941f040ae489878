"""Targets, text forms and allowed values of parameters."""

import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.scene.reshaping import length_of
from udkjax.study.identify.problem.parameters import unknowns_of
from udkjax.study.identify.problem.unknowns import apply_values


def _values(mechanism, unknowns, x):
    return apply_values(mechanism, unknowns.targets, jnp.asarray(x)).parameters()


def test_a_number_of_the_scene(linkage):
    u = unknowns_of(linkage, ["body.coupler.mass", "gravity[1]"])
    assert u.names == ("body.coupler.mass", "gravity[1]") and u.units == ("kg", "m/s2")
    assert u.kinds == ("positive", "free")
    found = _values(linkage, u, [3.0, -1.6])
    assert found["body.coupler.mass"] == 3.0 and found["gravity"].tolist() == [0.0, -1.6]


def test_an_array_is_as_many_parameters_as_it_has_entries(linkage):
    u = unknowns_of(linkage, ["joint.A1.points"])
    assert u.names == tuple(f"joint.A1.points[{i}][{j}]" for i in range(2) for j in range(2))
    assert np.allclose(_values(linkage, u, u.guess)["joint.A1.points"], linkage.joints["A1"].points)


@pytest.mark.parametrize(
    "text",
    [
        "length(link1) = length(link2) = length(link3)",
        "link1.length = link2.length = link3.length",
        "length(link1, link2, link3)",
    ],
)
def test_the_length_of_several_links(linkage, text):
    u = unknowns_of(linkage, text)
    assert u.units == ("m",) and u.kinds == ("positive",) and u.guess == pytest.approx([1.0])
    longer = apply_values(linkage, u.targets, jnp.array([1.2]))
    assert [float(length_of(longer, body)) for body in ("link1", "link2", "link3")] == pytest.approx([1.2] * 3)
    assert u.targets == unknowns_of(linkage, [udk.length("link1", "link2", "link3")]).targets


def test_ties_and_a_shared_factor(linkage):
    u = unknowns_of(linkage, ["body.link1.mass = body.link2.mass", "scale(body.link3.mass, body.coupler.mass)"])
    before, after = linkage.parameters(), _values(linkage, u, [0.7, 1.5])
    assert after["body.link1.mass"] == after["body.link2.mass"] == 0.7
    for body in ("link3", "coupler"):
        assert after[f"body.{body}.mass"] == pytest.approx(1.5 * before[f"body.{body}.mass"])


def test_a_function_with_a_start(linkage):
    def denser(mechanism, factor):
        return mechanism.with_parameters({"body.coupler.mass": factor * 2.0, "body.coupler.inertia": factor * 0.5})

    u = unknowns_of(linkage, [udk.Parameter(denser, guess=1.0, bounds=(0.1, 9.0))])
    assert u.names == ("denser",) and u.kinds == ("bounded",)
    assert _values(linkage, u, [2.0])["body.coupler.inertia"] == 1.0


def test_parameters_are_put_in_one_after_another(linkage):
    u = unknowns_of(linkage, ["body.link1.mass", udk.length("link1", "link2", "link3", as_rod=True), "body.link2.mass"])
    found = _values(linkage, u, [0.5, 2.0, 0.25])
    assert found["body.link1.mass"] == pytest.approx(1.0) and found["body.link2.mass"] == 0.25


@pytest.fixture(scope="module")
def kinds(linkage):
    p = udk.Parameter
    return unknowns_of(
        linkage,
        ["body.link1.mass", p("body.link2.mass", bounds=(0.5, 4.0)), p("joint.B1.points[1][0]"), p("gravity[0]", scale=3.0)],
    )


def test_unknowns_begin_at_zero_and_are_read_back(kinds):
    assert kinds.kinds == ("positive", "bounded", "free", "free")
    assert kinds.values(np.zeros(4)) == pytest.approx(kinds.guess)
    z = np.random.default_rng(0).normal(size=(5, 4))
    assert kinds.z_of(kinds.values(z)) == pytest.approx(z)


def test_slopes_against_differences(kinds):
    z, h = np.random.default_rng(1).normal(size=(7, 4)), 1e-6
    differences = (kinds.values(z + h) - kinds.values(z - h)) / (2 * h)
    assert kinds.dx_dz(z) == pytest.approx(differences, rel=1e-8)
    differences = (kinds.dx_dz(z + h) - kinds.dx_dz(z - h)) / (2 * h)
    assert kinds.d2x_dz2(z) == pytest.approx(differences, rel=1e-7, abs=1e-9)


def test_what_values_may_be(kinds):
    far = kinds.values(np.array([[-50.0, -50.0, 0.0, 0.0], [50.0, 50.0, 0.0, 0.0]]))
    assert (far[:, 0] > 0).all() and far[:, 1] == pytest.approx([0.5, 4.0])
    assert kinds.at_bounds(far[1]) == ("body.link2.mass",) and kinds.at_bounds(kinds.guess) == ()


def test_every_mistake_is_told(linkage):
    p = udk.Parameter
    wrong = [
        "body.link1.maß",
        "length(link9)",
        "length(link1) = body.link1.mass",
        p("body.link1.mass", bounds=(2.0, 3.0)),
        p("body.link2.mass", prior=(1.0, 0.0)),
        p("gravity[1]", transform="positive"),
        p(lambda mechanism, x: mechanism),
        "body.link3.mass",
        "body.link3.mass = body.coupler.mass",
    ]
    with pytest.raises(udk.IdentificationError) as error:
        unknowns_of(linkage, wrong)
    told = "\n".join(error.value.problems)
    for part in ('"body.link1.maß"', "link9", "another kind", "bounds", "deviation", "must be > 0", "guess=", "tie them"):
        assert part in told, part
    with pytest.raises(udk.IdentificationError, match="the list is empty"):
        unknowns_of(linkage, [])
