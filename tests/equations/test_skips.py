"""Programs contain only operations that the scene needs: counts of operations."""

import dataclasses

import jax.numpy as jnp
import pytest

import udkjax as udk
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.programs.unrolled import Unrolled, UnrolledProgram
from udkjax.equations.rows.analysis import analyse
from udkjax.expressions.loops.loop_derivative import FORWARD, REVERSE
from udkjax.pinv.rank_policy import RankPolicy

GROUND = "ground"
PAIR = 51  # operations that a sine and a cosine take together, where they are arithmetic
ACCELERATIONS = "a", "safe"
TANGENT_PART = "dq1", "dv1", "distance"
CHOICES = ("gt", "ge", "and", "select_n")


def programs(mechanism, policy=RankPolicy.DROP, baumgarte=False, analysis=None):
    """The programs of the scene, without redundant rows."""
    return scene_programs(mechanism, (analysis or analyse(mechanism)).redundant_rows or (), baumgarte, policy)


def unrolled(mechanism, outputs=ACCELERATIONS, **choices) -> UnrolledProgram:
    return Unrolled(programs(mechanism, **choices), [outputs]).program(*outputs)


def right_hand_side(mechanism, outputs=ACCELERATIONS, **choices):
    """Count the operations of each kind in the accelerations, or in another program."""
    return unrolled(mechanism, outputs, **choices).program.count()


def uses(mechanism, array, **choices) -> list[int]:
    """The numbers of an array that the accelerations depend on."""
    program, inputs, _ = unrolled(mechanism, **choices)
    return [k for s, (name, k) in zip(program.inputs, inputs, strict=True) if name == array and program.uses(s)]


def arithmetic(counts) -> int:
    return sum(n for name, n in counts.items() if name not in (*CHOICES, "sincos"))


def trigonometry(counts) -> dict[str, int]:
    return {name: n for name, n in counts.items() if name in ("sincos", "exp", "tanh", "tan", "atan2")}


def uses_time(mechanism) -> bool:
    return bool(uses(mechanism, "t"))


def joined(mechanism, joints=None, drivers=None, forces=None):
    joints, drivers = mechanism.joints | (joints or {}), mechanism.drivers | (drivers or {})
    return udk.Mechanism(mechanism.bodies, joints, drivers, mechanism.forces | (forces or {}))


@pytest.fixture(scope="module")
def plain(linkage):
    return right_hand_side(linkage)


@pytest.fixture(scope="module")
def rod():
    """A pendulum rod, hung at one end."""
    return udk.Mechanism({"rod": udk.Body(1.0, 0.1, [0.5, 0.0])}, {"A": udk.Revolute((GROUND, "rod"), [[0.0, 0.0], [-0.5, 0.0]])})


# --- the paper's linkage


def test_the_papers_linkage_pinned(linkage, plain):
    """11 rows in 12 coordinates: one reciprocal for each pivot, no other division, and no root. Decide before you allow more."""
    assert plain["div"] == plain["gt"] == plain["select_n"] == 11  # is the pivot small?
    assert "sqrt" not in plain
    assert trigonometry(plain) == {"sincos": 4}  # one pair a body
    assert arithmetic(plain) <= 520
    assert arithmetic(Unrolled(programs(linkage), [ACCELERATIONS]).prologue.count()) <= 40  # what parameters alone determine


# --- what a scene does not have


def test_a_body_in_free_fall_takes_no_operation():
    """a_F is constant, the mass cancels, and nothing else remains."""
    assert arithmetic(right_hand_side(udk.Mechanism({"stone": udk.Body(2.0, 0.1)}))) == 0


def test_without_drivers_time_is_not_used(linkage):
    assert not uses_time(linkage)
    driven = joined(linkage, drivers={"motor": udk.Driver((GROUND, "link1"), "angle", udk.Polynomial([0.0, 1.0, 0.5]))})
    assert not uses_time(driven)  # gamma of an angle that is quadratic in time is a number
    assert uses_time(joined(linkage, drivers={"motor": udk.Driver((GROUND, "link1"), "angle", udk.Sine(1.0, 2.0))}))


