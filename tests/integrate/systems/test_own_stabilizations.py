"""User-defined stabilizations in machine code, against the same text in diffrax."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from experiments.parts.atlas_own import BraunGoldfarb
from tests.integrate.systems.own_systems import G, pendulum
from tests.integrate.systems.test_own_methods import BenIsrael
from udkjax.native.lowering.lowering import SEPARATE_FUNCTION_SIZE
from udkjax.native.lowering.module_calls import ModuleCall, call_p, simplified

RATE = np.sqrt(G / 0.6)  # of the conical pendulum 0.6 m below its pivot
ON = udk.State([0.8, 0.0, -0.6], [0.0, 0.8 * RATE, 0.0])
OFF = udk.State([0.801, 0.0, -0.6], [0.0, 0.8 * RATE, 0.01])
TS = np.linspace(0.0, 0.5, 4)


class OwnBaumgarte(udk.Stabilization):
    """The terms of `Baumgarte`."""

    alpha: jax.Array
    beta: jax.Array

    def rates(self, at, v, a):
        return v, a - at.change_of_velocities(2 * self.alpha * at.psi_dot + self.beta**2 * at.psi)


class ByRows(udk.Stabilization):
    """The same with gains for each row, all of them negative."""

    gains: jax.Array  # (2, m)

    def rates(self, at, v, a):
        return v, a + at.change_of_velocities(2 * self.gains[0] * at.psi_dot - self.gains[1] ** 2 * at.psi)


class Relaxing(udk.Stabilization):
    """Violations fade at a rate, which makes q' differ from v as long as there are any."""

    gain: jax.Array

    def rates(self, at, v, a):
        return v - self.gain * at.change_of_positions(at.psi), a - self.gain * at.change_of_velocities(at.psi_dot)


class Newton(udk.Stabilization):
    """`Projection`, by three steps of Newton's method for positions; `at` is the state of a loop."""

    def end_of_step(self, at):
        def step(_, at):
            return at.moved(at.q - at.change_of_positions(at.psi), at.v)

        at = jax.lax.fori_loop(0, 3, step, at)
        return at.q, at.v - at.change_of_velocities(at.psi_dot)


class LongNewton(udk.Stabilization):
    """The same, in a loop whose body is so long that it becomes a function, which calls the equations."""

    def end_of_step(self, at):
        def step(_, at):
            for _ in range(SEPARATE_FUNCTION_SIZE):
                at = at.moved(at.q * 1.0, at.v)
            return at.moved(at.q - at.change_of_positions(at.psi), at.v)

        at = jax.lax.fori_loop(0, 3, step, at)
        return at.q, at.v - at.change_of_velocities(at.psi_dot)


class NewtonAndRates(BraunGoldfarb):
    def end_of_step(self, at):
        return Newton().end_of_step(at)


class Drag(udk.Stabilization):
    """A load along the motion, from the accelerations and masses of the state."""

    def rates(self, at, v, a):
        push = jnp.linalg.solve(at.mass, -0.1 * at.mass @ v)
        return v, at.accelerations + push - at.change_of_velocities(at.psi_dot)


def skater():
    """A sleigh that is pulled, with an eccentric mass: M is not diagonal, and its blade restricts velocities alone."""

    def mass(q):
        shift = -0.1 * jnp.sin(q[2])
        return jnp.diag(jnp.array([1.0, 1.0, 0.2])).at[0, 2].set(shift).at[2, 0].set(shift)

    return udk.ConstrainedSystem(
        mass,
        force=lambda t, q, v: jnp.array([jnp.sin(t), -1.0, 0.1]),
        constraint=lambda t, q: q[2:] - 0.3 * t,
        velocity_constraint=lambda t, q, v: v[1] * jnp.cos(q[2]) - v[0] * jnp.sin(q[2]),
    )


SCENES = {
    "redundant": (udk.library.parallelogram, None),
    "pendulum": (pendulum, ON),
    "open": (pendulum, OFF),
    "skater": (skater, udk.State([0.0, 0.0, 0.0], [1.0, 0.0, 0.3])),
}


def run(scene: str, stabilization: Any, **choices: Any) -> udk.Solution:
    make, start = SCENES[scene]
    settings: Any = {"rtol": 1e-8, "atol": 1e-8, "drift_tol": np.inf} | choices
    return udk.simulate(make(), settings.pop("ts", TS), start, stabilization=stabilization, **settings)


