"""All four-bars through nine points or five poses: published counts, known mechanisms, identities, and refused input."""

import json
from pathlib import Path

import numpy as np
import pytest

import udkjax as udk
from udkjax.scene import SceneError
from udkjax.synthesis.complete.four_bars import GRASHOF_KINDS, FourBars, classify

DATA = json.loads((Path(__file__).parents[2] / "data" / "path_synthesis.json").read_text())["nine_points"]
LINKS = {name: {"pins": list(pins), "mass": 1.0} for name, pins in (("crank", "OA"), ("coupler", "ABP"), ("rocker", "CB"))}
PINS = {"O": (0, 0), "A": (3, 4), "B": (12, 9), "P": (6, 12), "C": (10, 0)}
FOUR_BAR = udk.Drawing(PINS, LINKS, ground=["O", "C"], motors={"motor": {"pin": "O", "speed": 1.0}})


def places_of(frame, crank, coupler, rocker, point, angles):
    """Joints A, B and the traced point of a four-bar from the origin along x, in complex numbers, and the coupler's angle."""
    A = crank * np.exp(1j * np.asarray(angles))
    way = frame - A
    reach = np.abs(way)
    turn = way / reach * np.exp(1j * np.arccos((coupler**2 + reach**2 - rocker**2) / (2 * coupler * reach)))
    return A, A + coupler * turn, A + point * turn, np.angle(turn)


def crank_error(places, a, A, B, b):
    """The largest change of the length of crank b B as the coupler goes through the places with a A of constant length."""
    x, y, worst = A - places[0], B - places[0], 0.0
    for place in places[1:]:
        # |place + t x - a| = |A - a|: t x (place - a)* has a known real part; of both roots one keeps the other crank, too.
        w, size = x * np.conj(place - a), np.abs(A - a) ** 2 - np.abs(place - a) ** 2 - np.abs(x) ** 2
        t = np.exp(1j * (np.array([1, -1]) * np.arccos(np.clip(size / (2 * np.abs(w)), -1, 1)) - np.angle(w)))
        worst = max(worst, np.abs(np.abs(place + t * y - b) - np.abs(B - b)).min())
    return worst


@pytest.fixture(scope="module")
def published():
    return udk.design_all(FOUR_BAR, udk.PathGoal("P", DATA["points"]))


@pytest.mark.slow
def test_the_published_problem_has_its_64_real_classes(published):
    assert published.paths == {"tracked": DATA["classes"], "regular": DATA["classes"]}
    assert published.classes == DATA["real_classes"] == len({*published.numbers})
    assert len(published) == DATA["real_solutions_with_cognates_and_swaps"]
    assert published.unproven == 0 and published.radius.max() < 1e-10
    assert str(published).startswith(f"{len(published)} four-bars") and "proven within" in str(published[0])


@pytest.mark.slow
def test_limits_leave_out_what_is_beyond_them(published):
    limits = {"lengths": {("O", "A"): (0.1, 2.0)}, "bounds": {"pin.O": (-3.0, 3.0)}, "areas": {"C": (0.5, 0.5, 4.0)}}
    found = udk.design_all(FOUR_BAR, udk.PathGoal("P", DATA["points"]), transmission=0.05, rotation=True, **limits)
    pivot, joint, end = (published.pins[f"pin.{name}"] for name in "OAC")
    crank, off = np.linalg.norm(joint - pivot, axis=1), np.linalg.norm(end - 0.5, axis=1)
    inside = (crank >= 0.1) & (crank <= 2.0) & (np.abs(pivot) <= 3.0).all(axis=1) & (off <= 4.0)
    inside &= (published.transmission >= np.sin(0.05)) & published.turns
    assert 0 < len(found) == inside.sum() == len(published) - found.left_out
    np.testing.assert_array_equal(found.pins["pin.O"], pivot[inside])
    with pytest.raises(SceneError, match="no pin named"):
        udk.design_all(FOUR_BAR, udk.PathGoal("P", DATA["points"]), lengths={("O", "Z"): (0, 1)})


@pytest.mark.slow
def test_other_ends_are_listed():
    """If places share a coordinate, some solutions coincide and others go to infinity. Each is counted and listed."""
    y = [1, 2, -1, 0.5, 3, 0.5, -1, 2, 1]
    found = udk.design_all(FOUR_BAR, udk.PathGoal("P", np.stack([np.arange(9.0) - 4.0, y], 1)))
    kinds = [other.kind for other in found.others]
    assert kinds.count("infinite") == found.paths["infinite"] > 0 and kinds.count("singular") == found.paths["singular"] > 0
    assert found.paths["regular"] + found.paths["infinite"] + found.paths["singular"] == 1442
    # Two more have real joints and, where the place is on the axis of symmetry, no real turn: they are none of the real ones.
    assert found.unproven == 0


