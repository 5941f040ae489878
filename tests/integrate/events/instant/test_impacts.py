"""Impacts and rest of several contacts at once: compared with enumerated active sets, energy, closed forms and differences."""

# pyright: reportOptionalMemberAccess=false
# All of these runs have events.
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls

import udkjax as udk
from udkjax.complementarity.linear import solve_complementarity
from udkjax.integrate.events.instant.impacts import ContactRows, impulses_of_impact

G = 9.81


def enumerate_active_sets(W, b, allowed):
    """Return all distinct y = W x + b >= 0 with 0 <= x, x y = 0, by trying every active set."""
    found, tol = [], 1e-9 * np.abs(b).max()
    for chosen in product(*[[False, True] if ok else [False] for ok in allowed]):
        active = np.flatnonzero(chosen)
        x = np.zeros(len(b))
        x[active] = np.linalg.lstsq(W[np.ix_(active, active)], -b[active])[0]
        y = W @ x + b
        if (
            np.all(x > -tol)
            and np.all(y[allowed] > -tol)
            and np.all(np.abs(y[active]) < tol)
            and not any(np.abs(y - z).max() < 1e-6 * np.abs(b).max() for z in found)
        ):
            found.append(y)
    return found


def test_complementarity_is_that_of_enumeration_and_energy_never_grows():
    """Random contacts, some of them dependent or not involved, with all kinds of restitution."""
    rng = np.random.default_rng(5)
    E, n = 5, 200
    U = rng.normal(size=(n, E, 4)) * 10 ** rng.uniform(-2, 2, size=(n, E, 1))
    U[: n // 4, 4] = U[: n // 4, 3]  # the same contact twice
    U[n // 4 : n // 2, 2] = U[n // 4 : n // 2, :2].sum(1)
    W = U @ U.swapaxes(1, 2)
    p = rng.normal(size=(n, 4))
    rate = np.einsum("nei,ni->ne", U, p)
    e = rng.uniform(0, 1, size=(n, E)) * rng.integers(0, 2, size=(n, 1))
    e[:20] = 1.0
    closed = (rate <= 0) & (rng.uniform(size=(n, E)) < 0.8)

    @jax.jit
    @jax.vmap
    def hit(W, U, rate, e, closed):
        rows = ContactRows(W, U, jnp.full(E, True))
        return impulses_of_impact(rows, rate, e, closed, jnp.zeros(E)), solve_complementarity(W, rate, closed, jnp.zeros(E))

    found, plain = jax.tree.map(np.asarray, hit(W, U, rate, e, closed))
    size = np.linalg.norm(p, axis=1)
    assert closed.sum() > n and not found.remaining.any()
    assert found.impulse.min() >= 0 and (found.impulse[~closed] == 0).all()
    target = np.where(closed, found.rate + e * rate, 0.0) / np.linalg.norm(U, axis=2)
    assert target.min() > -1e-9 * size.max() and np.abs(target * found.impulse).max() < 1e-8
    after = p + np.einsum("ne,nei->ni", found.impulse, U)
    gain = ((after**2).sum(1) - (p**2).sum(1)) / size**2
    assert gain.max() < 1e-12 and np.abs(gain[:20]).max() < 1e-12  # all e = 1: nothing is lost
    for k in range(0, n, 5):
        for y, b in ((found.rate[k] + e[k] * rate[k], (1 + e[k]) * rate[k]), (plain.y[k], rate[k])):
            if closed[k].any():
                (expected,) = enumerate_active_sets(W[k], b, closed[k])
                assert np.abs((y - expected)[closed[k]]).max() < 1e-7 * np.abs(b).max()


def dumbbell(x, inertia, ts):
    """A body that rests on its left foot and falls onto its right one; the feet are at +-a from the centre, m = 1."""
    angle, e = x[0], x[1]
    place = 0.5 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    body = udk.Mechanism({"b": udk.Body(1.0, 1.0, position=(0.5, 0.0))}).with_parameters(
        {"body.b.position": place, "body.b.angle": angle, "body.b.inertia": inertia}
    )
    feet = [udk.Contact("b", point=[-0.5, 0], name="L"), udk.Contact("b", point=[0.5, 0], restitution=e, name="R")]
    return udk.simulate(body, ts, events=feet, throw=False, max_events=6, rtol=1e-11, atol=1e-11)


INERTIAS = jnp.array([0.2, 0.4])  # kg m^2: below and above m a^2
FALL = np.linspace(0.0, 0.19, 3)  # s: within it the right foot lands once


def test_a_foot_at_rest_is_pushed_or_leaves_where_the_other_lands():
    """It is pushed if I < m a^2, and leaves if I > m a^2, as the impulse at the right foot alone shows."""
    e = np.array([0.0, 0.3])
    sol = jax.jit(jax.vmap(lambda inertia: dumbbell(jnp.array([0.1, 0.3]), inertia, FALL)))(INERTIAS)
    index, q, before, after = (
        np.asarray(x) for x in (sol.events.index, sol.events.q_before, sol.events.v_before, sol.events.v_after)
    )
    assert (sol.code == udk.Result.successful).all()
    assert (index[:, 0] == 4).all() and (index[:, 1] == 1).all()  # the left foot rests, the right one hits
    assert (index[0, 2:] == -1).all() and index[1, 2] == 2  # and only of the second body the left one lets go
    for k, inertia in enumerate(INERTIAS):
        mass, v, jump = np.array([1, 1, inertia]), before[k, 1, 0], (after - before)[k, 1, 0]
        N = np.array([[0, 1, -0.5 * np.cos(q[k, 1, 0, 2])], [0, 1, 0.5 * np.cos(q[k, 1, 0, 2])]])
        (target,) = enumerate_active_sets(N / mass @ N.T, (1 + e) * (N @ v), np.full(2, True))
        assert np.abs(N @ (v + jump) - (target - e * (N @ v))).max() < 1e-9
        impulse = np.linalg.lstsq(N.T, mass * jump)[0]
        assert impulse.min() > -1e-12 and (impulse[0] > 1e-3) == (inertia < 0.25)


@pytest.mark.slow
def test_gradients_of_an_impact_with_a_contact_at_rest_beside_it():
    """Compared with differences, for a contact at rest that is pushed, and for one that leaves."""

    def smooth(x, inertia):
        sol = dumbbell(x, inertia, FALL)
        return jnp.concatenate([sol.q[-1, 0], sol.v[-1, 0], sol.events.time[:2]])

    x, h = jnp.array([0.1, 0.3]), 1e-5
    value = jax.jit(jax.vmap(smooth, (None, 0)))
    differences = [(value(x + h * d, INERTIAS) - value(x - h * d, INERTIAS)) / (2 * h) for d in np.eye(2)]
    jacobian = jax.jit(jax.vmap(jax.jacfwd(smooth), (None, 0)))(x, INERTIAS)
    assert np.abs(jacobian - np.stack(differences, axis=-1)).max() < 1e-6 * np.abs(differences).max()


def rocking(x, gap, ts, engine: Any = "native", **friction):
    """A rod slides on its left foot, while its right one falls from a small height; x: its moment of inertia and its speed."""
    rod = udk.Mechanism({"rod": udk.Body(1.0, 1.0)}).with_parameters(
        {
            "body.rod.position": 0.5 * jnp.stack([jnp.cos(gap), jnp.sin(gap)]),
            "body.rod.angle": gap,
            "body.rod.inertia": x[0],
            "body.rod.velocity": jnp.stack([x[1], 0.0]),
        }
    )
    feet = [udk.Contact("rod", point=[side, 0], name=n, **friction) for side, n in ((-0.5, "L"), (0.5, "R"))]
    return udk.simulate(rod, ts, events=feet, throw=False, rtol=1e-10, atol=1e-10, engine=engine)


def check_rocking(inertia, sol):
    """Feet land in turn and lift each other, ever more slowly. Then both rest, and no foot has ever pulled at an impact."""
    assert sol.result == udk.Result.successful and np.abs(sol.v[-1, 0, 1:]).max() < 1e-12 and abs(sol.q[-1, 0, 2]) < 1e-12
    counts = {name: int(n) for name, n in sol.events.counts.items()}
    assert counts["L lets go"] > 1 and counts["L rests"] + counts["R rests"] == 2 + counts["L lets go"] + counts["R lets go"]
    mass, floor, lifted = np.array([1, 1, inertia]), 1e-12 * np.sqrt(G), 0
    q, before, after = (np.asarray(x)[:, 0] for x in (sol.events.q_before, sol.events.v_before, sol.events.v_after))
    for angle, v0, v1 in zip(q[:, 2], before, after, strict=True):
        normals = np.array([[0, 1, side * np.cos(angle)] for side in (-0.5, 0.5)])
        along = np.array([[1, 0, -side * np.sin(angle)] for side in (-0.5, 0.5)])
        impulse, rates = mass * (v1 - v0), normals @ v1
        pushes, missing = nnls(np.concatenate([normals, along, -along]).T, impulse)
        assert missing < 1e-9 * np.abs(impulse).max() + 1e-13 and rates.min() > -floor
        assert np.abs(pushes[:2] * rates).max() < 1e-9 * max(np.abs(impulse).max(), floor) * np.abs(v0).max()
        assert mass @ (v1**2 - v0**2) <= 1e-13 * (mass @ v0**2)
        lifted += rates.max() > 1e-6
    assert lifted > 2


@pytest.mark.parametrize("inertia", [0.4, 1.0])  # kg m^2: more than m a^2, so that each foot lifts the other
def test_feet_that_take_turns_come_to_rest_without_a_pull(inertia):
    check_rocking(inertia, rocking([inertia, 0.3], 1e-5, [0.0, 0.2, 0.5]))


@pytest.mark.slow
def test_feet_that_take_turns_do_so_by_jax():
    native, plain = (rocking([0.4, 0.3], 1e-5, [0.0, 0.2, 0.5], engine) for engine in ("native", "jax"))
    check_rocking(0.4, plain)
    assert native.events.counts == plain.events.counts and np.abs(native.events.time - plain.events.time).max() < 1e-12
    np.testing.assert_allclose(native.v, plain.v, atol=1e-10)


@pytest.mark.slow
def test_feet_that_take_turns_have_friction_and_derivatives():
    """They press by m g on average, so the rod slides like a block, with the same derivatives."""
    ts, x, step, friction = jnp.array([0.0, 0.2, 0.3]), jnp.array([0.4, 0.4]), 1e-4, 0.1
    sol = rocking(x, 1e-5, ts, coefficient=friction)
    check_rocking(0.4, sol)
    np.testing.assert_allclose(sol.v[1:, 0, 0], 0.4 - friction * G * ts[1:], atol=1e-9)
    end = jax.jit(lambda x: rocking(x, 1e-5, ts, coefficient=friction).v[1:, 0].ravel())
    differences = [(end(x + step * d) - end(x - step * d)) / (2 * step) for d in np.eye(2)]
    assert np.abs(jax.jacfwd(end)(x) - np.stack(differences, axis=-1)).max() < 1e-7  # errors of 1e-11 over a step of 1e-4


def feet(places, restitution):
    return [udk.Contact("box", point=[x, -0.2], restitution=restitution, name=f"foot{x:g}") for x in places]


@pytest.mark.slow
@pytest.mark.parametrize("places", [(-0.5, 0.5), (-0.5, 0.4, 0.5), (-0.5, -0.1, 0.4, 0.5)])
def test_a_box_lands_on_all_its_feet(places):
    """It bounces like a point, however redundant its feet are, and comes to rest on two of them, which stay in contact."""
    box, e, first = udk.Mechanism({"box": udk.Body(1.0, 0.1, position=(0.1, 1.0))}), 0.5, np.sqrt(1.6 / G)
    sol = udk.simulate(box, np.linspace(0, 3, 7), events=feet(places, e), max_events=150)
    times = first * np.append(1, 1 + 2 * np.cumsum(e ** np.arange(1, 8)))
    for k in range(len(places)):
        assert np.abs(sol.events.of(sol.events.names[k])[:8] - times).max() < 1e-9
    assert sum(int(n) for name, n in sol.events.counts.items() if name.endswith("rests")) == 2
    assert not any(int(n) for name, n in sol.events.counts.items() if name.endswith("lets go"))
    assert np.abs(sol.q[-1, 0] - jnp.array([0.1, 0.2, 0.0])).max() < 1e-9 and np.abs(sol.v[-1]).max() < 1e-9


@pytest.mark.slow
def test_balls_in_a_row_and_a_body_on_a_body():
    """Three balls, e = 1: the first bounces off the other two. A body falls onto the feet of a box as onto the ground."""
    row = {f"b{k}": udk.Body(1.0, 0.1, position=(x, 0.0), velocity=(float(k == 0), 0.0)) for k, x in enumerate((0, 2, 3))}
    touching = [
        udk.Contact(f"b{k + 1}", point=[-0.5, 0], on=f"b{k}", through=[0.5, 0], normal=[1, 0], restitution=1.0) for k in (0, 1)
    ]
    sol = udk.simulate(udk.Mechanism(row, gravity=(0, 0)), [0.0, 3.0], events=touching)
    assert sol.events.count == 1 and np.abs(sol.v[-1, :, 0] - np.array([-1, 2, 2]) / 3).max() < 1e-12
    two = udk.Mechanism({"box": udk.Body(2.0, 0.4, position=(0, 0.2)), "top": udk.Body(1.0, 0.1, position=(0.1, 1.0))})
    events = [*feet((-0.5, 0.5), 0.2), udk.Contact("top", on="box", through=[0, 0.2], restitution=0.5, name="top")]
    sol = udk.simulate(two, np.linspace(0, 2, 5), events=events)
    first = np.sqrt(2 * 0.6 / G)
    assert np.abs(sol.events.of("top")[:4] - first * np.array([1, 2, 2.5, 2.75])).max() < 1e-9
    assert sol.events.counts["top rests"] == 1 and np.abs(sol.v[-1]).max() < 1e-9
    assert np.abs(sol.q[:, 0] - np.array([0, 0.2, 0])).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("restitutions", [(0.5, 0.5), (1.0, 0.0), (0.9, 0.3)])
def test_a_ball_lands_in_a_wedge(restitutions):
    """It hits both walls of a 60 degree wedge at once. The impact agrees with active sets, and energy does not grow."""
    ball, a = udk.Mechanism({"ball": udk.Body(1.0, 0.1, position=(0.0, 1.0))}), np.pi / 3
    normals = np.array([[np.sin(a), np.cos(a)], [-np.sin(a), np.cos(a)]])
    walls = [
        udk.Contact("ball", normal=n, restitution=e, name=f"{e}, {k}")
        for k, (n, e) in enumerate(zip(normals, restitutions, strict=True))
    ]
    sol = udk.simulate(ball, [0.0, 0.6], events=walls)
    before, after, e = sol.events.v_before[0, 0, :2], sol.events.v_after[0, 0, :2], np.array(restitutions)
    rate = normals @ np.asarray(before)
    (target,) = enumerate_active_sets(normals @ normals.T, (1 + e) * rate, np.full(2, True))
    assert np.abs(normals @ after - (target - e * rate)).max() < 1e-11
    assert after @ after <= before @ before * (1 + 1e-12)
