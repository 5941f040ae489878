"""What a scene doesn't need is not computed: shown by what the lowered programs contain, not by their timing.

A program is lowered to StableHLO, and its operations are counted, one for each number that an operation computes. `arithmetic`
are the floating-point operations proper (add, subtract, multiply, divide, negate, absolute value, powers and roots); sines and
cosines, comparisons and selections are counted apart. The sine and cosine of one angle, `sincos`, are one function, called once
for each pair: it is not entered, its own operations are not among those counted. A program that holds a loop, a branch or a
routine of a library cannot be counted like this; `operations` refuses it, which says that there is none.
"""

import dataclasses
import math
import re
from collections import Counter
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import udkjax as udk
from udkjax import GROUND
from udkjax.equations import prepare
from udkjax.equations.rank_policy import REFUSE
from udkjax.straightline.trigonometry import sincos

ARITHMETIC = (
    *("add", "subtract", "multiply", "divide", "negate", "abs", "sqrt", "rsqrt", "cbrt", "power", "maximum", "minimum"),
    *("floor", "round_nearest_even", "xor", "shift_left"),
)
TRIGONOMETRY = ("sincos", "sine", "cosine", "tan", "tanh", "atan2", "exponential", "log")
PAIR = 51  # operations in `sincos`, on numbers and, for signs, on their bits
CHOICES = ("compare", "select", "clamp", "and", "or", "not", "reduce")
MOVES = (
    "constant reshape slice concatenate broadcast_in_dim convert bitcast_convert optimization_barrier transpose branch".split()
)
NAME = r'@"?([^"(\s]+)"?'  # of a function
ELIMINATION = udk.Elimination()


def lowered(function, *arguments) -> str:
    return jax.jit(lambda *a: function(*a)).lower(*arguments).as_text()


def functions(text: str) -> dict[str, list[str]]:
    """The lines of each function of a module, by its name."""
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        if match := re.match(rf"\s*func\.func .*?{NAME}\(", line):
            current = found[match[1]] = []
        if found:
            current.append(line)
    return found


def results(line: str) -> int:
    """How many numbers an operation computes; of several results of one shape, how many each holds."""
    sizes = re.findall(r"tensor<((?:\d+x)*)\w+>", line.split("->")[-1] if "->" in line else line.rsplit(":", 1)[-1])
    return math.prod(int(n) for n in sizes[-1].split("x") if n) if sizes else 1


def operations(text: str) -> Counter:
    """How many numbers each kind of operation computes, those of a function as often as it is called; moves are left out."""
    lines = functions(text)

    @cache
    def inside(name: str) -> Counter:
        found = Counter()
        for line, after in zip(lines[name][1:], [*lines[name][3:], "", ""], strict=True):
            if match := re.match(rf"\s*(?:%\S+ = )?(?:func\.)?call {NAME}\(", line):
                found.update({"sincos": results(line)} if match[1].startswith("_sincos") else inside(match[1]))
            elif match := re.match(r'\s*%\S+ = "?(\w+)\.(\w+)', line):
                # Of a loop for as long as the value it begins with is true, a branch, the text holds the body once.
                once = match[2] == "while" and re.match(r"\s*stablehlo\.return %iterArg\w* : tensor<i1>$", after)
                found["branch" if once else match[2]] += results(line)
        return found

    found = Counter(inside("main"))
    unknown = set(found) - {*ARITHMETIC, *TRIGONOMETRY, *CHOICES, *MOVES}
    assert not unknown, f"cannot be counted: {unknown}"
    return Counter({name: n for name, n in found.items() if name not in MOVES})


def arithmetic(text: str) -> int:
    return sum(operations(text)[name] for name in ARITHMETIC)


def trigonometry(text: str) -> dict[str, int]:
    return {name: n for name, n in operations(text).items() if name in TRIGONOMETRY}


def right_hand_side(mechanism, method=ELIMINATION, baumgarte=None, analysis=None, **choices) -> str:
    """a(t, q, v) with the mechanism's numbers known: what is left is what every evaluation computes."""
    equations = prepare(mechanism, method, baumgarte, analysis=analysis)
    q, v = mechanism.q0.ravel(), mechanism.v0.ravel()
    return lowered(lambda t, q, v: equations.accelerations(t, q, v, **choices), 0.1, q, v)


