"""Parameters of overconstrained mechanisms that may vary."""

import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.calls import calls_of
from udkjax.equations.rows.position_rows import PositionRows
from udkjax.equations.rows.redundancy import kinematic_rows
from udkjax.scene.elements.couplings import Gear
from udkjax.scene.elements.joints import Revolute
from udkjax.study.identify.problem import loop_consistency
from udkjax.study.identify.problem.loop_consistency import loop_problems, tie_text


def lengths(*groups):
    """Make each value the common length of a group of bodies."""

    def apply(mechanism, x):
        for k, bodies in enumerate(groups):
            mechanism = udk.with_length(mechanism, bodies, x[k])
        return mechanism

    return apply


def numbers(*names):
    return lambda mechanism, x: mechanism.with_parameters({name: x[k] for k, name in enumerate(names)})


def asked(mechanism, *names):
    """Return the problems found if these numbers of a scene may vary."""
    return loop_problems(mechanism, numbers(*names), [entry(mechanism.parameters(), name) for name in names], names)


def entry(values, name):
    owner, *index = name.removesuffix("]").replace("][", "[").split("[")
    return float(np.asarray(values[owner])[tuple(map(int, index))])


ALL = 'joints "A1", "A2", "A3", "B1", "B2" and "B3" form a loop'


CHOICES = [lengths("link1", "link2", "link3"), lengths(("link1", "link2", "link3"))]  # each by itself; one for all


@pytest.fixture(scope="module")
def problems(linkage):
    """Return the problems of three separate cranks, and of three with a common length."""
    return [loop_problems(linkage, apply, [1.0] * n, "abc"[:n]) for apply, n in zip(CHOICES, (3, 1), strict=True)]


def test_three_cranks_must_stay_equal(problems):
    (problem,) = problems[0]
    assert problem == f"a, b and c cannot vary independently: {ALL} that only closes for a = b = c; tie them, or keep them fixed"


def test_sparse_arithmetic_says_the_same(linkage, problems, monkeypatch):
    monkeypatch.setattr(loop_consistency, "kinematic_rows", lambda mechanism: kinematic_rows(mechanism, large=True))
    assert [loop_problems(linkage, apply, [1.0] * n, "abc"[:n]) for apply, n in zip(CHOICES, (3, 1), strict=True)] == problems
    assert len(problems[0]) == 1 and problems[1] == []


@pytest.mark.parametrize("groups", [(("link1", "link2"), "link3"), (("link1", "link3"), "link2")])
def test_two_tied_and_one_free_are_refused(linkage, groups):
    (problem,) = loop_problems(linkage, lengths(*groups), [1.0, 1.0], ["two", "one"])
    assert "two and one cannot vary independently" in problem and "only closes for two = one; tie them" in problem


def test_all_three_tied_are_legal_and_so_are_masses(linkage):
    def apply(mechanism, x):
        mechanism = udk.with_length(mechanism, ("link1", "link2", "link3"), x[0])
        return mechanism.with_parameters({"body.link1.mass": x[1], "body.coupler.inertia": x[2], "gravity": x[3:]})

    assert loop_problems(linkage, apply, [1.0, 3.0, 0.3, 0.0, -9.81], ["l", "m", "I", "gx", "gy"]) == []


def test_of_masses_nothing_is_looked_at(linkage):
    with calls_of(PositionRows.sample) as sampled:
        assert asked(linkage, "body.link1.mass", "gravity[1]") == []
    assert sampled == []


def test_one_crank_alone_is_refused(linkage):
    (problem,) = loop_problems(linkage, lengths("link2"), [1.0], ["length(link2)"])
    assert problem.startswith("length(link2) cannot vary by itself: joints")
    assert problem.endswith("keep it fixed, or tie it to the parameters that must vary with it")


def test_first_guesses_that_open_a_loop_are_refused(linkage):
    (problem,) = loop_problems(linkage, lengths("link1", "link2", "link3"), [1.0, 1.2, 1.0], ["a", "b", "c"])
    assert problem.startswith("the first guesses of a, b and c open a loop")


