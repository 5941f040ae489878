"""Least gaps between links: closed forms, other methods on random linkages, derivatives, contacts, and wrong input."""

import json
from itertools import combinations
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

pytest.importorskip("experiments", reason="not in a source tree")

import udkjax as udk
from experiments.parts.gap_linkages import placed, random_linkage
from tests.command_line import udkjax
from udkjax.positions.gaps.convex import closest, gap_at, signed_distance
from udkjax.positions.gaps.pairs import joined_pairs
from udkjax.positions.gaps.shapes import convex_pieces, hull

FOUR_BAR = {"O": [0.0, 0.0], "A": [0.03, 0.04], "B": [0.16, 0.11], "C": [0.18, 0.0]}


def four_bar(widths=(0.01, 0.012, 0.015), pins=FOUR_BAR, ground=("O", "C"), more=None, units=None):
    w = dict(zip(("crank", "coupler", "rocker"), widths, strict=True))
    ends = {"crank": ["O", "A"], "coupler": ["A", "B"], "rocker": ["B", "C"]}
    links = {name: {"pins": ends[name], "mass": 1} | ({} if w[name] is None else {"width": w[name]}) for name in w} | (more or {})
    motors = {"motor": {"pin": "O", "speed": "1 rad/s"}}
    return udk.Drawing(pins=pins, links=links, ground=list(ground), motors=motors, units=units or {}).mechanism()


def supports(points, n):
    return (np.asarray(n) @ np.asarray(points).T).max(-1)


def by_directions(A, B):
    """The signed distance as the maximum over directions, refined around the best of a grid."""

    def gap(angle):
        n = np.stack([np.cos(angle), np.sin(angle)], -1)
        return -supports(B, -n) - supports(A, n)

    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    values = gap(angles)
    near = [a for k, a in enumerate(angles) if values[k] >= max(values[k - 1], values[(k + 1) % 720])]
    best = sorted(near, key=lambda a: -gap(a))[:3]
    options = {"xatol": 1e-12}
    return max(
        -minimize_scalar(lambda x: -gap(x), bounds=(a - 0.01, a + 0.01), method="bounded", options=options).fun for a in best
    )


def figures(counts, number, rng):
    """Random convex figures of two numbers of corners."""
    shapes = []
    for count in counts:
        found = []
        while len(found) < number:
            points = rng.normal(size=(count, 2))
            if len(corners := hull(points)) == count:
                found.append(points[corners] + rng.normal(size=2))
        shapes.append(np.stack(found, -1))
    return shapes


@pytest.mark.parametrize("counts", [(1, 1), (1, 2), (2, 2), (1, 4), (2, 5), (5, 3)])
def test_signed_distances_are_maxima_over_directions(counts):
    A, B = figures(counts, 60, np.random.default_rng(sum(counts)))
    got = signed_distance(A, B)
    wanted = np.array([by_directions(A[..., k], B[..., k]) for k in range(A.shape[-1])])
    assert np.abs(got - wanted).max() < 1e-7
    if min(counts) > 1:
        assert (got < 0).sum() > 5 and (got > 0).sum() > 5
    k = np.arange(A.shape[-1])
    found = closest(A, B).features(counts, k)
    for of_a, one, other in ((True, A, B), (False, B, A)):
        some = k[found.of_a == of_a]
        f = found.take(some)
        p, start, end = (x[c, :, some].T for x, c in zip((one, other, other), f[1:4], strict=True))
        distance, n, _ = gap_at(p, start, end, f.side, f.at)
        assert np.allclose(distance, got[some], atol=1e-14) and np.allclose(np.hypot(*n), 1.0)


@pytest.mark.parametrize("counts", [(1, 1), (2, 2), (5, 3), (3, 3), (6, 6)])
def test_closest_features_and_directions_have_the_distance(counts):
    """Also where corners are closest that no edge of the one figure separates from the other one, and one above the other."""
    A, B = figures(counts, 400, np.random.default_rng(7))
    A[..., :20], B[..., :20] = 0.1 * A[..., :20], 0.1 * B[..., :20]
    B[:, :, :20] += (A[:, :, :20].mean(0) - B[:, :, :20].mean(0)) + np.array([[0.0], [5.0]])  # above
    found, k = closest(A, B), np.arange(400)
    n = found.n
    supported = (n[0] * B[:, 0] + n[1] * B[:, 1]).min(0) - (n[0] * A[:, 0] + n[1] * A[:, 1]).max(0)
    assert np.allclose(supported, found.distance, atol=1e-14) and np.allclose(np.hypot(*n), 1.0)
    features = found.features(counts, k)
    for of_a, one, other in ((True, A, B), (False, B, A)):
        some = k[features.of_a == of_a]
        f = features.take(some)
        p, start, end = (x[c, :, some].T for x, c in zip((one, other, other), f[1:4], strict=True))
        distance, way, _ = gap_at(p, start, end, f.side, f.at)
        assert np.allclose(distance, found.distance[some], atol=1e-14)
        assert np.allclose(way, (-1.0 if of_a else 1.0) * n[:, some], atol=1e-9)


