"""User-defined systems by machine code: the same functions, motions and derivatives as in plain JAX."""

from dataclasses import replace
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from benchmarks.systems import spatial_chain
from tests.fresh_process import python
from tests.integrate.systems.own_systems import G, pendulum
from udkjax.equations import equations_of
from udkjax.equations.programs.unrolled import Unrolled
from udkjax.equations.systems.general import prepare_general
from udkjax.equations.systems.system_programs import system_programs
from udkjax.equations.systems.system_solver import factorize_mass, mass_operations
from udkjax.equations.systems.traced_system import trace_system
from udkjax.expressions.loops.loop_derivative import FORWARD, REVERSE
from udkjax.integrate.compiled_mechanism import compile_mechanism
from udkjax.integrate.native_engine import mark_rows
from udkjax.integrate.native_equations import native_equations
from udkjax.programs.deferred import deferred
from udkjax.requirements import ArgumentError

TS = np.linspace(0.0, 2.0, 5)
TIGHT: Any = {"rtol": 1e-10, "atol": 1e-10}


def random_system(seed, n=5, m=2, k=1, couples=True, redundant=True, linear=True):
    """Smooth functions with random coefficients; `redundant`: every row again, combined with others."""
    rng = np.random.default_rng(seed)
    a, b, c, w, e = (rng.normal(size=(rows, n)) for rows in (m, n, k, m, k))
    mix, diagonal = rng.normal(size=(m, m)), 1 + rng.random(n)

    def mass(q):
        u = jnp.cos(b @ q)
        return jnp.diag(diagonal * (1.2 + jnp.sin(q))) + (0.3 * jnp.outer(u, u) if couples else 0.0)

    def force(t, q, v):
        return jnp.sin(b @ q + t) - 0.3 * v * jnp.abs(v)

    def constraint(t, q):
        rows = a @ jnp.sin(q) + 0.2 * jnp.cos(w @ q + 0.3 * t)
        return jnp.concatenate([rows, mix @ rows]) if redundant else rows

    def velocity_constraint(t, q, v):
        rows = c @ v + 0.3 * jnp.sin(e @ q) * v[0] + 0.1 * t + (0.0 if linear else 0.2 * v @ v)
        return jnp.concatenate([rows, 2 * rows]) if redundant else rows

    return udk.ConstrainedSystem(mass, force, constraint if m else None, velocity_constraint if k else None)


KINDS: Any = [
    {"linear": False},
    {"couples": False, "k": 0},
    {"m": 0, "redundant": False},
    {"redundant": False, "n": 8, "m": 3, "k": 2},
]
METHODS = [udk.Auto(), udk.SVD(), udk.Elimination(), udk.Varga(), udk.Greville(), udk.Householder(), udk.GramSchmidt()]
EACH = [(kind, method) for kind in KINDS for method in METHODS]


@pytest.mark.parametrize(
    ("kind", "method"), [*EACH[:2], *(pytest.param(*x, marks=pytest.mark.slow) for x in EACH[2:])], ids=lambda x: str(x)[:24]
)
def test_functions_of_a_state(kind, method):
    """Accelerations, projections and tangent parts of random systems at random states, closed or not."""
    system, n, t = random_system(1, **kind), kind.get("n", 5), 0.3
    q, v, dq, dv = np.random.default_rng(2).normal(size=(4, n)) * 0.5
    compiled = compile_mechanism(trace_system(system, n), None, method, udk.Projection(), None, udk.BDF())
    by_code = native_equations(compiled, mark_rows(compiled, jnp.array(t), q, v, None, 1.0))
    plain = prepare_general(system, udk.SVD(), None)

    @deferred
    def of_both(q, v, dq, dv):
        a = [x.accelerations(t, q, v) for x in (by_code, plain)]
        for _ in range(4):
            q, v = plain.project(t, q, v)
        tangent = [x.tangent_part(t, q, v, dq, dv) for x in (by_code, plain)]
        near = q + 1e-4 * dq, v + 1e-4 * dv
        return a, tangent, [by_code.project(t, *near), plain.project(t, *plain.project(t, *near))]

    for found, expected in of_both(q, v, dq, dv):
        for x, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            assert_allclose(x, wanted, rtol=0, atol=1e-12 * max(1.0, float(jnp.abs(wanted).max())))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_partitions_of_a_state(kind):
    """Accelerations of closed random states, and states that are closed by other dependent coordinates and velocities."""
    system, n, t = random_system(1, **kind), kind.get("n", 5), 0.3
    q, v, dq, dv = np.random.default_rng(2).normal(size=(4, n)) * 0.5
    compiled = compile_mechanism(trace_system(system, n), None, udk.Auto(), None, udk.CoordinatePartitioning())
    operation = compiled.plan.operation
    assert operation is not None
    compiled = replace(compiled, plan=replace(compiled.plan, evaluation=operation.accelerations))
    by_code = native_equations(compiled, mark_rows(compiled, jnp.array(t), q, v, None, 1.0))
    plain = equations_of(system, udk.SVD(), None, udk.CoordinatePartitioning())

    @deferred
    def of_both(q, v, dq, dv):
        for _ in range(4):
            q, v = prepare_general(system, udk.SVD(), None).project(t, q, v)
        near = q + 1e-3 * dq, v + 1e-3 * dv
        return [x.accelerations(t, q, v) for x in (by_code, plain)], [x.project(t, *near) for x in (by_code, plain)]

    for found, expected in of_both(q, v, dq, dv):
        for x, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            assert_allclose(x, wanted, rtol=0, atol=1e-12 * max(1.0, float(jnp.abs(wanted).max())))


