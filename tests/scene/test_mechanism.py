import dataclasses
import pickle
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax.scene as udk
from tests.calls import calls_of
from tests.elements import P
from udkjax.scene import library
from udkjax.scene.tables.checks import numbers_are_valid


def test_the_order_is_the_users(everything):
    assert list(everything.bodies) == ["b", "a", "c"]
    again = jax.tree.unflatten(jax.tree.structure(everything), jax.tree.leaves(everything))
    assert list(again.bodies) == ["b", "a", "c"]
    assert list(again.constraints) == [*everything.joints, *everything.drivers]
    assert list(again.constraints)[-5:] == ["turn", "push", "lift", "slide", "stretch"]
    assert hash(jax.tree.structure(again)) == hash(jax.tree.structure(everything))


def test_all_numbers_are_leaves(everything):
    leaves = jax.tree.leaves(everything)
    assert all(isinstance(leaf, jax.Array) and leaf.dtype == jnp.float64 for leaf in leaves)
    assert len(leaves) == len(everything.parameters())  # the constants of gears and racks follow from them


def test_state_of_the_initial_guess(everything):
    assert_allclose(everything.q0[0], [0.3, -0.2, 0.4])
    assert_allclose(everything.v0, [[0.1, 0.2, -0.3], [0, 0, 0], [0, 0, 0]])


def test_every_parameter_can_be_set_and_traced(everything):
    parameters = everything.parameters()
    changed = jax.jit(lambda p: everything.with_parameters({k: 1.5 * v for k, v in p.items()}).parameters())(parameters)
    assert changed.keys() == parameters.keys()
    for name, value in parameters.items():
        assert_allclose(changed[name], 1.5 * value, err_msg=name)


def test_same_numbers_same_mechanism(everything, same):
    assert same(everything.with_parameters(everything.parameters()), everything)


def test_one_entry_of_an_array(everything):
    new = everything.with_parameters({"joint.revolute.points[1][0]": 7.0, "driver.turn.motion.coefficients[1]": 8.0})
    assert_allclose(new.joints["revolute"].points, [P[0], [7.0, P[1][1]]])
    assert_allclose(new.drivers["turn"].motion.coefficients, [0.1, 8.0, -0.7, 0.2])
    both = everything.with_parameters({"gravity[0]": 1.0, "gravity": [2.0, 3.0]})  # the whole first, then its entry
    assert_allclose(both.gravity, [1.0, 3.0])


def test_under_vmap_and_grad(everything):
    masses = jnp.array([1.0, 2.0, 3.0])
    batch = jax.vmap(lambda m: everything.with_parameters({"body.b.mass": m}))(masses)
    assert_allclose(batch.bodies["b"].mass, masses)
    slope = jax.grad(lambda k: everything.with_parameters({"force.damped.damping": k}).forces["damped"].damping ** 2)(3.0)
    assert_allclose(slope, 6.0)


def test_it_can_be_made_of_traced_numbers():
    @jax.jit
    def length(mass, x):
        mech = udk.Mechanism(
            {"a": udk.Body(mass, 1.0, jnp.stack([x, 0.0]))}, {"rod": udk.Distance(["ground", "a"], jnp.zeros((2, 2)))}
        )
        return mech.joints["rod"].length

    assert_allclose(length(-1.0, 3.0), 3.0)  # values that are traced are not looked at
    assert_allclose(jax.grad(length, 1)(1.0, 3.0), 1.0)


def test_an_absent_damping_can_be_set(everything):
    assert "force.undamped.damping" not in everything.parameters()
    assert everything.forces["undamped"].damping is None
    assert_allclose(everything.with_parameters({"force.undamped.damping": 0.2}).forces["undamped"].damping, 0.2)


def test_the_constants_of_gears_follow_the_initial_guess(everything, psi):
    new = everything.with_parameters({"body.b.angle": 2.0, "joint.gear.radii": [0.3, 0.4]})
    assert_allclose(new.joints["gear"].constant, 0.3 * new.bodies["a"].angle + 0.4 * 2.0)
    assert new.joints["prismatic"].angle == everything.joints["prismatic"].angle  # an ordinary parameter since it was made


