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


def small_impulses_in_one_freedom(k, mu, e, steps):
    """Return the rebound of a contact that approaches with the speed one and slides with k times its normal speed."""
    speed, impulse = -1.0, 0.0
    while speed < 0:
        speed, impulse = speed + (1 + mu * abs(k)) / steps, impulse + 1 / steps
    return max(0.0, e * impulse * (1 - mu * abs(k)))


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_in_one_freedom_friction_turns_round_with_the_sliding(count):
    """The rebound is e (1 - mu |k|) / (1 + mu |k|), and zero from mu |k| = 1 on, where the contact wedges."""
    rng, wedges = np.random.default_rng(count), 0
    for i in range(count):
        u, mu, e = rng.normal(size=2) * 10 ** rng.uniform(-2, 2, 2), rng.uniform(0, 2), rng.uniform()
        x, y = mu * abs(u[1] / u[0]), -u * np.sign(u[0])
        after = y + np.outer(u, u) @ impulses_in_units(np.outer(u, u), y, np.array([e]), np.array([mu]))
        expected, wedges = e * max(0.0, (1 - x) / (1 + x)), wedges + (x >= 1)
        np.testing.assert_allclose(after, -expected * y, rtol=0, atol=1e-12 * np.max(np.abs(y)))
        if i < 20 and x < 5:
            assert small_impulses_in_one_freedom(u[1] / u[0], mu, e, 10000) == pytest.approx(expected, abs=1e-3)
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