def test_collinear_segments_are_apart_whatever_their_direction():
    angles = np.linspace(0, np.pi, 500)
    way = np.stack([np.cos(angles), np.sin(angles)])
    A, B = (np.stack([a * way, b * way]) for a, b in ((0.0, 1.0), (1.5, 2.0)))
    assert np.allclose(signed_distance(A, B), 0.5, atol=1e-15)


def test_outlines_that_are_not_convex_are_cut_into_convex_pieces():
    star = np.array(
        [[np.cos(a) * r, np.sin(a) * r] for a, r in zip(np.linspace(0, 2 * np.pi, 11)[:-1], [1.0, 0.4] * 5, strict=True)]
    )
    area = lambda x: 0.5 * np.abs(np.sum(x[:, 0] * np.roll(x[:, 1], -1) - np.roll(x[:, 0], -1) * x[:, 1]))  # noqa: E731
    for corners in (star, star[::-1], np.array([[0, 0], [1, 0], [2, 0], [2, 1], [1, 0.5], [0, 1]])):
        pieces = convex_pieces(corners)
        assert sum(map(area, pieces)) == pytest.approx(area(corners), rel=1e-14)
        assert all(len(x) == 3 for x in pieces)
    assert len(convex_pieces(star[::2])) == 1


def test_a_bar_that_turns_past_a_disc_has_the_gap_of_its_end():
    pins = {"O": [0, 0], "A": [0.1, 0], "D": [0.15, 0.02]}
    links = {"arm": udk.Link(["O", "A"], mass=1, width=0.02), "wheel": udk.Link(["D"], mass=1, width=0.03)}
    motors = {"motor": {"pin": "O", "speed": 1.0}, "other": {"pin": "D", "speed": 1.0}}
    mech = udk.Drawing(pins=pins, links=links, ground=["O", "D"], motors=motors).mechanism()
    found = udk.gaps(mech, "motor", values=[0, 2 * np.pi]).least
    assert found.distance == pytest.approx(np.hypot(0.15, 0.02) - 0.1 - 0.01 - 0.015, abs=1e-15)
    assert found.value == pytest.approx(np.arctan2(0.02, 0.15), abs=1e-9)
    assert np.allclose(np.diff(found.points, axis=0), found.distance * np.array([0.15, 0.02]) / np.hypot(0.15, 0.02), atol=1e-12)


SEEDS = [range(4), *(pytest.param(range(k, k + 23), marks=pytest.mark.slow) for k in (4, 27))]


@pytest.mark.parametrize("seeds", SEEDS, ids=lambda x: f"{x[0]}-{x[-1]}")
def test_no_gap_between_samples_is_smaller(seeds):
    overlaps = 0
    for seed in seeds:
        mech, values = random_linkage(seed)
        found = udk.gaps(mech, "motor", values=values)
        dense = np.linspace(*values, 1237)
        motion = np.asarray(udk.kinematics(mech, "motor", dense).q)
        size = float(np.ptp(motion[..., :2], axis=(0, 1)).max())
        ordered = sorted(found.pairs, key=lambda gap: gap.value)
        poses = np.asarray(udk.kinematics(mech, "motor", [gap.value for gap in ordered]).q)
        for gap, here in zip(ordered, poses, strict=True):
            (A, ra), (B, rb) = (placed(mech, name, here) for name in gap.pair)
            assert gap.distance == pytest.approx(by_directions(A, B) - ra - rb, abs=1e-7 * size)
            parts = [placed(mech, name, motion)[0] for name in gap.pair]
            convex = [x[hull(x[..., 0])] if len(x) > 2 else x for x in parts]
            least = signed_distance(*convex).min() - ra - rb
            assert gap.distance <= least + 1e-12 * size and gap.bound <= gap.distance <= gap.bound + 2e-9 * (size + 2)
            overlaps += gap.distance < 0
    assert overlaps > 3


