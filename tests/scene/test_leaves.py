"""Every number of a mechanism has one home: changes of leaves by JAX affect runs, printing and files alike."""

import copy
import pickle
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.choices import fast
from udkjax import library

TS = np.array([0.0, 0.1])
DRAWINGS = sorted((Path(__file__).parents[2] / "examples" / "drawings").glob("*.toml"))


def workshop():
    """A drawing with every kind of element, some with numbers given directly; it need not be able to move."""
    angle = np.linspace(0, 2 * np.pi, 7, endpoint=False)
    pins = {
        "O": (0, 0),
        "A": (0.3, 0.4),
        "B": (1.2, 0.8),
        "C": (1.5, 0),
        "P": (0.9, 1.1),
        "Q": (2, 0),
        "R": (2.4, 0),
        "S": (3, 0),
    }
    links = {
        "crank": udk.Link(["O", "A"], density=7850.0, width=0.04, thickness=0.01),
        "coupler": udk.Link(["A", "B", "P"], mass=2.0),
        "rocker": udk.Link(["C", "B"], mass=1.5, inertia=0.2, centre=(1.3, 0.5)),
        "wheel": udk.Link(["Q"], mass=1.0, width=0.4),
        "pinion": udk.Link(["R"], density=2700.0, width=0.2, thickness=0.02),
        "block": udk.Link(["S"], mass=0.7, outline=[(2.9, -0.1), (3.1, -0.1), (3.1, 0.1), (2.9, 0.1)]),
    }
    return udk.Drawing(
        pins,
        links,
        ground=["O", "C", "Q", "R"],
        slides={"guide": {"link": "block", "direction": 0.3}},
        slots={"groove": {"pin": "P", "direction": 0.2, "link": "coupler"}},
        gears={"mesh": {"links": ["wheel", "pinion"], "radii": [0.2, 0.2]}},
        cams={"contact": {"pins": ["Q", "S"], "profile": {"angle": angle, "radius": 1.0 + 0.1 * np.cos(angle)}}},
        motors={"motor": {"pin": "O", "speed": 2.0}, "torque": {"pin": "C", "torque": 0.4}},
        springs={"spring": {"between": ["B", "S"], "stiffness": 30.0, "damping": 0.1}, "turn": {"pin": "Q", "stiffness": 2.0}},
        dampers={"damper": {"between": ["P", "S"], "damping": 0.3}},
        loads={"load": {"pin": "B", "force": [1.0, -2.0]}, "twist": {"link": "rocker", "torque": 0.2}},
        bodies={"mass": udk.Body(2.0, 0.1, [4.0, 1.0], 0.1)},
        joints={"rod": udk.Distance(["ground", "mass"], [[4.0, 2.0], [0.0, 0.1]])},
        forces={"weight": udk.Force("mass", [0.0, -1.0])},
        velocities={"A": (-0.4, 0.3)},
        gravity=(0.0, -9.0),
        name="workshop",
    ).mechanism()


def changed_workshop():
    return workshop().with_parameters(
        {"body.crank.mass": 3.0, "joint.B.points[0][0]": 0.31, "driver.motor.motion.coefficients": [0.9, 1.5]}
    )


def four_bar():
    pins = {"A": (0.0, 0.0), "B": (0.5, 0.9), "C": (2.7, 2.0), "D": (2.5, 0.0)}
    crank = udk.Link(["A", "B"], density=7850.0, width=0.03, thickness=0.01)
    given = {"crank": crank, "coupler": udk.Link(["B", "C"], mass=2.5), "rocker": udk.Link(["D", "C"], mass=2.0)}
    return udk.Drawing(pins, given, ground=["A", "D"]).mechanism()


def changed_four_bar():
    return four_bar().with_parameters({"body.crank.mass": 5.0, "joint.B.points[0][0]": 0.52})


def geared_pendulum():
    """A pendulum that turns a wheel. The constant of the gear follows from the angles, whose initial values are not zero."""
    bodies = {"rod": udk.Body(1.0, 0.1, [0.5, 0.0], 0.3), "wheel": udk.Body(2.0, 0.2, [1.0, 1.0], -0.4)}
    pins = {
        "pin": udk.Revolute(["ground", "rod"], [[0, 0], [-0.5, 0]]),
        "axle": udk.Revolute(["ground", "wheel"], [[1, 1], [0, 0]]),
    }
    return udk.Mechanism(bodies, {**pins, "mesh": udk.Gear(["rod", "wheel"], [0.3, 0.2])})


SCENES = {name: getattr(library, name) for name in library.__all__} | {
    "workshop": workshop,
    "changed workshop": changed_workshop,
    "four-bar": four_bar,
    "changed four-bar": changed_four_bar,
    "geared pendulum": geared_pendulum,
    **{file.stem: partial(udk.load, file) for file in DRAWINGS},
}
scenes = pytest.mark.parametrize("name", fast(["changed four-bar", "planetary_gear"], SCENES))