def test_legal_to_first_order_is_not_enough(linkage):
    """Cranks of l + d, l and l - d change Psi along the left null space by d^2, at every position."""

    def apply(mechanism, x):
        return lengths("link1", "link3")(mechanism, [1.0 + x[0], 1.0 - x[0]])

    for name in ("link1", "link3"):
        assert loop_problems(linkage, lengths(name), [1.0], ["one of them"])
    (problem,) = loop_problems(linkage, apply, [0.0], ["d"])
    assert problem.startswith("d cannot vary by itself")
    # A pin beside its crank's line: longer by the square of the distance.
    (problem,) = asked(linkage, "joint.A1.points[1][1]")
    assert "cannot vary by itself" in problem


def triangle():
    """Three equal cranks on the corners of a triangle carry a triangle of the same size, which closes along all of the motion."""
    corners, angle = [(0.0, 0.0), (1.0, 0.8), (2.0, 0.0)], 0.9
    e = jnp.array([np.cos(angle), np.sin(angle)])
    bodies = {f"link{i}": udk.Body(1.0, 0.1, jnp.array(c) + 0.5 * e, angle) for i, c in enumerate(corners)}
    bodies["plate"] = udk.Body(2.0, 0.2, jnp.array([1.0, 0.3]) + e, 0.0)
    joints = {f"A{i}": Revolute(("ground", f"link{i}"), [c, (-0.5, 0.0)]) for i, c in enumerate(corners)}
    joints |= {f"B{i}": Revolute(("plate", f"link{i}"), [(x - 1.0, y - 0.3), (0.5, 0.0)]) for i, (x, y) in enumerate(corners)}
    return udk.Mechanism(bodies, joints), np.array(corners) - [1.0, 0.3], angle


def test_a_tie_that_is_legal_at_one_position_only_is_refused(monkeypatch):
    """A larger plate with cranks just long enough to reach it at the first angle, where their lines then meet in one point.

    There the mechanism closes, and its rank is what it was: to first order, at that position, nothing is wrong.
    """
    mechanism, arms, angle = triangle()
    assert len(udk.analyse(mechanism).redundant) == 1
    e = np.array([np.cos(angle), np.sin(angle)])

    def apply(mechanism, x):
        cranks = [jnp.linalg.norm(e + x[0] * arm) for arm in arms]
        mechanism = lengths("link0", "link1", "link2")(mechanism, cranks)
        return mechanism.with_parameters({f"joint.B{i}.points[0]": (1.0 + x[0]) * arm for i, arm in enumerate(arms)})

    (problem,) = loop_problems(mechanism, apply, [0.0], ["larger"])
    assert "larger cannot vary by itself" in problem
    monkeypatch.setattr(loop_consistency.RedundantLoops, "_closes", lambda *_: True)
    assert loop_problems(mechanism, apply, [0.0], ["larger"]) == [problem]
    monkeypatch.setattr(PositionRows, "sample", lambda rows, q: [rows.close(0.0, q)])
    assert loop_problems(mechanism, apply, [0.0], ["larger"]) == []


def test_cranks_under_a_triangle_must_stay_equal():
    mechanism, _, _ = triangle()
    (problem,) = loop_problems(mechanism, lengths("link0", "link1", "link2"), [1.0] * 3, ["a", "b", "c"])
    assert "only closes for a = b = c" in problem


def test_pivots_move_with_the_coupler(linkage):
    a, b = "joint.A3.points[0][0]", "joint.B3.points[0][0]"
    (problem,) = asked(linkage, a, b)
    assert f"only closes for {a} and {b} changing by the same amount; tie them" in problem
    (problem,) = asked(linkage, "joint.B1.points[0][0]", b)
    assert "cannot vary, neither independently nor together" in problem and problem.endswith("keep them fixed")
    # A third one that has no partner stays fixed.
    (problem,) = asked(linkage, a, b, "joint.B1.points[0][0]")
    assert problem.endswith("tie them, and keep joint.B1.points[0][0] fixed")