def uses_time(text: str) -> bool:
    """Whether anything is computed from the first argument; what is merely handed on to a function counts if that uses it."""
    lines = functions(text)

    def used(name: str, variable: str) -> bool:
        for line in lines[name][1:]:
            if not re.search(rf"{variable}\b", line.split("=", 1)[-1]):
                continue
            called = re.search(rf"call {NAME}\(([^)]*)\)", line)
            moved = re.match(r"\s*(%\S+) = stablehlo\.(convert|reshape) ", line)
            if called:
                places = [k for k, a in enumerate(called[2].split(", ")) if a == variable]
                if any(used(called[1], f"%arg{k}") for k in places):
                    return True
            elif not moved or used(name, moved[1]):
                return True
        return False

    return used("main", "%arg0")


def joined(mechanism, *, joints=None, drivers=None, forces=None, name=""):
    """The mechanism with further elements."""
    return udk.Mechanism(
        dict(mechanism.bodies),
        {**mechanism.joints, **(joints or {})},
        {**mechanism.drivers, **(drivers or {})},
        {**mechanism.forces, **(forces or {})},
        mechanism.gravity,
        name,
    )


@pytest.fixture(scope="module")
def linkage():
    return udk.library.parallelogram()


@pytest.fixture(scope="module")
def plain(linkage):
    return right_hand_side(linkage)


@pytest.fixture(scope="module")
def rod():
    """One pendulum rod, hung at its end."""
    return udk.Mechanism({"rod": udk.Body(1.0, 0.1, [0.5, 0.0])}, {"A": udk.Revolute((GROUND, "rod"), [[0.0, 0.0], [-0.5, 0.0]])})


# --- the counter itself


def test_the_counter_counts_numbers_not_lines():
    text = lowered(lambda x: (jnp.sin(x) * 2.0 + x, -x[0], jax.lax.select(x > 0, x, x)), jnp.ones(5))
    found = operations(text)
    assert {k: found[k] for k in ("sine", "multiply", "add", "negate", "select", "compare")} == {
        "sine": 5, "multiply": 5, "add": 5, "negate": 1, "select": 5, "compare": 5,
    }  # fmt: skip
    assert arithmetic(text) == 11


def test_the_counter_enters_functions_as_often_as_they_are_called():
    double = jax.jit(lambda x: x + x)
    text = lowered(lambda x: double(double(x)) * 3.0, jnp.ones(5))
    assert operations(text) == {"add": 10, "multiply": 5}


@pytest.mark.parametrize(
    ("function", "used"),
    [
        (lambda t, x: x + 1.0, False),
        (lambda t, x: jax.jit(lambda t, x: jax.jit(lambda t, x: x + 1.0)(t, x))(t, x), False),
        (lambda t, x: jax.jit(lambda t, x: jax.jit(lambda t, x: x + t)(t, x))(t, x), True),
        (lambda t, x: jnp.reshape(t, (1,)) * x, True),
    ],
)
def test_the_use_of_time_is_followed_into_functions(function, used):
    assert uses_time(jax.jit(function, keep_unused=True).lower(0.1, jnp.ones(1)).as_text()) == used


def test_a_pair_is_counted_once_an_angle_and_holds_nothing_but_arithmetic():
    text = lowered(lambda x: (sincos(x), sincos(2.0 * x)[1]), jnp.ones(5))
    assert operations(text) == {"sincos": 10, "multiply": 5}
    (name,) = [name for name in functions(text) if name.startswith("_sincos")]
    within = operations(text.replace(name, "pair"))
    assert not set(within) & set(TRIGONOMETRY)
    assert sum(within[name] for name in ARITHMETIC) - 5 <= 10 * PAIR


def looped(x):
    return jax.lax.fori_loop(0, 2, lambda i, y: y + x, x)


@pytest.mark.parametrize("function", [jnp.linalg.inv, jnp.sort, lambda x: x @ x, looped])
def test_the_counter_refuses_what_it_cannot_count(function):
    with pytest.raises(AssertionError):
        operations(lowered(function, jnp.ones((3, 3))))


# --- the paper's linkage


