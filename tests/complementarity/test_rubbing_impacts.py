"""Impacts with friction, as arrays: Routh's method, small impulses of several contacts, dependent rows, energy, derivatives."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.complementarity.rubbing_impacts import RubbingContacts, rubbing_impact


def by_routh(W, y, mu, e):
    """Return the impulses of one contact, normal and along its line, by Routh's method."""
    (a, b), (_, c) = W
    (speed, slip), normal, along, end = y, 0.0, 0.0, np.inf
    for _ in range(5):
        sticks = abs(slip) < 1e-13
        ratio = np.clip(-b / c, -mu, mu) if sticks else -mu * np.sign(slip)
        rates = a + b * ratio, b + c * ratio
        steps = [end - normal, -speed / rates[0] if end == np.inf and rates[0] > 0 else np.inf]
        steps.append(-slip / rates[1] if not sticks and rates[1] * slip < 0 else np.inf)
        step = min(steps)
        normal, along = normal + step, along + step * ratio
        speed, slip = speed + step * rates[0], 0.0 if step == steps[2] else slip + step * rates[1]
        if step == steps[0]:
            break
        if step == steps[1]:
            end = (1 + e) * normal
    return np.array([normal, along])


def impulses_in_units(W, y, e, mu):
    """Return the impulses of contacts that all rub, for rows of any size."""
    N, size = len(e), np.sqrt(np.diag(W))
    contacts = RubbingContacts(W / size / size[:, None], y / size, e, mu * size[N:] / size[:N], np.ones(N, bool))
    return rubbing_impact(contacts, np.arange(N), np) / size


@pytest.mark.parametrize("count", [100, pytest.param(4000, marks=pytest.mark.slow)])
def test_one_contact_has_rouths_impulses(count):
    """With two or three freedoms, with rows of different sizes, and where pressing drives the contact in."""
    rng, drives = np.random.default_rng(count), 0
    for _ in range(count):
        U = rng.normal(size=(2, rng.integers(2, 4))) * 10 ** rng.uniform(-1, 1, (2, 1))
        W, y, mu, e = U @ U.T, U @ rng.normal(size=U.shape[1]), rng.uniform(0, 3), rng.uniform()
        y[0] = -abs(y[0])
        drives += W[0, 0] < mu * np.sign(y[1]) * W[0, 1]
        found = impulses_in_units(W, y, np.array([e]), np.array([mu]))
        np.testing.assert_allclose(W @ found, W @ by_routh(W, y, mu, e), rtol=0, atol=1e-9 * np.max(np.abs(y)))
    assert drives > count / 50


def press(u, w, mu, v, amount):
    """Return the velocity of one freedom, of unit mass, after a small normal impulse; rows are the contacts of many cases.

    The contact has the speeds u v + w, normal and along its line. Friction opposes the sliding, whose end divides the impulse; a
    contact that does not slide sticks if neither direction of sliding would go on.
    """
    slides = u[1] * v + w[1]
    direction = np.sign(np.where(np.abs(slides) > 1e-14 * (np.abs(u[1] * v) + np.abs(w[1])), slides, 0.0))
    rate = u[0] - mu * direction * u[1]
    until = np.where(direction * u[1] * rate < 0, -slides / np.where(u[1] * rate == 0, 1.0, u[1] * rate), np.inf)
    first = np.where(direction == 0, 0.0, np.minimum(amount, until))
    turns = first < amount
    rates = [u[0] - mu * s * u[1] for s in (1, -1)]
    rate_after = np.where(u[1] * rates[0] > 0, rates[0], np.where(u[1] * rates[1] < 0, rates[1], 0.0))
    v = np.where(turns & (u[1] != 0) & (direction != 0), -w[1] / np.where(u[1] == 0, 1.0, u[1]), v + first * rate)
    return v + np.where(turns, (amount - first) * rate_after, 0.0)


def small_impulses_in_one_freedom(u, w, v, mu, e, steps=40):
    """Return velocities after impacts by Poisson's law in small normal impulses, and which contacts never stop approaching."""
    amount = 4 * np.abs(u[0] * v + w[0]) / u[0] ** 2 / steps
    impulse, done = np.zeros_like(v), np.zeros_like(v, bool)
    for _ in range(200 * steps):
        after = press(u, w, mu, v, amount)
        ends = ~done & (u[0] * after + w[0] >= 0)
        low, high = np.zeros(len(v)), amount
        for _ in range(55 * ends.any()):
            middle = (low + high) / 2
            approaches = u[0] * press(u, w, mu, v, middle) + w[0] < 0
            low, high = np.where(approaches, middle, low), np.where(approaches, high, middle)
        impulse += np.where(done, 0.0, np.where(ends, high, amount))
        v, done = np.where(ends, -w[0] / u[0], np.where(done, v, after)), done | ends
        if done.all():
            break
    for _ in range(steps):
        v = press(u, w, mu, v, e * impulse / steps)
    return v, ~done


