"""The data of the player, without a browser."""

import json
import re
import tracemalloc
from collections import Counter
from html import unescape
from importlib.resources import files

import numpy as np
import pytest

import udkjax as udk
from tests.show.player.conftest import Motion
from udkjax.integrate.events.law.conditions import Gap
from udkjax.native.module.steps import Status
from udkjax.show.player.animation import FailedRunWarning
from udkjax.show.player.marks.mark_places import body_points, corners_of, to_ground
from udkjax.show.player.marks.marks import marks
from udkjax.show.player.marks.measure_curves import measures_of, reaction_arrows
from udkjax.show.player.page import module, page
from udkjax.show.player.player_data import PRECISION, run_record


def kinds(animation, k=0):
    return [mark["kind"] for mark in animation.data["runs"][k]["marks"]]


def embedded(text):
    """The data inside a page, as a browser reads it."""
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    return json.loads(found)


def test_poses_are_those_of_the_run_within_the_stated_precision(animation, run, slider_crank):
    length = float(udk.analyse(slider_crank).length)
    for k in (0, 17, 80):
        (pose,) = animation.pose(run.ts[k])
        error = np.abs(pose - run.q[k]) / [length, length, 1.0]
        assert error.max() <= 0.51 * PRECISION


def test_between_instants_poses_follow_the_velocities(animation, closed_form):
    ts = np.linspace(0.0, 2.0, 331)
    exact = closed_form.run(ts).q
    found = np.array([animation.pose(t)[0] for t in ts])
    assert np.abs(found - exact).max() < 3e-5  # cubic on 25 ms: (4 rad/s 0.025 s)^4 / 384 and half a step of precision


def test_a_page_of_twenty_seconds_of_the_papers_linkage_is_small():
    mech = udk.library.parallelogram()
    sol = udk.simulate(mech, np.linspace(0, 20, 401))
    text = udk.animate(mech, sol, measures={"angle (rad)": np.asarray(sol.q)[:, 0, 2]}).html()
    assert len(text.encode()) < 90_000
    assert "WebAssembly" not in text  # the page does not simulate
    assert not re.search(r"(?:src|href|@import|url\()\s*=?\s*[\"']?(?:https?:)?//", text)


def test_marks_of_each_kind_of_joint():
    gear = marks(udk.library.planetary_gear(), udk.library.planetary_gear().q0[None])
    wheels = [(m["body"], m["radius"], m["internal"]) for m in gear if m["kind"] == "wheel"]
    assert wheels[0] == (-1, pytest.approx(0.4), True)  # the ring is in the background
    assert sorted(wheels[1:]) == [(0, 0.2, False), (1, 0.1, False), (2, 0.1, False), (3, 0.1, False)]
    lift = udk.library.scissor_lift()
    found = marks(lift, lift.q0[None])
    assert [m["kind"] for m in found].count("support") == 1 and sum(m["kind"] == "rail" for m in found) == 3
    assert [m["slot"] for m in found if m["kind"] == "rail"] == [False, True, True]
    crank = udk.library.slider_crank(spring=(100.0, 1.5, 3.0))
    assert {"motor", "block", "spring", "rail"} <= {m["kind"] for m in marks(crank, crank.q0[None])}


def test_a_rail_is_as_long_as_its_used_range(slider_crank, run):
    (rail,) = (mark for mark in marks(slider_crank, run.q) if mark["kind"] == "rail")
    margin = 0.08 * 2.0  # relative to the size of the mechanism in its first pose
    way = run.q[:, 2, 0] - float(slider_crank.joints["guide"].points[0, 0])
    np.testing.assert_allclose(rail["span"], [way.min() - margin, way.max() + margin], rtol=1e-6)


def test_a_cams_outline_is_its_profile():
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    profile = udk.Profile(angle, 0.5 + 0.1 * np.cos(angle))
    mech = udk.Mechanism(
        {"cam": udk.Body(1, 1), "follower": udk.Body(1, 1, (0, 0.5))},
        {"cam": udk.Cam(("cam", "follower"), [(0.2, 0), (0, 0)], profile)},
    )
    (outline,) = (mark for mark in marks(mech, mech.q0[None]) if mark["kind"] == "outline")
    assert outline["at"] == [0.2, 0.0]
    x, y = np.array(outline["points"]).T
    expected = 0.5 + 0.1 * np.cos(np.arctan2(y, x))
    np.testing.assert_allclose(np.hypot(x, y), expected, atol=1e-4)  # the spline is within 1e-4 of the cosine