def test_a_driver_costs_its_own_derivatives_only(rod):
    """A motor of constant speed has no second derivative: it adds one row to eliminate, no time, and no sine except the rod's."""
    even = joined(rod, drivers={"motor": udk.Driver((GROUND, "rod"), "angle", udk.Polynomial([0.0, 1.0]))})
    sine = joined(rod, drivers={"motor": udk.Driver((GROUND, "rod"), "angle", udk.Sine(1.0, 2.0))})
    counts = [right_hand_side(m) for m in (rod, even, sine)]
    assert arithmetic(counts[0]) < arithmetic(counts[1]) < arithmetic(counts[2])
    assert not uses_time(even)
    assert [trigonometry(c) for c in counts] == [{"sincos": 1}, {"sincos": 1}, {"sincos": 2}]


@pytest.mark.parametrize(
    ("less", "more"),
    [
        (None, udk.TorsionSpring((GROUND, "rod"), 3.0)),
        (udk.TorsionSpring((GROUND, "rod"), 3.0), udk.TorsionSpring((GROUND, "rod"), 3.0, 0.2)),
        (None, udk.Force("rod", [0.0, 1.0], [0.1, 0.0])),
        (udk.Force("rod", [0.0, 1.0]), udk.Force("rod", [0.0, 1.0], frame="body")),
        (
            udk.Spring((GROUND, "rod"), [[0.0, 1.0], [0.5, 0.0]], 3.0, 0.5),
            udk.Spring((GROUND, "rod"), [[0.0, 1.0], [0.5, 0.0]], 3.0, 0.5, 0.2),
        ),
    ],
    ids=["spring", "its damper", "force", "in the body's axes", "damper of a spring"],
)
def test_a_force_element_adds_operations_and_its_absence_none(rod, less, more):
    counts = [arithmetic(right_hand_side(joined(rod, forces={"f": f} if f is not None else {}))) for f in (less, more)]
    assert counts[0] < counts[1]
    if less is None:
        assert counts[0] == arithmetic(right_hand_side(rod))


def test_a_body_without_dampers_is_not_asked_for_its_velocity():
    spring = lambda *damping: {"s": udk.TorsionSpring((GROUND, "wheel"), 3.0, *damping)}  # noqa: E731
    for forces, used in ((spring(), False), (spring(0.1), True)):
        assert bool(uses(udk.Mechanism({"wheel": udk.Body(1.0, 0.1)}, forces=forces), "v")) == used


def test_without_stabilization_psi_and_its_rate_are_not_evaluated(linkage, plain):
    """For hinges, only Psi contains positions of centres of mass, and only Psi_dot contains their velocities."""
    for baumgarte in (False, True):
        for x in "qv":
            assert any(k % 3 < 2 for k in uses(linkage, x, baumgarte=baumgarte)) == baumgarte
    stabilized = right_hand_side(linkage, baumgarte=True)
    assert arithmetic(stabilized) >= arithmetic(plain) + 4 * 11  # two products and two sums a row, and Psi and Psi_dot
    assert trigonometry(stabilized) == trigonometry(plain)


# --- redundancy


class Exponential(udk.Joint):
    """Equal angles, written with an exponential so that its evaluation can be counted."""

    def residual(self, t, *frames):
        one, two = frames
        return [jnp.exp(two.angle - one.angle) - 1.0]


def test_a_row_left_out_is_never_computed():
    """Both joints require equal angles. The second is left out, and with it the exponential."""
    two = joined(
        udk.Mechanism({"rod": udk.Body(1.0, 0.1), "bar": udk.Body(1.0, 0.1, [1.0, 0.0])}),
        joints={"A": udk.Revolute((GROUND, "rod"), [[0.0, 0.0], [0.0, 0.0]]), "same": udk.Angle(("rod", "bar"))},
    )
    three = joined(two, joints={"again": Exponential(("rod", "bar"))})
    assert analyse(three).redundant_rows == (3,)
    assert right_hand_side(three) == right_hand_side(two)
    assert "exp" in right_hand_side(three, analysis=dataclasses.replace(analyse(three), redundant_rows=()))


@pytest.mark.parametrize("outputs", [ACCELERATIONS, ("q1", "safe"), TANGENT_PART], ids="-".join)
@pytest.mark.parametrize("copies", [2, 3])
@pytest.mark.parametrize("baumgarte", [False, True], ids=["", "Baumgarte"])
def test_a_duplicated_joint_adds_no_operation(linkage, copies, baumgarte, outputs):
    more = {f"{joint} {k}": linkage.joints[joint] for joint in linkage.joints for k in range(1, copies)}
    one, other = (right_hand_side(m, outputs, baumgarte=baumgarte) for m in (linkage, joined(linkage, joints=more)))
    assert one == other