def test_traced_numbers_remember_the_concrete_ones_that_they_were_made_from(everything):
    seen = []

    @jax.jit
    def twice(mass):
        once = everything.with_parameters({"body.a.mass": mass})
        seen.extend([once.origin, once.with_parameters({"gravity": [0.0, 0.0]}).origin])
        return once.with_parameters({"body.b.mass": mass}).bodies["a"].mass

    twice(2.0)
    assert seen[0] is not None and seen[0] == seen[1] and seen[0].mechanism is everything
    assert everything.origin is None and everything.with_parameters({"body.a.mass": 2.0}).origin is None


@pytest.mark.parametrize("build", [library.four_bar, library.parallelogram], ids=["drawn", "elements"])
def test_numbers_that_were_never_checked_are_checked_with_others(build):
    """Functions on trees check nothing; a mechanism that is known to be valid needs only what differs to be checked."""
    mechanism = build()
    mass, other = (f"body.{name}.mass" for name in mechanism.body_names[:2])
    broken = eqx.tree_at(
        lambda m: m._source.gravity if build is library.parallelogram else m.drawing.gravity, mechanism, jnp.array([0.0, np.nan])
    )
    with pytest.raises(udk.SceneError, match=r"gravity.*must be finite"):
        broken.with_parameters({mass: 2.0})
    changed = mechanism.with_parameters({mass: 2.0}).with_parameters({other: 3.0})
    assert float(changed.bodies[mechanism.body_names[0]].mass) == 2.0
    where = re.escape(f'body "{mechanism.body_names[0]}" (body[0]).mass: must be > 0, not -2.0')
    for values in ({mass: -2.0}, {mass: -2.0, other: 1.0}, {mass: -2.0, "gravity": [0.0, -1.0]}):
        with pytest.raises(udk.SceneError, match=where):
            changed.with_parameters(values)
    with pytest.raises(udk.SceneError, match=r"gravity.*must be finite"):
        changed.with_parameters({"gravity": [0.0, np.inf]})


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"body.B.mass": 1.0}, 'no parameter "body.B.mass"; did you mean "body.b.mass"?'),
        ({"body.b.mas": 1.0}, 'no parameter "body.b.mas"; did you mean "body.b.mass"?'),
        ({"bodies": 1.0}, 'no parameter "bodies"'),
        ({"gravity": 1.0}, "gravity: must have the shape (2,), not ()"),
        ({"body.b.mass": [1.0]}, "body.b.mass: must have the shape (), not (1,)"),
        ({"joint.revolute.points[2][0]": 1.0}, "joint.revolute.points[2][0]: joint.revolute.points has the shape (2, 2)"),
        ({"driver.turn.points[0][0]": 1.0}, "driver.turn.points[0][0]: driver.turn.points is absent; set it as a whole"),
        ({"driver.turn.points": 1.0}, "driver.turn.points: must have the shape (2, 2), not ()"),
        ({"body.b.mass": "heavy"}, 'body.b.mass: must be a number or an array, not "heavy"'),
        ({"body.b.mass": -1.0}, 'body "b" (body[0]).mass: must be > 0, not -1.0'),
        ({"joint.gear.constant": 1.0}, 'no parameter "joint.gear.constant"'),
    ],
)
def test_wrong_parameters_are_refused(everything, values, problem):
    with pytest.raises(udk.SceneError) as caught:
        everything.with_parameters(values)
    assert [p for p in caught.value.problems if p.startswith(problem)] == caught.value.problems


