"""Random decisions of joints at rest: NumPy, JAX and machine code of any number of lanes decide alike, and obey the law.

Accelerations are a = b - W f, with friction f within limits c: a joint at rest has |f| <= c, and f = c sign(a) if it moves.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.native.lowering.lowered import lowered
from udkjax.complementarity.stick_or_slip import ContactsAtRest, JointsAtRest, Response
from udkjax.native.code import processor

UNIT = 1.0  # the characteristic acceleration


def responses(xp, W, b, c):
    def respond(modes):
        both = modes.locked[..., None] & modes.locked[..., :, None]
        given = xp.where(modes.locked, 0.0, modes.direction * c)
        wanted = xp.where(modes.locked, b - (W @ given[..., None])[..., 0], 0.0)
        force = given + xp.linalg.solve(xp.where(both, W, np.eye(W.shape[-1])), wanted[..., None])[..., 0]
        return Response(b - (W @ force[..., None])[..., 0], c - force, c + force)

    return respond


def decision(xp, W, b, c, rests, sliding):
    """Return the modes, whether none were found, and the response to them."""
    rest, no = rests > 0.5, rests > 2.0
    none = no[..., :0]
    contacts = ContactsAtRest(np.full(c.shape[-1], -1), none, none, c[..., :0], 0)
    joints = JointsAtRest.of(rest, sliding, W, xp.diagonal(W, axis1=-2, axis2=-1), no, no, UNIT + 0.0 * c, xp, contacts)
    found = joints.decide(responses(xp, W, b, c), 0.0 * c, no, no, xp)
    a, forwards, backwards, *_ = responses(xp, W, b, c)(found.modes)
    return found.modes.locked, found.modes.direction, found.modes.at_rest, found.failed, a, (backwards - forwards) / 2


def random_joints(count, F, rank, seed=0):
    rng = np.random.default_rng(seed)
    R = rng.standard_normal((count, F, rank))
    W = R @ R.swapaxes(1, 2) + (0.1 * np.eye(F) if rank == F else 0.0)
    b, c = (W @ (3 * rng.standard_normal((count, F, 1))))[..., 0], rng.uniform(0.2, 3.0, (count, F))
    return W, b, c, (rng.random((count, F)) < 0.8).astype(float), rng.choice([-1.0, 1.0], (count, F))


def check_law(given, found):
    """Where the rows of joints at rest depend on each other, forces are not unique, but accelerations are."""
    (_, b, c, rests, sliding), (locked, _, at_rest, failed, a, f) = given, found
    rest, moves = rests > 0.5, (rests > 0.5) & (np.abs(a) > 1e-7 * np.abs(b).max(axis=1, keepdims=True))
    assert not failed.any() and moves.any() and locked.any() and not moves[(locked | at_rest) > 0].any()
    assert (np.abs(f) <= c * (1 + 1e-8)).all()
    assert_allclose(f[moves], (c * np.sign(a))[moves], rtol=1e-7)
    assert_allclose(f[~rest], (c * sliding)[~rest])


@pytest.mark.parametrize(("F", "rank"), [(1, 1), (2, 1), (4, 4), (6, 4)])
@pytest.mark.parametrize("count", [500, pytest.param(25_000, marks=pytest.mark.slow)])
def test_random_decisions(F, rank, count):
    given = random_joints(count, F, rank)
    by_numpy = decision(np, *given)
    check_law(given, by_numpy)
    widths = [width for width in (1, 2, 4, 8) if width <= processor.lanes()]
    by_code = [lowered(lambda *x: decision(jnp, *x), given, width) for width in widths]
    for found in (jax.jit(jax.vmap(lambda *x: decision(jnp, *x)))(*given), *by_code):
        found = [np.asarray(x) for x in found]
        check_law(given, found)
        assert_allclose(found[4], by_numpy[4], atol=1e-9 * np.abs(given[1]).max())
        if rank == F:
            for one, other in zip(by_numpy[:3], found, strict=False):
                assert (one == other).all()
    for found in by_code[1:]:
        for one, other in zip(by_code[0], found, strict=True):
            assert (one == other).all()