@pytest.mark.parametrize(
    ("scene", "stabilization"),
    [
        ("redundant", BraunGoldfarb()),
        ("pendulum", NewtonAndRates()),
        pytest.param("open", Relaxing(jnp.array(10.0)), marks=pytest.mark.slow),
        pytest.param("skater", Newton(), marks=pytest.mark.slow),
        pytest.param("skater", Relaxing(jnp.array(10.0)), marks=pytest.mark.slow),
        pytest.param("redundant", Newton(), marks=pytest.mark.slow),
        pytest.param("redundant", Drag(), marks=pytest.mark.slow),
    ],
)
def test_machine_code_and_diffrax(scene, stabilization):
    """The same motion within the tolerance, also between steps."""
    native, other = (run(scene, stabilization, engine=engine) for engine in ("native", "diffrax"))
    assert_allclose(native.q, other.q, atol=1e-6)
    assert_allclose(native.v, other.v, atol=1e-5)


@pytest.mark.parametrize("method", [None, BenIsrael()])
def test_own_text_of_a_stabilization_of_the_package(method):
    """The same steps and states, up to rounding, also between steps, and with a pseudoinverse of one's own."""
    own, other = (
        run("redundant", x, method=method, engine="native")
        for x in (OwnBaumgarte(jnp.array(5.0), jnp.array(4.0)), udk.Baumgarte(5.0, 4.0))
    )
    assert own.stats["steps"] == other.stats["steps"]
    assert_allclose(own.q, other.q, atol=1e-11)
    assert_allclose(own.v, other.v, atol=1e-10)


def test_fields_may_be_any_finite_numbers():
    """Arrays, and negative ones: they are no thresholds."""
    gains = -np.tile([[5.0], [4.0]], 12)
    own, other = (run("redundant", x) for x in (ByRows(jnp.array(gains)), OwnBaumgarte(jnp.array(5.0), jnp.array(4.0))))
    assert own.settings["engine"] == "native"
    assert_allclose(own.q, other.q, atol=1e-12)
    batch = jax.vmap(lambda gains: run("redundant", ByRows(gains)).q)(jnp.stack([gains, 2 * gains]))
    assert_allclose(batch[0], own.q, atol=1e-12)
    gains[1, 2] = np.nan
    with pytest.raises(ValueError, match=r"stabilization.gains\[1, 2\] is nan: it must be finite"):
        run("redundant", ByRows(jnp.array(gains)))


def test_projection_by_hand():
    """The end of each step is that of `Projection`, and so is the motion."""
    own = run("redundant", Newton(), engine="native")
    assert_allclose(own.q, run("redundant", udk.Projection()).q, atol=1e-7)
    assert np.abs(udk.violation(udk.library.parallelogram(), own))[-1].max() < 1e-12


def test_a_long_loop_that_calls_the_equations():
    first, second = (udk.simulate(udk.library.four_bar(), TS, stabilization=x()) for x in (Newton, LongNewton))
    assert first.settings["engine"] == second.settings["engine"] == "native"
    assert_allclose(second.q, first.q, rtol=0, atol=1e-14)


def test_lanes():
    """Members with numbers of their own, in the mechanism and in the stabilization, as alone."""

    def end(mass, gain):
        linkage = udk.library.parallelogram().with_parameters({"body.link1.mass": mass})
        return udk.simulate(linkage, TS, stabilization=Relaxing(gain), engine="native", rtol=1e-7, atol=1e-7).q[-1]

    masses, gains = jnp.linspace(1.0, 2.0, 9), jnp.linspace(1.0, 20.0, 9)
    found = jax.jit(jax.vmap(end))(masses, gains)
    for k in (0, 4, 8):
        assert_allclose(found[k], end(masses[k], gains[k]), atol=1e-12)


def test_positions_slip_from_velocities():
    """Outputs between steps, where q' is not v at first: dense outputs have their own rates, and the errors of the states."""
    ts = np.linspace(0.0, 0.5, 201)
    found = run("open", Relaxing(jnp.array(10.0)), ts=ts, engine="native")
    slope = np.gradient(np.asarray(found.q), ts, axis=0)[1:-1]
    radius, slip = np.linalg.norm(found.q, axis=1), slope - np.asarray(found.v)[1:-1]
    assert np.abs(slip).max() > 5e-3
    exact = -10 * (radius**2 - 1) / (2 * radius)  # the least change along the radius
    along = (np.asarray(found.q) / radius[:, None])[1:-1]
    assert_allclose((slip * along).sum(1), exact[1:-1], atol=2e-4)
    finer = run("open", Relaxing(jnp.array(10.0)), ts=ts, engine="native", rtol=1e-11, atol=1e-11)
    assert_allclose(found.q, finer.q, atol=1e-6)
    assert_allclose(found.v, finer.v, atol=1e-6)