def test_all_mistakes_at_once():
    o = [[0.0, 0.0], [0.0, 0.0]]
    mistaken: Any = "weld"
    misspelt: Any = "angel"
    with pytest.raises(udk.SceneError) as caught:
        udk.Mechanism(
            bodies={"ground": udk.Body(1, 1), "b": udk.Body(-1.0, np.nan, [1.0, 2.0, 3.0])},
            joints={"A": udk.Revolute(["grund", "b"], [[0.0, 0.0]]), "B": udk.Slot(["b", "b"], o, axis=0.0), "C": mistaken},
            drivers={"A": udk.Driver(["ground", "b"], misspelt, udk.Spline([0.0, 1.0, 1.0], [0.0, 1.0]))},
            forces={
                "f": udk.Friction("B", torque=-1.0, velocity=1.0),
                "g": udk.Friction("Q", torque=1.0, velocity=1.0),
                "h": udk.Force("ground", [1.0, 2.0]),
            },
            gravity=[0.0, np.inf],
        )
    assert sorted(caught.value.problems) == sorted(
        [
            "gravity[1]: must be finite, not inf",
            'body "ground" (body[0]).name: "ground" is the fixed frame; choose another name',
            'body "b" (body[1]).mass: must be > 0, not -1.0',
            'body "b" (body[1]).inertia: must be finite, not nan',
            'body "b" (body[1]).position: must be a list of 2 numbers, not [1.0, 2.0, 3.0]',
            'joint "A" (joint[0]).bodies[0]: no body named "grund"; did you mean "ground"?',
            'joint "A" (joint[0]).points: must be a list of 2 x 2 numbers, not [[0.0, 0.0]]',
            'joint "B" (joint[1]).bodies: "b" is connected to itself',
            'joint "C" (joint[2]): must be of class Joint, not a str',
            'driver "A" (driver[0]).name: taken by joint[0]; names must be unique',
            'driver "A" (driver[0]).coordinate: must be one of "angle", "x", "y", "distance", not "angel"; did you mean "angle"?',
            'driver "A" (driver[0]).motion.times[2]: must be greater than the entry before, not 1.0',
            'driver "A" (driver[0]).motion.values: must have 3 entries, like times, not [0.0, 1.0]',
            'force "f" (force[0]).torque: must be >= 0, not -1.0',
            'force "f" (force[0]).torque: a slot does not turn: give a coefficient',
            'force "g" (force[1]).joint: no joint named "Q"',
            'force "h" (force[2]).body: "ground" does not move; name a body',
        ]
    )
    assert all(problem in str(caught.value) for problem in caught.value.problems)


def test_forces_without_names():
    spring = udk.Spring(["ground", "a"], [[0, 0], [0, 0]], 1.0, 1.0)
    mech = udk.Mechanism({"a": udk.Body(1, 1)}, forces=[spring, udk.Force("a", [0, 1]), spring])
    assert list(mech.forces) == ["spring1", "force1", "spring2"]


class Lever(udk.Joint):
    ratio: float

    def residual(self, t, one, two):
        return [one.angle - self.ratio * two.angle]


class Wind(udk.ForceElement):
    drag: float
    exponent: int = eqx.field(static=True, default=1)

    def loads(self, t, body):
        return [(-self.drag * body.vx**self.exponent, 0.0, 0.0)]


def test_classes_of_ones_own(psi):
    mech = udk.Mechanism(
        {"a": udk.Body(1, 1, angle=0.6), "b": udk.Body(1, 1, angle=0.2)},
        {"lever": Lever(["a", "b"], 3), "double": Lever(bodies=("a", "b"), ratio=2.0)},
        forces={"wind": Wind("a", 0.5, exponent=3)},
    )
    assert_allclose(psi(mech, mech.q0), [0.0, 0.2], atol=1e-15)
    assert_allclose(mech.with_parameters({"joint.lever.ratio": 4.0, "force.wind.drag": 2}).parameters()["joint.lever.ratio"], 4.0)
    assert mech.frames_of(mech.forces["wind"]) == ("a",)
    assert jax.jit(lambda m: m.forces["wind"].drag)(mech) == 0.5


def test_classes_of_ones_own_that_cannot_work():
    class Idle(udk.ForceElement):
        pass

    class Loose(udk.Joint):
        kind: str

        def residual(self, t, *frames):
            return [0.0]

    with pytest.raises(udk.SceneError) as caught:
        udk.Mechanism({"a": udk.Body(1, 1)}, {"loose": Loose(["a", "c"], "x")}, forces={"idle": Idle(["a"])})
    assert caught.value.problems == [
        'force "idle" (force[0]): Idle must have a method `potential` or `loads`',
        'joint "loose" (joint[0]).bodies[1]: no body named "c"',
    ]


def test_it_can_be_sent_to_another_process(everything, same):
    assert same(pickle.loads(pickle.dumps(everything)), everything)
    error = pickle.loads(pickle.dumps(udk.SceneError(["one", "two"], "scene.toml")))
    assert error.problems == ["one", "two"]
    assert str(error) == str(udk.SceneError(["one", "two"], "scene.toml"))


def test_a_rod_of_no_length_is_refused_where_rounding_gives_it_one():
    """0.1 + 0.2 - 0.3 is 5.6e-17, whose direction is meaningless. A short rod in a scene of the same size is valid."""
    for x, place in ((0.1 + 0.2, 0.3), (1.0, 1.0 + 1e-15), (0.0, 0.0)):
        with pytest.raises(udk.SceneError, match=r"joint\[0\]\).length: must be > 0, and is 0.0 in the initial guess"):
            udk.Mechanism({"b": udk.Body(1.0, 0.1, [x, 0.0])}, {"rod": udk.Distance(["ground", "b"], [[place, 0.0], [0.0, 0.0]])})
    small = udk.Mechanism({"b": udk.Body(1.0, 0.1, [1e-17, 0.0])}, {"rod": udk.Distance(["ground", "b"], [[0.0, 0.0]] * 2)})
    assert float(small.joints["rod"].length) == 1e-17