def test_gears_on_two_axles_keep_their_ratio():
    bodies = {"one": udk.Body(1.0, 0.1, (0.0, 0.0)), "two": udk.Body(1.0, 0.1, (0.6, 0.0))}
    axles = {name: Revolute(("ground", name), [body.position, (0.0, 0.0)]) for name, body in bodies.items()}
    wheels = {"pair": Gear(("one", "two"), (0.2, 0.4)), "second pair": Gear(("one", "two"), (0.1, 0.2))}
    mechanism = udk.Mechanism(bodies, axles | wheels)
    names = ["joint.pair.radii[0]", "joint.second pair.radii[0]"]
    (problem,) = asked(mechanism, *names)
    assert 'joints "pair" and "second pair" form a loop' in problem
    assert f"only closes for {names[0]} and {names[1]} in proportion 1 : 0.5; tie them" in problem
    assert asked(mechanism, "joint.one.points[0][0]", "joint.two.points[1][0]") == []  # wheels mesh wherever their axles are


def test_bars_of_a_scissor_lift_stay_equal_in_pairs():
    lift = udk.library.scissor_lift(1)
    names = ("rising0", "falling0")
    (problem,) = loop_problems(lift, lengths(*names), [1.0, 1.0], names)
    assert "only closes for rising0 = falling0" in problem and '"guide"' in problem
    assert loop_problems(lift, lengths(names), [1.0], ["both"]) == []


def test_loops_of_which_none_is_overconstrained_move_freely(compilations):
    """Four-bars in series have dependent rows only in singular configurations: nothing is checked."""
    bars = udk.library.n_four_bar(3)
    assert udk.analyse(bars).redundant_rows == ()
    apply = lengths("link0", "link1", "coupler2")
    assert compilations(lambda: loop_problems(bars, apply, [1.0, 1.0, 1.0], ["a", "b", "c"])) == []
    assert loop_problems(bars, apply, [1.0, 1.0, 1.0], ["a", "b", "c"]) == []


def test_loops_side_by_side_are_told_apart(linkage):
    """Two linkages in one scene have their own ties, and name their own joints."""
    bodies, joints = {}, {}
    for k in (0, 1):
        bodies |= {f"{name}/{k}": body for name, body in linkage.bodies.items()}
        for name, joint in linkage.joints.items():
            ends = tuple(b if b == "ground" else f"{b}/{k}" for b in joint.bodies)
            joints[f"{name}/{k}"] = Revolute(ends, joint.points)
    both = udk.Mechanism(bodies, joints)
    cranks = [f"{i}/{k}" for i in (1, 2, 3) for k in (0, 1)]

    def apply(mechanism, x):
        ends = {"A": -0.5, "B": 0.5}
        half = {f"joint.{pin}{n}.points[1][0]": end * x[i] for i, n in enumerate(cranks) for pin, end in ends.items()}
        return mechanism.with_parameters(half)

    problems = loop_problems(both, apply, [1.0] * 6, cranks)
    assert len(problems) == 2
    for k, problem in enumerate(problems):
        assert f"only closes for 1/{k} = 2/{k} = 3/{k};" in problem
        assert f'"A1/{k}"' in problem and f'"A1/{1 - k}"' not in problem


def test_texts_of_ties():
    names = ["a", "b", "c"]
    assert tie_text(names, np.array([2.0, 2.0, 1.0]), np.array([1.0, 1.0, 0.0])) == "a = b"
    assert tie_text(names, np.array([1.0, 2.0, 0.5]), np.array([2.0, 4.0, 1.0])) == "a, b and c in proportion 1 : 2 : 0.5"
    assert tie_text(names, np.array([0.0, 2.0, 0.5]), np.array([3.0, 3.0, 3.0])) == "a, b and c changing by the same amount"
    assert tie_text(names, np.array([0.0, 2.0, 0.5]), np.array([2.0, -1.0, 0.0])) == "a and b changing in proportion 1 : -0.5"