@pytest.mark.slow
def test_derivatives():
    """By a mass and by a gain, forward and reverse, against differences of runs by machine code."""

    def end(x):
        linkage = udk.library.parallelogram().with_parameters({"body.link1.mass": x[0]})
        return udk.simulate(linkage, TS, stabilization=Relaxing(x[1]), rtol=1e-10, atol=1e-10).q[-1].ravel()

    x, h = jnp.array([1.2, 5.0]), 1e-4
    differences = jnp.stack([(end(x + h * e) - end(x - h * e)) / (2 * h) for e in jnp.eye(2)], axis=1)
    assert_allclose(jax.jit(jax.jacfwd(end))(x), differences, atol=1e-6)
    assert_allclose(jax.jit(jax.grad(lambda x: end(x).sum()))(x), differences.sum(0), atol=1e-6)


class BySchurForm(udk.Stabilization):
    matrix: Any = None

    def rates(self, at, v, a):
        return v, a - jax.scipy.linalg.schur(at.mass)[1] @ v


class Differentiating(udk.Stabilization):
    def rates(self, at, v, a):
        return v, a - jax.jacfwd(lambda q: at.moved(q, v).psi)(at.q).T @ at.psi


class OfWrongShape(udk.Stabilization):
    def rates(self, at, v, a):
        return v, a[:2]


@pytest.mark.parametrize(
    ("scene", "stabilization", "reason"),
    [
        ("redundant", BySchurForm(), "the operation schur of the stabilization BySchurForm"),
        ("redundant", BySchurForm(np.array(2)), "arrays of type int64 of the stabilization BySchurForm"),
        ("redundant", Differentiating(), "the stabilization Differentiating"),
        ("redundant", OfWrongShape(), "the stabilization OfWrongShape"),
        ("skater", Drag(), "a mass matrix that is not diagonal of the stabilization Drag"),
    ],
)
def test_a_stabilization_without_machine_code(scene, stabilization, reason):
    with pytest.raises(ValueError, match=reason):
        run(scene, stabilization, engine="native")


def test_other_arguments_without_machine_code():
    with pytest.raises(ValueError, match="partitions coordinates without BraunGoldfarb"):
        run("redundant", BraunGoldfarb(), formulation=udk.CoordinatePartitioning(), engine="native")
    with pytest.raises(ValueError, match="explicit methods only, and Kvaerno5 is implicit"):
        run("redundant", BraunGoldfarb(), solver=diffrax.Kvaerno5(), engine="native")


def test_calls_that_are_left_out():
    """Repeated and unused calls; and preparations, unless the memory of the module holds another one since."""
    solve = ModuleCall(("factor", "solve"), ("q", "b"), (("x", (2,)),), 1)
    psi = ModuleCall(("psi",), ("q",), (("y", (2,)),))

    def text(q, r):
        (y,), (again,), (unused,) = psi(q), psi(q), psi(r)
        del unused
        (a,), (b,), (c,), (d,) = solve(q, y), solve(q, 2 * again), solve(r, y), solve(q, 3 * y)
        e = jax.lax.fori_loop(0, 2, lambda _, x: solve(q, x)[0], d)
        return a + b + c + d + e + solve(q, r)[0]

    given = [jax.ShapeDtypeStruct((2,), float)] * 2
    found = simplified(jax.make_jaxpr(text)(*given))
    calls = [e.params["call"].functions for e in found.jaxpr.eqns if e.primitive is call_p]
    whole = ("factor", "solve")
    assert calls == [("psi",), whole, ("solve",), whole, whole, whole]


class Unused(BraunGoldfarb):
    """A stabilization that asks for a change which it does not use, before the one that it uses."""

    def rates(self, at, v, a):
        at.change_of_velocities(3.0 * at.psi_dot)
        return super().rates(at, v, a)


def test_an_unused_change_prepares_nothing():
    """The call that is left out is the one that would have factored the rows."""
    scene, ts = udk.library.four_bar(), np.linspace(0.0, 1.0, 3)
    runs = [udk.simulate(scene, ts, stabilization=x, engine="native").q for x in (BraunGoldfarb(), Unused())]
    np.testing.assert_array_equal(runs[0], runs[1])