def numbers(mechanism):
    """All numbers that a run uses, and gravity."""
    return np.concatenate([np.ravel(x) for x in mechanism.numbers])


def different(mechanism):
    """The mechanism with each of its leaves slightly changed."""
    leaves, tree = jax.tree.flatten(mechanism)
    rng = np.random.default_rng(3)
    return jax.tree.unflatten(tree, [x * (1 + 1e-5 * rng.uniform(size=x.shape)) + 1e-7 for x in leaves])


@scenes
def test_leaves_are_the_independent_numbers(name):
    mechanism = SCENES[name]()
    independent = mechanism.independent_parameters()
    assert {id(x) for x in jax.tree.leaves(mechanism)} == {id(x) for x in independent.values()}
    assert len(jax.tree.leaves(mechanism)) == len(independent)


@scenes
def test_each_leaf_changes_what_its_name_changes(name):
    """A number changed as a leaf, by name, or in a file gives the same mechanism, which also prints the same."""
    mechanism = SCENES[name]()
    leaves, tree = jax.tree.flatten(mechanism)
    places = {id(x): k for k, x in enumerate(leaves)}
    for key, value in mechanism.independent_parameters().items():
        new = value * (1 + 1e-6) + 3e-7
        leaf = jax.tree.unflatten(tree, [new if k == places[id(value)] else x for k, x in enumerate(leaves)])
        by_name = mechanism.with_parameters({key: new})
        assert_allclose(numbers(leaf), numbers(by_name), rtol=1e-13, atol=1e-15, err_msg=key)
        assert repr(leaf) == repr(by_name), key
        for x, y in zip(jax.tree.leaves(leaf), jax.tree.leaves(by_name), strict=True):
            assert_allclose(x, y, rtol=1e-15, err_msg=key)


@scenes
def test_a_changed_tree_is_saved_as_it_runs(name):
    changed = different(SCENES[name]())
    loaded = udk.loads(udk.dumps(changed))
    assert_allclose(numbers(loaded), numbers(changed), rtol=1e-14, atol=1e-15)
    assert repr(loaded) == repr(changed)
    for key, value in loaded.parameters().items():
        assert_allclose(value, changed.parameters()[key], rtol=1e-14, atol=1e-15, err_msg=key)


