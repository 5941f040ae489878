"""Contacts that come to rest close their gaps without pushing others below zero."""

# pyright: reportOptionalMemberAccess=false
# All of these runs have events.
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.integrate.events.event_scenes import G
from udkjax.complementarity.linear import solve_complementarity

NORMALS = np.array([[0.0, 1.0], [0.6, 0.8]])  # of a floor and of a wall that leans over it
GAP = 5e-10  # m: of the floor where the ball hits the wall; closed, but not zero
SPEEDS = np.array([-1e-4, -2e-5])  # m/s: of both gaps there. A ball that is lifted so slowly stays as close for a while
BEFORE = 4e-6  # s from the start to that time


def corner_start() -> np.ndarray:
    """Return x, y and the velocity of the ball at the start of a free fall to the corner."""
    q, v, g = np.linalg.solve(NORMALS, [GAP, 0.0]), np.linalg.solve(NORMALS, SPEEDS), np.array([0.0, -G])
    return np.concatenate([q - v * BEFORE + g * BEFORE**2 / 2, v - g * BEFORE])


def corner(x: Any, restitution: Any, engine: Any = "native", **floor: Any) -> udk.Solution:
    """A ball comes to rest on a floor, and is lifted from a wall at the same time."""
    ball = udk.Mechanism({"ball": udk.Body(1.0, 0.1)})
    ball = ball.with_parameters({"body.ball.position": x[:2], "body.ball.velocity": x[2:]})
    walls = [
        udk.Contact("ball", name="floor", **floor),
        udk.Contact("ball", normal=NORMALS[1], restitution=restitution, name="wall"),
    ]
    return udk.simulate(ball, np.linspace(0.0, 0.5, 6), events=walls, throw=False, max_events=12, engine=engine)


PLAIN = pytest.param("diffrax", marks=pytest.mark.slow)


@pytest.mark.parametrize("engine", ["native", PLAIN])
@pytest.mark.parametrize("coefficient", [None, 0.1])
def test_a_lifted_contact_is_not_pushed_below_zero_where_another_comes_to_rest(engine, coefficient):
    sol = corner(corner_start(), 0.5, engine, coefficient=coefficient)
    assert sol.result == udk.Result.successful
    assert int(sol.events.counts["floor rests"]) == 1 and int(sol.events.counts["wall"]) <= 2
    before, after, v0, v1 = (
        np.asarray(x)[:, 0, :2] for x in (sol.events.q_before, sol.events.q_after, sol.events.v_before, sol.events.v_after)
    )
    assert (before @ NORMALS[0]).max() > 1e-10 and (after @ NORMALS.T).min() > -1e-15
    k = int(np.flatnonzero((after != before).any(1))[0])  # the event that closes both
    assert np.abs(after[k] @ NORMALS.T).max() < 1e-15 and (v1[k] @ NORMALS.T)[1] > 1e-6
    assert ((v1**2).sum(1) <= (v0**2).sum(1)).all()
    assert (np.asarray(sol.q)[1:, 0, :2] @ NORMALS.T).min() > -1e-12


@pytest.mark.slow
def test_derivatives_where_two_contacts_are_closed_together():
    """Compared with differences so small that the events stay the same."""

    def smooth(x):
        sol = corner(x[:4], x[4])
        return jnp.concatenate([sol.q[-1, 0, :2], sol.v[-1, 0, :2], sol.events.time[:2]])

    x, steps = np.append(corner_start(), 0.5), np.array([1e-13, 1e-13, 1e-9, 1e-9, 1e-4])
    value = jax.jit(smooth)
    differences = np.stack([(value(x + d) - value(x - d)) / (2 * d.sum()) for d in np.diag(steps)], axis=1)
    for derivative in (jax.jacfwd, jax.jacrev):
        jacobian = np.asarray(jax.jit(derivative(smooth))(x))
        assert (np.abs(jacobian - differences).max(0) < 1e-4 * np.abs(differences).max(0)).all()


@pytest.mark.parametrize("engine", ["native", PLAIN])
def test_an_attached_joint_pushes_no_contact_below_zero(engine):
    """A ball that rises from a floor catches another one, half a micrometre lower."""
    fall, rise, bodies = np.array([0.0, -G]), 1e-3, {}
    for name, y, speed in (("low", 1e-8 - 5e-7, 1.0), ("ball", 1e-8, -1.0)):
        v, t = np.array([speed, rise]), 5e-6
        bodies[name] = udk.Body(1.0, 0.1, np.array([0.0, y]) - v * t + fall * t**2 / 2, velocity=v - fall * t)
    glue = udk.Attach(udk.Weld(("low", "ball"), [[0, 0], [0, 0]]), "glue")
    events = [udk.Event(lambda t, at: at["ball"].x - at["low"].x, glue, name="caught"), udk.Contact("ball", name="floor")]
    ts = np.linspace(0.0, 0.3, 4)
    sol = udk.simulate(udk.Mechanism(bodies), ts, events=events, throw=False, max_events=12, engine=engine)
    assert sol.result == udk.Result.successful
    counts = {name: int(n) for name, n in sol.events.counts.items() if n}
    assert counts == {"caught": 1, "floor": 1, "floor rests": 1}
    after = np.asarray(sol.events.q_after)
    assert np.abs(after[0, 0, :2] - after[0, 1, :2]).max() < 1e-12 and after[:, :, 1].min() > -1e-12
    assert np.abs(np.asarray(sol.events.time)[1] - 5e-6 - 2 * rise / G) < 1e-7  # a throw from zero


def test_equalities_of_a_complementarity_problem_hold_besides_its_inequalities():
    """Compared with all active sets, by NumPy and JAX."""
    rng = np.random.default_rng(3)
    E, n = 5, 60
    U = rng.normal(size=(n, E, 5)) * 10 ** rng.uniform(-2, 2, size=(n, E, 1))
    W, b = U @ U.swapaxes(1, 2), rng.normal(size=(n, E)) * np.linalg.norm(U, axis=2)
    equal = rng.uniform(size=(n, E)) < 0.4
    allowed = (rng.uniform(size=(n, E)) < 0.8) & ~equal
    by_numpy = solve_complementarity(W, b, allowed, np.zeros((n, E)), equal, np)
    solve = jax.jit(lambda W, b: solve_complementarity(W, b, jnp.asarray(allowed), jnp.zeros((n, E)), jnp.asarray(equal)))
    by_jax = solve(W, b)
    negative = 0
    for k in range(n):
        found = []
        choices = [[True] if e else [False, True] if a else [False] for e, a in zip(equal[k], allowed[k], strict=True)]
        for chosen in product(*choices):
            active, x = np.flatnonzero(chosen), np.zeros(E)
            x[active] = np.linalg.solve(W[k][np.ix_(active, active)], -b[k, active])
            y = W[k] @ x + b[k]
            if (x[allowed[k]] >= 0).all() and (y[allowed[k]] >= -1e-9 * np.abs(b[k]).max()).all():
                found.append(x)
        assert len(found) == 1
        negative += (found[0][equal[k]] < 0).any()
        for solution in (by_numpy, by_jax):
            np.testing.assert_allclose(np.asarray(solution.x)[k], found[0], rtol=1e-6, atol=1e-9 * np.abs(found[0]).max())
    assert negative > 10