def one_freedom(rng, count):
    """Return the rows of contacts of bodies with one freedom, in its speed times the root of its inertia, and that speed.

    They are the tip of a rod on a pin, a slider in a slanted guide, a rod that turns another by a gear, and a crank of a slider.
    """
    angle, inertia, ratio = rng.uniform(-1.5, 1.5, count), 10 ** rng.uniform(-2, 2, count), rng.uniform(-3, 3, count)
    rod = np.array([np.cos(angle), -np.sin(angle)]) / np.sqrt(inertia)
    slider = np.array([np.sin(angle), np.cos(angle)]) / np.sqrt(inertia)
    geared = ratio * np.array([np.cos(angle), -np.sin(angle)]) / np.sqrt(inertia + ratio**2)
    turn = 0.4 * np.cos(angle) / np.sqrt(1 - (0.4 * np.sin(angle)) ** 2)
    crank = np.array([np.cos(angle), -np.sin(angle) - np.sin(angle) * turn]) / np.sqrt(inertia * (1 + turn**2))
    u = np.choose(np.arange(count) % 4, [rod[:, None], slider[:, None], geared[:, None], crank[:, None]])[:, 0]
    return u, -np.sign(u[0]) * rng.uniform(0.1, 3, count)


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("driven", [False, True])
def test_in_one_freedom_small_impulses_add_up(driven, count):
    """Random impacts and their neighbours; where a driver moves the line along itself, sliding does not end with the approach."""
    rng = np.random.default_rng(5 + driven)
    u, v = one_freedom(rng, count)
    w = np.array([np.zeros(count), driven * rng.normal(size=count)])
    mu, e = rng.uniform(0, 1.5, count), rng.uniform(0, 1, count)

    def after(v, i):
        y = u[:, i] * v + w[:, i]
        return v + u[:, i] @ impulses_in_units(np.outer(u[:, i], u[:, i]), y, e[i : i + 1], mu[i : i + 1])

    expected, jams = small_impulses_in_one_freedom(u, w, v, mu, e)
    found, beside = (np.array([after(x[i], i) for i in range(count)]) for x in (v, v * (1 + 1e-6)))
    assert jams.any() == driven and np.array_equal(np.isnan(found), jams)
    size = np.abs(v) + np.abs(w[1] / u[0])
    assert np.all((np.abs(found - expected) < 1e-6 * size)[~jams])
    assert np.all((np.abs(beside - found) < 1e-4 * size)[~jams])


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_in_one_freedom_friction_turns_round_with_the_sliding(count):
    """The rebound is e (1 - mu |k|) / (1 + mu |k|), and zero from mu |k| = 1 on, where the contact wedges."""
    rng, wedges = np.random.default_rng(count), 0
    for _ in range(count):
        u, mu, e = rng.normal(size=2) * 10 ** rng.uniform(-2, 2, 2), rng.uniform(0, 2), rng.uniform()
        x, y = mu * abs(u[1] / u[0]), -u * np.sign(u[0])
        after = y + np.outer(u, u) @ impulses_in_units(np.outer(u, u), y, np.array([e]), np.array([mu]))
        expected, wedges = e * max(0.0, (1 - x) / (1 + x)), wedges + (x >= 1)
        np.testing.assert_allclose(after, -expected * y, rtol=0, atol=1e-12 * np.max(np.abs(y)))
    assert wedges > count / 20


def test_neighbours_of_the_friction_that_wedges():
    """The rebound is continuous there, though for 1e-6 the compliance decides."""
    W, y = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([-1.0, 1.0])
    for change in (-1e-3, -1e-6, -1e-7, -1e-12, 0.0, 1e-12, 1e-7, 1e-3):
        after = y + W @ impulses_in_units(W, y, np.array([0.7]), np.array([1 + change]))
        assert after[0] == pytest.approx(0.7 * max(0.0, -change) / (2 + change), abs=5e-7)


