"""The form for large scenes, on small ones: held against straight-line code and against the equation as it stands."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.equations import constraints, large, loads, redundancy
from udkjax.equations.programs import prepare
from udkjax.equations.rank_policy import REFUSE
from udkjax.pinv.blocks import Sums
from udkjax.straightline import Loop


def everything() -> udk.Mechanism:
    """A scene with every type of joint, driver and force element, several of each kind, and a copy of a joint."""
    random = np.random.default_rng(3)
    places = random.uniform(-2, 2, (11, 2))
    bodies = {
        f"b{k}": udk.Body(1.0 + 0.1 * k, 0.2 + 0.05 * k, places[k], random.uniform(-1, 1), random.uniform(-1, 1, 2), 0.3 * k)
        for k in range(11)
    }
    ends = lambda: random.uniform(-0.5, 0.5, (2, 2))  # noqa: E731
    angles = np.linspace(0, 2 * np.pi, 9)[:-1]
    profile = udk.Profile(angles, 1.0 + 0.2 * np.cos(angles))
    joints = {
        "pin": udk.Revolute(("ground", "b0"), ends()),
        "pin2": udk.Revolute(("b0", "b1"), ends()),
        "slide": udk.Prismatic(("b1", "b2"), ends(), 0.3),
        "slot": udk.Slot(("b2", "b3"), ends(), 1.2),
        "weld": udk.Weld(("b3", "b4"), ends()),
        "rod": udk.Distance(("b4", "b5"), ends()),
        "rod2": udk.Distance(("ground", "b5"), ends()),
        "same": udk.Angle(("b5", "b6")),
        "gear": udk.Gear(("b6", "b7"), (1.0, 2.0)),
        "gear2": udk.Gear(("b7", "b8"), (1.0, 0.5), carrier="b6"),
        "rack": udk.Rack(("ground", "b8"), 0.5, 0.1),
        "cam": udk.Cam(("b9", "b10"), ends(), profile),
        "again": udk.Angle(("b5", "b6")),
    }
    drivers = {
        "turn": udk.Driver(("ground", "b9"), "angle", udk.Sine(1.0, 2.0)),
        "push": udk.Driver(("b9", "b0"), "distance", udk.Polynomial([2.0, 0.5])),
    }
    forces = {
        "spring": udk.Spring(("b0", "b3"), ends(), 5.0, 0.4, 0.3),
        "spring2": udk.Spring(("b10", "b3"), ends(), 4.0, 0.6, 0.2),
        "soft": udk.Spring(("ground", "b1"), ends(), 3.0, 0.3),
        "twist": udk.TorsionSpring(("b1", "b2"), 2.0, 0.1),
        "wind": udk.Force("b7", [1.0, -2.0], [0.1, 0.2]),
        "jet": udk.Force("b8", [1.0, -2.0], [0.1, 0.2], frame="body"),
        "rub": udk.Friction("pin2", 0.3, 0.05),
        "motor": udk.Torque(("b3", "b4"), 0.7),
    }
    return udk.Mechanism(bodies, joints, drivers, forces, name="everything")


COPY = 2 + 2 + 2 + 1 + 3 + 1 + 1 + 1 + 1 + 1 + 1 + 1  # the row of everything's copied joint: it does not close, to find that out


SCENES = {
    "linkage": udk.library.parallelogram,
    "planetary gear": udk.library.planetary_gear,
    "driven": udk.library.slider_crank,
}
QUANTITIES = ("accelerations", "project", "tangential", "violation", "multipliers", "matrices", "energy", "is_finite")


def quantities(equations, t, q, v):
    return {
        "accelerations": equations.accelerations(t, q, v),
        "project": equations.project(t, q, v),
        "tangential": equations.tangential(t, q, v, jnp.sin(q), jnp.cos(q))[:2],
        "violation": equations.violation(t, q, v),
        "multipliers": equations.multipliers(t, q, v),
        "matrices": equations.matrices(t, q, v),
        "energy": equations.energy(t, q, v),
        "is_finite": equations.is_finite(t, q, v),
    }


def closed(mech):
    """A closed position of a scene, and velocities that its constraints allow."""
    q, v = mech.q0.ravel(), mech.v0.ravel() + 0.1 * np.random.default_rng(0).standard_normal(mech.q0.size)
    equations = prepare(mech, large=True).with_policy(REFUSE)
    return jax.jit(lambda q, v: jax.lax.fori_loop(0, 8, lambda _, state: equations.project(0.3, *state), (q, v)))(q, v)


@pytest.fixture(
    scope="module", params=["linkage", *(pytest.param(n, marks=pytest.mark.slow) for n in ("planetary gear", "driven"))]
)
def forms(request):
    """All quantities of a scene near a closed position, by both forms."""
    mech = SCENES[request.param]()
    q, v = closed(mech)
    q = q + 1e-3 * np.random.default_rng(1).standard_normal(len(q))

    @partial(jax.jit, static_argnums=0)
    def form(large, q, v):
        return quantities(prepare(mech, None, udk.Baumgarte(3.0, 2.0), large=large), 0.3, q, v)

    return [form(large, q, v) for large in (False, True)]


@pytest.mark.parametrize("name", QUANTITIES)
def test_it_agrees_with_straight_line_code(forms, name):
    small, big = (form[name] for form in forms)
    for a, b in zip(jax.tree.leaves(small), jax.tree.leaves(big), strict=True):
        assert_allclose(b, a, rtol=1e-10, atol=1e-11 * (1 + float(jnp.abs(a).max())))


@pytest.fixture(scope="module")
def whole():
    """A scene of everything, and a state of it that is not closed."""
    mech = everything()
    random, analysis = np.random.default_rng(0), dataclasses.replace(udk.analyse(mech), redundant_rows=(COPY,))
    return mech, analysis, mech.q0.ravel() + 0.1 * random.standard_normal(33), random.standard_normal(33)


def test_everything_agrees_with_the_equation_written_down_plainly(whole, kkt):
    mech, analysis, q, v = whole
    t = jnp.array(0.3)
    equations = prepare(mech, udk.Elimination(), large=True, analysis=analysis).with_policy(REFUSE)

    @jax.jit
    def ours(*state):
        return equations.accelerations(*state), *equations.violation(*state), *equations.energy(*state)

    a, psi, psi_dot, kinetic, potential = ours(t, q, v)
    expected, _ = kkt(mech, t, q, v)
    assert_allclose(a, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    assert_allclose(psi, constraints.psi(mech, t, q), atol=1e-13)
    assert_allclose(psi_dot, constraints.psi_dot(mech, t, q, v), atol=1e-13)
    assert_allclose(kinetic, loads.kinetic_energy(mech, v), rtol=1e-13)
    assert_allclose(potential, loads.potential_energy(mech, t, q, v), rtol=1e-13)


@pytest.mark.slow
def test_everything_has_the_multipliers_of_minimum_norm(whole, kkt):
    mech, analysis, q, v = whole
    equations, t = prepare(mech, large=True, analysis=analysis), jnp.array(0.3)
    expected = kkt(mech, t, q, v)[1]
    assert_allclose(equations.multipliers(t, q, v), expected, atol=1e-9 * np.abs(expected).max())
    M, F, A, c = equations.matrices(t, q, v)
    assert_allclose(A, constraints.psi_q(mech, t, q), atol=1e-13)
    assert_allclose(F, loads.force(mech, t, q, v), atol=1e-12)
    assert_allclose(c, constraints.gamma(mech, t, q, v), atol=1e-12)
    assert_allclose(jnp.diag(M), loads.mass(mech))


@pytest.mark.slow
def test_derivatives_of_everything(whole):
    """Forward against differences, in all masses, points, stiffnesses and the state; reverse against forward."""
    mech, analysis, q, v = whole
    ends = ("mass", "inertia", "points", "stiffness", "gravity")
    values = {name: value for name, value in mech.parameters().items() if name.split(".")[-1] in ends}
    random = np.random.default_rng(2)
    weights = jnp.asarray(random.standard_normal(33))

    @jax.jit
    def scalar(values, q, v):
        equations = prepare(mech.with_parameters(values), None, udk.Baumgarte(3.0, 2.0), True, analysis=analysis).with_policy(
            REFUSE
        )
        return weights @ equations.accelerations(0.3, q, v)

    there = values, q, v
    way = jax.tree.map(lambda x: jnp.asarray(random.standard_normal(x.shape)) * 0.1, there)
    ahead, back = (scalar(*jax.tree.map(lambda x, w, h=h: x + h * w, there, way)) for h in (1e-5, -1e-5))
    forward = jax.jit(lambda x, w: jax.jvp(scalar, x, w)[1])(there, way)
    assert_allclose(forward, (ahead - back) / 2e-5, rtol=1e-6)
    slope = jax.jit(jax.grad(scalar, (0, 1, 2)))(*there)
    assert_allclose(sum(jax.tree.leaves(jax.tree.map(jnp.vdot, slope, way))), forward, rtol=1e-9)


@pytest.mark.slow
def test_derivatives_agree_with_straight_line_code():
    """Of the accelerations and of the projection, with a redundant row left out."""
    mech = udk.library.parallelogram()
    q, v = closed(mech)
    values = {name: mech.parameters()[name] for name in ("body.link1.mass", "body.coupler.inertia", "joint.A1.points")}
    weights = jnp.asarray(np.random.default_rng(2).standard_normal(len(q)))

    def gradient(large):
        def scalar(values, q, v):
            equations = prepare(mech.with_parameters(values), None, udk.Baumgarte(3.0, 2.0), large=large).with_policy(REFUSE)
            moved = equations.project(0.3, q, v)
            return weights @ (equations.accelerations(0.3, q, v) + moved[0] + moved[1])

        return jax.jit(jax.grad(scalar, (0, 1, 2)))(values, q, v)

    for a, b in zip(jax.tree.leaves(gradient(False)), jax.tree.leaves(gradient(True)), strict=True):
        assert_allclose(b, a, rtol=1e-8, atol=1e-9 * (1 + float(jnp.abs(a).max())))


@pytest.mark.slow
def test_the_plain_form_is_the_equation_as_it_stands():
    """By the dense method of each pseudoinverse."""
    mech = udk.library.scissor_lift()
    q, v = mech.q0.ravel(), mech.v0.ravel()
    expected = prepare(mech, udk.Elimination(), large=True).accelerations(0.0, q, v)
    for method in (udk.SVD(), udk.Householder()):
        assert_allclose(prepare(mech, method, large=True).accelerations(0.0, q, v), expected, atol=1e-10)


def test_a_singular_configuration_takes_singular_values():
    """All links of the paper's linkage in line: rank 10 of 12."""
    mech = udk.library.parallelogram(0.0)
    q, v = mech.q0.ravel(), mech.v0.ravel()
    exact = prepare(mech, udk.SVD(), large=False).accelerations(0.0, q, v)
    assert_allclose(prepare(mech, large=True).accelerations(0.0, q, v), exact, atol=1e-11)


