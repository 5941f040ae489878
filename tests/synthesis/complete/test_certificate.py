"""Certificates: exact roots are proven; points that are not roots, double roots, or points too near to one are not."""

import operator
from fractions import Fraction

import numpy as np
import pytest

from udkjax.synthesis.complete.balls import LONG_DOUBLE, Ball, ComplexBall
from udkjax.synthesis.complete.certificate import certify
from udkjax.synthesis.complete.five_poses import find_real_dyads


def circle_and_line(level):
    """The equations x^2 + y^2 = 1 and y = level, in ball arithmetic."""

    def system(u):
        x, y = u.part(0), u.part(1)
        F, slopes = [x * x + y * y - 1.0, y - level], [[x * 2.0, y * 2.0], [Ball.of(0 * x.mid), Ball.of(0 * x.mid + 1)]]
        mid, rad = (np.array([[getattr(s, part) for s in row] for row in slopes]) for part in Ball._fields)
        return Ball(*(np.stack([getattr(f, part) for f in F]) for part in Ball._fields)), Ball(mid, rad)

    return system


def test_roots_are_held_by_their_boxes():
    start = np.array([[0.9, -0.9], [0.55, 0.55]])
    found = certify(circle_and_line(0.5), start)
    exact = np.array([[1, -1], [1, 1]]) * np.array([[np.sqrt(LONG_DOUBLE(0.75))], [LONG_DOUBLE(0.5)]])
    assert found.is_proven.all() and (found.radius < 1e-15).all()
    assert (np.abs(found.middle - exact) <= found.radius + 1e-18).all()


@pytest.mark.parametrize("level", [1.0, 1.0 + 1e-9, 1.5])
def test_a_double_root_and_none_are_not_proven(level):
    assert not certify(circle_and_line(level), np.array([[1e-3, 0.3], [1.0, 1.0]])).is_proven.any()


def test_two_roots_close_together_are_told_apart_or_not_proven():
    for gap in (1e-4, 1e-8, 1e-12, 1e-16):
        found = certify(circle_and_line(1.0 - gap), np.array([[1.5, -1.5], [1.0, 1.0]]) * np.array([[np.sqrt(2 * gap)], [1.0]]))
        boxes = found.balls
        if found.is_proven.all():
            assert not boxes.part(np.s_[:, 0]).overlaps(boxes.part(np.s_[:, 1])).all()
        assert found.is_proven.all() or gap < 1e-12


def test_balls_hold_exact_results():
    """Random sums, products and quotients of exact fractions lie in the balls computed from rounded ones."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        numbers = [Fraction(int(n), int(d)) for n, d in zip(rng.integers(-999, 999, 4), rng.integers(1, 999, 4), strict=True)]
        balls = [Ball.of([float(x)], abs(float(Fraction(float(x)) - x))) for x in numbers]
        (a, b, c, d), (x, y, z, w) = numbers, balls
        if c * c + d * d == 0:
            continue
        cases = [
            (a * b - c + d, x * y - z + w),
            ((a - b) * (c - d), (x - y) * (z - w)),
            (a / (c * c + d * d), x / (z * z + w * w)),
        ]
        quotient = ComplexBall(x, y) / ComplexBall(z, w)
        cases += [((a * c + b * d) / (c * c + d * d), quotient.re), ((b * c - a * d) / (c * c + d * d), quotient.im)]
        for exact, ball in cases:
            assert abs(Fraction(float(ball.mid[0])) - exact) <= ball.rad[0] + Fraction(float(np.spacing(abs(float(ball.mid[0])))))


@pytest.mark.parametrize("operate", [operator.mul, operator.add, operator.sub, operator.truediv])
def test_balls_of_exact_numbers_hold_results_that_are_rounded(operate):
    """Exact inputs have radius zero, and the result's radius covers the rounding of this operation."""
    numbers = [(0.1, 0.1), (0.1, 0.3e-7), (1 / 3, 0.7), (1e5, 0.1)]
    off = []
    for a, b in numbers:
        ball, exact = operate(Ball.of([a]), Ball.of([b])), operate(Fraction(a), Fraction(b))
        off.append(abs(Ball.fractions(ball.mid).mid[0] - exact))
        assert off[-1] <= Fraction(ball.rad[0])
    assert any(off)  # some results are no floating-point numbers


def test_dividing_by_what_may_be_zero_says_nothing():
    assert np.isinf((Ball.of([1.0]) / Ball.of([1e-3], 1e-2)).rad).all()


def test_dyads_of_random_circles_are_found():
    """A joint turns about a pivot by five angles while the link turns by five others. That dyad is among those found."""
    rng = np.random.default_rng(1)
    for _ in range(40):
        pivot, joint = rng.normal(size=2) @ [1, 1j], rng.normal(size=2) @ [1, 1j]
        turn, crank = rng.uniform(-2, 2, 5), rng.uniform(-3, 3, 5)
        P = pivot + rng.uniform(0.3, 3) * np.exp(1j * crank) - joint * np.exp(1j * turn)
        found = find_real_dyads(np.stack([P.real, P.imag, turn], 1))
        u = found.boxes.middle.astype(float) * found.scale
        off = np.maximum(
            np.abs(u[0] + 1j * u[1] - joint * np.exp(1j * turn[0])), np.abs(u[0] + 1j * u[1] - u[2] - 1j * u[3] + P[0] - pivot)
        )
        assert off.min() < 1e-9 and u.shape[1] in (2, 4) and not found.unproven.size
