"""Every term of the equations, compared with its definition: the residuals of the elements and JAX's derivatives of them."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.calls import calls_of
from tests.elements import BODIES, DRIVERS, FORCES, JOINTS, P
from tests.run_programs import evaluate_programs
from udkjax.equations import constraints, loads, prepare
from udkjax.equations.programs.scene_arrays import SceneArrays, arrays_in_time
from udkjax.equations.programs.scene_programs import _scene_programs, scene_programs
from udkjax.equations.programs.unrolled import Unrolled
from udkjax.equations.rows.dense_rows import DenseTerms
from udkjax.equations.terms.structure import numbers_as_vector
from udkjax.expressions.loops import float_loops
from udkjax.expressions.loops.array_loops import WORTH_COMPILING_AT_MANY, ArrayLoops
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.programs.deferred import deferred


class Ellipse(udk.Joint):
    """A point of body 2 stays on an ellipse of body 1; written with arrays, and returning an array."""

    shape: jax.Array
    point: jax.Array

    def residual(self, t, *frames):
        one, two = frames
        turn = jnp.array([[one.cos, one.sin], [-one.sin, one.cos]])
        p = two.point(self.point)
        d = turn @ (jnp.stack([p.x, p.y]) - jnp.stack([one.x, one.y]))
        return jnp.atleast_1d(d @ self.shape @ d - 1.0)


class Table(udk.Joint):
    """Height over x from a table, a soft step, a branch, a loop, a linear system: any function that JAX can trace."""

    heights: tuple
    slope: float = 0.3

    def residual(self, t, *frames):
        (one,) = frames
        height = jnp.interp(one.x, jnp.linspace(-3.0, 3.0, len(self.heights)), jnp.stack([jnp.asarray(h) for h in self.heights]))
        bend = jax.lax.cond(one.y > 0, lambda s: jnp.sin(s) ** 2, lambda s: s * self.slope, one.angle)
        series = jax.lax.fori_loop(0, 3, lambda k, s: s * one.x / (k + 1.0) + 1.0, 1.0)
        matrix = jnp.array([[2.0 + one.cos, one.sin], [0.3, 1.5]])
        solved = jnp.linalg.solve(matrix, jnp.stack([one.x, one.y]))
        return [
            one.y - height,
            jax.nn.softplus(one.x) + bend,
            series * jnp.sum(solved),
            jnp.polyval(jnp.array([0.2, -1.0, 0.5]), one.x),
        ]


class Belt(udk.Joint):
    """Three bodies, with the ground in the middle."""

    radius: float

    def residual(self, t, *frames):
        one, ground, two = frames
        spread = jnp.array([one.angle, two.angle - ground.angle]) * self.radius
        return [jnp.sum(spread**3), jnp.cumsum(spread)[-1] * jnp.prod(jnp.stack([one.x, two.y]))]


class Chirp(udk.Motion):
    rate: float

    def __call__(self, t):
        return jnp.where(t > 0.5, jnp.sin(self.rate * t**2), jnp.exp(-t) * t)


class Stop(udk.ForceElement):
    """A one-sided spring against a wall."""

    stiffness: float

    def potential(self, t, *frames):
        (one,) = frames
        depth = jnp.where(one.x < 0.2, 0.2 - one.x, 0.0)
        return 0.5 * self.stiffness * depth**2 * jnp.cosh(one.angle)


class Drag(udk.ForceElement):
    """Quadratic drag, a time-dependent gust, and a potential."""

    coefficient: jax.Array

    def loads(self, t, *frames):
        one, two = frames
        velocity = jnp.stack([one.vx, one.vy]) - jnp.stack([two.vx, two.vy])
        force = -(self.coefficient @ velocity) * jnp.linalg.norm(velocity) + jnp.where(t > 0.1, jnp.tanh(t), 0.0)
        return [(*force, -(one.omega**3)), (*-force, jnp.max(jnp.stack([two.omega, one.omega])))]

    def potential(self, t, *frames):
        one, two = frames
        return jnp.logaddexp(one.y, two.y) + jnp.arctan2(one.cos, 2.0 + two.sin) * jnp.cos(t)


@pytest.fixture(scope="module")
def mech():
    """One element of each type, far from closed; the mechanism need not be able to move."""
    return udk.Mechanism(
        bodies=BODIES,
        joints={
            **JOINTS,
            "revolute of two": udk.Revolute(["c", "b"], P),
            "to ground": udk.Revolute(["a", "ground"], P),
            "slot of two": udk.Slot(["a", "c"], P, axis=0.3),
            "rack of two": udk.Rack(["a", "b"], radius=0.2, axis=0.1),
            "ellipse": Ellipse(["a", "c"], jnp.array([[1.0, 0.2], [0.2, 0.5]]), jnp.array([0.1, 0.3])),
            "ellipse on ground": Ellipse(["ground", "c"], jnp.array([[1.0, 0.2], [0.2, 0.5]]), jnp.array([0.1, 0.3])),
            "table": Table("c", (0.1, 0.4, -0.3, 0.8)),
            "belt": Belt(["a", "ground", "c"], 0.3),
        },
        drivers={
            **DRIVERS,
            "chirp": udk.Driver(["c", "ground"], "angle", Chirp(1.7)),
        },
        forces={
            **FORCES,
            "motor": udk.Torque(["ground", "c"], value=0.7),
            "rub of two": udk.Friction("revolute of two", torque=0.5, velocity=0.3),
            "stop": Stop("b", 40.0),
            "drag": Drag(["b", "c"], jnp.array([[0.4, 0.1], [0.0, 0.7]])),
            "gust": Drag(["a", "ground"], jnp.array([[0.4, 0.1], [0.0, 0.7]])),
        },
        gravity=(0.3, -9.81),
    )


TIMES = np.array([0.0, 0.3, 0.7, 2.0, 3.5])


@pytest.fixture(scope="module")
def states(mech):
    random = np.random.default_rng(1)
    q, v = random.standard_normal((2, len(TIMES), 3 * len(mech.bodies)))
    return jnp.asarray(TIMES), jnp.asarray(q), jnp.asarray(v)


@pytest.fixture(scope="module")
def terms(mech, states):
    """The terms by the programs."""
    arrays_at, (row, column, *_) = arrays_in_time(mech), scene_programs(mech).psi_q_entries

    def at(t, q, v):
        arrays = arrays_at(t)
        psi, psi_dot, values = arrays.geometry(t, q, v)
        free, b = arrays.loads(t, q, v)
        A = np.zeros((len(psi), len(q)))
        A[row, column] = values
        return {"psi": psi, "psi_dot": psi_dot, "psi_q": A, "gamma": b + A @ free, "force": free * np.asarray(loads.mass(mech))}

    each = [at(float(t), np.asarray(q), np.asarray(v)) for t, q, v in zip(*states, strict=True)]
    return {name: np.stack([found[name] for found in each]) for name in each[0]}


OWN_JOINTS = ["revolute of two", "to ground", "slot of two", "rack of two", "ellipse", "ellipse on ground", "table", "belt"]


@pytest.fixture(scope="module")
def definitions(mech, states):
    """The same terms from the residuals of the elements by JAX's own derivatives."""

    @deferred  # NumPy evaluates JAX's program sooner than XLA compiles it
    def at(state):
        t, q, v = state
        found = {name: getattr(constraints, name)(mech, t, q) for name in ("psi", "psi_q")}
        found |= {name: getattr(constraints, name)(mech, t, q, v) for name in ("psi_dot", "gamma")}
        return found | {"force": loads.force(mech, t, q, v)}

    found = [at(state) for state in zip(*states, strict=True)]
    return {name: np.stack([each[name] for each in found]) for name in found[0]}