@pytest.mark.slow
def test_a_scene_of_which_redundancy_is_not_known_finds_it_out():
    mech = udk.library.parallelogram()
    unknown = dataclasses.replace(udk.analyse(mech), redundant_rows=None)
    q, v = mech.q0.ravel(), mech.v0.ravel()
    expected = prepare(mech, large=False, analysis=unknown).accelerations(0.0, q, v)
    for method in (udk.Auto(), udk.Elimination()):
        assert_allclose(prepare(mech, method, large=True, analysis=unknown).accelerations(0.0, q, v), expected, atol=1e-10)


def test_what_moves_without_constraints_falls():
    mech = udk.Mechanism({"a": udk.Body(1.0, 0.1), "b": udk.Body(2.0, 0.1)}, forces=[udk.Torque(("a", "b"), 1.0)])
    equations = prepare(mech, large=True)
    a = equations.accelerations(0.0, mech.q0.ravel(), mech.v0.ravel())
    assert_allclose(a, [0, -9.81, -10.0, 0, -9.81, 10.0], atol=1e-14)
    assert not equations.constrained
    assert equations.multipliers(0.0, mech.q0.ravel(), mech.v0.ravel()).shape == (0,)


@pytest.mark.parametrize("degree", [2, 7])
def test_sums_by_targets(degree):
    """A target of many slots, some of few, one of none, slots without a target."""
    targets = np.array([0] * degree + [1, 2, 2, -1])
    values = np.random.default_rng(0).standard_normal((3, len(targets)))
    expected = np.stack([values[:, targets == k].sum(1) for k in range(4)], 1)
    assert_allclose(Sums(targets, 4)(jnp.asarray(values)), expected, atol=1e-15)