def test_the_papers_linkage_takes_fewer_than_a_thousand_operations(linkage):
    """With all numbers traced: what parameters alone determine (12 roots and reciprocals) is included."""
    known = udk.analyse(linkage)
    a = lambda mech, t, q, v: udk.accelerations(mech, t, q, v, method=udk.Elimination(), analysis=known)  # noqa: E731
    text = lowered(a, linkage, 0.0, linkage.q0, linkage.v0)
    assert arithmetic(text) <= 1000
    assert trigonometry(text) == {"sincos": 4}  # one pair a body


def test_the_papers_linkage_pinned(linkage, plain):
    """11 rows in 12 coordinates: a reciprocal a pivot, nothing else divides, no root is left to the run. More is a decision."""
    found = operations(plain)
    assert found["divide"] == 11
    assert found["sqrt"] == 0
    assert found["compare"] == found["select"] == 11  # is the pivot small?
    assert arithmetic(plain) <= 520


def test_the_lowered_program_is_the_counted_one(linkage, plain):
    program = prepare(linkage, ELIMINATION).code.program("accelerations").count()
    found = operations(plain)
    names = {"mul": "multiply", "sub": "subtract", "div": "divide", "gt": "compare", "select_n": "select"}
    for name, n in program.items():
        # a negative output takes a sign and a zero output nothing: they are not operations of the graph
        assert found[names.get(name, name)] == n, name
    assert found["negate"] <= 12


def test_the_compiler_repeats_little_of_it(linkage, plain):
    """Without barriers it computes everything before an output anew for each of them: ten times the operations."""
    equations = prepare(linkage, ELIMINATION)
    rhs = jax.jit(lambda t, q, v: equations.accelerations(t, q, v)).lower(0.0, linkage.q0.ravel(), linkage.v0.ravel())
    cost = rhs.compile().cost_analysis()
    assert cost
    assert cost["flops"] <= 1.6 * (arithmetic(plain) + PAIR * operations(plain)["sincos"])
    assert not cost.get("transcendentals")


# --- what a scene does not have


def test_a_body_in_free_fall_takes_no_operation():
    """a_F is a constant, its mass cancels, and there is nothing else."""
    text = right_hand_side(udk.Mechanism({"stone": udk.Body(2.0, 0.1)}))
    assert arithmetic(text) == 0 and trigonometry(text) == {}


def test_gravity_alone_makes_a_constant_free_acceleration(linkage):
    equations = prepare(linkage, ELIMINATION)
    assert all(s.node.depends <= {"parameter"} for s in equations.code.equations.free)


def test_without_drivers_time_is_not_used(linkage, plain):
    assert not uses_time(plain)
    driven = joined(linkage, drivers={"motor": udk.Driver((GROUND, "link1"), "angle", udk.Polynomial([0.0, 1.0, 0.5]))})
    assert not uses_time(right_hand_side(driven))  # gamma of an angle that is quadratic in time is a number
    turned = joined(linkage, drivers={"motor": udk.Driver((GROUND, "link1"), "angle", udk.Sine(1.0, 2.0))})
    assert uses_time(right_hand_side(turned))


def test_a_driver_costs_its_own_derivatives_only(rod):
    """A motor that turns evenly has no second derivative: one row more to eliminate, no time, and no sine but the rod's."""
    even = joined(rod, drivers={"motor": udk.Driver((GROUND, "rod"), "angle", udk.Polynomial([0.0, 1.0]))})
    sine = joined(rod, drivers={"motor": udk.Driver((GROUND, "rod"), "angle", udk.Sine(1.0, 2.0))})
    counts = [arithmetic(right_hand_side(m)) for m in (rod, even, sine)]
    assert counts[0] < counts[1] < counts[2]
    assert not uses_time(right_hand_side(even))
    assert trigonometry(right_hand_side(even)) == trigonometry(right_hand_side(rod)) == {"sincos": 1}
    assert trigonometry(right_hand_side(sine)) == {"sincos": 2}


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
        equations = prepare(udk.Mechanism({"wheel": udk.Body(1.0, 0.1)}, forces=forces), ELIMINATION)
        program = equations.code.program("accelerations")
        assert any(program.uses(v) for v in equations.code.equations.v) == used