@pytest.mark.slow
def test_places_whose_solutions_are_far_away_have_all_of_them():
    """One class of solutions for these places has a pivot 1e8 units away, and is not at infinity."""
    found = udk.design_all(FOUR_BAR, udk.PathGoal("P", np.random.default_rng(1028).normal(size=(9, 2))))
    assert found.paths == {"tracked": 1442, "regular": 1442} and not found.others


def test_pins_hold_their_links_in_all_positions(published):
    """If the coupler of a four-bar turns so that one crank keeps its length, the other one keeps its length as well."""
    pivot, joint, other, traced, end = ([1, 1j] @ published.pins[f"pin.{name}"].T for name in "OABPC")
    places = np.array(DATA["points"]) @ [1, 1j]
    for k in range(0, len(published), 7):
        error = crank_error(places, pivot[k], joint[k], other[k], end[k])
        assert error < 1e-6 * (1 + np.abs(end[k]) + np.abs(other[k] - traced[k]))


def test_motions_confirm_what_has_no_defect(published):
    free = [k for k, defect in enumerate(published.defects) if defect == "none"]
    assert free == [0, 1] and published.confirmed[free].all()
    assert np.abs(published.transmission).min() < 1e-3  # a position next to a dead point, from where the crank turns by little
    assert published.confirmed.all()
    one = published[0]
    moved = udk.kinematics(one.mechanism, "motor", one.values)
    np.testing.assert_allclose(udk.path(one.mechanism, moved, "P"), DATA["points"], atol=1e-9)
    steps = np.diff(one.values)
    assert one.turns and ((steps > 0).all() or (steps < 0).all()) and np.abs(np.ptp(one.values)) < 2 * np.pi
    assert bool(np.all(one.motion(19).reached))


def test_circuits_are_those_that_motions_meet(published):
    """For cranks that turn, a whole turn from the first position passes exactly the places of its circuit."""
    places = np.array(DATA["points"])
    for k in np.flatnonzero(published.turns)[::30]:
        one = published[int(k)]
        turn = np.linspace(0, 2 * np.pi, 1441)
        motion = udk.kinematics(one.mechanism, "motor", one.values[0] + turn)
        curve = np.asarray(udk.path(one.mechanism, motion, "P"))
        at = np.array(
            [np.argmin(np.abs(np.mod(turn - (value - one.values[0]) + np.pi, 2 * np.pi) - np.pi)) for value in one.values]
        )
        step = np.max(np.linalg.norm(np.diff(curve, axis=0), axis=1))
        meets = np.linalg.norm(curve[at] - places, axis=1) <= step
        assert (meets == (one.circuits == 0)).all()


@pytest.mark.slow
def test_a_known_mechanism_is_among_those_found():
    """Random four-bars, turned, moved and scaled. If the crank turns, the nine points are in order, without defects."""
    rng = np.random.default_rng(3)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 9))
    A, B, P, _ = places_of(4.0, 1.0, 3.5, 3.0, 2.0 + 1.5j, angles)
    move = 0.02 * np.exp(0.7j)
    offset = 3.0 - 2.0j
    places = move * P + offset
    found = udk.design_all(FOUR_BAR, udk.PathGoal("P", np.stack([places.real, places.imag], 1)))
    assert found.paths["regular"] == 1442
    known = {"O": offset, "C": move * 4.0 + offset, "A": move * A[0] + offset, "B": move * B[0] + offset}
    off = np.max([np.abs([1, 1j] @ found.pins[f"pin.{name}"].T - place) for name, place in known.items()], axis=0)
    best = int(np.argmin(off))
    assert off[best] < 1e-9 * 0.02 and found.radius[best] < 1e-9 * 0.02
    assert found.kinds[best] == "crank-rocker" and found.defects[best] == "none" and found.confirmed[best].all()
    np.testing.assert_allclose(found.values[best] - found.values[best][0], angles - angles[0], atol=1e-9)


def test_five_poses_of_a_known_four_bar():
    angles = np.array([0.2, 0.9, 1.7, 2.2, 3.0])
    A, B, P, turn = places_of(4.0, 1.0, 3.5, 3.0, 2.0 + 1.5j, angles)
    goal = udk.PoseGoal("coupler", np.stack([P.real, P.imag, turn], 1), pin="P")
    found = udk.design_all(FOUR_BAR, goal)
    assert found.paths["dyads"] == 4 and found.classes in (2, 4) and len(found) == found.classes * (found.classes - 1)
    known = {"O": 0, "C": 4.0, "A": A[0], "B": B[0]}
    off = np.max([np.abs([1, 1j] @ found.pins[f"pin.{name}"].T - place) for name, place in known.items()], axis=0)
    best = int(np.argmin(off))
    assert off[best] < 1e-10 and found.defects[best] == "none" and found.confirmed[best].all()
    one = found[best]
    moved = udk.kinematics(one.mechanism, "motor", one.values)
    np.testing.assert_allclose(udk.path(one.mechanism, moved, "P"), goal.targets[:, :2], atol=1e-9)
    body = one.mechanism.body_names.index("coupler")
    np.testing.assert_allclose(np.diff(np.unwrap(np.asarray(moved.q)[:, body, 2])), np.diff(np.unwrap(turn)), atol=1e-9)


