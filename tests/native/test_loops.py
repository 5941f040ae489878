"""The programs of scenes as loops, compared with the textbook; their derivatives, compared with differences."""

import dataclasses
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests import loops
from tests.choices import fast
from tests.run_programs import run
from udkjax.equations import constraints, loads
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.programs.differentiable_programs import PROJECTION_OUTPUTS
from udkjax.equations.programs.scene_arrays import constants_of
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.programs.unrolled import Unrolled
from udkjax.equations.rows.analysis import analyse
from udkjax.expressions.loops.loop_derivative import PREFIXES, TWICE, LoopDerivative
from udkjax.expressions.loops.loop_program import KernelLoop, Reset
from udkjax.native.code import processor
from udkjax.native.language.loops import LoopWriter
from udkjax.pinv.elimination_order import order_blocks
from udkjax.pinv.rank_policy import RankPolicy

O = ((0.0, 0.0), (0.0, 0.0))  # noqa: E741
TANGENT_PART = "dq1", "dv1", "distance"
END_OF_STEP = "v1", "a at v1", "safe", *TANGENT_PART
NOTHING = 1e-20  # a threshold of pivots below that of any that is more than rounding


def loaded() -> udk.Mechanism:
    """Joints, drivers and force elements of several kinds."""
    bodies = {f"b{k}": udk.Body(1.0 + 0.2 * k, 0.1 + 0.05 * k, [0.4 * k, 0.1], 0.2 * k, [0.1, -0.2 * k], 0.3) for k in range(6)}
    return udk.Mechanism(
        bodies,
        {
            "pin": udk.Revolute(["ground", "b0"], [[0.0, 0.0], [0.1, 0.2]]),
            "pin2": udk.Revolute(["b0", "b1"], [[0.3, 0.0], [-0.1, 0.2]]),
            "rod": udk.Distance(["b1", "b2"], [[0.1, 0.0], [0.1, 0.2]], 0.7),
            "slide": udk.Prismatic(["ground", "b3"], O, 0.4),
            "gear": udk.Gear(["b3", "b4"], [0.1, 0.3]),
            "slot": udk.Slot(["b4", "b5"], [[0.2, 0.0], [0.0, 0.1]], axis=0.3),
        },
        {"turn": udk.Driver(["ground", "b0"], "angle", udk.Sine(1.0, 2.0, 0.3))},
        {
            "spring": udk.Spring(["b1", "b4"], [[0.1, 0.0], [0.0, 0.2]], 30.0, 0.4, 0.3),
            "wind": udk.Force("b2", [1.0, 2.0], point=[0.1, 0.0]),
            "rub": udk.Friction("pin2", 0.3, 0.1),
        },
    )


SCENES = {
    "linkage": udk.library.parallelogram,
    "three four-bars": lambda: udk.library.n_four_bar(3),
    "chain": lambda: udk.library.chain(4),
    "scissor lift": udk.library.scissor_lift,
    "gears": udk.library.planetary_gear,
    "loaded": loaded,
    "free": lambda: udk.Mechanism({"stone": udk.Body(1.0, 0.3, [0.1, 0.2], 0.3)}),
}


@eqx.filter_jit  # operation by operation they are hundreds of programs
def textbook(mechanism, t, q, v, weights, gains=None, method=udk.SVD()):
    terms = {"psi": constraints.psi(mechanism, t, q), "psi_dot": constraints.psi_dot(mechanism, t, q, v)}
    terms |= {"psi_q": constraints.psi_q(mechanism, t, q)}
    return terms | {"a": uk.accelerations(mechanism, t, q, v, method, gains, weights)}


