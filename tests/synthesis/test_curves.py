"""Mechanisms for drawn curves: positions, derivatives, distances and results."""

import numpy as np
import pytest

import udkjax as udk
from udkjax.synthesis.curves.curve_search import FAMILY_SIZE, CurveSearch
from udkjax.synthesis.curves.descent import LinkageLimits
from udkjax.synthesis.curves.dyad_forms import PINS, RAIL, SLIDE
from udkjax.synthesis.curves.dyads import (
    BASE_LINKS,
    DYAD_NUMBERS,
    HEAD_NUMBERS,
    SPAN_INDEX,
    Topology,
    gradients,
    number_count,
    positions,
)
from udkjax.synthesis.curves.linkage_drawing import drawing_of, turns_on_its_branch
from udkjax.synthesis.curves.random_linkages import random_linkages, turn_angles
from udkjax.synthesis.curves.targets import WantedCurve, as_points, chamfer

ELLIPSE = np.array([[3.0 + 0.2 * np.cos(t), 1.0 + 0.1 * np.sin(t)] for t in np.linspace(0.0, 2.0 * np.pi, 40)])


@pytest.mark.parametrize("geared", [False, True])
@pytest.mark.parametrize("slides", [0.0, 0.7])
def test_derivatives_of_linkages_are_those_of_their_positions(geared, slides):
    x, topology = random_linkages(24, 3, np.random.default_rng(0), geared, slides)
    assert set(np.unique(topology.form)) == ({PINS, RAIL, SLIDE} if slides else {PINS})
    share = np.arange(20) / 20
    x[:, SPAN_INDEX] = 5.0

    def measures(y):
        at = positions(y, topology, y[:, SPAN_INDEX, None] * share)
        joints = np.stack([at.origins[BASE_LINKS::2], at.origins[BASE_LINKS + 1 :: 2], at.ends])
        third = np.sum(at.cosines**2, 0) + np.sum(np.abs(joints) ** 2, (0, 1))
        return at, joints, np.stack([np.real(at.pin), np.imag(at.pin), third], 1)

    at, joints, _ = measures(x)
    found = gradients(x, topology, at, share, 2 * joints[:2], 2 * joints[2], 2 * at.cosines)
    is_closed = (np.abs(at.cosines) < 0.95).all(0)[:, None]
    assert is_closed.mean() > 0.5
    for k in range(x.shape[1]):
        step = 1e-6 * np.eye(x.shape[1])[k]
        difference = (measures(x + step)[2] - measures(x - step)[2]) / 2e-6
        error = np.abs(found[:, k] - difference) / (1.0 + np.abs(difference))
        assert np.where(is_closed, error, 0.0).max() < 1e-6


@pytest.mark.parametrize("geared", [False, True])
@pytest.mark.parametrize("slides", [0.0, 0.7])
def test_random_linkages_close_over_the_whole_turn_with_their_dimensions(geared, slides):
    x, topology = random_linkages(200, 3, np.random.default_rng(1), geared, slides)
    cosines = np.abs(positions(x, topology, turn_angles(200)).cosines).max(2)
    assert cosines[topology.form.T != SLIDE].max() < 1.0  # a slide may pass too near to its link's pin to be used
    usable = (cosines < 0.99).all(0)
    x, topology = x[usable], topology.take(usable)
    at, rows = positions(x, topology, turn_angles(len(x)), least=0.0), np.arange(len(x))
    assert len(x) > 50
    for d in range(3):
        numbers = x[:, HEAD_NUMBERS + DYAD_NUMBERS * d : HEAD_NUMBERS + DYAD_NUMBERS * (d + 1), None]
        own, other, B, R = at.turns[BASE_LINKS + 2 * d], at.turns[BASE_LINKS + 2 * d + 1], topology.second[:, d], at.ends[d]
        Q = at.origins[B, rows] + at.turns[B, rows] * (numbers[:, 2] + 1j * numbers[:, 3])
        on_first, on_second = np.conj(own) * (R - at.origins[BASE_LINKS + 2 * d]), np.conj(other) * (R - Q)
        pins, rails, sliding = (topology.form[:, d] == form for form in (PINS, RAIL, SLIDE))
        for which, found, expected in (
            (~sliding, on_first, numbers[:, 4]),
            (pins, on_second, numbers[:, 5]),
            (rails, on_second.imag, 0.0 * numbers[:, 4]),
            (rails, other / at.turns[B, rows], np.exp(1j * numbers[:, 5])),
            (sliding, on_first, 1j * numbers[:, 4]),
            (sliding, on_second.imag, 0.0 * numbers[:, 4]),
            (sliding, other / own, 1.0 + 0.0 * numbers[:, 4]),
        ):
            np.testing.assert_allclose(found[which], np.broadcast_to(expected, found.shape)[which], rtol=1e-9, atol=1e-9)


