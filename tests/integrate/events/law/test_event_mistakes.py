"""Mistakes in events are named."""

# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# All of these runs have events; wrong arguments are meant.
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.integrate.events.event_scenes import PENDULUM, TS
from udkjax.integrate.events.law.event import listed_events


@pytest.mark.parametrize(
    ("events", "message"),
    [
        (udk.JointLimit("B", lower=0.0), 'no joint named "B"'),
        (udk.JointLimit("A"), "give `lower` or `upper`"),
        (udk.JointLimit("A", lower=np.nan), 'limit "A": lower must be a finite number, not nan'),
        (udk.JointLimit("A", upper=np.inf), 'limit "A": upper must be a finite number, not inf'),
        (udk.JointLimit("A", lower=[0, 1]), 'limit "A": lower must be one number'),
        (udk.JointLimit("A", lower=1, upper=0.5), 'limit "A": lower = 1 must not be above upper = 0.5'),
        (udk.JointLimit("A", lower=0, restitution=np.nan), 'event "A.lower": the restitution must be a finite number, not nan'),
        (udk.Contact("link", point=[np.nan, 0]), r'contact "link on ground": point\[0\] is nan'),
        (udk.Contact("link", point=[0, 0, 9]), r"point must be two numbers, x and y, not an array of the shape \(3,\)"),
        (udk.Contact("link", through=[0, np.inf]), r"through\[1\] is inf"),
        (udk.Contact("link", normal=[0, 1, 5]), "normal must be two numbers"),
        (udk.Contact("link", normal=[0, 0]), "normal must not be zero"),
        (udk.Contact("link", point="here"), 'contact "link on ground": point must be real numbers, not "here"'),
        (udk.Contact("link", restitution=[0.5, 0.5]), "the restitution must be one number"),
        (udk.Contact("link", name=3), "Contact: name must be a string, not 3"),
        (udk.Event(lambda t, at: at["link"].x, direction=1.5), 'event "event1": the direction must be -1, 0 or 1, not 1.5'),
        (udk.Event(lambda t, at: at["link"].x, udk.Release(7)), "the name of Release must be a string, not 7"),
        (udk.Event(lambda t, at: at["link"].x, udk.Lock(None)), "the joint of Lock must be a string, not None"),
        (udk.Event(lambda t, at: at["link"].x, udk.Attach("weld", "w")), "the joint of Attach must be a joint"),
        (
            udk.Event(lambda t, at: at["link"].x, udk.Attach(udk.Weld(("ground", "link"), [[0, np.nan], [0, 0]]), "w")),
            r"the joint of Attach\[0, 1\] is nan: it must be finite",
        ),
        (udk.Contact("lnik"), 'no body named "lnik"; did you mean "link"'),
        (udk.Event(lambda t, at: at["lnik"].x), 'event "event1": no body named "lnik"; did you mean "link"'),
        (udk.Event(lambda t, at: at["link"].omega, udk.Impact(0.5)), "must depend on positions alone"),
        (udk.Event(lambda t, at: at["link"].x, udk.Impact(0.5), 1), "its condition falls to zero, and not where direction=1"),
        (udk.Event(lambda t, at: at["link"].x, udk.Impact(1.5)), "restitution must be from 0 to 1, not 1.5"),
        (udk.Event(lambda t, at: at["link"].x, udk.Release("C")), 'no joint or driver named "C"'),
        (udk.Event(lambda t, at: jnp.ones(2)), r"must return one number, not an array of shape \(2,\)"),
        (udk.Event(lambda t, at: None), 'event "event1": the condition must return one number, not None'),
        (
            udk.Event(lambda t, at: at["link"].y < -0.3),
            "must return a real number, not one of the type bool: return the difference",
        ),
        (udk.Event(lambda t, at: at["link"].y * 1j), "must return a real number, not one of the type complex"),
        (udk.Event(lambda t: t), r"the condition must be a function \(t, frames\), not of \(t\)"),
        ([udk.Contact("link"), udk.Contact("link")], "two events have this name"),
        ([], "the list is empty"),
        ([1.0], r"events\[0\]: must be an Event"),
        ({}, "the list is empty"),
        ({"floor": 1.0}, r'events\["floor"\]: must be an Event, a JointLimit or a Contact, not 1.0'),
        ({1: udk.Contact("link")}, "events: name must be a string, not 1"),
    ],
)
def test_mistakes_are_named(events, message):
    with pytest.raises((ValueError, TypeError), match=message):
        udk.simulate(PENDULUM, TS, events=events)


def test_a_condition_that_jax_cannot_trace_is_named():
    with pytest.raises(TypeError) as raised:
        udk.simulate(PENDULUM, TS, events=udk.Event(lambda t, at: int(at["link"].x), name="grid"))
    assert 'the condition of the event "grid" is traced by JAX: write it with jax.numpy' in raised.value.__notes__[0]


def test_events_by_name_are_those_of_a_list_with_names():
    """The same object under a name compiles nothing anew."""
    limit, log = udk.JointLimit("A", lower=-0.5), udk.Event(lambda t, at: at["link"].angle, udk.Log())
    by_name = [udk.simulate(PENDULUM, TS, events={"stop": limit, "low": log}) for _ in range(2)]
    listed = udk.simulate(
        PENDULUM, TS, events=[udk.JointLimit("A", lower=-0.5, name="stop"), udk.Event(log.condition, udk.Log(), name="low")]
    )
    for run in by_name:
        assert run.events.names == listed.events.names and "stop.lower" in run.events.names and "low" in run.events.names
        np.testing.assert_array_equal(run.q, listed.q)
    assert listed_events({"low": log})[0] is listed_events({"low": log})[0]