def test_a_rod_that_hangs_by_its_end_is_drawn_to_its_other_end():
    rod = udk.library.compound_pendulum(length=1.4)
    heavy = rod.with_parameters({f"body.{rod.body_names[0]}.inertia": 3.0})
    for mech, ends in ((rod, (-0.7, 0.7)), (heavy, (-0.7, 0.0))):
        every = marks(mech, mech.q0[None])
        (link,) = (mark for mark in every if mark["kind"] == "link")
        np.testing.assert_allclose(sorted(np.array(link["points"])[:, 0]), ends, atol=1e-12)
        assert ("disc" in {mark["kind"] for mark in every}) == (mech is heavy)


def test_bodies_are_drawn_through_further_points(slider_crank, run):
    animation = udk.animate(slider_crank, run, measures=(), shapes={"rod": [(0.1, 0.4)]}, traces=(("rod", (0.1, 0.4)),))
    (rod,) = (m for m in animation.data["runs"][0]["marks"] if m["kind"] == "link" and m["body"] == 1)
    assert rod["closed"] and [0.1, 0.4] in rod["points"] and animation.data["runs"][0]["traces"] == [[1, 0.1, 0.4]]
    with pytest.raises(ValueError, match="shapes: there is no body 'rot'"):
        udk.animate(slider_crank, run, measures=(), shapes={"rot": [(0, 0)]})


def test_corners_of_plates_and_ends_of_bars():
    inner = np.array([[0.0, 0], [2, 0], [0.5, 0.4], [0, 2]])  # the third is inside the triangle of the others
    corners, closed = corners_of(inner)
    assert closed and sorted(map(tuple, corners)) == [(0, 0), (0, 2), (2, 0)]
    ends, closed = corners_of(np.array([[1.0, 1], [0, 0], [3, 3]]))
    assert not closed and abs(ends[0] - ends[-1]).tolist() == [3, 3]
    np.testing.assert_allclose(to_ground((1, 0), np.array([[3.0, 4.0, np.pi / 2]])), [[3, 5]], atol=1e-15)


def test_attachments_of_bodies_are_listed_once():
    points = body_points(udk.library.parallelogram())
    np.testing.assert_allclose(points["ground"], [[0, 0], [1, 0], [2, 0]])
    assert len(points["coupler"]) == 3 and len(points["link1"]) == 2


def test_singular_values_and_rank_of_the_papers_linkage():
    mech = udk.library.parallelogram()
    poses = np.stack([mech.q0, mech.q0])
    poses[1] = np.nan
    run = Motion(ts=np.zeros(2), q=poses, v=0 * poses)
    rank, smallest = measures_of(mech, run, ("rank",), "")
    assert rank.values[0] == 11 and np.isnan(rank.values[1])
    expected = udk.singular_values(mech, 0.0, poses[0])
    assert smallest.name == "singular value 11" and expected[11] < 1e-14
    np.testing.assert_allclose(smallest.values, [float(expected[10]), np.nan], rtol=1e-12)


@pytest.mark.slow
def test_the_rank_of_a_large_mechanism_is_found_without_dense_matrices():
    """A dense Jacobian has 72 kB here; of each position the curve needs two numbers."""
    mech = udk.library.chain(50)
    run = Motion(ts=np.arange(200.0), q=np.tile(mech.q0, (200, 1, 1)), v=np.zeros((200, 50, 3)))
    measures_of(mech, run, ("rank",), "")
    tracemalloc.start()
    rank, smallest = measures_of(mech, run, ("rank",), "")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200 * 36_000 and (rank.values == 100).all()
    np.testing.assert_allclose(smallest.values, udk.singular_values(mech, 0.0, mech.q0)[99], rtol=1e-12)


