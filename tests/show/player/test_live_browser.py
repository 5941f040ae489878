"""Live pages in headless Chromium: they simulate as Python does, and sliders, pulling and addresses work."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import udkjax as udk
from tests.integrate.events.event_scenes import BALL, PENDULUM
from tests.show.player.conftest import Motion
from tests.show.player.pages import PLAYER, on_screen, picture, plain, ring_centre, until
from udkjax.show.player.animation import FailedRunWarning
from udkjax.show.player.marks.measure_curves import reaction_arrows
from udkjax.show.player.marks.sketch import THEMES

TS = np.linspace(0.0, 2.0, 41)
LIVE = f"{PLAYER}.live"
SCENES = sorted(udk.library.__all__)
FAST = ("slider_crank",)
every_scene = pytest.mark.parametrize("name", [n if n in FAST else pytest.param(n, marks=pytest.mark.slow) for n in SCENES])


@pytest.fixture(scope="module")
def live(slider_crank):
    names = ["motor.motor.speed", "pin.P", "pin.B", "link.rod.mass"]
    return udk.animate(slider_crank, udk.simulate(slider_crank, TS), live=names)


@pytest.fixture(scope="module")
def pendulum():
    mechanism = udk.library.double_pendulum()
    return mechanism, udk.animate(mechanism, udk.simulate(mechanism, TS), live=["gravity"], measures=("violation", "energy"))


def shown_q(page):
    return np.array(page.evaluate(f"[...{LIVE}.runs[0].run.q]")).reshape(len(page.evaluate(f"[...{LIVE}.runs[0].run.ts]")), -1)


def events_of(run):
    assert run.events is not None
    return run.events


def measure(page, name):
    return np.array(page.evaluate(f"[...{LIVE}.runs[0].run.measures.find(m => m.name === {name!r}).values]"))


def note(page):
    return page.locator(".note").text_content()


def move(page, label, value):
    """Move a slider as a user does, and wait for the next frame."""
    number = page.get_by_role("spinbutton", name=f"{label}, number", exact=True)
    number.fill(str(value))
    number.press("Enter")
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


def show_all(page):
    for section in page.locator("details:not([open]) summary").all():
        section.click()


@every_scene
def test_the_motion_is_that_of_python(opened, name):
    """With other numbers, and with energies and torques."""
    mechanism, ts = getattr(udk.library, name)(), TS * (0.015 if name == "andrews_squeezer" else 1.0)
    given = {"gravity[1]": -6.0} | ({"motor.motor.speed": 3.0} if name == "slider_crank" else {})
    animation = udk.animate(mechanism, udk.simulate(mechanism, ts), live=list(given))
    other = mechanism.with_parameters(given)
    run = udk.simulate(other, ts)
    energy, efforts = udk.energy(other, run), udk.efforts(other, run)
    with opened(animation) as page:
        page.evaluate(f"{LIVE}.change({given})")
        until(page, f"{LIVE}.runs[0].run.ts.length === {len(TS)}")  # a long run is shown while it grows
        length = float(udk.analyse(mechanism).length)
        assert_allclose(shown_q(page), np.asarray(run.q).reshape(len(TS), -1), rtol=0, atol=1e-7 * max(length, 1.0))
        unit = max(1.0, float(np.abs(energy.total).max()))
        assert_allclose(measure(page, "kinetic energy"), energy.kinetic, rtol=0, atol=1e-6 * unit)
        assert_allclose(measure(page, "potential energy"), energy.potential, rtol=0, atol=1e-6 * unit)
        assert measure(page, "violation").max() < 1e-9 * max(length, 1.0)
        for driver, values in efforts.items():
            shown = measure(page, f"torque of {driver}")
            assert_allclose(shown, values, rtol=0, atol=1e-6 * max(1.0, float(np.abs(values).max())))


@pytest.mark.slow
def test_samples_of_loads_and_motions_are_held_between_their_times(opened):
    """A motor with a spline motion, loaded by a torque that is held between samples: both determine its driving torque."""
    knots = np.linspace(0.0, 2.0, 6)
    mechanism = udk.Mechanism(
        {"arm": udk.Body(2.0, 0.3, (0.5, 0.0))},
        {"axle": udk.Revolute(("ground", "arm"), [(0.0, 0.0), (-0.5, 0.0)])},
        {"motor": udk.Driver(("ground", "arm"), "angle", udk.Spline(knots, 0.4 * np.sin(2 * knots)))},
        {"brake": udk.Torque(("ground", "arm"), udk.Held([1.0, -2.0, 3.0], dt=0.6))},
    )
    ts = TS + 1e-3  # next to the samples
    animation = udk.animate(mechanism, udk.simulate(mechanism, ts), live=["gravity[1]", "body.arm.mass"])
    other = mechanism.with_parameters({"gravity[1]": -3.0, "body.arm.mass": 1.5})
    run = udk.simulate(other, ts)
    with opened(animation) as page:
        page.evaluate(f"{LIVE}.change({{'gravity[1]': -3.0, 'body.arm.mass': 1.5}})")
        assert_allclose(shown_q(page), np.asarray(run.q).reshape(len(ts), -1), atol=1e-8)
        assert_allclose(measure(page, "torque of motor"), udk.efforts(other, run)["motor"], atol=1e-6)


def test_arrows_of_forces_are_those_of_the_new_motion(opened, slider_crank):
    names = {"pin.P[0]": 0.4, "link.slider.mass": 5.0}
    animation = udk.animate(slider_crank, udk.simulate(slider_crank, TS), live=list(names), reactions=True)
    other = slider_crank.with_parameters(names)
    anchors, forces, unique = reaction_arrows(other, udk.simulate(other, TS))
    assert all(unique)
    with opened(animation) as page:
        before = page.evaluate(f"[...{LIVE}.runs[0].run.forces]")
        page.evaluate(f"{LIVE}.change({names})")
        shown = np.array(page.evaluate(f"[...{LIVE}.runs[0].run.forces]")).reshape(forces.shape)
        assert_allclose(shown, forces, atol=1e-6 * np.abs(forces).max())
        assert_allclose(page.evaluate(f"{LIVE}.runs[0].run.reactions.anchors"), anchors, atol=1e-12)
        page.locator(".panel canvas").press("Backspace")
        assert page.evaluate(f"[...{LIVE}.runs[0].run.forces]") == before


@pytest.mark.slow
def test_forces_that_are_not_unique_are_not_shown_for_a_new_motion(opened):
    mechanism = udk.library.parallelogram()
    with opened(udk.animate(mechanism, udk.simulate(mechanism, TS), live=["gravity"], reactions=True, measures=())) as page:
        button = page.get_by_role("button", name="Reactions")
        assert button.is_enabled()
        page.evaluate(f"{LIVE}.change({{'gravity[1]': -5}})")
        assert button.is_disabled() and page.evaluate(f"{LIVE}.runs[0].run.reactions") is None


@pytest.fixture(scope="module")
def with_events(slider_crank):
    """Two conditions, the second of which stops the motion, and its page."""
    passes = udk.Event(lambda t, at: at["slider"].x - 1.3, udk.Log(), name="passes")
    turned = udk.Event(lambda t, at: at["crank"].angle - 6.0, udk.Stop(), 1, name="turned")
    events = [passes, turned]
    run = udk.simulate(slider_crank, TS, events=events, rtol=1e-11, atol=1e-11)
    return events, udk.animate(slider_crank, run, live=["motor.motor.speed", "pin.P[0]", "gravity"], events=events)


@pytest.mark.slow
def test_events_happen_at_new_times_while_a_slider_moves(opened, with_events, slider_crank):
    events, animation = with_events
    happened = f"{LIVE}.runs[0].run.events"
    with opened(animation) as page:
        first = page.evaluate(happened)
        show_all(page)
        for speed, p, count in ((5.0, 0.45, 3), (2.0, 0.4, 1), (-9.0, 0.55, 5)):
            move(page, "motor speed", speed)
            move(page, "P x", p)
            other = slider_crank.with_parameters({"motor.motor.speed": speed, "pin.P[0]": p})
            run = udk.simulate(other, TS, events=events, rtol=1e-11, atol=1e-11)
            shown, expected = page.evaluate(happened), events_of(run)
            assert [event["name"] for event in shown] == [expected.names[k] for k in expected.index]
            assert len(shown) >= count
            assert_allclose([event["t"] for event in shown], expected.time, rtol=0, atol=1e-9)
            alive = np.isfinite(run.q).all((1, 2))
            q = np.asarray(run.q)[alive].reshape(alive.sum(), -1)
            if not alive.all():  # the page also shows the state at the event
                assert "stopped by turned" in note(page) and page.locator(".note.bad").count() == 0
                assert page.evaluate(f"{LIVE}.player.data.end") == pytest.approx(float(expected.time[-1]))  # the timeline's end
                q = np.vstack([q, np.ravel(expected.q_before[-1])])
            else:
                assert f"{len(shown)} event" in note(page)
            assert_allclose(shown_q(page), q, rtol=0, atol=1e-8)
        page.locator(".panel canvas").press("Backspace")
        assert page.evaluate(happened) == first


@pytest.mark.slow
def test_events_are_marked_on_the_timeline(opened, with_events):
    """Also in the player of a recorded run; the name of the event that has just happened is shown."""
    _, animation = with_events
    with opened(animation) as page:
        plain(page)
        ticks = page.locator(".ticks").bounding_box()
        t, end = page.evaluate(f"[{LIVE}.runs[0].run.events[0].t, {PLAYER}.live.player.data.end]")
        seen = picture(page)[round(ticks["y"]) : round(ticks["y"] + ticks["height"]), :]
        colour = page.evaluate(f"{LIVE}.player.theme.force")
        force = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        columns = np.flatnonzero((np.abs(seen - force).max(axis=2) < 40).any(axis=0))
        assert np.abs(columns - (ticks["x"] + 8 + (ticks["width"] - 16) * t / end)).min() < 1.5
        page.evaluate(f"{PLAYER}.seek({t + 0.01 * end})")
        assert page.locator(".happened").text_content() == f"passes, {t:.5g} s"
        page.evaluate(f"{PLAYER}.seek({t - 0.01 * end})")
        assert page.locator(".happened").text_content() == ""


def test_conditions_that_cross_zero_together_are_all_recorded(opened):
    """A condition that is zero at the start and rises does not cross."""
    pendulum = udk.library.simple_pendulum()
    body, start = pendulum.body_names[0], float(pendulum.q0[0, 2])
    conditions = {
        "left": lambda t, at: at[body].x,
        "again": lambda t, at: -2 * at[body].x,
        "start": lambda t, at: at[body].angle - start,
    }
    events = [udk.Event(condition, udk.Log(), name=name) for name, condition in conditions.items()]
    run = udk.simulate(pendulum, TS, events=events, rtol=1e-11, atol=1e-11)
    with opened(udk.animate(pendulum, run, live=["gravity[1]"], events=events)) as page:
        move(page, "gravity y", -7.0)
        other = pendulum.with_parameters({"gravity[1]": -7.0})
        expected = events_of(udk.simulate(other, TS, events=events, rtol=1e-11, atol=1e-11))
        shown = page.evaluate(f"{LIVE}.runs[0].run.events")
        assert sorted((e["name"], round(e["t"], 7)) for e in shown) == sorted(
            (expected.names[k], round(float(t), 7)) for t, k in zip(expected.time, expected.index, strict=True)
        )
        assert_allclose([e["t"] for e in shown], expected.time, rtol=0, atol=1e-9)


SLOWING = udk.Event(lambda t, at: at["link"].omega + 1.0, udk.Log(), name="slowing")  # an impact may jump across its zero
# A ball on the floor hangs by a spring on a hook that goes up and down: it lies, is lifted, and falls. A box, which stands on its
# left foot, falls on the right one, which lifts the left one.
LIFTED = udk.Mechanism(
    {"ball": udk.Body(1.0, 0.1, position=(0.0, 1.0)), "hook": udk.Body(0.1, 0.01, position=(0.0, 2.0))},
    {"guide": udk.Prismatic(("ground", "hook"), [(0.0, 0.0), (0.0, 0.0)], axis=np.pi / 2)},
    {"lift": udk.Driver(("ground", "hook"), "y", udk.Sine(1.5, 4.0, 0.0, 2.0), [(0.0, 0.0), (0.0, 0.0)])},
    {"rope": udk.Spring(("hook", "ball"), [(0.0, 0.0), (0.0, 0.0)], stiffness=6.0, length=1.0)},
)
BOX = udk.Mechanism({"box": udk.Body(1.0, 1.0, position=(0.5 * np.cos(0.1), 0.5 * np.sin(0.1)), angle=0.1)})
FEET = [udk.Contact("box", point=[x, 0.0], name=name) for x, name in ((-0.5, "left"), (0.5, "right"))]
# A box that falls on both corners at once, two balls that come to rest beside each other, and corners with friction.
FLAT = udk.Mechanism({"box": udk.Body(1.0, 1.0, position=(0.5 * np.cos(0.1), 0.5 * np.sin(0.1) + 0.2))})
CORNERS = [udk.Contact("box", point=[x, 0.0], name=name, restitution=0.5) for x, name in ((-0.5, "left"), (0.5, "right"))]
ROUGH = [udk.Contact("box", point=[x, 0.0], coefficient=0.3, name=name) for x, name in ((-0.5, "left"), (0.5, "right"))]
BALLS = udk.Mechanism({name: udk.Body(1.0, 0.1, (0.0, height)) for name, height in (("one", 1.0), ("two", 2.0))})
IMPACTS = {
    "both corners": (FLAT, CORNERS),
    "rough corners": (FLAT, ROUGH),
    "two at rest": (BALLS, [udk.Contact(name, name=name) for name in BALLS.body_names]),
    "lies": (LIFTED, [udk.Contact("ball", restitution=0.1, name="floor")]),
    "feet": (BOX, FEET),
    "rebounds": (BALL, [udk.Contact("ball", restitution=0.8, name="floor")]),
    "rest": (BALL, [udk.Contact("ball", restitution=0.5, at_rest="stop", name="floor")]),
    "inelastic": (BALL, [udk.Contact("ball", at_rest="stop", name="floor")]),
    "limits": (PENDULUM, [udk.JointLimit("A", -2.0, 1.0, restitution=0.9)]),
    "velocity": (PENDULUM, [udk.JointLimit("A", lower=-2.0, restitution=0.9), SLOWING]),
}


@pytest.mark.parametrize("name", [n if n == "rest" else pytest.param(n, marks=pytest.mark.slow) for n in IMPACTS])
def test_impacts_are_those_of_the_new_motion(opened, name):
    mechanism, events = IMPACTS[name]
    ts, tight = np.linspace(0.0, 0.3 if name == "feet" else 3.0, 91), {"rtol": 1e-11, "atol": 1e-11, "max_events": 300}
    animation = udk.animate(mechanism, udk.simulate(mechanism, ts, events=events, **tight), live=["gravity[1]"], events=events)
    run = udk.simulate(mechanism.with_parameters({"gravity[1]": -6.0}), ts, events=events, **tight)
    expected, alive = events_of(run), np.isfinite(run.q).all((1, 2))
    with opened(animation) as page:
        move(page, "gravity y", -6.0)
        shown = page.evaluate(f"{LIVE}.runs[0].run.events")
        assert [event["name"] for event in shown] == [expected.names[k] for k in expected.index]
        assert_allclose([event["t"] for event in shown], expected.time, rtol=0, atol=1e-9)
        q = shown_q(page)
        assert_allclose(q[: alive.sum()], np.asarray(run.q)[alive].reshape(alive.sum(), -1), rtol=0, atol=1e-8)
        if run.result.name == "at_rest":
            assert "floor has come to rest" in note(page) and page.locator(".note.bad").count() == 0
            assert_allclose(q[-1], np.ravel(expected.q_after[-1]), rtol=0, atol=1e-9)
        else:
            assert alive.all() and len(q) == len(ts)


@pytest.mark.slow
def test_a_body_pulled_against_a_stop_stays_there_until_it_is_pulled_back(opened):
    events = [udk.JointLimit("A", -2.4, 0.5, restitution=0.5)]
    run = udk.simulate(PENDULUM, TS, events=events, max_events=300)
    with opened(udk.animate(PENDULUM, run, live=["gravity"], events=events, measures=())) as page:
        angle = lambda: page.evaluate(f"{LIVE}.runs[0].run.pose({PLAYER}.time)[2]")  # noqa: E731
        first = np.array(page.evaluate(f"[...{LIVE}.runs[0].run.pose(0)]"))
        drag(page, on_screen(page, 0, first[:2]), on_screen(page, 0, (0.0, 0.5)), hold=0)
        until(page, f"{LIVE}.runs[0].run.events?.some(({{name}}) => name === 'A.upper rests')")
        assert angle() == pytest.approx(0.5, abs=1e-6)
        page.mouse.move(*on_screen(page, 0, (0.1, -0.5)), steps=4)
        until(page, f"{LIVE}.runs[0].run.pose({PLAYER}.time)[2] < 0.2")
        assert page.evaluate(f"{LIVE}.runs[0].run.events.at(-1).name") == "A.upper lets go"
        assert page.locator(".note.bad").count() == 0
        page.mouse.up()


def test_a_pull_passes_events_and_is_not_stopped(opened, with_events):
    _, animation = with_events
    with opened(animation) as page:
        page.evaluate(f"{PLAYER}.seek(1.4)")
        happened, before = f"{LIVE}.runs[0].run.events", page.evaluate(f"{LIVE}.runs[0].run.events.length")
        q = np.array(page.evaluate(f"[...{LIVE}.runs[0].run.pose(1.4)]")).reshape(-1, 3)
        place = on_screen(page, 0, q[2, :2])
        drag(page, place, (place[0] + 4, place[1] - 40), hold=1200)
        until(page, f"{PLAYER}.time > 1.7")  # beyond the event that stops a motion
        assert page.evaluate(happened)[-1]["name"] == "turned" and page.evaluate(f"{happened}.length") == before
        page.mouse.up()


def test_a_slider_changes_the_picture(opened, live, slider_crank):
    with opened(live) as page:
        plain(page)
        show_all(page)
        move(page, "P x", 0.3)
        assert "simulated in" in note(page)
        other = slider_crank.with_parameters({"pin.P[0]": 0.3})
        run = udk.simulate(other, TS)
        assert_allclose(shown_q(page), np.asarray(run.q).reshape(len(TS), -1), atol=1e-7)
        page.get_by_role("button", name="First motion").click()  # no ghost
        page.evaluate(f"{PLAYER}.seek({TS[13]})")
        place = np.asarray(run.q[13, 0])
        arm = np.asarray(other.joints["P"].points)[other.joints["P"].bodies.index("crank")]
        turn = np.array([[np.cos(place[2]), -np.sin(place[2])], [np.sin(place[2]), np.cos(place[2])]])
        expected = on_screen(page, 0, place[:2] + turn @ arm)
        assert np.abs(ring_centre(picture(page), expected, THEMES["light"]["ink"]) - expected).max() < 0.6


def test_a_slider_changes_all_runs_that_have_its_number(opened, slider_crank):
    """Each run keeps its own values of sliders that were not moved, and one of them is pulled."""
    heavy = slider_crank.with_parameters({"link.rod.mass": 9.0})
    mechanisms = {"light": slider_crank, "heavy": heavy}
    runs = {label: udk.simulate(one, TS) for label, one in mechanisms.items()}
    with opened(udk.animate(mechanisms, runs, live=["link.rod.mass", "pin.P[0]"])) as page:
        page.evaluate(f"{LIVE}.change({{'pin.P[0]': 0.4}})")
        assert "light: 2 s simulated in" in note(page) and "heavy: 2 s simulated in" in note(page)
        for k, one in enumerate(mechanisms.values()):
            other = one.with_parameters({"pin.P[0]": 0.4})
            shown = np.array(page.evaluate(f"[...{LIVE}.runs[{k}].run.q]")).reshape(len(TS), -1)
            assert_allclose(shown, np.asarray(udk.simulate(other, TS).q).reshape(len(TS), -1), atol=1e-8)
            torque = page.evaluate(f"[...{LIVE}.runs[{k}].run.measures.find(m => m.name === 'torque of motor').values]")
            assert_allclose(torque, udk.efforts(other, udk.simulate(other, TS))["motor"], atol=1e-5)


def test_a_slider_by_mouse_and_keys(opened, live):
    with opened(live) as page:
        slider = page.get_by_role("slider", name="motor speed")
        box = slider.bounding_box()
        page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + box["height"] / 2)
        page.mouse.down()
        page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + box["height"] / 2, steps=7)
        page.mouse.up()
        until(page, f"!{LIVE}.dirty && {LIVE}.changed")
        speed = page.evaluate(f"{LIVE}.values[0]")
        assert speed == pytest.approx(-4.0, abs=0.5)
        assert_allclose(np.diff(shown_q(page)[:, 2]) / np.diff(TS), speed, atol=1e-6)
        slider.press("ArrowRight")
        assert page.evaluate(f"{LIVE}.values[0]") > speed


@pytest.mark.slow
def test_loops_that_cannot_be_closed_are_reported_and_the_last_motion_stays(opened):
    mechanism = udk.library.parallelogram()
    with opened(udk.animate(mechanism, udk.simulate(mechanism, TS), live=["joint.A3.points"], measures=())) as page:
        before = shown_q(page)
        move(page, "A3 point 1 x", 9.0)  # the third link is half a metre long
        assert "do not close" in note(page) and "m remains. The last valid motion" in note(page)
        assert page.locator(".note.bad").count() == 1
        assert_array_equal(shown_q(page), before)
        move(page, "A3 point 1 x", 2.0)
        assert "simulated in" in note(page) and page.locator(".note.bad").count() == 0
        assert_allclose(shown_q(page), before, atol=1e-4)
        move(page, "A3 point 2 y", 0.01)  # three unequal links: the formerly redundant constraint locks them
        assert "Degrees of freedom: 0, 1 in the first motion" in note(page) or "do not close" in note(page)


@pytest.mark.slow
@pytest.mark.parametrize("apart", [3.0, 0.1])
def test_rows_that_other_numbers_make_redundant_are_found(opened, apart):
    """A bar with a misplaced third pin cannot be mounted on three cranks, or cannot move; in the right place it can."""
    name = "joint.B3.points[0][0]"
    sound = udk.library.parallelogram()
    stiff = sound.with_parameters({name: 1.0 + apart})
    still = Motion(ts=TS, q=np.tile(np.asarray(stiff.q0), (len(TS), 1, 1)), v=np.zeros((len(TS), 4, 3)))
    with opened(udk.animate(stiff, still, live={name: (0.0, 9.0)}, measures=())) as page:
        page.evaluate(f"{LIVE}.change({{{name!r}: 1.0}})")
        assert "simulated in" in note(page)
        assert_allclose(shown_q(page), np.asarray(udk.simulate(sound, TS).q).reshape(len(TS), -1), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_other_numbers_may_complete_a_failed_motion(opened):
    """A driven crank cannot make a full turn with a short rod, but can with a longer one."""
    drawing = udk.Drawing(
        pins={"O": (0.0, 0.0), "A": (0.5, 0.0), "B": (0.9, 0.3)},
        links={
            "crank": {"pins": ["O", "A"], "mass": 1.0},
            "rod": {"pins": ["A", "B"], "mass": 1.0},
            "block": {"pins": ["B"], "mass": 1.0, "inertia": 0.1},
        },
        slides=[{"link": "block", "direction": [1, 0]}],
        ground=["O"],
        motors={"motor": {"pin": "O", "speed": 4.0}},
    )
    mechanism = drawing.mechanism()
    run = udk.simulate(mechanism, TS, throw=False)
    assert not run.result.is_success
    with pytest.warns(FailedRunWarning):
        animation = udk.animate(mechanism, run, live=["pin.B"])
    with opened(animation) as page:
        assert len(shown_q(page)) < len(TS)
        page.evaluate(f"{LIVE}.change({{'pin.B[0]': 2.0}})")
        assert_allclose(shown_q(page)[:, 2], 4.0 * TS, atol=1e-7)
        assert page.evaluate(f"{PLAYER}.live.player.data.end") == TS[-1]


def test_numbers_are_typed_in_the_units_of_the_drawing(opened):
    pins, links = {"O": (0, 0), "A": (30, 40)}, {"crank": {"pins": ["O", "A"], "mass": 2}}
    motors, units = {"motor": {"pin": "O", "speed": "60 rpm"}}, {"length": "mm", "angle": "deg"}
    crank = udk.Drawing(pins, links, ground=["O"], motors=motors, units=units).mechanism()
    with opened(udk.animate(crank, udk.simulate(crank, TS), live=["motor.motor.speed", "pin.A"])) as page:
        fields = page.get_by_role("spinbutton")
        assert [fields.nth(k).input_value() for k in range(3)] == ["60", "30", "40"]
        assert page.locator(".live .unit").all_text_contents() == ["rpm", "mm", "mm"]
        move(page, "motor speed", 90)
        move(page, "A x", 45)
        assert_allclose(page.evaluate(f"[...{LIVE}.values]"), [3 * np.pi, 0.045, 0.04], rtol=1e-12)
        turned = shown_q(page)[-1, 2] - np.arctan2(40, 45)
        assert_allclose(turned, 3 * np.pi * TS[-1], atol=1e-6)


def test_reset_restores_the_first_motion_to_the_bit(opened, live):
    with opened(live) as page:
        first, values = shown_q(page), page.evaluate(f"[...{LIVE}.values]")
        symbols = page.evaluate(f"JSON.stringify({LIVE}.runs[0].run.symbols)")
        show_all(page)
        move(page, "P x", 0.4)
        move(page, "rod mass", 3.0)
        assert not np.array_equal(shown_q(page), first)
        page.locator(".panel canvas").press("Backspace")
        assert_array_equal(shown_q(page), first)
        assert page.evaluate(f"[...{LIVE}.values]") == values
        assert page.evaluate(f"JSON.stringify({LIVE}.runs[0].run.symbols)") == symbols
        assert page.get_by_role("spinbutton", name="rod mass, number").input_value() == "1.5"


def test_the_address_contains_the_numbers(opened, live):
    with opened(live) as page:
        show_all(page)
        move(page, "P x", 0.35)
        page.wait_for_timeout(400)
        shown, address = shown_q(page), page.evaluate("location.hash")
        assert "0.35" in address and "rod" not in address
    with opened(live, address) as page:
        assert_array_equal(shown_q(page), shown)
    with opened(live, "#pin.P[0]=nonsense&pin.Q=3&<b>=1") as page:
        assert not page.evaluate(f"{LIVE}.changed")


def test_the_first_motion_is_a_ghost(opened, live):
    with opened(live) as page:
        plain(page)
        show_all(page)
        page.evaluate(f"{PLAYER}.seek(0)")
        move(page, "motor speed", -4.0)  # the same place at the start; later, the mirror image
        page.evaluate(f"{PLAYER}.seek(0.3)")
        with_ghost = picture(page)[60:560, :690]
        page.locator(".panel canvas").press("g")
        without = picture(page)[60:560, :690]
        assert (np.abs(with_ghost - without).max(axis=2) > 20).sum() > 500
        assert page.get_by_role("button", name="First motion").get_attribute("aria-pressed") == "false"


def drag(page, start, end, hold):
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=6)
    page.wait_for_timeout(hold)


def test_a_pull_acts_through_the_dynamics(opened, pendulum):
    mechanism, animation = pendulum
    with opened(animation) as page:
        total = measure(page, "kinetic energy") + measure(page, "potential energy")
        assert np.ptp(total) < 1e-5  # recorded in single precision
        q = np.array(page.evaluate(f"[...{LIVE}.runs[0].run.pose(0)]")).reshape(-1, 3)
        start = on_screen(page, 0, q[1, :2])
        goal = on_screen(page, 0, (0.5, 0.4))
        page.mouse.move(*start)
        assert page.locator(".panel canvas.holds").count() == 1
        drag(page, start, goal, 1500)
        held = page.evaluate(
            f"({{t: {LIVE}.runs[0].hand.state.t, q: [...{LIVE}.runs[0].hand.state.q], spring: {LIVE}.runs[0].hand.spring}})"
        )
        assert held["t"] > 0.3  # in real time
        reached = np.array(held["q"]).reshape(-1, 3)[1, :2]
        assert np.linalg.norm(reached - [0.5, 0.4]) < 0.5 * np.linalg.norm(q[1, :2] - [0.5, 0.4])
        page.mouse.up()
        page.evaluate(f"{PLAYER}.pause()")
        ts = np.array(page.evaluate(f"[...{LIVE}.runs[0].run.ts]"))
        after = ts >= page.evaluate(f"{LIVE}.runs[0].run.ts[{LIVE}.runs[0].run.ts.length - 1]") - 1.9
        total = measure(page, "kinetic energy") + measure(page, "potential energy")
        assert np.ptp(total[after]) < 1e-5 * max(1.0, np.abs(total).max())  # after the release no energy is added
        assert measure(page, "violation").max() < 1e-9
        # After the release the motion is that of Python from the same state.
        k = int(np.flatnonzero(after)[0])
        states = np.array(page.evaluate(f"[...{LIVE}.runs[0].run.q]")).reshape(len(ts), -1, 3)
        rates = np.array(page.evaluate(f"[...{LIVE}.runs[0].run.v]")).reshape(len(ts), -1, 3)
        run = udk.simulate(mechanism, ts[k : k + 10], udk.State(states[k], rates[k]))
        assert_allclose(states[k : k + 10], run.q, atol=1e-6)


def test_a_drag_outside_the_bodies_moves_the_view(opened, pendulum):
    with opened(pendulum[1]) as page:
        before = on_screen(page, 0, (0, 0))
        box = page.locator(".panel canvas").bounding_box()
        drag(page, (box["x"] + 30, box["y"] + 30), (box["x"] + 90, box["y"] + 60), 50)
        page.mouse.up()
        assert np.abs(on_screen(page, 0, (0, 0)) - before - [60, 30]).max() < 5
        assert not page.evaluate(f"{LIVE}.changed")


def test_a_finger_pulls(opened, pendulum):
    with opened(pendulum[1], width=390, height=844, has_touch=True, is_mobile=True) as page:
        q = page.evaluate(f"[...{LIVE}.runs[0].run.pose(0)]")
        x, y = on_screen(page, 0, (q[3], q[4]))
        client = page.context.new_cdp_session(page)

        def touch(kind, *place):
            points = [{"x": place[0], "y": place[1]}] if place else []
            client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        touch("touchStart", x, y)
        for k in range(1, 6):
            touch("touchMove", x - 10 * k, y - 10 * k)
        page.wait_for_timeout(300)
        assert page.evaluate(f"{LIVE}.runs[0].hand !== null && {LIVE}.runs[0].hand.state.t > 0.02")
        touch("touchEnd")
        until(page, f"{LIVE}.runs[0].hand === null && {PLAYER}.playing")
        assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_the_fitted_view_is_that_of_the_motion_shown(opened, live):
    with opened(live) as page:
        before = page.evaluate(f"{PLAYER}.live.player.data.bounds")
        page.evaluate(f"{LIVE}.change({{'pin.B[0]': 4.0}})")
        page.locator(".panel canvas").press("0")
        right = page.evaluate(f"{PLAYER}.live.player.data.bounds[2]")
        assert right == pytest.approx(4.0, abs=0.05)  # where the slider begins
        page.locator(".panel canvas").press("Backspace")
        page.locator(".panel canvas").press("0")
        assert page.evaluate(f"{PLAYER}.live.player.data.bounds") == before


def test_a_long_motion_is_simulated_frame_by_frame(opened, pendulum):
    """With so few steps per frame that it takes several frames; the motion is still that of Python."""
    mechanism, animation = pendulum
    with opened(animation) as page:
        page.evaluate(f"{LIVE}.runs[0].steps = 9")
        script = f"{LIVE}.change({{'gravity[1]': -7.0}}); [{LIVE}.runs[0].run.ts.length, {LIVE}.panel.note.textContent]"
        count, words = page.evaluate(script)
        assert 1 < count < len(TS) and "Simulating" in words
        until(page, f"{LIVE}.runs[0].job === null")
        run = udk.simulate(mechanism.with_parameters({"gravity[1]": -7.0}), TS)
        assert_allclose(shown_q(page), np.asarray(run.q).reshape(len(TS), -1), atol=1e-6)


def test_markup_in_names_of_a_live_page_is_text(opened, hostile):
    animation = udk.animate(hostile.mechanism, udk.simulate(hostile.mechanism, TS), live=True)
    with opened(animation) as page:
        page.wait_for_timeout(100)
        assert page.evaluate("window.hit") is None
        assert page.locator("img, b b, u").count() == 0
        labels = page.locator(".live .name").all_text_contents()
        assert any(label.startswith("<img src=x onerror='window") for label in labels)


def test_without_webassembly_the_recorded_motion_is_played(opened, live):
    with opened(live, script="delete window.WebAssembly") as page:
        assert "no WebAssembly" in note(page) and "recorded" in note(page)
        assert page.get_by_role("slider", name="motor speed").is_disabled()
        page.get_by_role("button", name="play").click()
        until(page, f"{PLAYER}.time > 0.05")


@pytest.mark.slow
def test_the_page_is_readable_in_the_dark_theme_and_on_a_phone(opened, live):
    for width, height, scheme in ((1280, 800, "light"), (1280, 800, "dark"), (390, 844, "light"), (390, 844, "dark")):
        with opened(live, width=width, height=height, color_scheme=scheme) as page:
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            canvas, panel = (page.locator(name).bounding_box() for name in (".panel canvas", ".live"))
            assert canvas["width"] > 300 and canvas["height"] > 200 and panel["height"] > 150
            colours = [
                page.locator(".live .name").first.evaluate(f"e => getComputedStyle(e.closest('.player')).{name}")
                for name in ("color", "backgroundColor")
            ]
            assert contrast(*colours) > 7
            sizes = page.locator(".live *").evaluate_all("all => all.map(e => parseFloat(getComputedStyle(e).fontSize))")
            assert min(sizes) >= 11


def contrast(one, two):
    """The contrast ratio of two colours, as defined by WCAG."""

    def luminance(text):
        parts = np.array([int(part) for part in text[4:-1].split(",")]) / 255
        return np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]

    dark, bright = sorted(map(luminance, (one, two)))
    return (bright + 0.05) / (dark + 0.05)


def test_the_widget_simulates_without_python(opened, live):
    with opened.widget(live.data) as page:
        widget = "document.getElementById('one').player"
        page.evaluate(f"{widget}.live.ready")
        page.evaluate(f"{widget}.live.change({{'motor.motor.speed': 2.0}})")
        angle = np.array(page.evaluate(f"[...{widget}.live.runs[0].run.q]")).reshape(len(TS), -1)[:, 2]
        assert_allclose(angle, 2.0 * TS, atol=1e-7)