@pytest.mark.parametrize(
    ("lengths", "kind", "turns"),
    [
        ((4, 1, 3.5, 3), "crank-rocker", True),
        ((1, 3, 3.5, 4), "double crank", True),
        ((3.5, 3, 1, 4), "double rocker", False),
        ((4, 3, 3.5, 1), "rocker-crank", False),
        ((4, 2, 1.5, 3), "triple rocker", False),
    ],
)
def test_kinds_by_the_shortest_link(lengths, kind, turns):
    frame, crank, coupler, rocker = lengths
    angles = np.linspace(0.05, 2 * np.pi, 60)
    with np.errstate(invalid="ignore"):
        A, B, P, _ = places_of(frame, crank, coupler, rocker, 1.0, angles)
    there = np.isfinite(B)
    bars = FourBars(np.zeros(1), np.full(1, complex(frame)), A[None, there], B[None, there], P[there])
    found = classify(bars)
    assert GRASHOF_KINDS[found.kind[0]] == kind and found.turns[0] == turns == there.all()
    if turns:
        assert found.defect[0] == 0 and (found.order[0] == np.arange(there.sum())).all()


def test_cognates_trace_the_same_points():
    A, B, P, _ = places_of(4.0, 1.0, 3.5, 3.0, 2.0 + 1.5j, np.linspace(0, 5, 9))
    for bars in FourBars(np.zeros(1, complex), np.full(1, 4.0 + 0j), A[None], B[None], P).cognates():
        for start, end in ((bars.O[:, None], bars.A), (bars.A, bars.B), (bars.C[:, None], bars.B), (bars.A, bars.P)):
            np.testing.assert_allclose(np.abs(end - start), np.abs(end - start)[:, :1] * np.ones((1, 9)), rtol=1e-12)


CIRCLE = np.stack([np.cos(np.arange(9) * 0.6), np.sin(np.arange(9) * 0.6)], 1)


@pytest.mark.parametrize(
    ("targets", "says"),
    [
        (np.array(DATA["points"])[:8], "nine points; there are 8: use `design`"),
        (np.array([*DATA["points"], DATA["points"][0]]), "leave out the last one"),
        (np.array([*DATA["points"][:8], DATA["points"][2]]), "targets 2 and 8 are the same"),
        (np.stack([np.arange(9.0), 2 * np.arange(9.0)], 1), "9 of the targets are on one line"),
        (3.0 * CIRCLE + 5.0, "9 of the targets are on one circle"),
    ],
)
def test_places_without_isolated_solutions_are_refused(targets, says):
    with pytest.raises(ValueError, match=says):
        udk.design_all(FOUR_BAR, udk.PathGoal("P", targets))


def test_other_mistakes_are_named():
    nine = udk.PathGoal("P", DATA["points"])
    five = np.array([[0, 0, 0], [1, 0, 0.2], [2, 1, 0.1], [3, 1, 0.5], [4, 0, 0.3]], float)
    with pytest.raises(ValueError, match="five poses; there are 4"):
        udk.design_all(FOUR_BAR, udk.PoseGoal("coupler", five[:4], pin="P"))
    with pytest.raises(ValueError, match="targets 1 and 4 are the same pose"):
        udk.design_all(FOUR_BAR, udk.PoseGoal("coupler", five[[0, 1, 2, 3, 1]], pin="P"))
    with pytest.raises(ValueError, match="not isolated"):
        udk.design_all(FOUR_BAR, udk.PoseGoal("coupler", five * [1, 0, 0], pin="P"))
    with pytest.raises(ValueError, match="pin: name the pin"):
        udk.design_all(FOUR_BAR, udk.PoseGoal("coupler", five))
    with pytest.raises(SceneError, match="the coupler"):
        udk.design_all(FOUR_BAR, udk.PoseGoal("crank", five, pin="P"))
    with pytest.raises(SceneError, match="must have the pins"):
        udk.design_all(FOUR_BAR, udk.PathGoal("B", DATA["points"]))
    with pytest.raises(SceneError, match="drive the angle of"):
        udk.design_all(FOUR_BAR, nine, driver="body.coupler.angle")
    with pytest.raises(ValueError, match="values of the driver"):
        udk.design_all(FOUR_BAR, udk.PathGoal("P", DATA["points"], values=np.arange(9.0)))
    slider = udk.library.slider_crank()
    with pytest.raises(SceneError, match="four-bar"):
        udk.design_all(slider, nine)