def test_measures_are_those_of_the_equations(slider_crank, run):
    violation, change, kinetic, potential = measures_of(slider_crank, run, ("violation", "energy"), "")
    assert violation.log and violation.values.max() < 1e-14 and (violation.unit, kinetic.unit) == ("m", "J")
    total = np.asarray(udk.energy(slider_crank, run).total)
    np.testing.assert_allclose(kinetic.values + potential.values, total)
    np.testing.assert_allclose(change.values, total - total[0], atol=1e-12)
    (own,) = measures_of(slider_crank, run, {"torque (N m)": {"a": run.ts, "b": 2 * run.ts}}, "b")
    assert (own.name, own.unit) == ("torque", "N m") and own.values[-1] == 4.0
    with pytest.raises(ValueError, match="'energie' is unknown: use violation, energy, rank"):
        measures_of(slider_crank, run, ("energie",), "")
    with pytest.raises(ValueError, match="has shape"):
        measures_of(slider_crank, run, {"torque": run.ts[:3]}, "")


def test_arrows_are_the_reactions():
    mech = udk.library.compound_pendulum(0.3)
    run = Motion(ts=np.zeros(1), q=np.asarray(mech.q0)[None], v=np.zeros((1, 1, 3)))
    anchors, forces, unique = reaction_arrows(mech, run)
    (name,) = mech.joints
    expected = udk.reactions(mech, run)[name][mech.body_names[0]][0, :2]
    np.testing.assert_allclose(forces[0, 0], expected)
    assert anchors[0][0] == 0 and np.linalg.norm(forces) > 1 and unique == [True]
    arrows = udk.animate(mech, run, measures=(), reactions=True).data["runs"][0]["reactions"]
    assert arrows["usual"] == pytest.approx(np.linalg.norm(expected))


def test_forces_shared_by_redundant_constraints_are_marked():
    mech = udk.library.parallelogram()
    run = Motion(ts=np.zeros(1), q=np.asarray(mech.q0)[None], v=np.zeros((1, 4, 3)))
    assert reaction_arrows(mech, run)[2] == [False] * 6  # how the three links share the coupler's weight is indeterminate
    arrows = udk.animate(mech, run, measures=(), reactions=True).data["runs"][0]["reactions"]
    assert arrows["unique"] == [False] * 6


def test_a_failed_run_is_shown_up_to_its_failure(slider_crank, run):
    q = run.q.copy()
    q[50:] = np.nan
    broken = Motion(ts=run.ts, q=q, v=run.v, cause="not finite at t = 1.25 s")
    record, poses = run_record(slider_crank, broken, "", (), False, None)
    assert len(poses) == record["q"]["rows"] == 50 and "1.25 s" in record["note"]
    with pytest.warns(FailedRunWarning, match="'slow' failed: not finite"):
        assert "slow" in udk.animate(slider_crank, {"slow": broken}, measures=()).failures
    with pytest.warns(FailedRunWarning, match="the position is not finite at t ="):  # a motion without a cause
        udk.animate(slider_crank, Motion(ts=run.ts, q=q, v=run.v), measures=())
    with pytest.raises(ValueError, match="has no state to show: not finite"):
        run_record(slider_crank, Motion(ts=run.ts, q=np.nan * q, v=run.v, cause=broken.cause), "", (), False, None)


def test_long_runs_are_thinned_out_and_stay_exact(slider_crank, closed_form):
    fine = closed_form.run(np.linspace(0, 5, 20_001))
    animation = udk.animate(slider_crank, fine, measures=())
    assert animation.data["runs"][0]["q"]["rows"] == 2400
    for t in (1.2345, 4.9999):
        np.testing.assert_allclose(animation.pose(t)[0], closed_form.run([t]).q[0], atol=2e-5)


def test_traces_are_the_moving_pins_or_named_points(slider_crank, run):
    by_default = udk.animate(slider_crank, run, measures=()).data["runs"][0]["traces"]
    assert len(by_default) == 2  # P on its circle and B on its line, each on two bodies; O does not move
    named = udk.animate(slider_crank, run, measures=(), traces=("rod", "P")).data["runs"][0]["traces"]
    assert named == [[1, 0.0, 0.0], [1, -0.75, 0.0]]  # a pin is a point of the second body
    with pytest.raises(ValueError, match="trace 'Q': \"Q\" is neither a body nor a pin"):
        udk.animate(slider_crank, run, measures=(), traces=("Q",))