class At:
    """The programs of a scene at a state near its guess, run row by row."""

    def __init__(self, mechanism, baumgarte=None, every=False):
        redundant = analyse(mechanism).redundant_rows or ()
        gains = [] if baumgarte is None else [baumgarte.alpha, baumgarte.beta]
        code = scene_programs(mechanism, redundant, bool(gains), RankPolicy.FALL_BACK)
        self.code, self.mechanism = code.with_all_rows if every else code, mechanism
        state, random = udk.assemble(mechanism, throw=False), np.random.default_rng(1)
        n = self.code.coordinate_count
        self.t = 0.2
        self.q = np.ravel(state.q) + 1e-2 * random.standard_normal(n)
        self.v = np.ravel(state.v) + 0.3 * random.standard_normal(n)
        self.numbers = np.concatenate([np.ravel(x) for x in [*mechanism.at(self.t).numbers, *gains, NOTHING, NOTHING]])
        self.constants = np.zeros(len(self.code.constants))
        loops.run(self.code.prologue, {"numbers": self.numbers, "constants": self.constants})
        kept = [k for k in range(self.code.row_count) if every or k not in redundant]
        self.weights = np.isin(np.arange(self.code.row_count), kept).astype(float)

    @cached_property
    def textbook(self):
        return textbook(self.mechanism.without_origin, self.t, self.q, self.v, self.weights)

    def arrays(self, constants=None, q=None, v=None, **more):
        code = self.code
        found = {name: np.full(size, np.nan) for name, size in code.stored_sizes.items()}
        found |= {x: np.full(code.coordinate_count, np.nan) for x in ("a", "q1", "v1", "dq1", "dv1")}
        found |= {x: np.full(1, np.nan) for x in ("safe", "distance", "rank")}
        given = {"constants": self.constants, "t": np.array([self.t]), "q": self.q, "v": self.v}
        given |= {k: x for k, x in (("constants", constants), ("q", q), ("v", v)) if x is not None}
        found |= {x: np.full(code.row_count, np.nan) for x in ("psi", "psi_dot")}
        return found | given | {"terms": np.full(code.term_count, np.nan)} | more

    def run(self, *outputs, **given):
        found = self.arrays(**given)
        loops.run(self.code.of(*outputs), found)
        return found

    def value(self, outputs, constants, q, v, steps):
        """The results of a differentiable program; a projection takes `steps` steps."""
        if outputs == PROJECTION_OUTPUTS:
            for _ in range(steps):
                q = self.run("q1", constants=constants, q=q)["q1"]
            return np.append(q, self.run("v1", constants=constants, q=q, v=v)["v1"])
        found = self.arrays(constants, q, v)
        loops.run(self.code.differentiable.of(*outputs).program, found)
        return found[outputs[0]]

    def evaluated(self, outputs, q, v):
        """The arrays after a differentiable program."""
        found = self.arrays(q=q, v=v)
        loops.run(self.code.differentiable.of(*outputs).program, found)
        return found


@pytest.fixture(scope="module", params=fast(["linkage", "gears", "free"], SCENES))
def at(request):
    return At(SCENES[request.param]())


def test_accelerations_are_those_of_the_textbook(at):
    found, expected = at.run("a", "safe"), at.textbook["a"]
    assert_allclose(found["a"], expected, atol=1e-9 * max(1.0, np.abs(expected).max()))
    assert found["safe"] == 1


@pytest.mark.slow
def test_accelerations_with_baumgarte_are_those_of_the_textbook():
    gains = udk.Baumgarte(5.0, 7.0)
    at = At(loaded(), gains)
    expected = textbook(at.mechanism.without_origin, at.t, at.q, at.v, at.weights, gains)
    assert_allclose(at.run("a")["a"], expected["a"], atol=1e-8)


def test_residuals_are_those_of_the_textbook(at):
    assert_allclose(at.run("psi")["psi"], at.textbook["psi"], atol=1e-13)
    assert_allclose(at.run("psi_dot")["psi_dot"], at.textbook["psi_dot"], atol=1e-13)


def test_corrections_take_residuals_away(at):
    if not at.code.row_count:
        return
    kept = at.weights > 0
    root, A = uk.inverse_sqrt_mass(at.mechanism), np.asarray(at.textbook["psi_q"])[kept]
    D = A * root
    psi, rate = (np.asarray(x)[kept] for x in (at.textbook["psi"], at.run("psi_dot")["psi_dot"]))
    for output, x, residual in (("q1", at.q, psi), ("v1", at.v, rate)):
        expected = x - root * (np.linalg.pinv(D) @ residual)
        assert_allclose(at.run(output)[output], expected, atol=1e-9)


def test_what_is_tangential(at):
    random = np.random.default_rng(2)
    dq, dv = random.standard_normal((2, at.code.coordinate_count))
    found = at.run(*TANGENT_PART, dq=dq, dv=dv)
    again = at.run(*END_OF_STEP, dq=dq, dv=dv)
    A = np.asarray(at.textbook["psi_q"])[at.weights > 0]
    mass = np.asarray(loads.mass(at.mechanism))
    for name, given in (("dq1", dq), ("dv1", dv)):
        assert_allclose(A @ found[name], 0.0, atol=1e-10)
        left = mass * (given - found[name])  # a combination of rows
        combination = np.linalg.lstsq(A.T, left, rcond=None)[0] if len(A) else np.zeros(0)
        assert_allclose(A.T @ combination, left, atol=1e-9)
        assert_allclose(again[name], found[name], atol=1e-12)