@pytest.mark.parametrize("term", ["psi", "psi_dot", "psi_q", "gamma", "force"])
def test_the_terms_of_every_element_are_what_their_definitions_say(mech, terms, definitions, term):
    expected, found = np.asarray(definitions[term]), terms[term]
    names = mech.body_names if term == "force" else [name for name, _ in prepare(mech).row_names]
    assert np.shape(found) == np.shape(expected)
    off = ~(np.abs(found - expected) <= 1e-12 * (1 + np.abs(expected)))
    wrong = off.any(axis=tuple(k for k in range(off.ndim) if k != 1))
    assert not wrong.any(), [names[k // (3 if term == "force" else 1)] for k in np.flatnonzero(wrong)]


def test_no_element_is_forgotten(mech):
    owners = list(dict.fromkeys(name for name, _ in prepare(mech).row_names))
    assert owners == list(mech.constraints) == [*JOINTS, *OWN_JOINTS, *DRIVERS, "chirp"]


def test_values_are_inputs_and_types_are_structure(mech):
    other = jax.tree.map(lambda x: 1.1 * x, mech)
    one, two = (scene_programs(m, (), False, RankPolicy.DROP) for m in (other, mech))
    assert one is two


@pytest.fixture(scope="module")
def machine():
    """A slider-crank driven by a motor between crank and rod, with springs, dampers, friction and loads."""
    plain = udk.library.slider_crank(angle=0.7, driven=False)
    return udk.Mechanism(
        plain.bodies,
        plain.joints,
        {"motor": udk.Driver(["crank", "rod"], "angle", udk.Sine(0.5, 3.0, 0.2))},
        [
            udk.Spring(["ground", "slider"], [[2.5, 0.3], [0.0, 0.1]], 30.0, 0.2, 4.0),
            udk.TorsionSpring(["ground", "crank"], 3.0, 0.7, 0.3),
            udk.Force("rod", [1.0, -2.0], [0.2, 0.1], "body"),
            udk.Torque(["ground", "crank"], 2.0),
            udk.Friction("P", 0.4, 0.1),
            Drag(["slider", "ground"], jnp.eye(2)),
        ],
    )


@pytest.mark.slow
def test_energy_changes_by_the_power_of_loads_and_drivers(machine):
    """dE/dt = v F_nc + V_t + lambda Psi_t, where v satisfies the constraints; the reactions of joints do no work."""
    random, t = np.random.default_rng(2), jnp.array(0.4)
    q = machine.q0.ravel() + 0.1 * random.standard_normal(9)
    v = jnp.asarray(random.standard_normal(9))

    def energy(t, q, v):
        return loads.kinetic_energy(machine, v) + loads.potential_energy(machine, t, q, v)

    @jax.jit
    def rates(q, v):
        A = constraints.psi_q(machine, t, q)
        v = v - jnp.linalg.pinv(A) @ constraints.psi_dot(machine, t, q, v)
        a, multipliers = udk.accelerations(machine, t, q.reshape(3, 3), v.reshape(3, 3), multipliers=True)
        growth = jax.jvp(energy, (t, q, v), (1.0, v, a.ravel()))[1]
        psi_t = jax.jacfwd(constraints.psi, 1)(machine, t, q)
        power = v @ loads.element_loads(machine, t, q, v) + multipliers @ psi_t
        return v, growth, power + jax.grad(loads.potential_energy, 1)(machine, t, q, v), multipliers, psi_t

    v, growth, power, multipliers, psi_t = rates(q, v)
    assert abs(multipliers @ psi_t) > 1.0  # the motor works
    assert_allclose(growth, power, rtol=1e-11)

    moment = SimpleNamespace(ts=t[None], q=q.reshape(1, 3, 3), v=v.reshape(1, 3, 3))
    moving = dict(zip(machine.body_names, np.asarray(moment.v[0]), strict=True))
    work = {
        n: sum(np.asarray(load[0]) @ moving[b] for b, load in loads.items())
        for n, loads in udk.reactions(machine, moment).items()
    }
    assert_allclose(work.pop("motor"), multipliers @ psi_t, rtol=1e-10)
    assert_allclose(list(work.values()), 0.0, atol=1e-10)


def test_energies_along_a_motion(machine):
    ts, qs, vs = jnp.array([0.0, 0.2]), jnp.stack([machine.q0, machine.q0 + 0.1]), jnp.stack([machine.v0, machine.v0 - 0.3])
    found = udk.energy(machine, SimpleNamespace(ts=ts, q=qs, v=vs))
    for k, t in enumerate(ts):
        q, v = qs[k].ravel(), vs[k].ravel()
        assert_allclose(found.kinetic[k], loads.kinetic_energy(machine, v), rtol=1e-13)
        assert_allclose(found.potential[k], loads.potential_energy(machine, t, q, v), rtol=1e-13)
    assert_allclose(found.total, found.kinetic + found.potential, rtol=1e-15)


def test_floats_and_arrays_find_the_same(monkeypatch):
    """Scenes of few elements are evaluated by Python's floats, others, and non-finite numbers, by NumPy arrays."""
    names = ("revolute", "prismatic", "slot", "weld")
    mechanism = udk.Mechanism(BODIES, {name: JOINTS[name] for name in names}, forces={"push": FORCES["push"]})
    q, v = np.asarray(mechanism.q0).ravel(), np.linspace(-1.0, 1.0, mechanism.q0.size)
    states = [(q, v)] * 105 + [(np.full_like(q, np.inf), v)]  # the first ones row by row, later ones by machine code

    def evaluate(few):
        monkeypatch.setattr(float_loops, "FEW_ROWS", few)
        _scene_programs.cache_clear()
        at = arrays_in_time(mechanism)(0.3)
        return [np.concatenate([at.psi(0.3, q), *at.geometry(0.3, q, v), *at.loads(0.3, q, v)]) for q, v in states]

    few = float_loops.FEW_ROWS
    by_arrays, by_floats = evaluate(0), evaluate(few)
    assert ArrayLoops(scene_programs(mechanism).of("psi_q", "psi", "psi_dot"), np)._on_floats
    assert_allclose(by_floats, by_arrays, rtol=1e-12, atol=1e-12)
    assert np.isnan(by_floats[-1]).any() and np.isfinite(by_floats[:-1]).all()
    assert (np.array(by_floats[:99]) == by_floats[0]).all()  # to the last bit
    assert (np.array(by_floats[100:-1]) == by_floats[100]).all()


def test_many_states_at_once_are_single_states():
    """By NumPy at first, later by machine code in lanes."""
    names = ("revolute", "prismatic", "slot", "weld")
    mechanism = udk.Mechanism(BODIES, {name: JOINTS[name] for name in names}, forces={"push": FORCES["push"]})
    _scene_programs.cache_clear()
    at = arrays_in_time(mechanism)(0.3)
    rng, q0 = np.random.default_rng(0), np.asarray(mechanism.q0).ravel()
    t, q, v = rng.random(5), q0[:, None] + 0.1 * rng.standard_normal((q0.size, 5)), rng.standard_normal((q0.size, 5))
    q[0, 4] = np.inf

    def evaluate(t, q, v):
        with np.errstate(all="ignore"):
            return np.concatenate([at.psi(t, q), *at.geometry(t, q, v), *at.loads(t, q, v), at.energy(t, q, v)])

    single = np.stack([evaluate(t[k], q[:, k], v[:, k]) for k in range(5)], 1)
    with calls_of(ArrayLoops.at_many) as runs:
        for _ in range(WORTH_COMPILING_AT_MANY + 1):
            assert_allclose(evaluate(t, q, v), single, rtol=1e-12, atol=1e-12)
    at_rest = at.geometry(t, q, np.zeros((q0.size, 1)))  # the same velocity for all states
    assert_allclose(at_rest[2], at.geometry(t, q, np.zeros_like(q))[2], rtol=0, atol=0)
    assert runs[0].result is None and runs[-1].result is not None
    assert np.isnan(single[:, 4]).any() and np.isfinite(single[:, :4]).all()


def test_one_position_is_evaluated_once():
    mechanism = udk.library.four_bar()
    terms, q = DenseTerms(mechanism), np.array(mechanism.q0).ravel()
    with calls_of(SceneArrays._run) as runs:
        slopes, psi = terms.slopes(0.0, q)[0], terms.psi(0.0, q)
        assert_allclose(terms.slopes(0.0, q + 0.0)[0], slopes)
    assert [run.arguments["outputs"] for run in runs] == [("psi_q", "psi", "psi_dot")]
    assert not np.allclose(terms.psi(0.0, q + 0.1), psi)  # of another position
    q += 0.1  # and of the same array with other numbers
    assert not np.allclose(terms.slopes(0.0, q)[0], slopes)


def test_outputs_do_not_depend_on_what_else_a_program_computes():
    """All are by one elimination: each pivot of the four-bar has one reciprocal, and the distance has one."""
    mechanism, random = udk.library.four_bar(), np.random.default_rng(0)
    programs, n = scene_programs(mechanism), mechanism.q0.size
    outputs = ("a", "q1", "v1", "dv1", "psi", "psi_dot", "terms", "energy", "distance")
    numbers = [*map(float, numbers_as_vector(mechanism.without_origin.numbers)), 1e-14, 1e-14]
    q, v, dq, dv = np.ravel(mechanism.q0) + 0.01 * random.standard_normal(n), *random.standard_normal((3, n))
    evaluate = lambda asked: evaluate_programs(programs, asked, numbers, 0.0, q, v, dq=dq, dv=dv)  # noqa: E731
    together, apart = evaluate([outputs]), evaluate([(x,) for x in outputs])
    for x in outputs:
        assert_allclose(together[x], apart[x], rtol=1e-9, atol=1e-9, err_msg=x)
    assert Unrolled(programs, [outputs]).program(*outputs).program.count()["div"] == programs.row_count + 1