@scenes
def test_trees_are_taken_apart_and_put_together(name):
    changed = different(SCENES[name]())
    expected = numbers(changed)
    arrays, rest = eqx.partition(changed, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(changed)
    others = {
        "combine": eqx.combine(arrays, rest),
        "unflatten": jax.tree.unflatten(tree, leaves),
        "copy": copy.copy(changed),
        "deepcopy": copy.deepcopy(changed),
        "pickle": pickle.loads(pickle.dumps(changed)),
        "jit": jax.jit(lambda m: m)(changed),
        "tree_map": jax.tree.map(jnp.asarray, changed),
    }
    for how, other in others.items():
        assert_array_equal(numbers(other), expected, err_msg=how)
        assert jax.tree.structure(other) == tree, how
    traced = jax.jit(lambda m: jnp.concatenate([jnp.ravel(x) for x in m.numbers]))(changed)
    assert_allclose(traced, expected, rtol=1e-13, atol=1e-15)


@scenes
def test_stacked_mechanisms_are_mapped_and_printed(name):
    mechanism = SCENES[name]()
    pair = [mechanism, different(mechanism)]
    stacked = jax.tree.map(lambda *xs: jnp.stack(xs), *pair)
    found = jax.vmap(lambda m: jnp.concatenate([jnp.ravel(x) for x in m.numbers]))(stacked)
    assert_allclose(found, [numbers(m) for m in pair], rtol=1e-13, atol=1e-15)
    for key, value in stacked.parameters().items():
        assert_allclose(value, [m.parameters()[key] for m in pair], rtol=1e-13, atol=1e-15, err_msg=key)
    assert "numbers" in repr(stacked)


def end(mechanism):
    return udk.simulate(mechanism, TS).q[-1, 0, 2]


def test_what_is_given_is_changed_in_place_and_what_follows_is_refused():
    mechanism = four_bar()
    heavy = eqx.tree_at(lambda m: m.bodies["coupler"].mass, mechanism, jnp.asarray(3.0))
    assert float(heavy.drawing.links["coupler"].mass) == 3.0
    assert float(udk.loads(udk.dumps(heavy)).parameters()["body.coupler.mass"]) == 3.0
    moved = heavy.with_parameters({"pin.C": (2.71, 2.0)})
    assert float(moved.parameters()["body.coupler.mass"]) == 3.0
    placed = eqx.tree_at(lambda m: m.drawing.pins["B"], mechanism, jnp.array([0.5, 0.91]))
    assert_allclose(placed.bodies["crank"].position, [0.25, 0.455])
    lighter = eqx.tree_at(lambda m: m.gravity, mechanism, jnp.array([0.0, -1.6]))
    assert lighter.gravity[1] == -1.6 and "gravity [0, -1.6]" in repr(lighter)
    for where in (lambda m: m.bodies["crank"].mass, lambda m: m.joints["B"].points, lambda m: list(m.bodies.values())[1].inertia):
        with pytest.raises(
            udk.SceneError, match=r"(body|joint)\.\w+\.\w+ is not a leaf of the mechanism: it follows from the drawing"
        ):
            eqx.tree_at(where, mechanism, jnp.zeros(()))
    given = mechanism.with_parameters({"body.crank.mass": 5.0})
    for where in (lambda m: m.bodies["crank"].mass, lambda m: m.direct["body.crank.mass"]):
        assert eqx.tree_at(where, given, jnp.asarray(6.0)).with_parameters({"pin.B": (0.5, 0.91)}).bodies["crank"].mass == 6.0


def test_a_part_of_the_numbers_is_trained():
    """The usual way to freeze leaves: a tree of booleans that is True for the leaves to train."""
    mechanism = four_bar()
    chosen = jax.tree.map(lambda _: False, mechanism)
    chosen = eqx.tree_at(lambda m: (m.drawing.pins["B"], m.bodies["coupler"].mass), chosen, (True, True))
    trained, fixed = eqx.partition(mechanism, chosen)
    assert [x.shape for x in jax.tree.leaves(trained)] == [(2,), ()]
    slope = eqx.filter_grad(lambda t: jnp.sum(eqx.combine(t, fixed).bodies["coupler"].inertia))(trained)
    assert len(jax.tree.leaves(slope)) == 2 and repr(slope) and repr(trained)
    with pytest.raises(udk.SceneError, match="a part of its numbers is missing"):
        trained.bodies["crank"]


def test_mechanisms_that_share_arrays_keep_their_leaves_apart():
    mass = jnp.asarray(2.0, float)
    mechanism = four_bar().with_parameters({"link.coupler.mass": mass, "link.rocker.mass": mass})
    changed = eqx.tree_at(lambda m: m.bodies["coupler"].mass, mechanism, jnp.asarray(3.0))
    assert [float(changed.bodies[name].mass) for name in ("coupler", "rocker")] == [3.0, 2.0]


@pytest.mark.slow
@pytest.mark.parametrize("name", fast(["geared pendulum"], ["four-bar", "changed four-bar", "geared pendulum"]))
def test_derivatives_by_leaves(name):
    """Reverse mode over the whole mechanism, compared with differences of runs with one leaf changed, and by name."""
    mechanism = SCENES[name]()
    slopes = eqx.filter_jit(eqx.filter_grad(end))(mechanism).independent_parameters()
    run = jax.jit(end)
    for key, value in mechanism.independent_parameters().items():
        step = 1e-5 * np.maximum(np.abs(value), 0.1)
        for index in np.ndindex(*np.shape(value)):
            ends = [run(mechanism.with_parameters({key: value.at[index].add(s * step[index])})) for s in (1, -1)]
            assert_allclose(
                slopes[key][index], (ends[0] - ends[1]) / (2 * step[index]), rtol=1e-4, atol=3e-7, err_msg=f"{key}{index}"
            )


def test_invalid_leaves_are_named_where_they_are_used():
    """A step of an optimizer may make a mass negative, which is not checked before."""
    negative = eqx.tree_at(lambda m: m.drawing.links["coupler"].mass, four_bar(), jnp.asarray(-1.0))
    for use in (end, udk.dumps, udk.assemble):
        with pytest.raises(udk.SceneError, match=r'coupler" \(\w+\[1\]\)\.mass: must be > 0, not -1\.0'):
            use(negative)


def rod_on_a_string():
    """A rod by a string from its pin, with friction in the pin."""
    bodies = {"rod": udk.Body(1.0, 0.1, [0.5, 0.0]), "bob": udk.Body(1.0, 0.1, [1.5, 0.0])}
    joints = {"pin": udk.Revolute(["ground", "rod"], [[0, 0], [-0.5, 0]])}
    string = {"string": udk.Distance(["rod", "bob"], [[0.5, 0], [0, 0]], length=0.5)}
    rub = udk.Friction("pin", torque=0.1, velocity=0.1, coefficient=0.1, radius=0.01)
    return udk.Mechanism(bodies, joints | string, {}, {"rub": rub})


@pytest.mark.parametrize(
    ("make", "select", "place"),
    [
        (rod_on_a_string, lambda m: m.bodies["rod"].mass, r'body "rod" \(body\[0\]\)\.mass'),
        (rod_on_a_string, lambda m: m.bodies["bob"].inertia, r'body "bob" \(body\[1\]\)\.inertia'),
        (rod_on_a_string, lambda m: m.joints["string"].length, r'joint "string" \(joint\[1\]\)\.length'),
        (rod_on_a_string, lambda m: m.forces["rub"].velocity, r'force "rub" \(force\[0\]\)\.velocity'),
        (rod_on_a_string, lambda m: m.forces["rub"].radius, r'force "rub" \(force\[0\]\)\.radius'),
        (four_bar, lambda m: m.drawing.links["coupler"].mass, r'body "coupler" \(body\[1\]\)\.mass'),
    ],
)
def test_leaves_without_meaning_are_named_by_every_function(make, select, place):
    """Here as in a file, a negative mass or length is refused; a negative damping, as of finite differences, is not."""
    scene = make()
    run = udk.simulate(scene, TS)
    negative = eqx.tree_at(select, scene, jnp.asarray(-0.5))
    uses = {
        "simulate": lambda m: udk.simulate(m, TS),
        "simulate without throwing": lambda m: udk.simulate(m, TS, throw=False),
        "accelerations": lambda m: udk.accelerations(m, 0.0, m.q0, m.v0),
        "energy": lambda m: udk.energy(m, run),
        "analyse": udk.analyse,
        "assemble": udk.assemble,
    }
    for use in uses.values():
        with pytest.raises(udk.SceneError, match=f"{place}: must be > 0, not "):
            use(negative)
    code = eqx.filter_jit(lambda m: udk.simulate(m, TS, throw=False).code)(negative)
    assert code == udk.Result.invalid_argument


def test_a_concrete_leaf_without_meaning_beside_a_traced_one_is_an_invalid_argument():
    negative = eqx.tree_at(lambda m: m.joints["string"].length, rod_on_a_string(), jnp.asarray(-0.5))
    run = jax.jit(lambda g: udk.simulate(eqx.tree_at(lambda m: m.gravity, negative, g), TS, throw=False).code)
    assert run(jnp.array([0.0, -9.81])) == udk.Result.invalid_argument


def test_constants_of_gears_follow_from_their_radii(tmp_path):
    """If a radius is changed as a leaf, the run is the same as with a file that has this radius."""
    mechanism = library.planetary_gear()
    name = next(key for key in mechanism.parameters() if key.endswith(".radii"))
    joint = name.split(".")[1]
    changed = eqx.tree_at(lambda m: m.joints[joint].radii, mechanism, mechanism.joints[joint].radii * 1.01)
    udk.save(changed, tmp_path / "gear.toml")
    assert_array_equal(numbers(udk.load(tmp_path / "gear.toml")), numbers(changed))
    assert_array_equal(numbers(mechanism.with_parameters({name: changed.joints[joint].radii})), numbers(changed))
    with pytest.raises(
        udk.SceneError, match=r"joint\.[\w ]+\.constant is not a leaf of the mechanism: it follows from the initial guess"
    ):
        eqx.tree_at(lambda m: m.joints[joint].constant, mechanism, jnp.zeros(()))


def test_what_optax_trains_is_saved(tmp_path):
    mechanism, optimizer = four_bar(), optax.adam(1e-3)

    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def loss(m):
        return (end(m) - 1.0) ** 2

    state, first = optimizer.init(eqx.filter(mechanism, eqx.is_inexact_array)), float(loss(mechanism)[0])
    for _ in range(5):
        updates, state = optimizer.update(loss(mechanism)[1], state)
        mechanism = eqx.apply_updates(mechanism, updates)
    udk.save(mechanism, tmp_path / "trained.toml")
    loaded = udk.load(tmp_path / "trained.toml")
    assert float(loss(mechanism)[0]) == pytest.approx(float(loss(loaded)[0]), rel=1e-10) and float(loss(loaded)[0]) < 0.99 * first
    assert_allclose(numbers(loaded), numbers(mechanism), rtol=1e-14, atol=1e-15)
    scene = udk.simulate(mechanism, TS).to_xarray(mechanism).attrs["scene"]
    assert_array_equal(numbers(udk.loads(scene)), numbers(loaded))


def test_a_sweep_starts_from_the_changed_tree():
    heavy = eqx.tree_at(lambda m: m.bodies["coupler"].mass, four_bar(), jnp.asarray(3.0))
    data = udk.sweep(heavy, {"pin.B[0]": [0.5, 0.52]}, ts=TS, progress=False)
    for k, x in enumerate((0.5, 0.52)):
        assert_allclose(data["q_end"].values[k, 0, 2], end(heavy.with_parameters({"pin.B[0]": x})), rtol=1e-9)