def test_a_four_bar_has_the_positions_of_the_drawing():
    x = np.zeros((1, number_count(1)))
    x[0, HEAD_NUMBERS : HEAD_NUMBERS + DYAD_NUMBERS], x[0, -2:] = [1.0, 0.0, 3.0, 0.0, 2.5, 2.0], [1.0, 0.5]
    topology = Topology(np.array([[1]]), np.array([[0]]), np.array([[1.0]]), np.array([[PINS]]), np.array([0]))
    at = positions(x, topology, np.array([[0.0, 1.0]]))
    P, R, Q = at.origins[BASE_LINKS, 0], at.ends[0, 0], at.origins[BASE_LINKS + 1, 0]
    np.testing.assert_allclose(np.abs(R - P), 2.5, rtol=1e-12)
    np.testing.assert_allclose(np.abs(R - Q), 2.0, rtol=1e-12)
    np.testing.assert_allclose(P, np.exp(1j * np.array([0.0, 1.0])), rtol=1e-12)


def test_a_linkage_with_two_cranks_and_slides_is_the_mechanism_of_its_drawing():
    wanted = WantedCurve(ELLIPSE)
    x, topology = random_linkages(300, 2, np.random.default_rng(2), geared=True, slides=0.7)
    for ratio, forms in ((3, (PINS, PINS)), (-5, (RAIL, SLIDE)), (2, (SLIDE, RAIL))):
        k = np.flatnonzero((topology.ratio == ratio) & (topology.form == forms).all(1))[:1]
        one = topology.take(k)
        mechanism = drawing_of(x[k[0]], one, wanted, "geared").mechanism()
        assert turns_on_its_branch(mechanism, x[k[0]], one, wanted, 10.0 * wanted.extent)
        ends = np.asarray(udk.kinematics(mechanism, None, [0.0, 1.0]).q)[:, list(mechanism.bodies).index("crank2"), 2]
        np.testing.assert_allclose(ends[1] - ends[0], ratio * 2 * np.pi, rtol=1e-12)
        other = one._replace(side=-one.side)  # the branch of another linkage
        assert not turns_on_its_branch(mechanism, x[k[0]], other, wanted, 10.0 * wanted.extent)


@pytest.mark.slow
def test_two_cranks_draw_a_star_that_one_does_not():
    corners = np.arange(11)
    star = as_points(np.where(corners % 2, 0.45, 1.0) * np.exp(1j * np.pi * (0.5 + corners / 5)))
    found = udk.mechanisms_for(star, bars=9, seconds=600, rounds=2, error=0.02, results=10, progress=False)
    best, plain = found[0], [one for one in found if one.bars % 2 == 0]
    assert best.bars == 9 and best.error < 0.02 and np.asarray(best.motion(721).reached).all()
    assert plain and all(one.error > 4 * best.error for one in plain)


def test_a_second_crank_is_left_out_on_request():
    stages = CurveSearch(WantedCurve(ELLIPSE), LinkageLimits(0.98, 10.0, 0.02), 5, seed=0, geared=False).stages()
    assert next(stage for stage in stages if "round 2" in stage) == "round 2: random linkages of 4 bars"


def test_the_distance_of_parallel_lines_is_twice_their_gap():
    line = as_points(np.linspace(0.0, 1.0, 50) + 0j)
    assert chamfer(line, line + [0.0, 0.25]) == pytest.approx(0.5, rel=1e-12)


@pytest.mark.parametrize(
    ("curve", "message"),
    [
        ([[0, 0], [1, 1]], "at least 3 points"),
        ([[1, 1]] * 5, "coincide"),
        ([[0, 0], [1, np.nan], [2, 0]], "finite"),
        ([[0, 0, 0]] * 4, "shape"),
        ([[0, 0], [1e200, 0], [0, 1e200]], "another unit"),
        ([[0, 0], [1e-200, 0], [0, 1e-200]], "another unit"),
    ],
)
def test_what_is_no_curve_is_refused(curve, message):
    with pytest.raises(ValueError, match=message):
        udk.mechanisms_for(curve)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"size": 0.05}, "size"),
        ({"size": 0.0}, "size"),
        ({"seconds": np.nan}, "seconds"),
        ({"results": 0}, "results"),
        ({"bars": 3}, "bars"),
        ({"transmission": 2.0}, "transmission"),
        ({"part": "half"}, "part"),
    ],
)
def test_limits_that_contradict_each_other_are_refused(limits, message):
    with pytest.raises(ValueError, match=message):
        udk.mechanisms_for(ELLIPSE, **limits)


def test_a_polygon_of_many_points_whose_last_side_is_missing_is_closed():
    angle = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    polygon = as_points(np.exp(1j * angle))
    assert WantedCurve(polygon).is_closed and not WantedCurve(polygon[:-1]).is_closed
    assert not WantedCurve([[0, 0], [1, 0], [0.5, 1]]).is_closed


def test_limits_that_no_linkage_keeps_give_a_reason():
    found = udk.mechanisms_for(ELLIPSE, bars=4, transmission=1.5, seconds=0, progress=False)
    assert not len(found) and "smaller transmission" in found.reason