# --- size


def test_large_scenes_take_it_unasked():
    small, big = udk.library.n_four_bar(2), udk.library.n_four_bar(40)
    assert not isinstance(prepare(small), large.LargeEquations)
    assert isinstance(prepare(big), large.LargeEquations)


@pytest.mark.parametrize("large", [False, True])
def test_joints_that_are_alike_are_traced_once(large):
    """However many there are, and whatever their bodies are called: with the ground, and without."""
    calls = []

    class Pin(udk.Revolute):
        def residual(self, t, *frames):
            calls.append(self)
            return super().residual(t, *frames)

    links = 60 if large else 12
    names = [f"link{k}" for k in range(links)]
    bodies = {name: udk.Body(1.0, 0.1, [k + 0.5, 0.0]) for k, name in enumerate(names)}
    ends = [((0.0, 0.0), (-0.5, 0.0))] + [((0.5, 0.0), (-0.5, 0.0))] * (links - 1)
    pairs = zip(["ground", *names[:-1]], names, strict=True)
    mech = udk.Mechanism(bodies, {f"pin{k}": Pin(pair, end) for k, (pair, end) in enumerate(zip(pairs, ends, strict=True))})
    equations = prepare(mech, large=large).with_policy(REFUSE)
    jax.jit(lambda q, v: equations.accelerations(0.0, q, v)).lower(mech.q0.ravel(), mech.v0.ravel())
    assert len(calls) == 2 * 2  # the first derivative and the second, of both