def test_without_stabilization_psi_and_its_rate_are_not_evaluated(linkage, plain):
    """Of hinges, only Psi holds positions of centres of mass, and only Psi_dot holds their velocities."""
    code = {b: prepare(linkage, ELIMINATION, udk.Baumgarte(5.0, 5.0) if b else None).code for b in (False, True)}
    for baumgarte, used in ((False, False), (True, True)):
        program, e = code[baumgarte].program("accelerations"), code[baumgarte].equations
        assert any(program.uses(e.q[3 * k + i]) for k in range(4) for i in (0, 1)) == used
        assert any(program.uses(e.v[3 * k + i]) for k in range(4) for i in (0, 1)) == used
    stabilized = right_hand_side(linkage, baumgarte=udk.Baumgarte(5.0, 5.0))
    assert arithmetic(stabilized) >= arithmetic(plain) + 4 * 11  # two products and two sums a row, and Psi and Psi_dot
    assert trigonometry(stabilized) == trigonometry(plain)


def test_multipliers_and_energies_only_where_asked_for(linkage):
    """Multipliers of redundant constraints take singular values: a routine of a library, which `operations` refuses."""
    q, v = linkage.q0, linkage.v0
    without = lowered(lambda q, v: udk.accelerations(linkage, 0.0, q, v, ELIMINATION), q, v)
    constants = prepare(linkage, ELIMINATION).code.prologue.count()
    assert arithmetic(without) <= arithmetic(right_hand_side(linkage)) + sum(constants.values()) + 1
    with pytest.raises(AssertionError):
        operations(lowered(lambda q, v: udk.accelerations(linkage, 0.0, q, v, ELIMINATION, multipliers=True), q, v))
    equations = prepare(linkage, ELIMINATION)
    squares = equations.code.equations.kinetic_energy
    assert squares.index in equations.code.program("energy").order
    assert squares.index not in equations.code.program("accelerations").order


# --- redundancy


class Exponential(udk.Joint):
    """Equal angles, written so that it shows."""

    def residual(self, t, *frames):
        one, two = frames
        return [jnp.exp(two.angle - one.angle) - 1.0]


def test_a_row_left_out_is_never_computed(rod):
    """Both joints say that the angles are equal. The second is left out, and with it the exponential."""
    two = joined(
        udk.Mechanism({"rod": udk.Body(1.0, 0.1), "bar": udk.Body(1.0, 0.1, [1.0, 0.0])}),
        joints={"A": udk.Revolute((GROUND, "rod"), [[0.0, 0.0], [0.0, 0.0]]), "same": udk.Angle(("rod", "bar"))},
    )
    three = joined(two, joints={"again": Exponential(("rod", "bar"))})
    assert udk.analyse(three).redundant_rows == (3,)
    assert operations(right_hand_side(three)) == operations(right_hand_side(two))
    assert "exponential" in trigonometry(
        right_hand_side(three, analysis=dataclasses.replace(udk.analyse(three), redundant_rows=()))
    )


@pytest.mark.parametrize("copies", [2, 3])
@pytest.mark.parametrize("baumgarte", [None, udk.Baumgarte(2.0, 2.0)], ids=["", "Baumgarte"])
def test_a_duplicated_joint_adds_no_operation(linkage, plain, copies, baumgarte):
    more = {f"{name} {k}": joint for name, joint in linkage.joints.items() for k in range(1, copies)}
    duplicated = right_hand_side(joined(linkage, joints=more), baumgarte=baumgarte)
    assert operations(duplicated) == operations(plain if baumgarte is None else right_hand_side(linkage, baumgarte=baumgarte))


def test_a_duplicated_joint_adds_no_operation_to_the_projection(linkage):
    more = {f"{name} again": joint for name, joint in linkage.joints.items()}
    for name in ("nearer", "tangential"):
        counts = [prepare(m, ELIMINATION).code.program(name).count() for m in (linkage, joined(linkage, joints=more))]
        assert counts[0] == counts[1], name


def test_rows_left_out_are_watched_only_where_asked_for(linkage):
    auto = prepare(linkage, udk.Auto()).code
    watched, plain = (sum(auto.program(name).count().values()) for name in ("accelerations_watched", "accelerations"))
    assert plain < watched < plain + 100
    dropping = prepare(linkage, ELIMINATION).code.program("accelerations").count()  # which chooses at each pivot
    assert plain == sum(dropping.values()) - dropping["select_n"] + dropping["gt"] - 1  # and asks about all of them