def _requiring(element):
    """Iterate over the numbers of an element that must be positive or in order: the element that owns each, and its name."""
    for field in dataclasses.fields(element):
        value = getattr(element, field.name)
        if isinstance(value, eqx.Module):
            yield from _requiring(value)
        elif value is not None and any(need.strict for need in field.metadata.get("require", ())):
            yield element, field.name


def test_traced_numbers_are_checked_as_concrete_ones_are(everything):
    """A number that must be positive is not; numbers that must increase do not."""
    hold = jax.jit(lambda element: numbers_are_valid([element]))
    found = [one for element in everything.elements for one in _requiring(element)]
    assert len({(type(owner), name) for owner, name in found}) >= 11
    for owner, name in {(type(owner), name): (owner, name) for owner, name in found}.values():
        assert hold(owner)
        assert not hold(eqx.tree_at(lambda x, name=name: getattr(x, name), owner, -getattr(owner, name)))


def test_what_takes_nothing_from_the_guess_is_not_completed_again():
    """A change of one number causes no work for the hundreds of rods of a truss, whose lengths are given."""
    pair = ["a", "b"]
    joints = {
        "rod": udk.Distance(pair, P),
        "weld": udk.Weld(pair, P),
        "slide": udk.Prismatic(pair, P, axis=0.1),
        "turn": udk.Angle(pair),
    }
    bodies = {"a": udk.Body(1.0, 1.0), "b": udk.Body(1.0, 1.0, [1.0, 0.0], 0.2)}
    mechanism = udk.Mechanism(bodies, joints)
    with calls_of(udk.Distance.complete, udk.Weld.complete) as completed:
        changed = mechanism.with_parameters({"body.a.mass": 2.0})
        assert_allclose(changed.joints["rod"].length, mechanism.joints["rod"].length)
        assert completed == []
        udk.Mechanism(bodies, {"rod": udk.Distance(pair, P)})
        assert completed != []


def test_numbers_do_not_change_with_the_arrays_they_were_given_as():
    """JAX may use the memory of an array that lies at a multiple of 64 bytes."""
    memory = np.zeros(64)
    position = memory[(-memory.ctypes.data % 64) // 8 :][:2]
    body = udk.Body(1.0, 0.1, position)
    position[...] = 7.0
    assert np.array_equal(body.position, [0.0, 0.0])


def test_methods_are_trees_of_the_numbers_of_their_mechanism():
    """As those of every Equinox module: a program of a method takes the numbers as arguments."""
    mechanism = library.compound_pendulum()
    for method in (mechanism.parameters, mechanism.with_drivers, mechanism._table):  # of `Model`, of `Mechanism`, replaced there
        assert [id(x) for x in jax.tree.leaves(method)] == [id(x) for x in jax.tree.leaves(mechanism)]
        assert method.__name__ and method.__doc__ == getattr(type(mechanism), method.__name__).__doc__
        assert pickle.loads(pickle.dumps(method)).__name__ == method.__name__
    traced: Any = jax.jit(lambda method: method()["body.rod.mass"])  # JAX does not document _cache_size
    for mass in (1.0, 2.0):
        assert_allclose(traced(mechanism.with_parameters({"body.rod.mass": mass}).parameters), mass)
    assert traced._cache_size() == 1


def test_methods_of_users_elements_may_be_replaced_and_abstract():
    class Pull(udk.ForceElement):
        law: Any = eqx.field(static=True, default=np.sin)  # a function that is a number's default is no method

        def size(self, t):
            return self.law(t)

        def loads(self, t, frame):
            return [(self.size(t), 0.0, 0.0)]

    class Twice(Pull):
        def size(self, t):
            return 2.0 * super().size(t)

    assert_allclose(Twice(["b"]).loads(0.3, None)[0][0], 2.0 * np.sin(0.3))
    assert jax.tree.leaves(Twice(["b"]).size) == []
    with pytest.raises(TypeError, match="abstract"):
        udk.Motion()  # pyright: ignore[reportAbstractUsage]