def test_the_program_does_not_grow_with_the_scene():
    def operations(n):
        mech = udk.library.chain(n)
        equations = prepare(mech, large=True)
        text = jax.jit(lambda e, q, v: e.arrays(e.layout.kept, ["D", "b"], 0.0, q, v, e.free(0.0, q, v))).lower(
            equations, mech.q0.ravel(), mech.v0.ravel()
        )
        return len(text.as_text().splitlines())

    assert operations(30) == operations(60)


def test_a_body_of_many_joints():
    """Ten wheels on one carriage: each of them is coupled to all others."""
    wheels = [f"wheel{k}" for k in range(10)]
    bodies = {"carriage": udk.Body(5.0, 2.0)} | {w: udk.Body(1.0, 0.1, [k - 5.0, 0.0], 0.1 * k) for k, w in enumerate(wheels)}
    joints = {w: udk.Revolute(("carriage", w), [[k - 5.0, 0.0], [0.0, 0.0]]) for k, w in enumerate(wheels)}
    forces = {w: udk.Torque(("carriage", w), 1.0 + k) for k, w in enumerate(wheels)}
    mech = udk.Mechanism(bodies, joints, forces=forces)
    state = (0.0, mech.q0.ravel(), jnp.asarray(np.random.default_rng(1).standard_normal(mech.q0.size)))
    equations = prepare(mech, large=True)
    mass, force, rows, right = map(np.asarray, equations.matrices(*state))
    free, root = np.linalg.solve(mass, force), np.sqrt(1 / np.diag(mass))
    a = free + root * (np.linalg.pinv(rows * root) @ (right - rows @ free))
    assert_allclose(equations.accelerations(*state), a, atol=1e-11 * np.abs(a).max())


@pytest.mark.slow
def test_a_long_chain_against_the_dense_equation():
    mech = udk.library.chain(100, 0.4)
    random = np.random.default_rng(2)
    q, v = mech.q0.ravel() + 0.01 * random.standard_normal(300), random.standard_normal(300)
    M, F, A, c = prepare(mech).matrices(0.0, q, v)
    n, m = 300, 200
    system = np.block([[np.asarray(M), np.asarray(A).T], [np.asarray(A), np.zeros((m, m))]])
    expected = np.linalg.solve(system, np.concatenate([F, c]))
    a = udk.accelerations(mech, 0.0, q.reshape(-1, 3), v.reshape(-1, 3), multipliers=True)
    assert_allclose(a[0].ravel(), expected[:n], rtol=0, atol=1e-10 * np.abs(expected).max())
    assert_allclose(a[1], expected[n:], rtol=0, atol=1e-10 * np.abs(expected).max())


# --- parts that do not touch