def test_a_curve_of_any_size_is_drawn_and_the_search_ends_when_it_is_good_enough():
    found = udk.mechanisms_for(1e-12 * ELLIPSE, error=0.02, seconds=600, results=1, progress=False)
    assert found[0].error <= 0.02 and found[0].bars == 4 and found.rounds == 0


def test_linkages_that_end_at_a_limit_are_kept():
    wanted = WantedCurve([[0, 6], [0, 0], [4, 0]])
    search = CurveSearch(wanted, LinkageLimits(np.cos(np.deg2rad(25.0)), 3.0, 0.1), 6, seed=0)
    stages = search.stages()
    for _ in range(2):
        next(stages)
    best = search.fresh[6]
    assert len(best.x) >= 4
    at = positions(best.x, best.topology, turn_angles(len(best.x)), 0.0)
    cosine = np.abs(at.cosines).max((0, 2))
    assert (cosine < np.cos(np.deg2rad(25.0))).all() and (cosine > np.cos(np.deg2rad(26.0))).sum() >= len(cosine) / 2


def test_mechanisms_turn_draw_the_curve_and_repeat_with_the_seed():
    found, again = (udk.mechanisms_for(ELLIPSE, bars=4, seconds=600, rounds=1, results=2, progress=False) for _ in range(2))
    assert [one.error for one in found] == [one.error for one in again] and len(found) == 2
    best, wanted = found[0], WantedCurve(ELLIPSE)
    assert best.error < 0.02 and best.bars == 4 and best.size <= 3.0 * wanted.extent * 1.001
    normalized = (best.curve - as_points(np.array([wanted.middle]))) / wanted.scale
    assert chamfer(normalized[:-1], wanted.fine) == pytest.approx(best.error, rel=0.5)
    assert best.size < 3.0 * wanted.extent and best.transmission > np.deg2rad(8.0)
    motion = best.motion(721)
    assert np.asarray(motion.reached).all()
    open_by = [np.abs(np.asarray(udk.equations.psi(best.mechanism, 0.0, q)))[:-1].max() for q in np.asarray(motion.q)[::60]]
    assert max(open_by) < 1e-12
    path = np.asarray(udk.path(best.mechanism, motion, best.pin))
    assert chamfer(path, best.curve) < 0.01 * wanted.extent


def test_without_time_there_is_the_best_so_far():
    found = udk.mechanisms_for(ELLIPSE, seconds=0, results=1, progress=False)
    assert len(found) == 1 and found[0].bars == 4 and found.rounds == 0 and "1 mechanisms" in str(found)


def test_a_curve_that_no_four_bar_draws_within_the_limits_has_a_design_even_without_time():
    found = udk.mechanisms_for([[0, 6], [0, 0], [2, 4], [4, 0], [4, 6]], seconds=0, results=1, progress=False)
    assert len(found) == 1 and found[0].bars == 6


def test_an_interruption_ends_with_the_best_so_far():
    seen = []

    def interrupt(progress):
        seen.append(progress)
        if len(seen) == 1:
            raise KeyboardInterrupt

    found = udk.mechanisms_for(ELLIPSE, bars=4, seconds=1e9, results=1, progress=interrupt)
    assert len(found) == 1 and found[0].error < 0.1


def test_a_search_ends_in_the_middle_of_a_stage_and_keeps_what_it_has():
    search = CurveSearch(WantedCurve(ELLIPSE), LinkageLimits(0.98, 10.0, 0.02), 6, seed=0)
    next(search.stages())
    search.until = 0.0
    search._grow(search.fresh, 4, np.random.default_rng(0))
    assert np.isfinite(search.fresh[6].loss).all() and len(search.fresh[6].loss) > FAMILY_SIZE
    search.finish()
    rough = search.best
    assert rough < 0.1 and not search.finished  # to be finished again
    search.until = np.inf
    search.finish(0.0)
    assert 0.0 < search.best <= rough and search.finished


def test_the_curve_of_a_slider_crank_is_drawn_with_a_slide(tmp_path):
    A = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 120))
    slider = np.real(A) + np.sqrt(9.0 - (np.imag(A) - 0.3) ** 2) + 0.3j
    curve = as_points(A + (slider - A) * (0.5 + 0.3j))
    found = udk.mechanisms_for(curve, bars=4, slides=True, geared=False, seconds=600, rounds=1, results=9, progress=False)
    best = min(found, key=lambda one: one.error)
    assert best.error < 0.002 and best.bars == 4 and best.drawing is not None and best.drawing.groups["slide"]
    udk.save(best.mechanism, tmp_path / "slider.toml")
    mechanism = udk.load(tmp_path / "slider.toml")
    motion = udk.kinematics(mechanism, None, np.linspace(0.0, 1.0, 721))
    assert np.asarray(motion.reached).all() and np.abs(udk.violation(mechanism, motion)).max() < 1e-12 * best.size
    assert chamfer(np.asarray(udk.path(mechanism, motion, "P")), best.curve) < 0.01 * WantedCurve(curve).extent