def in_a_bowl(p):
    """A bead in a bowl that shakes, pulled along by the air; M is full, and a number is found in closures alone."""
    mass, radius, gravity = p

    def inertia(q):
        return mass * jnp.diag(jnp.array([1.0, 1.0, 2.0])) + 0.3 * jnp.outer(q, q)

    def force(t, q, v):
        return mass * jnp.array([0.3 * jnp.sin(t), 0.0, -gravity]) - 0.1 * v

    def constraint(t, q):
        gap = q @ q - radius**2
        return jnp.stack([gap, 2 * gap])

    return udk.ConstrainedSystem(inertia, force, constraint)


P = np.array([2.0, 1.0, 9.81])


def end_in_bowl(p, **choices):
    start = udk.State(p[1] * jnp.array([0.6, 0.0, -0.8]), p[0] * jnp.array([0.0, 0.75, 0.0]))
    return udk.simulate(in_a_bowl(p), TS, start, **(TIGHT | choices)).q[-1]


@pytest.mark.slow
def test_derivatives_through_closures():
    """Forward and reverse, by numbers that the functions close over and by the state, against differences."""
    h, steps = 1e-5, np.eye(3)
    differences = [(end_in_bowl(P + h * e) - end_in_bowl(P - h * e)) / (2 * h) for e in steps]
    forward, reverse = (jax.jit(derivative(end_in_bowl))(P) for derivative in (jax.jacfwd, jax.jacrev))
    assert_allclose(forward, reverse, rtol=0, atol=1e-13)
    assert_allclose(reverse, np.stack(differences, 1), rtol=0, atol=2e-6)