def test_a_plate_is_drawn_as_its_polygon_and_its_free_pins_are_traced():
    """A bell crank has a reentrant corner; its end T is on no other link."""
    corners = {"O": (0, 0), "S": (2, 0.5), "B": (0.5, 0.5), "T": (0.5, 2)}
    bent = udk.Drawing(pins=corners, links={"bent": udk.Link(list(corners), mass=1)}, ground=["O"]).mechanism()
    poses = np.stack([np.asarray(bent.q0), np.asarray(bent.q0)])
    poses[1, 0, :2] += 1.0
    (link,) = (mark for mark in marks(bent, poses) if mark["kind"] == "link")
    at = np.array(link["points"]) - link["points"][0]
    np.testing.assert_allclose(np.linalg.norm(at, axis=1), np.linalg.norm(list(corners.values()), axis=1))
    still = Motion(ts=np.arange(2.0), q=poses, v=0 * poses)
    assert len(udk.animate(bent, still, measures=()).data["runs"][0]["traces"]) == 4


def test_the_line_of_a_contact_is_drawn_over_its_used_range():
    """A ball falls on an incline; the line is drawn around the closest point, with the free side to its left."""
    ball = udk.Mechanism({"ball": udk.Body(1.0, 0.1, position=(1.0, 2.0))})
    (event,) = udk.Contact("ball", through=(1.0, 0.0), normal=(1.0, 1.0)).expand(ball)
    assert isinstance(event.condition, Gap)
    (floor,) = (
        mark
        for mark in marks(ball, np.array([[[1.0, 2.0, 0.0]], [[1.0, 0.0, 0.0]]]), gaps=[event.condition])
        if mark["kind"] == "floor"
    )
    assert (floor["body"], floor["at"], floor["axis"]) == (-1, [1.0, 0.0], pytest.approx(-np.pi / 4))
    assert floor["span"][0] < 0 < floor["span"][1] < 0.5


def test_bounds_contain_every_pose(animation, run):
    left, bottom, right, top = animation.data["bounds"]
    assert left <= -0.499 and right >= 1.999 and bottom <= -0.499 and top >= 0.499
    assert right - left < 3.2 and top - bottom < 1.5


def test_several_runs_and_wrong_ones(slider_crank, run, closed_form):
    short = closed_form.run(np.linspace(0.5, 1.0, 11))
    data = udk.animate(slider_crank, {"long": run, "short": short}, measures=()).data
    assert [r["label"] for r in data["runs"]] == ["long", "short"] and (data["start"], data["end"]) == (0.0, 2.0)
    batch = Motion(ts=run.ts, q=run.q[None], v=run.v[None])
    with pytest.raises(ValueError, match="solution is a batch of 1 solutions: take one of them"):
        udk.animate(slider_crank, batch)
    with pytest.raises(ValueError, match="no run"):
        udk.animate(slider_crank, {})


def test_a_mechanism_without_a_run_is_shown_as_in_its_scene(slider_crank):
    animation = udk.animate(slider_crank, measures=())
    np.testing.assert_allclose(animation.pose()[0], slider_crank.q0, atol=2e-5)
    assert animation.data["start"] == animation.data["end"] == 0.0


def test_modes_oscillate_about_their_pose(slider_crank):
    q, shapes = np.asarray(slider_crank.q0), np.zeros((2, 3, 3))
    shapes[0, 0, 2], shapes[1, 2, 0] = 7.0, -1e-3
    animation = udk.animate_modes(slider_crank, q, shapes, [0.5, 2.0])
    one, two = animation.pose(0.25)
    length = float(udk.analyse(slider_crank).length)
    np.testing.assert_allclose(one[0, 2] - q[0, 2], 0.12)  # rad
    np.testing.assert_allclose(two[2, 0] - q[2, 0], -0.12 * length)
    np.testing.assert_allclose(animation.pose(0.5), [q, q], atol=1e-15)
    assert [run["note"] for run in animation.data["runs"]] == ["0.5 Hz", "2 Hz"]
    with pytest.raises(ValueError, match="does not move anything"):
        udk.animate_modes(slider_crank, q, 0 * shapes)
    with pytest.raises(ValueError, match="not \\(modes, 3, 3\\)"):
        udk.animate_modes(slider_crank, q, shapes[0])