def test_gaps_that_are_constant_are_proven():
    """In a planetary gear all gaps are constant; pins of one link, at which two others are closest, stay as far apart."""
    gear = udk.load(Path(__file__).parents[3] / "examples/planetary_gear.toml")
    names = gear.body_names
    run = udk.simulate(gear, np.linspace(0.0, 1.0, 100))
    found = udk.gaps(gear, run=run, shapes=dict.fromkeys(names, 0.02), pairs=list(combinations(names, 2)))
    mech, values = random_linkage(8)
    shared = udk.gaps(mech, "motor", values=values, pairs=[("crank", "rod"), ("crank", "plate")])
    assert len(found.pairs) == 10
    for gap in (*found.pairs, *shared.pairs):
        assert gap.distance - 2e-9 < gap.bound <= gap.distance, gap.pair


def test_points_of_least_gaps_are_as_far_apart_as_the_links():
    """Of outlines that are not convex, too."""
    star = np.array(
        [[np.cos(a) * r, np.sin(a) * r] for a, r in zip(np.linspace(0, 2 * np.pi, 11)[:-1], [0.3, 0.12] * 5, strict=True)]
    )
    for seed in (13, 3):
        mech, values = random_linkage(seed)
        for gap in udk.gaps(mech, "motor", values=values, shapes={"rocker": star}).pairs:
            assert np.hypot(*np.diff(gap.points, axis=0)[0]) == pytest.approx(abs(gap.distance), abs=1e-12), (seed, gap.pair)


def test_contacts_are_located():
    mech = four_bar((0.1, 0.012, 0.12))
    found = udk.gaps(mech)
    (touch,) = found.contacts

    def gap(value):
        q = np.asarray(udk.kinematics(mech, "motor", [value]).q)[0]
        (A, ra), (B, rb) = (placed(mech, name, q) for name in ("crank", "rocker"))
        return float(signed_distance(A[..., None], B[..., None])[0]) - ra - rb

    middle = found.least.value
    for side, end in ((-1, touch.begins), (1, touch.ceases)):
        assert brentq(gap, middle, middle + side * 1.0, xtol=1e-13) == pytest.approx(end, abs=1e-9)
    assert found.least.pair == touch.pair == ("crank", "rocker") and "touch from" in repr(found)


def test_a_touch_between_samples_is_found():
    """The bars come so close for a thousandth of a radian, halfway between samples."""
    mech = four_bar()
    open_by = udk.gaps(mech).least
    wide = 0.015 + 2 * (float(open_by.distance) + 1e-9)
    found = udk.gaps(four_bar((0.01, 0.012, wide)))
    (touch,) = found.contacts
    assert found.least.distance == pytest.approx(-1e-9, abs=1e-15)
    assert touch.begins < open_by.value < touch.ceases and touch.ceases - touch.begins < 1e-3


def check_derivatives(of, x, step, tolerance=1e-8):
    """Compare the first and second derivative along a direction with differences."""
    way = step * np.random.default_rng(0).uniform(0.5, 1.0, len(x)) * np.array([1, -1, 1, -1, 1])[: len(x)]

    def along(t):
        return of(x + t * way)

    slope_at = lambda t: jax.jvp(along, (t,), (1.0,))[1]  # noqa: E731
    value, slope = jax.value_and_grad(along)(0.0)
    bend = jax.jvp(slope_at, (0.0,), (1.0,))[1]
    assert float(slope_at(0.0)) == pytest.approx(float(slope), rel=1e-12)
    at = {t: float(along(float(t))) for t in (-2, -1, 0, 1, 2)}
    assert float(value) == pytest.approx(at[0], rel=1e-12)
    first = (8 * (at[1] - at[-1]) - at[2] + at[-2]) / 12
    second = (16 * (at[1] + at[-1]) - at[2] - at[-2] - 30 * at[0]) / 12
    assert float(slope) == pytest.approx(first, rel=tolerance)
    assert float(bend) == pytest.approx(second, rel=1e4 * tolerance)
    return at[0]


def test_derivatives_are_those_of_differences():
    mech = four_bar()

    def least(x):
        return udk.gaps(mech.with_parameters({"pin.B": x[:2], "pin.A": x[2:4], "link.rocker.width": x[4]})).least.distance

    check_derivatives(least, np.array([0.16, 0.11, 0.03, 0.04, 0.015]), 1e-4)