def test_auto_is_elimination_and_a_branch(linkage, plain):
    """What an integrator evaluates at its stages holds no branch and no singular values: the same operations as Elimination's."""
    equations = prepare(linkage, udk.Auto())
    q, v = linkage.q0.ravel(), linkage.v0.ravel()
    quick = lowered(lambda t, q, v: equations.with_policy(REFUSE).accelerations(t, q, v), 0.0, q, v)
    assert arithmetic(quick) == arithmetic(plain)
    assert "stablehlo.case" not in quick
    assert "stablehlo.case" in lowered(lambda t, q, v: equations.accelerations(t, q, v), 0.0, q, v)


# --- structure


@pytest.mark.parametrize(
    "mechanism, pivots, most",
    [(udk.library.parallelogram(), 11, 7), (udk.library.chain(10), 20, 12), (udk.library.excavator(), 12, 8)],
    ids=["parallelogram", "chain", "excavator"],
)
def test_pivots_that_need_not_wait_for_each_other_do_not(mechanism, pivots, most):
    """A division takes several times as long as what is between two of them: those in a row are what a single run waits for."""
    code = prepare(mechanism, udk.Auto()).code
    program, row = code.program("accelerations"), {}
    for index in program.order:
        node = program.graph.nodes[index]
        row[index] = max((row.get(a.index, 0) for a in node.arguments), default=0) + (node.kind == "div")
    assert len(code.kept) == pivots <= program.count()["div"]
    assert max(row[s.index] for s in program.outputs) <= most


def test_parts_that_do_not_touch_are_solved_apart(rod):
    """Twice the operations, not eight times."""
    pin = [[0.0, 0.0], [-0.5, 0.0]]
    bodies = {name: udk.Body(1.0, 0.1, [0.5, 0.0]) for name in ("one", "two", "three")}
    apart = udk.Mechanism(bodies, {name: udk.Revolute((GROUND, name), pin) for name in bodies})
    assert arithmetic(right_hand_side(apart)) == 3 * arithmetic(right_hand_side(rod))


def test_a_chain_of_loops_grows_linearly():
    counts = [arithmetic(right_hand_side(udk.library.n_four_bar(n))) for n in (2, 4, 6)]
    assert counts[2] - counts[1] < 1.2 * (counts[1] - counts[0])


def test_a_step_of_a_projection_factorizes_once(linkage):
    """In position and velocity at once, and all steps are rounds of one loop: 11 reciprocals, of the pivots."""
    equations = prepare(linkage, ELIMINATION)
    text = lowered(lambda t, q, v: equations.project(t, q, v), 0.0, linkage.q0.ravel(), linkage.v0.ravel())
    assert text.count("stablehlo.divide") == 11
    step, a = (sum(equations.code.program(name).count().values()) for name in ("nearer", "accelerations"))
    assert step <= 1.5 * a  # with a choice at each pivot, and for two residuals


def test_numbers_that_change_do_not_compile_anew(linkage):
    calls = 0

    @eqx.filter_jit
    def a(mechanism):
        nonlocal calls
        calls += 1
        return udk.accelerations(mechanism, 0.0, mechanism.q0, mechanism.v0, ELIMINATION)

    first = a(linkage)
    heavier = linkage.with_parameters({"body.link1.mass": 1.5, "gravity": jnp.array([0.0, -3.0])})
    assert not jnp.allclose(a(heavier), first)
    assert calls == 1
    assert prepare(heavier, ELIMINATION).code is prepare(linkage, ELIMINATION).code


# --- derivatives


def pushed(mechanism, directions=None) -> str:
    """a and its tangents along q and v: in one direction, or in several at once."""
    equations, at = prepare(mechanism, ELIMINATION), (mechanism.q0.ravel(), mechanism.v0.ravel())
    push = lambda dots, *at: jax.jvp(lambda q, v: equations.accelerations(0.1, q, v), at, dots)  # noqa: E731
    if directions is None:
        return lowered(push, at, *at)
    dots = tuple(jnp.ones((directions, *x.shape)) for x in at)
    return lowered(jax.vmap(push, (0, None, None), (None, 0)), dots, *at)