def test_pivots_that_are_refused_are_only_asked_about(linkage, plain):
    """With DROP each pivot is compared and selected; with REFUSE the comparisons are only combined."""
    refusing = right_hand_side(linkage, policy=RankPolicy.REFUSE)
    assert sum(refusing.values()) == sum(plain.values()) - plain["select_n"] + plain["gt"] - 1


# --- structure


@pytest.mark.parametrize(
    "mechanism, pivots, most",
    [(udk.library.parallelogram(), 11, 7), (udk.library.chain(10), 20, 12), (udk.library.excavator(), 12, 8)],
    ids=["parallelogram", "chain", "excavator"],
)
def test_pivots_that_need_not_wait_for_each_other_do_not(mechanism, pivots, most):
    """A division takes several times as long as the operations between two divisions: chains of them limit a single run."""
    found = programs(mechanism, RankPolicy.REFUSE)
    program, row = unrolled(mechanism, policy=RankPolicy.REFUSE).program, {}
    for index in program.order:
        node = program.graph.nodes[index]
        row[index] = max((row.get(a.index, 0) for a in node.arguments), default=0) + (node.kind == "div")
    assert found.row_count - len(found.redundant_rows or ()) == pivots <= program.count()["div"]
    assert max(row[s.index] for s in program.outputs) <= most


def test_parts_that_do_not_touch_are_solved_apart(rod):
    """Three times the operations, not 27 times."""
    pin = [[0.0, 0.0], [-0.5, 0.0]]
    bodies = {name: udk.Body(1.0, 0.1, [0.5, 0.0]) for name in ("one", "two", "three")}
    apart = udk.Mechanism(bodies, {name: udk.Revolute((GROUND, name), pin) for name in bodies})
    assert arithmetic(right_hand_side(apart)) == 3 * arithmetic(right_hand_side(rod))


def test_a_chain_of_loops_grows_linearly():
    counts = [arithmetic(right_hand_side(udk.library.n_four_bar(n))) for n in (2, 4, 6)]
    assert counts[2] - counts[1] < 1.2 * (counts[1] - counts[0])


def test_the_end_of_a_step_factorizes_once(linkage, plain):
    """For velocities, accelerations and two changes: 11 reciprocals of the pivots, and one of the distance."""
    step = right_hand_side(linkage, ("v1", "a at v1", "safe", *TANGENT_PART))
    assert step["div"] == 12
    assert sum(step.values()) <= 2.5 * sum(plain.values())  # four linear systems instead of one


def test_numbers_that_change_make_no_other_code(linkage):
    heavier = linkage.with_parameters({"body.link1.mass": 1.5, "gravity": jnp.array([0.0, -3.0])})
    assert programs(heavier) is programs(linkage)


# --- derivatives


def derivative(mechanism, outputs=("a",), mode=FORWARD, numbers=()):
    """Count the operations of each kind in an evaluation with intermediate results, and in the derivative."""
    found = programs(mechanism)
    active = [k in numbers for k in range(found.number_count)]
    both = Unrolled(found, [], [outputs], active, mode).derivative(*outputs)
    return tuple(x.program.count() for x in both)


@pytest.mark.parametrize(("mode", "most"), [(FORWARD, 0.55), (REVERSE, 0.55)])
def test_a_derivative_takes_half_of_what_the_accelerations_take_and_factorizes_nothing(linkage, plain, mode, most):
    evaluation, further = derivative(linkage, mode=mode)
    more = arithmetic(evaluation) - arithmetic(plain)  # what the derivative needs to know
    assert arithmetic(further) + more <= most * (arithmetic(plain) + PAIR * plain["sincos"])
    assert not {"div", "sqrt", "sincos"} & set(further)
    assert evaluation["div"] == 11


def test_only_what_moves_is_differentiated(linkage):
    counts = [arithmetic(derivative(linkage, numbers=range(k))[1]) for k in (0, 2, 8)]
    assert 0 < counts[0] < counts[1] < counts[2]


def test_a_driver_that_is_not_differentiated_adds_only_its_row(rod):
    """Time is constant along q and v: the motor's motion has no derivatives beyond those in the accelerations."""
    motor = joined(rod, drivers={"motor": udk.Driver((GROUND, "rod"), "angle", udk.Sine(1.0, 2.0))})
    assert trigonometry(derivative(motor)[0]) == trigonometry(right_hand_side(motor))


def test_a_projection_is_differentiated_by_one_further_factorization(linkage):
    """At the projected state."""
    assert sum(counts.get("div", 0) for counts in derivative(linkage, ("q1", "v1 at q1"))) == 11