def test_texts_cannot_break_out_of_the_page(hostile):
    text = udk.animate(hostile.mechanism, measures=()).html()
    assert text.count("<script") == 2 and text.count("</script>") == 2
    assert "<img" not in text and "\u2028" not in text[text.index("<script") :] and "<b on" not in text
    data = embedded(text)
    assert data["title"] == hostile.names[0] and data["runs"][0]["bodies"] == [hostile.names[1]]
    assert {mark["name"] for mark in data["runs"][0]["marks"] if mark["kind"] == "pin"} == set(hostile.names[2:])
    frame = udk.animate(hostile.mechanism, measures=())._repr_html_()
    assert frame.count("<") == 2 and frame.startswith("<iframe") and frame.endswith("</iframe>")


def test_numbers_that_are_not_finite_are_refused_as_json(animation):
    with pytest.raises(ValueError, match="not JSON compliant"):
        page(animation.data | {"speed": np.nan})


def test_an_animation_shows_itself(animation):
    assert "2 s" in repr(animation)
    assert animation._repr_html_().startswith("<iframe")


def shown_by_ipython(animation):
    return pytest.importorskip("IPython.core.formatters").DisplayFormatter().format(animation)


def test_a_notebook_keeps_the_player(animation):
    """A cell's output does not need Python: nbconvert would leave a widget empty."""
    data, _ = shown_by_ipython(animation)
    assert set(data) == {"text/plain", "text/html"} and embedded(unescape(data["text/html"]))["runs"]


@pytest.mark.slow
def test_nbconvert_keeps_the_player(animation):
    nbformat, nbconvert = pytest.importorskip("nbformat"), pytest.importorskip("nbconvert")
    data, metadata = shown_by_ipython(animation)
    output = nbformat.v4.new_output("display_data", data, metadata=metadata)
    cell = nbformat.v4.new_code_cell("animation", outputs=[output])
    text, _ = nbconvert.HTMLExporter().from_notebook_node(nbformat.v4.new_notebook(cells=[cell]))
    assert embedded(unescape(text)) == embedded(unescape(data["text/html"]))


def test_the_page_knows_the_ways_in_which_a_run_ends():
    """The number of a status is that of machine code."""
    source = (files("udkjax") / "show" / "player" / "engine.js").read_text()
    found = re.search(r"const STATUSES = (\[.*?\]);", source)
    assert found and json.loads(found[1]) == [name.lower() for name in vars(Status) if name.isupper()]


def test_a_slot_is_drawn_on_its_lever_and_a_traced_end_has_a_dot():
    pins = {"A": (0, 0), "B": udk.polar("A", 50, 60), "E": (0, -30), "D": udk.polar("E", 110, 0, line=("E", "B"))}
    links = {"crank": {"pins": ["A", "B"], "mass": 1}, "lever": {"pins": ["E", "D"], "mass": 1}}
    slots, motors = [{"pin": "B", "along": ["E", "D"], "on": "lever"}], [{"pin": "A", "speed": "60 rpm"}]
    mech = udk.Drawing(pins, links, ["A", "E"], motors=motors, slots=slots, units={"length": "mm"}).mechanism()
    run = udk.animate(mech, udk.simulate(mech, np.linspace(0.0, 1.0, 51)), measures=()).data["runs"][0]
    kinds = [(mark["kind"], mark.get("body")) for mark in run["marks"]]
    lever = list(mech.bodies).index("lever")
    assert kinds.index(("rail", lever)) > kinds.index(("link", lever))
    (dot,) = (mark for mark in run["marks"] if mark["kind"] == "traced")
    assert dot["body"] == lever and [lever, *dot["at"]] in run["traces"]
    ends = next(mark["points"] for mark in run["marks"] if mark["kind"] == "link" and mark["body"] == lever)
    assert min(np.linalg.norm(np.subtract(dot["at"], end)) for end in ends) < 1e-9


def test_modules_of_a_page_have_different_names():
    """They become one script, in which a name that two modules declare is a syntax error: no page would run."""
    names = Counter(re.findall(r"^(?:async )?(?:const|let|class|function)\*? (\w+)", module(), re.MULTILINE))
    assert len(names) > 50 and {name for name, count in names.items() if count > 1} == set()
