"""Active sets and pivots: tolerances in the units of each row, and joints whose modes depend on each other."""

import numpy as np
import pytest

from udkjax.complementarity.linear import solve_complementarity
from udkjax.complementarity.stick_or_slip import JointsAtRest, Response


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e4])
def test_the_tolerance_of_a_row_has_the_units_of_the_row(size):
    """y = -1e-9 of its size is within a tolerance of 1e-8 of its size, and y = -1e-7 is not."""
    scale = np.array([size, 1.0])
    for y, x in ((-1e-9, 0.0), (-1e-7, 1e-7)):
        found = solve_complementarity(np.diag(scale**2), scale * [y, 1.0], np.ones(2, bool), 1e-8 * scale, np)
        np.testing.assert_allclose(found.x, [x / size, 0.0], rtol=1e-12)


def test_one_joint_at_a_time_changes_its_mode_if_two_alternate():
    """Each of two joints exceeds its limit while the other sticks, and sticks again once the other slides."""

    def respond(modes):
        other_sticks = modes.locked[::-1]
        a = np.where(modes.locked, 0.0, np.where(other_sticks, 1.0, -1.0))
        return Response(a, np.where(other_sticks, -1.0, 1.0), np.ones(2))

    no, yes = np.zeros(2, bool), np.ones(2, bool)
    joints = JointsAtRest.of(yes, np.zeros(2), np.eye(2), np.ones(2), no, yes, np.full(2, 1e-9), np)
    modes, has_failed, _ = joints.decide(respond, np.zeros(2), no, yes, np)
    assert not has_failed and sorted(modes.locked) == [False, True]
    assert modes.direction[~modes.locked] == 1.0


def test_pivots_begin_with_the_modes_before():
    """Of nine joints that stick and one that stops, all stick: one evaluation of the motion shows it."""
    calls, F = [], 10

    def respond(modes):  # each carries half of its limit
        calls.append(modes.locked.copy())
        force = np.where(modes.locked, 0.5, modes.direction)
        return Response(0.5 - force, 1.0 - force, 1.0 + force)

    no, yes, rested = np.zeros(F, bool), np.ones(F, bool), np.arange(F) < F - 1
    for before, count in ((rested, 1), (no, None)):  # where all come to rest together, the limits are iterated first
        calls.clear()
        joints = JointsAtRest.of(yes, np.zeros(F), np.eye(F), np.ones(F), before, before, np.full(F, 1e-9), np)
        modes, has_failed, _ = joints.decide(respond, np.zeros(F), no, no, np)
        assert not has_failed and modes.locked.all()
        assert len(calls) == count if count else len(calls) > 1