def test_steps_with_care_take_all_rows():
    """Near singular configurations, rows that are redundant elsewhere are not, and others are."""
    at = At(udk.library.parallelogram(), every=True)
    flat = np.array([[0.5, 0.0, 0.0], [1.5, 0.0, 0.0], [2.5, 0.0, 0.0], [2.0, 0.0, 0.0]]).ravel()
    at.numbers[-2] = 1e-10
    loops.run(at.code.prologue, {"numbers": at.numbers, "constants": at.constants})
    still = np.zeros(at.code.coordinate_count)
    expected = textbook(at.mechanism.without_origin, at.t, flat, still, np.ones(at.code.row_count), None, udk.SVD(1e-6))
    assert_allclose(at.run("a", q=flat, v=still)["a"], expected["a"], atol=1e-8)
    ranks = at.run("a", q=flat, v=still)
    loops.run(at.code.of("rank"), ranks)
    assert ranks["rank"] == np.linalg.matrix_rank(expected["psi_q"])


DIFFERENTIABLE = [("a",), PROJECTION_OUTPUTS, ("q1",), ("v1",)]


def test_no_number_is_written_once_it_was_read():
    """Derivatives rely on this."""
    code = At(loaded()).code
    programs = [code.differentiable.of(*outputs).program for outputs in DIFFERENTIABLE]
    for program in programs:
        read: set[tuple[str, int]] = set()
        for part in program.parts:
            if isinstance(part, Reset):
                written = {(part.array, k) for k in range(part.start, part.start + part.count)}
                assert not written & read
                continue
            assert isinstance(part, KernelLoop)
            places = [
                [(part.array(s.array), s.offset + (0 if s.base is None else int(row[s.base]))) for s in slots]
                for row in part.table
                for slots in (part.kernel.inputs, part.kernel.outputs)
            ]
            for inputs, outputs in zip(places[::2], places[1::2], strict=True):
                used = [p for p, s in zip(inputs, part.kernel.program.inputs, strict=True) if part.kernel.program.uses(s)]
                read |= set(used)
                assert not {p for p in outputs if p[0] not in ("nearness", "trusted")} & read


def on_the_manifold(at):
    q, v = at.q, at.v
    for _ in range(6):
        q = at.run("q1", q=q)["q1"]
        v = at.run("v1", q=q, v=v)["v1"]
    return q, v