def test_derivatives_where_the_way_out_of_an_overlap_changes():
    """The least gap of two plates can be at a kink, where two ways out of their overlap are equally long."""
    pins = {"O": [0, 0], "A": [0.1, 0.0], "D": [0.06, -0.02], "E": [0.11, -0.03], "F": [0.07, 0.03]}
    links = {"bar": udk.Link(["O", "A"], mass=1, width=0.01), "plate": udk.Link(["D", "E", "F"], mass=1)}
    motors = {"motor": {"pin": "O", "speed": 1.0}, "still": {"pin": "D", "speed": 0.0}}
    mech = udk.Drawing(pins=pins, links=links, ground=["O", "D"], motors=motors).mechanism()

    def least(x):
        changed = mech.with_parameters({"pin.E": x[:2], "link.bar.width": x[2]})
        return udk.gaps(changed, "motor", values=[-1.0, 1.0]).least.distance

    assert check_derivatives(least, np.array([0.11, -0.03, 0.01]), 1e-4) < 0


def test_derivatives_at_toggles():
    mech = four_bar(pins=FOUR_BAR | {"C": [0.26, 0.0], "B": [0.2, 0.09]})  # no whole turns

    def least(x):
        return udk.gaps(mech.with_parameters({"pin.B": x})).least.distance

    check_derivatives(least, np.array([0.2, 0.09]), 1e-4)


@pytest.mark.parametrize(("drive", "values"), [(None, np.linspace(0, 2 * np.pi, 41)), ("motor", np.linspace(2 * np.pi, 0, 41))])
def test_derivatives_along_a_run(drive, values):
    """Values of a driver may fall."""
    mech = four_bar()
    run = udk.kinematics(mech, drive, values)

    def least(x):  # the run need not be a motion of the mechanism
        moved = eqx.tree_at(lambda r: r.q, run, run.q.at[:, 2, 0].add(x[0] * np.arange(41.0)).at[:, 0, 2].multiply(1 + x[1]))
        return udk.gaps(mech, run=moved).least.distance

    check_derivatives(least, np.array([0.0, 0.0]), 1e-6)


def test_a_run_and_a_drive_agree():
    mech = four_bar()
    run = udk.simulate(mech, np.linspace(0, 2 * np.pi, 400))
    motion = udk.kinematics(mech, "motor", np.linspace(0, 2 * np.pi, 400), rate=3.0)
    back = udk.kinematics(mech, "motor", np.linspace(2 * np.pi, 0, 400), rate=3.0)
    wanted = udk.gaps(mech).least
    for given in (run, motion, back):
        found = udk.gaps(mech, run=given).least
        assert found.distance == pytest.approx(wanted.distance, abs=1e-9)


@pytest.mark.parametrize("scale", [1e-6, 1e3])
def test_gaps_grow_with_the_mechanism(scale):
    pins = {name: scale * np.array(place) for name, place in FOUR_BAR.items()}
    one, other = udk.gaps(four_bar()), udk.gaps(four_bar(scale * np.array([0.01, 0.012, 0.015]), pins))
    assert other.least.distance == pytest.approx(scale * one.least.distance, rel=1e-9)


def test_shapes_of_bodies_without_a_drawing():
    mech = udk.library.parallelogram()
    drive = f"body.{mech.body_names[0]}.angle"
    with pytest.raises(udk.SceneError, match=r"has no outline; give its width or corners, shapes="):
        udk.gaps(mech, drive)
    given = dict.fromkeys(mech.body_names, 0.01)
    found = udk.gaps(mech, drive, shapes=given)
    assert np.isfinite([gap.distance for gap in found.pairs]).all()
    wide = udk.gaps(mech, drive, shapes=given | {mech.body_names[0]: 0.03})
    for gap in found.pairs:
        other = next(x for x in wide.pairs if x.pair == gap.pair)
        less = 0.01 if mech.body_names[0] in gap.pair else 0.0
        assert other.distance == pytest.approx(gap.distance - less, abs=1e-12)


def test_links_on_one_pin_are_joined_whichever_of_them_its_joints_connect():
    """At a pin of three links, and at a place of the ground with two cranks, each link overlaps with each other."""
    ends = {"crank": "OA", "coupler": "AB", "rocker": "BC", "rod": "BD", "other": "OF"}
    links = {name: {"pins": list(pins), "mass": 1} for name, pins in ends.items()}
    pins = FOUR_BAR | {"D": [0.1, 0.2], "F": [0.03, 0.0]}
    mech = udk.Drawing(pins=pins, links=links, ground=["O", "C"]).mechanism()
    assert not any({"rocker", "rod"} == set(joint.bodies) for joint in mech.joints.values())
    found = joined_pairs(mech)
    assert {frozenset(pair) for pair in found} == {
        frozenset(pair) for pair in [
            ("ground", "crank"), ("ground", "other"), ("ground", "rocker"), ("crank", "coupler"), ("coupler", "rocker"),
            ("coupler", "rod"), ("rocker", "rod"), ("crank", "other"),
        ]
    }  # fmt: skip
    points = mech.parameters()["joint.B-2.points"]
    moved = mech.with_parameters({"joint.B-2.points": points + np.array([[1e-6, 0.0], [0.0, 0.0]])})
    assert ("rocker", "rod") not in joined_pairs(moved) and ("coupler", "rod") in joined_pairs(moved)