def small_impulses(W, y, mu, e, steps):
    """Return the speeds of contacts after an impact in small steps, and whether the solution of all steps is the only one.

    In each step the law holds at its end. Every set of modes is tried: normal impulses at their bound or speeds on the line, and
    each contact sticks or slides in one direction. Rows have unit size, and a compliance of 1e-7.
    """
    N = len(e)
    modes, unit, W1 = np.array(list(product(range(6), repeat=N))), np.eye(2 * N), W + 1e-7 * np.eye(2 * N)
    closed, sticks, direction = modes >= 3, modes % 3 == 0, np.array([0.0, 1.0, -1.0])[modes % 3]
    equal = np.concatenate([closed, sticks], 1)
    slip = np.concatenate([np.zeros((len(modes), N, 2 * N)), (mu * direction)[..., None] * unit[:N]], 1)
    inverse, is_unique, size = np.linalg.inv(np.where(equal[..., None], W1, unit + slip)), True, np.max(np.abs(y))
    least, x = np.zeros(N), np.zeros(2 * N)
    for line in (np.minimum(y[:N], 0.0), np.zeros(N)):
        before = -1
        for k in range(steps):
            target = line * (1 - (k + 1) / steps)
            right = np.where(closed, target - y[:N] + 1e-7 * least, least), np.where(sticks, -y[N:], 0.0)
            d = (inverse @ np.concatenate(right, 1)[..., None])[..., 0]
            new, tiny = y + d @ W, 1e-9 * np.max(np.abs(d), 1, keepdims=True)
            obeys = np.where(closed, d[:, :N] >= least - tiny, new[:, :N] >= target - 1e-11 * size)
            slides = np.where(sticks, np.abs(d[:, N:]) <= mu * d[:, :N] + tiny, new[:, N:] * direction >= -1e-11 * size)
            good = np.flatnonzero(np.all(obeys & slides, 1))
            if not len(good):
                return y, False
            is_unique &= bool(np.max(np.ptp(new[good], axis=0)) < 1e-6 * size)
            before = before if before in good else good[0]
            x, y = x + d[before], new[before]
        least = e * x[:N] / steps
    return y, is_unique


@pytest.mark.parametrize("count", [2, pytest.param(60, marks=pytest.mark.slow)])
@pytest.mark.parametrize("rank", [1, 2, 3, 5])
def test_several_contacts_have_small_impulses(rank, count):
    """Two contacts with different restitutions on one or more freedoms, wherever the law has one solution."""
    rng, compared = np.random.default_rng(rank), 0
    for _ in range(count):
        U = rng.normal(size=(4, rank))
        U /= np.linalg.norm(U, axis=1, keepdims=True)
        v = rng.normal(size=rank)
        U[:2] *= -np.sign(U[:2] @ v)[:, None]
        W, y, mu, e = U @ U.T, U @ v, rng.uniform(0, 1.2, 2), rng.uniform(size=2)
        found = impulses_in_units(W, y, e, mu)
        assert found @ y + found @ W @ found / 2 <= 1e-14
        expected, is_unique = small_impulses(W, y, mu, e, 400)
        if is_unique:
            np.testing.assert_allclose(y + W @ found, expected, rtol=0, atol=0.01 * np.max(np.abs(y)))
            compared += 1
    assert compared > count / 2


def test_contacts_of_one_freedom_share_the_momentum():
    """Half each, whatever their mobilities and restitutions: the rebound is the mean of both restitutions."""
    u = np.array([2.0, 0.5])
    found = rubbing_impact(
        RubbingContacts(np.ones((2, 2)), np.full(2, -1.0), np.array([0.2, 0.8]), np.zeros(0), np.ones(2, bool)),
        np.zeros(0, int),
        np,
    )
    np.testing.assert_allclose(found, [0.6, 0.9], atol=1e-12)
    impulses = found / u  # a unit of momentum in the units of both rows
    assert -1 + u @ impulses == pytest.approx(0.5, abs=1e-12)


def test_both_forms_agree_and_have_derivatives():
    """One contact on one, two and three freedoms: JAX's impulses are NumPy's, and derivatives are those of differences."""

    def after(U, v, e, mu):
        W, y = U @ U.T, U @ v
        size = jnp.sqrt(jnp.diag(W))
        contacts = RubbingContacts(W / size / size[:, None], y / size, e, mu * size[1:] / size[:1], np.ones(1, bool))
        return v + (rubbing_impact(contacts, np.array([0]), jnp) / size) @ U

    @jax.jit
    def evaluate(given, change, weights):
        value, forward = jax.jvp(after, given, change)
        return value, weights @ forward, jax.vjp(after, *given)[1](weights)

    rng = np.random.default_rng(2)
    for freedoms in (1, 2, 3, 3, 3):
        U, v, e, mu = rng.normal(size=(2, 3)), rng.normal(size=3), rng.uniform(size=1), rng.uniform(0, 1.5, 1)
        part, weights = np.arange(3) < freedoms, rng.normal(size=3)
        U, v = U * part, v * part
        U[0] *= -np.sign(U[0] @ v)
        given, change = (U, v, e, mu), (rng.normal(size=(2, 3)) * part, rng.normal(size=3) * part, *rng.normal(size=(2, 1)))
        value, forward, reverse = evaluate(given, change, weights)
        np.testing.assert_allclose(value, v + impulses_in_units(U @ U.T, U @ v, e, mu) @ U, atol=1e-13)
        assert sum(np.sum(x * y) for x, y in zip(reverse, change, strict=True)) == pytest.approx(float(forward), abs=1e-12)
        ends = [evaluate(tuple(x + s * d for x, d in zip(given, change, strict=True)), change, weights)[0] for s in (1e-6, -1e-6)]
        assert float(forward) == pytest.approx(float(weights @ (ends[0] - ends[1])) / 2e-6, rel=1e-6, abs=1e-7)