@pytest.mark.slow
def test_second_derivatives():
    slope, h = jax.jit(jax.jacfwd(end_in_bowl)), 1e-5
    second = jax.jit(jax.jacfwd(jax.jacfwd(end_in_bowl)))(P)
    differences = [(slope(P + h * e) - slope(P - h * e)) / (2 * h) for e in np.eye(3)]
    assert_allclose(second, np.stack(differences, 2), rtol=0, atol=2e-5)
    assert_allclose(jax.jit(jax.jacfwd(jax.jacrev(end_in_bowl)))(P), second, rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("choice", [{"method": udk.SVD()}, {"stabilization": udk.Baumgarte(5.0, 5.0)}, {"stabilization": None}])
def test_derivatives_of_other_choices(choice):
    derivatives = [jax.jit(derivative(lambda p: end_in_bowl(p, **choice)))(P) for derivative in (jax.jacfwd, jax.jacrev)]
    assert_allclose(*derivatives, rtol=0, atol=1e-12)
    assert_allclose(derivatives[0], jax.jit(jax.jacfwd(end_in_bowl))(P), rtol=0, atol=1e-8)


@pytest.mark.slow
def test_members_of_a_batch_are_single_runs():
    points = P * np.linspace(0.8, 1.2, 13)[:, None]
    batch = jax.jit(jax.vmap(end_in_bowl))(points)
    assert_allclose(batch[::4], [end_in_bowl(p) for p in points[::4]], rtol=0, atol=1e-12)


def test_numbers_do_not_compile_again():
    """Leaves of a module, and arrays of closures, are data of one program; zeros stay what they are."""

    class Ball(eqx.Module):
        weight: jax.Array

        def mass(self, q):
            return self.weight * jnp.eye(3)

    def traced(weight, pull):
        pull = np.array([0.0, 0.0, -pull])
        return trace_system(udk.ConstrainedSystem(Ball(jnp.array(weight)).mass, lambda t, q, v: jnp.asarray(pull) + 0 * q), 3)

    first, second = traced(2.0, 9.81), traced(3.0, 1.62)
    assert first.functions == second.functions
    assert [float(s.constant) for s in first.functions.force[:2]] == [0.0, 0.0]
    assert first.functions.number_count == 4
    assert [len(row) for row in first.functions.mass] == [1, 1, 1]


def test_what_has_no_scalar_form_is_left_to_diffrax():
    """The plan has the reason, which is among the settings of a run."""

    def force(t, q, v):
        return -jnp.linalg.svd(jnp.diag(q + 3.0), compute_uv=False)[::-1] * jnp.array([1.0, 2.0])

    system = trace_system(udk.ConstrainedSystem(lambda q: jnp.eye(2), force), 2)
    plan = compile_mechanism(system, None, udk.Auto(), udk.Projection()).plan
    assert not plan.is_native
    assert plan.why_not_native.endswith("which is not arithmetic on numbers")


def test_a_long_mass_matrix_is_left_to_diffrax_without_its_elimination():
    """The elimination would add some 170,000 nodes; constant entries and zeros take none."""
    n = 80

    def traced(mass):
        return trace_system(udk.ConstrainedSystem(mass, lambda t, q, v: -q), n)

    system = traced(lambda q: jnp.eye(n) + 0.1 * jnp.cos(q[0]))
    plan = compile_mechanism(system, None, udk.Auto(), udk.Projection()).plan
    assert plan.why_not_native == "the elimination of its mass matrix takes 170,640 operations, more than 60,000"
    assert len(system.functions.graph.nodes) < 2_000
    assert mass_operations(traced(lambda q: jnp.diag(2.0 + jnp.cos(q))).functions.mass) == 0


@pytest.mark.slow
def test_the_operations_of_a_mass_matrix():
    """As many as the elimination writes, but those with pivots."""
    mass = trace_system(random_system(3, n=12, m=0, k=0), 12).functions.mass
    graph = mass[0][0].graph
    before = len(graph.nodes)
    factorize_mass(graph, mass, [])
    assert mass_operations(mass) == pytest.approx(len(graph.nodes) - before, rel=0.2)


def test_the_shape_of_what_functions_return():
    system = udk.ConstrainedSystem(lambda q: jnp.ones(3), lambda t, q, v: -q)
    with pytest.raises(
        ArgumentError, match=r"mass must return the shape \(3, 3\) for 3 coordinates, not an array of shape \(3,\)"
    ):
        udk.simulate(system, TS, udk.State(np.zeros(3), np.zeros(3)))


def test_quantities_of_a_motion():
    """Energy, violation, load and multipliers of the spatial pendulum, of which all are known; also with traced numbers."""
    mass, length = 2.0, 1.0
    system = pendulum(mass, length)
    start = udk.State(np.array([0.6, 0.0, -0.8]), np.array([0.0, 1.5, 0.0]))
    run = udk.simulate(system, TS, start, **TIGHT)
    energy = udk.energy(system, run)
    assert_allclose(energy.kinetic, mass * np.sum(np.square(run.v), 1) / 2, rtol=1e-14)
    assert_allclose(energy.total, mass * (1.5**2 / 2 - 0.8 * G), rtol=1e-10)
    assert_allclose(udk.violation(system, run), 0.0, atol=1e-15)
    reaction = udk.reactions(system, run)["constraint"]
    pull = mass * (np.sum(np.square(run.v), 1) - G * np.asarray(run.q)[:, 2])
    assert_allclose(reaction["load"], -pull[:, None] * run.q, atol=1e-9)
    assert_allclose(reaction["multipliers"][:, 0], pull / 2, atol=1e-9)
    assert_allclose(udk.singular_values(system, 0.0, start.q), [2.0], rtol=1e-14)
    slope = jax.grad(lambda m: udk.energy(pendulum(m, length), run).total[0])(mass)
    assert_allclose(slope, energy.total[0] / mass, rtol=1e-12)


def test_assembly():
    """The nearest state on the sphere, with its derivative by the radius; a state that cannot be closed is refused."""
    guess = udk.State(np.array([0.7, 0.1, -0.8]), np.array([0.0, 1.5, 0.0]))
    unit = guess.q / np.linalg.norm(guess.q)
    found = udk.assemble(pendulum(), 0.0, guess)
    assert_allclose(found.q, unit, atol=1e-14)
    assert_allclose(found.v, guess.v - unit * (unit @ guess.v), atol=1e-14)
    assert_allclose(jax.jacrev(lambda length: udk.assemble(pendulum(2.0, length), 0.0, guess).q)(1.0), unit, atol=1e-12)
    never = udk.ConstrainedSystem(lambda q: jnp.eye(3), constraint=lambda t, q: q @ q + 1.0)
    with pytest.raises(udk.AssemblyError, match="Psi by 1"):
        udk.assemble(never, 0.0, guess)
    with pytest.raises(ValueError, match="no initial guess"):
        udk.assemble(pendulum())


def test_a_system_without_numbers():
    """A harmonic oscillator, whose functions hold no number: each function of a system takes it, at once and within JAX's own."""
    system = udk.ConstrainedSystem(lambda q: jnp.eye(1), lambda t, q, v: -q)
    start, ts = udk.State(np.array([1.0]), np.array([0.5])), np.array([0.0, 0.4])
    exact = start.q * np.cos(0.4) + start.v * np.sin(0.4), np.array([[np.cos(0.4), np.sin(0.4)]])

    def ends(q, v):
        stepped = udk.step(system, udk.State(q, v), None, 0.4, **TIGHT).q
        return jnp.stack([stepped, udk.simulate(system, ts, udk.State(q, v), **TIGHT).q[-1]])

    given = jnp.asarray(start.q), jnp.asarray(start.v)
    assert_allclose(ends(start.q, start.v), [exact[0]] * 2, atol=1e-9)
    assert_allclose(jax.jit(ends)(*given), [exact[0]] * 2, atol=1e-9)
    assert_allclose(jax.vmap(ends)(*(jnp.stack([x, 2 * x]) for x in given)), [[exact[0]] * 2, [2 * exact[0]] * 2], atol=1e-9)
    slopes = jnp.concatenate(jax.jacrev(ends, (0, 1))(*given), axis=-1)
    assert_allclose(slopes, [exact[1]] * 2, atol=1e-9)
    run = udk.simulate(system, ts, start, events=udk.Event(lambda t, q, v: v[0], udk.Log(), name="turns"), **TIGHT)
    assert run.events is not None and int(run.events.count) == 0
    assert udk.violation(system, run).shape == (2, 0) and not udk.reactions(system, run)
    assert_allclose(udk.accelerations(system, 0.0, start.q, start.v), -start.q, atol=1e-14)
    assert udk.diagnose(system, start).degrees_of_freedom == 1 and system.parameters() == {}
    data = udk.sweep(system, {"rtol": [1e-8, 1e-10]}, ts, state=start, atol=1e-10)
    assert_allclose(data["q_end"], [exact[0]] * 2, atol=1e-6)


@pytest.mark.slow
def test_control_intervals():
    """Four intervals are one run; a gradient through a loop of them, whose systems hold the inputs."""
    start = udk.State(np.array([0.6, 0.0, -0.8]), np.array([0.0, 1.5, 0.0]))

    def end(push):
        def advance(state, k):
            base = pendulum()
            pushed = udk.ConstrainedSystem(
                base.mass, lambda t, q, v: push * jnp.array([1.0, 0.0, 0.0]), base.constraint, potential=base.potential
            )
            return udk.step(pushed, state, None, 0.5, **TIGHT), None

        return jax.lax.scan(advance, start, jnp.arange(4))[0].q

    single = udk.simulate(pendulum(), np.array([0.0, 2.0]), start, **TIGHT)
    assert_allclose(end(0.0), single.q[-1], atol=1e-8)
    slope = jax.jit(jax.jacrev(end))(0.3)
    assert_allclose(slope, (end(0.3 + 1e-4) - end(0.3 - 1e-4)) / 2e-4, atol=1e-6)
    with pytest.raises(ValueError, match="inputs are for mechanisms"):
        udk.step(pendulum(), start, {"mass": 1.0}, 0.5)


class Pushed(eqx.Module):
    """A pendulum that a force pushes until a breakpoint."""

    push: Any

    def force(self, t, q, v):
        return jnp.where(t < 0.5, self.push, 0.0) * jnp.array([1.0, 0.0, 0.0])

    def system(self):
        base = pendulum()
        return udk.ConstrainedSystem(base.mass, self.force, base.constraint, breakpoints=[0.5], potential=base.potential)


@pytest.mark.slow
def test_methods_of_a_module_with_a_breakpoint():
    """The system itself is an argument of a compiled function; its leaf has a derivative on both sides of the jump."""
    start = udk.State(np.array([0.6, 0.0, -0.8]), np.array([0.0, 1.5, 0.0]))
    end = eqx.filter_jit(lambda system: udk.simulate(system, TS, start, **TIGHT).q[-1])
    slope = jax.jacrev(lambda push: end(Pushed(push).system()))(jnp.array(1.0))
    assert_allclose(slope, (end(Pushed(1.0 + 1e-4).system()) - end(Pushed(1.0 - 1e-4).system())) / 2e-4, atol=1e-6)
    halves = udk.simulate(Pushed(jnp.array(1.0)).system(), np.array([0.0, 0.5]), start, **TIGHT)
    rest = udk.simulate(pendulum(), np.array([0.5, 2.0]), udk.State(halves.q[-1], halves.v[-1]), **TIGHT)
    assert_allclose(end(Pushed(jnp.array(1.0)).system()), rest.q[-1], atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("choice", "is_native"),
    [({"solver": diffrax.Kvaerno5()}, True), ({"formulation": udk.Augmented()}, True), ({"solver": udk.BDF()}, False)],
)
def test_other_solvers_and_formulations(choice, is_native):
    """An implicit Runge-Kutta method and a formulation by machine code; BDF by diffrax, whose steps machine code evaluates."""
    start = udk.State(np.array([0.6, 0.0, -0.8]), np.array([0.0, 1.5, 0.0]))
    one, other = (udk.simulate(pendulum(), TS, start, rtol=1e-9, atol=1e-9, **x) for x in (choice, {}))
    assert (one.settings["engine"] == "native") == is_native
    assert_allclose(one.q, other.q, atol=1e-7)


@pytest.mark.slow
def test_single_precision():
    """Runs, assembly and sweeps in float32, by diffrax; events and ranks say that they need float64."""
    code = """
import numpy as np, jax.numpy as jnp, udkjax as udk
rate, ts = np.sqrt(9.81 / 0.6), np.linspace(0, 1, 3)
system = udk.ConstrainedSystem(
    lambda q: 2.0 * jnp.eye(3), constraint=lambda t, q: {"rod": q @ q - 1.0}, potential=lambda t, q: 2 * 9.81 * q[2],
    q0=[0.8, 0.0, -0.6], v0=[0.0, 0.8 * rate, 0.0])
run = udk.simulate(system, ts, rtol=1e-4, atol=1e-4)
exact = np.stack([0.8 * np.cos(rate * ts), 0.8 * np.sin(rate * ts), 0 * ts - 0.6], 1)
data = udk.sweep(system, {"rtol": [1e-3, 1e-4]}, ts, progress=False)
print(run.q.dtype, bool(np.abs(run.q - exact).max() < 1e-4), bool(np.abs(data.q_end[1] - exact[-1]).max() < 1e-4))
for function in (lambda: udk.diagnose(system), lambda: udk.simulate(system, ts, events=udk.Event(lambda t, q, v: q[0]))):
    try:
        function()
    except ValueError as error:
        print("leave JAX_ENABLE_X64 unset" in str(error))
"""
    assert python(code, JAX_ENABLE_X64="0").split() == ["float32", "True", "True", "True", "True"]


@pytest.mark.parametrize("mode", [FORWARD, REVERSE])
def test_derivatives_of_a_chain_grow_as_its_length(mode):
    """The solution of the equations passes tangents from body to body; its Jacobian has an entry for each pair of bodies."""

    def operations(rods):
        system = trace_system(spatial_chain(rods)[0], 7 * rods)
        programs = system_programs(system, False)
        both = Unrolled(programs, [], [("a",)], [False] * programs.number_count, mode).derivative("a")
        return np.array([len(x.program.order) for x in both])

    short, long = operations(2), operations(4)
    assert np.all(long < 2.3 * short)


@pytest.mark.slow
def test_a_long_chain_in_space_swings_in_its_plane_as_a_planar_one():
    """56 coordinates and 32 rows, 8,000 operations, by machine code: derivatives and batches, too."""
    n, ts = 8, np.linspace(0.0, 1.0, 6)
    system, start, in_plane = spatial_chain(n)
    planar = udk.simulate(in_plane, ts, rtol=1e-10, atol=1e-10)

    def places(spin):
        state = udk.State(start.q, spin * jnp.asarray(turning))
        return udk.simulate(system, ts, state, rtol=1e-10, atol=1e-10).q.reshape(len(ts), n, 7)[..., :3]

    turning = udk.assemble(system, 0.0, udk.State(start.q, np.tile([0, 1, 0, 0, 0, 0, 0.0], n))).v
    run = udk.simulate(system, ts, start, rtol=1e-10, atol=1e-10)
    assert run.settings["engine"] == "native"
    assert_allclose(run.q.reshape(len(ts), n, 7)[..., [0, 2]], planar.q[..., :2], atol=1e-7)
    assert np.abs(udk.violation(system, run)).max() < 1e-12
    batch = jax.vmap(places)(jnp.array([0.0, 0.3]))
    assert_allclose(batch[0][..., [0, 2]], planar.q[..., :2], atol=1e-7)
    assert np.abs(batch[1][..., 1]).max() > 0.01  # out of the plane
    one = lambda spin: places(spin)[-1, -1, 1]  # noqa: E731
    slope = (one(0.3 + 1e-4) - one(0.3 - 1e-4)) / 2e-4
    assert_allclose([jax.jacfwd(one)(0.3), jax.grad(one)(0.3)], slope, rtol=1e-6)


@pytest.mark.parametrize(
    ("functions", "message"),
    [
        ({"constraint": lambda q: q}, r"constraint must be a function \(t, q\), not of \(q\)"),
        ({"force": lambda t, q: q}, r"force must be a function \(t, q, v\), not of \(t, q\)"),
        ({"mass": np.eye(2)}, r"mass must be a function \(q\), not an? ndarray"),
        ({"q0": np.zeros(2), "v0": np.zeros(3)}, r"v0 must have the shape of q0, \(2,\); it has the shape \(3,\)"),
    ],
)
def test_functions_that_do_not_fit_are_named(functions, message):
    with pytest.raises((TypeError, ValueError), match=message):
        udk.ConstrainedSystem(**{"mass": lambda q: jnp.eye(2)} | functions)


@pytest.mark.parametrize(
    ("functions", "message"),
    [
        ({"mass": lambda q: -jnp.eye(2)}, r"not positive definite: its eigenvalues are -1 to -1.*check the signs in `mass`"),
        (
            {"mass": lambda q: jnp.eye(2) + jnp.sin(q[0]) * jnp.array([[0.0, 0.1], [0.0, 0.0]])},
            r"mass must return a symmetric matrix; at q = .* entry \[0, 1\] is 0.012.*, and \[1, 0\] is 0",
        ),
        (
            {"mass": lambda q: jnp.diag(jnp.array([1.0, 0.0]))},
            "mass matrix is not positive definite: its eigenvalues are 0 to 1. Add mass in directions that",
        ),
        ({"constraint": lambda t, q: {"rod": jnp.log(-q[0])}}, "constraint of the system is not finite"),
        ({"mass": lambda q: None}, r"mass must return the shape \(2, 2\) for 2 coordinates, not None"),
        ({"constraint": lambda t, q: {"rod": None}}, "constraint must return a vector for 2 coordinates, not None"),
        ({"potential": lambda t, q: "y"}, 'potential must return a number for 2 coordinates, not "y"'),
    ],
)
@pytest.mark.parametrize("function", [udk.assemble, lambda system: udk.simulate(system, TS)])
def test_functions_whose_values_do_not_fit_are_named(functions, message, function):
    circle = {"constraint": lambda t, q: {"rod": q @ q - 1.0}, "potential": lambda t, q: q[1]}
    system = udk.ConstrainedSystem(**{"mass": lambda q: jnp.eye(2)} | circle | functions, q0=[1.0, 0.0])
    with pytest.raises((TypeError, ValueError, RuntimeError), match=message):
        function(system)


@pytest.mark.parametrize(
    "force", [lambda t, q, v: -np.sin(q), lambda t, q, v: -q if q[0] > 0 else q, lambda t, q, v: [float(q[0])]]
)
def test_a_function_that_jax_cannot_trace_is_named(force):
    system = udk.ConstrainedSystem(lambda q: jnp.eye(1), force, q0=[1.0])
    with pytest.raises(TypeError) as raised:
        udk.simulate(system, TS)
    assert "force of a ConstrainedSystem is traced by JAX: write it with jax.numpy" in raised.value.__notes__[0]