def test_layers_are_the_fewest_and_free_of_contacts():
    assert udk.layers(four_bar()).count == 2
    wide = udk.layers(four_bar((0.1, 0.012, 0.12)))
    assert wide.count == 3 and wide.is_least and ("crank", "rocker") in wide.conflicts
    mech, values = random_linkage(3)
    found = udk.layers(mech, "motor", values=values)
    assert all(found.of[one] != found.of[other] for one, other in found.conflicts)
    if max(map(list(found.of.values()).count, found.of.values())) > 1:
        assert udk.gaps(mech, "motor", values=values, layers=found.of).least.distance > 0


WRONG = {
    "no width": (lambda: udk.gaps(four_bar((0.01, 0.012, None))), 'link "rocker": has no width; give width= to the link'),
    "unknown link": (lambda: udk.gaps(four_bar(), pairs=[("crank", "roker")]), 'no link named "roker"; did you mean "rocker"'),
    "unknown shape": (lambda: udk.gaps(four_bar(), shapes={"crnk": 0.1}), 'shapes: no link named "crnk"; did you mean "crank"'),
    "clash": (lambda: udk.gaps(four_bar(), layers={"crank": 0, "coupler": 0, "rocker": 1}), "share .* both in layer 0"),
    "no layer": (lambda: udk.gaps(four_bar(), layers={"crank": 0, "coupler": 1}), "no layer for .*rocker"),
    "alone": (lambda: udk.gaps(four_bar(), layers={"crank": 0, "coupler": 1, "rocker": 2}), "no two links are in one layer"),
    "ground": (lambda: udk.gaps(four_bar(), pairs=[("ground", "coupler")]), "the ground has no outline"),
    "negative": (lambda: udk.gaps(four_bar(), shapes={"crank": -0.1}), "width must be finite and not negative"),
    "both": (lambda: udk.gaps(four_bar(), pairs=[("crank", "rocker")], layers={}), "pairs and layers are both given"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_named_with_its_cure(case):
    call, message = WRONG[case]
    with pytest.raises(udk.SceneError, match=message):
        call()


def test_gaps_are_printed_in_the_units_of_the_drawing():
    pins = {name: 1e3 * np.array(place) for name, place in FOUR_BAR.items()}
    mech, plain = four_bar((10.0, 12.0, 15.0), pins, units={"length": "mm"}), udk.gaps(four_bar())
    found, wide = udk.gaps(mech), four_bar((100.0, 12.0, 120.0), pins, units={"length": "mm"})
    assert str(found).splitlines()[0] == "least gaps between links, by the angle of O-A from the x axis"
    assert f"{1e3 * plain.least.distance:.6g} mm  at  {np.degrees(found.least.value):.6g} deg" in str(found)
    (touch,) = udk.gaps(wide).contacts
    ends = (f"{np.degrees(x):.6g} deg" for x in touch[1:])
    assert "crank and rocker touch from {} to {}".format(*ends) in str(udk.gaps(wide))
    run = udk.kinematics(mech, "motor", np.linspace(3.0, 4.5, 31))
    assert f"mm  at  {np.degrees(found.least.value):.5g}" in str(udk.gaps(mech, run=run))
    in_time = udk.gaps(mech, run=udk.simulate(mech, np.linspace(0.0, 6.0, 61)))
    assert str(in_time).splitlines()[0] == "least gaps between links, by time" and f"{in_time.least.value:.6g} s" in str(in_time)


def test_the_command_reports_gaps_layers_and_contacts(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    udk.save(four_bar(), scene)
    assert udkjax("gaps", scene, "--json") == 0
    results = json.loads(capsys.readouterr().out)
    assert results["gaps"][0]["distance"] == pytest.approx(udk.gaps(four_bar()).least.distance, rel=1e-12)
    pins = {name: 1e3 * np.array(place) for name, place in FOUR_BAR.items()}
    udk.save(four_bar((100.0, 12.0, 120.0), pins, units={"length": "mm"}), scene)
    overlap = f"crank and rocker overlap by {-1e3 * udk.gaps(udk.load(scene)).least.distance:.6g} mm"
    assert udkjax("gaps", scene) == 1 and overlap in capsys.readouterr().err
    assert udkjax("gaps", scene, "--layers") == 0 and "3 fewest layers" in capsys.readouterr().out