def sensitivity(mechanism, *names) -> int:
    """How many operations the tangent of a along some parameters adds to those of a."""
    q, v, parameters = mechanism.q0.ravel(), mechanism.v0.ravel(), {name: mechanism.parameters()[name] for name in names}
    a = lambda p: prepare(mechanism.with_parameters(p), ELIMINATION).accelerations(0.1, q, v)  # noqa: E731
    both = lowered(lambda p, dp: jax.jvp(a, (p,), (dp,)), parameters, parameters)
    return arithmetic(both) - arithmetic(lowered(a, parameters))


def pulled(mechanism) -> str:
    """a and the cotangents of q and v."""
    equations = prepare(mechanism, ELIMINATION)

    def pull(w, q, v):
        a, back = jax.vjp(lambda q, v: equations.accelerations(0.1, q, v), q, v)
        return a, back(w)

    return lowered(pull, mechanism.q0.ravel(), mechanism.q0.ravel(), mechanism.v0.ravel())


def flops(text: str) -> int:
    return arithmetic(text) + PAIR * operations(text)["sincos"]


def test_a_tangent_takes_half_of_what_the_accelerations_take(linkage, plain):
    assert flops(pushed(linkage)) <= 1.5 * flops(plain)


def test_a_gradient_takes_half_of_what_the_accelerations_take(linkage, plain):
    assert flops(pulled(linkage)) <= 1.6 * flops(plain)


@pytest.mark.parametrize("text", [pushed, pulled], ids=["forward", "reverse"])
def test_a_derivative_factorizes_nothing(linkage, text):
    found = operations(text(linkage))
    assert found["divide"] == 11 and found["sincos"] == 4 and found["sqrt"] == 0


def test_further_directions_share_what_does_not_depend_on_them(linkage, plain):
    """The accelerations, and the coefficients of their tangents, are evaluated once."""
    found = {n: operations(pushed(linkage, n)) for n in (1, 2, 8)}
    counts = {n: sum(c[name] for name in ARITHMETIC) for n, c in found.items()}
    assert all(c["divide"] == 11 and c["sincos"] == 4 for c in found.values())
    assert counts[8] - counts[2] == 6 * (counts[2] - counts[1])
    assert counts[2] - counts[1] <= 0.4 * flops(plain)


def test_only_what_moves_is_differentiated(linkage, plain):
    one, two = (sensitivity(linkage, *names) for names in (["body.coupler.mass"], ["body.coupler.mass", "body.link2.inertia"]))
    assert 0 < one < two < arithmetic(pushed(linkage)) - arithmetic(plain)
    assert sensitivity(linkage, "body.link1.position") == 0  # of a guess, which the equations do not see


def test_a_tangent_of_the_velocity_alone_is_cheaper(linkage):
    equations, (q, v) = prepare(linkage, ELIMINATION), (linkage.q0.ravel(), linkage.v0.ravel())
    of_v = lowered(lambda q, v, dv: jax.jvp(lambda v: equations.accelerations(0.1, q, v), (v,), (dv,)), q, v, v)
    assert arithmetic(of_v) < 0.9 * arithmetic(pushed(linkage))


def test_a_driver_that_is_not_differentiated_adds_only_its_row(rod):
    """Along q and v, time does not move: of the motor's motion no derivative is taken beyond those in the accelerations."""
    motor = joined(rod, drivers={"motor": udk.Driver((GROUND, "rod"), "angle", udk.Sine(1.0, 2.0))})
    assert trigonometry(pushed(motor)) == trigonometry(right_hand_side(motor))


def test_a_projection_is_differentiated_by_one_further_factorization(linkage):
    """At the state that it returns."""
    equations = prepare(linkage, ELIMINATION)
    q, v = linkage.q0.ravel(), linkage.v0.ravel()
    project = lambda q, v: equations.project(0.0, q, v)  # noqa: E731
    value, both = lowered(project, q, v), lowered(lambda q, v: jax.jvp(project, (q, v), (v, q)), q, v)
    assert [text.count("stablehlo.divide") for text in (value, both)] == [11, 22]
    assert both.count("stablehlo.multiply") <= 2.1 * value.count("stablehlo.multiply")