def side_by_side(one, copies, off=0.0):
    """Copies of a mechanism in one scene, each body's place off by a little."""
    random, bodies, joints = np.random.default_rng(0), {}, {}
    for k in range(copies):
        bodies |= {
            f"{k} {n}": udk.Body(b.mass, b.inertia, b.position + off * random.standard_normal(2), b.angle)
            for n, b in one.bodies.items()
        }
        joints |= {
            f"{k} {n}": udk.Revolute([body if body == "ground" else f"{k} {body}" for body in j.bodies], j.points)
            for n, j in one.joints.items()
        }
    return udk.Mechanism(bodies, joints)


@pytest.mark.parametrize("name", ["accelerations", "nearer", "tangential"])
def test_two_of_them_take_twice_the_operations_of_one(name):
    one = udk.library.four_bar()
    counts = [prepare(m, udk.Elimination(), large=False).code.program(name).count() for m in (one, side_by_side(one, 2))]
    # Whether all pivots are safe is one question, and so is which is the smallest.
    together = {"max": 1, "sqrt": -1, "div": -1} if name == "tangential" else {"and": 1}
    assert {k: 2 * n + together.get(k, 0) for k, n in counts[0].items()} == counts[1]


@pytest.mark.slow
def test_dense_methods_see_each_of_them_by_itself():
    """Three linkages in line, each of rank 10 of 12: three matrices of 12 x 12, and no larger one."""
    mech = side_by_side(udk.library.parallelogram(0.0), 3)
    equations = prepare(mech, udk.SVD(), large=True)
    (parts,) = equations.layout.all.pattern.parts
    assert (parts.rows.shape, parts.columns.shape) == ((3, 12), (3, 12))
    rank = jax.jit(lambda q, v: equations.linearized("rows", 0.0, q, v)[0].rank)
    assert rank(mech.q0.ravel(), mech.v0.ravel()) == 30


# --- redundant rows


def copied(mech, seed, copies=3):
    random, joints = np.random.default_rng(seed), dict(mech.joints)
    joints |= {f"copy{k}": joints[name] for k, name in enumerate(random.choice(list(joints), copies))}
    return udk.Mechanism(mech.bodies, joints, mech.drivers, mech.forces)


FAST = ("scissor lift", "linkage, copied")
REDUNDANT = {
    "linkage": lambda: udk.library.parallelogram(),
    "linkage in line": lambda: udk.library.parallelogram(0.0),
    "scissor lift": lambda: udk.library.scissor_lift(),
    "planetary gear": lambda: udk.library.planetary_gear(),
    "linkage, copied": lambda: copied(udk.library.parallelogram(), 0),
    "gear, copied": lambda: copied(udk.library.planetary_gear(3), 3),
    "pendulum, copied": lambda: copied(udk.library.double_pendulum(), 4),
}


@pytest.mark.parametrize("name", [n if n in FAST else pytest.param(n, marks=pytest.mark.slow) for n in REDUNDANT])
def test_sparse_analysis_finds_as_many_rows_as_singular_values_which_do_as_well(name, monkeypatch):
    """At every position that the other has seen, what stays is as far from dependent as what the other leaves."""
    mech, choose = REDUNDANT[name](), redundancy.rows_of
    q, found = np.asarray(mech.q0).ravel(), []
    for size in (False, True):
        monkeypatch.setattr(redundancy, "rows_of", lambda mech, size=size: choose(mech, size))
        found.append(redundancy.redundant_rows(mech))
    dense = choose(mech, False)
    null_spaces = [p.null_space for p in redundancy.positions_of(dense, q) if p.smallest > redundancy.ORDINARY]
    assert len(found[0]) == len(found[1]) == null_spaces[0].shape[1]
    one, other = (min(np.linalg.svd(N[list(rows)])[1][-1] for N in null_spaces) for rows in found)
    assert one > 0.05 and other > 0.2 * one