@pytest.mark.parametrize("outputs", DIFFERENTIABLE, ids="-".join)
def test_derivatives_against_differences(at, outputs):
    code, random = at.code, np.random.default_rng(4)
    results, evaluated = [x.partition(" ")[0] for x in outputs], code.differentiable.of(*outputs)
    q, v = on_the_manifold(at) if outputs == PROJECTION_OUTPUTS else (at.q, at.v)  # of which its derivatives are
    dconstants = random.standard_normal(len(code.constants)) * at.constants
    dconstants[:2] = 0.0
    dq, dv = random.standard_normal((2, code.coordinate_count))

    def value(h):
        return at.value(outputs, at.constants + h * dconstants, q + h * dq, v + h * dv, 3)

    h = 1e-6
    slope = (value(h) - value(-h)) / (2 * h)
    found = at.evaluated(outputs, q, v)
    changes = {f"d_{x}": np.full(len(a), np.nan) for x, a in found.items()}
    changes |= {"d_constants": dconstants, "d_q": dq, "d_v": dv}
    forward = found | changes
    loops.run(evaluated.derivative().forward, forward)
    along = np.concatenate([forward[f"d_{x}"] for x in results])
    assert_allclose(along, slope, atol=2e-7 * max(1.0, np.abs(slope).max()))
    w = random.standard_normal(len(along))
    reverse = found | {f"bar_{x}": np.zeros(len(a)) for x, a in found.items()}
    for k, x in enumerate(results):
        reverse[f"bar_{x}"] = w[k * code.coordinate_count : (k + 1) * code.coordinate_count].copy()
    loops.run(evaluated.derivative().reverse, reverse)
    total = reverse["bar_constants"] @ dconstants + reverse["bar_q"] @ dq + reverse["bar_v"] @ dv
    assert_allclose(total, w @ along, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("at", ["linkage", "gears", "loaded"], indirect=True)
@pytest.mark.parametrize("outputs", DIFFERENTIABLE[:3], ids="-".join)
def test_second_derivatives_against_differences(at, outputs):
    """This includes two directions that open the loops: a projection repeated once is right to second order."""
    code, random = at.code, np.random.default_rng(7)
    results, evaluated = [x.partition(" ")[0] for x in outputs], code.differentiable.of(*outputs)
    q, v = on_the_manifold(at) if outputs == PROJECTION_OUTPUTS else (at.q, at.v)
    numbers = random.standard_normal((2, len(at.numbers))) * at.numbers
    numbers[:, -2:] = 0.0  # thresholds
    dq, dv = random.standard_normal((2, 2, code.coordinate_count))

    def value(h):
        constants = at.constants.copy()
        loops.run(code.prologue, {"numbers": at.numbers + h @ numbers, "constants": constants})
        return at.value(outputs, constants, q + h @ dq, v + h @ dv, 4)

    def mixed(h):
        one, two = h * np.array([1.0, 1.0]), h * np.array([1.0, -1.0])
        return (value(one) - value(two) - value(-two) + value(-one)) / (4 * h**2)

    h = 2e-4
    expected = (4 * mixed(h) - mixed(2 * h)) / 3
    found = at.evaluated(outputs, q, v)
    found["numbers"] = at.numbers
    found |= {prefix + x: np.full(len(a), np.nan) for x, a in found.items() for prefix in PREFIXES[TWICE]}
    for x, given in {"numbers": numbers, "q": dq, "v": dv}.items():
        found |= dict(zip((prefix + x for prefix in PREFIXES[TWICE]), (*given.copy(), 0.0 * given[0]), strict=True))
    loops.run(LoopDerivative(code.prologue.parts, ()).second(()), found)
    for _ in range(2 if outputs == PROJECTION_OUTPUTS else 1):
        loops.run(evaluated.in_mode(TWICE), found)
        if outputs == PROJECTION_OUTPUTS:
            found |= {prefix + x: found[f"{prefix}{x}1"].copy() for prefix in PREFIXES[TWICE] for x in "qv"}
    second = np.concatenate([found[f"de_{x}"] for x in results])
    assert_allclose(second, expected, atol=1e-6 * max(1.0, np.abs(expected).max()))


def test_constants_by_jax_are_those_of_the_loops(at):
    found = jax.jit(lambda numbers: constants_of(at.code, numbers, jnp))(jnp.asarray(at.numbers[:-2]))
    assert_allclose(found[2:], at.constants[2:], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(
    ("at", "width"),
    [("loaded", 1), ("loaded", processor.lanes()), ("linkage", processor.lanes()), ("gears", processor.lanes())],
    indirect=True,
)
@pytest.mark.parametrize("outputs", [END_OF_STEP, ("terms",)], ids="-".join)
def test_machine_code_runs_the_loops(at, outputs, code, width):
    program = at.code.of(*outputs)
    random = np.random.default_rng(5)
    given = at.arrays(dq=random.standard_normal(at.code.coordinate_count), dv=random.standard_normal(at.code.coordinate_count))
    writer = LoopWriter(width)
    names = sorted(program.arrays)
    writer.write(program, "whole", names, {x: (x, 0) for x in names})
    run = code(*writer.functions, globals=writer.globals)
    wide = {x: np.repeat(given[x][:, None], width, 1).copy() for x in names}
    run(*(wide[x] for x in names))
    loops.run(program, given)
    for x in names:
        for lane in range(width):
            assert_allclose(wide[x][:, lane], given[x], rtol=1e-9, atol=1e-9, err_msg=x)


def test_the_code_does_not_grow_with_the_scene():
    few, many = (scene_programs(udk.library.n_four_bar(n)) for n in (7, 70))
    for code in (few, many):
        for outputs in (("a", "safe"), END_OF_STEP, ("terms",)):
            code.of(*outputs)
    assert len(few._kernels) == len(many._kernels) < 60


def test_blocks_that_are_alike_are_eliminated_in_a_run():
    holds = [{2 * k, 2 * k + 1} for k in range(8)] + [{2 * k + 1, 2 * k + 2} for k in range(7)]
    found = order_blocks([2] * 15, holds)
    seen: list[int] = []
    for e in found:
        for k, later in zip(e.blocks, e.later, strict=True):
            assert not set(later) & set(seen)
            seen.append(k)
    assert sorted(seen) == list(range(15))
    assert len(found) <= 8


# --- unrolled


PROGRAMS = [("a", "safe"), ("q1", "safe"), ("v1", "psi"), ("q1", "v1 at q1", "psi at q1"), END_OF_STEP, TANGENT_PART]
PROGRAMS += [("terms",), ("psi",), ("psi_dot",)]


def test_unrolled_programs_equal_loops(at):
    code, random = at.code, np.random.default_rng(6)
    dq, dv = random.standard_normal((2, code.coordinate_count))
    unrolled = Unrolled(code, PROGRAMS)
    given = {"constants": np.array(unrolled.prologue(at.numbers.tolist())), "t": np.array([at.t]), "q": at.q, "v": at.v}
    for outputs in PROGRAMS:
        found, expected = run(unrolled.program(*outputs), given | {"dq": dq, "dv": dv}), at.run(*outputs, dq=dq, dv=dv)
        assert found or not code.row_count
        for x, value in found.items():
            size = max(1.0, np.abs(expected[x]).max(initial=0.0))
            assert_allclose(value, expected[x], rtol=1e-9, atol=1e-9 * size, err_msg=f"{x} of {outputs}")


# --- trajectories: many mechanisms side by side are a large scene, and each moves as it does alone


def beside_each_other(mechanism: udk.Mechanism, copies: int) -> udk.Mechanism:
    """A number of copies of a mechanism in one scene."""

    def renamed(element, k):
        return dataclasses.replace(element, bodies=tuple(b if b == "ground" else f"{b} {k}" for b in element.bodies))

    bodies = {f"{name} {k}": body for k in range(copies) for name, body in mechanism.bodies.items()}
    joints = {f"{name} {k}": renamed(joint, k) for k in range(copies) for name, joint in mechanism.joints.items()}
    return udk.Mechanism(bodies, joints, gravity=mechanism.gravity)


@pytest.fixture(scope="module")
def linkages():
    """A linkage, and eight of them in one scene."""

    def pair(angle):
        alone = udk.library.parallelogram(np.deg2rad(angle))
        return alone, beside_each_other(alone, 8)

    alone, many = pair(-50.0)
    assert all(scene_programs(m, udk.analyse(m).redundant_rows or ()).is_small == (m is alone) for m in (alone, many))
    return pair


@pytest.mark.slow
@pytest.mark.parametrize(("angle", "bound"), [(-50.0, 1e-9), (60.0, 2e-5)], ids=["ordinary", "through a singular configuration"])
def test_a_large_scene_moves_as_its_parts_do(linkages, angle, bound):
    alone, many = linkages(angle)
    one, all_of_them = (udk.simulate(m, np.linspace(0.0, 2.0, 6), rtol=1e-9, atol=1e-9) for m in (alone, many))
    assert_allclose(all_of_them.q.reshape(6, 8, 4, 3), np.repeat(one.q[:, None], 8, 1), atol=bound)


@pytest.mark.slow
def test_derivatives_of_a_large_scene_are_those_of_its_parts(linkages):
    """Derivatives of runs and of the assembly of their initial states, in forward and reverse mode."""
    ts, slopes = np.linspace(0.0, 0.3, 4), []
    for mechanism, copies in zip(linkages(-50.0), (1, 8), strict=True):
        names = [f"body.{name}.mass" for name in mechanism.body_names if name.startswith("link1")]
        analysis, state = udk.analyse(mechanism), udk.assemble(mechanism)
        dq, dv, w = (np.tile(x, (copies, 1)) for x in np.random.default_rng(0).standard_normal((3, 4, 3)))

        def measure(mass, q, v, mechanism=mechanism, analysis=analysis, names=names, w=w):
            scene = mechanism.with_parameters(dict.fromkeys(names, mass))
            start = udk.assemble(scene, 0.0, udk.State(q, v), throw=False, analysis=analysis)
            run = udk.simulate(scene, ts, start, rtol=1e-9, atol=1e-9, throw=False, analysis=analysis)
            return jnp.sum(w * run.q[-1]) + jnp.sum(w * run.v[1])

        at, along = (1.0, state.q + 5e-3 * dq, state.v), (0.3, jnp.asarray(dq), jnp.asarray(dv))
        value, slope = jax.jit(lambda *x, f=measure, d=along: jax.jvp(f, x, d))(*at)
        gradient = jax.jit(jax.grad(measure, (0, 1, 2)))(*at)
        assert_allclose(sum(jnp.vdot(g, d) for g, d in zip(gradient, along, strict=True)), slope, rtol=1e-9, atol=1e-9)
        slopes.append((value / copies, slope / copies))
    assert_allclose(slopes[1], slopes[0], rtol=1e-5, atol=1e-6)