@pytest.mark.slow
def test_a_large_scene_is_closed_and_its_redundant_rows_are_found():
    """Thirty linkages side by side, their guesses off: a row of each is left out, and all of them are closed."""
    one = udk.library.parallelogram(-0.6)
    mech = side_by_side(one, 30, 0.01)
    redundant = udk.analyse(mech).redundant_rows
    assert redundant is not None and len(redundant) == 30
    assert {row // 12 for row in redundant} == set(range(30))
    equations = prepare(mech)
    assert isinstance(equations, large.LargeEquations)
    state = udk.assemble(mech)
    psi, psi_dot = equations.violation(0.0, state.q.ravel(), state.v.ravel())
    assert jnp.abs(psi).max() < 1e-12 and jnp.abs(psi_dot).max() < 1e-12
    a = udk.accelerations(mech, 0.0, state.q, state.v)
    for k in (0, 29):
        part = slice(4 * k, 4 * k + 4)
        expected = udk.accelerations(one, 0.0, state.q[part], state.v[part])
        assert_allclose(a[part], expected, atol=1e-9)


# --- whole runs


@pytest.mark.slow
def test_a_chain_of_a_thousand_links_keeps_its_energy():
    mech = udk.library.chain(1000, np.pi / 3)
    sol = udk.simulate(mech, jnp.linspace(0.0, 0.05, 3))
    energy = udk.energy(mech, sol)
    assert jnp.abs(udk.violation(mech, sol)).max() < 1e-12
    assert energy.kinetic[-1] > 0.05
    assert jnp.abs(energy.total - energy.total[0]).max() < 1e-9 * energy.kinetic[-1]


@pytest.mark.slow
@pytest.mark.parametrize("n", [200])
def test_the_cost_of_a_right_hand_side_grows_with_the_scene(n):
    def flops(n):
        mech = udk.library.n_four_bar(n, 1.0)
        rhs = jax.jit(lambda e, q, v: e.accelerations(0.0, q, v))
        cost: Any = rhs.lower(prepare(mech, large=True), mech.q0.ravel(), mech.v0.ravel()).compile().cost_analysis()
        return cost["flops"]

    assert np.log(flops(n) / flops(n // 10)) / np.log(10) < 1.1


def marched(equations, loop, q, v):
    """A state after three rounds of what a step asks for, in a loop of which XLA does not know how long it is."""
    equations = equations.with_policy(REFUSE) if loop is None else equations.with_policy(REFUSE).within(loop)

    def again(_, state):
        q, v = state
        a = equations.accelerations(0.0, q, v)
        q, v = equations.project(0.0, q + 1e-3 * v, v + 1e-3 * a)
        return q, v + 1e-9 * equations.tangential(0.0, q, v, a, v).dq

    return jax.lax.fori_loop(0, jnp.where(jnp.sum(q * q) > 0.0, 3, 2), again, (q, v))


@pytest.mark.parametrize(
    "make", [lambda: udk.library.n_four_bar(7, 1.0), lambda: udk.library.chain(12, 0.4)], ids=["loops", "chain"]
)
def test_in_a_loop_that_is_one_function_it_is_written_out(make):
    mech = make()
    equations, loop = prepare(mech, large=True), Loop()
    q, v = mech.q0.ravel(), mech.v0.ravel() + jnp.linspace(0.1, 0.3, mech.q0.size)
    runs = [jax.jit(partial(marched, equations, x)).lower(q, v) for x in (loop, None)]
    assert [run.as_text().count("mhlo.fusion") > 0 for run in runs] == [loop.fuses, False]
    for found, expected in zip(*(run.compile()(q, v) for run in runs), strict=True):
        assert_allclose(found, expected, rtol=1e-11, atol=1e-11)


def test_batches_and_derivatives_of_such_loops_are_those_by_levels():
    """Batches of fronts would be too much to compile where they are no fusions."""
    mech = udk.library.n_four_bar(3, 1.0)
    equations = prepare(mech, large=True)
    q, v = mech.q0.ravel(), mech.v0.ravel() + jnp.linspace(0.1, 0.3, mech.q0.size)
    several = jnp.stack([v, 2 * v])
    lanes, plain = (jax.jit(jax.vmap(partial(marched, equations, x), (None, 0))) for x in (Loop(batch=True), None))
    assert lanes.lower(q, several).as_text().count("mhlo.fusion") == 0
    for found, expected in zip(lanes(q, several), plain(q, several), strict=True):
        assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
    along = [jax.jit(lambda v, x=x: jax.jvp(partial(marched, equations, x, q), (v,), (v,))[1])(v) for x in (Loop(), None)]
    for found, expected in zip(*along, strict=True):
        assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
